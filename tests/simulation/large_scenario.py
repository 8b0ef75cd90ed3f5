"""A large mesh: a flash start, rest, changed offers, a third killed at once, a partition, one module too many.

``python -m tests.simulation --kind large --seed N --peers M`` plays one and prints its figures.
"""

from __future__ import annotations

import functools
import gc
import resource
import time
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Final

from tests.simulation.large_module import TOPICS, Module, Tally
from tests.simulation.large_network import LargeNetwork, Traffic

if TYPE_CHECKING:
    from collections.abc import Callable

START_SPREAD: Final = 1.0
"""Seconds within which all modules start."""
REST_AFTER: Final = 30.0
"""Seconds after which all links are at rest."""
REST: Final = 20.0
LOOK: Final = 0.1
SINGLE_KILLS: Final = 3
PARTS: Final = ("rest", "offers", "kills", "third", "churn", "partition", "surplus")
USUAL_PARTS: Final = PARTS[:4]
CHANGED: Final = 10
"""Modules that change their offers at one time."""


@dataclass
class Figures:
    """What one scenario showed. Times in seconds; ``None``: not within the time that was given."""

    modules: int
    seed: int
    loss: float
    topics: int = TOPICS
    members_after: float | None = None
    graphs_after: float | None = None
    links_made: int = 0
    links_at_once: int = 0
    links_at_rest: int = 0
    start_bytes: float = 0.0
    rest_messages: float = 0.0
    rest_bytes: float = 0.0
    rest_by_kind: dict[str, float] = field(default_factory=dict)
    rest_cpu_percent: float = 0.0
    start_cpu: float = 0.0
    lost_falsely: int = 0
    changed_after: float | None = None
    killed: int = 0
    one_killed: list[float | None] = field(default_factory=list)
    killed_median: float | None = None
    killed_p99: float | None = None
    killed_all: float | None = None
    parted_lost: float | None = None
    healed_after: float | None = None
    churn_after: float | None = None
    surplus_links: int = 0
    """Links of the module that came to a full mesh."""
    surplus_others: int = 0
    """Links of the others, while it was there."""
    surplus_joined: float | None = None
    """Seconds until it had all links, after another one had been killed."""
    seconds: float = 0.0
    cpu: float = 0.0
    rss_mb: float = 0.0


class LargeScenario:
    """A large mesh through what a large mesh meets.

    Args:
        seed: Everything follows from it.
        count: How many modules.
        loss: Share of datagrams that are lost.
        say: Called with a line after each part.
        parts: Those of ``PARTS`` that are played after the flash start, in this order. Churn needs killed modules,
            and so plays ``third`` too.
        settle: Seconds after the start until rest is measured.
    """

    def __init__(
        self,
        seed: int,
        count: int,
        *,
        loss: float = 0.01,
        say: Callable[[str], None] = lambda _: None,
        parts: tuple[str, ...] = USUAL_PARTS,
        settle: float = REST_AFTER,
    ) -> None:
        self.figures = Figures(count, seed, loss)
        self.network = LargeNetwork(seed, loss)
        self.world = self.network.world
        self.tally = Tally()
        self.modules = [Module(self.network, number + 1, self.tally) for number in range(count)]
        self._parts = parts
        self._settle = settle
        self._disagrees = 0
        self._say = say

    def play(self) -> Figures:
        """Play all parts; return what they showed."""
        gc.disable()  # millions of objects that all stay: looking for cycles would be most of the work
        try:
            return self._play()
        finally:
            gc.enable()

    def _play(self) -> Figures:
        began = time.process_time()
        self._flash_start()
        play = {
            "rest": self._rest,
            "offers": self._change_offers,
            "kills": self._kill_some,
            "third": self._kill_a_third,
            "churn": self._churn,
            "partition": self._part,
            "surplus": self._one_too_many,
        }
        self.world.run(max(self.world.now, 1000.0 + self._settle))
        for part in PARTS:
            if part in self._parts or (part == "third" and "churn" in self._parts):
                play[part]()
        self.figures.lost_falsely = self.tally.lost_falsely
        self.figures.seconds = self.world.now - 1000.0
        self.figures.cpu = time.process_time() - began
        self.figures.rss_mb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
        return self.figures

    # --- parts ------------------------------------------------------------------------------------------------

    def _flash_start(self) -> None:
        """All start within a second; two in a hundred pairs use each other's data."""
        rng = self.world.rng
        for module in self.modules:
            module.wants = {rng.choice(self.modules).place for _ in range(2)} - {module.place}
            self.world.after(START_SPREAD * rng.random(), module.start)
        self.modules[len(self.modules) // 2].metered = True
        began = self.world.now
        self.world.run(began + START_SPREAD)
        self.figures.members_after = self._until(self._members_agree, began, 60.0)
        self.figures.graphs_after = self._until(self._graphs_agree, began, 60.0)
        self.figures.links_made = self.tally.links_made
        self.figures.links_at_once = self.tally.links
        total = sum(row.sent_bytes + row.received_bytes for row in self.network.traffic.values())
        self.figures.start_bytes = total / len(self.modules)
        self.figures.start_cpu = self.modules[len(self.modules) // 2].cpu
        members, graphs = _s(self.figures.members_after), _s(self.figures.graphs_after)
        self._say(f"flash start: all members known everywhere after {members}, all graphs after {graphs}")

    def _rest(self) -> None:
        """Nothing happens; what does that cost?"""
        metered = self.modules[len(self.modules) // 2]
        before, cpu = {kind: _copy(row) for kind, row in self.network.traffic.items()}, metered.cpu
        self.world.run(self.world.now + REST)
        per = len(self.modules) * REST
        kinds = self.network.traffic
        for kind, row in kinds.items():
            old = before.get(kind, Traffic())
            size = row.sent_bytes + row.received_bytes - old.sent_bytes - old.received_bytes
            self.figures.rest_by_kind[kind] = size / per
            self.figures.rest_bytes += size / per
            self.figures.rest_messages += (row.sent + row.received - old.sent - old.received) / per
        self.figures.rest_cpu_percent = 100 * (metered.cpu - cpu) / REST
        self.figures.links_at_rest = self.tally.links
        self._say(
            f"at rest {self.figures.rest_bytes / 1000:.2f} KB/s and {self.figures.rest_messages:.0f} messages/s"
        )

    def _change_offers(self) -> None:
        """Some modules advertise something new at one time."""
        began = self.world.now
        for module in self.world.rng.sample(self.modules, min(CHANGED, len(self.modules))):
            module.change_offers()
        self.figures.changed_after = self._until(self._graphs_agree, began, 60.0)
        self._say(f"changed offers known everywhere after {_s(self.figures.changed_after)}")
        self.world.run(self.world.now + 15.0)

    def _kill_some(self) -> None:
        """A machine loses its power, some times one after the other."""
        for _ in range(SINGLE_KILLS):
            times, pairs = self._kill(1)
            self.figures.one_killed.append(times[-1] if len(times) == pairs else None)
        self._say(f"one killed module known to all after {', '.join(map(_s, self.figures.one_killed))}")

    def _kill_a_third(self) -> None:
        """A third of the machines lose their power at once."""
        figures = self.figures
        figures.killed = len(self.network.modules) // 3
        times, pairs = self._kill(figures.killed)
        if times:
            figures.killed_median, figures.killed_p99 = times[len(times) // 2], times[len(times) * 99 // 100]
        if len(times) == pairs:
            figures.killed_all = times[-1]
        self._say(f"{figures.killed} killed modules known to all after {_s(figures.killed_all)}")

    def _kill(self, count: int) -> tuple[list[float], int]:
        """Kill so many modules; when each living one noticed each dead one, and how often it had to."""
        began = self.world.now
        victims = self.world.rng.sample(sorted(self.network.modules.values(), key=lambda m: m.place), count)
        dead = {module.place for module in victims}
        for module in self.modules:
            module.watch = True
            module.lost_at.clear()
        for module in victims:
            module.kill()
        living = [module for module in self.modules if module.alive]
        self._until(lambda: all(len(module.lost_at.keys() & dead) == count for module in living), began, 90.0)
        times = sorted(at - began for module in living for place, at in module.lost_at.items() if place in dead)
        self.world.run(self.world.now + 5.0)
        return times, count * len(living)

    def _churn(self) -> None:
        """The killed modules come back within ten seconds, while as many others restart."""
        began = self.world.now
        back = [module for module in self.modules if not module.alive]
        for module in back:
            self.world.after(10.0 * self.world.rng.random(), module.start)
        for module in self.world.rng.sample([m for m in self.modules if m.alive], len(back) // 3):
            self.world.after(10.0 * self.world.rng.random(), functools.partial(self._restart, module))
        self.world.run(self.world.now + 10.0)
        agreed = self._until(lambda: self._members_agree() and self._graphs_agree(), began, 120.0)
        self.figures.churn_after = agreed
        self._say(f"churn: all agree {_s(agreed)} after its begin")

    def _restart(self, module: Module) -> None:
        module.kill()
        module.start()

    def _part(self) -> None:
        """The network falls into two halves for a minute, and heals."""
        began = self.world.now
        half = len(self.modules) // 2
        self.network.sides = {module.address[0]: int(n >= half) for n, module in enumerate(self.modules)}
        for module in self.modules[:half]:
            for link in list(module.links.values()):
                module.part(link)
        for module in self.modules:
            module.watch = True
            module.lost_at.clear()
        self.figures.parted_lost = self._until(
            lambda: all(len(module.lost_at) >= half for module in self.modules), began, 90.0
        )
        self.world.run(max(self.world.now, began + 60.0))
        self.network.sides = {}
        began = self.world.now
        agreed = self._until(lambda: self._members_agree() and self._graphs_agree(), began, 180.0)
        self.figures.healed_after = agreed
        self._say(
            f"partition: halves lose each other after {_s(self.figures.parted_lost)}, agree again after {_s(agreed)}"
        )

    def _one_too_many(self) -> None:
        """A module comes to a mesh that is full, and joins when a place has become free."""
        extra = Module(self.network, len(self.modules) + 1, self.tally)
        extra.start()
        self.world.run(self.world.now + 30.0)
        self.figures.surplus_links = len(extra.links)
        self.figures.surplus_others = self.tally.links - len(extra.links)
        began, count = self.world.now, len(self.modules)
        self.modules[0].kill()
        self.figures.surplus_joined = self._until(lambda: len(extra.links) == count - 1, began, 90.0)
        self._say(f"one too many: {self.figures.surplus_links} links; joins after {_s(self.figures.surplus_joined)}")

    # --- inside -----------------------------------------------------------------------------------------------

    def _pairs(self) -> int:
        living = len(self.network.modules)
        return living * (living - 1)

    def _members_agree(self) -> bool:
        return self.tally.members == self._pairs()

    def _graphs_agree(self) -> bool:
        """Whether each module knows the present offers of each other one; begins where it failed the last time."""
        living = [module for module in self.modules if module.alive]
        present = {module.place: (module.identity.instance, module.offers) for module in living}
        at = self._disagrees % len(living)
        for step, module in enumerate(living[at:] + living[:at]):
            if len(module.known) != len(living) - 1 or any(present.get(p) != k for p, k in module.known.items()):
                self._disagrees = at + step
                return False
        return True

    def _until(self, done: Callable[[], bool], began: float, within: float) -> float | None:
        """Let time pass until something holds; the seconds since ``began``, ``None`` if it took too long."""
        while not done():
            if self.world.now - began >= within:
                return None
            self.world.run(self.world.now + LOOK)
        return self.world.now - began


def _copy(row: Traffic) -> Traffic:
    return Traffic(row.sent, row.sent_bytes, row.received, row.received_bytes)


def _s(seconds: float | None) -> str:
    return "too long" if seconds is None else f"{seconds:.1f} s"
