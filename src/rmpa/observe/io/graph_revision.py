"""Lets clients of the control socket wait for the next change of the local graph, and tells them what has changed."""

from __future__ import annotations

import asyncio
import contextlib
import secrets
from typing import TYPE_CHECKING

from rmpa.core.errors import ConfigError
from rmpa.observe import limits
from rmpa.observe.graph_changes import GraphHistory, GraphRevision

if TYPE_CHECKING:
    from rmpa.ros.core.api import Core
    from rmpa.ros.master.parameters import GraphChange

_REVISION_BITS = 52
"""Each revision is an integer that all programs read exactly from JSON, and no two agents begin near each other."""


class GraphRevisions:
    """The revision of a core's graph: a number that every change of the graph replaces.

    Args:
        core: Tells the changes.
        rows: Whether clients get the changes themselves. Those of a core that is another program are known here later
            than there.
    """

    def __init__(self, core: Core, *, rows: bool) -> None:
        self._core = core
        self._rows = rows
        # Begins anywhere, so that a client takes the graph of an agent that was started anew for another one.
        self._history = GraphHistory(secrets.randbits(_REVISION_BITS))
        self._changed = asyncio.Event()
        self._waiting = 0
        core.on_change(self._add)

    def _add(self, change: GraphChange) -> None:
        self._history.add(change)
        if self._waiting:
            self._changed.set()
            self._changed = asyncio.Event()

    async def after(self, args: dict[str, object]) -> GraphRevision:
        """The revision, as soon as it differs from the one that the client knows.

        Args:
            args: ``after``: the known revision; ``wait``: the most seconds to wait for another one, 0 by default;
                ``rows``: true for what has changed since ``after``.

        Raises:
            ConfigError: An argument is out of range.
        """
        known, wait = args.get("after"), args.get("wait", 0)
        if not isinstance(wait, int | float) or not 0 <= wait <= limits.CONTROL_WAIT_MAX:
            raise ConfigError("wait", f"{wait!r} is not between 0 and {limits.CONTROL_WAIT_MAX:g} s")
        if known == self._history.revision:
            self._waiting += 1
            try:
                with contextlib.suppress(TimeoutError):
                    async with asyncio.timeout(wait):
                        await self._changed.wait()
            finally:
                self._waiting -= 1
        if not self._rows or args.get("rows") is not True:
            return GraphRevision(revision=self._history.revision)
        rows = self._history.rows_since(known, self._core.state())
        return GraphRevision(revision=self._history.revision, core_uri=self._core.uri, rows=rows)
