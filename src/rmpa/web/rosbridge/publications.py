"""What a client publishes: one publisher of the hub for each topic, however often the client advertises it."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from rmpa.web.hub.requests import AdvertiseTopic, PublishMessage, UnadvertiseTopic
from rmpa.web.rosbridge import limits
from rmpa.web.rosbridge.context import check_count
from rmpa.web.rosbridge.protocol import Id, OpError, graph_name, type_name
from rmpa.web.values.codec import MessageCodec, codec_for

if TYPE_CHECKING:
    from rmpa.web.hub.requests import Failed
    from rmpa.web.rosbridge import protocol
    from rmpa.web.rosbridge.context import SessionContext


@dataclass(slots=True)
class _Publisher:
    handle: int
    topic: str
    type: str
    latch: bool
    codec: MessageCodec
    ids: set[Id] = field(default_factory=set)


class Publications:
    """All publishers of a client.

    Args:
        context: The session.
    """

    def __init__(self, context: SessionContext) -> None:
        self._context = context
        self._publishers: dict[str, _Publisher] = {}

    def advertise(self, op: protocol.RosbridgeAdvertise) -> None:
        """Begin a publisher, or count one more id of it.

        Raises:
            OpError: The topic has another type.
            DefinitionError: The type is not known.
        """
        name, kind = graph_name(op.topic), type_name(op.type)
        publisher = self._publishers.get(name)
        if publisher is not None and publisher.type != kind:
            raise OpError(f"{name} is advertised as {publisher.type}, not {kind}", "unadvertise it first")
        if publisher is not None and publisher.latch != bool(op.latch):
            ids = publisher.ids
            self._end(publisher)
            publisher = self._begin(name, kind, latch=bool(op.latch))
            publisher.ids |= ids
        if publisher is None:
            publisher = self._begin(name, kind, latch=bool(op.latch))
        if op.id not in publisher.ids:
            check_count(len(publisher.ids), limits.SUBSCRIBERS_MAX, f"advertisements of {name}")
        publisher.ids.add(op.id)
        self._context.status("info", f"advertised {name}", op.id)

    def unadvertise(self, op: protocol.RosbridgeUnadvertise) -> None:
        """Forget the id's advertisement, or all; the publisher ends with the last."""
        name = graph_name(op.topic)
        publisher = self._publishers.get(name)
        if publisher is None:
            self._context.status("warning", f"{name} is not advertised", op.id)
            return
        if op.id is None:
            publisher.ids.clear()
        else:
            publisher.ids.discard(op.id)
        if not publisher.ids:
            self._end(publisher)
        self._context.status("info", f"unadvertised {name}", op.id)

    def publish(self, op: protocol.RosbridgePublish) -> None:
        """Publish a message; a topic that was not advertised is, with the type that the graph knows.

        Raises:
            OpError: The topic was not advertised, and no type is known for it.
            MessageError: The message does not fit the type.
        """
        name = graph_name(op.topic)
        publisher = self._publishers.get(name) or self._begin(name, self._type_of(name), latch=bool(op.latch))
        written = publisher.codec.write({} if op.msg is None else op.msg, self._context.ros_time_ns())
        if written.missing:
            fields = ", ".join(written.missing)
            self._context.status("warning", f"publish {name}: these fields were not given: {fields}", op.id)
        self._context.ask(PublishMessage(publisher.handle, written.payload))

    def fail(self, failed: Failed) -> bool:
        """The hub cannot serve a publisher; False if it is none of these."""
        for publisher in self._publishers.values():
            if publisher.handle == failed.handle:
                del self._publishers[publisher.topic]
                problem = str(OpError(f"advertise {publisher.topic}: {failed.error}", failed.remedy))
                for mid in publisher.ids or {None}:
                    self._context.status("error", problem, mid)
                return True
        return False

    def close(self) -> None:
        """End all."""
        for publisher in list(self._publishers.values()):
            self._end(publisher)

    def _type_of(self, name: str) -> str:
        topic = self._context.graph.topics.get(name)
        if topic is None or not topic.types:
            raise OpError(f"publish {name}: the topic is not there, and its type is not known", "advertise it first")
        return topic.types[0]

    def _begin(self, name: str, kind: str, *, latch: bool) -> _Publisher:
        check_count(len(self._publishers), limits.ADVERTISED_MAX, "advertised topics")
        topic = self._context.graph.topics.get(name)
        if topic is not None and topic.types and kind not in topic.types:
            raise OpError(f"{name} has the type {', '.join(topic.types)}, not {kind}", "advertise it with that type")
        codec = codec_for(self._context.types.message(kind))
        publisher = _Publisher(self._context.new_handle(), name, kind, latch, codec)
        self._publishers[name] = publisher
        self._context.ask(AdvertiseTopic(publisher.handle, name, kind, latch))
        return publisher

    def _end(self, publisher: _Publisher) -> None:
        del self._publishers[publisher.topic]
        self._context.ask(UnadvertiseTopic(publisher.handle))
