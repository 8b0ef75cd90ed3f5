"""``python -m bench [path|startup|idle|throughput] [--quick] [--json FILE]``; without a name: all of them."""

from __future__ import annotations

import argparse
import sys
from dataclasses import replace
from pathlib import Path

from rich.console import Console

from bench import bed, idle, path, startup, throughput
from tests.interop import namespaces

_NAMES = ("path", "startup", "idle", "throughput")


def main() -> int:
    """Run what the command line asks for."""
    parser = argparse.ArgumentParser(prog="python -m bench", description=__doc__)
    parser.add_argument("measurement", nargs="*", choices=[*_NAMES, []], help="which; default: all")
    parser.add_argument("--quick", action="store_true", help="few samples: to see whether it works, not to quote")
    parser.add_argument("--json", type=Path, help="write the result there too (with one measurement)")
    parser.add_argument("--only", default="", help="path: these contenders, comma-separated")
    args = parser.parse_args()
    console = Console(width=130 if not sys.stdout.isatty() else None)
    if not bed.why_no_hosts():
        namespaces.remove_stale()
    for name in args.measurement or _NAMES:
        if name == "path":
            plan = path.QUICK if args.quick else path.FULL
            path.measure(replace(plan, only=tuple(filter(None, args.only.split(",")))), console, args.json)
            continue
        if reason := bed.why_no_ros() or bed.why_no_hosts():
            console.print(f"{name} is left out: {reason}", style="yellow")
            continue
        measure = {"startup": startup.measure, "idle": idle.measure, "throughput": throughput.measure}[name]
        measure(args.quick, console, args.json)
    return 0


if __name__ == "__main__":
    sys.exit(main())
