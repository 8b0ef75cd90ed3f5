"""``rmpa play``, ``rmpa diff`` and ``rmpa story``: what is done with recordings."""

from __future__ import annotations

import asyncio
import contextlib
import os
import signal
import sys
import termios
import tty
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import click

from rmpa.cli.module import check_record
from rmpa.cli.options import FiniteRange, Options, argument, flag, graph_verb, json_verb
from rmpa.cli.output import Table, paint, printable
from rmpa.core.errors import ConfigError, RmpaError
from rmpa.runtime.tasks import start_task

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from rmpa.record.diff import TopicDifference, TopicRun
    from rmpa.record.play import Player, PlayOptions

_RECORDING: Final = click.Path(exists=True, path_type=Path)
_COLOURS: Final = {"error": "red", "warn": "yellow", "info": ""}


@graph_verb(
    argument("recording", type=_RECORDING),
    click.option("-r", "--rate", type=FiniteRange(0.001), default=1.0, help="So many times as fast."),
    click.option("-s", "--start", type=FiniteRange(0), default=0.0, metavar="SECONDS", help="Leave out so much."),
    click.option("-u", "--duration", type=FiniteRange(0.01), metavar="SECONDS", help="Play so much."),
    flag("-l", "--loop", help="Begin again at the end."),
    flag("--clock", help="Publish /clock, and set /use_sim_time while it plays."),
    flag("--pause", "paused", help="Begin with a pause."),
    click.option("-t", "--topic", "globs", multiple=True, metavar="GLOB", help="Only these topics."),
    click.option("--not", "deny", multiple=True, metavar="GLOB", help="Not these topics."),
    click.option("-m", "--module", "modules", multiple=True, metavar="MODULE", help="Only what these modules said."),
    flag("--over", help="Play topics that other nodes publish, too."),
    argument("remap", nargs=-1, metavar="[OLD:=NEW]..."),
)
def play(recording: Path, paused: bool, remap: tuple[str, ...], options: Options, **given: Any) -> int:
    """Play a RECORDING into this module's core, from where it crosses the mesh: MCAP, a folder of it, or a bag.

    Space pauses, s plays one message, q ends. A topic that a node publishes already is left out, so that a node under
    test stands in for the one that was recorded.

    ---
    {master}

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
    flag("--all", "everything", help="Also equal topics."),
)
def diff(first: Path, second: Path, everything: bool, options: Options) -> int:
    """Compare two recordings, topic by topic: messages, rates, gaps, ages, and the first message that differs.

    Numbers and stamps of headers are not compared. Exits 1 if a topic differs.

    ---

    Examples:
      rmpa diff before.mcap after.mcap
      rmpa diff before.bag after.bag --json | jq '.[] | select(.difference != "")'
    """
    check_record("rmpa diff")
    from rmpa.record.bag import read_any
    from rmpa.record.diff import compare

    found = compare(read_any(first), read_any(second))
    shown = [one for one in found if everything or not one.same]
    rows = [row for one in shown for row in _rows(one)]
    heads = "TOPIC, >MESSAGES, >RATE, >GAP, >AGE, FIRST DIFFERENCE"
    options.show(found, Table(heads, rows), f"{len(found)} topics, {sum(not one.same for one in found)} differ")
    return int(any(not one.same for one in found))


def _rows(one: TopicDifference) -> Iterator[tuple[str, ...]]:
    def cells(run: TopicRun) -> tuple[str, ...]:
        values = ((run.rate, "{:.2f} Hz", 1.0), (run.gap, "{:.3f} s", 1.0), (run.age, "{:.1f} ms", 1e3))
        return (f"{run.count:,}", *("-" if value is None else text.format(value * by) for value, text, by in values))

    yield one.topic, *cells(one.first), one.difference or "-"
    yield "", *cells(one.second), ""


@json_verb(
    argument("recording", type=_RECORDING),
    click.option("--at", "around", type=FiniteRange(0), metavar="SECONDS", help="Only the half minute around it."),
    click.option("-o", "--output", type=click.Path(path_type=Path), metavar="FILE", help="Write it: .md or .html."),
)
def story(recording: Path, around: float | None, output: Path | None, options: Options) -> int:
    """Say what happened in a RECORDING: alarms, lost links, missed deadlines, profiles, gaps, errors, in order.

    ---

    Examples:
      rmpa story fall.mcap
      rmpa story fall.mcap --at 58 -o fall.html
    """
    check_record("rmpa story")
    from rmpa.record.bag import read_any
    from rmpa.record.merge import notes_of
    from rmpa.record.story import clock_text, render, tell

    told = tell(read_any(recording), recording.name, notes_of(recording), around)
    if output is not None:
        kind = output.suffix.removeprefix(".")
        if kind not in ("md", "html"):
            raise ConfigError("-o", f"{output} is neither .md nor .html", "name the file so")
        output.write_text(render(told, kind), encoding="utf-8")
        options.show(told, f"{output}: {len(told.lines)} lines")
        return 0
    rows = [(clock_text(line.at), line.module or "-", line.text, line.evidence) for line in told.lines]
    colours = [_COLOURS[line.level] for line in told.lines]
    seconds = (told.end - told.begin) / 1e9
    options.show(
        told,
        f"{told.title}: {seconds:.1f} s, {told.messages:,} messages of {', '.join(told.modules) or 'one module'}",
        *told.notes,
        Table("TIME (UTC), MODULE, WHAT HAPPENED, SEEN IN", rows, colours) if rows else "nothing went wrong",
    )
    return 0
