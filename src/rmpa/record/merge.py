"""One timeline of recordings of several modules: their clocks, their doubles, and the module of each message.

Times are put on the clock of one module by what the modules knew of each other's clocks while they recorded; where
nothing is known they stay as they are, and the result says so. Two messages of different modules that are nearer to
each other than the sum of their bounds may have happened in the other order. Where a module's clock was set while it
recorded, what is before is moved by as much. The same recordings give the same bytes.
"""

from __future__ import annotations

import heapq
from bisect import bisect_right
from itertools import pairwise
from typing import IO, TYPE_CHECKING, Final, NamedTuple

import msgspec

from rmpa.core.errors import RmpaError
from rmpa.core.identity import OWN_NODE, matches
from rmpa.record.format import (
    EVENTS,
    MERGE,
    NOTES,
    STATIC,
    SUFFIX,
    ClockRecord,
    DamagedError,
    Recorded,
    RecordedSource,
    SegmentReader,
    SegmentWriter,
    clock_shifts,
    moved,
)

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Mapping, Sequence
    from pathlib import Path

_SECOND: Final = 1_000_000_000
# By so many nanoseconds a clock may have been read before the first message of its module, or behind the last.
_NEAR: Final = 5 * _SECOND


class Offset(NamedTuple):
    """A module's clock against that of the reference, in seconds.

    Attributes:
        ahead: By so much it was ahead, at the first segment that knows it; 0 where nothing is known.
        error: The bound of that, ±; ``None``: it is not known.
    """

    ahead: float
    error: float | None


class MergeResult(NamedTuple):
    """What a merge gave.

    Attributes:
        reference: The module whose clock all times are of.
        offsets: By module.
        messages: How many.
        doubles: Messages that were left out because another module has them from their source.
        damaged: Files that could not be read, each with the reason.
        notes: What limits it: clocks that are not known or were set, modules that are missing.
    """

    reference: str
    offsets: dict[str, Offset]
    messages: int
    doubles: int
    damaged: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()


def files_of(path: Path) -> list[Path]:
    """The segments of a recording: a file, or all in a folder, in order.

    Raises:
        RmpaError: There are none.
    """
    found = [path] if path.is_file() else sorted(path.rglob(f"*{SUFFIX}*"))
    if not found:
        raise RmpaError(f"{path} has no recording: no file {SUFFIX}", code="unknown-name")
    return found


class _Clock:
    """The clock of one module against the reference, over time."""

    def __init__(self) -> None:
        # Readings: when, by the clock of the module that made them; ahead; the bound of its error.
        self.known: list[tuple[int, float, float | None]] = []

    def learn(self, at: int, ahead: float, error: float | None) -> None:
        self.known.append((at, ahead, error))

    def ready(self) -> None:
        self.known.sort(key=lambda each: each[0])

    @property
    def offset(self) -> Offset:
        errors = [error for _, _, error in self.known if error is not None]
        return Offset(self.known[0][1], max(errors, default=None)) if self.known else Offset(0.0, None)

    def shift(self, time: int) -> int:
        """Nanoseconds to take off a time of this clock: as of the last reading before it, else the first one."""
        if not self.known:
            return 0
        at = bisect_right(self.known, time, key=lambda each: each[0])
        return round(self.known[max(0, at - 1)][1] * _SECOND)


def merge(paths: Sequence[Path], file: IO[bytes], reference: str = "", topics: Sequence[str] = ()) -> MergeResult:
    """Write one recording of several.

    Args:
        paths: Recordings: files, or folders of segments; of any modules.
        file: The result, open for writing.
        reference: The module whose clock the times are put on; empty: the first by name that knows most others.
        topics: The topics that are wanted, as globs, beside events; empty: all.

    Raises:
        RmpaError: There is no such module, or nothing can be read.
    """
    files = sorted({each for path in paths for each in files_of(path)}, key=lambda each: (each.name, str(each)))
    heads, damaged = [], []
    for each in files:
        try:
            heads.append(_head(each))
        except DamagedError as error:
            damaged.append(str(error))
    if not heads:
        raise RmpaError(f"nothing can be read: {'; '.join(damaged)}", code="recording-damaged")
    modules = sorted({head.module for head in heads})
    reference = reference or _best_known(heads, modules)
    if reference not in modules:
        raise RmpaError(f"there is no recording of {reference}; there are {', '.join(modules)}", code="unknown-name")
    heads = _on_last_clocks(heads)
    steps = {module: found for module in modules if (found := _steps(heads, module))}
    clocks = _clocks(heads, modules, reference)
    nodes = {(head.module, source.node, source.type) for head in heads for source in head.sources}
    offsets = {module: clocks[module].offset for module in modules}
    writer = SegmentWriter(file, None)
    about = {name: msgspec.json.encode(one).decode() for name, one in offsets.items()}
    writer.metadata(MERGE, {"reference": reference, **about})
    missing = sorted({peer for head in heads for peer in head.clocks}.difference(modules))
    notes = _notes(reference, offsets, steps, missing)
    writer.metadata(NOTES, {"text": "\n".join(notes)})
    count = doubles = 0
    seen: dict[RecordedSource, bytes] = {}
    streams = (_timed(head, clocks[head.module]) for head in heads)
    wanted = {
        source.topic
        for head in heads
        for source in head.sources
        if source.topic == EVENTS or not topics or any(matches(glob, source.topic) for glob in topics)
    }
    for message in heapq.merge(*streams, key=_order):
        if message.source.topic not in wanted:
            continue
        if _is_double(message, nodes, seen):
            doubles += 1
            continue
        writer.write(*message)
        count += 1
    writer.finish()
    return MergeResult(reference, offsets, count, doubles, tuple(damaged), notes)


class _Head(NamedTuple):
    """What is known of a file without its messages."""

    path: Path
    module: str
    first: int
    last: int
    clocks: dict[str, ClockRecord]
    sources: frozenset[RecordedSource]
    epoch: tuple[str, int] | None
    # What puts its times on its module's clock as it was set at last, ns.
    shift: int = 0


def _head(path: Path) -> _Head:
    reader = SegmentReader(path)
    first, last, sources = reader.head()
    name = reader.module.name or path.parent.name
    return _Head(path, name, first, last, reader.clocks, frozenset(sources), reader.epoch)


def _on_last_clocks(heads: list[_Head]) -> list[_Head]:
    shifts = clock_shifts([(head.module, head.epoch) for head in heads])
    return [head._replace(shift=shift) for head, shift in zip(heads, shifts, strict=True)]


def _steps(heads: list[_Head], module: str) -> list[float]:
    shifts = [head.shift for head in heads if head.module == module]
    return [round((one - other) / _SECOND, 3) for one, other in pairwise(shifts) if one != other]


def _reading(heads: list[_Head], module: str, reader: _Head, known: ClockRecord) -> ClockRecord | None:
    """What a segment knew of a module's clock, for the clocks of both as they were set at last.

    ``None``: the module's clock was set, and it is not clear whether that was before or after.
    """
    then, ahead = known.at + round(known.ahead * _SECOND), known.ahead
    own = [head for head in heads if head.module == module and head.first]
    if any(head.shift for head in heads if head.module in (module, reader.module)):
        shifts = {head.shift for head in own if head.first - _NEAR <= then <= head.last + _NEAR}
        if len(shifts) != 1:
            return None
        ahead += (shifts.pop() - reader.shift) / _SECOND
    return ClockRecord(known.at + reader.shift, ahead, known.error)


def _best_known(heads: list[_Head], modules: list[str]) -> str:
    """The module of which, or by which, most clocks are known."""

    def known(name: str) -> int:
        own = {peer for head in heads if head.module == name for peer in head.clocks}
        return len(own | {head.module for head in heads if name in head.clocks})

    return max(modules, key=lambda name: (known(name), [-ord(letter) for letter in name]))


def _clocks(heads: list[_Head], modules: list[str], reference: str) -> dict[str, _Clock]:
    """Each module's clock against the reference: as the reference knew it, else as the module knew the reference."""
    made = {module: _Clock() for module in modules}
    for head in heads:
        for peer, known in head.clocks.items() if head.module == reference else ():
            if peer in made and (one := _reading(heads, peer, head, known)) is not None:
                made[peer].learn(one.at, one.ahead, one.error)
    unknown = {module for module, clock in made.items() if not clock.known}
    for head in heads:
        own = head.clocks.get(reference) if head.module in unknown else None
        if own is not None and (one := _reading(heads, reference, head, own)) is not None:
            made[head.module].learn(one.at, -one.ahead, one.error)
    made[reference] = _Clock()
    made[reference].learn(0, 0.0, 0.0)
    for clock in made.values():
        clock.ready()
    return made


def _timed(head: _Head, clock: _Clock) -> Iterator[Recorded]:
    """The messages of a file by the reference's clock, with their module."""
    named: dict[RecordedSource, RecordedSource] = {}
    for message in SegmentReader(head.path).messages():
        source, log_time, publish_time, data = moved(message, head.shift) if head.shift else message
        own = named.get(source)
        if own is None:
            own = named[source] = source if source.module else source._replace(module=head.module)
        yield Recorded(own, log_time - clock.shift(log_time), publish_time - clock.shift(publish_time), data)


def _order(message: Recorded) -> tuple[int, str, str, str]:
    source = message.source
    return message.log_time, source.module, source.topic, source.node


def _is_double(message: Recorded, nodes: set[tuple[str, str, str]], seen: dict[RecordedSource, bytes]) -> bool:
    """Whether a message is in the result already, or comes again from its source.

    A proxy (``/rmpa/PEER/node``) is a copy of a node whose own module was recorded, too. A message whose times differ
    is one that a segment repeats; the first one may be of a time that is not there, or by a clock that was set since.
    """
    source = message.source
    if source.node.startswith(f"{OWN_NODE}/") and source.topic != EVENTS:
        peer, _, node = source.node[len(OWN_NODE) + 1 :].partition("/")
        return (peer, f"/{node}", source.type) in nodes
    repeated = message.publish_time != message.log_time
    if repeated and seen.get(source) == message.data:
        return True
    if repeated or source.latching or source.topic == STATIC:
        seen[source] = message.data
    return False


def _notes(
    reference: str, offsets: Mapping[str, Offset], steps: Mapping[str, list[float]], missing: Iterable[str]
) -> tuple[str, ...]:
    """What limits a recording, for people."""
    notes = [f"Times are by the clock of {reference}."]
    unknown = [name for name, one in offsets.items() if one.error is None]
    bound = max((one.error for one in offsets.values() if one.error is not None), default=0.0)
    if len(offsets) > 1:
        notes.append(
            f"Of two modules, what is nearer than {2e3 * bound:.2f} ms may have happened in the other order."
        )
    for name, one in steps.items():
        times = ", ".join(f"{seconds:+.3f} s" for seconds in one)
        notes.append(f"The clock of {name} was set meanwhile ({times}): what was before is moved by as much.")
    if unknown:
        notes.append(f"The clock of {', '.join(unknown)} is not known against it: its times are as it wrote them.")
    if names := ", ".join(missing):
        notes.append(f"Nothing of {names} is here, which was linked: fetch its recording, if it can be reached.")
    return tuple(notes)


def notes_of(path: Path) -> tuple[str, ...]:
    """What a merged recording says of what limits it: of its clocks, and of modules that are missing."""
    if path.suffix == ".bag":
        return ()
    reader = SegmentReader(files_of(path)[0])
    next(reader.messages(), None)
    return reader.notes
