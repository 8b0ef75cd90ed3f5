"""``python -m tests.soak [--seconds N] [--seed N]``: disturb three modules for long, and check that nothing leaks.

Network namespaces and real nodes, so root and Debian's ROS 1 are needed. The seed of a run is printed; it brings the
same disturbances again. Logs stay in the folder that is named at the end if something went wrong.
"""

from __future__ import annotations

import argparse
import random
import shutil
import sys
import tempfile
import time
from pathlib import Path

from lab.bed import namespaces
from lab.bed.processes import BedError
from tests.interop import ros
from tests.soak import chaos
from tests.soak.held import MB, Held, growth, left, look, too_much
from tests.soak.stage import STEADY, Stage, leftovers

_GIVEN_BACK = 30.0
"""Seconds in which an agent releases what its nodes no longer use."""


class Soak:
    """One run.

    Args:
        seconds: How long, without start and end.
        seed: Of the disturbances.
        home: Existing directory for logs.
    """

    def __init__(self, seconds: float, seed: int, home: Path) -> None:
        self.problems: list[str] = []
        self._seconds = seconds
        self._rng = random.Random(seed)
        self._home = home
        self._begin = time.monotonic()
        self._samples: dict[str, list[Held]] = {name: [] for name in STEADY}
        self._disturbances = 0

    def run(self) -> None:
        """Run the soak; see ``problems``."""
        try:
            with Stage(self._home) as stage:
                stage.open()
                before = {name: look(stage.modules[name].agent, 0.0) for name in STEADY}
                self._populate(stage)
                self._begin = time.monotonic()
                while self._now < self._seconds and len(self.problems) < 20:
                    self._disturb(stage)
                self._end(stage, before)
        except (AssertionError, BedError) as error:
            self.problems.append(str(error))
        self.problems += [f"network namespace {name} is left" for name in leftovers()]

    @property
    def _now(self) -> float:
        return time.monotonic() - self._begin

    def _populate(self, stage: Stage) -> None:
        stage.populate()
        self.problems += stage.settle()

    def _disturb(self, stage: Stage) -> None:
        """Cause one disturbance, or two at once; then wait for calm and take a sample."""
        texts = []
        for _ in range(self._rng.choice((1, 1, 2))):
            text, act = chaos.draw(self._rng, stage)
            texts.append(text)
            self.problems += self._told(text, act())
            self._disturbances += 1
        began = time.monotonic()
        self.problems += self._told(" and ".join(texts), stage.settle())
        calm = time.monotonic() - began
        for name, samples in self._samples.items():
            samples.append(look(stage.modules[name].agent, self._now))
        shown = "; ".join(f"{name}: {samples[-1]}" for name, samples in self._samples.items())
        print(f"{self._now:6.0f} s  {', '.join(texts)}: calm after {calm:.1f} s  [{shown}]", flush=True)

    def _told(self, what: str, problems: list[str]) -> list[str]:
        for problem in problems:
            print(f"{self._now:6.0f} s  PROBLEM after {what}: {problem}", flush=True)
        return [f"{problem} (after {what})" for problem in problems]

    def _end(self, stage: Stage, before: dict[str, Held]) -> None:
        """End the nodes: then the agents must hold what they held before there were any."""
        self.problems += stage.drain()
        self.problems += stage.depopulate()
        for name, was in before.items():
            agent, samples = stage.modules[name].agent, self._samples[name]
            deadline = time.monotonic() + _GIVEN_BACK
            while (rest := left(was, now := look(agent, self._now))) and time.monotonic() < deadline:
                time.sleep(1.0)
            self.problems += [f"agent {name} still holds {text}" for text in rest]
            if text := too_much(samples):
                self.problems.append(f"agent {name}: {text}")
            rose = growth(samples)
            flat = "too short a time to tell" if rose is None else f"{rose / MB:+.2f} MB in the second half"
            print(f"agent {name}: before: {was}; afterwards: {now}; memory: {flat}")
        print(f"{self._disturbances} disturbances; {stage.heard} messages of reliable topics, each once, in order")


def main() -> int:
    """Run the soak; return 1 if something went wrong."""
    parser = argparse.ArgumentParser(prog="python -m tests.soak", description=__doc__)
    parser.add_argument("--seconds", type=float, default=600.0, help="how long (default: 600)")
    parser.add_argument("--seed", type=int, default=None, help="of the disturbances (default: a new one, printed)")
    options = parser.parse_args()
    if reason := ros.why_not() or namespaces.why_not():
        print(f"the soak cannot run here: {reason}", file=sys.stderr)
        return 2
    namespaces.remove_stale()
    seed = options.seed if options.seed is not None else random.SystemRandom().randrange(1 << 32)
    print(f"seed {seed}", flush=True)
    home = Path(tempfile.mkdtemp(prefix="rmpa-soak-"))
    soak = Soak(options.seconds, seed, home)
    try:
        soak.run()
    except KeyboardInterrupt:
        soak.problems.append("interrupted")
    if soak.problems:
        print(f"\nFAILED (seed {seed}); logs are in {home}")
        for problem in soak.problems:
            print(f"* {problem}")
        return 1
    shutil.rmtree(home)
    print(f"no failure in {options.seconds:g} s (seed {seed})")
    return 0


if __name__ == "__main__":
    sys.exit(main())
