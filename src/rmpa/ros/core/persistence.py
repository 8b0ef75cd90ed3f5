"""Stores the state of a core in a file, and restores it: parameters at once, nodes once they are verified.

Restored is what was lost under running nodes. After the end of all nodes the core begins empty, as a roscore does:
what a launch file of yesterday set would act for ever.
"""

from __future__ import annotations

import asyncio
import logging
from pathlib import Path
from typing import TYPE_CHECKING, Final

from rmpa.ros import limits
from rmpa.ros.core.state_writer import StateWriter
from rmpa.ros.core.store import CoreStore
from rmpa.ros.core.verification import NodeVerification, any_left

if TYPE_CHECKING:
    from collections.abc import Callable

    from rmpa.core.counters import Counters
    from rmpa.ros.master.master_api import MasterApi
    from rmpa.ros.master.parameters import Tree
    from rmpa.ros.master.stored_rows import StoredRegistrations

_log = logging.getLogger(__name__)
_BOOT_ID: Final = Path("/proc/sys/kernel/random/boot_id")
_SIMULATED: Final = "use_sim_time"
_SHOWN: Final = 3
"""Namespaces of dropped parameters that are named."""
_OF_A_CORE: Final = frozenset({"/run_id", "/rosdistro", "/rosversion"})


class CorePersistence:
    """The stored state of one core.

    Args:
        path: The file.
        api: The core's master.
        keep: When to restore it: ``auto``, if a node of it still runs or the core died within this boot of the
            machine; ``always``; ``never``.
        temporary: Whether a node of this name is not stored.
        carry_out: Called after each change of the registrations.
        counters: The core's.
    """

    def __init__(
        self,
        path: Path,
        api: MasterApi,
        *,
        keep: str,
        temporary: Callable[[str], bool],
        carry_out: Callable[[], None],
        counters: Counters,
    ) -> None:
        self._api = api
        self._keep = keep
        self._dropped = ""
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
        boot = await asyncio.to_thread(_boot_id)
        stored = await self._writer.open(boot)
        if self._keep != "always" and (stored.nodes or stored.tree):
            died = bool(boot) and stored.boot == boot
            if self._keep == "never" or not (died or await any_left(stored.nodes)):
                self._drop(stored)
                return
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
        if self._dropped:
            return self._dropped
        if not self.params and not nodes:
            return ""
        there = f"{self.path} has {_count(self.params, 'parameter')} and {_count(nodes, 'node')} of the run before"
        return (
            there
            + ("; each node is asked whether it is still there" if nodes else "")
            + " (--keep never begins empty)"
        )

    def summary(self) -> str:
        """The file and what was restored from it, for people."""
        parts = [f"kept in {self.path}" if not self.problem else "nothing is kept"]
        if self._dropped:
            parts.append(self._dropped)
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

    def _drop(self, stored: StoredRegistrations) -> None:
        """Begin empty."""
        self._writer.begin_empty()
        self._writer.restored_all({})
        names = [name for name in stored.tree if f"/{name}" not in _OF_A_CORE]
        if not names and not stored.nodes:
            return
        why = "core.keep is never" if self._keep == "never" else "no node of the run before is left"
        self._dropped = f"the core begins empty: {why}"
        if names and self._keep == "auto":
            more = f" and {len(names) - _SHOWN} more" if len(names) > _SHOWN else ""
            shown = ", ".join(f"/{name}" for name in names[:_SHOWN])
            self._dropped += f'; its parameters {shown}{more} are dropped (core.keep = "always" keeps them)'

    async def _without_stale_sim_time(self, stored: StoredRegistrations) -> Tree:
        """The parameters, without ``/use_sim_time`` where no restored node is left to publish ``/clock``.

        With that parameter and no clock, a node that starts would wait for ever.
        """
        if _SIMULATED not in stored.tree:
            return dict(stored.tree)
        if await any_left(stored.nodes):
            return dict(stored.tree)
        _log.warning("= /use_sim_time of the run before is not taken up: no node of it is left")
        return {name: value for name, value in stored.tree.items() if name != _SIMULATED}


def _boot_id() -> str:
    """Identifies this boot of the machine; empty where the kernel does not say."""
    try:
        return _BOOT_ID.read_text().strip()
    except OSError:
        return ""


def _count(number: int, what: str) -> str:
    return f"{number} {what}{'' if number == 1 else 's'}"
