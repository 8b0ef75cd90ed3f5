"""What the exports and imports of topics and services do, written down in the order in which they did it."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Collection, Iterator
from types import SimpleNamespace
from typing import Any, Final, NamedTuple, cast

from rmpa.bridge.data.export import ExportFlow, ExportRoute
from rmpa.bridge.data.route import RouteBegin
from rmpa.bridge.data.route_sender import RouteSender
from rmpa.bridge.messages import Description, Message, Origin, RouteOpened, Source
from rmpa.bridge.offers import PeerRun, PeerState
from rmpa.bridge.policy import OPEN_GATE, BridgeContext, Names, PermissionGate, Policy, ServiceRules
from rmpa.bridge.services import books
from rmpa.bridge.services.bodies import LocalService
from rmpa.bridge.services.books import RemoteService
from rmpa.bridge.topics import exports as topic_exports
from rmpa.bridge.topics import imports as topic_imports
from rmpa.bridge.topics.exports import LocalSource
from rmpa.bridge.topics.import_route import RemoteTopic
from rmpa.config.peer_rules import PolicySettings
from rmpa.config.settings import LimitSettings, ServiceSettings, Settings
from rmpa.core import limits as core_limits
from rmpa.core.contract import Contract, Contracts
from rmpa.ros.wire.tcpros import ServiceDescription


class Send(NamedTuple):
    peer: int
    message: Message


class Warn(NamedTuple):
    kind: str
    who: str
    text: str


class Connect(NamedTuple):
    source: Source
    uri: str


class Disconnect(NamedTuple):
    source: Source


class AddRoute(NamedTuple):
    source: Source
    peer: int
    route: int
    contract: Contract
    epoch: int = 0
    after: int | None = None


class RemoveRoute(NamedTuple):
    source: Source
    peer: int
    route: int


class SuspendRoute(NamedTuple):
    source: Source
    peer: int
    outage: float = core_limits.RESUME_WINDOW


class Publish(NamedTuple):
    peer: int
    source: Source
    type: str
    topic: str = ""
    origin: Origin | None = None


class Retract(NamedTuple):
    peer: int
    source: Source


class Moved(NamedTuple):
    old: int
    left: Source
    new: int
    source: Source
    origin: Origin | None


class PathChanged(NamedTuple):
    peer: int
    wire: Source | str
    origin: Origin


class Describe(NamedTuple):
    peer: int
    source: Source
    route: int
    description: Description
    contract: Contract
    epoch: int = 0
    first: int = 1


class Detach(NamedTuple):
    peer: int
    source: Source
    route: int
    keep: bool = False
    missed: bool = False
    last: int | None = None


class Probe(NamedTuple):
    service: str
    server: LocalService


class ServeRoute(NamedTuple):
    peer: int
    route: int
    requests: int
    service: str
    server: LocalService
    timeout: float


class EndRoute(NamedTuple):
    peer: int
    requests: int


class ServerGone(NamedTuple):
    service: str


class Provide(NamedTuple):
    peer: int
    service: str
    node: str


class Withdraw(NamedTuple):
    peer: int
    service: str
    node: str
    reason: str


class OpenedService(NamedTuple):
    peer: int
    service: str
    route: int
    requests: int
    about: ServiceDescription | None


class EndedService(NamedTuple):
    peer: int
    service: str
    route: int
    reason: str


class ForgetAbout(NamedTuple):
    peer: int
    service: str


_EFFECTS: Final[dict[str, Callable[..., Any]]] = {
    "send": Send,
    "warn": Warn,
    "path_changed": lambda e: PathChanged(e.peer, e.wire, e.origin),
    "probe": Probe,
    "serve": lambda peer, n, r, server: ServeRoute(peer, n, r.requests, r.service, server, r.timeout),
    "end_route": EndRoute,
    "server_gone": ServerGone,
    "provide": lambda e: Provide(e.peer, e.name, e.node),
    "withdraw": lambda e, reason: Withdraw(e.peer, e.name, e.node, reason),
    "opened": lambda e: OpenedService(e.peer, e.name, e.route, e.requests, e.about),
    "ended": lambda e, route, reason: EndedService(e.peer, e.name, route, reason),
    "forget_about": lambda e: ForgetAbout(e.peer, e.name),
}
"""What is written down of each effect."""


class Out:
    """What a part of the bridge does for its exports and imports."""

    def __init__(
        self,
        context: BridgeContext,
        rng: Callable[[], float] = lambda: 1.0,
    ) -> None:
        self.context = context
        self.rng = rng
        self.serving = self
        unlinked = SimpleNamespace(link=None, linked=False)
        self.bridge = SimpleNamespace(sessions=SimpleNamespace(get=lambda _: unlinked))
        self.direct_exports = SimpleNamespace(server_gone=lambda _: None)
        self.done: list[Any] = []

    def take(self) -> list[Any]:
        """What was done since the last call."""
        done, self.done = self.done, []
        return done

    def arm_timer(self) -> None:
        """Tests ask for the time."""

    def __getattr__(self, name: str) -> Any:
        effect = _EFFECTS[name]
        return lambda *args, **how: self.done.append(effect(*args, **how))


class NotedFlow(ExportFlow):
    """A connected source: on which routes it is sent is written down."""

    def __init__(self, uri: str, new_epoch: Callable[[], int], out: Out, last: int | None) -> None:
        super().__init__(uri, new_epoch)
        self._out, self._last = out, last

    def add(self, route: ExportRoute, _link: object, begin: RouteBegin | None = None) -> RouteSender:
        assert begin is not None

        def noted(*_: object) -> None:
            after = route.position[1] if route.position is not None and begin.goes_on else None
            self._out.done.append(
                AddRoute(route.source, route.peer, route.number, route.contract, begin.epoch, after)
            )

        terms = {"epoch": begin.epoch, "contract": route.contract, "following": 0, "last": self._last}
        sender = route.sender = cast("Any", SimpleNamespace(**terms, resume=noted))
        noted()
        return cast("RouteSender", sender)

    def remove(self, route: ExportRoute) -> None:
        self._out.done.append(RemoveRoute(route.source, route.peer, route.number))
        route.sender = None


class NotedExports(topic_exports.Exports):
    """Exports whose work at the local graph is written down."""

    def __init__(self, out: Out, last: int | None) -> None:
        super().__init__(cast("Any", out))
        self._noted, self._last = out, last

    def _connect(self, source: Source, uri: str) -> ExportFlow:
        self._noted.done.append(Connect(source, uri))
        return NotedFlow(uri, self._new_epoch, self._noted, self._last)

    def _disconnect(self, source: Source, flow: ExportFlow) -> None:
        self._noted.done.append(Disconnect(source))

    def _leaves(self, _key: Source) -> bool:
        return False  # nothing is on its way of a publisher that has gone

    def _suspend(self, route: ExportRoute) -> None:
        self._noted.done.append(SuspendRoute(route.source, route.peer, route.outage))


class NotedRoute:
    """A source in the local graph: what opens its route is written down."""

    flow = publication = node = None

    def __init__(self, out: Out, entry: RemoteTopic) -> None:
        self._out, self.entry = out, entry

    def open(self, opened: RouteOpened) -> None:
        terms = (opened.contract, opened.epoch, opened.first)
        entry, about = self.entry, opened.description
        self._out.done.append(Describe(entry.peer, entry.wire, opened.route, about, *terms))


class NotedImports(topic_imports.Imports):
    """Imports whose work at the local graph is written down."""

    def __init__(self, out: Out, position: Callable[[int, Source], tuple[int, int] | None]) -> None:
        super().__init__(cast("Any", out))
        self._noted, self._had = out, position
        self._times: dict[RemoteTopic, float] = {}

    def _publish(self, entry: RemoteTopic) -> None:
        name = entry.name if entry.name != entry.wire.topic else ""
        self._noted.done.append(Publish(entry.peer, entry.wire, entry.type, name, entry.origin))
        entry.route = cast("Any", NotedRoute(self._noted, entry))

    def _unpublish(self, entry: RemoteTopic) -> None:
        self._noted.done.append(Retract(entry.peer, entry.wire))
        entry.route = None

    def _carry(self, old: RemoteTopic, new: RemoteTopic) -> None:
        self._noted.done.append(Moved(old.peer, old.wire, new.peer, new.wire, new.origin))
        route = old.route
        assert route is not None
        old.route, new.route, route.entry = None, route, new

    def _detach(self, entry: RemoteTopic, **how: Any) -> None:
        self._noted.done.append(Detach(entry.peer, entry.wire, entry.number, **how))

    def _position(self, entry: RemoteTopic) -> tuple[int, int] | None:
        return self._had(entry.peer, entry.wire)

    def _wait(self, entry: RemoteTopic, until: float) -> None:
        entry.until = until
        self._times[entry] = until

    def next_timer(self) -> float | None:
        """When the first source is to be followed again."""
        self._times = {entry: until for entry, until in self._times.items() if entry.until == until}
        return min(self._times.values(), default=None)

    def handle_timer(self, now: float) -> None:
        """Follow those whose time has come, the first ones first."""
        self.next_timer()
        for entry, until in sorted(self._times.items(), key=lambda item: item[1]):
            if until <= now and entry.until == until and entry.peer in self._peers:
                del self._times[entry]
                self.follow(entry, now)


class PeerServiceRules(ServiceRules):
    """Rules of services, with those that hold for peers."""

    def __init__(self, settings: ServiceSettings, policy: Policy, names: Names) -> None:
        super().__init__(settings)
        self.policy, self.names = policy, names


def context(
    policy: Policy | None = None,
    contracts: Contracts | None = None,
    names: Names | None = None,
    limits: LimitSettings | None = None,
    gate: PermissionGate = OPEN_GATE,
    services: ServiceRules | None = None,
) -> BridgeContext:
    """Rules of a module; those that are left out allow everything."""
    policy = policy or getattr(services, "policy", None) or Policy(PolicySettings())
    names = names or getattr(services, "names", None) or Names()
    rules = services or ServiceRules(ServiceSettings())
    settings = Settings(limits=limits or LimitSettings())
    return BridgeContext(settings, policy, rules, names, contracts or Contracts(), gate)


_STEPS: Final = {"advertise", "reload", "gone"}
"""Methods whose work is done as their items are taken; in some books they do it at once."""


_QUESTIONS: Final = {"get", "next_timer", "offer", "contract", "description", "route", "routes", "shown", "decision"}
"""Methods that may answer ``None``."""


class Recorded:
    """A book whose methods return what was done by them; questions are answered."""

    questions = _QUESTIONS
    forgets = "link_down"

    def __init__(self, book: Any, out: Out) -> None:
        self.book = book
        self.out = out
        self.known: dict[int, PeerRun] = {}

    def __iter__(self) -> Iterator[Any]:
        return iter(self.book)

    def __getattr__(self, name: str) -> Any:
        value = getattr(self.book, name)
        if not callable(value) or name in self.questions:
            return value

        def call(*args: Any, **named: Any) -> Any:
            result = value(*args, **named)
            if result is not None and name not in _STEPS:
                return result
            for _ in result if result is not None else ():
                pass
            return self.out.take()

        return call

    def link_up(self, peer: int, name: str = "", instance: str = "", rank: int = 0) -> list[Any]:
        """A peer has a link."""
        known = self.known.setdefault(peer, PeerRun(peer=peer, name=name, instance=instance))
        known.name, known.instance, known.rank = name, instance, rank
        known.state, known.silent = PeerState.LINKED, False
        self.book.link_up(known)
        return self.out.take()

    def link_down(self, peer: int) -> list[Any]:
        """A peer has no link any more."""
        self.gone_away(peer)
        if self.forgets != "link_down":
            self.known.pop(peer, None)
        deque(getattr(self.book, self.forgets)(peer) or (), 0)
        return self.out.take()

    def gone_away(self, peer: int, *, silent: bool = False) -> None:
        if (known := self.known.get(peer)) is not None:
            known.state, known.silent = PeerState.AWAY, known.silent or silent

    def entry(self, peer: int, what: Any) -> Any:
        """An entry that is there."""
        found = self.book.get(peer, what)
        assert found is not None
        return found

    def advertised(self, peer: int, message: Any, now: float = 0.0) -> list[Any]:
        """Take a whole advertisement."""
        for wire, offer in self.book.changes(peer, message):
            self.book.take_in(peer, wire, offer, now)
        return self.out.take()

    def rejudge(self, rules: BridgeContext, *now: float) -> Iterator[list[Any]]:
        """Take new rules: what is done at once, and with each item."""
        self.out.context = rules
        steps = self.book.reload(*now)
        yield self.out.take()
        for _ in steps:
            yield self.out.take()
        yield self.out.take()


class Exports(Recorded):
    questions = _QUESTIONS | {"local", "of"}
    forgets = "gone"

    def __init__(
        self,
        policy: Policy | None = None,
        contracts: Contracts | None = None,
        names: Names | None = None,
        limit_settings: LimitSettings | None = None,
        last: int | None = None,
        gate: PermissionGate = OPEN_GATE,
    ) -> None:
        out = Out(context(policy, contracts, names, limit_settings, gate))
        super().__init__(NotedExports(out, last), out)

    def graph(self, topic: str, publishers: dict[str, LocalSource]) -> list[Any]:
        """Set a topic's publishers, by node."""
        self.book.look(topic, publishers)
        return self.out.take()

    def link_away(self, peer: int) -> tuple[list[Any], bool]:
        """What is done, and whether a route waits."""
        self.gone_away(peer)
        self.book.link_away(peer)
        return self.out.take(), self.book.outage(peer) > 0

    def flowing(self, source: Source) -> tuple[int, ...]:
        """The peers to which a source's data is sent now."""
        return tuple(peer for peer, route in self.book.routes(source).items() if route.flows)

    def contract(self, source: Source, peer: int) -> Contract:
        """The contract of a route."""
        found: Contract = self.book.routes(source)[peer].contract
        return found

    def given_up(self, source: Source, peer: int) -> list[Any]:
        """A route is not kept any more."""
        if (route := self.book.routes(source).get(peer)) is not None:
            self.book.given_up(route)
        return self.out.take()

    def apply_rules(
        self,
        policy: Policy,
        contracts: Contracts | None = None,
        names: Names | None = None,
        limits: LimitSettings | None = None,
    ) -> list[Any]:
        rules = context(policy, contracts, names, limits, self.out.context.gate)
        return [done for some in self.rejudge(rules) for done in some]


class Imports(Recorded):
    forgets = "forget"

    def __init__(
        self,
        policy: Policy | None = None,
        rng: Callable[[], float] = lambda: 1.0,
        contracts: Contracts | None = None,
        position: Callable[[int, Source], tuple[int, int] | None] = lambda *_: None,
        names: Names | None = None,
        limit_settings: LimitSettings | None = None,
        gate: PermissionGate = OPEN_GATE,
    ) -> None:
        out = Out(context(policy, contracts, names, limit_settings, gate), rng)
        super().__init__(NotedImports(out, position), out)

    def link_away(self, peer: int, *, briefly: bool = False) -> tuple[list[Any], bool]:
        """What is done, and whether a source waits."""
        self.gone_away(peer, silent=briefly)
        self.book.link_away(peer, briefly=briefly)
        return self.out.take(), bool(self.book._peers[peer].entries)

    def demand(self, peer: int, source: Source, now: float, *, wanted: bool) -> list[Any]:
        """A local node wants a source, or none does."""
        if (entry := self.book.get(peer, source)) is not None:
            self.book.demand(entry, now, wanted=wanted)
        return self.out.take()

    def refused_nodes(self, peer: int) -> dict[str, list[Source]]:
        """The sources that wait for a place, by node."""
        return {node: [one.wire for one in waiting] for node, waiting in self.book.refused_nodes(peer).items()}

    def apply_rules(
        self,
        policy: Policy,
        contracts: Contracts | None = None,
        names: Names | None = None,
        now: float = 0.0,
        limits: LimitSettings | None = None,
    ) -> Iterator[list[Any]]:
        return self.rejudge(context(policy, contracts, names, limits, self.out.context.gate), now)


class ServiceExports(Recorded):
    questions = _QUESTIONS | {"local"}

    def __init__(
        self, rules: ServiceRules, limit_settings: LimitSettings | None = None, gate: PermissionGate = OPEN_GATE
    ) -> None:
        out = Out(context(limits=limit_settings, gate=gate, services=rules))
        super().__init__(books.ServiceExports(cast("Any", out)), out)

    def apply_rules(self, rules: ServiceRules, limits: LimitSettings | None = None) -> Iterator[list[Any]]:
        return self.rejudge(context(limits=limits, gate=self.out.context.gate, services=rules))

    def graph(self, service: str, server: LocalService | None) -> list[Any]:
        """Set a service's server."""
        self.book.put(service, server)
        return self.out.take()


class ServiceImports(Recorded):
    def gone(self, peer: int, keep: Collection[str] = ()) -> list[Any]:
        """A peer does not come back."""
        self.gone_away(peer)
        deque(self.book.gone(peer, keep), 0)
        return self.out.take()

    def __init__(
        self, rules: ServiceRules, limit_settings: LimitSettings | None = None, gate: PermissionGate = OPEN_GATE
    ) -> None:
        out = Out(context(limits=limit_settings, gate=gate, services=rules))
        super().__init__(books.ServiceImports(cast("Any", out)), out)

    def hidden(self, remote: RemoteService) -> str:
        """Why a service is not shown."""
        why, _ = self.book.why_hidden(remote)
        assert remote.shown is not bool(why)
        return str(why)

    def refused_nodes(self, peer: int) -> dict[str, list[str]]:
        """The services that wait for a place, by node."""
        return {node: [one.name for one in waiting] for node, waiting in self.book.refused_nodes(peer).items()}

    def apply_rules(self, rules: ServiceRules, limits: LimitSettings | None = None) -> Iterator[list[Any]]:
        return self.rejudge(context(limits=limits, gate=self.out.context.gate, services=rules), 0.0)
