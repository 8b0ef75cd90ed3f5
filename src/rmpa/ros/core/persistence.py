"""What a core remembers over its end: its file, what is written there, and the nodes that are taken up from it."""

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
    from rmpa.ros.master.api import MasterApi
    from rmpa.ros.master.parameters import Tree
    from rmpa.ros.master.stored_rows import StoredRegistrations

_log = logging.getLogger(__name__)
_SIMULATED: Final = "use_sim_time"
_OF_A_CORE: Final = frozenset({"/run_id", "/rosdistro", "/rosversion"})


class CorePersistence:
    """The memory of one core.

    Args:
        path: The file.
        api: The core's.
        fresh: Take nothing up.
        temporary: Whether a node of this name is not to be kept.
        carry_out: Called after each change of the registrations.
        counters: Of the core.
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
        """Parameters that were taken up, those left out that every core has."""

    @property
    def path(self) -> Path:
        """Of the file."""
        return self._writer.path

    @property
    def problem(self) -> str:
        """Why nothing is kept at present, or empty."""
        return self._writer.problem

    async def open(self) -> None:
        """Take up parameters, and remember the nodes that are to be asked; to be called before the core listens."""
        kept = await self._writer.open(fresh=self._fresh)
        registrations = self._api.registrations
        for node, record in kept.nodes.items():
            if not self._temporary(node):
                registrations.restore(node, record)
        before = kept.tree
        if before:
            tree = await self._without_old_time(kept)
            self._api.parameters.set("/", tree)
            self.params = sum(1 for name in self._api.parameters.names() if name not in _OF_A_CORE)
        self._writer.taken(before)

    def start(self) -> None:
        """Ask the nodes from now on."""
        self.verification.start()
        if text := self.beginning():
            _log.info("= %s", text)

    def beginning(self) -> str:
        """What was there at the start, ready to read; empty for nothing."""
        nodes = self.verification.counts.nodes
        if not self.params and not nodes:
            return ""
        there = f"{self.path} has {_count(self.params, 'parameter')} and {_count(nodes, 'node')} of the run before"
        return there + ("; each node is asked whether it is still there" if nodes else "") + " (--fresh begins empty)"

    def summary(self) -> str:
        """Where it is kept, and what was taken up."""
        parts = [f"kept in {self.path}" if not self.problem else "nothing is kept"]
        if self._fresh:
            parts.append("begun empty (--fresh)")
        if self.verification.counts.nodes:
            parts.append(self.verification.summary())
        if self.params:
            parts.append(f"{_count(self.params, 'parameter')} of it {'was' if self.params == 1 else 'were'} taken up")
        return "; ".join(parts)

    def schedule_write(self) -> None:
        """Something of the core may have changed."""
        self._writer.schedule_write()

    async def stop_verification(self) -> None:
        """Ask no further nodes."""
        await self.verification.close()

    async def close(self) -> None:
        """Write what has changed, and end."""
        await self._writer.close()

    def notes(self) -> tuple[str, ...]:
        """What the user should know."""
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

    async def _without_old_time(self, kept: StoredRegistrations) -> Tree:
        """The parameters; without ``/use_sim_time`` where no node is left whose time it could be.

        A node that starts under it waits for a clock that nobody publishes any more.
        """
        if _SIMULATED not in kept.tree:
            return dict(kept.tree)
        if kept.nodes:
            try:
                ports, addresses = await asyncio.to_thread(lambda: (listening_ports(), set(local_addresses())))
            except OSError:  # no file descriptor is left to ask the kernel: nothing is known of them
                return dict(kept.tree)
            if not all(is_gone(record.api, ports, addresses) for record in kept.nodes.values()):
                return dict(kept.tree)
        _log.warning("= /use_sim_time of the run before is not taken up: no node of it is left")
        return {name: value for name, value in kept.tree.items() if name != _SIMULATED}


def _count(number: int, what: str) -> str:
    return f"{number} {what}{'' if number == 1 else 's'}"
