"""``python -m bench [NAME ...] [--quick] [--json FILE]``; without a name: all of them, in the order of the table."""

from __future__ import annotations

import argparse
import sys
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Final

from rich.console import Console

from bench import (
    bed,
    bookkeeping,
    crosstraffic,
    decision,
    idle,
    joining,
    load,
    path,
    peers,
    period,
    profile,
    roscore,
    scale,
    services,
    startup,
    storm,
    tasks,
    throughput,
)
from rmpa.experiments.bed import namespaces

if TYPE_CHECKING:
    from collections.abc import Callable

    Measure = Callable[[bool, Console, Path | None], object]


@dataclass(frozen=True, slots=True)
class Measurement:
    """One name of the command line.

    Args:
        about: What it finds out, in a few words.
        measure: Takes whether few samples will do, where to print, and a file for the result.
        needs: Each says why it cannot run here, or an empty string.
        realtime: Takes the same, and measures with nodes and agents under SCHED_FIFO.
    """

    about: str
    measure: Measure
    needs: tuple[Callable[[], str], ...] = (bed.why_no_ros, bed.why_no_hosts)
    realtime: Measure | None = None


MEASUREMENTS: Final[dict[str, Measurement]] = {
    "path": Measurement("how late a message is, on every path", path.run, needs=()),  # leaves out what cannot start
    "period": Measurement(
        "how evenly messages arrive", period.measure, realtime=partial(period.measure, realtime=True)
    ),
    "crosstraffic": Measurement(
        "a command beside images on 100 Mbit/s",
        crosstraffic.measure,
        realtime=partial(crosstraffic.measure, realtime=True),
    ),
    "load": Measurement("a command while every core is busy", load.measure),
    "storm": Measurement(
        "a stream while the core is asked 200 times a second",
        storm.measure,
        realtime=partial(storm.measure, realtime=True),
    ),
    "scale": Measurement("what more peers and more topics cost one stream", scale.measure),
    "peers": Measurement("who else carries bytes, in the same run", peers.measure, needs=()),  # likewise
    "profile": Measurement("what a relayed message costs an agent, and where that goes", profile.measure),
    "throughput": Measurement("how much goes through", throughput.measure),
    "startup": Measurement("how soon the first message arrives", startup.measure),
    "joining": Measurement(
        "how soon modules and their graphs are joined, and what a mesh costs while nothing happens", joining.measure
    ),
    "services": Measurement("a service call through two agents, and a direct one", services.measure),
    "roscore": Measurement(
        "what it costs to follow a real roscore, and how soon changes are seen", roscore.measure, (bed.why_no_ros,)
    ),
    "idle": Measurement("what an agent costs while nothing happens", idle.measure),
    "tasks": Measurement(
        "how evenly a resource's task runs, beside loops of rospy and roscpp",
        tasks.measure,
        (bed.why_no_ros,),
        partial(tasks.measure, realtime=True),
    ),
    "decision": Measurement("how long a resource takes to decide", decision.measure, needs=()),
    "bookkeeping": Measurement("what measuring quality costs, and how soon a resource adapts", bookkeeping.measure),
}


def main() -> int:
    """Run what the command line asks for."""
    parser = argparse.ArgumentParser(
        prog="python -m bench",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
        epilog="\n".join(f"  {name:12} {row.about}" for name, row in MEASUREMENTS.items()),
    )
    parser.add_argument("measurement", nargs="*", metavar="NAME", help="which of those below; default: all")
    parser.add_argument("--quick", action="store_true", help="few samples: to see whether it works, not to quote")
    parser.add_argument("--json", type=Path, help="write the result there too (with one measurement)")
    parser.add_argument("--only", default="", help="path: these contenders, comma-separated")
    parser.add_argument(
        "--realtime",
        action="store_true",
        help=f"{', '.join(name for name, row in MEASUREMENTS.items() if row.realtime)}: "
        "nodes and agents under SCHED_FIFO, so that other processes of this machine are out of the figures",
    )
    args = parser.parse_args()
    if unknown := [name for name in args.measurement if name not in MEASUREMENTS]:
        parser.error(f"no such measurement: {', '.join(unknown)}; there are {', '.join(MEASUREMENTS)}")
    console = Console(width=130 if not sys.stdout.isatty() else None)
    if not bed.why_no_hosts():
        namespaces.remove_stale()
    for name in args.measurement or MEASUREMENTS:
        row = MEASUREMENTS[name]
        if reason := next(filter(None, (why() for why in row.needs)), ""):
            console.print(f"{name} is left out: {reason}", style="yellow")
        elif name == "path" and args.only:
            plan = path.QUICK if args.quick else path.FULL
            path.measure(replace(plan, only=tuple(args.only.split(","))), console, args.json)
        else:
            measure = (args.realtime and row.realtime) or row.measure
            measure(args.quick, console, args.json)
    return 0


if __name__ == "__main__":
    sys.exit(main())
