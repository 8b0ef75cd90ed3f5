"""Stores the state of a core in a file, and restores it: parameters at once, nodes once they are verified."""

from __future__ import annotations

import asyncio
import logging
from typing import TYPE_CHECKING, Final

from rmpa.ros import limits
from rmpa.ros.core.liveness import is_gone, listening_ports
from rmpa.ros.core.state_writer import StateWriter
from rmpa.ros.core.store import CoreStore
from rmpa.ros.core.verification import NodeVerification
from rmpa.ros.node.local_addresses import local_addresses

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from rmpa.core.counters import Counters
    from rmpa.ros.master.master_api import MasterApi
    from rmpa.ros.master.parameters import Tree
    from rmpa.ros.master.stored_rows import StoredRegistrations

_log = logging.getLogger(__name__)
_SIMULATED: Final = "use_sim_time"
_OF_A_CORE: Final = frozenset({"/run_id", "/rosdistro", "/rosversion"})


class CorePersistence:
    """The stored state of one core.

    Args:
        path: The file.
        api: The core's master.
        fresh: Restore nothing.
        temporary: Whether a node of this name is not stored.
        carry_out: Called after each change of the registrations.
        counters: The core's.
    """

    def __init__(
        self,
        path: Path,
        api: MasterApi,
        *,
        fresh: bool,
        temporary: Callable[[str], bool],
        carry_out: Callable[[], None],
        counters: Counters,
    ) -> None:
        self._api = api
        self._fresh = fresh
        self._temporary = temporary
        self._writer = StateWriter(CoreStore(path), api, temporary, counters)
        self.verification = NodeVerification(api.registrations, carry_out)
        self.params = 0
        """Restored parameters, without those that every core sets."""

    @property
    def path(self) -> Path:
        """The file."""
        return self._writer.path

    @property
    def problem(self) -> str:
        """Why nothing is stored at present, or empty."""
        return self._writer.problem

    async def open(self) -> None:
        """Restore parameters and unverified nodes; to be called before the core listens."""
        stored = await self._writer.open(fresh=self._fresh)
        registrations = self._api.registrations
        for node, record in stored.nodes.items():
            if not self._temporary(node):
                registrations.restore(node, record)
        before = stored.tree
        if before:
            tree = await self._without_stale_sim_time(stored)
            self._api.parameters.set("/", tree)
            self.params = sum(1 for name in self._api.parameters.names() if name not in _OF_A_CORE)
        self._writer.restored_all(before)

    def start(self) -> None:
        """Begin to verify the nodes."""
        self.verification.start()
        if text := self.beginning():
            _log.info("= %s", text)

    def beginning(self) -> str:
        """A text for people about the file's content at the start; empty if the file had none."""
        nodes = self.verification.counts.nodes
        if not self.params and not nodes:
            return ""
        there = f"{self.path} has {_count(self.params, 'parameter')} and {_count(nodes, 'node')} of the run before"
        return there + ("; each node is asked whether it is still there" if nodes else "") + " (--fresh begins empty)"

    def summary(self) -> str:
        """The file and what was restored from it, for people."""
        parts = [f"kept in {self.path}" if not self.problem else "nothing is kept"]
        if self._fresh:
            parts.append("begun empty (--fresh)")
        if self.verification.counts.nodes:
            parts.append(self.verification.summary())
        if self.params:
            parts.append(f"{_count(self.params, 'parameter')} of it {'was' if self.params == 1 else 'were'} taken up")
        return "; ".join(parts)

    def schedule_write(self) -> None:
        """Write soon, if something of the core has changed."""
        self._writer.schedule_write()

    async def stop_verification(self) -> None:
        """Stop verifying nodes."""
        await self.verification.close()

    async def close(self) -> None:
        """Write what has changed, and close the file."""
        await self._writer.close()

    def notes(self) -> tuple[str, ...]:
        """Problems that the user should know of."""
        silent = self.verification.silent
        notes = list(self._writer.notes())
        if silent and self.verification.all_asked:
            named = [f"{node} at {api}" for node, api in list(silent.items())[: limits.CORE_STATE_UNFIT_SHOWN]]
            more = len(silent) - len(named)
            text = ", ".join(named) + (f" and {more} more" if more else "")
            text += " of the run before does not answer" if len(silent) == 1 else " of the run before do not answer"
            patience = f"{limits.VERIFY_PATIENCE / 60:g} min"
            notes.append(f"{text}, and is not shown; asked again for {patience}: is that program stopped?")
        return tuple(notes)

    async def _without_stale_sim_time(self, stored: StoredRegistrations) -> Tree:
        """The parameters, without ``/use_sim_time`` where no restored node is left to publish ``/clock``.

        With that parameter and no clock, a node that starts would wait for ever.
        """
        if _SIMULATED not in stored.tree:
            return dict(stored.tree)
        if stored.nodes:
            try:
                ports, addresses = await asyncio.to_thread(lambda: (listening_ports(), set(local_addresses())))
            except OSError:  # such as no file descriptor left to ask the kernel
                return dict(stored.tree)
            if not all(is_gone(record.api, ports, addresses) for record in stored.nodes.values()):
                return dict(stored.tree)
        _log.warning("= /use_sim_time of the run before is not taken up: no node of it is left")
        return {name: value for name, value in stored.tree.items() if name != _SIMULATED}


def _count(number: int, what: str) -> str:
    return f"{number} {what}{'' if number == 1 else 's'}"
