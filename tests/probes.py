"""What this machine can do for tests, each found out by trying it once."""

from __future__ import annotations

import functools
import os
import pty
import shutil


@functools.cache
def why_no_pty() -> str:
    """Why no pseudo-terminal can be opened here, or an empty string."""
    try:
        ours, its = pty.openpty()
    except OSError as error:
        return f"this machine gives no pseudo-terminals ({error})"
    os.close(ours)
    os.close(its)
    return ""


@functools.cache
def why_no_git() -> str:
    """Why git cannot be used here, or an empty string."""
    return "" if shutil.which("git") else "no git here (apt install git)"
