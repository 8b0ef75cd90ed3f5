"""What ``rmpa record`` does with recordings of other modules: they are kept, fetched and joined into one file."""

from __future__ import annotations

import base64
import contextlib
import shutil
import signal
import sys
import time
import zlib
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import click

from rmpa.bridge.kept import recording_id
from rmpa.bridge.limits import RECORDING_PART
from rmpa.bridge.recordings import FilePart, ModuleRecordings
from rmpa.cli.output import printable, size
from rmpa.core.errors import ConfigError, PeerRefused, RmpaError
from rmpa.core.identity import matches_any
from rmpa.core.limits import KIB

if TYPE_CHECKING:
    from collections.abc import Collection, Iterable, Iterator, Sequence
    from pathlib import Path

    from rmpa.bridge.kept import Kept
    from rmpa.cli.options import Options
    from rmpa.observe.control_client import ControlClient
    from rmpa.record.merge import Timeline

BAG: Final = ".bag"
MB: Final = 1_000_000
NO_RECORDER: Final = "no recorder runs there; start one: `rmpa record`, or [record] enabled = true"
# Seconds between two lines of progress.
PROGRESS: Final = 0.5
# Seconds that a command to all modules may take.
CALL: Final = 60.0
# A part of a file takes the way from its module for about so many seconds, and then the way is free as long: behind
# a switch or radio with a queue, a command waits for one part at the most. On 10 Mbit/s with a queue of 100 ms
# commands at 100 Hz had a p50 of 1 ms and a p99 of 25 ms by it. They were 64 to 83 ms and 116 to 169 ms when parts of
# 256 KiB followed each other; the fetch takes 33 s in place of 24 to 27.
_PART_SECONDS: Final = 0.02
# The least part; a smaller one would take the lane of commands.
_PART_MIN: Final = 16 * KIB
# Seconds within which modules have what is to be kept.
_KEPT_WITHIN: Final = 20.0
# Seconds for which a module that is not linked is waited for, and between two tries.
_AWAY: Final = 60.0
_AGAIN: Final = 0.5
# Seconds between two looks at what the recorders of a mesh have; they tell it every 5 s.
_LOOK: Final = 2.0
# Seconds of a ring that tell how many it will hold, and the share of its bytes above which it has dropped some.
_SURE: Final = 10.0
_FULL: Final = 0.75


def all_recordings(client: ControlClient) -> list[ModuleRecordings]:
    """The recordings of this module and of those that are linked."""
    return list(client.call("record", tuple[ModuleRecordings, ...], what="list"))


def parts_of(client: ControlClient, recording: str) -> list[tuple[str, Kept]]:
    """A recording at each module that has it.

    Raises:
        RmpaError: No module has it.
    """
    found = [(each.module, kept) for each in all_recordings(client) for kept in each.kept if kept.id == recording]
    if not found:
        raise RmpaError(f"no module has a recording {recording}; `rmpa record list` shows them", code="unknown-name")
    return found


@contextlib.contextmanager
def parts_folder(output: Path) -> Iterator[Path]:
    """A folder beside a file for what it is joined of; it stays if that fails, or is interrupted.

    Raises:
        ConfigError: There is one of an earlier run.
    """
    folder = output.with_name(f"{output.name}.parts")
    joins = f"`rmpa record merge {folder} -o {output}` joins it"
    if folder.exists():
        raise ConfigError("-o", f"{folder} is what an earlier run has left", f"{joins}; or remove it")
    folder.mkdir()
    try:
        yield folder
    except BaseException:
        if any(folder.rglob("*.mcap*")):
            click.echo(f"\nwhat was recorded so far is {folder}: {joins}", err=True)
        else:
            shutil.rmtree(folder)
        raise
    shutil.rmtree(folder)


def join(paths: list[Path], output: Path, reference: str = "", topics: Sequence[str] = ()) -> Timeline:
    """Merge recordings into one file, MCAP or bag; ``topics``: only those, by globs, and events."""
    from rmpa.record.bag import write_bag
    from rmpa.record.merge import Timeline

    if output.exists():
        raise ConfigError("-o", f"{output} exists", "name another file")
    timeline, whole = Timeline(paths, reference, topics), output.with_name(f".{output.name}.new")
    try:
        if output.suffix == BAG:
            write_bag(timeline.messages(), whole)
        else:
            with whole.open("wb") as file:
                timeline.write(file)
        whole.replace(output)
    except OSError as error:
        text = f"{output} cannot be written: {error.strerror}; is the disk full?"
        raise RmpaError(text, code="directory-unusable") from None
    finally:
        whole.unlink(missing_ok=True)
    return timeline


def merged(output: Path, result: Timeline) -> list[str]:
    """What became of a merge, in lines."""
    doubles = f", {result.doubles:,} doubles left out" if result.doubles else ""
    damaged = "".join(f"; not read: {text}" for text in result.damaged.values())
    text = f"{output}: {result.count:,} messages of {len(result.offsets)} modules{doubles}{damaged}"
    return [text, *result.notes]


class Fetched(NamedTuple):
    """What was fetched of one module: bytes, and why not all; empty: it is all there."""

    module: str
    size: int
    problem: str = ""


def fetch(client: ControlClient, recording: str, folder: Path, only: Collection[str] = ()) -> list[Fetched]:
    """Fetch a recording into a folder for each module; what is there already is checked, and not fetched again.

    Args:
        client: To the agent.
        recording: Its name.
        folder: Where to.
        only: The modules; empty: all that have it.

    Raises:
        RmpaError: No module has it.
    """
    parts = [(module, kept) for module, kept in parts_of(client, recording) if not only or module in only]
    total, done = sum(kept.size for _, kept in parts), 0
    found = []
    for module, kept in parts:
        place, count, problem = folder / module, 0, ""
        try:
            place.mkdir(parents=True, exist_ok=True)
            for name in kept.files:
                for more in _fetch_file(client, module, recording, name, place):
                    count += more
                    say(f"{module}: {100 * (done + count) // max(total, 1)} % of {size(total)}")
        except PeerRefused as error:
            problem = str(error)
        except OSError as error:
            problem = f"{place} cannot be written: {error.strerror}; is the disk full?"
        done += count
        found.append(Fetched(module, count, problem))
    end_line()
    return found


def _fetch_file(client: ControlClient, module: str, recording: str, name: str, place: Path) -> Iterator[int]:
    """Append what is missing of a file; yields the bytes of each part, and of what was there.

    Raises:
        PeerRefused: The module has it no more, or was away for too long.
        RmpaError: What is there is not the beginning of that file.
    """
    if "/" in name or name.startswith("."):
        raise RmpaError(f"{module} names a file {printable(name)}", code="protocol-error")
    path, wanted, check = place / name, _PART_MIN, True
    with path.open("ab") as file:
        yield file.tell()
        while True:
            began, offset = time.monotonic(), file.tell()
            part = _read(
                client, module, id=recording, file=name, offset=offset, size=wanted, check=check and offset > 0
            )
            took, data = time.monotonic() - began, base64.b64decode(part.data)
            if part.before is not None and part.before != _checksum(path):
                text = f"{path} is another file than that of {recording}; remove it, or name another folder with -o"
                raise RmpaError(text, code="file-exists")
            check = False
            file.write(data)
            yield len(data)
            if not data or file.tell() >= part.size:
                return
            if took < _PART_SECONDS / 2:
                wanted = min(2 * wanted, RECORDING_PART)
            elif took > 2 * _PART_SECONDS:
                wanted = max(wanted // 2, _PART_MIN)
            time.sleep(min(took, 1.0))


def _read(client: ControlClient, module: str, **args: Any) -> FilePart:
    """Ask for a part of a file; a module that is not linked is waited for.

    Raises:
        PeerRefused: It refuses, or is away for too long.
    """
    until = time.monotonic() + _AWAY
    while True:
        try:
            return client.call("record", FilePart, what="read", module=module, **args)
        except PeerRefused as error:
            if error.code not in {"peer-unlinked", "no-agent"} or time.monotonic() > until:
                raise
            say(f"{module} is away: waiting {until - time.monotonic():.0f} s for it; Ctrl-C ends")
            time.sleep(_AGAIN)


def _checksum(path: Path) -> int:
    found = 0
    with path.open("rb") as file:
        while block := file.read(MB):
            found = zlib.crc32(block, found)
    return found


def keep(
    client: ControlClient, why: str, seconds: float | None, modules: Sequence[str] = ()
) -> tuple[str, dict[str, str]]:
    """Keep what modules have of the last seconds.

    Returns:
        The recording's name, empty if no module has it; and by module why it is not kept there, or nothing.
    """
    name = recording_id(why, client.agent().name, time.time_ns())
    given = {"id": name, "why": why, "seconds": seconds, "modules": list(modules)}
    answers = client.call("record", dict[str, str], what="keep", **given)
    answers |= _outcome(client, name, {module for module, problem in answers.items() if not problem})
    return ("" if all(answers.values()) else name), answers


def _outcome(client: ControlClient, name: str, modules: set[str]) -> dict[str, str]:
    """Wait until modules have a recording, or say why not: by module, empty where it has it."""
    deadline, found = time.monotonic() + _KEPT_WITHIN, dict[str, str]()
    while True:
        told = {each.module: each for each in all_recordings(client) if each.module in modules}
        for module, each in told.items():
            if any(kept.id == name for kept in each.kept):
                found[module] = ""
            elif why := each.status.get("failed", {}).get(name) or (
                not each.status and (each.problem or NO_RECORDER)
            ):
                found[module] = why
        if found.keys() >= modules:
            return found
        if time.monotonic() > deadline:
            break
        time.sleep(0.1)
    for module in modules - found.keys():
        why = str(told[module].status.get("problem", "")) if module in told else "it is not linked any more"
        found[module] = f"not kept within {_KEPT_WITHIN:g} s: {why or 'it is busy'}"
    return found


def say(text: str) -> None:
    """Show progress, on a terminal, in place of what was shown before."""
    if sys.stderr.isatty():
        click.echo(f"\r\x1b[K{printable(text)}", err=True, nl=False)


def end_line() -> None:
    """End the line of progress."""
    if sys.stderr.isatty():
        click.echo("", err=True)


def record_mesh(options: Options, output: Path, given: dict[str, Any]) -> int:
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
    options.show(
        {**about, "problems": problems, "left_out": left},
        *merged(output, result),
        *(f"! {module}: {problem}" for module, problem in problems.items()),
        *(
            f"= {module}: {count:,} messages above its [record] topic_rate, total_rate or thin"
            for module, count in left.items()
        ),
    )
    return int(bool(problems) or not result.count)


def _recorders(
    found: Iterable[ModuleRecordings], wanted: Sequence[str]
) -> tuple[dict[str, ModuleRecordings], dict[str, str]]:
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


def _bounds(recorders: dict[str, ModuleRecordings], duration: float | None) -> float:
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
        raise ConfigError(
            "--duration", text, "set [record] seconds or megabytes there, or record with -o at the module"
        )
    return duration or min(least, 86_400.0)


def _wait(options: Options, recorders: dict[str, ModuleRecordings], seconds: float, given: dict[str, Any]) -> None:
    """Wait for the end, with progress; Ctrl-C raises ``KeyboardInterrupt``."""
    began, counts = time.monotonic(), (0, 0)
    looked = began
    with options.client(CALL) as client:
        while (rest := began + seconds - time.monotonic()) > 0:
            time.sleep(min(rest, PROGRESS))
            if time.monotonic() - looked > _LOOK and (sys.stderr.isatty() or given["megabytes"]):
                now = {each.module: each for each in all_recordings(client)}
                counts = (
                    _grown(recorders, now, "messages", given["globs"]),
                    _grown(recorders, now, "size", given["globs"]),
                )
                looked = time.monotonic()
            took = time.monotonic() - began
            say(f"{took:6.1f} s  {len(recorders)} modules  {counts[0]:,} messages  {size(counts[1])}")
            if given["megabytes"] and counts[1] >= given["megabytes"] * MB:
                return


def _grown(
    before: dict[str, ModuleRecordings], now: dict[str, ModuleRecordings], what: str, globs: Sequence[str]
) -> int:
    """By how much the recorders' counts of topics have grown."""
    total = 0
    for name, each in before.items():
        then = each.status.get(what, {})
        for topic, count in (now[name].status.get(what, {}) if name in now else {}).items():
            if not globs or matches_any(globs, topic):
                total += max(0, count - then.get(topic, 0))
    return total


def _missing(
    before: dict[str, ModuleRecordings], now: dict[str, ModuleRecordings], answers: dict[str, str], seconds: float
) -> dict[str, str]:
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
