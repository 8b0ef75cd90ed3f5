"""What differs between two recordings, topic by topic: how much came, how evenly, how old, and what it said."""

from __future__ import annotations

import statistics
import struct
from typing import TYPE_CHECKING, Any, Final

import msgspec

from rmpa.core.errors import RmpaError
from rmpa.record.format import EVENTS, Recorded
from rmpa.ros.types.codec import codec_for
from rmpa.ros.types.find import type_of_header

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

_SECOND: Final = 1_000_000_000
_HEADER: Final = struct.Struct("<III")
# Messages of a topic that are compared with each other, and bytes of each.
_COMPARED: Final = 10_000
_BYTES: Final = 64 * 1024


class TopicRun(msgspec.Struct, frozen=True):
    """One topic in one recording.

    Attributes:
        count: Messages.
        rate: Mean rate from the first to the last, Hz; ``None``: there are fewer than two.
        gap: The longest time between two messages, seconds.
        age: Median age of messages with a stamp when they were recorded, seconds.
    """

    count: int = 0
    rate: float | None = None
    gap: float | None = None
    age: float | None = None


class TopicDifference(msgspec.Struct, frozen=True):
    """One topic in both recordings.

    Attributes:
        topic: Its name.
        first: In the first recording.
        second: In the second one.
        difference: The first message that differs: ``message 12 at 0.60 s: ranges[3] is 1.2, then 1.4``; empty: none.
    """

    topic: str
    first: TopicRun
    second: TopicRun
    difference: str = ""

    @property
    def same(self) -> bool:
        """Whether both said the same, in the same number of messages."""
        return not self.difference and self.first.count == self.second.count


class _Seen:
    """A topic while a recording is read."""

    def __init__(self) -> None:
        self.times: list[int] = []
        self.ages: list[float] = []
        self.messages: list[Recorded] = []

    def take(self, message: Recorded) -> None:
        self.times.append(message.log_time)
        if len(self.messages) < _COMPARED:
            self.messages.append(message._replace(data=message.data[:_BYTES]))
        if "Header header" in message.source.definition.partition("\n====")[0] and len(message.data) >= _HEADER.size:
            _, seconds, nanoseconds = _HEADER.unpack_from(message.data)
            if seconds:
                self.ages.append(message.log_time / _SECOND - seconds - nanoseconds / _SECOND)

    @property
    def run(self) -> TopicRun:
        gaps = [(b - a) / _SECOND for a, b in zip(self.times, self.times[1:], strict=False)]
        total = sum(gaps)
        return TopicRun(
            len(self.times),
            len(gaps) / total if total > 0 else None,
            max(gaps, default=None),
            statistics.median(self.ages) if self.ages else None,
        )


def compare(first: Iterable[Recorded], second: Iterable[Recorded]) -> list[TopicDifference]:
    """Compare two recordings.

    Args:
        first: The messages of one, in order.
        second: The messages of the other one.

    Returns:
        Each topic of either, by name.
    """
    runs: list[dict[str, _Seen]] = [{}, {}]
    for seen, messages in zip(runs, (first, second), strict=True):
        for message in messages:
            if message.source.topic != EVENTS:
                seen.setdefault(message.source.topic, _Seen()).take(message)
    found = []
    for topic in sorted(runs[0].keys() | runs[1].keys()):
        one, other = runs[0].get(topic, _Seen()), runs[1].get(topic, _Seen())
        found.append(TopicDifference(topic, one.run, other.run, _first_difference(one, other)))
    return found


def _first_difference(one: _Seen, other: _Seen) -> str:
    for number, (a, b) in enumerate(zip(one.messages, other.messages, strict=False), 1):
        if a.source.md5sum != b.source.md5sum:
            return f"the type was {a.source.type}, then {b.source.type}"
        if _payload(a) != _payload(b):
            at = (a.log_time - one.times[0]) / _SECOND
            return f"message {number} at {at:.2f} s: {_field(a, b)}"
    return ""


def _payload(message: Recorded) -> bytes:
    """The bytes without number and stamp of the header, which differ in any two runs."""
    stamped = "Header header" in message.source.definition.partition("\n====")[0]
    return message.data[_HEADER.size :] if stamped else message.data


def _field(a: Recorded, b: Recorded) -> str:
    try:
        values = [_plain(message) for message in (a, b)]
    except RmpaError:
        return "its bytes differ"
    return _differing("", *values) or "its bytes differ"


def _plain(message: Recorded) -> Mapping[str, Any]:
    source = message.source
    fields = {"type": source.type, "md5sum": source.md5sum, "message_definition": source.definition}
    return codec_for(type_of_header(fields)).plain_values(memoryview(message.data))


def _differing(path: str, a: Any, b: Any) -> str:
    """The first field whose values differ."""
    if isinstance(a, dict) and isinstance(b, dict):
        for key in a:
            if path == "header" and key in ("seq", "stamp"):
                continue
            if text := _differing(f"{path}.{key}" if path else key, a[key], b.get(key)):
                return text
        return ""
    if isinstance(a, list) and isinstance(b, list):
        if len(a) != len(b):
            return f"{path} has {len(a)} elements, then {len(b)}"
        for index, (one, other) in enumerate(zip(a, b, strict=True)):
            if text := _differing(f"{path}[{index}]", one, other):
                return text
        return ""
    return f"{path} is {str(a)[:60]}, then {str(b)[:60]}" if a != b else ""
