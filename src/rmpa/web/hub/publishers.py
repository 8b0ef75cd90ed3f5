"""What clients publish: one publisher of the node for each topic, which all clients share."""

from __future__ import annotations

import asyncio
import contextlib
import functools
import time
from collections import deque
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from rmpa.config.peer_rules import Access
from rmpa.core.errors import PeerRefused
from rmpa.ros.types.messages import HeaderNumbers
from rmpa.web import limits
from rmpa.web.hub.node_link import EndingRegistrations, Registration

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable

    from rmpa.core.errors import RmpaError
    from rmpa.ros.node.node import Node, Publisher
    from rmpa.ros.types.messages import MessageType
    from rmpa.web.hub.clients import Key
    from rmpa.web.hub.node_link import NodeLink
    from rmpa.web.hub.requests import Payload


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
