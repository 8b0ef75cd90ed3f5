"""A simulated mesh of failure detectors: what breaks, and what the members hold of each other afterwards.

``python -m tests.simulation --kind swim --seed N --peers M`` replays one of the random runs with its whole trace.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Final

from tests.simulation.network import World
from tests.simulation.scenario import Disagreement, Outcome
from tests.simulation.swim_member import SwimMember

if TYPE_CHECKING:
    from rmpa.core.guid import Guid
    from rmpa.discovery.swim.events import MemberFailed, MemberLeft, MemberSuspected
    from tests.simulation.network import Address

BEACONS: Final = 20.0
"""Seconds between two beacons of an agent: N / 50 s for a thousand."""
CALM: Final = 90.0
"""Seconds after healing within which all agree: some beacons, and some comparisons of tables."""


@dataclass
class SwimFigures:
    """What a run has shown. Times are seconds of the simulated clock."""

    suspected_at: dict[bytes, float] = field(default_factory=dict)
    """By instance: when a member was suspected for the first time since it was last forgotten here."""
    lost_at: dict[bytes, list[float]] = field(default_factory=dict)
    """By instance: when each of the others lost it."""
    false_suspicions: int = 0
    false_failures: int = 0
    """Times that a living agent held another living one, which it can reach, to have failed."""
    falsely_failed: list[str] = field(default_factory=list)


class SwimScenario:
    """A network of members.

    Args:
        seed: Everything follows from it.
        count: How many members.
        loss: Share of the packets that are lost.
        delay: Shortest and longest time of a packet.
        beacons: Seconds between two beacons of a member, 0: none.
        keep: Keep the whole trace.
    """

    kind = "swim"

    def __init__(
        self,
        seed: int,
        count: int,
        *,
        loss: float = 0.0,
        delay: tuple[float, float] = (0.0002, 0.002),
        beacons: float = BEACONS,
        keep: bool = False,
    ) -> None:
        self.seed = seed
        self.count = count
        self.world = World(seed, keep=keep)
        self.loss = loss
        self.delay = delay
        self.figures = SwimFigures()
        self.cut: set[tuple[int, int]] = set()
        """Pairs of numbers: no packet passes from the first to the second."""
        self.sides: dict[int, int] = {}
        self.members = [SwimMember(self, number + 1) for number in range(count)]
        self._by_host = {member.address[0]: member for member in self.members}
        self._beacons = beacons

    # --- what the members do ----------------------------------------------------------------------------------

    def reaches(self, one: SwimMember, other: SwimMember) -> bool:
        """Whether packets of one come to the other now."""
        if self.cut and (one.number, other.number) in self.cut:
            return False
        return not self.sides or self.sides.get(one.number, 0) == self.sides.get(other.number, 0)

    def send(self, sender: SwimMember, to: Address, data: bytes) -> None:
        """Carry one packet, or lose it."""
        rng = self.world.rng
        target = self._by_host.get(to[0])
        if target is None or rng.random() < self.loss:
            return
        source = sender.address

        def arrive() -> None:
            if self.reaches(sender, target):
                target.datagram(data, source)

        self.world.after(rng.uniform(*self.delay), arrive)

    def greet(self, member: SwimMember, guid: Guid) -> None:
        """An announcement to one that was only heard of, and its answer, make each known to the other."""
        other = self._by_host.get(str(guid.address))
        if other is not None:
            self.world.after(0.05, lambda: self._meet(member, other))

    def suspected(self, member: SwimMember, event: MemberSuspected) -> None:
        """One suspects another."""
        victim = self._by_host[str(event.guid.address)]
        self.world.note(member.name, f"suspects {victim.name}")
        self.figures.suspected_at.setdefault(event.instance, self.world.now)
        if victim.alive and victim.identity.instance == event.instance:
            self.figures.false_suspicions += 1

    def lost(self, member: SwimMember, event: MemberFailed | MemberLeft) -> None:
        """One holds another to have failed or left."""
        victim = self._by_host[str(event.guid.address)]
        self.world.note(member.name, f"loses {victim.name}: {type(event).__name__}")
        self.figures.lost_at.setdefault(event.instance, []).append(self.world.now)
        same = victim.alive and victim.identity.instance == event.instance
        if same and self.reaches(member, victim) and self.reaches(victim, member):
            self.figures.false_failures += 1
            self.figures.falsely_failed.append(f"{self.world.now - 1000:.1f} {victim.name} at {member.name}")

    # --- what is done to them ---------------------------------------------------------------------------------

    def start(self) -> None:
        """Start all, which know each other at once, and let them settle."""
        for member in self.members:
            member.start()
        for member in self.members:
            for other in self.members:
                if other is not member:
                    member.meet(other)
        if self._beacons:
            for member in self.members:
                self.world.after(self.world.rng.random() * self._beacons, lambda m=member: self._beacon(m))  # type: ignore[misc]

    def run(self, seconds: float) -> None:
        """Let time pass."""
        self.world.run(self.world.now + seconds)

    def living(self) -> list[SwimMember]:
        """Those that run."""
        return [member for member in self.members if member.alive]

    def disagreements(self) -> list[str]:
        """What the living members hold otherwise than it is."""
        living = self.living()
        found = []
        everyone = {member.identity.instance for member in living}
        digests = {member.detector.digest for member in living}
        for member in living:
            held = member.members.keys() | {member.identity.instance}
            watched = member.detector.view().members + 1
            if held != everyone or watched != len(everyone):
                missing = [m.name for m in living if m.identity.instance not in held]
                found.append(f"{member.name} holds {len(held)}, watches {watched} of {len(living)}: no {missing[:5]}")
            elif member.detector.view().suspects:
                found.append(f"{member.name} suspects {member.detector.view().suspects}")
        if len(digests) > 1:
            found.append(f"{len(digests)} different tables")
        return found

    def _beacon(self, member: SwimMember) -> None:
        rng = self.world.rng
        if member.alive and self.world.now >= member.stopped_until:
            for other in self.members:
                if other.alive and member.identity.instance not in other.members and rng.random() >= self.loss:
                    self._meet(other, member)
        self.world.after(self._beacons * (0.9 + 0.1 * rng.random()), lambda: self._beacon(member))

    def _meet(self, member: SwimMember, other: SwimMember) -> None:
        """One hears another; its answer, and then a link, let the other hear it too."""
        if member is other or not (member.alive and other.alive and self.reaches(other, member)):
            return
        if member.stopped_until <= self.world.now:
            member.meet(other)
            member.flush()
        if self.reaches(member, other) and other.stopped_until <= self.world.now:
            other.meet(member)
            other.flush()

    # --- a random run -----------------------------------------------------------------------------------------

    def play(self) -> Outcome:
        """Play random failures, heal, and check.

        Raises:
            Disagreement: The members do not agree.
        """
        rng = self.world.rng
        self.loss = rng.choice([0.0, 0.01, 0.1]) * rng.random()
        self.start()
        self.run(3)
        for _ in range(rng.randint(2, 8)):
            self._mischief()
            self.run(rng.choice([0.1, 1.0, 5.0, 20.0]) * rng.random())
        self.world.note("network", "heals")
        self.sides, self.loss = {}, 0.0
        self.cut.clear()
        for member in self.members:
            member.slow = 0.0
            if not member.alive and rng.random() < 0.5:
                member.start()
        self.run(CALM)
        problems = self.disagreements()
        if problems:
            lines = "\n".join(list(self.world.lines)[-60:])
            again = f"python -m tests.simulation --kind swim --seed {self.seed} --peers {self.count}"
            raise Disagreement(f"{problems[0]} (and {len(problems) - 1} more)\n{lines}\n{again}")
        return Outcome(self.world.trace_hash, tuple(self.world.lines), sum(m.packets for m in self.members))

    def _mischief(self) -> None:
        rng = self.world.rng
        living = self.living()
        member: Any = rng.choice(self.members)
        match rng.choice(["part", "join", "kill", "third", "leave", "start", "stop", "slow", "cut", "version"]):
            case "part":
                self.sides = {m.number: rng.randint(0, 1) for m in self.members}
                self.world.note("network", "parts")
            case "join":
                self.sides = {}
            case "kill" if member.alive and len(living) > 3:
                member.kill()
            case "third" if len(living) > 6:
                for one in rng.sample(living, len(living) // 3):
                    one.kill()
            case "leave" if member.alive and len(living) > 3:
                member.leave()
            case "start" if not member.alive:
                member.start()
            case "stop" if member.alive:
                member.stop(rng.uniform(0.5, 5.0))
            case "slow":
                member.slow = rng.uniform(0.1, 2.0)
            case "cut":
                self.cut.update((member.number, rng.choice(self.members).number) for _ in range(self.count // 3))
            case "version" if member.alive:
                member.detector.set_version(member.detector.view().version + 1, self.world.now)
                member.flush()
            case _:
                pass
