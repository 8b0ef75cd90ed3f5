"""A client's subscriptions: several ids of one topic are one subscription of the hub.

Its messages have the lowest throttle_rate and fragment_size, the highest queue_length, and the highest compression of
none, png, cbor and cbor-raw.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from rmpa.core.errors import RmpaError
from rmpa.web.hub.requests import Failed, ReceivedMessage, Subscribe, Unsubscribe
from rmpa.web.rosbridge import limits
from rmpa.web.rosbridge.context import check_count, fragment_of
from rmpa.web.rosbridge.encodings import Compression, PublishFrames, encode_cbor_raw
from rmpa.web.rosbridge.protocol import Id, OpError, RosbridgeFrame, graph_name, type_name, whole
from rmpa.web.rosbridge.throttle import QueuedBytes, Throttle
from rmpa.web.values.codec import MessageCodec, codec_for

if TYPE_CHECKING:
    from collections.abc import Iterator

    from rmpa.web.hub.requests import OtherType
    from rmpa.web.rosbridge import protocol
    from rmpa.web.rosbridge.context import SessionContext


@dataclass(frozen=True, slots=True)
class _Wish:
    """What one id asked for."""

    interval: float
    length: int
    fragment_size: int | None
    compression: Compression


@dataclass(slots=True)
class _Topic:
    """A subscribed topic; `name` is as the client writes it."""

    handle: int
    name: str
    type: str | None
    throttle: Throttle
    wishes: dict[Id, _Wish] = field(default_factory=dict)
    compression: Compression = Compression.NONE
    fragment_size: int | None = None
    codecs: dict[tuple[str, str], MessageCodec] = field(default_factory=dict)
    problem: str = ""
    judged_at: float | None = None
    """When it fails, if the topic is not there by then."""

    def choose(self) -> None:
        """Choose from all wishes."""
        wishes = self.wishes.values()
        self.throttle.configure(min(each.interval for each in wishes), max(each.length for each in wishes))
        self.compression = max(each.compression for each in wishes)
        self.fragment_size = min((each.fragment_size for each in wishes if each.fragment_size), default=None)


class Subscriptions:
    """All subscriptions of a client.

    Args:
        context: The session.
        frames: Encodes messages, shared with other sessions.
    """

    def __init__(self, context: SessionContext, frames: PublishFrames) -> None:
        self._context = context
        self._frames = frames
        self._topics: dict[str, _Topic] = {}
        self._by_handle: dict[int, _Topic] = {}
        self._queued = QueuedBytes()

    def subscribe(self, op: protocol.RosbridgeSubscribe, now: float) -> None:
        """Begin a subscription, or change that of the same id.

        Without a type it fails where the topic does not appear within `limits.TYPE_WAIT`.

        Raises:
            OpError: A value is wrong, or the type is another than that of the client's other subscriptions.
        """
        name = graph_name(op.topic)
        compression = Compression.parse(op.compression)
        kind = type_name(op.type) if op.type else None
        wish = _Wish(
            whole(op.throttle_rate, "throttle_rate") / 1000,
            whole(op.queue_length, "queue_length"),
            fragment_of(op.fragment_size),
            compression,
        )
        if compression is Compression.CBOR_RAW:
            kind = None  # bytes of any type
        topic = self._topics.get(op.topic)
        if topic is None:
            topic = self._begin(op.topic, name, kind)
            if op.type is None and compression is not Compression.CBOR_RAW and not self._is_there(name):
                topic.judged_at = now + limits.TYPE_WAIT
        elif kind is not None and topic.type is not None and kind != topic.type:
            raise OpError(f"{op.topic} is subscribed as {topic.type}, not {kind}", "unsubscribe it first")
        if op.id not in topic.wishes:
            check_count(len(topic.wishes), limits.SUBSCRIBERS_MAX, f"subscriptions of {op.topic}")
        topic.wishes[op.id] = wish
        topic.choose()
        self._context.status("info", f"subscribed to {op.topic}", op.id)

    def _is_there(self, name: str) -> bool:
        known = self._context.graph.topics.get(name)
        return bool(known is not None and known.types) or name in self._context.graph.published

    def _begin(self, spelling: str, name: str, kind: str | None) -> _Topic:
        check_count(len(self._topics), limits.SUBSCRIPTIONS_MAX, "subscribed topics")
        known = self._context.graph.topics.get(name)
        if kind is not None and known is not None and known.types and kind not in known.types:
            raise OpError(f"{spelling} has the type {', '.join(known.types)}, not {kind}", "subscribe with that type")
        topic = _Topic(self._context.new_handle(), spelling, kind, Throttle(self._queued))
        self._topics[spelling] = self._by_handle[topic.handle] = topic
        self._context.ask(Subscribe(topic.handle, name, kind))
        return topic

    def unsubscribe(self, op: protocol.RosbridgeUnsubscribe) -> None:
        """End the subscription with the op's id, or all of the topic."""
        topic = self._topics.get(op.topic)
        if topic is None or (op.id is not None and op.id not in topic.wishes):
            self._context.status("warning", f"{op.topic[: limits.NAME_MAX]} is not subscribed", op.id)
            return
        if op.id is None:
            topic.wishes.clear()
        else:
            del topic.wishes[op.id]
        if topic.wishes:
            topic.choose()
        else:
            self._end(topic)
            self._context.ask(Unsubscribe(topic.handle))
        self._context.status("info", f"unsubscribed from {op.topic}", op.id)

    def receive(self, message: ReceivedMessage, now: float) -> None:
        """Take a message of the hub."""
        topic = self._by_handle.get(message.handle)
        if topic is not None:
            self._send(topic, topic.throttle.offer(message, now))

    def differs(self, other: OtherType) -> None:
        """A publisher has another type: its messages do not come, and the subscription waits for others."""
        topic = self._by_handle.get(other.handle)
        if topic is not None:
            error = OpError(f"{topic.name} has the type {other.type}, not {topic.type}", "subscribe with that type")
            for mid in topic.wishes:
                self._context.status("error", f"subscribe: {error}", mid)

    def fail(self, failed: Failed) -> bool:
        """The hub cannot serve a subscription; False if it is none of these."""
        topic = self._by_handle.get(failed.handle)
        if topic is None:
            return False
        self._end(topic)
        problem = str(OpError(f"subscribe {topic.name}: {failed.error}", failed.remedy))
        for mid in topic.wishes:
            self._context.status("error", problem, mid)
        return True

    def next_timer(self) -> float | None:
        """When `handle_timer` is to be called; None for never."""
        return min(self._timers(), default=None)

    def _timers(self) -> Iterator[float]:
        for topic in self._topics.values():
            for at in (topic.throttle.next_timer(), topic.judged_at):
                if at is not None:
                    yield at

    def handle_timer(self, now: float) -> None:
        """Send what was held back until now, and end what waits in vain."""
        for topic in [*self._topics.values()]:
            self._send(topic, topic.throttle.due(now))
            if topic.judged_at is not None and topic.judged_at <= now:
                topic.judged_at = None
                if not self._is_there(graph_name(topic.name)):
                    self._context.ask(Unsubscribe(topic.handle))
                    text = "the topic is not there, and its type is not known"
                    self.fail(Failed(topic.handle, text, "give its 'type'"))

    def close(self) -> None:
        """End all."""
        for topic in list(self._topics.values()):
            self._end(topic)
            self._context.ask(Unsubscribe(topic.handle))

    def _end(self, topic: _Topic) -> None:
        topic.throttle.clear()
        del self._topics[topic.name], self._by_handle[topic.handle]

    def _send(self, topic: _Topic, messages: list[ReceivedMessage]) -> None:
        for message in messages:
            try:
                frame = self._encode(topic, message)
            except RmpaError as error:
                # Once: a publisher of broken messages may send a thousand a second.
                if topic.problem != str(error):
                    topic.problem = str(error)
                    self._context.status("error", f"message of {topic.name}: {error}")
                continue
            self._context.send(RosbridgeFrame(frame.parts, frame.binary, topic.handle), topic.fragment_size)

    def _encode(self, topic: _Topic, message: ReceivedMessage) -> RosbridgeFrame:
        if topic.compression is Compression.CBOR_RAW:
            return encode_cbor_raw(topic.name, message.payload, message.stamp_ns)
        version = message.type, message.md5sum
        codec = topic.codecs.get(version)
        if codec is None:
            codec = topic.codecs[version] = codec_for(self._context.types.version(*version))
        return self._frames.encode(topic.name, message.payload, topic.compression, codec)
