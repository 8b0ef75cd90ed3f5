"""Service calls, rosapi in a graph of many topics, and how soon a new topic is seen."""

from __future__ import annotations

import sys
import time
from typing import TYPE_CHECKING, Any, Final

from lab.bed.processes import BedError, eventually
from lab.bed.ros import NODES
from lab.web.rosbridge_client import RosbridgeClient
from lab.web.subscriptions import FOXGLOVE, wait_channel
from lab.web.websocket import WebSocket

if TYPE_CHECKING:
    from collections.abc import Mapping

    from lab.bed.ros import Ros
    from lab.web.servers import WebServer

TOPIC: Final = "/crowd/topic7"
NODE: Final = "/crowd0"
TYPE: Final = "std_msgs/UInt8MultiArray"
"""Of the crowd's topics (``lab/nodes/crowd.py``)."""
ROSAPI: Final[Mapping[str, Mapping[str, Any]]] = {
    "topics": {},
    "topics_and_raw_types": {},
    "topics_for_type": {"type": TYPE},
    "topic_type": {"topic": TOPIC},
    "publishers": {"topic": TOPIC},
    "subscribers": {"topic": TOPIC},
    "nodes": {},
    "node_details": {"node": NODE},
    "services": {},
    "action_servers": {},
    "message_details": {"type": TYPE},
    "get_param_names": {},
}
"""The services of rosapi that clients ask for the graph, with their arguments."""
_BUDGET: Final = 20.0
"""Seconds after which one service is not called again: rosbridge_suite needs minutes for some."""
_WARM_UP: Final = 3
_CROWD_WITHIN: Final = 120.0
_SEEN_WITHIN: Final = 10.0
_POLL: Final = 0.01
"""Seconds between two questions: answers with thousands of topics must not be all that the server does."""
_PAUSES: Final = (0.31, 0.44, 0.53, 0.67)
"""Seconds between two new topics: at any moment between two looks of a server."""


class Crowd:
    """Publishers that never send, registered at one master.

    Args:
        ros: A shell with that master.
    """

    def __init__(self, ros: Ros) -> None:
        self._process = ros.start(sys.executable, NODES / "crowd.py", name="crowd", commands=True)
        self._process.wait_event("up")
        self._count = 0
        self._since = 0

    def grow(self, count: int) -> None:
        """Register publishers until there are so many."""
        since = self._process.mark_events()
        self._process.tell(str(count))
        self._process.wait_event("registered", _CROWD_WITHIN, since=since)
        self._count = count

    def ask_more(self) -> str:
        """Have one more registered, by another process; returns its topic at once."""
        self._since = self._process.mark_events()
        self._process.tell(str(self._count + 1))
        return f"/crowd/topic{self._count}"

    def registered_ns(self) -> int:
        """When the topic of ``ask_more`` was registered, by CLOCK_MONOTONIC."""
        event = self._process.wait_event("registered", since=self._since)
        self._count = int(str(event["count"]))
        return int(str(event["at_ns"]))


def call_times(server: WebServer, calls: int) -> list[float]:
    """Milliseconds of calls of one service through rosbridge, one after the other."""
    with RosbridgeClient(server.port, server.path) as client:
        for _ in range(_WARM_UP):
            client.call(server.service, {"data": True})
        return [client.call(server.service, {"data": True})[0] for _ in range(calls)]


def rosapi_times(server: WebServer, calls: int) -> dict[str, list[float]]:
    """Milliseconds of calls of each service of rosapi; fewer where it is slow, none where it gives no answer."""
    found: dict[str, list[float]] = {}
    for name, arguments in ROSAPI.items():
        times = found[name] = []
        deadline = time.monotonic() + _BUDGET
        try:
            with RosbridgeClient(server.port, server.path) as client:
                while len(times) < calls and time.monotonic() < deadline:
                    times.append(client.call(f"/rosapi/{name}", arguments)[0])
        except BedError:
            continue
    return found


def wait_topics(server: WebServer, count: int) -> None:
    """Return when rosapi lists so many topics.

    Raises:
        Deadline: It does not.
    """
    with RosbridgeClient(server.port, server.path) as client:
        eventually(
            lambda: len(client.call("/rosapi/topics")[1]["topics"]) >= count, what=f"{count} topics of {server.title}"
        )


def seen_by_rosapi(server: WebServer, crowd: Crowd, changes: int) -> list[float]:
    """Milliseconds from a topic's registration until rosapi lists it, asked again and again.

    Raises:
        BedError: It does not list it.
    """
    delays = []
    with RosbridgeClient(server.port, server.path) as client:
        for number in range(changes):
            time.sleep(_PAUSES[number % len(_PAUSES)])
            topic = crowd.ask_more()
            deadline = time.monotonic() + _SEEN_WITHIN
            while topic not in client.call("/rosapi/topics")[1]["topics"]:
                if time.monotonic() > deadline:
                    raise BedError(f"{server.title}: rosapi does not list {topic}")
                time.sleep(_POLL)
            seen = time.monotonic_ns()
            delays.append(max(0.0, (seen - crowd.registered_ns()) / 1e6))
    return delays


def seen_by_foxglove(server: WebServer, crowd: Crowd, changes: int) -> list[float]:
    """Milliseconds from a topic's registration until a connected client has its channel."""
    delays = []
    with WebSocket(server.port, server.path, FOXGLOVE) as client:
        wait_channel(client, server.topic)
        for number in range(changes):
            time.sleep(_PAUSES[number % len(_PAUSES)])
            wait_channel(client, crowd.ask_more())
            seen = time.monotonic_ns()
            delays.append(max(0.0, (seen - crowd.registered_ns()) / 1e6))
    return delays
