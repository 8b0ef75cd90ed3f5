"""Runs programs of the system, and asks the resolver, each with a time-out."""

from __future__ import annotations

import contextlib
import shutil
import socket
import subprocess
import threading
from typing import TYPE_CHECKING

from rmpa.observe import limits

if TYPE_CHECKING:
    from collections.abc import Iterable


def ask_program(*words: str) -> str | None:
    """What a program prints; ``None`` if it is missing, fails, or takes more than ``limits.DOCTOR_PROGRAM``."""
    path = shutil.which(words[0], path="/usr/sbin:/sbin:/usr/bin:/bin")
    if path is None:
        return None
    try:
        done = subprocess.run(  # noqa: S603 - fixed arguments, and a program of the system's folders
            [path, *words[1:]],
            capture_output=True,
            timeout=limits.DOCTOR_PROGRAM,
            check=False,
            stdin=subprocess.DEVNULL,
        )
    except (OSError, subprocess.TimeoutExpired):
        return None
    return done.stdout[: limits.DOCTOR_OUTPUT_MAX].decode("utf-8", "replace") if done.returncode == 0 else None


def resolve(names: Iterable[str]) -> dict[str, tuple[str, ...]]:
    """The IPv4 addresses of host names; none for a name that is not resolved within ``limits.DOCTOR_NAME``."""
    found: dict[str, tuple[str, ...]] = dict.fromkeys(names, ())

    def look(name: str) -> None:
        with contextlib.suppress(OSError, UnicodeError):
            found[name] = tuple(dict.fromkeys(str(a[4][0]) for a in socket.getaddrinfo(name, None, socket.AF_INET)))

    # The resolver cannot be interrupted: a thread that still waits ends with the program.
    threads = [threading.Thread(target=look, args=(name,), daemon=True) for name in found]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(limits.DOCTOR_NAME)
    return dict(found)
