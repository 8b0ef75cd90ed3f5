"""The log of this module's nodes, ``/rosout_agg``: its last lines are kept for pages that open it."""

from __future__ import annotations

import asyncio
import time
from collections import deque
from typing import TYPE_CHECKING, Any, Final

from rmpa.core.errors import RmpaError
from rmpa.web.hub.clients import OWN_CLIENT
from rmpa.web.monitor import limits
from rmpa.web.monitor.messages import LOG_TOPIC

if TYPE_CHECKING:
    from collections.abc import Callable

    from rmpa.web.hub.hub import Hub
    from rmpa.web.hub.requests import ReceivedMessage
    from rmpa.web.monitor.io.values import MessageValues

_TYPE: Final = "rosgraph_msgs/Log"
_LEVELS: Final = {1: "DEBUG", 2: "INFO", 4: "WARN", 8: "ERROR", 16: "FATAL"}
_GATHER: Final = 0.1
"""Seconds in which lines are gathered into one message to a page."""
_HANDLE: Final = 100


class LogFeed:
    """Follows the log while it is open.

    Args:
        hub: Subscribes to it.
        values: Decodes its messages.
    """

    def __init__(self, hub: Hub, values: MessageValues) -> None:
        self._hub = hub
        self._values = values
        self._lines: deque[dict[str, Any]] = deque(maxlen=limits.LOG_LINES)
        self._fresh: list[dict[str, Any]] = []
        self._followers: dict[object, Callable[[list[dict[str, Any]]], None]] = {}
        self._timer: asyncio.TimerHandle | None = None
        self._count = 0
        self.refused: RmpaError | None = None
        """Why there is no log to show."""

    def start(self) -> None:
        """Begin to keep lines."""
        self._hub.topics.subscribe((OWN_CLIENT, _HANDLE), LOG_TOPIC, _TYPE, self._take, self._refused)

    def close(self) -> None:
        """Keep no more."""
        if self._timer is not None:
            self._timer.cancel()
        self._hub.topics.unsubscribe((OWN_CLIENT, _HANDLE), LOG_TOPIC)

    def follow(self, page: object, show: Callable[[list[dict[str, Any]]], None]) -> list[dict[str, Any]]:
        """Give a page each further line, by ``show``; returns those that are kept, oldest first."""
        known, self._followers[page] = page in self._followers, show
        return [] if known else list(self._lines)

    def unfollow(self, page: object) -> None:
        """End a ``follow``."""
        self._followers.pop(page, None)

    def _take(self, message: ReceivedMessage) -> None:
        try:
            values = self._values.of(message)
        except RmpaError:
            return  # not a message of the log; there is nothing to show
        stamp = values["header"]["stamp"]
        at = stamp["secs"] + stamp["nsecs"] * 1e-9
        self._count += 1
        line = {
            "n": self._count,
            "at": at or message.stamp_ns * 1e-9 or time.time(),
            "level": _LEVELS.get(values["level"], "INFO"),
            "node": values["name"][: limits.LOG_CHARACTERS],
            "text": values["msg"][: limits.LOG_CHARACTERS],
        }
        self._lines.append(line)
        if not self._followers:
            return
        self._fresh.append(line)
        if self._timer is None:
            self._timer = asyncio.get_running_loop().call_later(_GATHER, self._show)

    def _show(self) -> None:
        self._timer = None
        lines, self._fresh = self._fresh[-limits.LOG_LINES :], []
        for show in [*self._followers.values()]:
            show(lines)

    def _refused(self, error: RmpaError) -> None:
        self.refused = error
