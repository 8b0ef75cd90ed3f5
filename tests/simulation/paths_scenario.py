"""Modules and relays whose cables are plugged and pulled at random, while numbered messages take any way there is.

Whole bridges in made-up time (``tests.bridge.io``): what a reliable topic's listener misses is told, to the message;
nothing comes twice, and a latched message once.
"""

from __future__ import annotations

import asyncio
import itertools
import random
from collections.abc import Iterable, Sequence
from functools import partial
from typing import Final, cast

from rmpa.bridge.bridge import Bridge
from rmpa.config.settings import Settings
from rmpa.core.contract import ContractRule, Reliability
from rmpa.core.identity import Guid, Identity
from rmpa.mesh import limits as mesh_limits
from rmpa.ros.core.embedded import RosCore
from tests.bridge.io.links import LinkEnd
from tests.bridge.io.nodes import Core, Listener, Speaker
from tests.bridge.io.two_bridges import Side, World, made_up
from tests.bridge.io.virtual import VirtualLoop, run

PERIOD: Final = 0.02
SURE: Final = ContractRule(("/sure", "/map"), (), {"reliability": Reliability.RELIABLE, "depth": 5000})


class Module(Side):
    """One module; each but the first and the last one is a relay."""

    def __init__(self, number: int, rng: random.Random, *, relays: bool) -> None:
        self._relays = relays
        self.places = itertools.count(1)
        super().__init__(f"m{number}", number, (SURE,), rng)

    def begin(self) -> None:
        """The one run of its agent."""
        self.number = self._number
        instance = bytes([self._number]) * 16
        self.identity = Identity(Guid.of(f"10.{next(self.places)}.0.{self._number}", 1000), instance, self.name)
        self.core = Core(self)
        settings = Settings(contracts=self._rules, relay=self._relays)
        self.bridge = Bridge(cast("RosCore", self.core), settings, rng=self._rng.random)
        self.bridge.place(self.identity)

    def move(self) -> None:
        """It has another address, and is the same run."""
        guid = Guid.of(f"10.{next(self.places)}.0.{self._number}", 1000)
        self.identity = Identity(guid, self.identity.instance, self.name)


class Paths(World):
    """Two modules with relays between them.

    Args:
        seed: Of all chance.
        relays: How many relays there are.
    """

    def __init__(self, seed: int, relays: int) -> None:
        self._count = relays + 2
        super().__init__(seed)
        self.cables = list(itertools.combinations(self.modules, 2))
        self.ends: dict[tuple[Module, Module], tuple[LinkEnd, LinkEnd]] = {}

    def make_sides(self, _rules: Iterable[ContractRule]) -> Sequence[Side]:
        self.modules = [Module(n, self.rng, relays=1 < n < self._count) for n in range(1, self._count + 1)]
        return self.modules

    def keeps(self, _speaker: int) -> bool:
        """No message may come again."""
        return False

    # --- cables ---------------------------------------------------------------------------------------------

    def plugged(self, cable: tuple[Module, Module]) -> bool:
        """Whether a link stands."""
        return cable in self.ends and not any(end.gone or end.wires["express"].lost for end in self.ends[cable])

    def plug(self, cable: tuple[Module, Module]) -> None:
        """A new link stands; a side that has not noticed the end of the last one does so now."""
        for end in self.ends.get(cable, ()):
            end.end(silent=True)
        self.ends[cable] = self.connect(*cable)

    def pull(self, cable: tuple[Module, Module]) -> None:
        """Nothing arrives any more; each side notices it by its lease."""
        for end in self.ends[cable]:
            for wire in end.wires.values():
                wire.lost = True
            within = mesh_limits.EXPRESS_LEASE * self.rng.uniform(0.7, 1.1)
            asyncio.get_running_loop().call_later(within, partial(end.end, silent=True))

    def say_bye(self, module: Module) -> None:
        """An agent says bye on all its links."""
        for cable in [cable for cable in self.cables if module in cable and self.plugged(cable)]:
            for end in self.rng.sample(self.ends[cable], 2):
                end.end(silent=False)

    def move(self, module: Module) -> None:
        """A module has another address; its links end as by silence, and are made anew."""
        there = [cable for cable in self.cables if module in cable and self.plugged(cable)]
        module.move()
        for cable in there:
            self.plug(cable)

    def disturb(self) -> None:
        """Something happens."""
        cable = self.rng.choice(self.cables)
        match self.rng.randrange(8):
            case 0:
                self.say_bye(self.rng.choice(self.modules[1:-1]))
            case 1:
                self.move(self.rng.choice(self.modules))
            case _ if self.plugged(cable):
                self.pull(cable)
            case _:
                self.plug(cable)

    def _carry_all(self) -> None:
        """What is under way arrives, on each wire a little or all."""
        ends = [end for pair in self.ends.values() for end in pair if not end.gone]
        for end in self.rng.sample(ends, len(ends)):
            for wire in end.wires.values():
                wire.carry(self.rng.choice([100, 1000, 1 << 20]))


async def _play(paths: Paths, seconds: float) -> None:
    here, there = paths.modules[0], paths.modules[-1]
    sure, chart = paths.speak(here, "/sure", "/n1"), paths.speak(here, "/map", "/n2", latching=True)
    heard, charted = paths.listen(there, "/sure"), paths.listen(there, "/map")
    chart.say(10)
    for cable in paths.cables:
        paths.plug(cable)
    await paths.rest(1.0, step=PERIOD)
    until, pause = 0.0, 0.0
    while until < seconds:
        sure.say(10)
        await paths.rest(PERIOD, step=PERIOD)
        until, pause = until + PERIOD, pause - PERIOD
        if pause <= 0:
            paths.disturb()
            pause = paths.rng.choice([0.2, 1.0, 3.0, 10.0])
    for cable in paths.cables:
        if not paths.plugged(cable):
            paths.plug(cable)
    await paths.rest(5.0, step=PERIOD)
    for _ in range(10):
        sure.say(10)
        await paths.rest(1.0, step=PERIOD)
    check(paths, sure, heard, chart, charted)


def check(paths: Paths, sure: Speaker, heard: Listener, chart: Speaker, charted: Listener) -> None:
    """What did not come was told, and nothing came twice."""
    numbers = [number for _, number in heard.got[sure.number]]
    assert numbers == sorted(set(numbers)), "in order, and none twice"
    assert numbers[-1] == sure.said, "it still flows"
    missing = numbers[-1] - numbers[0] + 1 - len(numbers)
    counters = paths.modules[-1].bridge.counters
    lost, unknown = counters["message.lost"], counters["message.lost_unknown"]
    assert lost == missing or (unknown and lost <= missing), f"{missing} are missing, {lost} told, {unknown} unknown"
    connections = [ear for ear, _ in charted.got[chart.number]]
    assert len(connections) == len(set(connections)) > 0, "the latched message once for each connection"


def play(seed: int, *, relays: int = 2, seconds: float = 60.0) -> int:
    """Play one run; return how many messages were lost, and told."""
    loop = VirtualLoop()
    lost = 0

    async def main() -> None:
        nonlocal lost
        async with Paths(seed, relays) as paths:
            await _play(paths, seconds)
            lost = paths.modules[-1].bridge.counters["message.lost"]

    with made_up(loop):
        run(main(), loop)
    return lost
