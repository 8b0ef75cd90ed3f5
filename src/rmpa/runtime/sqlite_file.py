"""What the stores of an agent share that keep their state in a file of SQLite: what is damaged, and where it goes."""

from __future__ import annotations

import contextlib
import sqlite3
from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from pathlib import Path

_DAMAGED: Final = (sqlite3.SQLITE_CORRUPT, sqlite3.SQLITE_NOTADB)


class DamagedFileError(Exception):
    """The file cannot be used: it is damaged, no store of this kind, or has the format of a later release."""


def is_damaged(error: sqlite3.Error) -> bool:
    """Whether SQLite says by an error that the file is damaged, or no data base at all."""
    return getattr(error, "sqlite_errorcode", 0) & 0xFF in _DAMAGED


def check(connection: sqlite3.Connection, version: int) -> None:
    """Look at a file that was opened.

    Args:
        connection: Of the file.
        version: The newest format that this release reads (``PRAGMA user_version``).

    Raises:
        DamagedFileError: The format is newer, or the file is damaged.
        sqlite3.Error: It cannot be read; see ``is_damaged``.
    """
    if (found := int(connection.execute("PRAGMA user_version").fetchone()[0])) > version:
        raise DamagedFileError(f"it is of version {found}; this release reads {version}")
    if (said := connection.execute("PRAGMA quick_check(1)").fetchone()[0]) != "ok":
        raise DamagedFileError(said)


def set_aside(path: Path) -> Path:
    """Rename a closed file to ``.damaged``, in place of an earlier one, and remove its journals; return the new path.

    Raises:
        OSError: It cannot be renamed.
    """
    aside = path.with_name(f"{path.name}.damaged")
    path.replace(aside)
    for suffix in ("-wal", "-shm", "-journal"):
        path.with_name(f"{path.name}{suffix}").unlink(missing_ok=True)
    return aside


def close(connection: sqlite3.Connection | None) -> None:
    """Close a connection, if there is one, whatever state the disk is in."""
    if connection is not None:
        with contextlib.suppress(sqlite3.Error):
            connection.close()
