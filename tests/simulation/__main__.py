"""Replay one simulated network and print what happened."""

from __future__ import annotations

import argparse
import json
import sys
from dataclasses import asdict
from pathlib import Path

from tests.simulation.direct_scenario import DirectScenario
from tests.simulation.lanes_scenario import LanesScenario
from tests.simulation.large_scenario import LargeScenario
from tests.simulation.mesh_scenario import MeshScenario
from tests.simulation.reliable_scenario import ReliableScenario
from tests.simulation.rests_scenario import RestsScenario
from tests.simulation.scenario import Scenario
from tests.simulation.swim_scenario import SwimScenario


def main() -> int:
    """Print the trace and its hash; 1 if the peers do not agree, or a message was lost unseen."""
    parser = argparse.ArgumentParser(prog="python -m tests.simulation", description=__doc__)
    parser.add_argument("--seed", type=int, required=True)
    parser.add_argument("--peers", type=int, default=2, help="not with --kind reliable and direct")
    kinds = ["rosters", "mesh", "lanes", "reliable", "direct", "swim", "rests", "thousand"]
    parser.add_argument("--kind", choices=kinds, default="rosters")
    parser.add_argument("--loss", type=float, default=0.01, help="thousand: share of datagrams that are lost")
    parser.add_argument("--parts", default="", help="thousand: also churn, partition; comma-separated")
    parser.add_argument("--json", type=Path, help="thousand: write the figures there")
    arguments = parser.parse_args()
    if arguments.kind == "thousand":
        return _play_large(arguments)
    scenario: Scenario | ReliableScenario | DirectScenario | SwimScenario
    if arguments.kind == "direct":
        scenario = DirectScenario(arguments.seed, keep=True)
    elif arguments.kind == "swim":
        scenario = SwimScenario(arguments.seed, arguments.peers, keep=True)
    elif arguments.kind == "reliable":
        scenario = ReliableScenario(arguments.seed, keep=True)
    else:
        make = {"rosters": Scenario, "mesh": MeshScenario, "lanes": LanesScenario, "rests": RestsScenario}[
            arguments.kind
        ]
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


def _play_large(arguments: argparse.Namespace) -> int:
    """Play a large mesh; print what it showed while it goes on."""
    parts = tuple(filter(None, arguments.parts.split(",")))
    scenario = LargeScenario(arguments.seed, arguments.peers, loss=arguments.loss, parts=parts, say=_say)
    text = json.dumps(asdict(scenario.play()), indent=1)
    print(text)
    if arguments.json is not None:
        arguments.json.write_text(text + "\n")
    return 0


def _say(line: str) -> None:
    print(line, flush=True)


if __name__ == "__main__":
    sys.exit(main())
