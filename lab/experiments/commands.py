"""``python -m lab experiment list|run|report|compare``."""

from __future__ import annotations

import datetime as dt
import shlex
import signal
import sys
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Final

import click

from lab.experiments.registry import EXPERIMENTS, find_experiment
from rmpa.cli.options import json_option
from rmpa.cli.output import Table, duration, print_json, print_text, warn
from rmpa.core.errors import ConfigError, StartError

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Mapping, Sequence

    from lab.bed.plan import Client, Plan
    from lab.experiments.report import Report
    from lab.experiments.runner import Job, Outcome
    from lab.experiments.store import Store
    from lab.findings import Claim, Findings

_PROGRAM: Final = ("python", "-m", "lab")
_PARENT: Final = Path("rmpa-experiments")
_COLOURS: Final[Mapping[bool | None, str]] = {True: "green", False: "red", None: "yellow"}
_REACHED: Final[Mapping[bool | None, str]] = {True: "reached", False: "not reached", None: "too few samples"}
_RUN_EPILOG: Final = """\
\b
Without names: all experiments. A directory that has a run in it is gone on with: what is measured stays, what is
missing or failed is measured now, and options that are left out are as they were. Ctrl-C loses the current cell only.

\b
Exit codes: 0 all was measured (whatever the figures say); 1 some of it could not be; 130 interrupted.

\b
Examples:
  python -m lab experiment run --short                   does everything work? a few minutes; not for figures to quote
  sudo make experiment                          the whole evaluation, on hosts of its own; over an hour
  python -m lab experiment run control rates --out mine  two of them, into ./mine
  python -m lab experiment run --out mine                go on there
  python -m lab experiment run rates --only rate=1000 --client roscpp
  python -m lab experiment run images --link none        on cables that are not shaped
"""


@dataclass(frozen=True, slots=True)
class _Row:
    """One experiment in the list; times in seconds."""

    name: str
    about: str
    cells: int
    seconds: float
    seconds_short: float


_directory = click.Path(file_okay=False, path_type=Path)


@click.group(
    epilog="""\
\b
The hosts are network namespaces with a shaped cable each, and the nodes rospy's and roscpp's: root, iproute2 and
ROS 1 are needed.
"""
)
def experiment() -> None:
    """Measure whether RMPA keeps its promise: the paper's evaluation, classic ROS beside it."""


@experiment.command(
    "list",
    epilog="\b\nExample:\n  python -m lab experiment list --json | jq -r '.experiments[].name'\n",
)
@json_option
def list_(as_json: bool) -> None:
    """List the experiments, and how long they take in full and with --short."""
    from lab.bed.plan import Plan
    from lab.bed.stage import why_not

    rows = []
    for name, (_, about) in EXPERIMENTS.items():
        cells, few = (find_experiment(name).cells(plan) for plan in (Plan(), Plan("short")))
        rows.append(
            _Row(name, about, len(cells), sum(cell.seconds for cell in cells), sum(cell.seconds for cell in few))
        )
    if as_json:
        print_json({"experiments": rows, "why_not": why_not()})
        return
    times = [(duration(row.seconds), duration(row.seconds_short)) for row in rows]
    lines = [(row.name, str(row.cells), *both, row.about) for row, both in zip(rows, times, strict=True)]
    print_text(Table("NAME, >CELLS, >TIME, >SHORT, WHAT IT MEASURES", lines), "")
    if why := why_not():
        warn(f"cannot run here: {why}")


@experiment.command(epilog=_RUN_EPILOG)
@click.argument("names", nargs=-1, metavar="[NAME]...")
@click.option("--out", type=_directory, help="The run's directory. [default: ./rmpa-experiments/DATE_TIME]")
@click.option("--short", is_flag=True, help="Few samples: to see that everything works, not for figures to quote.")
@click.option(
    "--client",
    "clients",
    type=click.Choice(["rospy", "roscpp"]),
    multiple=True,
    help="Whose nodes; repeatable. [default: both]",
)
@click.option("--link", metavar="RATE", help="What a host's cable carries, as tc has it, or none. [default: 100mbit]")
@click.option("--seed", type=int, help="Of what is left to chance. [default: 1]")
@click.option(
    "--only",
    metavar="SETTING=VALUE",
    multiple=True,
    help="Only cells with this setting; repeatable.",
)
@json_option
def run(
    names: tuple[str, ...],
    out: Path | None,
    short: bool,
    clients: tuple[Client, ...],
    link: str | None,
    seed: int | None,
    only: tuple[str, ...],
    as_json: bool,
) -> int:
    """Measure classic ROS and RMPA side by side, and write the report.

    Both systems take turns, cell by cell, with the same nodes on the same hosts. Raw samples, a manifest and the
    report are in one directory (docs/compare/experiments.md).
    """
    from lab.bed import namespaces
    from lab.bed.stage import make_stage, why_not
    from lab.experiments import runner
    from lab.experiments.asked import choose
    from lab.experiments.progress import Progress, last_line
    from lab.experiments.store import Store, is_run_directory

    there = Store.load(out) if out is not None and is_run_directory(out) else None
    plan = choose("short" if short else None, clients, link, seed, there.plan if there else None)
    if why := why_not():
        raise StartError("hosts as network namespaces", why)
    jobs = _jobs(names or (there.names if there else ()) or EXPERIMENTS, plan, only)
    store = _store(there, out, plan)
    waiting = runner.to_measure(jobs, store)
    if not as_json:
        seconds = sum(cell.seconds for _, cell in waiting)
        print_text(f"{_shown(store.plan)}; {len(waiting)} cells, about {duration(seconds)}")
        print_text(f"into {store.directory}")
    namespaces.remove_stale()
    try:
        with (
            _terminated(),
            store.session([*_PROGRAM, *sys.argv[1:]]),
            Progress([cell for _, cell in waiting]) as progress,
        ):
            outcome = runner.run(jobs, store, make_stage, progress)
    except KeyboardInterrupt:
        words = [
            *_PROGRAM,
            "experiment",
            "run",
            *names,
            *(f"--only={text}" for text in only),
            "--out",
            str(store.directory),
        ]
        warn(f"interrupted; go on with: {shlex.join(words)}")
        return 130
    except OSError as caught:
        raise StartError(str(store.directory), f"cannot be written to ({caught.strerror})") from caught
    written = _write_report(store.directory)
    if as_json:
        print_json(_outcome(store, outcome) | _about(store.directory, written))
    else:
        _print_report(written)
        for name, cell, error in outcome.failed:
            warn(f"{name} {cell} could not be measured: {last_line(error)}")
    return 1 if outcome.failed else 0


@experiment.command(epilog="\b\nExample:\n  python -m lab experiment report mine --json | jq '.claims'\n")
@click.argument("directory", type=_directory)
@json_option
def report(directory: Path, as_json: bool) -> None:
    """Write the report of the run in DIRECTORY again, from its samples.

    As after each run: report.html, which needs no other file, report.md, and the figures as PNG and SVG.
    """
    written = _write_report(directory)
    if as_json:
        print_json(_about(directory, written))
    else:
        _print_report(written)


@experiment.command(epilog="\b\nExample:\n  python -m lab experiment compare yours mine --json\n")
@click.argument("a", type=_directory)
@click.argument("b", type=_directory)
@json_option
def compare(a: Path, b: Path, as_json: bool) -> None:
    """Compare the runs in directories A and B: what was measured, and what differs in how."""
    from lab.experiments.report.compare import compare as comparison
    from lab.words import number, quantity

    found = comparison(a, b)
    if as_json:
        print_json(found)
        return
    if found.differences:
        print_text(Table("WHAT DIFFERS, A, B", [(one.what, one.a, one.b) for one in found.differences]), "")
    rows = [
        (one.experiment, one.text, quantity(one.a, one.unit), quantity(one.b, one.unit), number(one.ratio))
        for one in found.claims
    ]
    print_text(Table("EXPERIMENT, FIGURE, >A, >B, >B/A", rows))


# --- what is asked for ----------------------------------------------------------------------------------------------


def _jobs(names: Iterable[str], plan: Plan, only: Sequence[str]) -> list[Job]:
    """Experiments, each once, with the cells that are wanted; those with none are left out."""
    from lab.experiments.asked import parse_only, select

    planned = [(one, one.cells(plan)) for one in map(find_experiment, dict.fromkeys(names))]
    wanted = parse_only(only, [cell for _, cells in planned for cell in cells])
    jobs = [(one, select(cells, wanted)) for one, cells in planned]
    if not any(cells for _, cells in jobs):
        raise ConfigError("--only", "no cell has all of these settings")
    return [(one, cells) for one, cells in jobs if cells]


def _store(there: Store | None, out: Path | None, plan: Plan) -> Store:
    """The run directory to go on with, or a new one."""
    from lab.experiments.code import code_here
    from lab.experiments.store import Store
    from lab.machine import facts

    if there is not None:
        there.require(plan, code_here(), facts())
        return there
    directory = out or _PARENT / f"{dt.datetime.now().astimezone():%Y-%m-%d_%H%M%S}"
    return Store.create(directory, plan, code_here(), facts())


@contextmanager
def _terminated() -> Iterator[None]:
    """SIGTERM and a closed terminal end the run as Ctrl-C does: what was started ends, what was measured stays."""

    def interrupt(*_: object) -> None:
        raise KeyboardInterrupt

    before = {number: signal.signal(number, interrupt) for number in (signal.SIGTERM, signal.SIGHUP)}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


# --- what is shown --------------------------------------------------------------------------------------------------


def _shown(plan: Plan) -> str:
    from lab.words import link as words_of

    link = f"cables of {words_of(plan.link)}" if plan.link else "cables not shaped"
    return f"hosts as network namespaces, {link}, nodes of {' and '.join(plan.clients)}, {plan.size}"


def _write_report(directory: Path) -> Report:
    from lab.experiments.report import write_report

    return write_report(directory)


def _outcome(store: Store, outcome: Outcome) -> dict[str, object]:
    return {
        "size": store.plan.size,
        "measured": outcome.measured,
        "there": outcome.there,
        "failed": [{"experiment": name, "cell": cell, "error": error} for name, cell, error in outcome.failed],
    }


def _about(directory: Path, written: Report) -> dict[str, object]:
    return {
        "directory": str(directory),
        "html": str(written.html),
        "markdown": str(written.markdown),
        "figures": [str(path) for path in written.figures],
        "missing": written.missing,
        "claims": [
            {
                "experiment": name,
                "claim": claim.text,
                "wanted": claim.limit,
                "at_least": claim.at_least,
                "unit": claim.unit,
                "measured": claim.value,
                "paper": claim.paper,
                "reached": claim.reached,
            }
            for name, claim in _claims(written.findings)
        ],
    }


def _print_report(written: Report) -> None:
    from lab.words import measured, quantity, wanted

    claims = list(_claims(written.findings))
    if claims:
        rows = [
            (name, _REACHED[each.reached], measured(each), wanted(each), quantity(each.paper, each.unit), each.text)
            for name, each in claims
        ]
        colours = [_COLOURS[claim.reached] for _, claim in claims]
        print_text(Table("EXPERIMENT, REACHED, >MEASURED, >WANTED, >PAPER, WHAT", rows, colours), "")
    print_text(f"report: {written.html}", f"        {written.markdown}")
    if written.missing:
        warn(f"left out: {written.missing}")


def _claims(findings: Mapping[str, Findings]) -> Iterator[tuple[str, Claim]]:
    for name, found in findings.items():
        for claim in found.claims:
            yield name, claim
