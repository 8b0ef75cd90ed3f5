"""The paper's set-up (Fig. 7) on one machine: four modules, each with its own agent, ROS core and nodes.

make demo [SECONDS=30] [JOYSTICK=/dev/input/js0]      until Ctrl-C, or for so many seconds
make demo-kill MODULE=base                            kill -9 one module, from a second terminal
make demo-start MODULE=base                           and start it again
make demo-sites [SECONDS=30]                          the same modules at two sites, joined by gateways over a router
"""

from __future__ import annotations

import argparse
import asyncio
import importlib.util
import json
import math
import os
import signal
import stat
import sys
from pathlib import Path

from home import Home, ask, running
from sites import JOINING, SITES
from supervisor import MODULES, Refused, Supervisor


def main() -> int:
    """Do what the command line says; return the exit status."""
    options = _parser().parse_args()
    try:
        if options.command:
            return _command(options.command, options.module, options.demo)
        if options.sites:
            _explain_sites(as_json=options.json)
        if options.joystick:
            _check_joystick(options.joystick)
        return asyncio.run(_run(options))
    except (Refused, OSError) as error:
        print(f"demo: {error}", file=sys.stderr)
        return 1


async def _run(options: argparse.Namespace) -> int:
    home = Home()
    try:
        supervisor = Supervisor(
            home, joystick=options.joystick, as_json=options.json, web=options.web, sites=options.sites
        )
        for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
            asyncio.get_running_loop().add_signal_handler(number, supervisor.stop)
        await supervisor.run(options.seconds)
    finally:
        home.remove()
    for failure in supervisor.failures:
        print(f"demo: {failure}", file=sys.stderr)
    return 1 if supervisor.failures else 0


def _command(verb: str, module: str, pid: int | None) -> int:
    demos = running()
    if not demos or (pid is not None and pid not in demos):
        raise Refused("no demo runs here; start one with `make demo`" if not demos else f"no demo has the pid {pid}")
    if pid is None and len(demos) > 1:
        raise Refused(f"several demos run here; name one with --demo PID: {', '.join(map(str, demos))}")
    path = demos[pid] if pid is not None else next(iter(demos.values()))
    reply = json.loads(ask(path, json.dumps({"do": verb, "module": module}).encode()) or b'{"ok": false, "text": ""}')
    if not reply["ok"]:
        raise Refused(reply["text"] or "the demo has just ended")
    print(reply["text"])
    return 0


def _explain_sites(*, as_json: bool) -> None:
    missing = [name for name in ("zenoh", "xxhash") if importlib.util.find_spec(name) is None]
    if missing:
        raise Refused(f"{' and '.join(missing)} not installed; `make -B venv` installs it")
    if not as_json:
        places = "; ".join(f"{site}: {', '.join(modules)}" for site, modules in SITES.items())
        print(f"Two sites that do not see each other, joined by a gateway each and a router. {places}", flush=True)


def _check_joystick(device: str) -> None:
    there = ", ".join(sorted(str(path) for path in Path("/dev/input").glob("js*"))) or "no joystick at all"
    try:
        mode = Path(device).stat().st_mode
    except OSError as error:
        raise Refused(f"--joystick {device}: {error.strerror}; there is {there}") from None
    if not (stat.S_ISCHR(mode) or stat.S_ISFIFO(mode)):
        raise Refused(f"--joystick {device}: is not a device; there is {there}")
    if not os.access(device, os.R_OK):
        raise Refused(f"--joystick {device}: not for this user; join the group input: sudo usermod -aG input $USER")


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=_positive, help="end after so many seconds [default: at Ctrl-C]")
    parser.add_argument("--joystick", metavar="DEVICE", default="", help="such as /dev/input/js0 [a recorded drive]")
    parser.add_argument("--json", action="store_true", help="one JSON object a second, and the summary as the last")
    parser.add_argument("--no-web", dest="web", action="store_false", help="without the web page")
    parser.add_argument("--sites", action="store_true", help="the modules are at two sites, joined by gateways")
    parser.set_defaults(command="")
    commands = parser.add_subparsers(title="from a second terminal", metavar="COMMAND")
    for verb, text in (("kill", "kill -9 a module's agent and node"), ("start", "start a killed module again")):
        command = commands.add_parser(verb, help=text)
        names = f"one of {', '.join(MODULES)}; with --sites also {', '.join(JOINING)}"
        command.add_argument("module", metavar="MODULE", help=names)
        command.add_argument("--demo", type=int, metavar="PID", help="which demo, where several run")
        command.set_defaults(command=verb)
    return parser


def _positive(text: str) -> float:
    try:
        seconds = float(text)
    except ValueError:
        seconds = math.nan
    if not (math.isfinite(seconds) and seconds > 0):
        raise argparse.ArgumentTypeError(f"{text} is not a number of seconds")
    return seconds


if __name__ == "__main__":
    sys.exit(main())
