"""Replay one simulated network and print what happened."""

from __future__ import annotations

import argparse
import json
import sys
from dataclasses import asdict
from pathlib import Path

from tests.simulation.direct_scenario import DirectScenario
from tests.simulation.lanes_scenario import LanesScenario
from tests.simulation.large_scenario import PARTS, USUAL_PARTS, Figures, LargeScenario
from tests.simulation.mesh_scenario import MeshScenario
from tests.simulation.rests_scenario import RestsScenario
from tests.simulation.scenario import Scenario


def main() -> int:
    """Print the trace and its hash; 1 if the peers do not agree, or a message was lost unseen."""
    parser = argparse.ArgumentParser(prog="python -m tests.simulation", description=__doc__)
    parser.add_argument("--seed", type=int, required=True)
    parser.add_argument("--peers", type=int, default=2, help="not with --kind direct")
    kinds = ["rosters", "mesh", "lanes", "direct", "rests", "large"]
    parser.add_argument("--kind", choices=kinds, default="rosters")
    parser.add_argument("--loss", type=float, default=0.01, help="large: share of datagrams that are lost")
    parser.add_argument(
        "--parts",
        default=",".join(USUAL_PARTS),
        help=f"large: of {','.join(PARTS)}; %(default)s",
    )
    parser.add_argument("--json", type=Path, help="large: write the figures there")
    arguments = parser.parse_args()
    if arguments.kind == "large":
        return _play_large(arguments)
    scenario: Scenario | DirectScenario
    if arguments.kind == "direct":
        scenario = DirectScenario(arguments.seed, keep=True)
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
    if unknown := set(parts) - set(PARTS):
        print(f"no such parts: {', '.join(sorted(unknown))}; there are {', '.join(PARTS)}", file=sys.stderr)
        return 2
    scenario = LargeScenario(arguments.seed, arguments.peers, loss=arguments.loss, parts=parts, say=_say)
    _write(scenario.play(), arguments.json)
    return 0


def _write(figures: Figures, file: Path | None) -> None:
    text = json.dumps(asdict(figures), indent=1)
    print(text)
    if file is not None:
        file.write_text(text + "\n")


def _say(line: str) -> None:
    print(line, flush=True)


if __name__ == "__main__":
    sys.exit(main())
