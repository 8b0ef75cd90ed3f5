"""Writes changes of a core's registrations and parameters to its state file, a moment after they happen."""

from __future__ import annotations

import asyncio
import contextlib
import logging
from typing import TYPE_CHECKING, Final

from rmpa.core import limits as core_limits
from rmpa.ros import limits
from rmpa.ros.core.store import is_locked
from rmpa.ros.master import stored_rows
from rmpa.ros.wire.xmlrpc import brief
from rmpa.runtime.event_loop import yielding_to_data

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from rmpa.core.counters import Counters
    from rmpa.ros.core.store import CoreStore
    from rmpa.ros.master.master_api import MasterApi
    from rmpa.ros.master.parameters import Tree
    from rmpa.ros.master.stored_rows import Key, Row, StoredRegistrations

_log = logging.getLogger(__name__)
_NONE: Final = (0, 0)
_ROW: Final = 64
_OPENS: Final = 3
"""Attempts to open a locked file at the start; each waits for ``limits.CORE_STATE_LOCKED``."""
_RECORDS: Final = 8
"""Nodes serialized in a row, before other pending data is served; each takes some 25 microseconds."""


class StateWriter:
    """Finds the rows that have changed, and writes them.

    Args:
        store: The file.
        api: The core's master.
        temporary: Whether a node of this name is not stored, because the agent registers its own nodes anew.
        counters: ``kept.written``, ``kept.failed``, ``kept.unfit``.
    """

    def __init__(
        self, store: CoreStore, api: MasterApi, temporary: Callable[[str], bool], counters: Counters
    ) -> None:
        self._store = store
        self._api = api
        self._temporary = temporary
        self._counters = counters
        self.problem = ""
        """Why nothing is stored at present, or empty."""
        self._revisions: dict[str, int] = {}
        self._tree: Tree = {}
        self._revision = -1
        """Of the registrations when they were last compared with the file."""
        self._known: dict[Key, tuple[int, int]] = {}
        """Size and hash of each row that is in the file."""
        self._size = 0
        self._unfit: dict[Key, str] = {}
        self._rewrite = False
        self._run = self._run_written = b""
        """The row that says that this core runs, and whether it is in the file."""
        self._unread = False
        """Whether the file could not be read at the start: it is copied before it is written."""
        self._timer: asyncio.TimerHandle | None = None
        self._writing: asyncio.Task[None] | None = None
        self._again = False
        self._closed = False

    @property
    def path(self) -> Path:
        """The file."""
        return self._store.path

    # --- the start --------------------------------------------------------------------------------------------

    async def open(self, boot: str) -> StoredRegistrations:
        """Open the file and read it; the result is empty if it cannot be read (``problem`` says why).

        Args:
            boot: Identifies the present boot of the machine; written until ``close()``.
        """
        self._run = boot.encode()
        try:
            rows = await self._opened()
        except OSError as error:
            self._rewrite = self._unread = True
            self._set_problem(str(error))
            self._after(limits.CORE_STATE_RETRY)
            return stored_rows.StoredRegistrations()
        found = stored_rows.read(rows)
        for lost in found.lost[: core_limits.LOG_LINES_MAX]:
            _log.warning("! %s: left out: %s", self.path, lost)
        self._known = {(kind, name): _known(name, value) for kind, name, value in rows}
        self._size = sum(size for size, _ in self._known.values())
        self._run_written = found.boot.encode()
        return found

    def begin_empty(self) -> None:
        """Write everything with the next write, in place of what the file has."""
        self._revisions, self._tree, self._known, self._size, self._run_written = {}, {}, {}, 0, b""
        self._rewrite = True

    async def _opened(self) -> list[Row]:
        """Open the file and return its rows; tries again while the previous process holds the file's lock."""
        for _ in range(_OPENS - 1):
            try:
                return await self._store.open()
            except OSError as error:
                if not is_locked(error):
                    raise
        return await self._store.open()

    def restored_all(self, tree: Tree) -> None:
        """Take the master's present state as stored: it has all that was read.

        Args:
            tree: The parameters in the file.
        """
        self._revisions = dict(self._api.registrations.revisions)
        self._tree = tree

    def schedule_write(self) -> None:
        """Write soon, if something has changed."""
        registrations, tree = self._api.registrations, self._api.parameters.tree
        if self._closed or (registrations.revision == self._revision and tree is self._tree and not self.problem):
            return
        if self._writing is not None:
            self._again = True
        elif self._timer is None:
            self._after(limits.CORE_STATE_GATHER)

    async def close(self) -> None:
        """Write what has changed, and close the file."""
        self._closed = True
        if self._timer is not None:
            self._timer.cancel()
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(limits.CORE_STATE_CLOSE):
                if self._writing is not None:
                    await self._writing
                self._run = b""
                await self._write()
        if self._writing is not None and not self._writing.done():
            self._writing.cancel()
            await asyncio.gather(self._writing, return_exceptions=True)
        await self._store.close()

    def notes(self) -> tuple[str, ...]:
        """Problems that the user should know of."""
        notes = []
        if self.problem:
            notes.append(f"nothing of the core is kept over a restart: {self.problem}")
        if self._unfit:
            texts = list(self._unfit.values())
            more = len(texts) - limits.CORE_STATE_UNFIT_SHOWN
            text = ", ".join(texts[: limits.CORE_STATE_UNFIT_SHOWN]) + (f" and {more} more" if more > 0 else "")
            notes.append(f"not kept over a restart of the core: {text}")
        return tuple(notes)

    # --- inside -----------------------------------------------------------------------------------------------

    def _after(self, seconds: float) -> None:
        self._timer = asyncio.get_running_loop().call_later(seconds, self._begin)

    def _begin(self) -> None:
        self._timer = None
        self._again = False
        self._writing = asyncio.get_running_loop().create_task(self._work(), name="keep the core's state")

    async def _work(self) -> None:
        good = False
        try:
            good = await self._write()
        except Exception:  # noqa: BLE001 - a task's top
            _log.exception("! keeping the core's state failed")
        finally:
            self._writing = None
            if not self._closed and (self._again or not good):
                self._after(limits.CORE_STATE_GATHER if good else limits.CORE_STATE_RETRY)

    async def _write(self) -> bool:
        """Write what has changed; return whether that succeeded."""
        registrations, tree = self._api.registrations, self._api.parameters.tree
        revisions, revision = dict(registrations.revisions), registrations.revision
        same = revisions == self._revisions and tree is self._tree and self._run == self._run_written
        if same and not self._rewrite and not self.problem:
            self._revision = revision
            return True
        try:
            if self._unread:
                if (aside := await self._store.copy_aside()) is not None:
                    _log.warning("! %s was not read at the start; what it holds is kept as %s", self.path, aside)
                self._unread = False
            if await self._store.taken_away() and not self._rewrite:
                self.begin_empty()
            rows = dict(self._changed_nodes(revisions))
            rows |= self._changed_params(tree)
            known = self._fitting(rows)
            run = self._run
            if run != self._run_written:
                rows[stored_rows.RUN] = run
            if rows or self._rewrite:
                await self._store.write(rows, anew=self._rewrite)
                self._counters.add("kept.written")
        except OSError as error:
            self._counters.add("kept.failed")
            self._set_problem(str(error))
            return False
        self._rewrite = False
        self._revisions, self._tree, self._revision, self._run_written = revisions, tree, revision, run
        for key, (size, digest) in known.items():
            self._size += size - self._known.pop(key, _NONE)[0]
            if size:
                self._known[key] = size, digest
        self._set_problem("")
        return True

    def _changed_nodes(self, revisions: dict[str, int]) -> dict[Key, bytes | None]:
        rows: dict[Key, bytes | None] = {
            (stored_rows.NODE, name): None
            for name in yielding_to_data(list(self._revisions))
            if name not in revisions
        }
        for name, revision in yielding_to_data(revisions.items(), every=_RECORDS):
            if self._revisions.get(name) != revision and not self._temporary(name):
                record = self._api.registrations.record(name)
                rows[stored_rows.NODE, name] = record.serialize() if record is not None else None
        return rows

    def _changed_params(self, tree: Tree) -> dict[Key, bytes | None]:
        rows: dict[Key, bytes | None] = {}
        for path, value in yielding_to_data(stored_rows.changed_params(self._tree, tree)):
            key = stored_rows.param_key(path)
            rows[key] = None
            if value is not None:
                try:
                    rows[key] = stored_rows.packed(value, yielding_to_data)
                except stored_rows.NotStorableError as error:
                    self._refuse(key, "/" + "/".join(path), str(error))
                    continue
            self._unfit.pop(key, None)
        return rows

    def _fitting(self, rows: dict[Key, bytes | None]) -> dict[Key, tuple[int, int]]:
        """Remove rows that are in the file already or do not fit; return size and hash of each other row."""
        known: dict[Key, tuple[int, int]] = {}
        size = self._size
        for key, value in sorted(rows.items(), key=lambda row: row[1] is not None):
            name = key[1]
            wanted = _known(name, value) if value is not None else _NONE
            before = self._known.get(key, _NONE)
            if wanted[0] and size - before[0] + wanted[0] > limits.CORE_STATE_BYTES:
                self._refuse(key, brief(name), f"{wanted[0]:,} bytes beside the {size:,} that are kept")
                rows[key], wanted = None, _NONE
            if wanted == before:
                del rows[key]
                continue
            size += wanted[0] - before[0]
            known[key] = wanted
        return known

    def _refuse(self, key: Key, name: str, why: str) -> None:
        self._counters.add("kept.unfit")
        if not self._unfit:
            _log.warning("! %s is not kept over a restart of the core: %s", name, why)
        self._unfit[key] = f"{key[0]} {name} ({why})"

    def _set_problem(self, problem: str) -> None:
        """Note a problem; log when it begins and when it is over."""
        if problem and not self.problem:
            _log.warning("! nothing of the core is kept over a restart: %s", problem)
        elif self.problem and not problem:
            _log.info("= %s: everything is kept again", self.path)
        self.problem = problem


def _known(name: str, value: bytes) -> tuple[int, int]:
    """Size in bytes and hash of a row. The name counts twice because it is in the index too."""
    return 2 * len(name) + len(value) + _ROW, hash(value)
