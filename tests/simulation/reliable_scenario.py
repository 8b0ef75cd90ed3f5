"""One reliable route through bad times; then it heals, and the fate of every message must be known exactly.

``python -m tests.simulation --kind reliable --seed N`` replays one with its whole trace.
"""

from __future__ import annotations

from typing import Final

from rmpa.core import limits
from tests.simulation.network import Network, Weather, World
from tests.simulation.reliable_ends import Bounds, Exporter, Importer
from tests.simulation.scenario import Disagreement, Outcome

TROUBLES: Final = ("cut", "cut", "cut", "outage", "outage", "replace", "exporter", "importer")
_SETTLED: Final = 2.0
"""Seconds within which a route stands again and late bytes have come."""
_DRAINED: Final = 30.0
"""Seconds within which a whole outage's messages have come, one for each acknowledgement in the smallest window."""


class ReliableScenario:
    """A publisher, a route, and what happens to its links.

    Args:
        seed: Everything follows from it.
        bounds: Of the senders; by the seed if left out.
        keep: Keep the whole trace.
    """

    def __init__(self, seed: int, bounds: Bounds | None = None, *, keep: bool = False) -> None:
        self.seed = seed
        self.world = World(seed, keep=keep)
        self.network = Network(self.world)
        rng = self.world.rng
        self.bounds = bounds or Bounds(
            depth=rng.choice([2, 10, 100_000, 100_000]),
            max_bytes=rng.choice([200, 1 << 30, 1 << 30]),
            window_messages=rng.choice([1, 8, 64, 256]),
            window_bytes=rng.choice([100, 1 << 20]),
        )
        self.budget: dict[str, int] = {}
        """``exporter`` or ``importer`` to the bytes that it still reads before ``trouble``."""
        self.read = {"exporter": 0, "importer": 0}
        """The bytes that they have read."""
        self.trouble = ""
        self.exporter = Exporter(
            self.network, self.bounds, lambda count: self._allow("exporter", count), lambda: self.happen(self.trouble)
        )
        self.importer = Importer(
            self.network, lambda count: self._allow("importer", count), lambda: self.happen(self.trouble)
        )
        self.replaced = self.broken = False

    def play(self, troubles: tuple[str, ...] = TROUBLES) -> Outcome:
        """Messages and troubles, healing, and the check.

        Raises:
            Disagreement: A message was lost unseen, doubled, or out of order.
        """
        rng = self.world.rng
        self.network.weather = Weather(delay=(0.0001, rng.choice([0.0005, 0.005, 0.03])))
        for _ in range(rng.randint(1, 7)):
            for _ in range(rng.randint(0, 12)):
                self.exporter.publish(rng.choice([0, 4, 8, 9, 30, 80]))
                self.world.run(self.world.now + rng.choice([0.0, 0.0, 0.001, 0.01]) * rng.random())
            self.happen(rng.choice(troubles))
        return self.settle()

    def settle(self) -> Outcome:
        """All is well again: let everything come that can, and check."""
        self.network.weather = Weather()
        self.budget.clear()
        self.world.run(self.world.now + _SETTLED)
        latest = self.world.now + _DRAINED
        while (sender := self.exporter.sender) is not None and not sender.idle and self.world.now < latest:
            self.world.run(self.world.now + _SETTLED)
        try:
            self.check()
        except AssertionError as error:
            raise Disagreement(self._report(error)) from error
        return Outcome(self.world.trace_hash, tuple(self.world.lines), 0)

    def happen(self, trouble: str) -> None:
        """Something bad."""
        self.world.note("network", trouble)
        rng = self.world.rng
        if trouble == "cut":
            self.cut(rng.choice(["exporter", "importer"]))
        elif trouble == "outage":
            self.outage(rng.choice([0.05, 0.3, 1.0, limits.RESUME_WINDOW + 1, 600.0]) * (0.5 + rng.random() / 2))
        elif trouble == "replace":
            self.replaced = True
            self.importer.dial()
            self.flow(10, self.network.delay() / 3)
        else:
            self.broken = True
            (self.exporter if trouble == "exporter" else self.importer).restart()

    def flow(self, count: int, period: float) -> None:
        """So many messages, evenly."""
        start = self.world.now
        for number in range(count):
            self.exporter.publish(4)
            self.world.run(start + (number + 1) * period)

    def cut(self, side: str) -> None:
        """The present link breaks; this side notices it first."""
        wire = self.exporter.wire if side == "exporter" else self.importer.wire
        if wire is not None:
            wire.cut()

    def outage(self, seconds: float, rate: float = 20.0) -> None:
        """No link for some time, while messages go on at some rate."""
        self.importer.wants = False
        self.cut("importer")
        self.flow(round(seconds * rate), 1 / rate)
        self.importer.wants = True
        self.importer.dial()

    def check(self) -> None:
        """In order, none doubled; each missing one within a gap that says so; the last epoch complete."""
        exporter = self.exporter
        numbers = [got.number for life in self.importer.lives for got in life.received]
        assert numbers == sorted(set(numbers)), "out of order or doubled"
        for life in self.importer.lives:
            last: dict[int, int] = {}
            for got in life.received:
                before = last.get(got.epoch, exporter.starts[got.epoch] - 1)
                assert got.gap == got.number - before - 1, f"{got} behind {before}"
                last[got.epoch] = got.number
            seen = sum(got.gap for got in life.received)
            assert life.gaps == seen + sum(life.unseen.values())
        self._check_last_epoch()
        if self.bounds == Bounds() and not self.broken and not exporter.gave_up:
            first = exporter.starts[self.importer.lives[0].epochs[0]]
            assert numbers == list(range(first, exporter.published)), "lost though it fitted"

    def _check_last_epoch(self) -> None:
        sender, life = self.exporter.sender, self.importer.lives[-1]
        assert sender is not None, "no link after healing"
        assert (sender.idle, sender.pending, sender.pending_bytes) == (True, 0, 0)
        assert life.epochs[-1] == sender.epoch
        got = [g for g in life.received if g.epoch == sender.epoch]
        offered = self.exporter.published - self.exporter.starts[sender.epoch]
        gaps = sum(g.gap for g in got) + life.unseen.get(sender.epoch, 0)
        assert len(got) + gaps == offered, f"{len(got)} came, {gaps} are known to be lost, of {offered}"
        assert sender.overflowed >= gaps
        if not self.replaced:
            assert sender.overflowed == gaps, "both ends count the same"
        if self.bounds.depth >= offered and self.bounds.max_bytes == 1 << 30 and not self.exporter.gave_up:
            assert gaps == 0, "lost though it fitted"

    def _allow(self, side: str, count: int) -> int:
        self.read[side] += count
        left = self.budget.get(side, count)
        if count > left:
            del self.budget[side]
            return left
        if side in self.budget:
            self.budget[side] = left - count
        return count

    def _report(self, error: AssertionError) -> str:
        lines = "\n".join(list(self.world.lines)[-60:])
        return (
            f"{error}\n--- the last events ---\n{lines}\n--- all of them, exactly so again ---\n"
            f"python -m tests.simulation --kind reliable --seed {self.seed}\n"
        )
