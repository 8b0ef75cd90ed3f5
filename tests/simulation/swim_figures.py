"""Figures of the failure detector on a simulated clock and network: ``make swim``, or ``--help``.

Each line is one measurement. Only the failure detectors are simulated; ``--kind thousand`` and ``--kind long`` of
``python -m tests.simulation`` play whole agents.
"""

from __future__ import annotations

import argparse
import functools
import gc
import statistics
import sys
import time
from typing import TYPE_CHECKING

from tests.simulation.swim_scenario import SwimScenario

if TYPE_CHECKING:
    from tests.simulation.swim_member import SwimMember


class Rest:
    """Traffic and processor time of a mesh in which nothing happens."""

    def __init__(self, scenario: SwimScenario, seconds: float) -> None:
        members = scenario.living()
        packets, size = sum(m.packets for m in members), sum(m.bytes for m in members)
        cpu = time.process_time()
        scenario.run(seconds)
        share = len(members) * seconds
        self.cpu = (time.process_time() - cpu) / share
        """Seconds of a core for each member and second: two exchanges, half of each, and the simulation."""
        self.packets = (sum(m.packets for m in members) - packets) / share
        self.bytes = (sum(m.bytes for m in members) - size) / share


class Deaths:
    """Seconds from the death of members until another one suspects each, and until all others know of each."""

    def __init__(self, scenario: SwimScenario, victims: list[SwimMember], seconds: float) -> None:
        self.suspected: list[float] = []
        self.known: list[float] = []
        self.missed = 0
        for victim in victims:
            scenario.figures.suspected_at.pop(victim.identity.instance, None)  # a false one, before
            victim.kill()
        begun = scenario.world.now
        scenario.run(seconds)
        for victim in victims:
            instance = victim.identity.instance
            lost = scenario.figures.lost_at.get(instance, [])
            self.missed += len(scenario.living()) - len(lost)
            self.suspected.append(scenario.figures.suspected_at.get(instance, scenario.world.now) - begun)
            self.known.append(max(lost, default=scenario.world.now) - begun)


def false_alarms(scenario: SwimScenario, seconds: float) -> tuple[int, int]:
    """False suspicions, and false failures (counted at each that holds one), in that time."""
    suspicions, failures = scenario.figures.false_suspicions, scenario.figures.false_failures
    scenario.run(seconds)
    return scenario.figures.false_suspicions - suspicions, scenario.figures.false_failures - failures


def until_agreed(scenario: SwimScenario, limit: float) -> float:
    """Seconds until all living members hold the same, at most ``limit``."""
    begun = scenario.world.now
    while scenario.disagreements() and scenario.world.now - begun < limit:
        scenario.run(1.0)
    return scenario.world.now - begun


def spread(values: list[float]) -> str:
    """``mean 1.23, worst 2.34``."""
    return f"mean {statistics.fmean(values):.2f}, worst {max(values):.2f}"


def at_rest_and_deaths(seed: int, count: int) -> None:
    """Rest, single deaths, and the death of a third."""
    scenario = SwimScenario(seed, count, delay=(0.0002, 0.003))
    scenario.start()
    scenario.run(10)
    rest = Rest(scenario, 10)
    say(f"at rest: {rest.packets:.1f} packets and {rest.bytes:.0f} bytes a member and second sent, as many received")
    say(f"processor time with the simulation: {1e6 * rest.cpu:.0f} us a member and second")
    suspected, known, missed = [], [], 0
    for _ in range(10):
        death = Deaths(scenario, [scenario.world.rng.choice(scenario.living())], 8)
        suspected += death.suspected
        known += death.known
        missed += death.missed
    say(f"10 deaths: suspected after {spread(suspected)} s, known to all after {spread(known)} s, missed {missed}")
    living = scenario.living()
    size = sum(m.bytes for m in living)
    death = Deaths(scenario, scenario.world.rng.sample(living, len(living) // 3), 20)
    sent = (sum(m.bytes for m in scenario.living()) - size) / len(scenario.living()) / 20
    say(
        f"a third ({len(death.known)}) killed at once: known to all after {spread(death.known)} s, "
        f"missed {death.missed}"
    )
    say(f"  false failures {scenario.figures.false_failures}, {sent:.0f} bytes a member and second meanwhile")


class Alarms:
    """What the members hold falsely within some seconds, and what that costs."""

    def __init__(self, scenario: SwimScenario, seconds: float, faulty: list[SwimMember] | None = None) -> None:
        disturbed = {member.identity.instance for member in faulty or []}
        scenario.figures.lost_at.clear()
        packets, size = sum(m.packets for m in scenario.living()), sum(m.bytes for m in scenario.living())
        self.suspicions, self.failures = false_alarms(scenario, seconds)
        share = len(scenario.living()) * seconds
        self.packets = (sum(m.packets for m in scenario.living()) - packets) / share
        self.bytes = (sum(m.bytes for m in scenario.living()) - size) / share
        lost = scenario.figures.lost_at.keys()
        self.held = len(lost & disturbed)
        """How many of the disturbed members anyone held to have failed."""
        self.others = len(lost - disturbed)
        """How many of all others."""
        scenario.figures.lost_at.clear()

    def __str__(self) -> str:
        return (
            f"{self.others} undisturbed members held to have failed, {self.suspicions} suspicions of living members "
            f"(counted at each that heard of one), {self.packets:.1f} packets and {self.bytes:.0f} bytes a member and"
            f" second sent"
        )


def losses(scenario: SwimScenario) -> None:
    """Lost packets, and deaths while packets are lost."""
    for loss in (0.01, 0.05, 0.1, 0.3):
        scenario.loss = loss
        found = Alarms(scenario, 30)
        say(f"{100 * loss:.0f} % loss for 30 s: {found}")
        suspected, known, missed = [], [], 0
        for _ in range(3):
            death = Deaths(scenario, [scenario.world.rng.choice(scenario.living())], 12)
            suspected += death.suspected
            known += death.known
            missed += death.missed
        say(f"  3 deaths: suspected after {spread(suspected)} s, known to all after {spread(known)} s")
        say(f"  not noticed by {missed} within 12 s")
        _calm(scenario)


def pauses(scenario: SwimScenario) -> None:
    """Processes that are stopped, or get little CPU."""
    rng = scenario.world.rng
    some = max(2, min(20, scenario.count // 20))
    for seconds in (1.0, 2.0, 5.0, 10.0):
        paused = rng.sample(scenario.living(), some)
        for member in paused:
            member.stop(seconds)
        found = Alarms(scenario, seconds + 8, paused)
        say(f"{some} stopped for {seconds:g} s: {found.held} of these held to have failed; {found}")
        _calm(scenario)
    paused = rng.sample(scenario.living(), some)
    for member in paused:
        for turn in range(30):
            at = scenario.world.now + 2.0 * turn + rng.random()
            scenario.world.at(at, functools.partial(member.stop, 1.5))
    found = Alarms(scenario, 60, paused)
    say(f"{some} that run 0.5 s of each 2 s, for 60 s: {found.held} of these held to have failed; {found}")
    _calm(scenario)
    slow = rng.sample(scenario.living(), scenario.count // 4)
    for member in slow:
        member.slow = 1.0
    found = Alarms(scenario, 60, slow)
    say(f"a quarter without CPU, up to 1 s late, for 60 s: {found.held} of {len(slow)} held to have failed; {found}")
    _calm(scenario)


def cuts(scenario: SwimScenario) -> None:
    """Packets pass in one direction only."""
    rng = scenario.world.rng
    living = scenario.living()
    for member in living:
        others = rng.sample(living, scenario.count // 20)
        scenario.cut.update((member.number, other.number) for other in others if other is not member)
    say(f"a twentieth of all pairs cut in one direction for 30 s: {Alarms(scenario, 30)}")
    _calm(scenario)
    one = rng.choice(living)
    scenario.cut = {(one.number, other.number) for other in living}
    found = Alarms(scenario, 30, [one])
    say(f"one whose packets all are lost for 30 s: {found.held} of 1 held to have failed; {found}")
    _calm(scenario)
    one = rng.choice(living)
    scenario.cut = {(other.number, one.number) for other in living}
    found = Alarms(scenario, 30, [one])
    say(f"one that hears no other for 30 s: {found.held} of 1 held to have failed; {found}")
    _calm(scenario)
    half = len(living) // 2
    scenario.cut = {(a.number, b.number) for a in living[:half] for b in living[half:]}
    found = Alarms(scenario, 30, living[:half])
    say(f"one half does not hear the other for 30 s: {found.held} of {half} held to have failed; {found}")
    _calm(scenario)
    scenario.sides = {m.number: m.number % 2 for m in living}
    found = Alarms(scenario, 30, living)
    halves = {len(m.members) + 1 for m in living}
    say(f"parted in halves for 30 s: each holds {min(halves)} to {max(halves)}; {found}")
    _calm(scenario)


def _calm(scenario: SwimScenario) -> None:
    """End all disturbances, and wait until all agree."""
    scenario.loss = 0.01
    scenario.cut, scenario.sides = set(), {}
    for member in scenario.members:
        member.slow = 0.0
        if not member.alive:
            member.start()
    say(f"  all agree again after {until_agreed(scenario, 180):.0f} s")


def disturbed(seed: int, count: int, parts: tuple[str, ...]) -> None:
    """Loss, pauses and cuts, one after the other, at 1 % loss where nothing else is said."""
    scenario = SwimScenario(seed + 1, count, loss=0.01, delay=(0.0002, 0.003))
    scenario.start()
    scenario.run(10)
    for name, play in (("losses", losses), ("pauses", pauses), ("cuts", cuts)):
        if name in parts:
            play(scenario)


def say(text: str) -> None:
    """Print a line at once."""
    print(text, flush=True)


def main() -> int:
    """Print the figures."""
    parser = argparse.ArgumentParser(prog="python -m tests.simulation.swim_figures", description=__doc__)
    parser.add_argument("--members", type=int, default=1000)
    parser.add_argument("--seed", type=int, default=1)
    parts = ("deaths", "losses", "pauses", "cuts")
    parser.add_argument("--only", choices=parts, action="append", help="may be given again")
    arguments = parser.parse_args()
    gc.disable()  # all that is made stays: looking for cycles would be most of the work
    chosen = tuple(arguments.only or parts)
    if "deaths" in chosen:
        at_rest_and_deaths(arguments.seed, arguments.members)
    if chosen != ("deaths",):
        disturbed(arguments.seed, arguments.members, chosen)
    return 0


if __name__ == "__main__":
    sys.exit(main())
