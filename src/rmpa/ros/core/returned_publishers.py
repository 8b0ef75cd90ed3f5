"""Repeats the list of a topic's publishers after one of them was withdrawn and soon registered again.

A rospy subscriber that gets the new list before it has read the end of its connection to that publisher takes itself
for connected, and would never connect again. Lists that bring nothing new change nothing at a node.
"""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING

from rmpa.ros import limits
from rmpa.ros.master.effects import RegistrationKind

if TYPE_CHECKING:
    from collections.abc import Callable

    from rmpa.ros.master.effects import GraphChange


class ReturnedPublishers:
    """The publishers that were withdrawn lately, and the topics whose list will be repeated.

    Args:
        repeat: Called in the loop with the topics whose list of publishers is to be sent to their subscribers again.
    """

    def __init__(self, repeat: Callable[[list[str]], None]) -> None:
        self._repeat = repeat
        self._withdrawn: dict[tuple[str, str], float] = {}
        self._returned: dict[str, None] = {}
        self._timer: asyncio.TimerHandle | None = None

    def graph_changed(self, change: GraphChange) -> None:
        """Take in one change of the graph."""
        if change.kind is not RegistrationKind.PUBLISHER:
            return
        loop = asyncio.get_running_loop()
        now = loop.time()
        key = change.name, change.api
        at = self._withdrawn.pop(key, None)
        if not change.added:
            self._withdrawn[key] = now
            if len(self._withdrawn) > limits.WITHDRAWN_KEPT:
                del self._withdrawn[next(iter(self._withdrawn))]
        elif at is not None and now - at <= limits.WITHDRAWN_LATELY:
            self._returned[change.name] = None
            if self._timer is None:
                self._timer = loop.call_later(limits.PUBLISHERS_AGAIN, self._due)

    def close(self) -> None:
        """Repeat nothing any more."""
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None

    def _due(self) -> None:
        topics, self._returned = list(self._returned), {}
        self._timer = None
        self._repeat(topics)
