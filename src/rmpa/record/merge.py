"""One timeline of recordings of several modules: their clocks, their doubles, and the module of each message.

Times are put on the clock of one module by what the modules knew of each other's clocks while they recorded, also
through a third one; where nothing is known they stay as they are, and the result says so. Two messages of different
modules that are nearer to each other than the sum of their bounds may have happened in the other order. The same
recordings give the same bytes.
"""

from __future__ import annotations

import filecmp
from bisect import bisect_right
from typing import IO, TYPE_CHECKING, Final, NamedTuple

import msgspec

from rmpa.core.errors import RmpaError
from rmpa.core.identity import OWN_NODE, matches_any
from rmpa.record import limits
from rmpa.record.format import (
    CLOCK,
    EVENTS,
    MERGE,
    STATIC,
    SUFFIX,
    ClockRecord,
    DamagedError,
    Recorded,
    RecordedSource,
    SegmentReader,
    SegmentWriter,
    read_in_order,
)

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Sequence
    from pathlib import Path

    from rmpa.record.bag import BagReader

_SECOND: Final = 1_000_000_000
# Quartzes differ by so much at most: what two readings of a clock differ by more was set, not drift.
_DRIFT: Final = 500e-6
# Two files of a module that are so far apart, in nanoseconds, are one time in which it recorded.
_APART: Final = 2 * _SECOND
# A proxy's copy comes so much later than its source, nanoseconds.
_LATE: Final = _SECOND // 10
# Seconds by which times may differ for nothing but rounding.
_ROUNDING: Final = 1e-6
# Keys in the metadata of a merged file beside modules, which have no such names.
_NOTES, _MISSING = "/notes", "/missing"


class Offset(NamedTuple):
    """A module's clock against that of the reference, in seconds.

    Attributes:
        ahead: By so much it was ahead, at the first segment that knows it; 0 where nothing is known.
        error: The bound of that, ±; ``None``: it is not known.
    """

    ahead: float
    error: float | None


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
    """The clock of one module against that of another one, which has one against the reference itself.

    Args:
        known: What is known of it, at times of it; empty: nothing.
        over: The other one; ``None``: it is the reference.
    """

    def __init__(self, known: Iterable[ClockRecord], over: _Clock | None = None) -> None:
        self._known = sorted(known, key=lambda each: (each.at, each.ahead))
        self._over = over
        self.widened = 0.0

    @property
    def known(self) -> bool:
        return bool(self._known) and (self._over is None or self._over.known)

    @property
    def offset(self) -> Offset:
        """Its first reading against the reference, with the largest bound."""
        if not self._known:
            return Offset(0.0, None)
        first, errors = self._known[0], [each.error for each in self._known]
        over = Offset(0.0, 0.0) if self._over is None else self._over.offset
        error = None if None in errors or over.error is None else max(filter(None, errors), default=0.0) + over.error
        return Offset(first.ahead + over.ahead, None if error is None else max(error, self.widened))

    def shift(self, at: int) -> int:
        """Nanoseconds to take off a time of this clock: between two readings evenly, but where it was set."""
        if not self._known or self._over is None:
            return 0
        after = bisect_right(self._known, at, key=lambda each: each.at)
        one, other = self._known[max(0, after - 1)], self._known[min(after, len(self._known) - 1)]
        ahead = one.ahead
        if other.at > one.at:
            part = (at - one.at) / (other.at - one.at)
            ahead += (other.ahead - one.ahead) * (round(part) if _was_set(one, other) else part)
        own = round(ahead * _SECOND)
        return own + self._over.shift(at - own)


def _was_set(one: ClockRecord, other: ClockRecord) -> bool:
    errors = (one.error or 0.0) + (other.error or 0.0)
    return abs(other.ahead - one.ahead) > errors + _DRIFT * (other.at - one.at) / _SECOND + 0.01


class _Head(NamedTuple):
    """What is known of a file without its messages.

    Attributes:
        path: The file.
        module: Whose clock its times are of.
        first: The time of its first message.
        last: Of the last one.
        readings: What it knows of the clocks of peers.
        sources: Whose messages are in it.
        merged: What a merge said of its clocks.
        epoch: The machine's run (``boot``), and by what its clock was ahead of the time since then (``epoch``).
    """

    path: Path
    module: str
    first: int
    last: int
    readings: list[tuple[str, ClockRecord]]
    sources: Iterable[RecordedSource]
    merged: dict[str, str]
    epoch: tuple[str, int]


def _reader(path: Path) -> SegmentReader | BagReader:
    from rmpa.record.bag import BAG, BagReader  # noqa: PLC0415 - its library is for bags alone

    return BagReader(path) if path.suffix == BAG else SegmentReader(path)


def _head(path: Path) -> _Head:
    reader = _reader(path)
    first, last, sources = reader.head()
    module = reader.merged.get("reference", reader.module.name)
    if not module:
        module = min((source.module for source in sources), default="") or path.parent.absolute().name
    return _Head(path, module, first, last, reader.readings, sources, reader.merged, reader.epoch)


class Timeline:
    """Recordings of any modules on one clock, each message with its module, and none twice.

    Args:
        paths: Files, or folders of segments.
        reference: The module whose clock the times are put on; empty: the first by name that knows most others.
        topics: The topics that are wanted, as globs, beside events; empty: all.

    Raises:
        RmpaError: There is no such module, or nothing can be read.
    """

    def __init__(self, paths: Sequence[Path], reference: str = "", topics: Sequence[str] = ()) -> None:
        self._topics = topics
        # Files that cannot be read, or not whole, each with the reason; the latter are known after ``messages``.
        self.damaged: dict[Path, str] = {}
        # Messages, and what was left out because another module has it from its source; of the last reading.
        self.count = self.doubles = 0
        self._heads = self._read_heads({each for path in paths for each in files_of(path)})
        if not self._heads:
            raise RmpaError(f"nothing can be read: {'; '.join(self.damaged.values())}", code="recording-damaged")
        modules = sorted({head.module for head in self._heads})
        self.reference = reference or _best_known(self._heads, modules)
        if self.reference not in modules:
            text = f"there is no recording by the clock of {reference}; there are {', '.join(modules)}"
            raise RmpaError(text, code="unknown-name")
        self._notes = list(dict.fromkeys(note for head in self._heads for note in _list_in(head, _NOTES)))
        self._set = self._steps()
        self._pairs = self._read_clocks()
        self._clocks = self._chain(modules)
        self._compare()
        self._spans = {
            h.path: (h.first - self._shift(h, h.first), h.last - self._shift(h, h.last)) for h in self._heads
        }
        self._heads.sort(key=lambda head: self._spans[head.path])
        self._covered = self._cover()
        self.begin = next((max(1, self._spans[head.path][0]) for head in self._heads if head.first), 1)

    def _read_heads(self, paths: set[Path]) -> list[_Head]:
        heads: list[_Head] = []
        for path in sorted(paths, key=lambda each: (each.name, str(each))):
            try:
                head = _head(path)
            except DamagedError as error:
                self.damaged[path] = str(error)
                continue
            if not any(one[1:4] == head[1:4] and filecmp.cmp(one.path, path, shallow=False) for one in heads):
                heads.append(head)
        return heads

    def _steps(self) -> dict[Path, int]:
        """Nanoseconds to take off the times of a file, so that the module's clock is as it was set last."""
        steps: dict[Path, int] = {}
        after: dict[tuple[str, str], tuple[int, int, int]] = {}
        for head in reversed(self._heads):
            boot, epoch = head.epoch
            later, taken, began = after.get((head.module, boot), (epoch, 0, head.first))
            slewed = _DRIFT * abs(began - later - head.first + epoch)
            if abs(epoch - later) >= limits.CLOCK_STEP * _SECOND + slewed:
                taken += epoch - later
                text = f"The clock of {head.module} was set {abs(later - epoch) / _SECOND:.3f} s"
                way = "forward" if later > epoch else "back"
                self._notes.append(f"{text} {way} while it recorded; its times before are as if it had been right.")
            steps[head.path] = taken
            after[head.module, boot] = epoch, taken, head.first
        return steps

    def _read_clocks(self) -> dict[tuple[str, str], list[ClockRecord]]:
        """What each module knew of another one's clock, by the clocks as they were set last.

        Backwards: the last reading is of a clock as it is; each one before fits best with the one after it.
        """
        pairs: dict[tuple[str, str], list[ClockRecord]] = {}
        for head in reversed(self._heads):
            for peer, one in reversed(head.readings):
                there, own = one.at + round(one.ahead * _SECOND), self._set[head.path]
                steps = [self._set[h.path] for h in self._heads if h.module == peer and _near(h, there)] or [0]
                known = pairs.setdefault((head.module, peer), [])
                last = known[-1].ahead if known else one.ahead + own / _SECOND
                found = ((one.ahead * _SECOND + own - step) / _SECOND for step in steps)
                known.append(ClockRecord(one.at - own, min(found, key=lambda each: abs(each - last)), one.error))
        return pairs

    def _chain(self, modules: list[str]) -> dict[str, _Clock]:
        """Each module's clock against the reference: by what one of both knew of the other, else by a third one."""
        clocks = {self.reference: _Clock([ClockRecord(0, 0.0, 0.0)])}
        found = [self.reference]
        for other in found:
            for name in modules:
                there = self._pairs.get((other, name), ())
                known = [ClockRecord(one.at + round(one.ahead * _SECOND), one.ahead, one.error) for one in there]
                here = self._pairs.get((name, other), ())
                known = known or [ClockRecord(one.at, -one.ahead, one.error) for one in here]
                if known and name not in clocks:
                    clocks[name] = _Clock(known, clocks[other])
                    found.append(name)
        return clocks | {name: _Clock(()) for name in modules if name not in clocks}

    def _compare(self) -> None:
        """Say where what was known of the clocks does not fit together; the bounds grow by it."""
        for (own, peer), known in sorted(self._pairs.items()):
            one, other = self._clocks.get(own), self._clocks.get(peer)
            if one is None or other is None or not one.known or not other.known:
                continue
            worst = most = 0.0
            for each in known:
                there = each.at + round(each.ahead * _SECOND)
                apart = abs(each.at - one.shift(each.at) - there + other.shift(there)) / _SECOND
                bounds = sum(bound or 0.0 for bound in (each.error, one.offset.error, other.offset.error))
                worst, most = max(worst, apart - bounds), max(most, apart)
            if worst > _ROUNDING:
                (other if peer != self.reference else one).widened = most
                text = f"What {own} knew of the clock of {peer} contradicts the others by {most:.3f} s"
                self._notes.append(f"{text}: that is the bound.")

    def _cover(self) -> dict[tuple[str, str, str], list[tuple[int, int, Path | None]]]:
        """When the sources of modules were recorded by their own: by module, node and type.

        What is left in a merged file was judged by what is in it: its path is with the time.
        """
        covered: dict[tuple[str, str, str], list[tuple[int, int, Path | None]]] = {}
        for head in self._heads:
            (begin, end), owner = self._spans[head.path], head.path if head.merged else None
            for source in head.sources:
                spans = covered.setdefault((source.module or head.module, source.node, source.type), [])
                if spans and spans[-1][2] == owner and begin - spans[-1][1] < _APART:
                    spans[-1] = spans[-1][0], max(spans[-1][1], end), owner
                else:
                    spans.append((begin, end, owner))
        return covered

    @property
    def offsets(self) -> dict[str, Offset]:
        """The clocks of all modules, by name."""
        found = {name: clock.offset for name, clock in self._clocks.items()}
        for head in self._heads:
            by = found[head.module]
            for name in head.merged.keys() - {"reference", _NOTES, _MISSING}:
                one = msgspec.json.decode(head.merged[name], type=Offset)
                error = None if by.error is None or one.error is None else by.error + one.error
                found.setdefault(name, Offset(by.ahead + one.ahead, error))
        return dict(sorted(found.items()))

    @property
    def missing(self) -> list[str]:
        """Modules that were linked, and of which nothing is here."""
        linked = {peer for _, peer in self._pairs}.union(*(_list_in(head, _MISSING) for head in self._heads))
        return sorted(linked - self.offsets.keys())

    @property
    def notes(self) -> list[str]:
        """What limits the order of the messages, and what is missing or could not be read."""
        offsets, notes = self.offsets, list[str]()
        errors = sorted(one.error for one in offsets.values() if one.error is not None)
        if len(offsets) > 1:
            notes.append(f"Times are by the clock of {self.reference}.")
            bound = f"{1e3 * sum(errors[-2:]):.2f} ms"
            notes.append(f"Of two modules, what is nearer than {bound} may have happened in the other order.")
        if unknown := [name for name, one in offsets.items() if one.error is None]:
            notes.append(
                f"The clock of {', '.join(unknown)} is not known against it: its times are as it wrote them."
            )
        if names := ", ".join(self.missing):
            notes.append(f"Nothing of {names} is here, which was linked: fetch its recording, if it can be reached.")
        return notes + self.own_notes

    @property
    def own_notes(self) -> list[str]:
        """Those of them that do not follow from the offsets."""
        return [*self._notes, *(f"Not whole: {text}." for text in self.damaged.values())]

    @property
    def sources(self) -> list[RecordedSource]:
        """All that messages may be of; those of a topic in the order in which they appear."""
        return list(dict.fromkeys(self._named(head, source) for head in self._heads for source in head.sources))

    def _named(self, head: _Head, source: RecordedSource) -> RecordedSource:
        return source if source.module or len(self._clocks) == 1 else source._replace(module=head.module)

    def messages(self, since: int = 0) -> Iterator[Recorded]:
        """The messages in order of their times.

        Args:
            since: Messages before may be left out, but for latched ones.
        """
        self.count = self.doubles = 0
        repeats: dict[RecordedSource, tuple[int, bytes]] = {}
        streams = [(self._spans[h.path][0], self._timed(h, since, repeats)) for h in self._heads]
        for self.count, message in enumerate(read_in_order(streams), 1):
            yield message

    def write(self, file: IO[bytes]) -> None:
        """Write it as one recording into a file that is open for writing."""
        writer = SegmentWriter(file, None)
        for (own, peer), known in sorted(self._pairs.items()):
            for one in known if own == self.reference else ():  # a later merge needs it
                writer.metadata(CLOCK, {peer: msgspec.json.encode(one).decode()})
        for message in self.messages():
            writer.write(*message)
        about: dict[str, object] = {**self.offsets, _NOTES: self.own_notes, _MISSING: self.missing}
        texts = {name: msgspec.json.encode(one).decode() for name, one in about.items()}
        writer.metadata(MERGE, {"reference": self.reference, **texts})
        writer.finish()

    def _shift(self, head: _Head, at: int) -> int:
        step = self._set[head.path]
        return step + self._clocks[head.module].shift(at - step)

    def _timed(self, head: _Head, since: int, repeats: dict[RecordedSource, tuple[int, bytes]]) -> Iterator[Recorded]:
        """The messages of a file by the reference's clock, with their module; without what a segment repeats."""
        reader, known = (
            _reader(head.path),
            dict[RecordedSource, tuple[RecordedSource, list[tuple[int, int]] | None]](),
        )
        for message in reader.messages(since and since + self._shift(head, since) - _SECOND):
            source, log_time, publish_time, data = message
            if (about := known.get(source)) is None:
                spans = self._recorded(source, head.path) if self._wants(source) else None
                about = known[source] = self._named(head, source), spans
            own, spans = about
            if spans is None:
                continue
            if source.latching or source.topic == STATIC:
                if message.repeated and repeats.get(own) == (publish_time, data):
                    self.doubles += 1
                    continue
                repeats[own] = publish_time, data
            shift = self._shift(head, log_time)
            if spans and any(begin <= log_time - shift <= end + _LATE for begin, end in spans):
                self.doubles += 1
                continue
            yield Recorded(own, max(1, log_time - shift), max(1, publish_time - shift), data)
        if reader.damage or reader.unfinished:
            what = f"{reader.damage} parts cannot be read" if reader.damage else "its end is missing"
            self.damaged[head.path] = f"{head.path}: {what}"

    def _wants(self, source: RecordedSource) -> bool:
        wanted = not self._topics or source.topic == EVENTS
        return wanted or matches_any(self._topics, source.topic)

    def _recorded(self, source: RecordedSource, path: Path) -> list[tuple[int, int]]:
        """When the recording of its own module has, too, what a proxy (``/rmpa/PEER/node``) said."""
        if not source.node.startswith(f"{OWN_NODE}/") or source.topic == EVENTS:
            return []
        peer, _, node = source.node[len(OWN_NODE) + 1 :].partition("/")
        spans = self._covered.get((peer, f"/{node}", source.type), ())
        return [(begin, end) for begin, end, owner in spans if owner != path]


def _near(head: _Head, at: int) -> bool:
    return head.first - _APART <= at <= head.last + _APART


def _list_in(head: _Head, key: str) -> list[str]:
    return msgspec.json.decode(head.merged.get(key, "[]"), type=list[str])


def _best_known(heads: list[_Head], modules: list[str]) -> str:
    """The module of which, or by which, most clocks are known."""

    def known(name: str) -> int:
        own = {peer for head in heads if head.module == name for peer, _ in head.readings}
        others = {head.module for head in heads if any(peer == name for peer, _ in head.readings)}
        return len((own | others) & set(modules))

    return max(modules, key=lambda name: (known(name), [-ord(letter) for letter in name]))
