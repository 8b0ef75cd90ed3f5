"""The file of the token that clients need: made once, readable by its owner alone."""

from __future__ import annotations

import os
import re
import secrets
import stat
from typing import TYPE_CHECKING, Final

from rmpa.core.errors import StartError
from rmpa.web import limits

if TYPE_CHECKING:
    from pathlib import Path

_TOKEN: Final = re.compile(r"[A-Za-z0-9._~+/=-]+")  # RFC 6750, section 2.1


def token_from(path: Path) -> tuple[str, bool]:
    """The token of a file, and whether the file was made now.

    Raises:
        StartError: The file cannot be made or read, others may read it, or it holds no token.
    """
    try:
        path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        try:
            fd = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC | os.O_NOFOLLOW, 0o600)
        except FileExistsError:
            return _read(path), False
        token = secrets.token_urlsafe(limits.WEB_TOKEN_BYTES)
        with os.fdopen(fd, "w", encoding="ascii") as file:
            file.write(f"{token}\n")
    except OSError as error:
        problem = f"the token's file cannot be used: {error.strerror}"
        raise StartError(str(path), problem, "choose another one with --token-file") from None
    return token, True


def _read(path: Path) -> str:
    with path.open("rb") as file:
        mode = os.fstat(file.fileno()).st_mode
        if stat.S_ISREG(mode) and mode & 0o077:
            problem = f"other users may use the token's file (mode {stat.S_IMODE(mode):03o})"
            raise StartError(str(path), problem, f"chmod 600 {path}")
        text = file.read(limits.WEB_TOKEN_FILE_MAX).decode("utf-8", "replace").strip()
    if len(text) < limits.WEB_TOKEN_LENGTH_MIN or not _TOKEN.fullmatch(text):
        problem = f"holds no token of {limits.WEB_TOKEN_LENGTH_MIN} letters, digits or ._~+/=- and more"
        raise StartError(str(path), problem, "remove the file, and rmpa web makes one")
    return text
