"""``rmpa play``, ``rmpa diff`` and ``rmpa story``: what is done with recordings."""

from __future__ import annotations

import asyncio
import contextlib
import os
import signal
import sys
import termios
import time
import tty
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import click
import msgspec

from rmpa.cli.module import check_record
from rmpa.cli.options import FiniteRange, Options, argument, flag, graph_verb, json_verb, option, output_option
from rmpa.cli.output import Table, paint, print_error, printable
from rmpa.core.errors import ConfigError, RmpaError
from rmpa.runtime.tasks import start_task

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from rmpa.record.diff import TopicDifference, TopicRun
    from rmpa.record.play import Player, PlayOptions
    from rmpa.record.story import Story

_RECORDING: Final = click.Path(exists=True, path_type=Path)
_COLOURS: Final = {"error": "red", "warn": "yellow", "info": ""}


@graph_verb(
    argument("recording", type=_RECORDING),
    option("-r --rate", help="So many times as fast.", type=FiniteRange(0.001), default=1.0),
    option("-s --start", "SECONDS", "Leave out so much.", type=FiniteRange(0), default=0.0),
    option("-u --duration", "SECONDS", "Play so much.", type=FiniteRange(0.01)),
    flag("-l --loop", "Begin again at the end."),
    flag("--clock", "Publish /clock, and set /use_sim_time while it plays."),
    flag("--pause paused", "Begin with a pause."),
    option("-t --topic globs", "GLOB", "Only these topics.", multiple=True),
    option("--not deny", "GLOB", "Not these topics.", multiple=True),
    option("-m --module modules", "MODULE", "Only what these modules said.", multiple=True),
    flag("--over", "Play topics that other nodes publish, too."),
    argument("remap", nargs=-1, metavar="[OLD:=NEW]..."),
)
def play(recording: Path, paused: bool, remap: tuple[str, ...], options: Options, **given: Any) -> int:
    """Play a RECORDING at this module, from where it crosses the mesh: MCAP, a folder of it, or a bag.

    Space pauses, s plays one message, q ends. What other modules said is played here, too; for each part at its own
    module, run it at each with -m. A topic is left out while a node publishes it, also at a peer, so that a node
    under test stands in for the one that was recorded; of a topic of several nodes, only what that node said, if it
    is one of them. Exits 1 if the recording is not whole.

    ---
    {master}

    --clock sets /use_sim_time at this module, and as it was at the end; other modules follow it as [time] says. A
    player that was killed leaves it; the next `rmpa play` sets it as it was. A recorded /clock is played as it is.

    Examples:
      rmpa play fall.mcap
      rmpa play fall.mcap --start 55 --rate 0.25 --clock
      rmpa play run.bag -t '/scan' /scan:=/old_scan
      rmpa play fall.mcap -m base              what the module base said
    """
    check_record("rmpa play")
    from rmpa.record.play import PlayOptions

    names: dict[str, str] = {}
    for text in remap:
        old, sign, new = text.partition(":=")
        if not sign or not old or not new:
            raise ConfigError("OLD:=NEW", f"{text!r} renames nothing", "for example /scan:=/old_scan")
        names[old if old.startswith("/") else f"/{old}"] = new if new.startswith("/") else f"/{new}"
    globs: Any = given.pop("globs") or ("/**",)
    asked = PlayOptions(remap=names, topics=globs, **given)
    return asyncio.run(_play(recording, asked, options, paused=paused))


async def _play(recording: Path, asked: PlayOptions, options: Options, *, paused: bool) -> int:
    from rmpa.record.merge import Timeline
    from rmpa.record.play import NODE, Player
    from rmpa.ros.node.node import Node

    timeline = Timeline([recording])
    sys.setswitchinterval(0.0002)  # seconds that a message which is due waits for the thread that reads
    async with Node(NODE, master_uri=options.master().uri) as node:
        player = Player(node, timeline, asked, lambda text: click.echo(paint(printable(text), "yellow"), err=True))
        if paused:
            player.pause()
        task = start_task(player.run(), "play", raises=(RmpaError,))
        loop = asyncio.get_running_loop()
        for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
            loop.add_signal_handler(number, _end, task)
        with _keys(player, task), contextlib.suppress(asyncio.CancelledError):
            await task
    about = {"messages": player.count, "left_out": player.left_out, "notes": timeline.own_notes}
    options.show(about, timeline.own_notes, f"{player.count:,} messages played")
    return int(bool(timeline.damaged))


def _end(task: asyncio.Task[None]) -> None:
    """End the player, once: a second Ctrl-C would end it while it sets /use_sim_time as it was."""
    if not task.cancelling():
        task.cancel()


@contextlib.contextmanager
def _keys(player: Player, task: asyncio.Task[None]) -> Iterator[None]:
    """Keys of a terminal, and a line that shows where the player is."""
    if not (sys.stdin.isatty() and sys.stderr.isatty()):
        yield
        return
    loop, before = asyncio.get_running_loop(), termios.tcgetattr(sys.stdin)

    def pressed() -> None:
        key = os.read(sys.stdin.fileno(), 1)
        actions: dict[bytes, Callable[[], object]] = {
            b" ": player.pause,
            b"s": player.step,
            b"q": partial(_end, task),
        }
        if key in actions:
            actions[key]()

    async def show() -> None:
        while True:
            state = "paused " if player.paused else "playing"
            click.echo(f"\r{state} {player.position:8.2f} s  {player.count:,} messages  ", err=True, nl=False)
            await asyncio.sleep(0.2)

    tty.setcbreak(sys.stdin)
    loop.add_reader(sys.stdin, pressed)
    line = start_task(show(), "show the position")
    try:
        yield
    finally:
        line.cancel()
        loop.remove_reader(sys.stdin)
        termios.tcsetattr(sys.stdin, termios.TCSADRAIN, before)
        click.echo("", err=True)


@json_verb(
    argument("first", type=_RECORDING),
    argument("second", type=_RECORDING),
    flag("--all everything", "Also equal topics."),
)
def diff(first: Path, second: Path, everything: bool, options: Options) -> int:
    """Compare two recordings, topic by topic: messages, rates, gaps, ages, and the first message that differs.

    Numbers and stamps of headers are not compared. AGE is the time from the stamp to the recording: the median, and
    what 99 % have at most. Exits 1 if a topic differs, 2 if a recording cannot be read, or not whole.

    ---

    Examples:
      rmpa diff before.mcap after.mcap
      rmpa diff before.bag after.bag --json | jq '.[] | select(.difference != "")'
    """
    check_record("rmpa diff")
    from rmpa.record.diff import compare
    from rmpa.record.merge import Timeline

    try:
        recordings = Timeline([first]), Timeline([second])
        found = compare(*recordings)
    except RmpaError as error:
        print_error(error, error.code)
        options.show({"error": str(error), "code": error.code})
        return 2
    damaged = [text for one in recordings for text in one.damaged.values()]
    for text in damaged:
        click.echo(f"not whole: {printable(text)}", err=True)
    differ = [one for one in found if one.difference]
    rows = [row for one in (found if everything else differ) for row in _rows(one)]
    table = [Table("TOPIC, >MESSAGES, >RATE, >GAP, >AGE, FIRST DIFFERENCE", rows)] if rows else []
    options.show(found, *table, f"{len(found)} topics, {len(differ)} differ")
    return 2 if damaged else int(bool(differ))


def _rows(one: TopicDifference) -> Iterator[tuple[str, ...]]:
    def cells(run: TopicRun) -> tuple[str, ...]:
        age = f"{1e3 * run.age:.1f} / {1e3 * run.age_p99:.1f} ms" if run.age is not None and run.age_p99 else "-"
        rate, gap = (f"{run.rate:.2f} Hz" if run.rate else "-"), (f"{run.gap:.3f} s" if run.gap is not None else "-")
        return f"{run.count:,}", rate, gap, age

    yield one.topic, *cells(one.first), one.difference or "-"
    yield "", *cells(one.second), ""


def _at(_context: click.Context, _parameter: click.Parameter, text: str | None) -> float | time.struct_time | None:
    """A time of a recording: seconds from its beginning, or a time of the day."""
    try:
        return None if text is None else time.strptime(text, "%H:%M:%S") if ":" in text else float(text)
    except ValueError:
        raise click.BadParameter(f"{text!r} is neither seconds nor a time of the day: 58, 12:15:58.") from None


@json_verb(
    argument("recording", type=_RECORDING),
    option("--at", "TIME", "Only the half minute around it: 58 (s), 12:15:58 (UTC).", callback=_at),
    output_option("Write it: .md or .html."),
)
def story(recording: Path, at: float | time.struct_time | None, output: Path | None, options: Options) -> int:
    """Say what happened in a RECORDING: alarms, lost links, missed deadlines, profiles, gaps, errors, in order.

    AFTER is in seconds of the recording, as `--at` and `rmpa play --start` take it.

    ---

    Examples:
      rmpa story fall.mcap
      rmpa story fall.mcap --at 58 -o fall.html
    """
    check_record("rmpa story")
    from rmpa.record.merge import Timeline
    from rmpa.record.story import clock_text, render, tell

    timeline = Timeline([recording])
    told = tell(timeline.messages(), recording.name)
    told = msgspec.structs.replace(told, notes=(*timeline.notes, *told.notes))
    if at is not None:
        told = told.around(at if isinstance(at, float) else _seconds(told, at))
    if output is not None:
        kind = output.suffix.removeprefix(".")
        if kind not in ("md", "html"):
            raise ConfigError("-o", f"{output} is neither .md nor .html", "name the file so")
        output.write_text(render(told, kind), encoding="utf-8")
        options.show(told, f"{output}: {len(told.lines)} lines")
        return 0
    rows = [(f"{e.after:.2f} s", clock_text(e.at), e.module or "-", e.text, e.evidence) for e in told.lines]
    modules = ", ".join(told.modules) or "one module"
    options.show(
        told,
        f"{told.title}: {told.seconds:.1f} s, {told.messages:,} messages of {modules}",
        told.notes,
        Table(
            ">AFTER, TIME (UTC), MODULE, WHAT HAPPENED, SEEN IN", rows, [_COLOURS[line.level] for line in told.lines]
        )
        if rows
        else "nothing went wrong here",
    )
    return 0


def _seconds(told: Story, at: time.struct_time) -> float:
    """Seconds from the beginning to the next time of the day."""
    begin = told.begin / 1e9
    return (at.tm_hour * 3600 + at.tm_min * 60 + at.tm_sec - begin) % 86_400
