"""Direct transport between a module with talkers and others with listeners, through bad times; then all is well.

``python -m tests.simulation --kind direct --seed N`` replays one with its whole trace.
"""

from __future__ import annotations

from itertools import count
from typing import Final

from rmpa.bridge import limits
from rmpa.bridge.direct.conditions import Condition
from rmpa.bridge.direct.publisher_side import DirectGrants
from rmpa.bridge.direct.subscriber_side import DirectKey, DirectState, Path
from rmpa.bridge.messages import Source
from tests.simulation.direct_modules import Channel, PublisherModule, SubscriberModule, Talker
from tests.simulation.network import World
from tests.simulation.scenario import Disagreement, Outcome

NAMES: Final = ("/viewer", "/logger", "/planner")
_TICK: Final = 0.1
_GRACE: Final = 3.0
"""Seconds for which a session outlives its link here."""
_SETTLED: Final = 2 * limits.DIRECT_RETRY + limits.DIRECT_BREAKS_SPAN + 2 * limits.DIRECT_ADOPT
"""Seconds after which every retry has been made."""


class DirectScenario:
    """Two talkers, two modules of listeners of the same names, and what happens to them.

    Args:
        seed: Everything follows from it.
        keep: Keep the whole trace.
    """

    def __init__(self, seed: int, *, keep: bool = False) -> None:
        self.seed = seed
        self.world = World(seed, keep=keep)
        self.ports = count(40_000)
        self.numbers = count(1)
        plain = Talker(Source("/chatter", "/talker"), next(self.ports))
        latched = Talker(Source("/map", "/mapper"), next(self.ports), latched=True)
        self.there = PublisherModule(self.world, (plain, latched))
        self.modules = [SubscriberModule(self.world, name, self.there) for name in ("b", "c")]
        self.away_since: dict[str, float] = {}
        for module in self.modules:
            self.link_up(module)
        self._tick()

    def play(self) -> Outcome:
        """Troubles, healing, and the check.

        Raises:
            Disagreement: A subscriber has two paths, or in the end not the one that the conditions ask for.
        """
        rng = self.world.rng
        try:
            for _ in range(rng.randint(5, 40)):
                self.world.run(self.world.now + rng.choice([0.0, 0.001, 0.01, 0.1, 1.0, 5.0]) * rng.random())
                self.happen()
            self.heal()
            self.world.run(self.world.now + _SETTLED)
            self.check()
        except AssertionError as error:
            raise Disagreement(self._report(error)) from None
        return Outcome(self.world.trace_hash, tuple(self.world.lines), 0)

    # --- what happens ----------------------------------------------------------------------------------------------

    def happen(self) -> None:
        """One event, of a listener, a talker, the rules or a link."""
        rng = self.world.rng
        module = rng.choice(self.modules)
        getattr(
            self, "_" + rng.choice(["listener", "listener", "listener", "talker", "rules", "link", "link", "breaks"])
        )(module)

    def _listener(self, module: SubscriberModule) -> None:
        rng = self.world.rng
        name = rng.choice(NAMES)
        if name in module.listeners:
            self.note(module, f"{name} ends")
            module.unsubscribe(name)
        else:
            self.note(module, f"{name} starts")
            module.subscribe(name, leaves=rng.random() < 0.5)

    def _talker(self, _: SubscriberModule) -> None:
        rng, there = self.world.rng, self.there
        talker = rng.choice(list(there.talkers.values()))
        what = rng.choice(["restart", "replace", "toggle", "reachable", "network", "namesake"])
        self.world.note("a", f"{talker.source.node}: {what}")
        if what in ("restart", "replace", "toggle"):
            self._restart(talker, what)
        elif what == "reachable":
            talker.reachable = not talker.reachable
        elif what == "network":
            talker.network = not talker.network
        else:
            self._namesake(rng.choice(NAMES))

    def _restart(self, talker: Talker, what: str) -> None:
        there, old = self.there, talker.port
        if talker.up:
            for module in self.modules:
                module.end_all(old)
            if what != "replace":
                talker.up = False
                there.grants.gone(talker.source)
        if what != "toggle" or talker.port == 0:
            talker.up, talker.port = True, next(self.ports)
            there.act(there.grants.published(talker.source, talker.uri))
        elif not talker.up:
            talker.port = 0
        self.world.after(0.02 * self.world.rng.random(), there.advertise)

    def _namesake(self, name: str) -> None:
        there = self.there
        if name in there.local:
            there.local.discard(name)
            for talker in there.talkers.values():
                there.act(there.grants.local_subscriber_gone(talker.source.topic))
        else:
            there.local.add(name)
            for talker in there.talkers.values():
                there.act(there.grants.local_subscriber(talker.source.topic, name))

    def _rules(self, module: SubscriberModule) -> None:
        if self.world.rng.random() < 0.5:
            module.allowed = not module.allowed
            self.note(module, f"allows it: {module.allowed}")
            module.judge()
        else:
            self.set_rules(allowed=not self.there.allowed)

    def set_rules(self, *, allowed: bool) -> None:
        """Reload the publisher's module."""
        there = self.there
        there.allowed = allowed
        self.world.note("a", f"allows it: {allowed}")
        there.act(there.grants.retry_all())
        there.act(there.grants.judge_again(lambda source, peer, _: there.unmet(source, peer, "")))

    def _breaks(self, module: SubscriberModule) -> None:
        if module.listeners:
            name = self.world.rng.choice(sorted(module.listeners))
            source = self.world.rng.choice(sorted(self.there.talkers))
            self.note(module, f"the connection of {name} to {source} breaks")
            module.broken(source, name)

    # --- links -----------------------------------------------------------------------------------------------------

    def _link(self, module: SubscriberModule) -> None:
        if module.channel is None:
            self.link_up(module)
            return
        how = self.world.rng.choice(["silence", "silence", "replaced", "replaced", "bye", "agent", "host"])
        self.note(module, f"link down: {how}")
        if how == "agent":
            for one in self.modules:
                self.link_down(one, crashed=True, gone=True)
            self.there.grants = DirectGrants()
        elif how == "host":
            self.link_down(module, crashed=False, gone=True)
            module.restart()
        else:
            self.link_down(module, crashed=how == "replaced", gone=how == "bye")
        if how == "replaced":
            self.link_up(module)

    def link_up(self, module: SubscriberModule) -> None:
        """Link a module, in its earlier session if that waits still."""
        there = self.there
        waits = module.name in self.away_since
        if waits and self.world.now - self.away_since.pop(module.name) > _GRACE:
            self._end(module, crashed=False)
            waits = False
        number = module.here if waits else next(self.numbers)
        channel = Channel(self.world)
        self.note(module, f"link up, session {number}")
        module.there_number = number
        there.peers[number] = module
        module.link_up(channel, number)
        there.grants.link_up(number)
        self.world.after(limits.DIRECT_ADOPT, lambda: self._expire(number, channel))
        for source in sorted(there.talkers):
            module.tell(lambda s=source, on=source in there.offered: module.advertised(s, shown=on))  # type: ignore[misc]

    def _expire(self, number: int, channel: Channel) -> None:
        if channel.up:
            self.there.act(self.there.grants.expire(number))

    def link_down(self, module: SubscriberModule, *, crashed: bool, gone: bool) -> None:
        """End a link; its session waits unless it is ``gone``."""
        there, number = self.there, module.there_number
        if module.channel is None:
            if gone and self.away_since.pop(module.name, None) is not None:
                self._end(module, crashed=crashed)
            return
        module.channel.up = False
        if not crashed:
            there.act(there.grants.unreachable(number))
        module.link_down(crashed=crashed, gone=False)
        if gone:
            self._end(module, crashed=crashed)
        else:
            self.away_since[module.name] = self.world.now

    def _end(self, module: SubscriberModule, *, crashed: bool) -> None:
        there, number = self.there, module.there_number
        module.link_down(crashed=crashed, gone=True)
        module.shown.clear()
        there.peers.pop(number, None)
        there.act(there.grants.peer_gone(number))

    # --- the end ---------------------------------------------------------------------------------------------------

    def heal(self) -> None:
        """All conditions but those of names, latching and rules hold from now on."""
        for module in self.modules:
            if module.channel is None:
                self.link_up(module)
        for talker in self.there.talkers.values():
            talker.reachable = talker.network = True
            if not talker.up:
                self._restart(talker, "restart")
        if self.world.rng.random() < 0.7:
            for module in self.modules:
                module.allowed = True
                module.judge()
            self.set_rules(allowed=True)
        for talker in self.there.talkers.values():  # a node that listens elsewhere now is another process
            self._restart(talker, "restart")

    def check(self) -> None:
        """Each subscriber has one path, the one that the conditions ask for, and the grants are those in use."""
        used = set()
        for module in self.modules:
            for source in sorted(self.there.talkers):
                for name in sorted(module.listeners):
                    key = DirectKey(module.here, source, name)
                    if self._check_one(module, key):
                        used.add((source, module.there_number, name))
        granted = {(source, peer, name) for source, peer, name, _ in self.there.grants}
        assert granted == used, f"granted {sorted(granted)}, used {sorted(used)}"
        known = [key for module in self.modules for key, _ in module.routes]
        assert len(known) == sum(len(module.listeners) * len(self.there.talkers) for module in self.modules)

    def _check_one(self, module: SubscriberModule, key: DirectKey) -> bool:
        source, name = key.source, key.subscriber
        route, paths = module.routes.get(key), module.paths(source, name)
        who = f"{name} of {module.name} at {source}"
        assert route is not None, f"{who} is unknown"
        talker = self.there.talkers[source]
        why = route.unmet.condition if route.unmet else None
        if route.state is DirectState.DIRECT:
            assert (route.path, paths) == (Path.DIRECT, [talker.port]), f"{who}: direct by {paths}, {route.path}"
            assert module.allowed, who
            assert self.there.allowed, who
            assert name not in self.there.local, who
            return True
        assert route.state is DirectState.RELAYED, f"{who} is {route.state}"
        assert (route.path, paths) == (Path.RELAY, ["relay"]), f"{who}: relayed ({why}) by {paths}, {route.path}"
        if why is Condition.LATCHED:
            assert talker.latched, who
        elif not module.allowed or not self.there.allowed:
            assert why is Condition.TRANSPORT, f"{who}: {why}"
        else:
            assert why is Condition.CALLER_ID, f"{who}: {why}"
            others = [peer for peer, other, _ in self.there.grants.of(source) if other == name]
            assert name in self.there.local or others, f"{who}: no other has the name"
        return False

    def _tick(self) -> None:
        for module in self.modules:
            module.check()
            for listener in module.listeners.values():
                for source, paths in listener.paths.items():
                    assert len(paths) <= 1, f"{listener.name} of {module.name}: {paths} to {source}"
        for source in self.there.talkers:
            names = [name for _, name, _ in self.there.grants.of(source)]
            assert len(names) == len(set(names)), f"granted twice: {names}"
            assert not set(names) & self.there.local, f"granted {names} beside {self.there.local}"
        self.world.after(_TICK, self._tick)

    def note(self, module: SubscriberModule, what: str) -> None:
        """One line of the trace."""
        self.world.note(module.name, what)

    def _report(self, error: AssertionError) -> str:
        lines = "\n".join(list(self.world.lines)[-60:])
        return (
            f"{error}\n--- the last events ---\n{lines}\n--- all of them, exactly so again ---\n"
            f"python -m tests.simulation --kind direct --seed {self.seed}\n"
        )
