"""Which sources of the peers appear in the local graph, and which routes are open for them.

Sans-I/O: the driver tells what peers say and whether somebody local listens; it gets back actions. Each source
of each peer is in one state of this table::

    idle ──wanted──► opening ──opened──► open ──unwanted──► lingering ──time──► idle
      ▲                 │ closed, time      │ closed             │ wanted
      │ unwanted        ▼                   ▼                    ▼
      └────────────── waiting ◄────────────────                 open
                        │ time ──► opening
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from enum import Enum, auto
from typing import TYPE_CHECKING, Final

from rmpa.bridge.actions import Action, Describe, Detach, Publish, Retract, Send, Warn
from rmpa.bridge.messages import Advertise, Close, Closed, Mismatch, Offer, Open, Opened, Source
from rmpa.core import limits
from rmpa.core.backoff import Backoff
from rmpa.core.clock import earliest
from rmpa.core.contract import Contract, Contracts, Reliability
from rmpa.core.errors import LocalProtocolError

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping

    from rmpa.bridge.messages import Description
    from rmpa.bridge.policy import Policy


class RouteState(Enum):
    """Where a remote source's route stands."""

    IDLE = auto()
    """Visible in the local graph, nobody listens."""
    OPENING = auto()
    """Asked for, not answered."""
    OPEN = auto()
    """Data flows."""
    LINGERING = auto()
    """Data flows, though nobody listens; perhaps somebody comes back."""
    WAITING = auto()
    """It was closed although somebody listens; it will be asked for again."""


_S = RouteState
TRANSITIONS: Final[Mapping[RouteState, frozenset[RouteState]]] = {
    _S.IDLE: frozenset({_S.OPENING}),
    _S.OPENING: frozenset({_S.OPEN, _S.WAITING, _S.IDLE}),
    _S.OPEN: frozenset({_S.LINGERING, _S.WAITING}),
    _S.LINGERING: frozenset({_S.OPEN, _S.IDLE}),
    _S.WAITING: frozenset({_S.OPENING, _S.IDLE}),
}


@dataclass(slots=True)
class Import:
    """One source of one peer, as we see it.

    Args:
        type: Its message type.
        backoff: Delays between attempts.
        shown: Whether it is in the local graph.
        hidden: Why it is not, or empty.
        conflict: Whether that is because a local node publishes the topic with another type.
        state: Where its route stands.
        route: The route's id while it is asked for or open, else 0.
        timer: When the state is looked at again, monotonic seconds.
        description: What its messages are, once known.
        problem: Why the last attempt failed, or empty.
        wanted: Whether somebody local listens.
        contract: What holds for its route, once it was open.
    """

    type: str
    backoff: Backoff
    shown: bool = False
    hidden: str = ""
    conflict: bool = False
    state: RouteState = RouteState.IDLE
    route: int = 0
    timer: float | None = None
    description: Description | None = None
    problem: str = ""
    wanted: bool = False
    contract: Contract | None = None


def _nothing(_peer: int, _source: Source) -> None:
    """Nothing outlives its link."""


_LISTENED: Final = frozenset({RouteState.OPENING, RouteState.OPEN, RouteState.WAITING})


class Imports:
    """The inbound half of the bridge.

    Args:
        policy: What may cross; the receiving side judges too.
        rng: Uniform numbers in [0, 1) for the back-off's jitter.
        contracts: What our side asks for.
        position: ``(peer, source)``: epoch and last message of a reliable route that outlived its link, or ``None``.
    """

    def __init__(
        self,
        policy: Policy,
        rng: Callable[[], float],
        contracts: Contracts | None = None,
        position: Callable[[int, Source], tuple[int, int] | None] = _nothing,
    ) -> None:
        self._policy = policy
        self._rng = rng
        self._contracts = contracts if contracts is not None else Contracts()
        self._position = position
        self._peers: dict[int, dict[Source, Import]] = {}
        self._away: set[int] = set()
        self._routes: dict[int, dict[int, Source]] = {}
        self._next_route: dict[int, int] = {}
        self._nodes: dict[int, Counter[str]] = {}
        self._local_types: dict[str, str] = {}
        self._timed: set[tuple[int, Source]] = set()

    def __iter__(self) -> Iterator[tuple[int, Source, Import]]:
        """Every known source, with its peer."""
        for peer, sources in self._peers.items():
            for source, entry in sources.items():
                yield peer, source, entry

    def get(self, peer: int, source: Source) -> Import | None:
        """One known source."""
        return self._peers.get(peer, {}).get(source)

    def local_types(self, types: Mapping[str, str]) -> list[Action]:
        """The types of the topics that local nodes publish; a remote source of another type stays hidden."""
        if self._local_types == types:
            return []
        self._local_types = dict(types)
        actions: list[Action] = []
        for peer, source, entry in self:
            shown = entry.shown
            actions += self._show_or_hide(peer, source, entry)
            if shown and not entry.shown:
                actions += self._report_conflict(peer, source, entry)
        return actions

    def link_up(self, peer: int) -> list[Action]:
        """A link is up, perhaps of a peer that was away; its first message will be a full advertisement."""
        self._away.discard(peer)
        self._peers.setdefault(peer, {})
        self._routes[peer] = {}
        self._next_route[peer] = 1
        self._nodes.setdefault(peer, Counter())
        return []

    def link_away(self, peer: int, *, briefly: bool = False) -> tuple[list[Action], bool]:
        """A link is gone, but its peer may come back: what does not need a reliable route leaves the local graph.

        Args:
            peer: Whose.
            briefly: Nothing leaves yet: the link fell silent, and most of those are back at once. Called again
                without this when the time is over.

        Returns:
            What to do, and whether something waits for the peer: if nothing does, ``link_down`` it.
        """
        actions: list[Action] = []
        self._away.add(peer)
        self._routes[peer] = {}
        for source, entry in list(self._peers[peer].items()):
            reliable = entry.contract is not None and entry.contract.reliability is Reliability.RELIABLE
            keep = briefly or (reliable and entry.wanted and entry.state in _LISTENED)
            if entry.route:
                actions.append(Detach(peer, source, entry.route, keep=keep))
            entry.route = 0
            self._timed.discard((peer, source))
            if keep:
                self._suspend(peer, source, entry)
            else:
                actions += self._drop(peer, source, entry)
        return actions, bool(self._peers[peer])

    def _suspend(self, peer: int, source: Source, entry: Import) -> None:
        """Bring an entry into a state without a link."""
        entry.problem = "its peer is away"
        if entry.state is RouteState.LINGERING:
            self._move(peer, source, entry, RouteState.IDLE)
        elif entry.state in {RouteState.OPEN, RouteState.OPENING}:
            self._move(peer, source, entry, RouteState.WAITING)
        entry.timer = None

    def link_down(self, peer: int) -> list[Action]:
        """A link is gone: all that came over it leaves the local graph."""
        actions: list[Action] = []
        sources = self._peers.pop(peer, {})
        for source, entry in sources.items():
            self._timed.discard((peer, source))
            if entry.route:
                actions.append(Detach(peer, source, entry.route))
            if entry.shown:
                actions.append(Retract(peer, source))
        self._away.discard(peer)
        self._routes.pop(peer, None)
        self._next_route.pop(peer, None)
        self._nodes.pop(peer, None)
        return actions

    def advertised(self, peer: int, message: Advertise, now: float = 0.0) -> list[Action]:
        """A peer says what it publishes."""
        known = self._peers[peer]
        removed = list(message.removed)
        if message.full:
            offered = {offer.source for offer in message.added}
            removed += [source for source in known if source not in offered]
        actions: list[Action] = []
        for source in removed:
            actions += self._forget(peer, source)
        for offer in message.added:
            actions += self._learn(peer, offer)
        if message.full:
            actions += self._go_on(peer, now)
        return actions

    def _go_on(self, peer: int, now: float) -> list[Action]:
        """A peer is back: ask again for what its link took away."""
        actions: list[Action] = []
        for source, entry in self._peers[peer].items():
            if entry.state is RouteState.WAITING and entry.timer is None:
                actions += self._open(peer, source, entry, now)
        return actions

    def opened(self, peer: int, message: Opened, now: float) -> list[Action]:
        """A route that we asked for is open; one that we closed meanwhile is ignored."""
        source = self._routes[peer].get(message.route)
        entry = self._peers[peer].get(source) if source is not None else None
        if source is None or entry is None or entry.state is not RouteState.OPENING:
            return []
        if message.description.type != entry.type:
            self._routes[peer].pop(message.route)
            why = f"it is offered as {entry.type}, but its publisher sends {message.description.type}"
            fail = self._fail(peer, source, entry, why, now)
            return [Send(peer, Close(message.route)), Warn("mismatch.type", str(source), f"{source}: {why}"), *fail]
        self._move(peer, source, entry, RouteState.OPEN)
        entry.problem = ""
        entry.backoff.reset()
        entry.description = message.description
        entry.contract = message.contract
        terms = (message.contract, message.epoch, message.first)
        return [Describe(peer, source, message.route, message.description, *terms)]

    def closed(self, peer: int, message: Closed, now: float) -> list[Action]:
        """The other side has no such route, or no longer."""
        source = self._routes[peer].pop(message.route, None)
        entry = self._peers[peer].get(source) if source is not None else None
        if source is None or entry is None:
            return []
        return self._fail(peer, source, entry, message.reason, now)

    def demand(self, peer: int, source: Source, now: float, *, wanted: bool) -> list[Action]:
        """Somebody local listens to a source, or nobody does any more."""
        entry = self.get(peer, source)
        if entry is None:
            return []
        entry.wanted = wanted
        if wanted:
            if entry.state is RouteState.IDLE:
                return self._open(peer, source, entry, now)
            if entry.state is RouteState.LINGERING:
                self._move(peer, source, entry, RouteState.OPEN)
            return []
        if entry.state is RouteState.OPEN:
            self._move(peer, source, entry, RouteState.LINGERING, now + limits.ROUTE_LINGER)
            return []
        if entry.state in {RouteState.OPENING, RouteState.WAITING}:
            return self._close(peer, source, entry)
        return []

    def mismatched(self, peer: int, source: Source, subscriber: str, text: str) -> list[Action]:
        """A local node was refused because its definition is another one: say so here and over there."""
        return [
            Warn("mismatch.md5", str(source), text),
            Send(peer, Mismatch(source.topic, source.node, subscriber, text)),
        ]

    def next_timer(self) -> float | None:
        """When ``handle_timer`` is due."""
        return earliest(*(self._peers[peer][source].timer for peer, source in self._timed))

    def handle_timer(self, now: float) -> list[Action]:
        """Do what is due."""
        actions: list[Action] = []
        for peer, source in sorted(self._timed):
            entry = self._peers[peer][source]
            if entry.timer is None or entry.timer > now:
                continue
            if entry.state is RouteState.LINGERING:
                actions += self._close(peer, source, entry)
            elif entry.state is RouteState.OPENING:
                self._routes[peer].pop(entry.route, None)
                actions.append(Send(peer, Close(entry.route)))
                actions += self._fail(peer, source, entry, "the peer has not answered", now)
            elif entry.state is RouteState.WAITING:
                actions += self._open(peer, source, entry, now)
        return actions

    def _learn(self, peer: int, offer: Offer) -> list[Action]:
        known = self._peers[peer]
        source = offer.source
        actions: list[Action] = []
        if source in known:
            if known[source].type == offer.type:
                return []
            actions += self._forget(peer, source)
        elif len(known) >= limits.TOPICS_PER_PEER_MAX:
            return [
                Warn("topics.too_many", str(peer), f"a peer offers more than {limits.TOPICS_PER_PEER_MAX} topics")
            ]
        nodes = self._nodes[peer]
        if source.node not in nodes and len(nodes) >= limits.NODES_PER_PEER_MAX:
            return [
                Warn(
                    "nodes.too_many",
                    str(peer),
                    f"a peer offers topics of more than {limits.NODES_PER_PEER_MAX} nodes; the rest stays hidden: "
                    "deny some by bridge.deny over there",
                )
            ]
        nodes[source.node] += 1
        backoff = Backoff(limits.BACKOFF_FIRST, limits.BACKOFF_MAX, self._rng)
        entry = known[source] = Import(offer.type, backoff)
        actions += self._show_or_hide(peer, source, entry)
        return actions + self._report_conflict(peer, source, entry)

    def _show_or_hide(self, peer: int, source: Source, entry: Import) -> list[Action]:
        entry.hidden, entry.conflict = self._why_hidden(source, entry.type)
        if entry.shown is not bool(entry.hidden):
            return []
        if not entry.hidden:
            entry.shown = True
            return [Publish(peer, source, entry.type)]
        entry.shown = False
        entry.wanted = False
        return [*self._close(peer, source, entry), Retract(peer, source)]

    def _report_conflict(self, peer: int, source: Source, entry: Import) -> list[Action]:
        """Say loudly, on both sides, that a local topic of another type is in the way."""
        if not entry.conflict:
            return []
        return [
            Warn("mismatch.type", str(source), f"{source}: {entry.hidden}"),
            Send(peer, Mismatch(source.topic, source.node, "", entry.hidden)),
        ]

    def _why_hidden(self, source: Source, type_name: str) -> tuple[str, bool]:
        decision = self._policy.judge(source.topic, type_name, source.node)
        if not decision.allowed:
            return decision.rule, False
        local = self._local_types.get(source.topic, type_name)
        if local == type_name:
            return "", False
        why = f"its type is {type_name}, but a local node publishes {source.topic} as {local}; "
        return why + "rename one of the topics or use one type", True

    def _forget(self, peer: int, source: Source) -> list[Action]:
        entry = self._peers[peer].get(source)
        if entry is None:
            return []
        return self._close(peer, source, entry) + self._drop(peer, source, entry)

    def _drop(self, peer: int, source: Source, entry: Import) -> list[Action]:
        actions: list[Action] = [Retract(peer, source)] if entry.shown else []
        del self._peers[peer][source]
        nodes = self._nodes[peer]
        nodes[source.node] -= 1
        if not nodes[source.node]:
            del nodes[source.node]
        return actions

    def _move(self, peer: int, source: Source, entry: Import, state: RouteState, timer: float | None = None) -> None:
        """Change a state as the table allows."""
        if state not in TRANSITIONS[entry.state]:
            raise LocalProtocolError(f"{entry.state.name} does not lead to {state.name}")
        entry.state = state
        entry.timer = timer
        if timer is None:
            self._timed.discard((peer, source))
        else:
            self._timed.add((peer, source))

    def _open(self, peer: int, source: Source, entry: Import, now: float) -> list[Action]:
        if peer in self._away:
            self._move(peer, source, entry, RouteState.OPENING)
            self._move(peer, source, entry, RouteState.WAITING)
            return []
        route = self._next_route[peer]
        self._next_route[peer] = route + 1
        self._routes[peer][route] = source
        entry.route = route
        self._move(peer, source, entry, RouteState.OPENING, now + limits.ROUTE_OPEN_TIMEOUT)
        contract = self._contracts.of(source.topic, entry.type)
        epoch, after = self._position(peer, source) or (0, 0)
        return [Send(peer, Open(route, source.topic, source.node, contract, epoch, after))]

    def _close(self, peer: int, source: Source, entry: Import) -> list[Action]:
        """Leave a source alone, whatever its state."""
        actions: list[Action] = []
        if entry.route:
            self._routes[peer].pop(entry.route, None)
            actions += [Send(peer, Close(entry.route)), Detach(peer, source, entry.route)]
        entry.route = 0
        entry.backoff.reset()
        if entry.state is RouteState.OPEN:
            self._move(peer, source, entry, RouteState.LINGERING)
        if entry.state is not RouteState.IDLE:
            self._move(peer, source, entry, RouteState.IDLE)
        return actions

    def _fail(self, peer: int, source: Source, entry: Import, reason: str, now: float) -> list[Action]:
        actions: list[Action] = [Detach(peer, source, entry.route)]
        entry.route = 0
        entry.problem = reason
        if entry.state is RouteState.LINGERING:
            self._move(peer, source, entry, RouteState.IDLE)
        else:
            self._move(peer, source, entry, RouteState.WAITING, now + entry.backoff.delay())
        return actions
