"""Figures of the failure detector on a simulated clock and network: ``make swim``, or ``--help``.

Each line is one measurement. ``--hours`` simulates that long a time at 1 % loss, in which no member may be held to
have failed: at 1,000 members an hour takes some four minutes of a core, so ``--loss-members`` may say fewer.
"""

from __future__ import annotations

import argparse
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


def disturbed(seed: int, count: int) -> None:
    """Pauses, processes without CPU, asymmetric cuts, a partition, churn."""
    scenario = SwimScenario(seed + 1, count, loss=0.01, delay=(0.0002, 0.003))
    rng = scenario.world.rng
    scenario.start()
    scenario.run(5)
    for shortest, longest in ((0.5, 1.0), (1.0, 1.5), (1.5, 2.0), (2.0, 3.0), (3.0, 5.0)):
        paused = rng.sample(scenario.members, 20)
        failed = set(scenario.figures.lost_at)
        for member in paused:
            member.stop(rng.uniform(shortest, longest))
        false_alarms(scenario, 10)
        held = [m for m in paused if m.identity.instance in scenario.figures.lost_at.keys() - failed]
        others = len(scenario.figures.lost_at.keys() - failed) - len(held)
        say(f"stopped for {shortest} to {longest} s: {len(held)} of 20 held to have failed, {others} others")
        until_agreed(scenario, 60)
        scenario.figures.lost_at.clear()
    for member in rng.sample(scenario.members, count // 20):
        member.slow = 2.0
    slow = {m.identity.instance for m in scenario.members if m.slow}
    false_alarms(scenario, 60)
    others = len(scenario.figures.lost_at.keys() - slow)
    say(f"a twentieth without CPU (up to 2 s late) for 60 s: {len(scenario.figures.lost_at) - others} of these held ")
    say(f"  to have failed, {others} others")
    for member in scenario.members:
        member.slow = 0.0
    say(f"  all agree again after {until_agreed(scenario, 120):.0f} s")
    for member in scenario.members:
        scenario.cut.update((member.number, other.number) for other in rng.sample(scenario.members, count // 20))
    found = false_alarms(scenario, 60)
    say(f"a twentieth of all pairs cut in one direction for 60 s: {found[0]} suspicions, {found[1]} failures")
    scenario.cut.clear()
    scenario.sides = {m.number: m.number % 2 for m in scenario.members}
    scenario.run(30)
    halves = {len(m.members) + 1 for m in scenario.members}
    scenario.sides = {}
    say(
        f"parted in halves for 30 s: each holds {min(halves)} to {max(halves)}; "
        f"agreed {until_agreed(scenario, 180):.0f} s after"
    )


def long_loss(seed: int, count: int, hours: float) -> bool:
    """A long time at 1 % loss; return whether no member was held to have failed."""
    scenario = SwimScenario(seed + 2, count, loss=0.01, delay=(0.0002, 0.02), beacons=0.0)
    scenario.start()
    begun = scenario.world.now
    while (spent := scenario.world.now - begun) < hours * 3600:
        false_alarms(scenario, min(3600.0, hours * 3600 - spent))
        figures = scenario.figures
        passed = (scenario.world.now - begun) / 3600
        say(f"{passed:g} h at 1 % loss, {count} members: {figures.false_failures} of them held to have failed, ")
        say(f"  {figures.false_suspicions} suspicions (counted at each that heard of one)")
    return scenario.figures.false_failures == 0


def say(text: str) -> None:
    """Print a line at once."""
    print(text, flush=True)


def main() -> int:
    """Print the figures; 1 if a living member was held to have failed in the long time at 1 % loss."""
    parser = argparse.ArgumentParser(prog="python -m tests.simulation.swim_figures", description=__doc__)
    parser.add_argument("--members", type=int, default=1000)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--hours", type=float, default=24.0)
    parser.add_argument("--loss-members", type=int, default=100)
    parser.add_argument("--only", choices=["deaths", "disturbed", "loss"])
    arguments = parser.parse_args()
    if arguments.only in {None, "deaths"}:
        at_rest_and_deaths(arguments.seed, arguments.members)
    if arguments.only in {None, "disturbed"}:
        disturbed(arguments.seed, arguments.members)
    if arguments.only in {None, "loss"}:
        return 0 if long_loss(arguments.seed, arguments.loss_members, arguments.hours) else 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
