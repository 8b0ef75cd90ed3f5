"""Direct transport between a module with talkers and others with listeners, through bad times; then all is well.

``python -m tests.simulation --kind direct --seed N`` replays one with its whole trace.
"""

from __future__ import annotations

import asyncio
from contextlib import ExitStack
from itertools import count
from typing import TYPE_CHECKING, Final
from unittest.mock import patch

from rmpa.bridge import limits
from rmpa.bridge.direct.paths import Condition, Want
from rmpa.bridge.messages import Source
from rmpa.ros.master.parameters import RegistrationKind
from tests.bridge.io.virtual import VirtualLoop, run
from tests.simulation.direct_modules import Channel, Network, PublisherModule, SubscriberModule, Talker, World
from tests.simulation.scenario import Disagreement, Outcome

if TYPE_CHECKING:
    from collections.abc import Callable, Coroutine

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

    def play(self, story: Callable[[], Coroutine[object, object, None]] | None = None) -> Outcome:
        """Troubles, healing, and the check; or another story.

        Raises:
            Disagreement: A subscriber has two paths, or in the end not the one that the conditions ask for.
        """
        try:
            run(self._play(story or self._troubles), VirtualLoop())
        except AssertionError as error:
            raise Disagreement(self.world.report(error, f"--kind direct --seed {self.seed}")) from None
        return Outcome(self.world.trace_hash, tuple(self.world.lines), 0)

    async def _play(self, story: Callable[[], Coroutine[object, object, None]]) -> None:
        self.ports, self.numbers = count(40_000), count(1)
        plain = Talker(Source("/chatter", "/talker"), next(self.ports))
        latched = Talker(Source("/map", "/mapper"), next(self.ports), latched=True)
        with ExitStack() as patches:
            self.there = PublisherModule(self.world, (plain, latched))
            self.modules: list[SubscriberModule] = []
            for one in Network(self.world, self.modules).patches(patch):
                patches.enter_context(one)
            self.modules += [SubscriberModule(self.world, name, self.there) for name in ("b", "c")]
            self.away_since: dict[str, float] = {}
            for module in self.modules:
                self.link_up(module)
            self.done = False
            watch = asyncio.create_task(self._watch())
            try:
                await story()
            finally:
                self.done = True
                for module in self.modules:
                    await module.importer.close()
                await asyncio.gather(watch, *self.world.tasks)
                await asyncio.sleep(2 * limits.DIRECT_LIST_AGAIN)

    async def _troubles(self) -> None:
        rng = self.world.rng
        for _ in range(rng.randint(5, 40)):
            await self.world.pause(rng.choice([0.0, 0.001, 0.01, 0.1, 1.0, 5.0]))
            self.happen()
        self.heal()
        await asyncio.sleep(_SETTLED)
        self.check()

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
        topic, node = talker.source.topic, talker.source.node
        if talker.up:
            for module in self.modules:
                module.end_all(old)
            if what != "replace":
                talker.up = False
                there.changed(RegistrationKind.PUBLISHER, topic, node, added=False)
        if what != "toggle" or talker.port == 0:
            talker.up, talker.port = True, next(self.ports)
            there.changed(RegistrationKind.PUBLISHER, topic, node, added=True)
        elif not talker.up:
            talker.port = 0
        asyncio.get_running_loop().call_later(0.02 * self.world.rng.random(), there.advertise)

    def _namesake(self, name: str) -> None:
        there = self.there
        added = name not in there.local
        (there.local.add if added else there.local.discard)(name)
        for talker in there.talkers.values():
            there.changed(RegistrationKind.SUBSCRIBER, talker.source.topic, name, added=added)

    def _rules(self, module: SubscriberModule) -> None:
        if self.world.rng.random() < 0.5:
            module.allowed = not module.allowed
            self.note(module, f"allows it: {module.allowed}")
            module.reload()
        else:
            self.set_rules(allowed=not self.there.allowed)

    def set_rules(self, *, allowed: bool) -> None:
        """Reload the publisher's module."""
        there = self.there
        there.allowed = allowed
        self.world.note("a", f"allows it: {allowed}")
        there.exporter.judge_again()

    def _breaks(self, module: SubscriberModule) -> None:
        if module.listeners:
            name = self.world.rng.choice(sorted(module.listeners))
            source = self.world.rng.choice(sorted(self.there.talkers))
            self.note(module, f"the connection of {name} to {source} breaks")
            paths = module.paths(source, name)
            paths[:] = [one for one in paths if one == "relay"]

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
            self.there.start()
        elif how == "host":
            self.link_down(module, crashed=False, gone=True)
            for listener in module.listeners.values():
                listener.paths.clear()
        else:
            self.link_down(module, crashed=how == "replaced", gone=how == "bye")
        if how == "replaced":
            self.link_up(module)

    def link_up(self, module: SubscriberModule) -> None:
        """Link a module, in its earlier session if that waits still."""
        waits = module.name in self.away_since
        if waits and self.world.now - self.away_since.pop(module.name) > _GRACE:
            module.gone()
            waits = False
        numbers = (module.here, module.there_number) if waits else (next(self.numbers), next(self.numbers))
        channel = Channel(self.world)
        self.note(module, f"link up, session {numbers[0]}")
        module.link_up(channel, *numbers)
        for source in sorted(self.there.talkers):
            module.told(source, shown=source in self.there.offered)

    def link_down(self, module: SubscriberModule, *, crashed: bool, gone: bool) -> None:
        """End a link; its session waits unless it is ``gone``."""
        if module.channel is not None:
            module.link_down(crashed=crashed)
            self.away_since[module.name] = self.world.now
        if gone and self.away_since.pop(module.name, None) is not None:
            module.gone()

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
                module.reload()
            self.set_rules(allowed=True)
        for talker in self.there.talkers.values():  # a node that listens elsewhere now is another process
            self._restart(talker, "restart")

    def check(self) -> None:
        """Each subscriber has one path, the one that the conditions ask for, and the grants are those in use."""
        used = set()
        for module in self.modules:
            for source in sorted(self.there.talkers):
                for name in sorted(module.listeners):
                    if self._check_one(module, source, name):
                        used.add((module.there_number, Want(source.topic, source.node, name)))
        granted = {(peer, want) for peer, want, _ in self.there.exporter}
        assert granted == used, f"granted {sorted(granted)}, used {sorted(used)}"
        for module in self.modules:
            left = {path.want.user for path in module.importer} - set(module.listeners)
            assert not left, f"{left} have left {module.name}"

    def _check_one(self, module: SubscriberModule, source: Source, name: str) -> bool:
        path = module.importer.get(module.here, Want(source.topic, source.node, name))
        paths = module.paths(source, name)
        who = f"{name} of {module.name} at {source}"
        if path is None:  # relayed by rule since it came
            assert (module.allowed, paths) == (False, ["relay"]), f"{who} is unknown"
            return False
        talker = self.there.talkers[source]
        why = path.unmet.condition if path.unmet else None
        if path.state == "direct":
            assert paths == [talker.port], f"{who}: direct by {paths}"
            assert path.endpoint == (module.address, talker.port), who
            assert module.allowed, who
            assert self.there.allowed, who
            assert name not in self.there.local, who
            return True
        assert path.state == "relayed", f"{who} is {path.state}"
        assert (path.endpoint, paths) == (None, ["relay"]), f"{who}: relayed ({why}) by {paths}, {path.endpoint}"
        if why is Condition.LATCHED:
            assert talker.latched, who
        elif not module.allowed or not self.there.allowed:
            assert why is Condition.TRANSPORT, f"{who}: {why}"
        else:
            assert why is Condition.CALLER_ID, f"{who}: {why}"
            others = [peer for peer, other, _ in self.there.exporter.of(source.topic, source.node) if other == name]
            assert name in self.there.local or others, f"{who}: no other has the name"
        return False

    async def _watch(self) -> None:
        while not self.done:
            for module in self.modules:
                for listener in module.listeners.values():
                    for source, paths in listener.paths.items():
                        assert len(paths) <= 1, f"{listener.name} of {module.name}: {paths} to {source}"
            for source in self.there.talkers:
                names = [name for _, name, _ in self.there.exporter.of(source.topic, source.node)]
                assert len(names) == len(set(names)), f"granted twice: {names}"
            await asyncio.sleep(_TICK)

    def note(self, module: SubscriberModule, what: str) -> None:
        """One line of the trace."""
        self.world.note(module.name, what)
