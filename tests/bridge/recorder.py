"""What the exports and imports of topics and services do, written down in the order in which they did it."""

from __future__ import annotations

from types import SimpleNamespace
from typing import TYPE_CHECKING, Any, Final, NamedTuple

from rmpa.bridge.context import BridgeContext, Names, ServiceRules
from rmpa.bridge.data.route import RouteBegin
from rmpa.bridge.messages import Source
from rmpa.bridge.offers import Effects
from rmpa.bridge.policy import OPEN_GATE, PermissionGate, Policy
from rmpa.bridge.services import books
from rmpa.bridge.topics import exports as topic_exports
from rmpa.bridge.topics import imports as topic_imports
from rmpa.config.peer_rules import PolicySettings
from rmpa.config.settings import LimitSettings, ServiceSettings, Settings
from rmpa.core import limits as core_limits
from rmpa.core.contract import Contract, Contracts

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from rmpa.bridge.messages import Description, Message, Origin, RouteOpened
    from rmpa.bridge.services.bodies import LocalService
    from rmpa.bridge.services.books import RemoteService
    from rmpa.bridge.topics.exports import ExportRoute, LocalSource
    from rmpa.bridge.topics.imports import RemoteTopic
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


def _detached(entry: RemoteTopic, **how: Any) -> Detach:
    return Detach(entry.peer, entry.wire, entry.route, **how)


def _described(entry: RemoteTopic, opened: RouteOpened) -> Describe:
    terms = (opened.contract, opened.epoch, opened.first)
    return Describe(entry.peer, entry.wire, opened.route, opened.description, *terms)


_EFFECTS: Final[dict[str, Callable[..., Any]]] = {
    "send": Send,
    "warn": Warn,
    "connect": Connect,
    "disconnect": Disconnect,
    "add_route": lambda s, peer, r, b: AddRoute(
        s, peer, r.number, r.contract, b.epoch, r.position[1] if r.position is not None and b.goes_on else None
    ),
    "remove_route": RemoveRoute,
    "suspend_route": SuspendRoute,
    "publish": lambda e: Publish(e.peer, e.wire, e.type, e.name if e.name != e.wire.topic else "", e.origin),
    "retract": lambda e: Retract(e.peer, e.wire),
    "moved": lambda old, new: Moved(old.peer, old.wire, new.peer, new.wire, new.origin),
    "path_changed": lambda e: PathChanged(e.peer, e.wire, e.origin),
    "describe": _described,
    "detach": _detached,
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


class Out(Effects):
    """What a part of the bridge does for its exports and imports."""

    def __init__(
        self,
        context: BridgeContext,
        rng: Callable[[], float] = lambda: 1.0,
        position: Callable[[int, Source], tuple[int, int] | None] = lambda *_: None,
        numbering: Callable[[Source, int], Any] = lambda *_: None,
    ) -> None:
        self.rules = context
        self.rng = rng
        self._numbering = numbering
        self.outbound = self.serving = self
        self.direct_exports = SimpleNamespace(server_gone=lambda _: None)
        self.done: list[Any] = []
        self.epochs: dict[Source, int] = {}
        self._position = position

    @property
    def context(self) -> BridgeContext:
        return self.rules

    def last(self, source: Source, peer: int) -> int | None:
        numbering = self._numbering(source, peer)
        return numbering.last if numbering is not None else None

    def begins(self, source: Source, peer: int, route: ExportRoute) -> RouteBegin:
        """Each source has one numbering, which begins when it is connected; suspended senders say where they are."""
        numbering = self._numbering(source, peer)
        epoch = self.epochs.setdefault(source, len(self.epochs) + 1)
        if route.position is None or route.position[0] != epoch:
            return RouteBegin(epoch, 1)
        following = numbering.following if numbering is not None else 0
        return RouteBegin(epoch, max(following, route.position[1] + 1), goes_on=True)

    def take(self) -> list[Any]:
        """What was done since the last call."""
        done, self.done = self.done, []
        return done

    def position(self, entry: RemoteTopic) -> tuple[int, int] | None:
        return self._position(entry.peer, entry.wire)

    def __getattribute__(self, name: str) -> Any:
        effect = _EFFECTS.get(name)
        if effect is None:
            return super().__getattribute__(name)
        return lambda *args, **how: self.done.append(effect(*args, **how))


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


_STEPS: Final = {"advertise", "link_away", "link_down", "reload", "gone"}
"""Methods whose work is done as their items are taken; in some books they do it at once."""


_QUESTIONS: Final = {"get", "next_timer", "offer", "contract", "description", "source", "shown", "decision"}
"""Methods that may answer ``None``."""


class Recorded:
    """A book whose methods return what was done by them; questions are answered."""

    questions = _QUESTIONS

    def __init__(self, book: Any, out: Out) -> None:
        self.book = book
        self.out = out

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
        self.out.rules = rules
        steps = self.book.reload(*now)
        yield self.out.take()
        for _ in steps:
            yield self.out.take()
        yield self.out.take()


class Exports(Recorded):
    questions = _QUESTIONS | {"local"}

    def __init__(
        self,
        policy: Policy | None = None,
        contracts: Contracts | None = None,
        names: Names | None = None,
        limit_settings: LimitSettings | None = None,
        numbering: Callable[[Source, int], Any] = lambda *_: None,
        gate: PermissionGate = OPEN_GATE,
    ) -> None:
        out = Out(context(policy, contracts, names, limit_settings, gate), numbering=numbering)
        super().__init__(topic_exports.Exports(out), out)

    @property
    def topics(self) -> set[str]:
        """The topics that the graph has."""
        return {source.topic for source in self.book.seen}

    def graph(self, topic: str, publishers: dict[str, LocalSource]) -> list[Any]:
        """Set a topic's publishers, by node."""
        before = [source.node for source in self.book.seen if source.topic == topic]
        for node in dict.fromkeys((*before, *publishers)):
            self.book.put(Source(topic, node), publishers.get(node))
        return self.out.take()

    def link_away(self, peer: int) -> tuple[list[Any], bool]:
        """What is done, and whether a route waits."""
        for _ in self.book.link_away(peer):
            pass
        return self.out.take(), self.book.outage(peer) > 0

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
        out = Out(context(policy, contracts, names, limit_settings, gate), rng, position)
        super().__init__(topic_imports.Imports(out), out)

    def link_away(self, peer: int, *, briefly: bool = False) -> tuple[list[Any], bool]:
        """What is done, and whether a source waits."""
        for _ in self.book.link_away(peer, briefly=briefly):
            pass
        return self.out.take(), bool(self.book._peers[peer].entries)

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
        super().__init__(books.ServiceExports(out), out)

    def apply_rules(self, rules: ServiceRules, limits: LimitSettings | None = None) -> Iterator[list[Any]]:
        return self.rejudge(context(limits=limits, gate=self.out.context.gate, services=rules))

    def graph(self, service: str, server: LocalService | None) -> list[Any]:
        """Set a service's server."""
        self.book.put(service, server)
        return self.out.take()


class ServiceImports(Recorded):
    def __init__(
        self, rules: ServiceRules, limit_settings: LimitSettings | None = None, gate: PermissionGate = OPEN_GATE
    ) -> None:
        out = Out(context(limits=limit_settings, gate=gate, services=rules))
        super().__init__(books.ServiceImports(out), out)

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
