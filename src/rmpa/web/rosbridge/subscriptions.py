"""Subscriptions of a rosbridge client: throttled, in fragments.

What the parts of a session share: handles, what is to be sent, and status messages.
"""

from __future__ import annotations

import itertools
from collections import OrderedDict, deque
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Final

import msgspec

from rmpa.core.errors import LimitExceeded, RmpaError
from rmpa.ros.types.codec import MessageCodec, codec_for
from rmpa.web import limits
from rmpa.web.hub.requests import Failed, ReceivedMessage, Subscribe, Unsubscribe
from rmpa.web.rosbridge.protocol import (
    Compression,
    Id,
    OpError,
    PublishFrames,
    RosbridgeFrame,
    encode_cbor,
    encode_cbor_raw,
    encode_png,
    graph_name,
    status,
    type_name,
    whole,
    write_op,
)

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping
    from typing import Any

    from rmpa.web.hub.graph import TypeLibrary
    from rmpa.web.hub.requests import HubRequest, OtherType
    from rmpa.web.rosbridge import protocol
    from rmpa.web.rosbridge.rosapi import HubGraph


# Fragments: an op in JSON, cut into pieces of so many characters, each within an op ``fragment``.


def split(frame: RosbridgeFrame, size: int, mid: Id) -> list[RosbridgeFrame]:
    """Cut a frame of JSON into fragments of up to `size` characters; a frame that fits, and CBOR, stay whole.

    Args:
        frame: The op.
        size: Characters, 1 or more.
        mid: The id of all fragments.

    Raises:
        OpError: The fragments are too many.
    """
    if frame.binary or frame.size <= size:
        return [frame]
    text = bytes(frame.data).decode()
    total = -(-len(text) // size)
    if total > limits.FRAGMENTS_MAX:
        problem = f"a message of {len(text)} characters would be {total} fragments of {size}"
        raise OpError(problem, f"ask for a fragment_size of {-(-len(text) // limits.FRAGMENTS_MAX)} or more")
    if total == 1:
        return [frame]
    return [
        RosbridgeFrame(
            write_op(
                {
                    "op": "fragment",
                    "id": mid,
                    "data": text[num * size : (num + 1) * size],
                    "num": num,
                    "total": total,
                }
            ).parts,
            handle=frame.handle,
        )
        for num in range(total)
    ]


@dataclass(slots=True)
class _Incomplete:
    total: int
    deadline: float
    size: int = 0
    pieces: dict[int, str] = field(default_factory=dict)


class Assembler:
    """Puts a client's fragments together. They may come in any order; a repeated one is ignored."""

    def __init__(self) -> None:
        self._messages: OrderedDict[tuple[str, str | int], _Incomplete] = OrderedDict()
        self._bytes = 0

    def add(self, kind: str, mid: str | int, num: int, total: int, data: str, now: float) -> str | None:
        """Take one fragment.

        Args:
            kind: Its op, fragment or png.
            mid: Its id.
            num: Its place, from 0.
            total: How many there are.
            data: Its text.
            now: The present time.

        Returns:
            The whole text with the last missing fragment; else None.

        Raises:
            OpError: The numbers are impossible.
            LimitExceeded: The message has too many fragments, or is too long.
        """
        if total > limits.FRAGMENTS_MAX:
            raise LimitExceeded("total of fragments", total, limits.FRAGMENTS_MAX)
        if total < 1 or not 0 <= num < total:
            raise OpError(f"fragment {num} of {total} cannot be: they count from 0")
        key = (kind, mid)
        message = self._messages.get(key)
        if message is None:
            message = self._messages[key] = _Incomplete(total, now)
        elif message.total != total:
            self._drop(key)
            raise OpError(f"the fragments of {str(mid)[:80]!r} disagree: {message.total} or {total} in all")
        message.deadline = now + limits.FRAGMENT_TIMEOUT
        self._messages.move_to_end(key)
        if num not in message.pieces:
            self._store(key, message, num, data)
        if len(message.pieces) < total:
            return None
        self._drop(key)
        return "".join(message.pieces[index] for index in range(total))

    def _store(self, key: tuple[str, str | int], message: _Incomplete, num: int, data: str) -> None:
        # Python keeps up to four bytes a character, and some 200 bytes for each piece.
        size = len(data) * (1 if data.isascii() else 4) + 200
        if message.size + size > limits.FRAGMENTED_MAX:
            self._drop(key)
            raise LimitExceeded("message in fragments", message.size + size, limits.FRAGMENTED_MAX)
        message.pieces[num] = data
        message.size += size
        self._bytes += size
        while self._bytes > limits.FRAGMENTED_MAX or len(self._messages) > limits.FRAGMENTED_MESSAGES_MAX:
            self._drop(next(iter(self._messages)))

    def next_timer(self) -> float | None:
        """When `expire` is to be called; None for never."""
        return min((each.deadline for each in self._messages.values()), default=None)

    def expire(self, now: float) -> Iterator[str | int]:
        """Drop the messages whose next fragment is overdue; yields their ids."""
        for key, message in list(self._messages.items()):
            if message.deadline <= now:
                self._drop(key)
                yield key[1]

    def _drop(self, key: tuple[str, str | int]) -> None:
        self._bytes -= self._messages.pop(key).size


# Holds back the messages of one topic for one client: ``throttle_rate`` and ``queue_length``.
#
# Without a queue, messages within the interval are dropped. With one they wait, the oldest is dropped when it is
# full,
# and one is sent in each interval.


class QueuedBytes:
    """Bytes queued for all topics of a client together."""

    def __init__(self) -> None:
        self.used = 0


class Throttle:
    """The machine of one topic.

    Args:
        total: Bytes queued for all topics of the client.
    """

    def __init__(self, total: QueuedBytes) -> None:
        self.interval = 0.0
        self.length = 0
        self._total = total
        self._queue: deque[ReceivedMessage] = deque()
        self._bytes = 0
        self._free_at = float("-inf")

    def configure(self, interval: float, length: int) -> None:
        """Set the interval in seconds and the queue's length in messages; what is queued stays, as far as it fits."""
        self._free_at += interval - self.interval
        self.interval = interval
        self.length = min(length, limits.QUEUE_MESSAGES_MAX)
        while len(self._queue) > self.length:
            self._drop_oldest()

    def offer(self, message: ReceivedMessage, now: float) -> list[ReceivedMessage]:
        """Take a message; returns those to be sent now."""
        if not self._queue and now >= self._free_at:
            self._free_at = now + self.interval
            return [message]
        if not self.length:
            return []
        size = len(message.payload)
        while self._queue and (len(self._queue) >= self.length or self._bytes + size > limits.QUEUE_BYTES_MAX):
            self._drop_oldest()
        if not self._total.used or self._total.used + size <= limits.QUEUES_BYTES_MAX:
            self._queue.append(message)
            self._count(size)
        return self.due(now)

    def due(self, now: float) -> list[ReceivedMessage]:
        """The messages whose time has come: all where there is no interval any more."""
        sent: list[ReceivedMessage] = []
        while self._queue and now >= self._free_at:
            message = self._queue.popleft()
            self._count(-len(message.payload))
            sent.append(message)
            self._free_at = now + self.interval
        return sent

    def next_timer(self) -> float | None:
        """When `due` has something; None for never."""
        return self._free_at if self._queue else None

    def clear(self) -> None:
        """Drop all that is queued; the client no longer wants it."""
        self._count(-self._bytes)
        self._queue.clear()

    def _drop_oldest(self) -> None:
        self._count(-len(self._queue.popleft().payload))

    def _count(self, size: int) -> None:
        self._bytes += size
        self._total.used += size


LEVELS: Final = ("none", "error", "warning", "info")
"""Each includes those before it."""


class SessionContext:
    """The session's side towards the client and the hub.

    Args:
        types: Finds definitions.
        graph: The snapshot of the graph.
        ros_time_ns: The present ROS time in nanoseconds.
    """

    def __init__(self, types: TypeLibrary, graph: HubGraph, ros_time_ns: Callable[[], int]) -> None:
        self.types = types
        self.graph = graph
        self.ros_time_ns = ros_time_ns
        self.level = "error"
        self.frames: list[RosbridgeFrame] = []
        self.requests: list[HubRequest] = []
        self._handles = itertools.count(1)
        self._fragment_ids = itertools.count()

    def new_handle(self) -> int:
        """A handle that was never used in this session."""
        return next(self._handles)

    def ask(self, request: HubRequest) -> None:
        """Send a request to the hub."""
        self.requests.append(request)

    def status(self, level: str, text: str, mid: Id = None) -> None:
        """Send a status message, if the client wants those of this level."""
        if LEVELS.index(level) <= LEVELS.index(self.level):
            self.frames.append(status(level, text, mid))

    def send(self, frame: RosbridgeFrame, fragment_size: int | None = None, mid: Id = None) -> None:
        """Send a frame, in fragments where it is text and longer than `fragment_size` characters."""
        if fragment_size is None:
            self.frames.append(frame)
            return
        try:
            self.frames += split(frame, fragment_size, mid if mid is not None else next(self._fragment_ids))
        except OpError as error:
            self.status("error", str(error), mid)

    def send_op(self, values: Mapping[str, Any], style: Style, mid: Id = None) -> None:
        """Send an op that answers one of the client's, in the style that it asked for."""
        if style.compression >= Compression.CBOR:
            self.send(encode_cbor(values))
            return
        text = msgspec.json.encode(values)
        frame = encode_png(text) if style.compression is Compression.PNG else RosbridgeFrame((text,))
        self.send(frame, style.fragment_size, mid)


class Style(msgspec.Struct, frozen=True):
    """How a client wants an answer."""

    compression: Compression = Compression.NONE
    fragment_size: int | None = None

    @classmethod
    def parse(cls, compression: str | None, fragment_size: float | None) -> Style:
        """Read it from an op.

        Raises:
            OpError: The compression is unknown, or the size not 1 or more.
        """
        return cls(Compression.parse(compression), fragment_of(fragment_size))


def fragment_of(size: float | None) -> int | None:
    """A fragment size in characters; None for whole messages.

    Raises:
        OpError: It is not 1 or more.
    """
    return None if size is None else whole(size, "fragment_size", 1)


def check_count(count: int, limit: int, what: str) -> None:
    """Refuse one more where `count` are there.

    Raises:
        OpError: The limit is reached.
    """
    if count >= limit:
        raise OpError(f"this client has {count} {what} already", f"{limit} are allowed; end some first")


# A client's subscriptions: several ids of one topic are one subscription of the hub.
#
# Its messages have the lowest throttle_rate and fragment_size, the highest queue_length, and the highest
# compression of
# none, png, cbor and cbor-raw.


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
