"""Publishers and parameters of web clients, ROS time, and rosbridge_suite's counts of clients.

``/client_count`` and ``/connected_clients``, as rosbridge_suite publishes them.
"""

from __future__ import annotations

import asyncio
import contextlib
import functools
import logging
import struct
import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Final, cast

from rmpa.config.peer_rules import Access
from rmpa.core.errors import PeerRefused, RmpaError
from rmpa.ros.master.parameters import Parameters, leaves
from rmpa.ros.types.codec import codec_for
from rmpa.ros.types.messages import HeaderNumbers
from rmpa.web import limits
from rmpa.web.hub.node_link import EndingRegistrations, Registration

if TYPE_CHECKING:
    from collections.abc import Awaitable

    from rmpa.ros.node.node import Node, Publisher
    from rmpa.ros.types.messages import MessageType
    from rmpa.ros.wire.xmlrpc import XmlRpcValue
    from rmpa.web.hub.graph import TypeLibrary
    from rmpa.web.hub.node_link import Key, NodeLink
    from rmpa.web.hub.requests import ParamValue, Payload, ReceivedMessage
    from rmpa.web.hub.topics import HubTopics


# The parameters of the local core: a copy that follows its changes.


_log = logging.getLogger(__name__)
_MISSING = object()


@dataclass(frozen=True, slots=True)
class _Follower:
    names: tuple[str, ...]
    changed: Callable[[Mapping[str, ParamValue]], None]


class ParamMirror:
    """The copy, and the clients that follow it.

    Args:
        link: Has the node.
    """

    def __init__(self, link: NodeLink) -> None:
        self._link = link
        self._parameters = Parameters()
        self._followers: dict[Key, _Follower] = {}
        self._loading: asyncio.Task[None] | None = None
        self._meanwhile: list[tuple[str, XmlRpcValue]] | None = None
        self._told = 0
        self.loaded = asyncio.Event()
        """Set once the parameters are known."""
        self.changes = 0
        """How often they have changed."""
        link.on_node.append(self._load_from)

    @property
    def tree(self) -> Mapping[str, ParamValue]:
        """All parameters; never changed afterwards."""
        return cast("Mapping[str, ParamValue]", self._parameters.tree)

    def value(self, name: str) -> ParamValue:
        """The value at a global name; ``None`` where there is none."""
        try:
            return cast("ParamValue", self._parameters.get(name))
        except KeyError:
            return None

    def values(self, names: tuple[str, ...], prefix: str) -> dict[str, ParamValue]:
        """The values of ``names`` that exist; without names those of all parameters below ``prefix``."""
        if names:
            return {name: value for name in names if (value := self.value(name)) is not None}
        value = self.value(prefix)
        return dict(leaves(prefix.rstrip("/"), value)) if value is not None else {}

    def updated(self, key: str, value: XmlRpcValue) -> None:
        """The master tells a change; ``{}`` for a parameter that was deleted."""
        self._told += 1
        if self._meanwhile is not None:
            self._meanwhile.append((key, value))
            return
        self._change(lambda: self._apply(key, value))

    async def set(self, name: str, value: ParamValue) -> None:
        """Set a parameter.

        Raises:
            RmpaError: The master does not answer, or refuses; or the rules deny it.
        """
        await self._check(name, value)
        told = self._told
        await self._link.need().set_param(name, cast("XmlRpcValue", value))
        # The master does not tell the node that set it.
        self._own_change(told, lambda: self._parameters.set(name, cast("XmlRpcValue", value)))

    async def delete(self, name: str) -> None:
        """Delete a parameter.

        Raises:
            RmpaError: The master does not answer, or the parameter does not exist; or the rules deny it.
        """
        await self._check(name)
        told = self._told
        await self._link.need().delete_param(name)
        self._own_change(told, lambda: self._remove(name))

    def follow(self, key: Key, names: tuple[str, ...], changed: Callable[[Mapping[str, ParamValue]], None]) -> None:
        """Call ``changed`` with each change of ``names``, or of all; ``None`` is a parameter that was deleted."""
        self._followers[key] = _Follower(names, changed)

    def unfollow(self, key: Key) -> None:
        """End a ``follow``."""
        self._followers.pop(key, None)

    def forget_client(self, number: int) -> None:
        """End all that a client follows."""
        for key in [key for key in self._followers if key[0] == number]:
            del self._followers[key]

    def reload(self) -> None:
        """Read everything anew: the master was away."""
        if self._link.node is not None:
            self._load_from(self._link.node)

    async def close(self) -> None:
        """End the reading."""
        if self._loading is not None:
            self._loading.cancel()
            await asyncio.wait([self._loading])

    # --- inside -----------------------------------------------------------------------------------------------

    async def _check(self, name: str, after: ParamValue = None) -> None:
        """Check a change as ``NodeRules`` does, once no reading of the core's parameters is under way."""
        if self._link.rules.permissions is None:
            return
        self._link.need()
        await self.loaded.wait()
        while self._loading is not None and not self._loading.done():
            await asyncio.wait([self._loading])
        self._link.rules.check_param_change(name, self.value, after)

    def _own_change(self, told: int, apply: Callable[[], None]) -> None:
        """Apply a change that the master has taken, unless it told of others meanwhile: their order is not known."""
        self._change(apply)
        if told != self._told or self._meanwhile is not None:
            self.reload()

    def _load_from(self, node: Node) -> None:
        if self._loading is not None:
            self._loading.cancel()
        self._loading = asyncio.get_running_loop().create_task(self._load(node), name="read the parameters")

    async def _load(self, node: Node) -> None:
        while True:
            self._meanwhile = []
            try:
                tree = await node.follow_param("/")
            except RmpaError as error:
                _log.debug("! the parameters cannot be read: %s", error)
                await asyncio.sleep(limits.NODE_RETRY)
                continue
            # Changes that the master told before its answer arrived are newer than the answer.
            meanwhile, self._meanwhile = self._meanwhile, None

            def apply(tree: XmlRpcValue = tree, meanwhile: list[tuple[str, XmlRpcValue]] = meanwhile) -> None:
                self._parameters.set("/", tree if isinstance(tree, dict) else {})
                for key, value in meanwhile:
                    self._apply(key, value)

            self._change(apply)
            self.loaded.set()
            return

    def _apply(self, key: str, value: XmlRpcValue) -> None:
        if value == {} and key.strip("/"):
            self._remove(key)
        else:
            try:
                self._parameters.set(key, value)
            except ValueError as error:
                _log.debug("! the master tells %s for %s: %s", type(value).__name__, key, error)

    def _remove(self, key: str) -> None:
        with contextlib.suppress(KeyError):
            self._parameters.delete(key)

    def _change(self, apply: Callable[[], None]) -> None:
        before = self._parameters.tree
        apply()
        after = self._parameters.tree
        if before is after:
            return
        self.changes += 1
        if not self._followers:
            return
        leaves: dict[str, ParamValue] | None = None
        for follower in [*self._followers.values()]:
            if follower.names:
                changed = {
                    name: new for name in follower.names if not _same(_get(before, name), new := _get(after, name))
                }
                told = {name: None if new is _MISSING else cast("ParamValue", new) for name, new in changed.items()}
            else:
                if leaves is None:
                    leaves = dict(_differences("", before, after))
                told = leaves
            if told:
                follower.changed(told)


def _same(one: object, other: object) -> bool:
    """Whether two values are equal and of the same types: 1 is not 1.0, nor True."""
    if one is other:
        return True
    if isinstance(one, Mapping) and isinstance(other, Mapping):
        return one.keys() == other.keys() and all(_same(value, other[key]) for key, value in one.items())
    if isinstance(one, list) and isinstance(other, list):
        return len(one) == len(other) and all(map(_same, one, other))
    return type(one) is type(other) and one == other


def _get(tree: object, name: str) -> object:
    for part in filter(None, name.split("/")):
        if not isinstance(tree, Mapping) or part not in tree:
            return _MISSING
        tree = tree[part]
    return tree


def _differences(name: str, before: object, after: object) -> Iterator[tuple[str, ParamValue]]:
    """The leaves that differ, each with its new value; ``None`` for those that are gone."""
    if before is after or (not isinstance(after, Mapping) and _same(before, after)):
        return
    old = before if isinstance(before, Mapping) else {}
    new = after if isinstance(after, Mapping) else {}
    for key in old.keys() - new.keys():
        yield from ((leaf, None) for leaf, _ in leaves(f"{name}/{key}", old[key]))
    for key, value in new.items():
        yield from _differences(f"{name}/{key}", old.get(key, _MISSING), value)
    if not isinstance(before, Mapping) and before is not _MISSING and isinstance(after, Mapping):
        yield name, None
    if not isinstance(after, Mapping):
        yield name, cast("ParamValue", after)


# What clients publish: one publisher of the node for each topic, which all clients share.


@dataclass(slots=True, eq=False)
class _Shared:
    """One published topic."""

    topic: str
    type: str
    latch: bool
    users: dict[Key, Callable[[RmpaError], None]] = field(default_factory=dict)
    numbers: HeaderNumbers | None = None
    """Numbers its messages; ``None`` while its type is not known."""
    registration: Registration[Publisher] | None = None
    linger: asyncio.TimerHandle | None = None
    early: deque[tuple[float, Payload]] | None = field(default_factory=deque)
    """What was published before subscribers were connected; ``None`` from then on."""
    early_bytes: int = 0
    latched: tuple[memoryview, int] | None = None


class Publishers:
    """All published topics of the hub.

    Args:
        link: Has the node.
        find: Finds a message type.
        known: A message type that is found at once, or ``None``.
        deliver: ``(topic, type, payload, latch)``: hands a message to the clients of this hub.
        ended: ``(topic)``: a topic was withdrawn.
        now_ns: The wall clock, in nanoseconds.
    """

    def __init__(
        self,
        link: NodeLink,
        find: Callable[[str], Awaitable[MessageType]],
        *,
        known: Callable[[str], MessageType | None],
        deliver: Callable[[str, str, memoryview, bool], None],
        ended: Callable[[str], None],
        now_ns: Callable[[], int] = time.time_ns,
    ) -> None:
        self._link = link
        self._find = find
        self._known = known
        self._deliver = deliver
        self._ended = ended
        self._now_ns = now_ns
        self._shared: dict[str, _Shared] = {}
        self._ending: EndingRegistrations[Publisher] = EndingRegistrations()

    @property
    def topics(self) -> dict[str, str]:
        """The types of the published topics by name, those included that wait for their withdrawal."""
        return {each.topic: each.type for each in self._shared.values()}

    def latched(self, topic: str) -> tuple[str, memoryview, int] | None:
        """The type, payload and time of the last message of a latching topic."""
        shared = self._shared.get(topic)
        return (shared.type, *shared.latched) if shared is not None and shared.latched is not None else None

    def advertise(
        self, key: Key, topic: str, type_: str, failed: Callable[[RmpaError], None], *, latch: bool
    ) -> None:
        """Publish a topic, or join its publisher.

        Raises:
            PeerRefused: The rules deny it, other clients publish it with another type, or there are too many topics.
        """
        self._link.rules.check(Access.PUBLISH, topic)
        shared = self._shared.get(topic)
        if shared is not None and (shared.type != type_ or (not shared.users and shared.latch != latch)):
            if shared.users:
                problem = f"other clients publish {topic} as {shared.type}, not {type_}"
                raise PeerRefused("the web server", problem, "publish it with that type, or under another name")
            self._end(shared)
            shared = None
        if shared is not None and latch and not shared.latch:
            users = shared.users
            self._end(shared)  # TCPROS says at the connection whether a publisher latches
            shared = self._begin(topic, type_, latch=True)
            shared.users |= users
        if shared is None:
            shared = self._begin(topic, type_, latch=latch)
        if shared.linger is not None:
            shared.linger.cancel()
            shared.linger = None
        shared.users[key] = failed

    def unadvertise(self, key: Key, topic: str) -> None:
        """Leave a topic's publisher; the last one's is withdrawn after ``limits.UNADVERTISE_DELAY``."""
        shared = self._shared.get(topic)
        if shared is None or shared.users.pop(key, None) is None or shared.users:
            return
        shared.linger = asyncio.get_running_loop().call_later(limits.UNADVERTISE_DELAY, self._end, shared)

    def publish(self, topic: str, payload: Payload) -> None:
        """Publish a message of an advertised topic, numbered. The payload must not change afterwards."""
        shared = self._shared.get(topic)
        if shared is None:
            return
        if shared.numbers is None:
            self._wait(shared, payload)  # it is numbered and delivered when the type is known
            return
        payload = shared.numbers.stamp(payload)
        view = memoryview(payload)
        if shared.latch:
            shared.latched = (view, self._now_ns())
        publisher = shared.registration.value if shared.registration is not None else None
        if shared.early is not None or publisher is None:
            self._wait(shared, payload)  # also while the node is made anew: the newest messages wait for it
        else:
            publisher.publish_raw(payload)
        self._deliver(topic, shared.type, view, shared.latch)

    async def close(self) -> None:
        """End all, after the node was closed."""
        for shared in [*self._shared.values()]:
            self._end(shared)
        await self._ending.closed()

    # --- inside -----------------------------------------------------------------------------------------------

    def _wait(self, shared: _Shared, payload: Payload) -> None:
        if shared.early is None:
            shared.early, shared.early_bytes = deque(), 0
        shared.early.append((asyncio.get_running_loop().time(), payload))
        shared.early_bytes += len(payload)
        while len(shared.early) > limits.EARLY_MESSAGES or (
            len(shared.early) > 1 and shared.early_bytes > limits.EARLY_BYTES
        ):
            shared.early_bytes -= len(shared.early.popleft()[1])

    def _number(self, shared: _Shared, kind: MessageType) -> None:
        """The type is known: number and deliver what came before."""
        shared.numbers = HeaderNumbers(kind)
        waiting, shared.early, shared.early_bytes = shared.early or (), deque(), 0
        for _, payload in waiting:
            self.publish(shared.topic, payload)

    def _begin(self, topic: str, type_: str, *, latch: bool) -> _Shared:
        if len(self._shared) >= limits.PUBLISHERS_MAX:
            waiting = next((each for each in self._shared.values() if not each.users), None)
            if waiting is None:
                problem = f"its clients publish {len(self._shared)} topics, which is the limit"
                raise PeerRefused("the web server", problem, "publish fewer topics")
            self._end(waiting)
        kind = self._known(type_)
        numbers = HeaderNumbers(kind) if kind is not None else None
        shared = self._shared[topic] = _Shared(topic, type_, latch, numbers=numbers)
        shared.registration = Registration(
            self._link,
            topic,
            functools.partial(self._register, shared),
            _withdraw,
            functools.partial(self._refused, shared),
            after=self._ending.take(topic),
        )
        return shared

    async def _register(self, shared: _Shared, node: Node) -> Publisher:
        kind = await self._find(shared.type)
        if shared.numbers is None and self._shared.get(shared.topic) is shared:
            self._number(shared, kind)
        publisher = await node.advertise(shared.topic, kind, latch=shared.latch)
        if shared.early is not None and not shared.latch:
            # The master has just told the subscribers, which connect now: what is published meanwhile waits for them.
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(limits.EARLY_WAIT):
                    await publisher.wait_for_subscriber()
        early, shared.early = shared.early, None
        oldest = asyncio.get_running_loop().time() - limits.EARLY_AGE
        young = [payload for came, payload in early or () if came >= oldest]  # an old command must not act late
        for payload in young:
            publisher.publish_raw(payload)
        if not young and shared.latched is not None:
            publisher.publish_raw(shared.latched[0])  # a new node: its subscribers have had it, newcomers have not
        return publisher

    def _refused(self, shared: _Shared, error: RmpaError) -> None:
        if self._shared.get(shared.topic) is shared:
            users = [*shared.users.values()]
            shared.users.clear()
            self._end(shared)
            for failed in users:
                failed(error)

    def _end(self, shared: _Shared) -> None:
        if shared.linger is not None:
            shared.linger.cancel()
        del self._shared[shared.topic]
        self._ended(shared.topic)
        if shared.registration is not None:
            self._ending.end(shared.topic, shared.registration)


async def _withdraw(publisher: Publisher) -> None:
    await publisher.close()


COUNT: Final = "/client_count"
CLIENTS: Final = "/connected_clients"
_TYPES: Final = {COUNT: "std_msgs/Int32", CLIENTS: "rosbridge_msgs/ConnectedClients"}
_NANO: Final = 1_000_000_000


@dataclass(frozen=True, slots=True)
class _Connected:
    address: str
    since_ns: int


class ClientCounts:
    """Publishes the number and the list of rosbridge clients, latched, from the first client on.

    Args:
        publishers: The hub's.
        types: Finds the two types.
        key: For the publishers.
        now_ns: The wall clock, in nanoseconds.
    """

    def __init__(self, publishers: Publishers, types: TypeLibrary, key: Key, now_ns: Callable[[], int]) -> None:
        self._now_ns = now_ns
        self._publishers = publishers
        self._types = types
        self._key = key
        self._clients: dict[int, _Connected] = {}
        self._advertised = False

    def add(self, number: int, address: str) -> None:
        """A client is there."""
        self._clients[number] = _Connected(address, self._now_ns())
        self._publish()

    def remove(self, number: int) -> None:
        """A client has gone."""
        if self._clients.pop(number, None) is not None:
            self._publish()

    def _publish(self) -> None:
        if not self._advertised:
            self._advertised = True
            for topic, type_ in _TYPES.items():
                try:
                    self._publishers.advertise(self._key, topic, type_, self._refused, latch=True)
                except RmpaError as error:  # a client publishes that topic with another type
                    self._refused(error)
        clients = [
            {
                "ip_address": each.address,
                "connection_time": {"secs": each.since_ns // _NANO, "nsecs": each.since_ns % _NANO},
            }
            for each in self._clients.values()
        ]
        for topic, values in ((COUNT, {"data": len(clients)}), (CLIENTS, {"clients": clients})):
            codec = codec_for(self._types.message(_TYPES[topic]))
            self._publishers.publish(topic, codec.write(values, 0).payload)

    @staticmethod
    def _refused(error: RmpaError) -> None:
        _log.warning("! %s", error)


# The ROS time: the wall clock, or ``/clock`` where ``use_sim_time`` is set.


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
