"""``rmpa record``: the flight recorder of this module, and the recordings of all."""

from __future__ import annotations

import asyncio
import logging
import os
import signal
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import click

from rmpa.cli.main import LazyGroup
from rmpa.cli.module import check_record, find_module
from rmpa.cli.options import (
    FiniteRange,
    Options,
    agent_option,
    agent_verb,
    argument,
    completes,
    config_option,
    flag,
    json_option,
    json_verb,
    options_of,
    peers,
    topics,
)
from rmpa.cli.output import Table, begin_log, size
from rmpa.cli.recordings import (
    BAG,
    CALL,
    MB,
    PROGRESS,
    all_recordings,
    end_line,
    fetch,
    join,
    keep,
    merged,
    parts_folder,
    parts_of,
    record_mesh,
    say,
)
from rmpa.core.errors import ConfigError, RmpaError, StartError
from rmpa.observe.operations import remove_recording

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from rmpa.bridge.kept import Kept
    from rmpa.bridge.recordings import ModuleRecordings
    from rmpa.cli.module import Module

_log = logging.getLogger("rmpa.record")
_SECOND: Final = 1_000_000_000


@click.group(cls=LazyGroup, path="record", invoke_without_command=True, help=None)
@click.option(
    "-o", "--output", type=click.Path(path_type=Path), metavar="FILE", help="Record into this file: .mcap or .bag."
)
@click.option(
    "-t",
    "--topic",
    "globs",
    multiple=True,
    metavar="GLOB",
    shell_complete=completes(topics),
    help="Only these topics.",
)
@click.option("--duration", type=FiniteRange(0.1), metavar="SECONDS", help="Stop after so long. [default: at Ctrl-C]")
@click.option("--size", "megabytes", type=FiniteRange(0.1), metavar="MB", help="Stop after so many MB of messages.")
@flag("--here", help="Record what nodes of other modules publish, too: it crosses the network.")
@flag("--mesh", help="Let all modules record their own nodes by their recorders, then fetch and merge that.")
@click.option(
    "--peer",
    "peers",
    multiple=True,
    metavar="NAME",
    shell_complete=completes(peers),
    help="As --mesh, of these modules alone.",
)
@config_option
@json_option
@agent_option
@click.pass_context
def record(context: click.Context, /, config: str | None, as_json: bool, agent: str | None, **given: Any) -> int:
    """Record what happens on this module: without a file into a ring, of which recordings are kept.

    ---
    The recorder subscribes to this module's nodes, beside the agent and never in its path. [record] says to which and
    how much is kept ([record] enabled = true starts it with the agent). When an alarm is raised, a link or node is
    lost, or by `rmpa record keep`, all linked modules keep the last minutes. With -o it writes a file until Ctrl-C,
    as rosbag record does.

    Examples:
      rmpa record                                 the ring: the last two minutes are always there
      rmpa record -o run.mcap                     all topics of this module, into a file
      rmpa record -o run.bag -t '/scan' -t '/tf*' --duration 60
      rmpa record -o run.mcap --here              with what other modules publish
      rmpa record -o run.mcap --mesh --duration 60   what the recorders of all modules have of it, fetched at the end
      rmpa record keep "it fell over" -o fall.mcap   what all modules have of the last minutes, as one file
    """
    if context.invoked_subcommand is not None:
        return 0
    check_record("rmpa record")
    options = Options(as_json, agent)
    module = find_module(agent, {"config": config}, os.environ, "--agent")
    if given["output"] is None:
        if any(given[key] for key in ("globs", "duration", "megabytes", "here", "mesh", "peers")):
            raise ConfigError("-o", "these options are for a recording into a file", "add -o FILE.mcap or FILE.bag")
        return _ring(module)
    if given["output"].exists():
        raise ConfigError("-o", f"{given['output']} exists", "name another file")
    if given["mesh"] or given["peers"]:
        if given["here"]:
            text = "--here gathers over the network while it records, --mesh and --peer at the end"
            raise ConfigError("--here", text, "use one of them")
        if given["mesh"] and given["peers"]:
            raise ConfigError("--peer", "--mesh is all modules", "use one of them")
        return record_mesh(options, _file(given["output"]), given)
    return _by_hand(module, options, given)


def _ring(module: Module) -> int:
    from rmpa.config.module_name import module_dir
    from rmpa.record.recorder import Recorder

    settings, core = module.loaded.settings, _core_of(module)
    begin_log(settings, module.loaded.notes, _log, sys.stderr)
    folder = module_dir(module.place, module.name) / "record"
    recorder = Recorder(settings.record, folder, module.name, core)
    _log.info(
        "= recording into %s: the last %g s, %d MB", folder, settings.record.seconds or 0, settings.record.megabytes
    )
    asyncio.run(_until_signal(recorder.run))
    return 0


def _core_of(module: Module) -> str:
    if module.socket is None:
        raise StartError("rmpa record", f"the agent {module.name} does not run", "start it: rmpa up")
    from rmpa.observe.control_client import ControlClient

    with ControlClient(module.socket) as client:
        return client.agent().core_uri


async def _until_signal(run: Callable[[asyncio.Event], Any]) -> None:
    stop = asyncio.Event()
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        asyncio.get_running_loop().add_signal_handler(number, stop.set)
    await run(stop)


def _file(path: Path) -> Path:
    """A file that a recording goes to.

    Raises:
        ConfigError: Its name does not say as what.
    """
    if path.suffix not in (BAG, ".mcap"):
        raise ConfigError("-o", f"{path} is neither .mcap nor .bag", "name the file so")
    return path


def _by_hand(module: Module, options: Options, given: dict[str, Any]) -> int:
    """Record into a file: segments beside it, which are joined at the end."""
    from rmpa.record.recorder import record_file

    settings = module.loaded.settings
    wanted = replace(
        settings.record, topics=given["globs"] or ("/**",), topic_rate=None, total_rate=None, thin=None, deny=()
    )
    shown = 0.0

    def progress(seconds: float, messages: int, total: int) -> bool:
        nonlocal shown
        if seconds - shown >= PROGRESS:
            shown = seconds
            say(f"{seconds:6.1f} s  {messages:,} messages  {size(total)}")
        return bool(given["megabytes"]) and total >= given["megabytes"] * MB

    output = _file(given["output"])
    with parts_folder(output) as parts:
        counts = asyncio.run(
            record_file(
                wanted,
                parts,
                module.name,
                _core_of(module),
                progress,
                given["duration"],
                everything=given["here"],
            )
        )
        end_line()
        result = join([parts], output)
    options.show(
        {"file": str(output), "messages": result.count, "topics": counts},
        f"{output}: {result.count:,} messages of {len(counts)} topics, {size(output.stat().st_size)}",
    )
    return 0 if result.count else 1


def names(ctx: click.Context, _: str) -> Iterator[str]:
    """The names of recordings, for completion."""
    with options_of(ctx).client() as client:
        yield from dict.fromkeys(kept.id for each in all_recordings(client) for kept in each.kept)


@agent_verb()
def record_list(options: Options) -> int:
    """List what the modules have kept, and what their recorders do.

    ---

    Examples:
      rmpa record list
      rmpa record list --json | jq -r '.[].kept[].id'
    """
    with options.client(CALL) as client:
        found = all_recordings(client)
    recorders = [
        (each.module, *(_state(each)), each.problem or str(each.status.get("problem", "")) or "-") for each in found
    ]
    by_id: dict[str, list[tuple[str, Kept]]] = {}
    for each in found:
        for kept in each.kept:
            by_id.setdefault(kept.id, []).append((each.module, kept))
    rows = [
        (name, ", ".join(module for module, _ in parts), size(sum(kept.size for _, kept in parts)), parts[0][1].why)
        for name, parts in sorted(by_id.items())
    ]
    options.show(
        found,
        Table("MODULE, RECORDER, >BACK, >RING, >WRITTEN, PROBLEM", recorders),
        "",
        Table("RECORDING, MODULES, >SIZE, WHY", rows),
    )
    return int(any(each.problem for each in found))


def _state(each: ModuleRecordings) -> tuple[str, str, str, str]:
    status = each.status
    if not status:
        return "-", "-", "-", "-"
    total, back = status.get("ring", (0, 0.0))
    hours = max(status["at"] - status["since"], 1.0) / 3600
    return "runs", f"{back:.0f} s", size(total), f"{size(status.get('written', 0) / hours)}/h"


@agent_verb(argument("recording", names))
def record_info(recording: str, options: Options) -> int:
    """Show what is known of a RECORDING, at each module that has it.

    ---

    Examples:
      rmpa record info 20261129-121500-arm-alarm
    """
    with options.client(CALL) as client:
        parts = parts_of(client, recording)
    rows = [
        (
            module,
            _clock(kept.since),
            f"{(kept.until - kept.since) / _SECOND:.0f} s",
            str(len(kept.files)),
            size(kept.size),
        )
        for module, kept in parts
    ]
    kept = parts[0][1]
    about = f"{kept.id}: {kept.why}" + (f" (asked by {kept.asked_by})" if kept.asked_by else "")
    options.show([kept for _, kept in parts], about, Table("MODULE, SINCE (UTC), >LENGTH, >FILES, >SIZE", rows))
    return 0


def _clock(at: int) -> str:
    return time.strftime("%Y-%m-%d %H:%M:%S", time.gmtime(at / _SECOND))


@agent_verb(
    argument("why", required=False, default="by hand"),
    click.option("--seconds", type=FiniteRange(0.1), help="How much of the past. [default: all that is there]"),
    click.option("-o", "--output", type=click.Path(path_type=Path), metavar="FILE", help="Fetch and merge it, too."),
)
def record_keep(why: str, seconds: float | None, output: Path | None, options: Options) -> int:
    """Keep what all modules have of the last minutes; WHY names it.

    Modules that are not linked keep it when they are back. Exits 1 if a module cannot.

    ---

    Examples:
      rmpa record keep
      rmpa record keep "the arm hit the table" --seconds 60 -o hit.mcap
    """
    if output is not None and _file(output).exists():
        raise ConfigError("-o", f"{output} exists", "name another file")
    with options.client(CALL) as client:
        name, answers = keep(client, why, seconds)
        rows = [(module, problem or "kept") for module, problem in answers.items()]
        about: dict[str, Any] = {"id": name, "modules": answers}
        lines: list[str] = []
        if output is not None and name:
            with parts_folder(output) as folder:
                fetched = fetch(client, name, folder)
                result = join([folder], output)
            about |= {"file": str(output), "messages": result.count}
            lines = [*merged(output, result), *(f"! {one.module}: {one.problem}" for one in fetched if one.problem)]
            answers |= {one.module: one.problem for one in fetched if one.problem}
    options.show(about, name, Table("MODULE, STATE", rows), *lines)
    return int(not name or any(answers.values()))


@agent_verb(
    argument("recording", names),
    click.option(
        "-o", "--output", type=click.Path(path_type=Path), metavar="DIR", help="Where to. [default: ./RECORDING]"
    ),
)
def record_fetch(recording: str, output: Path | None, options: Options) -> int:
    """Fetch a RECORDING from all modules that have it, a folder each; what is there already is not fetched again.

    A module whose link is lost meanwhile is waited for, a minute long. The same command goes on where one was ended.
    Commands do not wait for it: it takes half of the way at the most.

    ---

    Examples:
      rmpa record fetch 20261129-121500-arm-alarm
      rmpa record fetch 20261129-121500-arm-alarm -o fall
    """
    folder = output or Path(recording)
    try:
        with options.client(CALL) as client:
            fetched = fetch(client, recording, folder)
    except KeyboardInterrupt:
        click.echo(f"\nnot all is in {folder}: the same command goes on from there", err=True)
        raise
    problems = {one.module: one.problem for one in fetched if one.problem}
    options.show(
        {"folder": str(folder), "modules": {one.module: one.size for one in fetched}, "problems": problems},
        Table("MODULE, >SIZE, PROBLEM", [(one.module, size(one.size), one.problem or "-") for one in fetched]),
        "not all is there: the same command goes on from there"
        if problems
        else f"merge it: rmpa record merge {folder} -o {recording}.mcap",
    )
    return int(bool(problems))


@json_verb(
    argument("recordings", nargs=-1, required=True, type=click.Path(exists=True, path_type=Path)),
    click.option(
        "-o", "--output", required=True, type=click.Path(path_type=Path), metavar="FILE", help=".mcap or .bag."
    ),
    click.option("--clock", "reference", default="", metavar="MODULE", help="Whose clock. [default: the best known]"),
)
def record_merge(recordings: tuple[Path, ...], output: Path, reference: str, options: Options) -> int:
    """Put RECORDINGS of several modules on one timeline: files, or folders as `rmpa record fetch` makes them.

    ---

    Examples:
      rmpa record merge fall -o fall.mcap
      rmpa record merge arm.mcap base.mcap --clock base -o both.bag
    """
    check_record("rmpa record")
    result = join(list(recordings), _file(output), reference)
    about = {
        "file": str(output),
        "reference": result.reference,
        "offsets": {name: one._asdict() for name, one in result.offsets.items()},
        "messages": result.count,
        "doubles": result.doubles,
        "damaged": list(result.damaged.values()),
        "notes": result.notes,
    }
    rows = [
        (name, "the clock" if name == result.reference else f"{1e3 * one.ahead:+.3f} ms", _bound(one.error))
        for name, one in result.offsets.items()
    ]
    options.show(about, *merged(output, result), Table("MODULE, >AHEAD, >±", rows))
    return int(bool(result.damaged))


def _bound(error: float | None) -> str:
    return "not known" if error is None else f"{1e3 * error:.3f} ms"


@agent_verb(argument("recording", names), click.option("--module", default="", help="Only that of this module."))
def record_rm(recording: str, module: str, options: Options) -> int:
    """Remove a RECORDING at all modules that have it.

    ---

    Examples:
      rmpa record rm 20261129-121500-arm-alarm
    """
    with options.client(CALL) as client:
        removed, problems = remove_recording(client, recording, module)
    if not removed and not problems:
        raise RmpaError(f"no module has a recording {recording}; `rmpa record list` shows them", code="unknown-name")
    rows = [*((name, "removed") for name in removed), *problems.items()]
    options.show({"removed": removed, "problems": problems}, Table("MODULE, STATE", rows))
    return int(bool(problems))
