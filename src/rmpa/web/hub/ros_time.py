"""The ROS time: the wall clock, or ``/clock`` where ``use_sim_time`` is set."""

from __future__ import annotations

import struct
import time
from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from collections.abc import Callable

    from rmpa.web.hub.clients import Key
    from rmpa.web.hub.params import ParamMirror
    from rmpa.web.hub.requests import ReceivedMessage
    from rmpa.web.hub.topics import HubTopics

CLOCK: Final = "/clock"
CLOCK_TYPE: Final = "rosgraph_msgs/Clock"
_PARAM: Final = "/use_sim_time"
_TIME: Final = struct.Struct("<II")


class RosTime:
    """The present time.

    Args:
        topics: The hub's subscriptions.
        params: The parameters.
        key: For the subscription and the parameter.
        now_ns: The wall clock, in nanoseconds.
    """

    def __init__(
        self, topics: HubTopics, params: ParamMirror, key: Key, now_ns: Callable[[], int] = time.time_ns
    ) -> None:
        self._topics = topics
        self._params = params
        self._key = key
        self._now_ns = now_ns
        self._sim_ns = 0
        self.simulated = False
        """Whether ``/clock`` gives the time."""
        params.follow(key, (_PARAM,), lambda values: self._use(bool(values.get(_PARAM))))

    def now_ns(self) -> int:
        """Nanoseconds; 0 until the first message of ``/clock`` where that gives the time, as in rospy."""
        return self._sim_ns if self.simulated else self._now_ns()

    def _use(self, simulated: bool) -> None:
        if simulated == self.simulated:
            return
        self.simulated = simulated
        if simulated:
            self._sim_ns = 0
            self._topics.subscribe(self._key, CLOCK, CLOCK_TYPE, self._take, lambda _: None)
        else:
            self._topics.unsubscribe(self._key, CLOCK)

    def _take(self, message: ReceivedMessage) -> None:
        if len(message.payload) == _TIME.size:
            seconds, nanoseconds = _TIME.unpack(message.payload)
            self._sim_ns = seconds * 1_000_000_000 + nanoseconds
