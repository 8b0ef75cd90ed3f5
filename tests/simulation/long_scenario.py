"""A mesh for hours, of which packets are lost all the time: no living module may be held to have failed.

The real machines of every agent run together: beacons with their leases, probes, dialling. Once an hour a module
loses its power, which all others must notice, and starts again: so a detector that sees nothing does not pass.

``python -m tests.simulation --kind long --hours 24 --loss 0.01 --peers 32 --seed 1`` plays one; ``make soak-swim``.
"""

from __future__ import annotations

import gc
import resource
import time
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Final

from tests.simulation.large_module import Module, Tally
from tests.simulation.large_network import LargeNetwork

if TYPE_CHECKING:
    from collections.abc import Callable

HOUR: Final = 3600.0
SETTLE: Final = 60.0
"""Seconds after the start until suspicions are counted."""
KILL_AFTER: Final = 1800.0
"""Seconds of each hour after which a module loses its power."""
DOWN: Final = 60.0
"""Seconds for which it is gone: longer than any lease at this size."""
NOTICED_WITHIN: Final = 30.0
DELAY: Final = (0.0002, 0.02)
"""Seconds of a packet's way: Wi-Fi."""


@dataclass
class LongFigures:
    """What the hours showed. Suspicions and losses are counted at each module that held one."""

    modules: int
    seed: int
    loss: float
    hours: float = 0.0
    suspected_falsely: int = 0
    lost_falsely: int = 0
    falsely: list[str] = field(default_factory=list)
    """The last lines of the trace, if there was a false loss."""
    killed: int = 0
    missed: int = 0
    """Pairs of a living and a killed module that did not notice it within half a minute."""
    noticed_worst: float = 0.0
    """Seconds until a killed module was known to all, the longest of them."""
    messages: float = 0.0
    """Sent and received, by a module and second."""
    bytes: float = 0.0
    trace: str = ""
    """Hash of all that was noted: equal for equal seeds."""
    cpu: float = 0.0
    rss_mb: float = 0.0


class LongScenario:
    """Modules that link on demand, whatever their number, at rest for hours.

    Args:
        seed: Everything follows from it.
        count: How many modules.
        loss: Share of datagrams that are lost.
        hours: How long, on the simulated clock.
        say: Called with a line after each hour.
    """

    def __init__(
        self, seed: int, count: int, *, loss: float, hours: float, say: Callable[[str], None] = lambda _: None
    ) -> None:
        self.figures = LongFigures(count, seed, loss)
        self.network = LargeNetwork(seed, loss, DELAY)
        self.world = self.network.world
        self.tally = Tally()
        self.modules = [Module(self.network, number + 1, self.tally, demand=True) for number in range(count)]
        self._hours = hours
        self._say = say

    def play(self) -> LongFigures:
        """Play all hours; return what they showed."""
        began = time.process_time()
        rng = self.world.rng
        for module in self.modules:
            module.wants = {rng.choice(self.modules).place} - {module.place}
            self.world.after(rng.random(), module.start)
        self.world.run(self.world.now + SETTLE)
        gc.collect()
        gc.freeze()  # the mesh itself stays: it need not be looked through again and again
        start, figures = self.world.now, self.figures
        suspected, packets, size = self.tally.suspected_falsely, *self._traffic()
        while (left := start + self._hours * HOUR - self.world.now) > 0:
            self._hour(min(HOUR, left))
            seconds = self.world.now - start
            figures.hours = seconds / HOUR
            figures.suspected_falsely = self.tally.suspected_falsely - suspected
            figures.lost_falsely = self.tally.lost_falsely
            sent, octets = self._traffic()
            figures.messages = (sent - packets) / seconds / len(self.modules)
            figures.bytes = (octets - size) / seconds / len(self.modules)
            figures.cpu = time.process_time() - began
            self._say(
                f"{figures.hours:g} h: {figures.lost_falsely} false losses, {figures.suspected_falsely} false "
                f"suspicions; {figures.killed} killed, {figures.missed} not noticed, the last after "
                f"{figures.noticed_worst:.1f} s at worst ({figures.cpu:.0f} s of processor time)"
            )
        if figures.lost_falsely:
            figures.falsely = list(self.world.lines)
        figures.trace = self.world.trace_hash
        figures.rss_mb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
        gc.unfreeze()
        return figures

    def _hour(self, seconds: float) -> None:
        end = self.world.now + seconds
        if seconds > KILL_AFTER + 2 * DOWN:
            self.world.run(self.world.now + KILL_AFTER)
            self._kill_one()
        self.world.run(end)

    def _kill_one(self) -> None:
        victim = self.world.rng.choice(self.modules)
        others = [module for module in self.modules if module is not victim]
        for module in others:
            module.watch = True
            module.lost_at.clear()
        killed = self.world.now
        self.world.note(victim.name, "is killed")
        victim.kill()
        self.world.run(killed + NOTICED_WITHIN)
        noticed = [module.lost_at[victim.place] - killed for module in others if victim.place in module.lost_at]
        self.figures.killed += 1
        self.figures.missed += len(others) - len(noticed)
        self.figures.noticed_worst = max([self.figures.noticed_worst, *noticed])
        self.world.run(killed + DOWN)
        victim.start()

    def _traffic(self) -> tuple[int, int]:
        rows = self.network.traffic.values()
        return sum(r.sent + r.received for r in rows), sum(r.sent_bytes + r.received_bytes for r in rows)
