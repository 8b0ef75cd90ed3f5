"""What differs between two recordings, topic by topic: how much came, how evenly, how old, and what it said."""

from __future__ import annotations

import struct
from array import array
from collections import Counter
from functools import lru_cache
from typing import TYPE_CHECKING, Any, Final

import msgspec

from rmpa.core.errors import RmpaError
from rmpa.record.format import EVENTS, Recorded, RecordedSource
from rmpa.ros.types.codec import codec_for
from rmpa.ros.types.find import type_of_header

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable

    from rmpa.record.merge import Timeline

    Key = Callable[[RecordedSource], str]

_SECOND: Final = 1_000_000_000
_HEADER: Final = struct.Struct("<III")
# Where a message is looked for in the other recording: so many places further on.
_FURTHER: Final = 100


class TopicRun(msgspec.Struct, frozen=True):
    """One topic in one recording.

    Attributes:
        count: Messages.
        rate: Mean rate from the first to the last, Hz; ``None``: there are fewer than two.
        gap: The longest time between two messages, seconds.
        age: Median age of messages with a stamp when they were recorded, seconds.
        age_p99: The age that 99 % of them have at most.
    """

    count: int = 0
    rate: float | None = None
    gap: float | None = None
    age: float | None = None
    age_p99: float | None = None


class TopicDifference(msgspec.Struct, frozen=True):
    """One topic in both recordings.

    Attributes:
        topic: Its name; ``TOPIC of NODE`` where several nodes publish it in both.
        first: In the first recording.
        second: In the second one.
        difference: The first message that differs: ``message 12 at 0.60 s: ranges[3] is 1.2, then 1.4``; empty: none.
    """

    topic: str
    first: TopicRun
    second: TopicRun
    difference: str = ""


class _Seen:
    """A topic while a recording is read; of each message its time, age, and a number for its content."""

    def __init__(self) -> None:
        self.begin = self.last = self.gap = 0
        self.ages = array("d")
        self.contents = array("q")

    def take(self, message: Recorded) -> None:
        self.begin = self.begin or message.log_time
        if self.contents:
            self.gap = max(self.gap, message.log_time - self.last)
        self.last = message.log_time
        self.contents.append(hash(_content(message)))
        if _headers(message.source.definition)[0] and len(message.data) >= _HEADER.size:
            _, seconds, nanoseconds = _HEADER.unpack_from(message.data)
            if seconds:
                self.ages.append(message.log_time / _SECOND - seconds - nanoseconds / _SECOND)

    @property
    def run(self) -> TopicRun:
        count, ages = len(self.contents), sorted(self.ages)
        if count < 2:
            return TopicRun(count)
        rate = (count - 1) * _SECOND / (self.last - self.begin) if self.last > self.begin else None
        old = (ages[len(ages) // 2], ages[len(ages) * 99 // 100]) if ages else (None, None)
        return TopicRun(count, rate, self.gap / _SECOND, *old)


def compare(first: Timeline, second: Timeline) -> list[TopicDifference]:
    """Compare two recordings.

    Returns:
        Each topic of either, by name.
    """
    key = _key(first.sources, second.sources)
    runs: list[dict[str, _Seen]] = [{}, {}]
    for seen, recording in zip(runs, (first, second), strict=True):
        for message in recording.messages():
            if message.source.topic != EVENTS:
                seen.setdefault(key(message.source), _Seen()).take(message)
    pairs = {
        topic: [seen.get(topic) or _Seen() for seen in runs] for topic in sorted(runs[0].keys() | runs[1].keys())
    }
    places = {topic: _place(one.contents, other.contents) for topic, (one, other) in pairs.items()}
    wanted = {topic: place for topic, place in places.items() if isinstance(place, int)}
    texts = {topic: place for topic, place in places.items() if isinstance(place, str)}
    messages = [_messages_at(recording, key, wanted) for recording in (first, second)]
    for topic, place in wanted.items():
        one, other = (found[topic] for found in messages)
        texts[topic] = f"message {place + 1} at {(one.log_time - first.begin) / _SECOND:.2f} s: {_field(one, other)}"
    return [TopicDifference(topic, one.run, other.run, texts[topic]) for topic, (one, other) in pairs.items()]


def _key(first: Iterable[RecordedSource], second: Iterable[RecordedSource]) -> Key:
    """What messages are compared by: their topic, and their node where several publish it, the same in both."""
    nodes: list[dict[str, set[str]]] = [{}, {}]
    for found, sources in zip(nodes, (first, second), strict=True):
        for source in sources:
            found.setdefault(source.topic, set()).add(source.module + source.node)
    apart = {topic for topic, names in nodes[0].items() if len(names) > 1 and names == nodes[1].get(topic)}

    def key(source: RecordedSource) -> str:
        return f"{source.topic} of {source.module}{source.node}" if source.topic in apart else source.topic

    return key


def _place(one: array[int], other: array[int]) -> int | str:
    """The place of the first message whose content differs, or what differs besides; empty: nothing."""
    if not one or not other:
        return f"only in the {'first' if one else 'second'}"
    place = next((n for n, (a, b) in enumerate(zip(one, other, strict=False)) if a != b), None)
    if place is None:
        more = len(one) - len(other)
        return f"{abs(more)} more at the end of the {'first' if more > 0 else 'second'}" if more else ""
    missing, extra = other[place] in one[place : place + _FURTHER], one[place] in other[place : place + _FURTHER]
    if missing != extra:
        return f"message {place + 1} is only in the {'first' if missing else 'second'}"
    return place


def _messages_at(recording: Timeline, key: Key, wanted: dict[str, int]) -> dict[str, Recorded]:
    found: dict[str, Recorded] = {}
    counts: Counter[str] = Counter()
    for message in recording.messages() if wanted else ():
        name = key(message.source)
        if wanted.get(name) == counts[name]:
            found[name] = message
            if len(found) == len(wanted):
                break
        counts[name] += 1
    return found


@lru_cache(maxsize=1000)
def _headers(definition: str) -> tuple[bool, bool]:
    """Whether a type begins with a header, and whether it has one elsewhere."""
    lines = [line.partition("#")[0].split() for line in definition.splitlines()]
    kinds = [words[0] for words in lines if len(words) > 1 and "=" not in words[1]]
    headers = [kind.partition("[")[0] in ("Header", "std_msgs/Header") for kind in kinds]
    return headers[:1] == [True], any(headers[1:])


def _content(message: Recorded) -> bytes | str:
    """What it says but for numbers and stamps of headers, which differ in any two runs."""
    first, elsewhere = _headers(message.source.definition)
    if elsewhere:
        try:
            return repr(_without_stamps(_values(message)))
        except RmpaError:
            return message.data
    return message.data[_HEADER.size :] if first else message.data


def _values(message: Recorded) -> Any:
    source = message.source
    fields = {"type": source.type, "md5sum": source.md5sum, "message_definition": source.definition}
    return codec_for(type_of_header(fields)).plain_values(memoryview(message.data))


def _without_stamps(value: Any) -> Any:
    if isinstance(value, dict):
        header = value.keys() == {"seq", "stamp", "frame_id"}
        return {k: _without_stamps(v) for k, v in value.items() if not header or k == "frame_id"}
    return [_without_stamps(each) for each in value] if isinstance(value, list) else value


def _field(one: Recorded, other: Recorded) -> str:
    if one.source.md5sum != other.source.md5sum:
        return f"the type is {one.source.type}, then {other.source.type}"
    try:
        values = [_without_stamps(_values(message)) for message in (one, other)]
    except RmpaError:
        return "its bytes differ"
    return _differing("", *values) or "its bytes differ"


def _differing(path: str, a: Any, b: Any) -> str:
    """The first field whose values differ."""
    if isinstance(a, dict) and isinstance(b, dict):
        parts = ((f"{path}.{key}" if path else key, value, b.get(key)) for key, value in a.items())
        return next(filter(None, (_differing(*part) for part in parts)), "")
    if isinstance(a, list) and isinstance(b, list):
        if len(a) != len(b):
            return f"{path} has {len(a)} elements, then {len(b)}"
        elements = ((f"{path}[{index}]", *pair) for index, pair in enumerate(zip(a, b, strict=True)))
        return next(filter(None, (_differing(*each) for each in elements)), "")
    return f"{path} is {str(a)[:60]}, then {str(b)[:60]}" if a != b else ""
