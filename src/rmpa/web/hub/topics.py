"""The hub's topics: one subscription and one publisher of its node for all clients, and what is latched."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import time
import weakref
from collections import OrderedDict, deque
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Final, Generic, TypeVar

import msgspec

from rmpa.config.peer_rules import Access
from rmpa.core.errors import PeerRefused, RmpaError
from rmpa.core.limits import MIB
from rmpa.core.log import logged_failure
from rmpa.ros.types.messages import HeaderNumbers, MessageType
from rmpa.ros.wire.tcpros import ANY
from rmpa.web import limits
from rmpa.web.hub.node_link import NodeLink, Payload, Registration

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Mapping

    from rmpa.ros.node.node import Node, Publisher, Subscriber
    from rmpa.web.hub.graph import GraphWatch, TypeLibrary

_log = logging.getLogger(__name__)
_T = TypeVar("_T")
_User = TypeVar("_User", "ClientSubscription", "ClientPublication")


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


class _Shared(Generic[_User]):
    """A topic that clients subscribe to, or publish, together: it stays while it has users, and a while longer.

    Args:
        table: All of its kind, by name.
        name: The topic.
    """

    registration: Registration[Any]

    def __init__(self, table: dict[str, Any], name: str) -> None:
        self.name = name
        self.users: dict[_User, None] = {}
        self._table = table
        self._timer: asyncio.TimerHandle | None = None
        table[name] = self

    @property
    def is_there(self) -> bool:
        """Whether it has not ended."""
        return self._table.get(self.name) is self

    def use(self, user: _User) -> None:
        """It has one more user."""
        self._keep()
        self.users[user] = None

    def leave(self, user: _User, linger: float) -> None:
        """A user has gone, once; the last one's stays for so many seconds."""
        if user in self.users:
            del self.users[user]
            if not self.users and self.is_there:
                self._timer = asyncio.get_running_loop().call_later(linger, self.end)

    def refused(self, error: RmpaError) -> None:
        """The master refuses it: it ends, and its users are told."""
        if self.is_there:
            users, self.users = self.users, {}
            self.end()
            for each in users:
                each.failed(error)

    def end(self) -> None:
        """Unregister it, also while clients use it."""
        self._keep()
        del self._table[self.name]
        self.registration.end()

    def _keep(self) -> None:
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None


@dataclass(slots=True, eq=False, weakref_slot=True)
class ClientSubscription:
    """One subscription of one client, from ``HubTopics.subscribe``."""

    there: _Topic
    type: str | None
    receive: Callable[[ReceivedMessage], None]
    failed: Callable[[RmpaError], None]
    differs: Callable[[str], None]
    # Other types that ``differs`` was called for.
    told: set[str] = field(default_factory=set)

    def close(self) -> None:
        """End it; the last one's topic lingers for ``limits.SUBSCRIPTION_LINGER``."""
        self.there.leave(self, limits.SUBSCRIPTION_LINGER)


@dataclass(slots=True, eq=False, weakref_slot=True)
class ClientPublication:
    """One client's share of a publisher, from ``HubTopics.advertise``."""

    there: _Publisher
    failed: Callable[[RmpaError], None]
    accepts: Callable[[str], bool]

    @property
    def topic(self) -> str:
        """The topic."""
        return self.there.name

    def publish(self, payload: Payload) -> None:
        """Publish a message, numbered. The payload must not change afterwards."""
        if self.accepts(self.topic) and self in self.there.users and self.there.is_there:
            self.there.publish(payload)

    def close(self) -> None:
        """Leave the publisher; the last one's is withdrawn after ``limits.UNADVERTISE_DELAY``."""
        self.there.leave(self, limits.UNADVERTISE_DELAY)


@dataclass(slots=True, eq=False)
class _Latched:
    """The last message of a latching source, and which subscriptions have had it."""

    message: ReceivedMessage
    header: Mapping[str, str]
    had: weakref.WeakSet[ClientSubscription] = field(default_factory=weakref.WeakSet)


class HubTopics:
    """All topics that clients of the hub subscribe to and publish: for each one subscription and one publisher.

    Args:
        link: Has the node.
        types: Is told the headers of publishers, and knows the types.
        graph: Likewise, and the topics.
    """

    def __init__(self, link: NodeLink, types: TypeLibrary, graph: GraphWatch) -> None:
        self.link = link
        self.types = types
        self.graph = graph
        # The topics that are subscribed to, those included that linger.
        self.subscribed: dict[str, _Topic] = {}
        # The published topics, those included that wait for their withdrawal.
        self.published: dict[str, _Publisher] = {}
        # The last messages of latching sources, by topic and source, the oldest first.
        self.latched: OrderedDict[tuple[str, str], _Latched] = OrderedDict()
        self.buffers = PayloadBuffers()
        graph.follow(self._graph_changed)

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
        self.link.rules.check(Access.SUBSCRIBE, topic)
        there = self.subscribed.get(topic) or _Topic(self, topic)
        made = ClientSubscription(there, None if type_ == ANY else type_, receive, failed, differs)
        there.use(made)
        loop = asyncio.get_running_loop()
        loop.call_soon(there.replay, made)
        loop.call_soon(there.judge)
        return made

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
        self.link.rules.check(Access.PUBLISH, topic)
        there = self.published.get(topic)
        users = there.users if there is not None else {}
        if there is not None and users and there.type != type_:
            problem = f"other clients publish {topic} as {there.type}, not {type_}"
            raise PeerRefused("the web server", problem, "publish it with that type, or under another name")
        # TCPROS says at the connection whether a publisher latches.
        if there is not None and (there.type != type_ or there.latch != latch) and (latch or not users):
            there.end()
            there = None
        if there is None:
            self._make_room()
            there = _Publisher(self, topic, type_, latch=latch)
            for each in users:
                each.there = there
                there.use(each)
        made = ClientPublication(there, failed, accepts)
        there.use(made)
        return made

    def _make_room(self) -> None:
        if len(self.published) >= limits.PUBLISHERS_MAX:
            unused = next((each for each in self.published.values() if not each.users), None)
            if unused is None:
                problem = f"its clients publish {len(self.published)} topics, which is the limit"
                raise PeerRefused("the web server", problem, "publish fewer topics")
            unused.end()

    def close(self) -> None:
        """End all."""
        open_: list[_Topic | _Publisher] = [*self.subscribed.values(), *self.published.values()]
        for there in open_:
            there.end()

    def keep(self, latched: _Latched) -> _Latched:
        """Keep a latched message for newcomers, as long as there is room."""
        self.latched[latched.message.topic, latched.message.source] = latched
        self.latched.move_to_end((latched.message.topic, latched.message.source))
        size = sum(len(each.message.payload) for each in self.latched.values())
        while size > limits.LATCHED_BYTES and len(self.latched) > 1:
            size -= len(self.latched.popitem(last=False)[1].message.payload)
        return latched

    def _graph_changed(self) -> None:
        for there in [*self.subscribed.values()]:
            there.judge()


class _Topic(_Shared[ClientSubscription]):
    """A topic that clients subscribe to."""

    def __init__(self, topics: HubTopics, name: str) -> None:
        super().__init__(topics.subscribed, name)
        self._topics = topics
        # The type that it is registered with; ``None``: any.
        self._kind: MessageType | None = None
        # The last header of each publisher, by its name.
        self._headers: dict[str, Mapping[str, str]] = {}
        self.registration: Registration[Subscriber] = self._registered()
        own = topics.published.get(name)
        if own is not None and own.latched is not None:
            topics.keep(_Latched(own.latched, {}))

    def _registered(self) -> Registration[Subscriber]:
        return Registration(self._topics.link, "topic", self.name, self._register, self.refused)

    async def _register(self, node: Node) -> Subscriber:
        return await node.subscribe(self.name, self._kind, on_bytes=self._take, own=False)

    def end(self) -> None:
        """End it, and forget what is latched."""
        super().end()
        for key in [key for key in self._topics.latched if key[0] == self.name]:
            del self._topics.latched[key]
        if not self._topics.subscribed:
            self._topics.buffers.clear()

    def judge(self) -> None:
        """Compare the types that are wanted with those that are published.

        Where nothing of a topic can be delivered, it is subscribed to with the type that is wanted: its publishers
        then refuse the connection as they refuse any node's, so that no message is sent in vain, and ``rmpa why`` and
        the diagnostics name the mismatch.
        """
        if not self.is_there:
            return
        topic = self._topics.graph.topics.get(self.name)
        types = topic.types if topic is not None and topic.publishers else ()
        wanted = {each.type for each in self.users}
        for each in [*self.users] if types else ():
            if each.type is not None and each.type not in types and types[0] not in each.told:
                each.told.add(types[0])
                each.differs(types[0])
        unfit = types and len(wanted) == 1 and not wanted & {None, *types}
        kind = self._topics.types.at_hand(next(iter(wanted)) or "") if unfit else None
        if kind is not self._kind:
            self._kind = kind
            self.registration.end()
            self.registration = self._registered()

    def _take(self, data: memoryview, header: Mapping[str, str]) -> None:
        if not self.is_there:
            return  # it has ended, and is being withdrawn
        topics = self._topics
        stamp_ns = time.time_ns()
        source, type_ = header.get("callerid", "?"), header.get("type", "")
        if self._headers.get(source) is not header:
            self._headers[source] = header
            if len(self._headers) > limits.SEEN_PUBLISHERS_MAX:
                del self._headers[next(iter(self._headers))]
            topics.types.learn(header)
            if type_:
                topics.graph.saw_type(self.name, type_)
        payload = topics.buffers.copy(data)
        message = ReceivedMessage(self.name, type_, payload, stamp_ns, source, header.get("md5sum", ""))
        self.deliver(message, header if header.get("latching") == "1" else None)

    def deliver(self, message: ReceivedMessage, latching: Mapping[str, str] | None) -> None:
        """Hand a message to all; ``latching`` is its publisher's header, if that latches."""
        if latching is None:
            _hand(message, self.users)
            return
        latched = self._topics.latched.get((self.name, message.source))
        again = latched is not None and latched.header is not latching and latched.message.payload == message.payload
        if latched is not None and again and message.source != OWN:
            # The publisher sends its latched message at each new connection: most have had it.
            latched.header = latching
        else:
            latched = self._topics.keep(_Latched(message, latching))
        _hand_latched(latched, self.users)

    def replay(self, subscription: ClientSubscription) -> None:
        """Hand what is latched to a new subscription."""
        subscriber = self.registration.value
        connected = {OWN} | (subscriber.callers if subscriber is not None else set())
        if subscription in self.users:
            for (topic, source), latched in [*self._topics.latched.items()]:
                if topic == self.name and source in connected:
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


class _Publisher(_Shared[ClientPublication]):
    """A topic that clients publish."""

    # More than 12 fields: what is published before its type is known, or its subscribers are connected, waits.
    def __init__(self, topics: HubTopics, name: str, type_: str, *, latch: bool) -> None:
        super().__init__(topics.published, name)
        self.type = type_
        self.latch = latch
        # The last message, if it latches.
        self.latched: ReceivedMessage | None = None
        self._topics = topics
        # What was published before subscribers were connected; ``None`` from then on.
        self._early: deque[tuple[float, Payload]] | None = deque()
        self._early_bytes = 0
        # Numbers its messages; ``None`` while its type is not known.
        kind = topics.types.at_hand(type_)
        self._numbers = HeaderNumbers(kind) if kind is not None else None
        self.registration: Registration[Publisher] = Registration(
            topics.link, "publisher", name, self._register, self.refused
        )

    def end(self) -> None:
        """End it, and forget what is latched."""
        super().end()
        self._topics.latched.pop((self.name, OWN), None)

    def publish(self, payload: Payload) -> None:
        """Publish a message, also to clients of the hub: the node itself does not subscribe to it."""
        if self._numbers is None:
            self._wait(payload)  # it is numbered and delivered when the type is known
            return
        payload = self._numbers.stamp(payload)
        message = ReceivedMessage(self.name, self.type, memoryview(payload), time.time_ns())
        if self.latch:
            self.latched = message
        if self._early is not None or self.registration.value is None:
            self._wait(payload)  # also while the node is made anew: the newest messages wait for it
        else:
            self.registration.value.publish_raw(payload)
        if (there := self._topics.subscribed.get(self.name)) is not None:
            there.deliver(message, {} if self.latch else None)

    def _wait(self, payload: Payload) -> None:
        if self._early is None:
            self._early, self._early_bytes = deque(), 0
        self._early.append((asyncio.get_running_loop().time(), payload))
        self._early_bytes += len(payload)
        while len(self._early) > 100 or (len(self._early) > 1 and self._early_bytes > 4 * MIB):
            self._early_bytes -= len(self._early.popleft()[1])

    async def _register(self, node: Node) -> Publisher:
        kind = await self._topics.types.find_message(self.type)
        if self._numbers is None and self.is_there:
            self._numbers = HeaderNumbers(kind)
            waiting, self._early, self._early_bytes = self._early or (), deque(), 0
            for _, payload in waiting:
                self.publish(payload)
        publisher = await node.advertise(self.name, kind, latch=self.latch)
        if self._early is not None and not self.latch:
            # The master has just told the subscribers, which connect now: what is published meanwhile waits for them.
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(1.0):
                    await publisher.wait_for_subscriber()
        early, self._early = self._early, None
        oldest = asyncio.get_running_loop().time() - limits.EARLY_AGE
        young = [payload for came, payload in early or () if came >= oldest]  # an old command must not act late
        for payload in young:
            publisher.publish_raw(payload)
        if not young and self.latched is not None:
            # A new node: its subscribers have had it, newcomers have not.
            publisher.publish_raw(self.latched.payload)
        return publisher
