"""Replay one simulated network and print what happened."""

from __future__ import annotations

import argparse
import sys

from tests.simulation.direct_scenario import DirectScenario
from tests.simulation.mesh_scenario import MeshScenario, RestsScenario
from tests.simulation.scenario import Scenario


def main() -> int:
    """Print the trace and its hash; 1 if the peers do not agree, or a message was lost unseen."""
    parser = argparse.ArgumentParser(prog="python -m tests.simulation", description=__doc__)
    parser.add_argument("--seed", type=int, required=True)
    parser.add_argument("--peers", type=int, default=2, help="not with --kind direct")
    kinds = ["rosters", "mesh", "direct", "rests"]
    parser.add_argument("--kind", choices=kinds, default="rosters")
    arguments = parser.parse_args()
    scenario: Scenario | DirectScenario
    if arguments.kind == "direct":
        scenario = DirectScenario(arguments.seed, keep=True)
    else:
        make = {"rosters": Scenario, "mesh": MeshScenario, "rests": RestsScenario}[arguments.kind]
        scenario = make(arguments.seed, arguments.peers, keep=True)
    problem = ""
    try:
        scenario.play()
    except AssertionError as error:
        problem = str(error).splitlines()[0]
    print("\n".join(scenario.world.lines))
    print(f"trace {scenario.world.trace_hash}")
    print(f"DISAGREE: {problem}" if problem else "all agree")
    return 1 if problem else 0


if __name__ == "__main__":
    sys.exit(main())
