"""Recordings that modules have kept: ``rmpa record list|info|keep|fetch|merge|rm``."""

from __future__ import annotations

import base64
import contextlib
import shutil
import sys
import time
import zlib
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import click

from rmpa.bridge.kept import Kept, recording_id
from rmpa.bridge.limits import RECORDING_PART
from rmpa.bridge.recordings import FilePart, ModuleRecordings
from rmpa.cli.module import check_record
from rmpa.cli.options import FiniteRange, Options, agent_verb, argument, json_verb, option, options_of, output_option
from rmpa.cli.output import Table, printable, size
from rmpa.core.errors import ConfigError, PeerRefused, RmpaError
from rmpa.core.limits import KIB
from rmpa.observe.operations import remove_recording

if TYPE_CHECKING:
    from collections.abc import Collection, Iterator, Sequence

    from rmpa.observe.control_client import ControlClient
    from rmpa.record.merge import Timeline

_BAG: Final = ".bag"
_SECOND: Final = 1_000_000_000
_BLOCK: Final = 1_000_000
NO_RECORDER: Final = "no recorder runs there; start one: `rmpa record`, or [record] enabled = true"
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


def all_recordings(client: ControlClient) -> tuple[ModuleRecordings, ...]:
    """The recordings of this module and of those that are linked."""
    return client.call("record", tuple[ModuleRecordings, ...], what="list")


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


def writable(output: Path) -> None:
    """Check that a recording can go to a file.

    Raises:
        ConfigError: The file is there, or its name does not say as what.
    """
    if output.exists():
        raise ConfigError("-o", f"{output} exists", "name another file")
    if output.suffix not in (_BAG, ".mcap"):
        raise ConfigError("-o", f"{output} is neither .mcap nor .bag", "name the file so")


def join(paths: list[Path], output: Path, reference: str = "", topics: Sequence[str] = ()) -> Timeline:
    """Merge recordings into one file, MCAP or bag; ``topics``: only those, by globs, and events."""
    from rmpa.record.bag import write_bag
    from rmpa.record.merge import Timeline

    writable(output)
    timeline, whole = Timeline(paths, reference, topics), output.with_name(f".{output.name}.new")
    try:
        if output.suffix == _BAG:
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
        while block := file.read(_BLOCK):
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


def _names(ctx: click.Context, _: str) -> Iterator[str]:
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
    recorders = [(each.module, *_state(each), each.problem or each.status.get("problem") or "-") for each in found]
    by_id: dict[str, list[tuple[str, Kept]]] = {}
    for each in found:
        for kept in each.kept:
            by_id.setdefault(kept.id, []).append((each.module, kept))
    rows = [
        (name, ", ".join(module for module, _ in parts), size(sum(kept.size for _, kept in parts)), parts[0][1].why)
        for name, parts in sorted(by_id.items())
    ]
    table = Table("MODULE, RECORDER, >BACK, >RING, >WRITTEN, PROBLEM", recorders)
    options.show(found, table, "", Table("RECORDING, MODULES, >SIZE, WHY", rows))
    return int(any(each.problem for each in found))


def _state(each: ModuleRecordings) -> tuple[str, str, str, str]:
    status = each.status
    if not status:
        return "-", "-", "-", "-"
    total, back = status.get("ring", (0, 0.0))
    hours = max(status["at"] - status["since"], 1.0) / 3600
    return "runs", f"{back:.0f} s", size(total), f"{size(status.get('written', 0) / hours)}/h"


@agent_verb(argument("recording", _names))
def record_info(recording: str, options: Options) -> int:
    """Show what is known of a RECORDING, at each module that has it.

    ---

    Examples:
      rmpa record info 20261129-121500-arm-alarm
    """
    with options.client(CALL) as client:
        parts = parts_of(client, recording)
    rows = []
    for module, kept in parts:
        since = time.strftime("%Y-%m-%d %H:%M:%S", time.gmtime(kept.since / _SECOND))
        length = f"{(kept.until - kept.since) / _SECOND:.0f} s"
        rows.append((module, since, length, str(len(kept.files)), size(kept.size)))
    kept = parts[0][1]
    about = f"{kept.id}: {kept.why}" + (f" (asked by {kept.asked_by})" if kept.asked_by else "")
    options.show([kept for _, kept in parts], about, Table("MODULE, SINCE (UTC), >LENGTH, >FILES, >SIZE", rows))
    return 0


@agent_verb(
    argument("why", required=False, default="by hand"),
    option("--seconds", help="How much of the past. [default: all that is there]", type=FiniteRange(0.1)),
    output_option("Fetch and merge it, too."),
)
def record_keep(why: str, seconds: float | None, output: Path | None, options: Options) -> int:
    """Keep what all modules have of the last minutes; WHY names it.

    Modules that are not linked keep it when they are back. Exits 1 if a module cannot.

    ---

    Examples:
      rmpa record keep
      rmpa record keep "the arm hit the table" --seconds 60 -o hit.mcap
    """
    if output is not None:
        writable(output)
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


@agent_verb(argument("recording", _names), output_option("Where to. [default: ./RECORDING]", "DIR"))
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
    about = {"folder": str(folder), "modules": {one.module: one.size for one in fetched}, "problems": problems}
    table = Table("MODULE, >SIZE, PROBLEM", [(one.module, size(one.size), one.problem or "-") for one in fetched])
    after = "not all is there: the same command goes on from there"
    options.show(about, table, after if problems else f"merge it: rmpa record merge {folder} -o {recording}.mcap")
    return int(bool(problems))


@json_verb(
    argument("recordings", nargs=-1, required=True, type=click.Path(exists=True, path_type=Path)),
    output_option(".mcap or .bag.", required=True),
    option("--clock reference", "MODULE", "Whose clock. [default: the best known]", default=""),
)
def record_merge(recordings: tuple[Path, ...], output: Path, reference: str, options: Options) -> int:
    """Put RECORDINGS of several modules on one timeline: files, or folders as `rmpa record fetch` makes them.

    ---

    Examples:
      rmpa record merge fall -o fall.mcap
      rmpa record merge arm.mcap base.mcap --clock base -o both.bag
    """
    check_record("rmpa record")
    result = join([*recordings], output, reference)
    about = {
        "file": str(output),
        "reference": result.reference,
        "offsets": {name: one._asdict() for name, one in result.offsets.items()},
        "messages": result.count,
        "doubles": result.doubles,
        "damaged": list(result.damaged.values()),
        "notes": result.notes,
    }
    rows = []
    for name, one in result.offsets.items():
        ahead = "the clock" if name == result.reference else f"{1e3 * one.ahead:+.3f} ms"
        rows.append((name, ahead, "not known" if one.error is None else f"{1e3 * one.error:.3f} ms"))
    options.show(about, *merged(output, result), Table("MODULE, >AHEAD, >±", rows))
    return int(bool(result.damaged))


@agent_verb(argument("recording", _names), option("--module", help="Only that of this module.", default=""))
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
