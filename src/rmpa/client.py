"""What an agent of this machine shows, as typed values: its snapshot, and an event for each change.

::

    async with AgentClient() as agent:
        snapshot = await agent.snapshot()
        print([peer.name for peer in snapshot.peers])
        async for event in agent.events(since=snapshot):
            match event:
                case PeerLost():
                    print(event.peer.name, "is gone:", event.peer.last_error)

The agent is the one that the commands of ``rmpa`` choose: the named one, else that of RMPA_AGENT, else the only one.
"""

from __future__ import annotations

import asyncio
import os
from contextlib import aclosing
from typing import TYPE_CHECKING, Final, Self, TypeAlias

import msgspec

from rmpa.core.errors import PeerRefused, RmpaError, UnreachableError
from rmpa.core.facts import LinkInfo, RouteInfo, ServiceInfo, TopicInfo
from rmpa.core.timers import positive
from rmpa.observe import limits
from rmpa.observe.control_client import ControlClient, choose_agent
from rmpa.observe.graph import GraphRevision
from rmpa.observe.snapshot import AgentInfo, PeerInfo, Snapshot

if TYPE_CHECKING:
    from collections.abc import AsyncGenerator, Iterator
    from pathlib import Path
    from types import TracebackType

__all__ = [
    "AgentClient",
    "AgentEvent",
    "AgentInfo",
    "AgentLost",
    "AgentReturned",
    "ContractBroken",
    "LinkInfo",
    "NoteCleared",
    "NoteRaised",
    "PeerInfo",
    "PeerLinked",
    "PeerLost",
    "RouteInfo",
    "ServiceAppeared",
    "ServiceGone",
    "ServiceInfo",
    "Snapshot",
    "TopicAppeared",
    "TopicGone",
    "TopicInfo",
    "changes",
    "snapshot",
]

# The least time from one snapshot to the next while the graph changes all the time.
_LEAST: Final = 0.1


class PeerLinked(msgspec.Struct, frozen=True):
    """The agent has a link to a peer, or hears it by another peer that relays.

    Attributes:
        peer: The peer as it is now.
    """

    peer: PeerInfo


class PeerLost(msgspec.Struct, frozen=True):
    """The agent has lost a peer.

    Attributes:
        peer: The peer as it is now, with ``last_error``; as it was last if it has left the roster.
    """

    peer: PeerInfo


class TopicAppeared(msgspec.Struct, frozen=True):
    """There is a topic, of this module or of a peer.

    Attributes:
        topic: The topic as it is now.
    """

    topic: TopicInfo


class TopicGone(msgspec.Struct, frozen=True):
    """A topic is gone.

    Attributes:
        topic: The topic as it was last.
    """

    topic: TopicInfo


class ServiceAppeared(msgspec.Struct, frozen=True):
    """There is a service, of this module or of a peer.

    Attributes:
        service: The service as it is now.
    """

    service: ServiceInfo


class ServiceGone(msgspec.Struct, frozen=True):
    """A service is gone.

    Attributes:
        service: The service as it was last.
    """

    service: ServiceInfo


class ContractBroken(msgspec.Struct, frozen=True):
    """A topic's contract was not kept.

    Attributes:
        topic: The topic's name.
        peer: The peer that its messages come from, or go to.
        kind: ``deadline_missed``, ``lifespan_expired``, ``liveliness_lost`` or ``messages_lost``.
        count: How many times, or how many messages, since the last such event.
    """

    topic: str
    peer: str
    kind: str
    count: int


class NoteRaised(msgspec.Struct, frozen=True):
    """The agent has something that its user should know.

    Attributes:
        text: Ready to read.
    """

    text: str


class NoteCleared(msgspec.Struct, frozen=True):
    """A note is over.

    Attributes:
        text: That of the note.
    """

    text: str


class AgentLost(msgspec.Struct, frozen=True):
    """The agent does not answer; it is asked again and again.

    Attributes:
        problem: Why, and what to do.
    """

    problem: str


class AgentReturned(msgspec.Struct, frozen=True):
    """The agent answers again; what has changed meanwhile follows.

    Attributes:
        agent: The agent, perhaps of another run.
    """

    agent: AgentInfo


AgentEvent: TypeAlias = (
    PeerLinked
    | PeerLost
    | TopicAppeared
    | TopicGone
    | ServiceAppeared
    | ServiceGone
    | ContractBroken
    | NoteRaised
    | NoteCleared
    | AgentLost
    | AgentReturned
)


def snapshot(name: str | None = None) -> Snapshot:
    """What an agent shows now, for programs without asyncio; it blocks for some milliseconds.

    Args:
        name: The agent's; ``None``: as the commands of ``rmpa`` choose it.

    Raises:
        UnreachableError: No agent answers, or none of that name.
        RmpaError: Several agents run, and none is selected.
    """
    with ControlClient(choose_agent(os.environ, name).path) as client:
        return client.snapshot()


class AgentClient:
    """Asks one agent of this machine; use it in an ``async with``.

    Args:
        name: The agent's; ``None``: as the commands of ``rmpa`` choose it.
    """

    def __init__(self, name: str | None = None) -> None:
        self._name = name
        self._path: Path | None = None

    async def __aenter__(self) -> Self:
        """Find the agent.

        Raises:
            UnreachableError: No agent answers, or none of that name.
            RmpaError: Several agents run, and none is selected.
        """
        self._path = (await asyncio.to_thread(choose_agent, os.environ, self._name)).path
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._path = None

    @property
    def name(self) -> str:
        """The agent's name."""
        return self._where.stem

    async def snapshot(self) -> Snapshot:
        """What the agent shows now.

        Raises:
            UnreachableError: The agent does not answer.
        """
        with await asyncio.to_thread(ControlClient, self._where) as client:
            return await client.ask("snapshot", Snapshot)

    async def events(self, *, since: Snapshot | None = None, period: float = 1.0) -> AsyncGenerator[AgentEvent, None]:
        """The changes from a snapshot on, without end.

        A change of the local graph, which peers' topics are part of, is an event at once; other changes at the end of
        a period. What appears and is gone again in between is no event. An agent that ends is waited for.

        Args:
            since: The snapshot that the caller knows; ``None``: what is there now comes first, as if it had appeared.
            period: Seconds from one snapshot to the next at the most.

        Raises:
            RemoteProtocolError: The agent is of a release that cannot be understood.
        """
        positive(period, "the period of events")
        last, lost = since, False
        async with aclosing(self.snapshots(period=period)) as snapshots:
            async for now in snapshots:
                if isinstance(now, AgentLost):
                    lost = True
                    yield now
                    continue
                if lost:
                    yield AgentReturned(now.agent)
                    lost = False
                for event in changes(last, now):
                    yield event
                last = now

    async def snapshots(self, *, period: float = 1.0) -> AsyncGenerator[Snapshot | AgentLost, None]:
        """What the agent shows, after each change of its graph and after a period without one, without end.

        Args:
            period: Seconds from one snapshot to the next at the most.

        Raises:
            RemoteProtocolError: The agent is of a release that cannot be understood.
        """
        positive(period, "the period of snapshots")
        lost = False
        while True:
            try:
                with await asyncio.to_thread(ControlClient, self._where) as client:
                    async with aclosing(_snapshots(client, period)) as snapshots:
                        async for now in snapshots:
                            lost = False
                            yield now
            except UnreachableError as error:
                if not lost:
                    lost = True
                    yield AgentLost(str(error))
                await asyncio.sleep(period)

    @property
    def _where(self) -> Path:
        if self._path is None:
            raise RmpaError("the agent is not known: write `async with AgentClient() as agent:`")
        return self._path


async def _snapshots(client: ControlClient, period: float) -> AsyncGenerator[Snapshot, None]:
    """A snapshot after each change of the graph, and after a period without one."""
    loop = asyncio.get_running_loop()
    known: int | None = None
    while True:
        began = loop.time()
        try:
            known = (await client.ask("graph", GraphRevision)).revision
            yield await client.ask("snapshot", Snapshot)
            wait = min(period, limits.CONTROL_WAIT_MAX)
            await client.ask("graph", GraphRevision, after=known, wait=wait)
        except PeerRefused:  # an agent without a graph, such as a gateway's
            yield await client.ask("snapshot", Snapshot)
            await asyncio.sleep(period)
        await asyncio.sleep(max(0.0, began + min(_LEAST, period) - loop.time()))


def changes(before: Snapshot | None, after: Snapshot) -> Iterator[AgentEvent]:
    """The events between two snapshots of one agent.

    Args:
        before: The earlier one; ``None``: one with nothing in it.
        after: The later one.
    """
    linked = {peer.guid: peer for peer in after.peers if _is_linked(peer)}
    roster = {peer.guid: peer for peer in after.peers}
    old = before or msgspec.structs.replace(after, peers=(), topics=(), services=(), notes=())
    was_linked = {peer.guid: peer for peer in old.peers if _is_linked(peer)}
    yield from (PeerLost(roster.get(guid, peer)) for guid, peer in was_linked.items() if guid not in linked)
    yield from (PeerLinked(peer) for guid, peer in linked.items() if guid not in was_linked)
    topics, old_topics = ({topic.name: topic for topic in each.topics} for each in (after, old))
    yield from (TopicGone(topic) for name, topic in old_topics.items() if name not in topics)
    yield from (TopicAppeared(topic) for name, topic in topics.items() if name not in old_topics)
    services, old_services = ({_key(each): each for each in one.services} for one in (after, old))
    yield from (ServiceGone(service) for key, service in old_services.items() if key not in services)
    yield from (ServiceAppeared(service) for key, service in services.items() if key not in old_services)
    for name, topic in topics.items():
        yield from _broken(old_topics.get(name), topic)
    yield from (NoteCleared(text) for text in old.notes if text not in after.notes)
    yield from (NoteRaised(text) for text in after.notes if text not in old.notes)


def _broken(before: TopicInfo | None, topic: TopicInfo) -> Iterator[ContractBroken]:
    counted = {_route(route): route.events for route in before.routes} if before is not None else {}
    for route in topic.routes:
        known = counted.get(_route(route))
        for kind, count in route.events.items() if known is not None else ():
            more = count - known.get(kind, 0) if known is not None else 0
            if more > 0 and kind != "liveliness_restored":
                yield ContractBroken(topic.name, route.peer, kind, more)


def _route(route: RouteInfo) -> tuple[str, str, str]:
    return route.peer, route.node, route.direction


def _is_linked(peer: PeerInfo) -> bool:
    return peer.state in {"linked", "relayed"}


def _key(service: ServiceInfo) -> tuple[str, str]:
    return service.name, service.peer
