"""The hub's subscriptions: one ROS subscription a topic for all clients, and the latched messages for newcomers."""

from __future__ import annotations

import asyncio
import functools
import logging
import time
from collections import OrderedDict, deque
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Final

from rmpa.config.peer_rules import Access
from rmpa.core.errors import PeerRefused
from rmpa.ros.wire.tcpros import ANY
from rmpa.web import limits
from rmpa.web.hub.node_link import EndingRegistrations, Registration
from rmpa.web.hub.requests import OtherType, ReceivedMessage

if TYPE_CHECKING:
    from collections.abc import Callable, KeysView, Mapping

    from rmpa.core.errors import RmpaError
    from rmpa.ros.node.node import Node, Subscriber
    from rmpa.ros.types.messages import MessageType
    from rmpa.web.hub.node_link import Key, NodeLink
    from rmpa.web.hub.requests import GraphTopic


# Buffers for the payloads of received messages, used again and again. No I/O.


class PayloadBuffers:
    """Copies large payloads into buffers that are used again when no view of them is left.

    To fill a fresh buffer of a megabyte takes several times as long as to fill one that was used before: the kernel
    maps and clears each of its pages first.

    Args:
        kept_bytes: Bytes of the buffers that are kept, used and unused.
    """

    def __init__(self, kept_bytes: int = limits.PAYLOAD_BUFFERS_BYTES) -> None:
        self._limit = kept_bytes
        self._kept: deque[bytearray] = deque()
        """Those used last are at the right."""
        self._bytes = 0

    @property
    def bytes(self) -> int:
        """Bytes of the buffers that are kept."""
        return self._bytes

    def copy(self, data: memoryview) -> memoryview:
        """A read-only copy, which stays as it is while there is a view of it."""
        size = len(data)
        if size < limits.PAYLOAD_BUFFER_MIN:
            return memoryview(bytes(data))
        buffer = self._unused(size)
        if buffer is None:
            buffer = bytearray(size)
            self._bytes += size
        self._kept.append(buffer)
        while self._bytes > self._limit or len(self._kept) > limits.PAYLOAD_BUFFERS_MAX:
            self._bytes -= len(self._kept.popleft())
        view = memoryview(buffer)[:size]
        view[:] = data
        return view.toreadonly()

    def clear(self) -> None:
        """Keep no buffer; those in use end with their last view."""
        self._kept.clear()
        self._bytes = 0

    def _unused(self, size: int) -> bytearray | None:
        """Take out the buffer that was used last, of those that are large enough and not far too large.

        It is the one that the processor's caches are most likely to hold.
        """
        for index in reversed(range(len(self._kept))):
            buffer = self._kept[index]
            if size <= len(buffer) <= 2 * size and not _has_views(buffer):
                del self._kept[index]
                return buffer
        return None


def _has_views(buffer: bytearray) -> bool:
    try:
        del buffer[-1:]  # a buffer with a view cannot be resized
    except BufferError:
        return True
    buffer.append(0)  # moves nothing: its memory has not become smaller
    return False


_log = logging.getLogger(__name__)
OWN: Final = ""
"""The source of what clients of this hub publish: the node has no connection to itself."""


@dataclass(slots=True, eq=False)
class _Sink:
    """One subscription of one client."""

    handle: int
    type: str | None
    deliver: Callable[[ReceivedMessage], None]
    failed: Callable[[RmpaError], None]
    differs: Callable[[OtherType], None] | None = None
    told: set[str] = field(default_factory=set)
    """Other types that ``differs`` was called for."""


@dataclass(slots=True, eq=False)
class _Latched:
    """The last message of a latching source, and which sinks have had it."""

    header: Mapping[str, str]
    type: str
    payload: memoryview
    stamp_ns: int
    had: set[_Sink] = field(default_factory=set)


@dataclass(slots=True, eq=False)
class _Topic:
    name: str
    sinks: dict[Key, _Sink] = field(default_factory=dict)
    registration: Registration[Subscriber] | None = None
    kind: MessageType | None = None
    """The type that it is registered with; ``None``: any."""
    linger: asyncio.TimerHandle | None = None
    latched: dict[str, _Latched] = field(default_factory=dict)
    headers: dict[str, Mapping[str, str]] = field(default_factory=dict)
    """The last header of each publisher, by its name."""
    messages: int = 0
    bytes: int = 0


class HubTopics:
    """All subscriptions.

    Args:
        link: Has the node.
        learn: ``(topic, header)``: a publisher's header, at each new connection, before its first message.
        own_latched: The type, payload and time of the latched message that a client of this hub publishes on a topic.
        graph: All topics of the graph by name; ``graph_changed`` is called at its changes.
        find: A message type, if it is known at once.
        now_ns: The wall clock, in nanoseconds.
    """

    def __init__(
        self,
        link: NodeLink,
        learn: Callable[[str, Mapping[str, str]], None],
        own_latched: Callable[[str], tuple[str, memoryview, int] | None],
        graph: Callable[[], Mapping[str, GraphTopic]] = dict,
        find: Callable[[str], MessageType | None] = lambda _: None,
        now_ns: Callable[[], int] = time.time_ns,
    ) -> None:
        self._link = link
        self._learn = learn
        self._own_latched = own_latched
        self._graph = graph
        self._find = find
        self._now_ns = now_ns
        self._topics: dict[str, _Topic] = {}
        self._ending: EndingRegistrations[Subscriber] = EndingRegistrations()
        self._latched_bytes = 0
        self._latched_order: OrderedDict[tuple[str, str], None] = OrderedDict()
        self._buffers = PayloadBuffers()

    @property
    def names(self) -> KeysView[str]:
        """The topics that are subscribed to, those included that linger."""
        return self._topics.keys()

    def subscribe(
        self,
        key: Key,
        topic: str,
        type_: str | None,
        deliver: Callable[[ReceivedMessage], None],
        failed: Callable[[RmpaError], None],
        differs: Callable[[OtherType], None] | None = None,
    ) -> None:
        """Begin a subscription; latched messages that are there are delivered before this returns.

        Args:
            key: The client and its handle.
            topic: The global name.
            type_: The only type that is wanted; ``None`` for any.
            deliver: Takes each message.
            failed: Called where the rules or the master refuse the subscription, which has then ended.
            differs: Called once for each other type that all its publishers have.
        """
        try:
            self._link.rules.check(Access.SUBSCRIBE, topic)
        except PeerRefused as error:
            failed(error)
            return
        sink = _Sink(key[1], None if type_ == ANY else type_, deliver, failed, differs)
        there = self._topics.get(topic)
        if there is None:
            there = self._topics[topic] = _Topic(topic)
            there.registration = self._registration(there)
            own = self._own_latched(topic)
            if own is not None:
                self._keep(there, OWN, _Latched({}, *own))
        if there.linger is not None:
            there.linger.cancel()
            there.linger = None
        there.sinks[key] = sink
        self._judge(there)
        self._replay(there, sink)

    def unsubscribe(self, key: Key, topic: str) -> None:
        """End a subscription; the last one's topic lingers for ``limits.SUBSCRIPTION_LINGER``."""
        there = self._topics.get(topic)
        sink = there.sinks.pop(key, None) if there is not None else None
        if there is None or sink is None:
            return
        for latched in there.latched.values():
            latched.had.discard(sink)
        if not there.sinks:
            loop = asyncio.get_running_loop()
            there.linger = loop.call_later(limits.SUBSCRIPTION_LINGER, self._end, there)

    def publish(self, topic: str, type_: str, payload: memoryview, *, latch: bool) -> None:
        """Deliver what a client of this hub publishes, to which the node itself does not subscribe."""
        there = self._topics.get(topic)
        if there is not None:
            self._deliver(there, OWN, {"type": type_}, type_, payload, self._now_ns(), latch=latch)

    def forget_own(self, topic: str) -> None:
        """Forget the latched message of the hub's own publisher, which has ended."""
        self._forget_latched(topic, OWN)

    def graph_changed(self) -> None:
        """Publishers have come or gone: tell the subscriptions whose type is another."""
        for there in [*self._topics.values()]:
            self._judge(there)

    async def close(self) -> None:
        """End all, after the node was closed."""
        for there in [*self._topics.values()]:
            self._end(there)
        await self._ending.closed()

    # --- inside -----------------------------------------------------------------------------------------------

    def _registration(self, there: _Topic) -> Registration[Subscriber]:
        return Registration(
            self._link,
            there.name,
            functools.partial(self._register, there),
            _withdraw,
            functools.partial(self._refused, there),
            after=self._ending.take(there.name),
        )

    async def _register(self, there: _Topic, node: Node) -> Subscriber:
        take = functools.partial(self._take, there)
        return await node.subscribe(there.name, there.kind, on_bytes=take, own=False)

    def _judge(self, there: _Topic) -> None:
        """Compare the types that are wanted with those that are published.

        Where nothing of a topic can be delivered, it is subscribed to with the type that is wanted: its publishers
        then refuse the connection as they refuse any node's, so that no message is sent in vain, and ``rmpa why`` and
        the diagnostics name the mismatch.
        """
        topic = self._graph().get(there.name)
        types = topic.types if topic is not None and topic.publishers else ()
        wanted = {sink.type for sink in there.sinks.values()}
        for sink in [*there.sinks.values()] if types else ():
            if sink.type is not None and sink.type not in types and types[0] not in sink.told:
                sink.told.add(types[0])
                if sink.differs is not None:
                    sink.differs(OtherType(sink.handle, there.name, types[0]))
        unfit = types and len(wanted) == 1 and not wanted & {None, *types}
        kind = self._find(next(iter(wanted)) or "") if unfit else None
        if there.registration is not None and kind is not there.kind:
            there.kind = kind
            self._ending.end(there.name, there.registration)
            there.registration = self._registration(there)

    def _refused(self, there: _Topic, error: RmpaError) -> None:
        if self._topics.get(there.name) is there:
            sinks = [*there.sinks.values()]
            there.sinks.clear()
            self._end(there)
            for sink in sinks:
                sink.failed(error)

    def _end(self, there: _Topic) -> None:
        if there.linger is not None:
            there.linger.cancel()
        del self._topics[there.name]
        for source in [*there.latched]:
            self._forget_latched(there.name, source, there)
        if there.registration is not None:
            self._ending.end(there.name, there.registration)
        if not self._topics:
            self._buffers.clear()

    def _take(self, there: _Topic, data: memoryview, header: Mapping[str, str]) -> None:
        if self._topics.get(there.name) is not there:
            return  # it has ended, and is being withdrawn
        stamp_ns = self._now_ns()
        source = header.get("callerid", "?")
        if there.headers.get(source) is not header:
            there.headers[source] = header
            if len(there.headers) > limits.SEEN_PUBLISHERS_MAX:
                del there.headers[next(iter(there.headers))]
            self._learn(there.name, header)
        latch = header.get("latching") == "1"
        payload = self._buffers.copy(data)
        self._deliver(there, source, header, header.get("type", ""), payload, stamp_ns, latch=latch)

    def _deliver(
        self,
        there: _Topic,
        source: str,
        header: Mapping[str, str],
        type_: str,
        payload: memoryview,
        stamp_ns: int,
        *,
        latch: bool,
    ) -> None:
        there.messages += 1
        there.bytes += len(payload)
        had: set[_Sink] | None = None
        if latch:
            latched = there.latched.get(source)
            if latched is not None and source != OWN and latched.header is not header and latched.payload == payload:
                # The publisher sends its latched message at each new connection: most sinks have had it.
                latched.header = header
            else:
                latched = self._keep(there, source, _Latched(header, type_, payload, stamp_ns))
            had = latched.had
        md5sum = header.get("md5sum", "")
        for sink in [*there.sinks.values()]:
            if sink.type not in (None, type_):
                continue
            if had is not None:
                if sink in had:
                    continue
                had.add(sink)
            _deliver_to(
                sink,
                ReceivedMessage(sink.handle, there.name, type_, payload, stamp_ns, source=source, md5sum=md5sum),
            )

    def _keep(self, there: _Topic, source: str, latched: _Latched) -> _Latched:
        self._forget_latched(there.name, source, there)
        there.latched[source] = latched
        self._latched_order[there.name, source] = None
        self._latched_bytes += len(latched.payload)
        while self._latched_bytes > limits.LATCHED_BYTES and len(self._latched_order) > 1:
            self._forget_latched(*next(iter(self._latched_order)))
        return latched

    def _forget_latched(self, topic: str, source: str, there: _Topic | None = None) -> None:
        there = there or self._topics.get(topic)
        self._latched_order.pop((topic, source), None)
        latched = there.latched.pop(source, None) if there is not None else None
        if latched is not None:
            self._latched_bytes -= len(latched.payload)

    def _replay(self, there: _Topic, sink: _Sink) -> None:
        subscriber = there.registration.value if there.registration is not None else None
        connected = subscriber.callers if subscriber is not None else set()
        for source, latched in there.latched.items():
            if (source == OWN or source in connected) and sink.type in (None, latched.type):
                latched.had.add(sink)
                _deliver_to(
                    sink,
                    ReceivedMessage(
                        sink.handle,
                        there.name,
                        latched.type,
                        latched.payload,
                        latched.stamp_ns,
                        latched=True,
                        source=source,
                        md5sum=latched.header.get("md5sum", ""),
                    ),
                )


def _deliver_to(sink: _Sink, message: ReceivedMessage) -> None:
    try:
        sink.deliver(message)
    except Exception:  # noqa: BLE001 - a fault of one client must not cost the others their messages
        _log.exception("! a message of %s could not be delivered", message.topic)


async def _withdraw(subscriber: Subscriber) -> None:
    await subscriber.close()
