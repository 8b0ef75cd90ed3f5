"""Counts the changes of the local graph, and lets clients of the control socket wait for the next one."""

from __future__ import annotations

import asyncio
import contextlib
import secrets
from typing import TYPE_CHECKING

from rmpa.core.errors import ConfigError
from rmpa.observe import limits
from rmpa.observe.snapshot import GraphRevision

if TYPE_CHECKING:
    from rmpa.ros.core.api import Core


class GraphRevisions:
    """The revision of a core's graph: a number that every change of the graph replaces.

    Args:
        core: Tells the changes.
    """

    def __init__(self, core: Core) -> None:
        # Begins anywhere, so that a client takes the graph of an agent that was started anew for another one.
        self._number = secrets.randbits(31)
        self._changed = asyncio.Event()
        core.on_change(lambda _change: self._count())

    def _count(self) -> None:
        self._number += 1
        self._changed.set()
        self._changed = asyncio.Event()

    async def after(self, args: dict[str, object]) -> GraphRevision:
        """The revision, as soon as it differs from the one that the client knows.

        Args:
            args: ``after``: the known revision; ``wait``: the most seconds to wait for another one, 0 by default.

        Raises:
            ConfigError: An argument is out of range.
        """
        known, wait = args.get("after"), args.get("wait", 0)
        if not isinstance(wait, int | float) or not 0 <= wait <= limits.CONTROL_WAIT_MAX:
            raise ConfigError("wait", f"{wait!r} is not between 0 and {limits.CONTROL_WAIT_MAX:g} s")
        if known == self._number:
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(wait):
                    await self._changed.wait()
        return GraphRevision(revision=self._number)
