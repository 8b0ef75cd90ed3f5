"""A client, its session and a hub that writes down what it is asked; the graph is made up."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, TypeVar

import cbor2
import msgspec

from rmpa.ros.types.installed import ServiceType
from rmpa.ros.types.messages import MessageType
from rmpa.web.hub.requests import Answer, GraphService, GraphTopic, HubRequest, ParamValue, ReceivedMessage
from rmpa.web.rosbridge.calls import RosbridgeSession
from rmpa.web.rosbridge.protocol import PublishFrames

if TYPE_CHECKING:
    from rmpa.web.rosbridge.protocol import RosbridgeFrame

NOW_NS = 1_700_000_000_000_000_123
_R = TypeVar("_R", bound=HubRequest)


@dataclass
class Graph:
    topics: dict[str, GraphTopic] = field(default_factory=dict)
    published: dict[str, str] = field(default_factory=dict)
    services: dict[str, GraphService] = field(default_factory=dict)
    nodes: tuple[str, ...] = ()
    params: dict[str, ParamValue] = field(default_factory=dict)

    def add_topic(self, name: str, *types: str, publishers: tuple[str, ...] = (), subscribers: Any = ()) -> None:
        self.topics[name] = GraphTopic(name, types, publishers, tuple(subscribers))

    def add_service(self, name: str, kind: str, provider: str = "/server", uri: str = "rosrpc://robot:1234") -> None:
        self.services[name] = GraphService(name, kind, (provider,), uri)


class Types:
    """The definitions that rmpa brings."""

    def version(self, name: str, md5sum: str) -> MessageType:
        return self.message(name)

    def message(self, name: str) -> MessageType:
        return MessageType(name)

    def service(self, name: str) -> ServiceType:
        return ServiceType(name)


class Client:
    """One client with its session; `now` is the clock of all calls."""

    def __init__(self, frames: PublishFrames | None = None) -> None:
        self.now = 0.0
        self.graph = Graph()
        types: Any = Types()
        graph: Any = self.graph
        self.session = RosbridgeSession(types, graph, lambda: NOW_NS, frames=frames or PublishFrames())

    def send(self, op: str, **values: Any) -> list[HubRequest]:
        return self.send_raw(msgspec.json.encode({"op": op, **values}).decode())

    def send_raw(self, data: str | bytes) -> list[HubRequest]:
        self.session.receive_frame(data, self.now)
        return self.session.requests_to_send()

    def one(self, kind: type[_R], requests: list[HubRequest]) -> _R:
        (request,) = requests
        assert isinstance(request, kind)
        return request

    def answer(self, answer: Answer) -> list[HubRequest]:
        self.session.receive_answer(answer, self.now)
        return self.session.requests_to_send()

    def publish(self, handle: int, kind: str, values: Any, topic: str = "/t") -> memoryview:
        """Let the hub have a message for a subscription; returns its payload."""
        message = MessageType(kind)
        payload = memoryview(message.serialize(message.make(values)))
        self.answer(ReceivedMessage(handle, topic, kind, payload, NOW_NS))
        return payload

    def advance(self, seconds: float) -> None:
        """Let time pass; timers are handled at their time."""
        end = self.now + seconds
        while (at := self.session.next_timer()) is not None and at <= end:
            self.now = max(self.now, at)
            self.session.handle_timer(self.now)
        self.now = end

    def frames(self) -> list[RosbridgeFrame]:
        return self.session.frames_to_send()

    def received(self) -> list[dict[str, Any]]:
        """What the client got since the last call."""
        return [decoded(frame) for frame in self.frames()]

    def error(self) -> str:
        """The text of the one status message that the client got."""
        (got,) = self.received()
        assert (got["op"], got["level"]) == ("status", "error"), got
        text: str = got["msg"]
        return text


def decoded(frame: RosbridgeFrame) -> dict[str, Any]:
    values: dict[str, Any] = cbor2.loads(bytes(frame.data)) if frame.binary else msgspec.json.decode(frame.data)
    return values
