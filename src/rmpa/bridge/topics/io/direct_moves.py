"""Moves single subscribers of a remote source between the direct and the relayed transport.

TCPROS has no way to redirect a connection. A subscriber is made to leave: roscpp by a list of publishers without the
proxy, rospy by ending its connection. Then it is called back by a list with the proxy, and gets the other answer.
"""

from __future__ import annotations

import asyncio
from contextlib import asynccontextmanager
from typing import TYPE_CHECKING

from rmpa.bridge import limits
from rmpa.bridge.direct.direct_route import DirectState, Path
from rmpa.bridge.direct.io.nodes import (
    bus_links,
    direct_links,
    end_links,
    end_to,
    forgotten,
    publisher_update,
    report_failure,
    standing,
    until,
)
from rmpa.bridge.policy import is_own
from rmpa.bridge.topics.remote_topic import RouteState

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Callable, Mapping

    from rmpa.bridge.direct.direct_route import DirectKey, DirectRoute
    from rmpa.bridge.direct.subscriber_side import DirectSubscriptions
    from rmpa.bridge.messages import Source
    from rmpa.bridge.session.peer_sessions import PeerSessions
    from rmpa.bridge.topics.imports import Imports
    from rmpa.bridge.topics.io.peer_topics import PeerTopics
    from rmpa.bridge.topics.remote_topic import RemoteTopic
    from rmpa.core.counters import Counters
    from rmpa.ros.core.api import Core
    from rmpa.ros.node.publication import Publication


class SubscriberMoves:
    """Moves subscribers; one move of each at a time.

    Args:
        core: The local core.
        imports: The remote sources.
        topics: The peers' topics in the local graph, by the numbers of their sessions.
        sessions: The peers.
        routes: The state of each subscriber.
        on_demand: ``(peer, source, wanted)``: opens the relayed route of a source, or lets it close.
        on_left: Called with a subscriber that has left its connection, and is called back.
        on_warning: ``(kind, subject, text)``: logs and counts a warning.
        counters: Counts ``direct.moved``.
    """

    def __init__(
        self,
        core: Core,
        imports: Imports,
        topics: Mapping[int, PeerTopics],
        sessions: PeerSessions,
        routes: DirectSubscriptions,
        *,
        on_demand: Callable[[int, Source, bool], None],
        on_left: Callable[[DirectKey], None],
        on_warning: Callable[[str, str, str], None],
        counters: Counters,
    ) -> None:
        self._core = core
        self._imports = imports
        self._topics = topics
        self._sessions = sessions
        self._routes = routes
        self._on_demand = on_demand
        self._on_left = on_left
        self._on_warning = on_warning
        self._counters = counters
        self._tasks: dict[DirectKey, asyncio.Task[None]] = {}
        self._hang_ups: set[asyncio.Task[None]] = set()
        """The calls that make subscribers hang up."""
        self._locks: dict[DirectKey, tuple[asyncio.Lock, int]] = {}
        """A lock for each subscriber that is being called, and how many hold it or wait for it."""
        self._repeats: dict[DirectKey, asyncio.TimerHandle] = {}
        self._again: set[DirectKey] = set()
        """Subscribers to be judged again when their move is over."""
        self._stuck: dict[tuple[Source, str], None] = {}
        """Sources and subscribers whose direct connection could not be ended, the latest last."""
        self._closed = False

    def __contains__(self, key: DirectKey) -> bool:
        """Whether a subscriber is being moved."""
        return key in self._tasks

    def uri(self, subscriber: str, topic: str) -> str:
        """The slave API of a local subscriber; empty if it is not registered."""
        return self._core.subscribers(topic).get(subscriber, "")

    async def close(self) -> None:
        """Stop all moves."""
        self._closed = True
        for handle in self._repeats.values():
            handle.cancel()
        self._repeats.clear()
        tasks = [*self._tasks.values(), *self._hang_ups]
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)

    def is_stuck(self, key: DirectKey) -> bool:
        """Whether a direct connection of a subscriber to a source could not be ended."""
        return (key.source, key.subscriber) in self._stuck

    def stuck(self, key: DirectKey, endpoint: tuple[str, int], problem: str) -> None:
        """Note and report a direct connection that cannot be ended.

        Args:
            key: The subscriber.
            endpoint: The other end of its connection.
            problem: Why.
        """
        self._mark_stuck(key, stuck=True)
        self._routes.stays(key, endpoint, problem)
        text = (
            f"{key.source}: {key.subscriber} stays connected to {endpoint[0]}:{endpoint[1]}: a rospy subscriber "
            f"leaves only when its connection is ended, and this agent may not do that ({problem}); see rmpa doctor"
        )
        self._on_warning("direct.stuck", f"{key.peer} {key.source} {key.subscriber}", text)

    async def end_unknown(self, key: DirectKey, topic: str, address: str) -> tuple[tuple[str, int] | None, str]:
        """End a subscriber's direct connections to a peer that no present decision knows of.

        They were made under an earlier run of this agent, or could not be ended before.

        Args:
            key: The subscriber.
            topic: The topic's local name.
            address: The address of the peer's nodes.

        Returns:
            The other end of one that stays, and why; ``None`` if none is left.
        """
        uri = self.uri(key.subscriber, topic)
        known = {route.endpoint for one, route in self._routes.connected() if one.subscriber == key.subscriber}
        if (route := self._routes.get(key)) is not None:
            known.discard(route.endpoint)
        local = {one for name, one in self._core.publishers(topic).items() if not is_own(name)}
        left: tuple[tuple[str, int] | None, str] = (None, "")
        for link in await bus_links(uri) or () if uri else ():
            end, port = link.remote, link.local_port
            direct = link.inbound and link.topic == topic and link.connected and link.other not in local
            if direct and end is not None and end[0] == address and end not in known and port in standing(end):
                problem = end_to(end, {port})
                left = (end, problem) if problem else left
        self._mark_stuck(key, stuck=bool(left[1]))
        return left

    def _mark_stuck(self, key: DirectKey, *, stuck: bool) -> None:
        if not stuck:
            self._stuck.pop((key.source, key.subscriber), None)
            return
        self._stuck[key.source, key.subscriber] = None
        if len(self._stuck) > limits.DIRECT_MAX:
            del self._stuck[next(iter(self._stuck))]

    # --- hanging up -------------------------------------------------------------------------------------------------

    def hang_up(self, key: DirectKey, endpoint: tuple[str, int]) -> None:
        """Make a subscriber leave its direct connection; it is not called back."""
        task = asyncio.create_task(self._hang_up_alone(key, endpoint), name=f"hang up {key.subscriber}")
        self._hang_ups.add(task)
        task.add_done_callback(self._hung_up)

    def _hung_up(self, task: asyncio.Task[None]) -> None:
        self._hang_ups.discard(task)
        report_failure(task, self._counters)

    @asynccontextmanager
    async def _alone(self, key: DirectKey) -> AsyncIterator[None]:
        """Excludes other calls to the same subscriber: their lists of publishers must not overtake each other."""
        lock, count = self._locks.get(key, (asyncio.Lock(), 0))
        self._locks[key] = (lock, count + 1)
        try:
            async with lock:
                yield
        finally:
            lock, count = self._locks[key]
            if count == 1:
                del self._locks[key]
            else:
                self._locks[key] = (lock, count - 1)

    async def _hang_up_alone(self, key: DirectKey, endpoint: tuple[str, int]) -> None:
        async with self._alone(key):
            await self._hang_up(key, endpoint)

    async def _hang_up(self, key: DirectKey, endpoint: tuple[str, int]) -> None:
        topic, proxy = key.source.topic, self._proxy_uri(key)
        uri = self.uri(key.subscriber, topic)
        if not uri:
            return
        links = await direct_links(uri, topic, endpoint)
        others = [one for one in self._core.publishers(topic).values() if one != proxy]
        await publisher_update(uri, topic, others)
        if problem := await end_links(endpoint, links or ()):
            self.stuck(key, endpoint, problem)
        route, now = self._routes.get(key), list(self._core.publishers(topic).values())
        called_back = route is not None and not route.stranded
        if called_back or [one for one in now if one != proxy] != others:
            await publisher_update(uri, topic, now)  # the master's own list may have been overtaken
        self._repeat_later(key, topic)

    def _repeat_later(self, key: DirectKey, topic: str) -> None:
        """Repeats the list of publishers: a roscore's list is known here with a delay, and calls may be lost."""
        if not self._closed:
            later = asyncio.get_running_loop().call_later
            if (earlier := self._repeats.pop(key, None)) is not None:
                earlier.cancel()
            self._repeats[key] = later(limits.DIRECT_LIST_AGAIN, self._repeat, key, topic)

    def _repeat(self, key: DirectKey, topic: str) -> None:
        self._repeats.pop(key, None)
        uri, route = self.uri(key.subscriber, topic), self._routes.get(key)
        if uri and not self._closed and not (route is not None and route.stranded):
            task = asyncio.create_task(self._call_back(key, uri, topic), name=f"call back {key.subscriber}")
            self._hang_ups.add(task)
            task.add_done_callback(self._hung_up)

    async def _call_back(self, key: DirectKey, uri: str, topic: str) -> None:
        async with self._alone(key):
            await publisher_update(uri, topic, list(self._core.publishers(topic).values()))

    def _proxy_uri(self, key: DirectKey) -> str:
        session = self._sessions.get(key.peer)
        proxy = session.proxies.get(key.source.node) if session is not None else None
        return proxy.uri if proxy is not None else ""

    # --- moving -----------------------------------------------------------------------------------------------------

    def move(self, key: DirectKey) -> None:
        """Make a subscriber leave its present connection, and call it back to get the answer that was decided."""
        if key in self._tasks:
            self._again.add(key)
            return
        task = self._tasks[key] = asyncio.create_task(self._move(key), name=f"move {key.subscriber}")
        task.add_done_callback(lambda done: self._moved(key, done))

    def _moved(self, key: DirectKey, task: asyncio.Task[None]) -> None:
        """Moves a subscriber again if the decision has changed since it was called back."""
        self._tasks.pop(key, None)
        report_failure(task, self._counters)
        again = key in self._again
        self._again.discard(key)
        if again and not self._closed and self._routes.misplaced(key):
            self.move(key)

    def _publication(self, key: DirectKey) -> Publication | None:
        topics = self._topics.get(key.peer)
        return topics.publication(key.source) if topics is not None else None

    async def _move(self, key: DirectKey) -> None:
        async with self._alone(key):
            await self._move_alone(key)

    async def _move_alone(self, key: DirectKey) -> None:
        entry, route = self._imports.get(key.peer, key.source), self._routes.get(key)
        publication = self._publication(key)
        if entry is None or route is None or publication is None:
            return
        uri, proxy, session = (
            self.uri(key.subscriber, entry.topic),
            self._proxy_uri(key),
            self._sessions.get(key.peer),
        )
        if not uri or not proxy or session is None:
            return
        elsewhere = route.endpoint is not None and route.endpoint[0] != session.address
        if not elsewhere and not self._routes.misplaced(key):
            return  # decided otherwise meanwhile
        to_relay = route.state is DirectState.RELAYED
        held = to_relay and route.path is Path.DIRECT
        if held:
            # Make before break: the relayed route flows, and its latched message is known, before the other ends.
            self._on_demand(key.peer, key.source, True)
            await until(lambda: _is_relayed(entry, publication), limits.DIRECT_MOVE_ROUTE)
            if not self._routes.misplaced(key):
                self._let_go(key, publication)
                return  # decided otherwise meanwhile
        try:
            had = publication.latched if held else ()
            if not await self._leave(key, route, publication, uri, proxy):
                return
            publication.spare(key.subscriber, had)
            self._counters.add("direct.moved")
            await publisher_update(uri, entry.topic, list(self._core.publishers(entry.topic).values()))
            arrived = await self._arrived(key, publication)
            if not arrived and self._routes.get(key) is route and route.path is Path.NONE:
                # A list of publishers that the master sent at the same time may have overtaken this one.
                await publisher_update(uri, entry.topic, list(self._core.publishers(entry.topic).values()))
            self._repeat_later(key, entry.topic)
        finally:
            if held:
                self._let_go(key, publication)

    def _let_go(self, key: DirectKey, publication: Publication) -> None:
        """Lets the relayed route close again if nothing subscribes to it."""
        if not publication.subscribers:
            self._on_demand(key.peer, key.source, False)

    async def _leave(
        self, key: DirectKey, route: DirectRoute, publication: Publication, uri: str, proxy: str
    ) -> bool:
        """Ends a subscriber's present connection to a source; return whether it has none any more."""
        topic = publication.topic
        endpoint = route.endpoint if route.path is Path.DIRECT else None
        links = await direct_links(uri, topic, endpoint) if endpoint is not None else []
        if links is None and endpoint is not None and standing(endpoint):
            return False  # the node is stopped: `_check` tries again
        await publisher_update(uri, topic, [one for one in self._core.publishers(topic).values() if one != proxy])
        left = publication.hang_up(key.subscriber)
        if endpoint is not None and (problem := await end_links(endpoint, links or ())):
            self.stuck(key, endpoint, problem)
            return False
        if left or route.path is not Path.RELAY:
            await forgotten(uri, topic, proxy)
        self._routes.hung_up(key)
        self._on_left(key)
        return True

    async def _arrived(self, key: DirectKey, publication: Publication) -> bool:
        """Waits until a subscriber that was called back is connected, by either transport."""

        def there() -> bool:
            route = self._routes.get(key)
            if route is None or key.subscriber in publication.callers:
                return True
            return route.path is Path.DIRECT and route.endpoint is not None and bool(standing(route.endpoint))

        return await until(there, limits.DIRECT_SETTLE)


def _is_relayed(entry: RemoteTopic, publication: Publication) -> bool:
    """Whether messages flow through the agents, and the last one of a latched source has come."""
    if entry.state is not RouteState.OPEN:
        return False
    latching = entry.description is not None and entry.description.latching
    return bool(publication.latched) or not latching
