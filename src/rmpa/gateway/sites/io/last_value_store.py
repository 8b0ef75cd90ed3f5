"""The file of last values: SQLite in a thread of its own.

Nothing here blocks the event loop, and no failure of the disk stops the gateway: if it is full, read-only or gone,
that is logged once (``LastValueStore.problem``), and writing is tried again. A damaged file is renamed to
``.damaged`` and begun anew with what is known::

    last_values(module, topic, node, type, md5sum, definition, latching, stamp_ns, body)
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import sqlite3
from dataclasses import replace
from typing import TYPE_CHECKING, Final, TypeVar

from rmpa.gateway import limits
from rmpa.gateway.sites.last_values import LastValue, ValueHeader, ValueKey
from rmpa.runtime import sqlite_file
from rmpa.runtime.sqlite_file import DamagedFileError
from rmpa.runtime.threads import in_thread

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable
    from pathlib import Path

_T = TypeVar("_T")
_log = logging.getLogger(__name__)
_VERSION: Final = 1
_PAGE: Final = 4096
_SLACK: Final = 2
"""The file may be so many times the values: the journal and freed pages need room."""
_SCHEMA: Final = f"""
CREATE TABLE IF NOT EXISTS last_values (
    module TEXT NOT NULL, topic TEXT NOT NULL, node TEXT NOT NULL, type TEXT NOT NULL, md5sum TEXT NOT NULL,
    definition TEXT NOT NULL, latching INTEGER NOT NULL, stamp_ns INTEGER NOT NULL, body BLOB NOT NULL,
    PRIMARY KEY (module, topic, node));
PRAGMA user_version = {_VERSION};
"""
_PUT: Final = "INSERT OR REPLACE INTO last_values VALUES (?, ?, ?, ?, ?, ?, ?, ?, ?)"
_INDEX: Final = (
    "SELECT module, topic, node, type, md5sum, definition, latching, stamp_ns, length(body) FROM last_values"
)
_GET: Final = "SELECT body FROM last_values WHERE module = ? AND topic = ? AND node = ?"
_DELETE: Final = "DELETE FROM last_values WHERE module = ? AND topic = ? AND node = ?"


class LastValueStore:
    """The last values of a site's topics.

    Args:
        path: The file; created with its folders if it does not exist. ``None``: values are kept while this runs.
        values_max: How many are kept.
        bytes_max: Bytes of all that are kept.
    """

    def __init__(
        self,
        path: Path | None,
        values_max: int = limits.LAST_VALUES_MAX,
        bytes_max: int = limits.LAST_VALUES_BYTES_MAX,
    ) -> None:
        self.path = path
        self.problem = "" if path is not None else "there is no state directory: last values are not written"
        """Why nothing is written at present; empty if all is."""
        self.dropped = 0
        """Values that were too large, or were not written because the disk took none for too long."""
        self._values_max = values_max
        self._bytes_max = bytes_max
        self._pending_max = limits.LAST_VALUES_PENDING_MAX if path is not None else bytes_max
        self._index: dict[ValueKey, ValueHeader] = {}
        self._size = 0
        """Bytes of all that is in the index."""
        self._pending: dict[ValueKey, LastValue | None] = {}
        """To write; ``None``: to delete. Newest at the end."""
        self._connection: sqlite3.Connection | None = None
        self._begun_anew = False
        self._turn = asyncio.Lock()
        self._jobs: set[asyncio.Task[object]] = set()
        self._writing: asyncio.Task[None] | None = None

    @property
    def headers(self) -> dict[ValueKey, ValueHeader]:
        """What is kept; not to be changed."""
        return self._index

    async def open(self) -> None:
        """Open the file, and read what it has; a file that cannot be used is a warning."""
        if self.path is None:
            return
        try:
            async with asyncio.timeout(limits.LAST_VALUES_OPEN_TIMEOUT):
                found = await self._in_thread(lambda: self._attempt(self._read_index))
        except TimeoutError:
            self._set_problem("the disk does not answer")
            return
        self._set_index({**(found or {}), **self._index})

    def put(self, key: ValueKey, value: LastValue) -> bool:
        """Keep a value in place of the one before; ``False``: it is too large, and the one before is forgotten."""
        if len(value.body) > min(limits.LAST_VALUE_MAX, self._bytes_max):
            self.dropped += 1
            self.forget(key)
            return False
        if len(value.definition) > limits.LAST_VALUE_DEFINITION_MAX:
            value = replace(value, definition="")
        self._pending.pop(key, None)
        self._pending[key] = value
        self._drop(key)
        self._index[key] = header = header_of(key, value)
        self._size += _cost(header)
        self._bound()
        self._write_soon()
        return True

    def forget(self, key: ValueKey) -> None:
        """Drop a value."""
        if self._drop(key):
            self._pending.pop(key, None)
            self._pending[key] = None
            self._write_soon()

    async def body(self, key: ValueKey) -> bytes | None:
        """The message of a value; ``None`` if there is none, or the disk does not give it in time."""
        waiting = self._pending.get(key)
        if waiting is not None:
            return waiting.body
        if key not in self._index or self.path is None:
            return None
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(limits.LAST_VALUES_READ_TIMEOUT):
                return await self._in_thread(lambda: self._attempt(lambda: self._read_body(key)))
        return None

    async def close(self) -> None:
        """Write what waits; a disk that hangs is left behind."""
        if self._writing is not None:
            self._writing.cancel()
            await asyncio.gather(self._writing, return_exceptions=True)
        try:
            async with asyncio.timeout(limits.LAST_VALUES_CLOSE_TIMEOUT):
                if self.path is not None:
                    await self._flush()
                await self._in_thread(self._disconnect)
        except TimeoutError:
            _log.warning("! %s does not answer; the newest values are not kept", self.path)
        for job in self._jobs:
            job.cancel()

    # --- the event loop -------------------------------------------------------------------------------------------

    def _drop(self, key: ValueKey) -> bool:
        """Take a value out of the index; return whether it was there."""
        header = self._index.pop(key, None)
        if header is not None:
            self._size -= _cost(header)
        return header is not None

    def _set_index(self, index: dict[ValueKey, ValueHeader]) -> None:
        self._index = index
        self._size = sum(map(_cost, index.values()))

    def _bound(self) -> None:
        if self._size > self._bytes_max or len(self._index) > self._values_max:
            for key in sorted(self._index, key=lambda each: self._index[each].stamp):
                if self._size <= self._bytes_max and len(self._index) <= self._values_max:
                    break
                self.forget(key)
        waiting = sum(_weight(value) for value in self._pending.values() if value is not None)
        for key, value in list(self._pending.items()) if waiting > self._pending_max else ():
            if waiting <= self._pending_max:
                break
            if value is not None:
                waiting -= _weight(value)
                del self._pending[key]
                self._drop(key)
                self.dropped += 1

    def _write_soon(self) -> None:
        if self._writing is None and self.path is not None:
            self._writing = asyncio.get_running_loop().create_task(self._write(), name="write last values")

    async def _write(self) -> None:
        failures = 0
        try:
            while self._pending:
                await asyncio.sleep(min(limits.LAST_VALUES_INTERVAL * 2**failures, limits.LAST_VALUES_RETRY_MAX))
                failures = 0 if await self._flush() else min(failures + 1, 16)
        except Exception:  # noqa: BLE001 - a task's top
            _log.exception("! writing last values failed")
        finally:
            self._writing = None

    async def _flush(self) -> bool:
        work = dict(self._pending)
        if work and await self._in_thread(lambda: self._attempt(lambda: self._insert(work))) is None:
            return False
        for key, value in work.items():
            if key in self._pending and self._pending[key] is value:
                del self._pending[key]
        return True

    async def _in_thread(self, work: Callable[[], _T]) -> _T:
        """Run one job after the other; one whose time is up goes on in its thread, since nothing can stop it."""

        async def run() -> _T:
            async with self._turn:
                found = await in_thread(work, "last values")
            if self._begun_anew:
                self._begun_anew = False
                self._set_index({key: header for key, header in self._index.items() if key in self._pending})
            return found

        job = asyncio.get_running_loop().create_task(run(), name="last values")
        self._jobs.add(job)
        job.add_done_callback(self._jobs.discard)
        return await asyncio.shield(job)

    # --- the thread -----------------------------------------------------------------------------------------------

    def _attempt(self, work: Callable[[], _T]) -> _T | None:
        """Do something with the file; a damaged one is replaced first. ``None`` if it could not be done."""
        try:
            try:
                found = self._checked(work)
            except DamagedFileError as error:
                self._set_aside(str(error))
                found = self._checked(work)
        except (OSError, sqlite3.Error, DamagedFileError) as error:
            self._disconnect()
            self._set_problem(str(error) or type(error).__name__)
            return None
        self._set_problem("")
        return found

    def _checked(self, work: Callable[[], _T]) -> _T:
        try:
            return work()
        except sqlite3.DatabaseError as error:
            if sqlite_file.is_damaged(error):
                raise DamagedFileError(str(error)) from error
            raise

    def _read_index(self) -> dict[ValueKey, ValueHeader]:
        found = {}
        for module, topic, node, kind, md5sum, definition, latching, stamp, size in self._connected().execute(_INDEX):
            found[ValueKey(str(module), str(topic), str(node))] = ValueHeader(
                node=str(node),
                type=str(kind),
                md5sum=str(md5sum),
                definition=str(definition),
                latching=bool(latching),
                stamp=int(stamp),
                size=int(size),
            )
        return found

    def _read_body(self, key: ValueKey) -> bytes | None:
        row = self._connected().execute(_GET, (key.module, key.topic, key.node)).fetchone()
        return bytes(row[0]) if row is not None else None

    def _insert(self, work: dict[ValueKey, LastValue | None]) -> bool:
        connection = self._connected()
        with connection:
            connection.executemany(_DELETE, _places(key for key, value in work.items() if value is None))
            connection.executemany(
                _PUT,
                (
                    (*place, v.type, v.md5sum, v.definition, int(v.latching), v.stamp, v.body)
                    for key, v in work.items()
                    if v is not None
                    for place in _places([key])
                ),
            )
        return True

    def _connected(self) -> sqlite3.Connection:
        assert self.path is not None  # noqa: S101 - without a file nothing comes to the thread
        if self._connection is not None:
            return self._connection
        self.path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        connection = sqlite3.connect(self.path, timeout=1.0, check_same_thread=False)
        self._connection = connection
        sqlite_file.check(connection, _VERSION)
        connection.execute("PRAGMA journal_mode = WAL")
        connection.execute("PRAGMA synchronous = NORMAL")
        connection.executescript(_SCHEMA)
        connection.execute(f"PRAGMA max_page_count = {_SLACK * self._bytes_max // _PAGE + 64}")
        return connection

    def _set_aside(self, why: str) -> None:
        assert self.path is not None  # noqa: S101 - as above
        self._disconnect()
        aside = sqlite_file.set_aside(self.path)
        self._begun_anew = True
        _log.warning("! %s is damaged (%s); it is set aside as %s and begun anew", self.path, why, aside.name)

    def _disconnect(self) -> None:
        connection, self._connection = self._connection, None
        sqlite_file.close(connection)

    def _set_problem(self, problem: str) -> None:
        """Log a problem when it begins and when it is over."""
        if problem and not self.problem:
            _log.warning("! %s: last values are not kept: %s", self.path, problem)
        elif self.problem and not problem:
            _log.info("= %s: last values are kept again", self.path)
        self.problem = problem


def header_of(key: ValueKey, value: LastValue) -> ValueHeader:
    """All of a value but its message."""
    return ValueHeader(
        node=key.node,
        type=value.type,
        md5sum=value.md5sum,
        definition=value.definition,
        latching=value.latching,
        stamp=value.stamp,
        size=len(value.body),
    )


def _places(keys: Iterable[ValueKey]) -> list[tuple[str, str, str]]:
    return [(key.module, key.topic, key.node) for key in keys]


def _cost(header: ValueHeader) -> int:
    """Bytes that a value takes, as ``bytes_max`` counts them: of its definition too, which is kept in memory."""
    return header.size + len(header.definition)


def _weight(value: LastValue) -> int:
    return len(value.body) + len(value.definition)
