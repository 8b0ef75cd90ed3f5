"""``rmpa resource history``: which profile ran when and why, and which qualities fell short."""

from __future__ import annotations

import os
import time
from typing import TYPE_CHECKING, Final

import click
from click.core import ParameterSource

from rmpa.cli.options import completes, json_option
from rmpa.cli.output import Column, duration, print_json, print_table
from rmpa.config.state_dir import module_dir, state_dir
from rmpa.core.errors import ConfigError, RmpaError
from rmpa.resource.declare.units import quantity
from rmpa.resource.run.history import profile_runs, read_events, read_units, read_windows

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from rmpa.resource.run.history import HistoryEvent, ProfileRun, QualityWindow

_COLOURS: Final = {"OK": "", "WARN": "yellow", "ERROR": "red", "STALE": "magenta"}
_VIOLATIONS: Final = ("alarm", "over")
_EVENT_TITLES: Final = ("TIME", "LEVEL", "EVENT", "PROFILE", "MESSAGE")
_PROFILE_TITLES: Final = ("SINCE", "FOR", "PROFILE", "REACTION", "WHY")
_EXAMPLES: Final = """\
\b
Examples:
  rmpa resource history sonar                        profiles, alarms and their ends
  rmpa resource history sonar --profiles             which profile ran when, how long and why
  rmpa resource history sonar --violations           only alarms and their ends
  rmpa resource history sonar --windows --since 5min the quality that was measured
  rmpa resource history sonar --windows --json | jq -c '.[] | [.at, .quality.rate]'
"""


@click.command(epilog=_EXAMPLES)
@click.argument("resource", required=False, shell_complete=completes("resource"))
@click.option("--profiles", "shown", flag_value="profiles", help="Which profile ran when, and why.")
@click.option("--violations", "shown", flag_value="violations", help="Only alarms, and when they were over.")
@click.option("--windows", "shown", flag_value="windows", help="The measured quality, window by window.")
@click.option("-n", "--count", type=click.IntRange(1), default=20, show_default=True, help="The last so many rows.")
@click.option("--since", metavar="TIME", help="Only what is younger: 30s, 5min, 2h. Without -n all of it.")
@json_option
@click.option("--agent", metavar="NAME", help="The module that ran it, if several did. [env: RMPA_AGENT]")
@click.option("--state", metavar="DIR", help="Where `rmpa run` keeps it. [env: RMPA_STATE_DIR]")
@click.pass_context
def history(
    ctx: click.Context,
    resource: str | None,
    shown: str | None,
    count: int,
    since: str | None,
    as_json: bool,
    agent: str | None,
    state: str | None,
) -> None:
    """Show what a RESOURCE of this machine did, and why, whether it runs or not.

    Read from the file that `rmpa run` keeps; the last 10 s may be missing while it runs.
    """
    path = _find(resource, agent or os.environ.get("RMPA_AGENT"), state)
    after = time.time() - quantity(since, "s", "--since") if since is not None else 0.0
    by_default = ctx.get_parameter_source("count") is ParameterSource.DEFAULT
    last = slice(None) if since is not None and by_default else slice(-count, None)
    try:
        if shown == "windows":
            windows = [window for window in read_windows(path) if window.at >= after][last]
            titles, rows, colours = _window_table(windows, read_units(path))
            _print(windows, as_json, titles, rows, colours)
            return
        events = read_events(path)
    except OSError as error:
        raise RmpaError(str(error)) from None
    if shown == "profiles":
        runs = [run for run in profile_runs(events) if run.until is None or run.until >= after][last]
        _print(runs, as_json, _PROFILE_TITLES, list(map(_profile_row, runs)))
        return
    events = [each for each in events if each.at >= after and (shown is None or each.event in _VIOLATIONS)][last]
    colours = [_COLOURS[each.level] for each in events]
    _print(events, as_json, _EVENT_TITLES, list(map(_event_row, events)), colours)


def _print(
    found: Sequence[object],
    as_json: bool,
    titles: Sequence[str],
    rows: Sequence[Sequence[str]],
    colours: Sequence[str] = (),
) -> None:
    if as_json:
        print_json(found)
    else:
        print_table(tuple(map(Column, titles)), rows, colours=colours)


def _event_row(event: HistoryEvent) -> Sequence[str]:
    return _time(event.at), event.level, event.event, str(event.details.get("profile", "-")), event.message


def _profile_row(run: ProfileRun) -> Sequence[str]:
    length = duration((run.until or time.time()) - run.at)
    return (
        _time(run.at),
        length if run.until is not None else f"{length} …",
        run.profile,
        duration(run.reaction),
        run.why,
    )


def _window_table(
    windows: Sequence[QualityWindow], units: dict[str, str]
) -> tuple[Sequence[str], Sequence[Sequence[str]], Sequence[str]]:
    """Titles, rows and colours; only the attributes that need no name of an output or input."""
    names = sorted({name for window in windows for name in window.quality if "." not in name})
    titles = ["TIME", "LEVEL", "PROFILE", *(f"{name} [{units[name]}]" if units.get(name) else name for name in names)]
    rows = [
        (_time(window.at), window.level, window.profile or "-", *(_cell(window.quality.get(name)) for name in names))
        for window in windows
    ]
    return titles, rows, [_COLOURS[window.level] for window in windows]


def _cell(value: float | str | None) -> str:
    return "-" if value is None else value if isinstance(value, str) else f"{value:.4g}"


def _time(at: float) -> str:
    return time.strftime("%Y-%m-%d %H:%M:%S", time.localtime(at))


def _find(resource: str | None, module: str | None, state: str | None) -> Path:
    """The store of a resource.

    Raises:
        ConfigError: It is a peer's.
        RmpaError: There is none, or several.
    """
    name = (resource or "*").removeprefix("/")
    if ":" in name:
        remedy = "ask there: its file is where it runs"
        raise ConfigError("resource", f"{name} is of another module", remedy)
    directory = state_dir(os.environ, state)
    folders = [] if directory is None else [module_dir(directory, module)] if module else sorted(directory.glob("*"))
    found = [
        path
        for folder in folders
        for path in sorted(folder.glob("*.sqlite"))
        if path.stem == name or (resource is None and not path.name.startswith(("_", "core-")))
    ]
    if len(found) == 1:
        return found[0]
    where = str(directory)
    if not found:
        what = f"resource {name}" if resource is not None else "resource"
        raise RmpaError(f"no history of a {what} in {where}; `rmpa run` keeps one, --state says where it is")
    modules = ", ".join(f"{path.parent.name}/{path.stem}" for path in found)
    raise RmpaError(f"several have a history in {where}: {modules}; name the resource, or its module by --agent")
