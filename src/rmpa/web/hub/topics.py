"""The hub's topics: one subscription and one publisher of its node for all clients, and what is latched."""

from __future__ import annotations

import asyncio
import contextlib
import functools
import logging
import weakref
from collections import OrderedDict, deque
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Final, Generic, TypeVar

import msgspec

from rmpa.config.peer_rules import Access
from rmpa.core.errors import PeerRefused
from rmpa.core.limits import MIB
from rmpa.core.log import logged_failure
from rmpa.ros.types.messages import HeaderNumbers
from rmpa.ros.wire.tcpros import ANY
from rmpa.web import limits
from rmpa.web.hub.node_link import Registration

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, KeysView, Mapping

    from rmpa.core.errors import RmpaError
    from rmpa.ros.node.node import Node, Publisher, Subscriber
    from rmpa.ros.types.messages import MessageType
    from rmpa.web.hub.graph import GraphWatch, TypeLibrary
    from rmpa.web.hub.node_link import NodeLink, Payload

_log = logging.getLogger(__name__)
_T = TypeVar("_T")


class PayloadBuffers:
    """Copies large payloads into buffers that are used again when no view of them is left.

    To fill a fresh buffer of a megabyte takes several times as long as to fill one that was used before: the kernel
    maps and clears each of its pages first.

    Args:
        kept_bytes: Bytes of the buffers that are kept, used and unused.
    """

    def __init__(self, kept_bytes: int = 16 * MIB) -> None:  # what waits for one slow client
        self._limit = kept_bytes
        # Those used last are at the right.
        self._kept: deque[bytearray] = deque()
        # Bytes of the buffers that are kept.
        self.bytes = 0

    def copy(self, data: memoryview) -> memoryview:
        """A read-only copy, which stays as it is while there is a view of it."""
        size = len(data)
        if size < limits.PAYLOAD_BUFFER_MIN:
            return memoryview(bytes(data))
        buffer = self._unused(size)
        if buffer is None:
            buffer = bytearray(size)
            self.bytes += size
        self._kept.append(buffer)
        while self.bytes > self._limit or len(self._kept) > limits.PAYLOAD_BUFFERS_MAX:
            self.bytes -= len(self._kept.popleft())
        view = memoryview(buffer)[:size]
        view[:] = data
        return view.toreadonly()

    def clear(self) -> None:
        """Keep no buffer; those in use end with their last view."""
        self._kept.clear()
        self.bytes = 0

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


class MadeOnce(Generic[_T]):
    """What is made of messages, once for all clients: these get a topic's message at nearly the same time.

    A message is recognised by its payload, which is the same memoryview for all.

    Args:
        most_bytes: Of the messages that are kept, and of what was made of them.
        size: Bytes of what was made of one.
    """

    def __init__(self, most_bytes: int, size: Callable[[_T], int] = lambda _: 0) -> None:
        self._most = most_bytes
        self._size = size
        self._kept: OrderedDict[tuple[object, ...], tuple[Payload, int, _T]] = OrderedDict()
        # Bytes of all that is kept.
        self.bytes = 0

    def get(self, payload: memoryview, make: Callable[[], _T], *how: object) -> _T:
        """What was made of a message in one way; it is shared, and must not be changed. Raises as ``make``."""
        key = (id(payload), *how)
        kept = self._kept.get(key)
        if kept is not None:
            # The payload is kept too, so its id cannot have been given to another.
            self._kept.move_to_end(key)
            return kept[2]
        made = make()
        size = self._size(made) + len(payload)
        if size <= self._most:
            self._kept[key] = payload, size, made
            self.bytes += size
            while self.bytes > self._most or len(self._kept) > limits.MADE_KEPT:
                self.bytes -= self._kept.popitem(last=False)[1][1]
        return made


# The source of what clients of this hub publish: the node has no connection to itself.
OWN: Final = ""


class ReceivedMessage(msgspec.Struct, frozen=True):
    """One message, for all who subscribe to its topic.

    Attributes:
        payload: Stays valid and unchanged for as long as it is referenced.
        stamp_ns: Its time of receipt (UTC, nanoseconds).
        source: The node that published it in this module's graph; "" for a client of the hub.
        md5sum: That of the publisher's version of the type; "" where it is not told.
    """

    topic: str
    type: str
    payload: memoryview
    stamp_ns: int
    source: str = OWN
    md5sum: str = ""


@dataclass(slots=True, eq=False, weakref_slot=True)
class ClientSubscription:
    """One subscription of one client, from ``HubTopics.subscribe``."""

    topics: HubTopics
    topic: str
    type: str | None
    receive: Callable[[ReceivedMessage], None]
    failed: Callable[[RmpaError], None]
    differs: Callable[[str], None]
    # Other types that ``differs`` was called for.
    told: set[str] = field(default_factory=set)

    def close(self) -> None:
        """End it; the last one's topic lingers for ``limits.SUBSCRIPTION_LINGER``."""
        self.topics.unsubscribe(self)


@dataclass(slots=True, eq=False)
class _Latched:
    """The last message of a latching source, and which subscriptions have had it."""

    message: ReceivedMessage
    header: Mapping[str, str]
    had: weakref.WeakSet[ClientSubscription] = field(default_factory=weakref.WeakSet)


@dataclass(slots=True, eq=False)
class _Topic:
    name: str
    registration: Registration[Subscriber] = field(init=False)
    subscriptions: dict[ClientSubscription, None] = field(default_factory=dict)
    # The type that it is registered with; ``None``: any.
    kind: MessageType | None = None
    linger: asyncio.TimerHandle | None = None
    # The last header of each publisher, by its name.
    headers: dict[str, Mapping[str, str]] = field(default_factory=dict)


class HubTopics:
    """All subscriptions, and what clients of the hub publish to each other.

    Args:
        link: Has the node.
        types: Is told the headers of publishers, and knows the types.
        graph: Likewise, and the topics.
        now_ns: The wall clock, in nanoseconds.
    """

    def __init__(self, link: NodeLink, types: TypeLibrary, graph: GraphWatch, now_ns: Callable[[], int]) -> None:
        self._link = link
        self._types = types
        self._graph = graph
        self._now_ns = now_ns
        self._topics: dict[str, _Topic] = {}
        # The last messages of latching sources, by topic and source, the oldest first.
        self._latched: OrderedDict[tuple[str, str], _Latched] = OrderedDict()
        self._buffers = PayloadBuffers()
        self.publishers = Publishers(link, types, self, now_ns)
        graph.follow(self._graph_changed)

    @property
    def names(self) -> KeysView[str]:
        """The topics that are subscribed to, those included that linger."""
        return self._topics.keys()

    def subscribe(
        self,
        topic: str,
        type_: str | None,
        receive: Callable[[ReceivedMessage], None],
        failed: Callable[[RmpaError], None] = lambda _: None,
        differs: Callable[[str], None] = lambda _: None,
    ) -> ClientSubscription:
        """Begin a subscription. Latched messages that are there come first, right after this has returned.

        Args:
            topic: The global name.
            type_: The only type that is wanted; ``None`` for any.
            receive: Takes each message.
            failed: Called where the master refuses the subscription, which has then ended.
            differs: Called once for each other type that all its publishers have.

        Raises:
            PeerRefused: The rules deny it.
        """
        self._link.rules.check(Access.SUBSCRIBE, topic)
        made = ClientSubscription(self, topic, None if type_ == ANY else type_, receive, failed, differs)
        there = self._topics.get(topic)
        if there is None:
            there = self._topics[topic] = _Topic(topic)
            there.registration = self._registration(there)
            if (own := self.publishers.latched(topic)) is not None:
                self._keep(_Latched(own, {}))
        if there.linger is not None:
            there.linger.cancel()
            there.linger = None
        there.subscriptions[made] = None
        loop = asyncio.get_running_loop()
        loop.call_soon(self._replay, there, made)
        loop.call_soon(self._judge, there)
        return made

    def unsubscribe(self, subscription: ClientSubscription) -> None:
        """End a subscription, once."""
        there = self._topics.get(subscription.topic)
        if there is None or subscription not in there.subscriptions:
            return
        del there.subscriptions[subscription]
        if not there.subscriptions:
            there.linger = asyncio.get_running_loop().call_later(limits.SUBSCRIPTION_LINGER, self._end, there)

    def publish_own(self, message: ReceivedMessage, *, latch: bool) -> None:
        """Deliver what a client of this hub publishes, to which the node itself does not subscribe."""
        there = self._topics.get(message.topic)
        if there is not None:
            self._deliver(there, message, {} if latch else None)

    def forget_own(self, topic: str) -> None:
        """Forget the latched message of the hub's own publisher, which has ended."""
        self._latched.pop((topic, OWN), None)

    def close(self) -> None:
        """End all."""
        for there in [*self._topics.values()]:
            self._end(there)
        self.publishers.close()

    def _registration(self, there: _Topic) -> Registration[Subscriber]:
        register = functools.partial(self._register, there)
        return Registration(self._link, "topic", there.name, register, functools.partial(self._refused, there))

    async def _register(self, there: _Topic, node: Node) -> Subscriber:
        take = functools.partial(self._take, there)
        return await node.subscribe(there.name, there.kind, on_bytes=take, own=False)

    def _graph_changed(self) -> None:
        for there in [*self._topics.values()]:
            self._judge(there)

    def _judge(self, there: _Topic) -> None:
        """Compare the types that are wanted with those that are published.

        Where nothing of a topic can be delivered, it is subscribed to with the type that is wanted: its publishers
        then refuse the connection as they refuse any node's, so that no message is sent in vain, and ``rmpa why`` and
        the diagnostics name the mismatch.
        """
        if self._topics.get(there.name) is not there:
            return
        topic = self._graph.topics.get(there.name)
        types = topic.types if topic is not None and topic.publishers else ()
        wanted = {each.type for each in there.subscriptions}
        for each in [*there.subscriptions] if types else ():
            if each.type is not None and each.type not in types and types[0] not in each.told:
                each.told.add(types[0])
                each.differs(types[0])
        unfit = types and len(wanted) == 1 and not wanted & {None, *types}
        kind = self._types.at_hand(next(iter(wanted)) or "") if unfit else None
        if kind is not there.kind:
            there.kind = kind
            there.registration.end()
            there.registration = self._registration(there)

    def _refused(self, there: _Topic, error: RmpaError) -> None:
        if self._topics.get(there.name) is there:
            subscriptions = [*there.subscriptions]
            self._end(there)
            for each in subscriptions:
                each.failed(error)

    def _end(self, there: _Topic) -> None:
        if there.linger is not None:
            there.linger.cancel()
        for key in [key for key in self._latched if key[0] == there.name]:
            del self._latched[key]
        del self._topics[there.name]
        there.registration.end()
        if not self._topics:
            self._buffers.clear()

    def _take(self, there: _Topic, data: memoryview, header: Mapping[str, str]) -> None:
        if self._topics.get(there.name) is not there:
            return  # it has ended, and is being withdrawn
        stamp_ns = self._now_ns()
        source, type_ = header.get("callerid", "?"), header.get("type", "")
        if there.headers.get(source) is not header:
            there.headers[source] = header
            if len(there.headers) > limits.SEEN_PUBLISHERS_MAX:
                del there.headers[next(iter(there.headers))]
            self._types.learn(header)
            if type_:
                self._graph.saw_type(there.name, type_)
        payload = self._buffers.copy(data)
        message = ReceivedMessage(there.name, type_, payload, stamp_ns, source, header.get("md5sum", ""))
        self._deliver(there, message, header if header.get("latching") == "1" else None)

    def _deliver(self, there: _Topic, message: ReceivedMessage, latching: Mapping[str, str] | None) -> None:
        """Hand a message to all; ``latching`` is its publisher's header, if that latches."""
        if latching is None:
            _hand(message, there.subscriptions)
            return
        latched = self._latched.get((there.name, message.source))
        again = latched is not None and latched.header is not latching and latched.message.payload == message.payload
        if latched is not None and again and message.source != OWN:
            # The publisher sends its latched message at each new connection: most have had it.
            latched.header = latching
        else:
            latched = self._keep(_Latched(message, latching))
        _hand_latched(latched, there.subscriptions)

    def _keep(self, latched: _Latched) -> _Latched:
        self._latched[latched.message.topic, latched.message.source] = latched
        self._latched.move_to_end((latched.message.topic, latched.message.source))
        size = sum(len(each.message.payload) for each in self._latched.values())
        while size > limits.LATCHED_BYTES and len(self._latched) > 1:
            size -= len(self._latched.popitem(last=False)[1].message.payload)
        return latched

    def _replay(self, there: _Topic, subscription: ClientSubscription) -> None:
        subscriber = there.registration.value
        connected = {OWN} | (subscriber.callers if subscriber is not None else set())
        if subscription in there.subscriptions:
            for (topic, source), latched in [*self._latched.items()]:
                if topic == there.name and source in connected:
                    _hand_latched(latched, (subscription,))


def _hand_latched(latched: _Latched, subscriptions: Iterable[ClientSubscription]) -> None:
    news = [each for each in subscriptions if each not in latched.had]
    latched.had.update(each for each in news if each.type in (None, latched.message.type))
    _hand(latched.message, news)


def _hand(message: ReceivedMessage, subscriptions: Iterable[ClientSubscription]) -> None:
    for each in [*subscriptions]:
        if each.type in (None, message.type):
            # A fault of one client must not cost the others their messages.
            with logged_failure(_log, "a message of %s could not be delivered", message.topic):
                each.receive(message)


@dataclass(slots=True, eq=False, weakref_slot=True)
class ClientPublication:
    """One client's share of a publisher, from ``Publishers.advertise``."""

    publishers: Publishers
    topic: str
    failed: Callable[[RmpaError], None]
    accepts: Callable[[str], bool]

    def publish(self, payload: Payload) -> None:
        """Publish a message, numbered. The payload must not change afterwards."""
        if self.accepts(self.topic):
            self.publishers.publish(self, payload)

    def close(self) -> None:
        """Leave the publisher; the last one's is withdrawn after ``limits.UNADVERTISE_DELAY``."""
        self.publishers.unadvertise(self)


@dataclass(slots=True, eq=False)
class _Publisher:
    """One published topic."""

    topic: str
    type: str
    latch: bool
    users: set[ClientPublication]
    # Numbers its messages; ``None`` while its type is not known.
    numbers: HeaderNumbers | None = None
    registration: Registration[Publisher] = field(init=False)
    linger: asyncio.TimerHandle | None = None
    # What was published before subscribers were connected; ``None`` from then on.
    early: deque[tuple[float, Payload]] | None = field(default_factory=deque)
    early_bytes: int = 0
    latched: ReceivedMessage | None = None


class Publishers:
    """All published topics of the hub: one publisher of the node for each, which all clients share.

    Args:
        link: Has the node.
        types: Finds the types.
        subscriptions: The clients' that subscribe to the same topics.
        now_ns: The wall clock, in nanoseconds.
    """

    def __init__(
        self, link: NodeLink, types: TypeLibrary, subscriptions: HubTopics, now_ns: Callable[[], int]
    ) -> None:
        self._link = link
        self._types = types
        self._subscriptions = subscriptions
        self._now_ns = now_ns
        self._topics: dict[str, _Publisher] = {}

    @property
    def names(self) -> KeysView[str]:
        """The published topics, those included that wait for their withdrawal."""
        return self._topics.keys()

    def latched(self, topic: str) -> ReceivedMessage | None:
        """The last message of a latching topic."""
        there = self._topics.get(topic)
        return there.latched if there is not None else None

    def advertise(
        self,
        topic: str,
        type_: str,
        failed: Callable[[RmpaError], None],
        *,
        latch: bool,
        accepts: Callable[[str], bool] = lambda _: True,
    ) -> ClientPublication:
        """Publish a topic, or join its publisher.

        Args:
            topic: The global name.
            type_: Its type.
            failed: Called where the master refuses the publisher, which has then ended.
            latch: Whether its last message is kept for newcomers.
            accepts: ``(topic)``: whether a message may be published now.

        Raises:
            PeerRefused: The rules deny it, other clients publish it with another type, or there are too many topics.
        """
        self._link.rules.check(Access.PUBLISH, topic)
        there = self._topics.get(topic)
        users = there.users if there is not None else set()
        if there is not None and users and there.type != type_:
            problem = f"other clients publish {topic} as {there.type}, not {type_}"
            raise PeerRefused("the web server", problem, "publish it with that type, or under another name")
        # TCPROS says at the connection whether a publisher latches.
        if there is not None and (there.type != type_ or there.latch != latch) and (latch or not users):
            self._end(there)
            there = None
        if there is None:
            there = self._begin(topic, type_, users, latch=latch)
        if there.linger is not None:
            there.linger.cancel()
            there.linger = None
        made = ClientPublication(self, topic, failed, accepts)
        there.users.add(made)
        return made

    def unadvertise(self, publication: ClientPublication) -> None:
        """End a publication, once."""
        there = self._topics.get(publication.topic)
        if there is not None and publication in there.users:
            there.users.remove(publication)
            if not there.users:
                there.linger = asyncio.get_running_loop().call_later(limits.UNADVERTISE_DELAY, self._end, there)

    def publish(self, publication: ClientPublication, payload: Payload) -> None:
        """Publish a message of a publication that has not ended."""
        there = self._topics.get(publication.topic)
        if there is not None and publication in there.users:
            self._publish(there, payload)

    def close(self) -> None:
        """End all."""
        for there in [*self._topics.values()]:
            self._end(there)

    def _publish(self, there: _Publisher, payload: Payload) -> None:
        if there.numbers is None:
            self._wait(there, payload)  # it is numbered and delivered when the type is known
            return
        payload = there.numbers.stamp(payload)
        message = ReceivedMessage(there.topic, there.type, memoryview(payload), self._now_ns())
        if there.latch:
            there.latched = message
        if there.early is not None or there.registration.value is None:
            self._wait(there, payload)  # also while the node is made anew: the newest messages wait for it
        else:
            there.registration.value.publish_raw(payload)
        self._subscriptions.publish_own(message, latch=there.latch)

    def _wait(self, there: _Publisher, payload: Payload) -> None:
        if there.early is None:
            there.early, there.early_bytes = deque(), 0
        there.early.append((asyncio.get_running_loop().time(), payload))
        there.early_bytes += len(payload)
        while len(there.early) > 100 or (len(there.early) > 1 and there.early_bytes > 4 * MIB):
            there.early_bytes -= len(there.early.popleft()[1])

    def _begin(self, topic: str, type_: str, users: set[ClientPublication], *, latch: bool) -> _Publisher:
        if len(self._topics) >= limits.PUBLISHERS_MAX:
            unused = next((each for each in self._topics.values() if not each.users), None)
            if unused is None:
                problem = f"its clients publish {len(self._topics)} topics, which is the limit"
                raise PeerRefused("the web server", problem, "publish fewer topics")
            self._end(unused)
        kind = self._types.at_hand(type_)
        numbers = HeaderNumbers(kind) if kind is not None else None
        there = self._topics[topic] = _Publisher(topic, type_, latch, users, numbers)
        register = functools.partial(self._register, there)
        refused = functools.partial(self._refused, there)
        there.registration = Registration(self._link, "publisher", topic, register, refused)
        return there

    async def _register(self, there: _Publisher, node: Node) -> Publisher:
        kind = await self._types.find_message(there.type)
        if there.numbers is None and self._topics.get(there.topic) is there:
            there.numbers = HeaderNumbers(kind)
            waiting, there.early, there.early_bytes = there.early or (), deque(), 0
            for _, payload in waiting:
                self._publish(there, payload)
        publisher = await node.advertise(there.topic, kind, latch=there.latch)
        if there.early is not None and not there.latch:
            # The master has just told the subscribers, which connect now: what is published meanwhile waits for them.
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(1.0):
                    await publisher.wait_for_subscriber()
        early, there.early = there.early, None
        oldest = asyncio.get_running_loop().time() - limits.EARLY_AGE
        young = [payload for came, payload in early or () if came >= oldest]  # an old command must not act late
        for payload in young:
            publisher.publish_raw(payload)
        if not young and there.latched is not None:
            # A new node: its subscribers have had it, newcomers have not.
            publisher.publish_raw(there.latched.payload)
        return publisher

    def _refused(self, there: _Publisher, error: RmpaError) -> None:
        if self._topics.get(there.topic) is there:
            users = [*there.users]
            there.users.clear()
            self._end(there)
            for each in users:
                each.failed(error)

    def _end(self, there: _Publisher) -> None:
        if there.linger is not None:
            there.linger.cancel()
        del self._topics[there.topic]
        self._subscriptions.forget_own(there.topic)
        there.registration.end()
