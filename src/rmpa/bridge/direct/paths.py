"""What two agents say of one direct connection, and the side that asks: how nodes here reach those of peers.

The question, the grant, and each condition that fails as a reason: docs/guides/contracts.md lists the conditions for
users, docs/design/protocol.md has examples of the messages. Topics and services have the same three:
``direct.topic`` or ``direct.service`` asks, ``…_again`` makes the asking side ask again, ``…_release`` gives a grant
back.

``Paths.update`` decides about one path whenever one of its facts has changed. What this module knows itself decides
at once; else one task asks the peer's agent, and probes the node that it names. A change meanwhile begins the task
anew, so that no outdated answer is taken. ``Path.found`` is the decision, ``Path.place`` where the subscriber is now:
where they differ, a subclass moves it.
"""

from __future__ import annotations

import asyncio
import math
from abc import ABC, abstractmethod
from collections import deque
from dataclasses import dataclass, field
from enum import StrEnum
from typing import TYPE_CHECKING, Annotated, Any, Final, Generic, NamedTuple

import msgspec

from rmpa.bridge import limits
from rmpa.bridge.messages import Name, NameOrNone, Origin, convert, is_crossing_name
from rmpa.bridge.peer_offers import EntryT
from rmpa.core.contract import Contract, Transport, needs_agents
from rmpa.core.errors import PeerRefused, RemoteProtocolError, RmpaError
from rmpa.runtime.tasks import OwnedTasks

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from rmpa.bridge.bridge import Bridge
    from rmpa.bridge.sessions import PeerSession


class Condition(StrEnum):
    """A condition of direct transport; its value is the word in ``--json`` and between agents.

    Attributes:
        TRANSPORT: The transport of the contract, or of the service's rule, is not ``relay``.
        CONTRACT: The contract asks for nothing that only agents do.
        NAME: The topic or service has the same name in both modules: TCPROS headers carry it.
        OWN_SOURCE: The source is the peer's own, and does not come by a relay.
        ACTION: It is no topic whose publisher compares the names of its subscribers.
        RELEASE: The peer's agent knows direct transport.
        AGENT: The peer's agent answers in time.
        OFFERED: The peer offers the topic or service now.
        NODE: The publisher's node answers its agent.
        LISTENING: The publisher's node listens where the subscriber's module can reach it, not only on loopback.
        REACHABLE: A connection from the subscriber's module to the publisher's node works.
        CALLER_ID: No other subscriber of the same name is connected to the publisher.
        SUBSCRIBER: The subscriber's node connects to other machines (ROS_IP and ROS_HOSTNAME do not bind it to
            loopback).
        MEASURES: The subscriber is no tool that measures by the agents.
        LATCHED: No latched message would be delivered twice by the move.
        STABLE: Direct connections of this subscriber have not broken repeatedly.
        LIMIT: The peer's direct connections are within ``limits.DIRECT_MAX``.
        TRUST: The mesh is not secured, or both modules let plain connections cross (``trust.direct``), or share a
            machine.
        CORE: The local core can answer each node by itself: services only.
    """

    TRANSPORT = "transport"
    CONTRACT = "contract"
    NAME = "name"
    OWN_SOURCE = "own_source"
    ACTION = "action"
    RELEASE = "release"
    AGENT = "agent"
    OFFERED = "offered"
    NODE = "node"
    LISTENING = "listening"
    REACHABLE = "reachable"
    CALLER_ID = "caller_id"
    SUBSCRIBER = "subscriber"
    MEASURES = "measures"
    LATCHED = "latched"
    STABLE = "stable"
    LIMIT = "limit"
    TRUST = "trust"
    CORE = "core"


_PASSING: Final = frozenset({Condition.AGENT, Condition.NODE, Condition.REACHABLE, Condition.STABLE, Condition.LIMIT})


@dataclass(frozen=True, slots=True)
class Unmet:
    """A condition that does not hold, and the fact as text for the user."""

    condition: Condition
    text: str

    @property
    def lasting(self) -> bool:
        """Whether only a change that is noticed can make it hold, so that trying again by time is of no use."""
        return self.condition not in _PASSING


# What holds while there is no link.
NO_LINK: Final = Unmet(Condition.OFFERED, "its module has no link")


class Grant(NamedTuple):
    """A peer's permission to connect to one of its nodes.

    Args:
        port: The node's TCPROS port; the address is that of the link.
        node: The node's name in the peer's graph.
        probe: A service of the node, by which it is probed; empty: none is known.
    """

    port: int
    node: str
    probe: str = ""


def unmet_by_contract(contract: Contract, where: str) -> Unmet | None:
    """The condition that a contract does not meet, if any.

    Args:
        contract: The contract.
        where: Whose it is, as text.
    """
    if contract.transport is Transport.RELAY:
        return Unmet(Condition.TRANSPORT, f'the setting transport = "relay" of {where} asks for it')
    terms = needs_agents(contract)
    return Unmet(Condition.CONTRACT, f"the contract asks for what only agents do: {terms}") if terms else None


def unmet_by_rules(
    contract: Contract, bridge: Bridge, peer: PeerSession, where: str, owner: str, other: str, origin: Origin | None
) -> Unmet | None:
    """The condition that is not met by what both sides of topics and services judge alike, if any.

    Args:
        contract: That of the side that judges; of a service the transport alone.
        bridge: Whether the mesh is secured, and whether plain connections are let all the same.
        peer: The peer: on one machine a connection does not leave it.
        where: Whose rules these are, as text.
        owner: The owner's module, as text.
        other: The name that the topic or service has there, if it is another one here; else empty.
        origin: The module that a relayed one belongs to.
    """
    if (unmet := unmet_by_contract(contract, where)) is not None:
        return unmet
    if not (bridge.context.gate.plain or peer.same_machine):
        text = f"the mesh is secured, and nothing would protect the connection; trust.direct is false in {where}"
        return Unmet(Condition.TRUST, text)
    if origin is not None:
        return Unmet(Condition.OWN_SOURCE, f"it is {origin.name}'s, and comes by a relay")
    return Unmet(Condition.NAME, f"it is {other} in {owner}") if other else None


class Want(NamedTuple):
    """What is to be reached directly.

    Args:
        name: The topic or service, by its name on the wire.
        node: The node that publishes or provides it.
        user: The subscribing node; empty: a service, for every node of the asking module.
    """

    name: str
    node: str
    user: str = ""


class DirectAsk(msgspec.Struct, frozen=True, omit_defaults=True):
    """May this be reached directly? A notification has the fields of ``Want`` alone.

    Args:
        name: As in ``Want``.
        node: As in ``Want``.
        user: As in ``Want``.
        contract: What the subscriber's module asks for; topics only.
        broken: Whether an earlier connection ended by itself, so that the publisher may be dead.
    """

    name: Name
    node: Name
    user: NameOrNone = ""
    contract: Contract | None = None
    broken: bool = False

    @property
    def want(self) -> Want:
        """What is asked for."""
        return Want(self.name, self.node, self.user)


def read_ask(args: dict[str, Any]) -> DirectAsk:
    """Read and validate a question or a notification.

    Raises:
        RemoteProtocolError: A name or a value is invalid.
    """
    return convert("direct transport", args, DirectAsk)


class _Reply(msgspec.Struct, frozen=True):
    """The answer of the owner's agent: a port, or a reason."""

    port: Annotated[int, msgspec.Meta(gt=0, lt=1 << 16)] | None = None
    probe: str = ""
    why: str | None = None
    text: str = ""


def read_reply(value: object, node: str) -> Grant | Unmet:
    """Read the answer of a peer. A reason's text is safe to show; one of a later release counts as ``RELEASE``.

    Args:
        value: What the peer sent.
        node: The node that was asked for.

    Raises:
        RemoteProtocolError: It is neither a port nor a reason.
    """
    reply = convert("direct transport", value, _Reply)
    if reply.port is not None:
        return Grant(reply.port, node, reply.probe if is_crossing_name(reply.probe) else "")
    if reply.why is None:
        raise RemoteProtocolError("direct transport: an answer has neither a port nor a reason")
    condition = Condition(reply.why) if reply.why in set(Condition) else Condition.RELEASE
    return Unmet(condition, "".join(one if one.isprintable() else "�" for one in reply.text[:300]))


def reply_of(found: Grant | Unmet) -> dict[str, object]:
    """The answer to a peer."""
    if isinstance(found, Grant):
        return {"port": found.port, "probe": found.probe}
    return {"why": found.condition.value, "text": found.text}


# When a subscriber was without its direct path, by the peer's name and what is reached: how often, when the last time
# began, and when it ended (``None``: it lasts), monotonic seconds. It outlasts links. What was published meanwhile is
# lost to it, and not counted.
Interruptions = dict[tuple[str, Want], tuple[int, float, float | None]]


def interrupted(known: Interruptions, session: PeerSession, want: Want, *, lasts: bool) -> None:
    """Note that a path is gone (``lasts``), or that a subscriber has one again, direct or relayed."""
    peer, now = session.link.name, asyncio.get_running_loop().time()
    count, began, ended = known.pop((peer, want), (0, now, now))
    if lasts and ended is not None:
        count, began, ended = count + 1, now, None
    elif not lasts and ended is None:
        ended = now
    if count:
        known[peer, want] = count, began, ended
    if len(known) > limits.DIRECT_MAX:
        del known[next(iter(known))]


_UNSTABLE: Final = Unmet(
    Condition.STABLE,
    f"its direct connection broke {limits.DIRECT_BREAKS} times in {limits.DIRECT_BREAKS_SPAN:g} s",
)
# The place of a subscriber that is connected to the proxy.
AGENTS: Final = ("", 0)
# The place of a subscriber that has lost its connection, and is called back.
LOST: Final = ("", -1)


@dataclass(slots=True, eq=False)
class Path(Generic[EntryT]):
    """How one local subscriber of a peer's topic, or all local callers of its service, reach the peer's node.

    More than twelve fields: the facts, the decision, and where the subscriber is, which follows it later.

    Args:
        session: The peer.
        want: What is reached.
        entry: The source or service, as the peer offers it.
        contract: That of the topic here; of a service the transport alone.
        here: The condition that does not hold by the rules and the graph of this module, if any.
        breaks: When its direct connections ended by themselves, monotonic seconds.
        asked_at: When the peer was last asked, monotonic seconds.
        held: Whether the peer may hold a grant for it.
        task: Asks the peer; ``None``: ``found`` is the decision.
        retry: Decides again: what does not hold may pass.
        found: The last decision; ``None``: there is none yet.
        since: When it was made, monotonic seconds.
        place: Where it is connected: ``AGENTS``, an address and port, or ``LOST``; ``None``: nowhere, by itself.
        placed_at: When ``place`` was set, monotonic seconds.
        mover: Moves the subscriber.
    """

    session: PeerSession
    want: Want
    entry: EntryT
    contract: Contract
    here: Unmet | None = None
    breaks: deque[float] = field(default_factory=lambda: deque(maxlen=limits.DIRECT_BREAKS))
    asked_at: float = -math.inf
    held: bool = False
    task: asyncio.Task[None] | None = None
    retry: asyncio.TimerHandle | None = None
    found: Grant | Unmet | None = None
    since: float = 0.0
    place: tuple[str, int] | None = None
    placed_at: float = 0.0
    mover: asyncio.Task[None] | None = None

    @property
    def target(self) -> tuple[str, int] | None:
        """Where a new connection should lead; ``None``: to the agents."""
        return (self.session.address, self.found.port) if isinstance(self.found, Grant) else None

    @property
    def endpoint(self) -> tuple[str, int] | None:
        """The address and port of its direct connection; ``None`` if it has none."""
        return None if self.place in {AGENTS, LOST} else self.place

    @property
    def unmet(self) -> Unmet | None:
        """Why it is relayed; ``None`` if it is not, or not decided."""
        return self.found if isinstance(self.found, Unmet) and self.task is None else None

    @property
    def state(self) -> str:
        """``asking``, ``direct`` or ``relayed``."""
        if self.task is not None or self.found is None:
            return "asking"
        return "direct" if isinstance(self.found, Grant) else "relayed"


class Paths(ABC, Generic[EntryT]):
    """The decisions of this module. Subclasses probe nodes, and carry the decisions out.

    Args:
        bridge: The core, the peers and the rules.
        on_warning: ``(kind, subject, text)``: logs and counts a warning.

    Attributes:
        kind: The middle of the names of the messages.
        _paths: By peer, name and node; then by user.
    """

    kind = ""

    def __init__(self, bridge: Bridge, on_warning: Callable[[str, str, str], None]) -> None:
        self._bridge = bridge
        self._on_warning = on_warning
        self._paths: dict[tuple[int, str, str], dict[str, Path[EntryT]]] = {}
        self._probes: dict[tuple[int, int, str], asyncio.Task[str]] = {}
        self._asks: dict[int, asyncio.Semaphore] = {}
        self._tasks = OwnedTasks()
        self._closed = False

    def __iter__(self) -> Iterator[Path[EntryT]]:
        """Every path; changes during the iteration are allowed."""
        return iter([path for users in self._paths.values() for path in users.values()])

    def of(self, peer: int, name: str, node: str) -> list[Path[EntryT]]:
        """The paths to one node's topic or service, by the names of their users."""
        return [path for _, path in sorted(self._paths.get((peer, name, node), {}).items())]

    def get(self, peer: int, want: Want) -> Path[EntryT] | None:
        """One path; ``None`` if it is not known."""
        return self._paths.get((peer, *want[:2]), {}).get(want.user)

    @staticmethod
    def _now() -> float:
        return asyncio.get_running_loop().time()

    @abstractmethod
    async def _probe(self, path: Path[EntryT], grant: Grant) -> str:
        """Why a node cannot be reached from here; empty: it can."""

    @abstractmethod
    def _decided(self, path: Path[EntryT]) -> None:
        """Carry out a decision."""

    @abstractmethod
    def _subject(self, path: Path[EntryT]) -> str:
        """A path in a warning."""

    def judge(
        self, session: PeerSession, want: Want, entry: EntryT, contract: Contract, unmet: Unmet | None
    ) -> Path[EntryT]:
        """Judge a path that is new, or for which something may have changed here.

        Args:
            session: The peer.
            want: What is reached.
            entry: The source or service, as the peer offers it.
            contract: That of the topic here; of a service the transport alone.
            unmet: The condition that does not hold here, if any.
        """
        path = self.get(session.peer, want)
        if path is None:
            path = Path(session, want, entry, contract, unmet)
            self._paths.setdefault((session.peer, *want[:2]), {})[want.user] = path
        elif (path.contract, path.here) == (contract, unmet):
            return path
        path.contract, path.here = contract, unmet
        self.update(path)
        return path

    def forget(self, path: Path[EntryT]) -> None:
        """Forget a path that is not used any more; its connections stay as they are."""
        place = (path.session.peer, *path.want[:2])
        users = self._paths.get(place, {})
        users.pop(path.want.user, None)
        if not users:
            self._paths.pop(place, None)
        self._stop(path)
        self._release(path)

    def link_up(self, session: PeerSession) -> None:
        """Ask for all of a peer again; what stands goes on if the answer is the same."""
        for path in self._of_peer(session):
            self.update(path)

    def link_down(self, session: PeerSession) -> None:
        """Relay all of a peer that cannot be reached; if only its agent has died, what stands goes on."""
        for path in self._of_peer(session):
            if session.link.crashed and path.endpoint is not None:
                self._stop(path)
            else:
                self.update(path)

    def gone(self, session: PeerSession) -> None:
        """Forget a peer."""
        self._asks.pop(session.peer, None)
        for path in self._of_peer(session):
            self.forget(path)

    def _of_peer(self, session: PeerSession) -> list[Path[EntryT]]:
        return [path for path in self if path.session is session]

    def broke(self, path: Path[EntryT]) -> None:
        """Ask again for what was direct until its connection ended by itself, unless that happens all the time."""
        path.breaks.append(self._now())
        self.update(path)

    def _asked_again(self, session: PeerSession, args: dict[str, Any]) -> None:
        want = read_ask(args).want
        path = self.get(session.peer, want)
        if path is None:
            self._bridge.rpc.notify(session, f"direct.{self.kind}_release", want._asdict())
        elif path.found is not _UNSTABLE:
            path.held = True  # an earlier release may have been lost with its link
            self.update(path, pause=path.asked_at + limits.DIRECT_RETRY_PAUSE - self._now())

    def _retry(self, path: Path[EntryT]) -> None:
        path.breaks.clear()
        self.update(path)

    async def close(self) -> None:
        """Stop everything; direct connections go on."""
        self._closed = True
        for path in self:
            self._stop(path)
        await self._tasks.close()

    def _unmet(self, path: Path[EntryT]) -> Unmet | None:
        """The condition that does not hold by what is known here; ``None``: the peer decides."""
        if path.here is not None:
            return path.here
        if not path.session.linked:
            return NO_LINK
        breaks = path.breaks
        often = len(breaks) == limits.DIRECT_BREAKS and breaks[-1] - breaks[0] < limits.DIRECT_BREAKS_SPAN
        return _UNSTABLE if often else None

    def update(self, path: Path[EntryT], *, pause: float = 0.0) -> None:
        """Decide again: a fact has changed.

        Args:
            path: The path.
            pause: Seconds after which the peer is asked, if it has to be.
        """
        self._stop(path)
        if self._closed:
            return
        if (unmet := self._unmet(path)) is not None:
            self._decide(path, unmet)
        else:
            path.task = self._tasks.start(self._find(path, pause), f"direct {path.want.name}")

    async def decision(self, path: Path[EntryT]) -> None:
        """Wait for the decision, at most ``limits.DIRECT_HOLD``."""
        try:
            async with asyncio.timeout(limits.DIRECT_HOLD):
                while path.task is not None and not path.task.done():
                    await asyncio.wait([path.task])
        except TimeoutError:
            self._bridge.counters.add("direct.undecided")

    def _stop(self, path: Path[EntryT]) -> None:
        for work in (path.task, path.retry):
            if work is not None:
                work.cancel()
        path.task = path.retry = None

    async def _find(self, path: Path[EntryT], pause: float) -> None:
        found: Grant | Unmet = Unmet(Condition.AGENT, "this agent failed")
        try:
            await asyncio.sleep(pause)
            found = await self._ask(path)
            if isinstance(found, Grant):
                found = await self._reached(path, found) or found
        finally:  # of this agent's own failures, too
            if path.task is asyncio.current_task():
                path.task = None
                self._decide(path, self._unmet(path) or found)

    def _decide(self, path: Path[EntryT], found: Grant | Unmet) -> None:
        path.found, path.since = found, self._now()
        if isinstance(found, Unmet):
            self._release(path)
            if not found.lasting:
                path.retry = asyncio.get_running_loop().call_later(limits.DIRECT_RETRY, self._retry, path)
            wanted = path.contract.transport is Transport.DIRECT
            if wanted and found.condition not in {Condition.TRANSPORT, Condition.MEASURES}:
                subject = self._subject(path)
                text = f'{subject}: relayed although transport is "direct": {found.text}'
                self._on_warning("direct.relayed", f"{path.session.peer} {subject} {found.condition}", text)
        self._decided(path)

    async def _ask(self, path: Path[EntryT]) -> Grant | Unmet:
        session, want = path.session, path.want
        async with self._asks.setdefault(session.peer, asyncio.Semaphore(limits.DIRECT_ASKS)):
            broken = bool(path.breaks) and path.breaks[-1] > path.asked_at
            asked = DirectAsk(*want, path.contract if want.user else None, broken)
            path.asked_at, path.held = self._now(), True
            try:
                value = await self._bridge.rpc.request(
                    session, f"direct.{self.kind}", msgspec.to_builtins(asked), limits.DIRECT_ASK_TIMEOUT
                )
                found = read_reply(value, want.node)
                path.held = isinstance(found, Grant)
            except PeerRefused as error:
                found = Unmet(Condition.RELEASE if error.unknown else Condition.AGENT, str(error))
            except RemoteProtocolError as error:
                found = Unmet(Condition.RELEASE, f"{session.link.name}: {error}")
            except RmpaError as error:
                found = Unmet(Condition.AGENT, str(error))
            return found

    async def _reached(self, path: Path[EntryT], grant: Grant) -> Unmet | None:
        """Probe a node, once for all that ask for it at a time."""
        key = (id(path.session.link), grant.port, "" if path.want.user else path.want.name)
        task = self._probes.get(key)
        if task is None:
            task = self._probes[key] = self._tasks.start(self._probe(path, grant), f"probe {grant.node}")
            task.add_done_callback(lambda _: self._probes.pop(key, None))
        problem = await asyncio.shield(task)
        return Unmet(Condition.REACHABLE, problem) if problem else None

    def _release(self, path: Path[EntryT]) -> None:
        """Give back a grant that the peer may hold."""
        if path.held and path.session.linked:
            path.held = False
            self._bridge.rpc.notify(path.session, f"direct.{self.kind}_release", path.want._asdict())
