"""``rmpa log``: the last log lines of the nodes and agents of all modules, in one order."""

from __future__ import annotations

import contextlib
import re
import shutil
import sys
import textwrap
import time
from datetime import datetime
from typing import TYPE_CHECKING, Final

import click

from rmpa.bridge.limits import LOG_LINES_ASKED
from rmpa.bridge.log_ring import LEVELS, LogLine, ModuleLog
from rmpa.cli.options import LINES, Options, agent_verb, argument, flag, nodes, option, peers
from rmpa.cli.output import Painted, paint, print_json, print_text, printable, warn
from rmpa.core.errors import ConfigError

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator

    from rmpa.observe.control_client import ControlClient
    from rmpa.observe.snapshot import PeerInfo

    # A line, its module, and the bound of the error of its time, seconds.
    _Entry = tuple[LogLine, str, float | None]

# Lines that are shown before those that are followed.
_BEFORE: Final = 10
# Seconds between two questions while the log is followed.
_LOOK: Final = 0.5
# Seconds for which a line waits for earlier ones of other modules.
_HELD: Final = 0.3
# Seconds after which it is said again that lines of a node are lost.
_LOST_AGAIN: Final = 10.0
_COLOURS: Final = {"warn": "yellow", "error": "red", "fatal": "red", "debug": "bright_black"}
_SINCE: Final = re.compile(r"(\d+(?:\.\d+)?) *(ms|s|sec|m|min|h|d)?")
_SECONDS: Final = {"ms": 1e-3, "m": 60.0, "min": 60.0, "h": 3600.0, "d": 86_400.0}


class _Log:
    """Asks the agent for further lines.

    Args:
        client: The agent.
        modules: Names or GUIDs; none: all.
        query: Further fields of ``LogQuery``.
    """

    def __init__(self, client: ControlClient, modules: tuple[str, ...], query: dict[str, object]) -> None:
        self._client = client
        self._args: dict[str, object] = query | ({"modules": modules} if modules else {})
        self._after: dict[str, int] = {}
        self._problems: dict[str, str] = {}
        self._lost: dict[str, float] = {}
        self._unlinked = {peer.name: _why_not(peer) for peer in client.snapshot(topics=()).peers if peer.link is None}
        for name, problem in self._unlinked.items() if not modules else ():
            warn(f"{name}: {problem}", "peer-unlinked")
        # The modules that have answered, and those that have not, at the last question.
        self.read: set[str] = set()
        self.unread: set[str] = set()

    def ask(self, most: int) -> list[_Entry]:
        """The lines since the last question, or the newest ones, by their time; says what is wrong."""
        found = self._client.call("log", tuple[ModuleLog, ...], after=self._after, most=most, **self._args)
        self.read = {one.module for one in found if not one.problem}
        self.unread = {one.module for one in found if one.problem}
        for one in found:
            self._say(one)
            if not one.problem:
                self._after[one.module] = one.next
        return sorted(((line, one.module, one.error) for one in found for line in one.lines), key=_time_of)

    def _say(self, one: ModuleLog) -> None:
        if one.problem != self._problems.get(one.module, ""):
            problem = self._unlinked.get(one.module) if one.code == "unknown-name" else one.problem
            hint = "; a [[permission]] there may allow it: log" if one.code == "not-permitted" else ""
            warn(f"{one.module}: {problem or one.problem or 'it answers again'}{hint}", one.code)
            self._problems[one.module] = one.problem
        now = time.monotonic()
        for node in one.lost:
            key = f"{one.module}:{node}"
            if now - self._lost.get(key, float("-inf")) >= _LOST_AGAIN:
                self._lost[key] = now
                warn(f"{key} writes more than is kept: lines of it are missing", "limit-reached")


@agent_verb(
    argument("modules", peers, nargs=-1, metavar="[MODULE]..."),
    flag("-f --follow", "Go on to print lines as they come, until Ctrl-C."),
    option("--level", help="At least.", type=click.Choice([*LEVELS.values()]), default="info", show_default=True),
    option(
        "--node", "GLOB", "Only of nodes like this: '/arm/*', arm:/hand; /rmpa is the agent.", default="", find=nodes
    ),
    option("--since", "TIME", "Only of the last so long: 30s, 5m, 2h.", default=""),
    option(
        "-n --lines",
        help=f"At most so many of them, the newest. [default: {LINES}, with -f {_BEFORE}]",
        type=click.IntRange(1, LOG_LINES_ASKED),
    ),
)
def log(
    modules: tuple[str, ...], follow: bool, level: str, node: str, since: str, lines: int | None, options: Options
) -> int:
    """Show the last log lines of nodes and agents, of all modules or of each MODULE, in one order.

    Each agent keeps the last lines of /rosout of its module, and its own. Times are by the clock of this module; a
    line with ± may have been written before the one above it: the clocks of two modules are known so well. A module
    that cannot be read is named on stderr. Exits 1 if it was named as MODULE, or if there is no other.

    ---

    Examples:
      rmpa log                             the newest lines of all modules
      rmpa log -f --level warn             follow warnings and errors
      rmpa log arm --node '/arm/*' --since 5m
      rmpa log --json | jq -r 'select(.agent | not) | .text'
    """
    module, _, name = node.rpartition(":")
    modules = (module,) if module else modules
    glob = name if not name or name.startswith(("/", "*")) else f"/{name}"
    query: dict[str, object] = {"level": level, "node": glob, "since": _read_since(since) if since else 0.0}
    with options.client(timeout=60.0) as client:
        asked = _Log(client, modules, query)
        most = lines or (_BEFORE if follow else LINES)
        found = asked.ask(most)[-most:]
        last = _print(found, None, options)
        if follow:
            with contextlib.suppress(KeyboardInterrupt):
                _follow(asked, last, options)
    return int(bool(asked.unread if modules else not asked.read))


def _follow(asked: _Log, last: _Entry | None, options: Options) -> None:
    waiting: list[_Entry] = []
    while True:
        time.sleep(_LOOK)
        waiting = sorted([*waiting, *asked.ask(LOG_LINES_ASKED)], key=_time_of)
        until = time.time() - _HELD
        due = [entry for entry in waiting if entry[0].at <= until or entry[0].at > until + 2 * _LOOK]
        waiting = [entry for entry in waiting if entry not in due]
        last = _print(due, last, options) or last


def _time_of(entry: _Entry) -> float:
    return entry[0].at


def _read_since(text: str) -> float:
    """Seconds.

    Raises:
        ConfigError: It is no time.
    """
    found = _SINCE.fullmatch(text.strip())
    if found is None:
        raise ConfigError("--since", f"{text!r} is not a time", "write 30s, 5m or 2h")
    return float(found[1]) * _SECONDS.get(found[2] or "s", 1.0)


def _why_not(peer: PeerInfo) -> str:
    """Why a peer that is not linked cannot be asked."""
    if peer.state == "relayed":
        return f"its log does not pass the relay {peer.via}; ask there: rmpa log"
    return f"it is not linked ({peer.state})" + (f": {peer.last_error}" if peer.last_error else "")


def _print(entries: Iterable[_Entry], last: _Entry | None, options: Options) -> _Entry | None:
    """Print lines; ``last`` was the one before; returns the last one."""
    width = shutil.get_terminal_size().columns if sys.stdout.isatty() else None
    for entry in entries:
        line, module, error = entry
        if options.as_json:
            about = {"module": module, "node": line.node, "agent": line.agent, "n": line.n, "at": line.at}
            print_json(about | {"error": error, "level": line.level, "text": line.text})
        else:
            print_text(*map(Painted, _shown(entry, last, width)))
        last = entry
    return last


def _shown(entry: _Entry, before: _Entry | None, width: int | None) -> Iterator[str]:
    """A line as text: in a pipe it is one, on a terminal it is filled."""
    line, module, _ = entry
    at = datetime.fromtimestamp(line.at).astimezone()
    day = "" if at.date() == datetime.now(at.tzinfo).date() else f"{at:%Y-%m-%d} "
    clock = f"{day}{at:%H:%M:%S}.{at.microsecond // 1000:03d}{'±' if _is_unordered(entry, before) else ' '}"
    source = printable(f"{module} agent" if line.agent else f"{module}:{line.node}")
    text = line.text.expandtabs(4)
    if width is None:
        shown = [f"{clock}{line.level:<5} {source}: {printable(text)}"]
    else:
        first, *rest = text.rstrip("\n").split("\n")
        shown = _filled(f"{clock}{line.level:<5} {source}: {printable(first)}", width, "")
        shown += [each for more in rest for each in _filled(printable(more), width, "    ")]
    word, end = f"{line.level:<5}", len(clock)
    yield f"{shown[0][:end]}{paint(word, _COLOURS.get(line.level))}{shown[0][end + len(word) :]}"
    yield from shown[1:]


def _filled(text: str, width: int, indent: str) -> list[str]:
    return textwrap.wrap(text, width, initial_indent=indent, subsequent_indent="    ", break_on_hyphens=False) or [""]


def _is_unordered(entry: _Entry, before: _Entry | None) -> bool:
    """Whether a line may have been written before the one above it, which is of another module."""
    if before is None or entry[1] == before[1]:
        return False
    bounds = entry[2], before[2]
    return None in bounds or entry[0].at - before[0].at <= sum(bound for bound in bounds if bound is not None)
