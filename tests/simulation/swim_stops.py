"""How long the process of one member may be stopped before the others hold it to have failed, by the mesh's size.

``python -m tests.simulation.swim_stops`` prints a line for each size; the figures are in docs/design/decisions.md.
"""

from __future__ import annotations

import argparse
from typing import Final

from tests.simulation.swim_scenario import SwimScenario

SIZES: Final = (3, 5, 10, 30, 100)
SPANS: Final = (0.75, 1.0, 1.25, 1.5, 1.75, 2.0, 2.5, 3.0)
SETTLE: Final = 10.0
"""Seconds after each stop until all members agree again."""
NOTICED: Final = 5.0
"""Seconds after each stop in which a failure would become known."""


def failures(seed: int, count: int, span: float, trials: int) -> int:
    """In how many of the trials a member that was stopped for ``span`` seconds was held to have failed."""
    scenario = SwimScenario(seed, count, loss=0.01, delay=(0.0002, 0.003))
    scenario.start()
    scenario.run(8)
    held = 0
    for _ in range(trials):
        scenario.figures.lost_at.clear()
        member = scenario.world.rng.choice(scenario.living())
        member.stop(span)
        scenario.run(span + NOTICED)
        held += member.identity.instance in scenario.figures.lost_at
        scenario.run(SETTLE)
    return held


def main() -> None:
    """Print the figures."""
    parser = argparse.ArgumentParser(prog="python -m tests.simulation.swim_stops", description=__doc__)
    parser.add_argument("--seed", type=int, default=7)
    parser.add_argument("--trials", type=int, default=60)
    parser.add_argument("--members", type=int, nargs="+", default=SIZES)
    arguments = parser.parse_args()
    for count in arguments.members:
        found = (f"{span:g} s {failures(arguments.seed, count, span, arguments.trials)}" for span in SPANS)
        print(f"{count} members, held to have failed in {arguments.trials} stops of: {', '.join(found)}", flush=True)


if __name__ == "__main__":
    main()
