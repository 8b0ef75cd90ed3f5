"""Modules that negotiate direct transport in made-up time: the machines of both sides, and models of their nodes.

The drivers do what ``bridge.topics.io.direct_importer`` and ``direct_exporter`` do, with nodes that are values.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Final

from rmpa.bridge import limits
from rmpa.bridge.direct.conditions import Condition, Grant, Unmet
from rmpa.bridge.direct.direct_route import Ask, Decided, DirectKey, HangUp, Move, Path, ProbeNode, Release
from rmpa.bridge.direct.publisher_side import DirectGrants, EndConnections, Granted, Retry, WithdrawGrant
from rmpa.bridge.direct.subscriber_side import DirectSubscriptions
from rmpa.core.contract import Contract, Transport

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable

    from rmpa.bridge.direct.direct_route import DirectAction
    from rmpa.bridge.direct.publisher_side import GrantAction
    from rmpa.bridge.messages import Source
    from tests.simulation.network import World

AUTO: Final = Contract(transport=Transport.AUTO)
RELAYED: Final = Unmet(Condition.TRANSPORT, "relay")


class Channel:
    """The control frames of one link, both ways: in order, each after a random delay, none behind the link's end."""

    def __init__(self, world: World) -> None:
        self._world = world
        self._last = [0.0, 0.0]
        self.up = True

    def send(self, way: int, deliver: Callable[[], None]) -> None:
        """Deliver a message in the direction ``way``, 0 or 1."""
        when = self._world.now + self._world.rng.choice([0.0005, 0.005, 0.05]) * self._world.rng.random()
        self._last[way] = when = max(when, self._last[way])
        self._world.at(when, lambda: deliver() if self.up else None)


@dataclass
class Talker:
    """A publisher's node."""

    source: Source
    port: int
    up: bool = True
    reachable: bool = True
    network: bool = True
    """Whether it listens for other machines."""
    latched: bool = False

    @property
    def uri(self) -> str:
        return f"http://t:{self.port}/"


@dataclass
class Listener:
    """A subscriber's node: its connections to each source are ``"relay"`` or a port."""

    name: str
    leaves: bool
    """Whether it hangs up on publishers that the master does not name, as roscpp does."""
    paths: dict[Source, list[str | int]] = field(default_factory=dict)


class PublisherModule:
    """The module of the talkers: its grants, its local subscribers and its rules."""

    def __init__(self, world: World, talkers: Iterable[Talker]) -> None:
        self.world = world
        self.talkers = {one.source: one for one in talkers}
        self.grants = DirectGrants()
        self.local: set[str] = set()
        self.allowed = True
        self.offered = set(self.talkers)
        self.peers: dict[int, SubscriberModule] = {}

    def unmet(self, source: Source, peer: int, name: str) -> Unmet | None:
        """As ``DirectExporter._unmet``."""
        if source not in self.offered or not self.talkers[source].up:
            return Unmet(Condition.OFFERED, "not offered")
        if not self.allowed:
            return RELAYED
        return self.grants.judge(peer, source, name, self.local)

    def asked(self, peer: int, channel: Channel, source: Source, name: str, reply: Callable[[object], None]) -> None:
        """Answer ``direct.open`` as ``DirectExporter._find``: the node is asked in between."""

        def refuse(unmet: Unmet) -> None:
            self.act(self.grants.refused(peer, source, name))
            channel.send(1, lambda: reply(unmet))

        def found() -> None:
            talker = self.talkers[source]
            if not channel.up:
                return  # the handlers of an ended link are cancelled
            problem = None if talker.network else Unmet(Condition.LISTENING, "loopback")
            problem = problem or self.unmet(source, peer, name)
            if problem is None and talker.uri != uri:
                problem = Unmet(Condition.NODE, "restarted")
            if problem is not None:
                refuse(problem)
                return
            self.grants.grant(peer, source, name, Granted(AUTO, talker.port, uri))
            grant = Grant(talker.port, source.node)
            channel.send(1, lambda: reply(grant))

        unmet = self.unmet(source, peer, name)
        if unmet is not None:
            refuse(unmet)
            return
        uri = self.talkers[source].uri
        self.world.after(self.world.rng.choice([0.001, 0.02]), found)

    def act(self, actions: Iterable[GrantAction]) -> None:
        """Send the notifications, end connections."""
        for action in actions:
            module = self.peers.get(action.peer)
            if module is None:
                continue
            match action:
                case EndConnections(port=port):
                    module.end_all(port)
                case WithdrawGrant(source=source, subscriber=name, unmet=unmet):
                    module.tell(lambda m=module, s=source, n=name, u=unmet: m.withdrawn(s, n, u))  # type: ignore[misc]
                case Retry(source=source):
                    module.tell(lambda m=module, s=source: m.retried(s))  # type: ignore[misc]

    def advertise(self) -> None:
        """Compare what is offered with the registrations, a little later than these."""
        now = {source for source, one in self.talkers.items() if one.up}
        changed, self.offered = now ^ self.offered, now
        for module in set(self.peers.values()):
            for source in sorted(changed):
                module.tell(lambda m=module, s=source, on=source in now: m.advertised(s, shown=on))  # type: ignore[misc]


class SubscriberModule:
    """A module with listeners: its decisions, and the calls that carry them out."""

    def __init__(self, world: World, name: str, there: PublisherModule) -> None:
        self.world = world
        self.name = name
        self.there = there
        self.routes = self._machine()
        self.listeners: dict[str, Listener] = {}
        self.allowed = True
        self.channel: Channel | None = None
        self.here = 0
        """The number of the publisher's module in this agent."""
        self.there_number = 0
        """The number of this run in the publisher's agent."""
        self.shown: set[Source] = set()
        self.strays: dict[tuple[Source, str], int] = {}
        self._busy: dict[DirectKey, list[Callable[[Callable[[], None]], None]]] = {}
        self._waiting: dict[DirectKey, list[Callable[[], None]]] = {}
        self._life = 0

    def _machine(self) -> DirectSubscriptions:
        return DirectSubscriptions(lambda key: self.there.talkers[key.source].latched, self._is_relayed)

    def _is_relayed(self, key: DirectKey) -> bool:
        listener = self.listeners.get(key.subscriber)
        return listener is not None and "relay" in listener.paths.get(key.source, [])

    def paths(self, source: Source, name: str) -> list[str | int]:
        """The connections of a listener to a source."""
        return self.listeners[name].paths.setdefault(source, []) if name in self.listeners else []

    def tell(self, deliver: Callable[[], None]) -> None:
        """Deliver a notification of the publisher's agent over the present link."""
        if self.channel is not None:
            self.channel.send(1, deliver)

    # --- what happens ----------------------------------------------------------------------------------------------

    def subscribe(self, name: str, *, leaves: bool) -> None:
        """A node starts; it asks each proxy that it is named."""
        self.listeners[name] = Listener(name, leaves)
        for source in sorted(self.shown):
            self._consider(source, name)
            self._ask_topic(DirectKey(self.here, source, name))

    def unsubscribe(self, name: str) -> None:
        """A node ends, and its connections with it."""
        del self.listeners[name]
        for source in sorted(self.shown):
            self.act(self.routes.remove(DirectKey(self.here, source, name), hang_up=False))

    def judge(self) -> None:
        """Judge all again after a reload."""
        for source in sorted(self.shown):
            for name in list(self.listeners):
                self._consider(source, name)

    def advertised(self, source: Source, *, shown: bool) -> None:
        """A source appears in the graph here, or leaves it."""
        if shown and source not in self.shown:
            self.shown.add(source)
            for name in list(self.listeners):
                self._consider(source, name)
                self._ask_topic(DirectKey(self.here, source, name))
        elif not shown and source in self.shown:
            self.shown.discard(source)
            self._hide(source, hang_up=True)

    def _hide(self, source: Source, *, hang_up: bool) -> None:
        for name, listener in self.listeners.items():
            paths = self.paths(source, name)
            if "relay" in paths:
                paths.remove("relay")
            if listener.leaves and hang_up:
                paths.clear()
            key = DirectKey(self.here, source, name)
            route = self.routes.get(key)
            if not hang_up and route is not None and route.path is Path.DIRECT and route.endpoint is not None:
                self.strays[source, name] = route.endpoint[1]
            self.act(self.routes.remove(key, hang_up=hang_up))

    def withdrawn(self, source: Source, name: str, unmet: Unmet) -> None:
        """Take ``direct.closed``."""
        self.act(self.routes.closed(self.here, source, name, unmet, self.world.now))

    def retried(self, source: Source) -> None:
        """Take ``direct.retry``."""
        self.act(self.routes.retry(self.here, source, self.world.now))

    def broken(self, source: Source, name: str) -> None:
        """A direct connection breaks by itself."""
        paths = self.paths(source, name)
        paths[:] = [one for one in paths if one == "relay"]

    def end_all(self, port: int) -> None:
        """The publisher's agent ends the connections from this module to a port."""
        for listener in self.listeners.values():
            for paths in listener.paths.values():
                if port in paths:
                    paths.remove(port)

    def restart(self) -> None:
        """The host is switched off and on again: all that was known here is gone, and all connections."""
        self._life += 1
        self._busy.clear()
        self._waiting.clear()
        self.routes = self._machine()
        self.strays.clear()
        for listener in self.listeners.values():
            listener.paths.clear()
        self.shown.clear()
        self.here = 0

    # --- links -----------------------------------------------------------------------------------------------------

    def link_up(self, channel: Channel, number: int) -> None:
        """A link; with another number of the peer it is one of another run."""
        self.channel = channel
        if number != self.here:
            self.here = number
            self.shown.clear()
        self.act(self.routes.link_up(number, self.world.now))

    def link_down(self, *, crashed: bool, gone: bool) -> None:
        """The link ends; ``gone``: its session too."""
        self.channel = None
        self.act(self.routes.link_down(self.here, self.world.now, crashed=crashed))
        if gone:
            for source in sorted(self.shown):
                self._hide(source, hang_up=not crashed)
            left = dict(self.strays)
            self.world.after(limits.DIRECT_ADOPT, lambda: self._end_strays(left))

    def _end_strays(self, left: dict[tuple[Source, str], int]) -> None:
        for (source, name), port in left.items():
            if self.strays.get((source, name)) == port:
                del self.strays[source, name]
                paths = self.paths(source, name)
                if port in paths:
                    paths.remove(port)

    # --- carrying out ----------------------------------------------------------------------------------------------

    def _consider(self, source: Source, name: str) -> None:
        unmet = None if self.allowed else RELAYED
        key = DirectKey(self.here, source, name)
        self.act(self.routes.consider(key, Transport.AUTO, unmet, self.world.now))

    def act(self, actions: Iterable[DirectAction]) -> None:
        """Carry out the machine's actions, as ``DirectImporter._act``."""
        for action in actions:
            match action:
                case Ask(key, attempt):
                    self._ask(key, attempt)
                case ProbeNode(peer, grant):
                    self._soon(lambda p=peer, g=grant: self._probe(p, g), 0.01)  # type: ignore[misc]
                case Decided(key):
                    for answer in self._waiting.pop(key, []):
                        answer()
                case Move(key):
                    self._queue(key, lambda done, k=key: self._move(k, done))  # type: ignore[misc]
                case HangUp(key, (_, port)):
                    self._queue(key, lambda done, k=key, p=port: self._hang_up(k, p, done))  # type: ignore[misc]
                case Release(key):
                    self._release(key)
                case _:
                    pass

    def _release(self, key: DirectKey) -> None:
        number, grants = self.there_number, self.there.grants
        if self.channel is not None:
            release = lambda: self.there.act(grants.release(number, key.source, key.subscriber))  # noqa: E731
            self.channel.send(0, release)

    def _soon(self, work: Callable[[], None], most: float) -> None:
        life = self._life
        self.world.after(most * self.world.rng.random(), lambda: work() if life == self._life else None)

    def _ask(self, key: DirectKey, attempt: int) -> None:
        channel, life = self.channel, self._life
        done: list[bool] = []

        def reply(found: object) -> None:
            if not done and life == self._life and isinstance(found, Grant | Unmet):
                done.append(True)
                self.act(self.routes.replied(key, attempt, found, self.world.now))

        if channel is None or key.peer != self.here:
            self.world.after(0.0, lambda: reply(Unmet(Condition.OFFERED, "no link")))
            return
        number = self.there_number
        channel.send(0, lambda: self.there.asked(number, channel, key.source, key.subscriber, reply))
        no_answer = Unmet(Condition.AGENT, "no answer")
        self.world.after(limits.DIRECT_ASK_TIMEOUT, lambda: reply(no_answer))

    def _probe(self, peer: int, grant: Grant) -> None:
        talkers = self.there.talkers.values()
        there = any(one.up and one.reachable and one.port == grant.port for one in talkers)
        self.act(self.routes.probed(peer, grant.port, "" if there else "no connection", self.world.now))

    def _queue(self, key: DirectKey, work: Callable[[Callable[[], None]], None]) -> None:
        """Calls to one node for one source go one after the other."""
        queue = self._busy.setdefault(key, [])
        queue.append(work)
        if len(queue) == 1:
            self._next(key)

    def _next(self, key: DirectKey) -> None:
        def done() -> None:
            queue = self._busy[key]
            queue.pop(0)
            if queue:
                self._next(key)
            else:
                del self._busy[key]

        self._soon(lambda: self._busy[key][0](done), 0.02)

    def _hang_up(self, key: DirectKey, port: int, done: Callable[[], None]) -> None:
        paths = self.paths(key.source, key.subscriber)
        if port in paths:
            paths.remove(port)
        done()

    def _move(self, key: DirectKey, done: Callable[[], None]) -> None:
        route = self.routes.get(key)
        if route is None or key.source not in self.shown or not self.routes.misplaced(key):
            done()
            return
        paths = self.paths(key.source, key.subscriber)
        paths.clear()
        self.routes.hung_up(key)

        def call_back() -> None:
            self._ask_topic(key)
            done()

        self._soon(call_back, 0.02)

    def _ask_topic(self, key: DirectKey) -> None:
        """The node calls ``requestTopic`` at the proxy, and is answered as by ``DirectImporter._answer``."""
        if self.routes.decision(key) is not None:
            self._answer(key)
            return
        done: list[bool] = []
        life = self._life

        def answer() -> None:
            if not done and life == self._life:
                done.append(True)
                self._answer(key)

        self._waiting.setdefault(key, []).append(answer)
        self.world.after(limits.DIRECT_HOLD, answer)

    def _answer(self, key: DirectKey) -> None:
        if self.routes.get(key) is None or key.subscriber not in self.listeners:
            return
        paths = self.paths(key.source, key.subscriber)
        decision, now = self.routes.decision(key), self.world.now
        route = self.routes.get(key)
        before = route.endpoint[1] if route is not None and route.endpoint and route.path is Path.DIRECT else None
        stray = self.strays.pop((key.source, key.subscriber), None)
        direct = decision.port if isinstance(decision, Grant) else None
        for port in [one for one in paths if one != "relay"]:
            if port == direct:
                self.act(self.routes.answered(key, ("b", port), now))
                return
            if port in {stray, before}:
                paths.remove(port)
        if "relay" in paths:
            return  # it is connected, so it does not ask
        if direct is None:
            paths.append("relay")
            self.act(self.routes.answered(key, None, now))
            return
        talker = self.there.talkers[key.source]
        if talker.up and talker.reachable and talker.port == direct:
            paths.append(direct)
        self.act(self.routes.answered(key, ("b", direct), now))

    def check(self) -> None:
        """As ``DirectImporter._check``, and the machine's timer."""
        now = self.world.now
        due = self.routes.next_timer()
        if due is not None and due <= now:
            self.act(self.routes.handle_timer(now))
        for key, route in self.routes.connected():
            if route.endpoint is None or now - route.answered_at <= limits.DIRECT_SETTLE or key in self._busy:
                continue
            if self.routes.misplaced(key):
                self.act([Move(key)])
            elif route.endpoint[1] not in self.paths(key.source, key.subscriber):
                self.act(self.routes.broken(key, now))
