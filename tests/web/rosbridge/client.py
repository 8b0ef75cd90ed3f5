"""A rosbridge client, its session and a hub that writes down what it is asked; the graph is made up."""

from __future__ import annotations

from typing import Any

import msgspec

from rmpa.ros.types.messages import MessageType
from rmpa.web.hub.node_link import FULL
from rmpa.web.rosbridge.session import RosbridgeSession
from tests.web.recorder import Asked, FakeHub, Recorded, decoded


class Client(Recorded):
    """One client with its session."""

    def __init__(self) -> None:
        self.hub = FakeHub()
        self.graph = self.hub.graph
        hub: Any = self.hub
        super().__init__(RosbridgeSession(hub, FULL, "here"))

    def send(self, op: str, **values: Any) -> list[Asked]:
        return self.send_raw(msgspec.json.encode({"op": op, **values}).decode())

    def subscribe(self, topic: str = "/t", **values: Any) -> Asked:
        return self.one("subscribe", self.send("subscribe", topic=topic, **values))

    def publish(self, subscription: Asked, values: Any = None, kind: str = "std_msgs/String") -> None:
        """Let the hub have a message for a subscription."""
        message = MessageType(kind)
        subscription.message(message.serialize(message.make(values or {"data": "hello"})), kind)

    def received(self) -> list[dict[str, Any]]:
        """What the client got since the last call."""
        return [decoded(frame) for frame in self.frames()]

    def error(self) -> str:
        """The text of the one status message that the client got."""
        (got,) = self.received()
        assert (got["op"], got["level"]) == ("status", "error"), got
        text: str = got["msg"]
        return text
