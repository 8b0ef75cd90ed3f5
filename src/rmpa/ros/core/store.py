"""The state file of a core: SQLite, accessed in threads.

It has one table, ``kept(kind, name, value)``; ``ros.master.stored_rows`` defines its rows. A commit is one
transaction in a write-ahead log. It does not wait for the disk: the data survives any end of the process, but a loss
of power may lose the last seconds. A file that is damaged, of another program or of a newer release is set aside
under ``.damaged``.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import os
import sqlite3
from typing import TYPE_CHECKING, Final, TypeVar

from rmpa.ros import limits
from rmpa.runtime import sqlite_file
from rmpa.runtime.sqlite_file import DamagedFileError
from rmpa.runtime.threads import in_thread

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping
    from pathlib import Path

    from rmpa.ros.master.stored_rows import Key, Row

_log = logging.getLogger(__name__)
_T = TypeVar("_T")
_VERSION: Final = 1
_APPLICATION: Final = 0x524D5041
"""``RMPA`` in the file's header identifies the program."""
_PAGE: Final = 4096
_SCHEMA: Final = f"""
CREATE TABLE IF NOT EXISTS kept (kind TEXT NOT NULL, name TEXT NOT NULL, value BLOB NOT NULL, UNIQUE (kind, name));
PRAGMA application_id = {_APPLICATION};
PRAGMA user_version = {_VERSION};
"""
_PUT: Final = "INSERT INTO kept VALUES (?, ?, ?) ON CONFLICT (kind, name) DO UPDATE SET value = excluded.value"
_REMEDIES: Final = {
    sqlite3.SQLITE_FULL: "make room on that disk",
    sqlite3.SQLITE_READONLY: "make it writable for this user, or set RMPA_STATE_DIR",
    sqlite3.SQLITE_CANTOPEN: "make its directory writable for this user, or set RMPA_STATE_DIR",
    sqlite3.SQLITE_BUSY: "another process uses it: each module needs a name or core port of its own",
}


def is_locked(error: OSError) -> bool:
    """Whether an error of a store means that another process has locked the file."""
    return getattr(error.__cause__, "sqlite_errorcode", 0) & 0xFF == sqlite3.SQLITE_BUSY


class CoreStore:
    """One state file; one access at a time: ``OSError`` while an earlier access still hangs.

    Args:
        path: Created if it does not exist, with its folders, for this user alone.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._connection: sqlite3.Connection | None = None
        self._inode = 0
        self._busy = False

    async def open(self) -> list[Row]:
        """Open the file and read all rows, in the order in which they were first written.

        Raises:
            OSError: The file cannot be used; the text has the reason and a remedy.
        """
        return await self._run(self._open, limits.CORE_STATE_OPEN)

    async def write(self, rows: Mapping[Key, bytes | None], *, anew: bool = False) -> None:
        """Write rows and delete those that are ``None``, in one transaction.

        Args:
            rows: Must not change until this returns.
            anew: Delete all other rows.

        Raises:
            OSError: As for ``open``; nothing was written.
        """
        await self._run(lambda: self._write(rows, anew=anew), limits.CORE_STATE_WRITE)

    async def copy_aside(self) -> Path | None:
        """Copy a file that could not be read at the start to ``.before``, in place of an older copy.

        Returns:
            The copy, or ``None`` if the file is empty.

        Raises:
            OSError: As for ``open``.
        """
        return await self._run(self._copied, limits.CORE_STATE_WRITE)

    async def taken_away(self) -> bool:
        """Whether the file was removed or replaced since it was opened."""
        return await self._run(self._replaced, limits.CORE_STATE_WRITE)

    async def close(self) -> None:
        """Close the file."""
        with contextlib.suppress(OSError):
            await self._run(self._disconnect, limits.CORE_STATE_CLOSE)

    # --- inside: in threads -----------------------------------------------------------------------------------

    async def _run(self, function: Callable[[], _T], seconds: float | None = None) -> _T:
        silent = f"{self.path}: the disk does not answer"
        if self._busy:  # the previous access still hangs
            raise OSError(silent)
        self._busy = True
        try:
            async with asyncio.timeout(seconds):
                return await in_thread(lambda: self._call(function), "core state")
        except TimeoutError:
            raise OSError(silent) from None

    def _call(self, function: Callable[[], _T]) -> _T:
        """Call a function; errors of SQLite become an ``OSError`` with a remedy."""
        try:
            return function()
        except sqlite3.Error as error:
            self._disconnect()
            remedy = _REMEDIES.get(getattr(error, "sqlite_errorcode", 0) & 0xFF, "")
            raise OSError(f"{self.path}: {error}" + (f"; {remedy}" if remedy else "")) from error
        except OSError as error:
            self._disconnect()
            problem = error.strerror or str(error)
            raise OSError(f"{error.filename or self.path}: {problem}; set RMPA_STATE_DIR to another place") from error
        finally:
            self._busy = False

    def _open(self) -> list[Row]:
        try:
            return self._read()
        except DamagedFileError as error:
            why = str(error)
        except sqlite3.DatabaseError as error:
            if not sqlite_file.is_damaged(error):
                raise
            why = str(error)
        self._set_aside(why)
        return self._read()

    def _read(self) -> list[Row]:
        connection = self._connected()
        rows = connection.execute("SELECT kind, name, value FROM kept ORDER BY rowid").fetchall()
        if not all(isinstance(kind, str) and isinstance(name, str) and type(v) is bytes for kind, name, v in rows):
            raise DamagedFileError("a row of it is of another kind")
        return rows

    def _connected(self) -> sqlite3.Connection:
        if self._connection is not None:
            return self._connection
        self.path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        os.close(os.open(self.path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600))
        if self.path.stat().st_size > 2 * limits.CORE_STATE_BYTES:
            raise DamagedFileError("it is larger than a core's file can be")
        connection = sqlite3.connect(self.path, timeout=limits.CORE_STATE_LOCKED, check_same_thread=False)
        self._connection = connection
        # The lock is held until the file is closed: it keeps other processes away, and SQLite needs no shared memory.
        connection.execute("PRAGMA locking_mode = EXCLUSIVE")
        connection.execute("PRAGMA journal_mode = WAL")
        connection.execute("PRAGMA synchronous = NORMAL")
        connection.execute(f"PRAGMA max_page_count = {2 * limits.CORE_STATE_BYTES // _PAGE}")
        application, tables = (
            int(connection.execute(query).fetchone()[0])
            for query in ("PRAGMA application_id", "SELECT count(*) FROM sqlite_master")
        )
        if tables and application != _APPLICATION:
            raise DamagedFileError("it is another program's")
        sqlite_file.check(connection, _VERSION)
        connection.executescript(_SCHEMA)
        self._inode = self.path.stat().st_ino
        return connection

    def _write(self, rows: Mapping[Key, bytes | None], *, anew: bool) -> None:
        connection = self._connected()
        with connection:
            if anew:
                connection.execute("DELETE FROM kept")
            gone = [key for key, value in rows.items() if value is None]
            connection.executemany("DELETE FROM kept WHERE kind = ? AND name = ?", gone)
            connection.executemany(_PUT, [(*key, value) for key, value in rows.items() if value is not None])

    def _replaced(self) -> bool:
        with contextlib.suppress(OSError):
            if self._connection is not None and self.path.stat().st_ino == self._inode:
                return False
        self._disconnect()
        return True

    def _copied(self) -> Path | None:
        if not self._open():
            return None
        connection = self._connected()
        aside = self.path.with_name(f"{self.path.name}.before")
        aside.unlink(missing_ok=True)
        os.close(os.open(aside, os.O_RDWR | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o600))
        connection.execute("VACUUM INTO ?", (str(aside),))
        return aside

    def _set_aside(self, why: str) -> None:
        self._disconnect()
        aside = sqlite_file.set_aside(self.path)
        _log.warning(
            "! %s cannot be read (%s); it is set aside as %s, and the core begins empty", self.path, why, aside
        )

    def _disconnect(self) -> None:
        connection, self._connection = self._connection, None
        sqlite_file.close(connection)
