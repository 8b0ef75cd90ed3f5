"""``rmpa record``: the flight recorder of this module, and recordings into a file: of this module, or of all."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import os
import signal
import sys
import time
from dataclasses import replace
from typing import TYPE_CHECKING, Any, Final

import click

from rmpa.cli.main import LazyGroup
from rmpa.cli.module import Module, check_record, find_module
from rmpa.cli.options import (
    FiniteRange,
    Options,
    agent_option,
    config_option,
    flag,
    json_option,
    option,
    output_option,
    peers,
    topics,
)
from rmpa.cli.output import begin_log, size
from rmpa.cli.recordings import (
    CALL,
    NO_RECORDER,
    all_recordings,
    end_line,
    fetch,
    join,
    keep,
    merged,
    parts_folder,
    say,
    writable,
)
from rmpa.core.errors import ConfigError, RmpaError, StartError
from rmpa.core.identity import matches_any

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Sequence
    from pathlib import Path

    from rmpa.bridge.recordings import ModuleRecordings

    _ByModule = dict[str, ModuleRecordings]

_log = logging.getLogger("rmpa.record")
_MB: Final = 1_000_000
# Seconds between two lines of progress.
_PROGRESS: Final = 0.5
# Seconds between two looks at what the recorders of a mesh have; they tell it every 5 s.
_LOOK: Final = 2.0
# Seconds of a ring that tell how many it will hold, and the share of its bytes above which it has dropped some.
_SURE: Final = 10.0
_FULL: Final = 0.75


@click.group(cls=LazyGroup, path="record", invoke_without_command=True, help=None)
@output_option("Record into this file: .mcap or .bag.")
@option("-t --topic globs", "GLOB", "Only these topics.", multiple=True, find=topics)
@option("--duration", "SECONDS", "Stop after so long. [default: at Ctrl-C]", type=FiniteRange(0.1))
@option("--size megabytes", "MB", "Stop after so many MB of messages.", type=FiniteRange(0.1))
@flag("--here", "Record what nodes of other modules publish, too: it crosses the network.")
@flag("--mesh", "Let all modules record their own nodes by their recorders, then fetch and merge that.")
@option("--peer peers", "NAME", "As --mesh, of these modules alone.", multiple=True, find=peers)
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
    writable(given["output"])
    if given["mesh"] or given["peers"]:
        if given["here"]:
            text = "--here gathers over the network while it records, --mesh and --peer at the end"
            raise ConfigError("--here", text, "use one of them")
        if given["mesh"] and given["peers"]:
            raise ConfigError("--peer", "--mesh is all modules", "use one of them")
        return _mesh(options, given["output"], given)
    return _by_hand(module, options, given)


def _ring(module: Module) -> int:
    from rmpa.config.module_name import module_dir
    from rmpa.record.recorder import Recorder

    settings, core = module.loaded.settings, _core_of(module)
    begin_log(settings, module.loaded.notes, _log, sys.stderr)
    folder = module_dir(module.place, module.name) / "record"
    recorder = Recorder(settings.record, folder, module.name, core)
    seconds = settings.record.seconds or 0
    _log.info("= recording into %s: the last %g s, %d MB", folder, seconds, settings.record.megabytes)
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


def _by_hand(module: Module, options: Options, given: dict[str, Any]) -> int:
    """Record into a file: segments beside it, which are joined at the end."""
    from rmpa.record.recorder import record_file

    shown, topics = 0.0, given["globs"] or ("/**",)
    bare = replace(module.loaded.settings.record, topic_rate=None, total_rate=None, thin=None, deny=())

    def progress(seconds: float, messages: int, total: int) -> bool:
        nonlocal shown
        if seconds - shown >= _PROGRESS:
            shown = seconds
            say(f"{seconds:6.1f} s  {messages:,} messages  {size(total)}")
        return bool(given["megabytes"]) and total >= given["megabytes"] * _MB

    output: Path = given["output"]
    with parts_folder(output) as parts:
        asked = replace(bare, topics=topics), parts, module.name, _core_of(module), progress, given["duration"]
        counts = asyncio.run(record_file(*asked, everything=given["here"]))
        end_line()
        result = join([parts], output)
    about = {"file": str(output), "messages": result.count, "topics": counts}
    text = f"{output}: {result.count:,} messages of {len(counts)} topics, {size(output.stat().st_size)}"
    options.show(about, text)
    return 0 if result.count else 1


def _mesh(options: Options, output: Path, given: dict[str, Any]) -> int:
    """Let modules record their own nodes for a time, by the rings of their recorders; fetch and merge that.

    Args:
        options: Of the command.
        output: The file.
        given: The values of the command's options.
    """
    for number in (signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.default_int_handler)  # as Ctrl-C
    with options.client(CALL) as client:
        recorders, problems = _recorders(all_recordings(client), given["peers"])
        until = _bounds(recorders, given["duration"])
    for module, problem in problems.items():
        click.echo(f"! {module} is not recorded: {problem}", err=True)
    if given["duration"] is None:
        click.echo(f"= it ends by itself after {until:.0f} s: so much the rings hold ([record] seconds)", err=True)
    began = time.monotonic()
    with contextlib.suppress(KeyboardInterrupt):
        _wait(options, recorders, until, given)
    end_line()
    seconds, name = time.monotonic() - began, ""
    try:
        with options.client(CALL) as client, parts_folder(output) as folder:
            name, answers = keep(client, f"by hand for {seconds:.0f} s", seconds, given["peers"])
            ends = {each.module: each for each in all_recordings(client) if each.module in recorders}
            problems |= _missing(recorders, ends, answers, seconds)
            if not name:
                text = "; ".join(f"{module}: {problem}" for module, problem in problems.items())
                raise RmpaError(f"no module has kept it: {text}", code="recording-stopped")
            fetched = fetch(client, name, folder, recorders)
            problems |= {one.module: one.problem for one in fetched if one.problem}
            result = join([folder], output, "", given["globs"])
            if not any(one.problem for one in fetched):
                for one in fetched:
                    client.call("record", object, what="remove", module=one.module, id=name)
                name = ""
    finally:
        if name:
            click.echo(f"the modules have it as {name}: rmpa record fetch {name}", err=True)
    left = {one: count for one in ends if (count := _grown({one: recorders[one]}, ends, "left_out", given["globs"]))}
    about = {"file": str(output), "messages": result.count, "modules": list(result.offsets)}
    lines = [f"! {module}: {problem}" for module, problem in problems.items()]
    above = "messages above its [record] topic_rate, total_rate or thin"
    lines += [f"= {module}: {count:,} {above}" for module, count in left.items()]
    options.show({**about, "problems": problems, "left_out": left}, *merged(output, result), *lines)
    return int(bool(problems) or not result.count)


def _recorders(found: Iterable[ModuleRecordings], wanted: Sequence[str]) -> tuple[_ByModule, dict[str, str]]:
    """The modules that record, and by module why others do not.

    Raises:
        RmpaError: None does.
    """
    all_of = {each.module: each for each in found if not wanted or each.module in wanted}
    problems = {name: "it is not linked; `rmpa peer list` shows why" for name in wanted if name not in all_of}
    for name, each in all_of.items():
        if each.problem or not each.status:
            problems[name] = each.problem or NO_RECORDER
    recorders = {name: each for name, each in all_of.items() if name not in problems}
    if not recorders:
        text = "; ".join(f"{name}: {problem}" for name, problem in problems.items())
        raise RmpaError(f"no module records: {text}", code="no-recorder")
    return recorders, problems


def _bounds(recorders: _ByModule, duration: float | None) -> float:
    """For how long to record.

    Raises:
        ConfigError: A ring is too short for that.
    """
    least, shortest = float("inf"), ""
    for name, each in recorders.items():
        most, seconds = each.status.get("bounds", (0, None))
        total, back = each.status.get("ring", (0, 0.0))
        by_size = most * back / total if total and back > _SURE else float("inf")
        if (holds := min(seconds or float("inf"), by_size)) < least:
            least, shortest = holds, name
    if duration is not None and duration > least:
        text = f"{duration:g} s are asked for, and the ring of {shortest} holds the last {least:.0f} s"
        remedy = "set [record] seconds or megabytes there, or record with -o at the module"
        raise ConfigError("--duration", text, remedy)
    return duration or min(least, 86_400.0)


def _wait(options: Options, recorders: _ByModule, seconds: float, given: dict[str, Any]) -> None:
    """Wait for the end, with progress; Ctrl-C raises ``KeyboardInterrupt``."""
    began = looked = time.monotonic()
    messages = total = 0
    with options.client(CALL) as client:
        while (rest := began + seconds - time.monotonic()) > 0:
            time.sleep(min(rest, _PROGRESS))
            if time.monotonic() - looked > _LOOK and (sys.stderr.isatty() or given["megabytes"]):
                now = {each.module: each for each in all_recordings(client)}
                messages, total = (_grown(recorders, now, what, given["globs"]) for what in ("messages", "size"))
                looked = time.monotonic()
            took = time.monotonic() - began
            say(f"{took:6.1f} s  {len(recorders)} modules  {messages:,} messages  {size(total)}")
            if given["megabytes"] and total >= given["megabytes"] * _MB:
                return


def _grown(before: _ByModule, now: _ByModule, what: str, globs: Sequence[str]) -> int:
    """By how much the recorders' counts of topics have grown."""
    total = 0
    for name, each in before.items():
        then = each.status.get(what, {})
        later = now[name].status.get(what, {}) if name in now else {}
        wanted = (topic for topic in later if not globs or matches_any(globs, topic))
        total += sum(max(0, later[topic] - then.get(topic, 0)) for topic in wanted)
    return total


def _missing(before: _ByModule, now: _ByModule, answers: dict[str, str], seconds: float) -> dict[str, str]:
    """By module what of the time cannot be had, and why."""
    problems = {}
    for name in before:
        status = now[name].status if name in now else {}
        (most, _), (total, back) = status.get("bounds", (0, None)), status.get("ring", (0, seconds))
        if name not in answers:
            problems[name] = "it is not linked any more"
        elif answers[name]:
            problems[name] = answers[name]
        elif total > _FULL * most > 0 and back < seconds:
            problems[name] = f"the first {seconds - back:.0f} s are missing: its ring is full ([record] megabytes)"
    return problems
