"""A resource's file: its state over a restart, and a bounded history. SQLite in a thread of its own.

Nothing here blocks the event loop, and no disk failure stops a resource: if the disk is full, read-only or gone, that
is logged once (``ResourceStore.problem``) and writing is tried again. A damaged file is renamed to ``.damaged``, and
the new file begins with all known state. ``rmpa.resource.run.history`` reads the last three tables::

    state(kind, name, value, at_ns)                      value: JSON; see resource.decide.saved_state
    windows(at_ns, profile, level, message, quality)     quality: JSON, attribute -> value in the attribute's unit
    events(at_ns, event, level, message, details)        event: apply, alarm, over, reacted; details: JSON
    descriptors(node, text, first_ns, last_ns)
"""

from __future__ import annotations

import asyncio
import concurrent.futures
import contextlib
import fcntl
import logging
import os
import sqlite3
import threading
import time
from collections import deque
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Final

from rmpa.resource import limits
from rmpa.runtime import sqlite_file
from rmpa.runtime.sqlite_file import DamagedFileError

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from rmpa.resource.decide.saved_state import Key

_log = logging.getLogger(__name__)
_VERSION: Final = 1
_PAGE: Final = 4096
_SCHEMA: Final = f"""
CREATE TABLE IF NOT EXISTS state (
    kind TEXT NOT NULL, name TEXT NOT NULL, value TEXT NOT NULL, at_ns INTEGER NOT NULL, PRIMARY KEY (kind, name));
CREATE TABLE IF NOT EXISTS windows (
    id INTEGER PRIMARY KEY, at_ns INTEGER, profile TEXT, level INTEGER, message TEXT, quality TEXT);
CREATE TABLE IF NOT EXISTS events (
    id INTEGER PRIMARY KEY, at_ns INTEGER, event TEXT, level INTEGER, message TEXT, details TEXT);
CREATE TABLE IF NOT EXISTS descriptors (
    id INTEGER PRIMARY KEY, node TEXT NOT NULL, text TEXT NOT NULL, first_ns INTEGER, last_ns INTEGER,
    UNIQUE (node, text));
PRAGMA user_version = {_VERSION};
"""
_INSERT: Final = {
    "windows": "INSERT INTO windows (at_ns, profile, level, message, quality) VALUES (?, ?, ?, ?, ?)",
    "events": "INSERT INTO events (at_ns, event, level, message, details) VALUES (?, ?, ?, ?, ?)",
    "descriptors": "INSERT INTO descriptors (node, text, first_ns, last_ns) VALUES (?, ?, ?, ?)"
    " ON CONFLICT (node, text) DO UPDATE SET last_ns = excluded.last_ns",
}
_KEPT: Final = {
    "windows": limits.STORE_WINDOWS_MAX,
    "events": limits.STORE_EVENTS_MAX,
    "descriptors": limits.STORE_DESCRIPTORS_MAX,
}
_LOCK_RETRY: Final = 0.02
"""Seconds between attempts to take the lock."""


@contextlib.contextmanager
def open_read_only(path: Path) -> Iterator[sqlite3.Connection]:
    """Open a store for reading, without disturbing its resource if that runs.

    Raises:
        OSError: The store cannot be read.
    """
    try:
        uri = f"{path.resolve().as_uri()}?mode=ro"
        with contextlib.closing(sqlite3.connect(uri, uri=True, timeout=1.0)) as connection:
            yield connection
    except sqlite3.Error as error:
        raise OSError(f"{path}: {error}") from error


def read_state(path: Path) -> dict[Key, str]:
    """The rows of a store's ``state`` table: values by kind and name.

    Raises:
        OSError: The store cannot be read.
    """
    with open_read_only(path) as connection:
        return _state(connection)


def _state(connection: sqlite3.Connection) -> dict[Key, str]:
    rows = connection.execute("SELECT kind, name, value FROM state ORDER BY kind, name")
    return {(str(kind), str(name)): str(value) for kind, name, value in rows}


@dataclass
class _Pending:
    """Changes that wait to be written: rows of ``state`` (``None`` deletes one), and rows of the other tables."""

    state: dict[Key, str | None] = field(default_factory=dict)
    rows: deque[tuple[str, tuple[object, ...]]] = field(
        default_factory=lambda: deque(maxlen=limits.STORE_PENDING_MAX)
    )

    def __bool__(self) -> bool:
        return bool(self.state or self.rows)


class ResourceStore:
    """The store of one resource. No method blocks the event loop; ``open`` and ``close`` await the thread.

    Args:
        path: The file; created with its folders if it does not exist.
        interval: Seconds between writes of the history.
        bytes_max: The largest size of the file in bytes.
    """

    def __init__(
        self, path: Path, *, interval: float = limits.STORE_INTERVAL, bytes_max: int = limits.STORE_BYTES_MAX
    ) -> None:
        self.path = path
        self.problem = ""
        """Why nothing can be stored at present; empty if storing works."""
        self._interval = interval
        self._pages = bytes_max // _PAGE
        self._change = threading.Condition()
        self._pending = _Pending()
        self._urgent = False
        self._closing = False
        self._known: dict[Key, str] = {}
        """The content of ``state``, written to the new file after a damaged or deleted one."""
        self._connection: sqlite3.Connection | None = None
        self._inode = 0
        self._lock: int | None = None
        self._opened: concurrent.futures.Future[dict[Key, str]] = concurrent.futures.Future()
        self._thread = threading.Thread(target=self._run, name=f"store {path.stem}", daemon=True)

    async def open(self) -> dict[Key, str]:
        """Open the file and return its ``state``.

        Returns:
            Values by kind and name; empty if the file cannot be read within ``limits.STORE_OPEN_TIMEOUT`` seconds,
            which is logged.
        """
        self._thread.start()
        try:
            async with asyncio.timeout(limits.STORE_OPEN_TIMEOUT):
                return await asyncio.wrap_future(self._opened)
        except TimeoutError:
            _log.warning("! %s does not answer; nothing is remembered", self.path)
            return {}

    def put(self, key: Key, value: str | None) -> None:
        """Set a row of ``state`` to a JSON text, or delete it (``None``); the thread writes it without delay."""
        with self._change:
            self._pending.state[key] = value
            self._urgent = True
            self._change.notify()

    def window(self, at_ns: int, profile: str, level: int, message: str, quality: str) -> None:
        """Add a quality window that ended at ``at_ns`` (Unix nanoseconds) to the history; ``quality`` is JSON."""
        self._add("windows", (at_ns, profile, level, message, quality))

    def event(self, at_ns: int, event: str, level: int, message: str, details: str) -> None:
        """Add an event at ``at_ns`` (Unix nanoseconds) to the history; ``details`` is JSON."""
        self._add("events", (at_ns, event, level, message, details))

    def descriptor(self, node: str, text: str, at_ns: int) -> None:
        """Add a node's descriptor (JSON) to the history; if it is there already, only its ``last_ns`` is updated."""
        self._add("descriptors", (node, text, at_ns, at_ns))

    async def close(self) -> None:
        """Write all pending changes and end the thread; a thread whose disk hangs is left behind."""
        with self._change:
            self._closing = True
            self._change.notify()
        if self._thread.ident is not None:
            await asyncio.to_thread(self._thread.join, limits.STORE_CLOSE_TIMEOUT)
            if self._thread.is_alive():
                _log.warning("! %s does not answer; what was last is not kept", self.path)

    # --- inside: the thread -------------------------------------------------------------------------------------

    def _add(self, table: str, row: tuple[object, ...]) -> None:
        with self._change:
            self._pending.rows.append((table, row))

    def _run(self) -> None:
        try:
            self._attempt(_Pending())
        finally:
            self._opened.set_result(dict(self._known))
        while True:
            with self._change:
                self._change.wait_for(lambda: self._urgent or self._closing, self._interval)
                work, self._pending = self._pending, _Pending()
                self._urgent, closing = False, self._closing
            if (work or self.problem) and not self._attempt(work) and not closing:
                self._put_back(work)
            if closing:
                break
        self._disconnect()
        if self._lock is not None:
            os.close(self._lock)

    def _put_back(self, work: _Pending) -> None:
        with self._change:
            self._pending.state = work.state | self._pending.state
            rows = [*work.rows, *self._pending.rows]
            self._pending.rows = deque(rows, maxlen=limits.STORE_PENDING_MAX)

    def _attempt(self, work: _Pending) -> bool:
        """Write changes; a damaged file is replaced first. Returns false if nothing could be written."""
        try:
            try:
                self._write(work)
            except DamagedFileError as error:
                self._set_aside(str(error))
                self._write(work)
        except (OSError, sqlite3.Error, DamagedFileError) as error:
            self._disconnect()
            self._set_problem(f"{type(error).__name__}: {error}" if not str(error) else str(error))
            return False
        self._set_problem("")
        return True

    def _write(self, work: _Pending) -> None:
        try:
            connection = self._connected()
            with connection:
                self._insert(connection, work)
        except sqlite3.DatabaseError as error:
            if sqlite_file.is_damaged(error):
                raise DamagedFileError(str(error)) from error
            raise
        for key, value in work.state.items():
            if value is None:
                self._known.pop(key, None)
            else:
                self._known[key] = value

    def _insert(self, connection: sqlite3.Connection, work: _Pending) -> None:
        now = time.time_ns()
        for (kind, name), value in work.state.items():
            if value is None:
                connection.execute("DELETE FROM state WHERE kind = ? AND name = ?", (kind, name))
            else:
                connection.execute("INSERT OR REPLACE INTO state VALUES (?, ?, ?, ?)", (kind, name, value, now))
        for table, row in work.rows:
            connection.execute(_INSERT[table], row)
        for table in {table for table, _ in work.rows}:
            # The table's name is a key of _KEPT, never user input.
            oldest = f"(SELECT max(id) FROM {table}) - {_KEPT[table]}"  # noqa: S608
            connection.execute(f"DELETE FROM {table} WHERE id <= {oldest}")  # noqa: S608

    def _connected(self) -> sqlite3.Connection:
        if self._connection is not None:
            with contextlib.suppress(OSError):
                if self.path.stat().st_ino == self._inode:
                    return self._connection
            _log.warning("! %s was taken away; it is begun anew", self.path)
            self._disconnect()
        self.path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        self._take_lock()
        connection = sqlite3.connect(self.path, timeout=1.0, check_same_thread=False)
        self._connection = connection
        connection.execute(f"PRAGMA max_page_count = {self._pages}")
        sqlite_file.check(connection, _VERSION)
        connection.execute("PRAGMA journal_mode = WAL")
        connection.execute("PRAGMA synchronous = FULL")
        connection.executescript(_SCHEMA)
        self._inode = self.path.stat().st_ino
        if not self._known:
            self._known = _state(connection)
        else:
            with connection:
                self._insert(connection, _Pending(dict(self._known)))
        return connection

    def _take_lock(self) -> None:
        """Lock the file against a second process: another module of the same name may run the same resource here.

        Raises:
            OSError: Another process holds the lock for longer than ``limits.STORE_LOCK_TIMEOUT`` seconds.
        """
        if self._lock is not None:
            return
        number = os.open(self.path.with_suffix(".lock"), os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)
        deadline = time.monotonic() + limits.STORE_LOCK_TIMEOUT
        while True:
            try:
                fcntl.flock(number, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                if time.monotonic() > deadline:
                    os.close(number)
                    raise OSError("another process uses it; name this module otherwise, or set --state") from None
                time.sleep(_LOCK_RETRY)
            except OSError:
                os.close(number)
                raise
            else:
                self._lock = number
                return

    def _set_aside(self, why: str) -> None:
        self._disconnect()
        aside = sqlite_file.set_aside(self.path)
        _log.warning("! %s is damaged (%s); it is set aside as %s and begun anew", self.path, why, aside.name)

    def _disconnect(self) -> None:
        connection, self._connection = self._connection, None
        sqlite_file.close(connection)

    def _set_problem(self, problem: str) -> None:
        """Log a problem when it begins and when it is over."""
        if problem and not self.problem:
            _log.warning("! %s: nothing is kept: %s", self.path, problem)
        elif self.problem and not problem:
            _log.info("= %s: everything is kept again", self.path)
        self.problem = problem
