"""What happened in a recording, in plain words: alarms, lost links, missed deadlines, profiles, gaps, errors in logs.

A story is made of the recording alone: of its events, of what nodes said (/rosout, alarms, profiles), and of what is
missing in it. Each line names its evidence.
"""

from __future__ import annotations

import contextlib
import re
import time
from collections import Counter, deque
from pathlib import Path
from typing import TYPE_CHECKING, Final

import msgspec

from rmpa.core.errors import RmpaError
from rmpa.record.format import EVENTS, Recorded, read_event
from rmpa.ros.types.messages import MessageType

if TYPE_CHECKING:
    from collections.abc import Iterable

_SECOND: Final = 1_000_000_000
_LOG: Final = MessageType("rosgraph_msgs/Log")
_TEXT: Final = MessageType("std_msgs/String")
# Level of an error on /rosout (rosgraph_msgs/Log).
_ERROR: Final = 8
# A topic has a gap where a message comes after so many of the longer of its periods, and so many seconds.
_PERIODS: Final = 5
_LEAST: Final = 0.5
# The last periods, of which the usual one is the median and a longer one the ninth decile; the least number of them.
_USUAL, _KNOWN = 64, 8
# Of the errors that a node logs in so many seconds so many are told, the others counted.
_FLOOD, _FLOOD_LINES = 10, 4
# Seconds before and after a time that belong to it.
_AROUND: Final = 15
# Events that are no line of a story: what comes and goes in order.
_QUIET: Final = (
    "topic_came", "topic_gone", "service_came", "service_gone", "note_over", "alarm_over", "peer_linked", "kept",
)  # fmt: skip
_WARN, _BAD, _INFO = "warn", "error", "info"
_LEVELS: Final = {
    **dict.fromkeys(("alarm", "clock_step", "contract", "node_gone"), _WARN),
    **dict.fromkeys(("agent_lost", "node_died", "peer_lost", "stop"), _BAD),
}


class StoryLine(msgspec.Struct, frozen=True):
    """One thing that happened.

    Attributes:
        at: When, Unix nanoseconds.
        after: The same in seconds from the beginning of the recording.
        module: Where; empty: not known.
        level: ``info``, ``warn`` or ``error``.
        kind: ``alarm``, ``gap``, ``log`` …
        text: A sentence.
        evidence: Where it was read: a topic, with the file and line of a log.
    """

    at: int
    after: float
    module: str
    level: str
    kind: str
    text: str
    evidence: str


class Story(msgspec.Struct, frozen=True):
    """What happened in a recording.

    Attributes:
        title: The recording.
        begin: Its first message, Unix nanoseconds.
        end: Its last one.
        modules: The modules in it.
        messages: How many messages.
        lines: What happened, in order.
        notes: What limits the story: clocks that are not known, what was left out.
    """

    title: str
    begin: int
    end: int
    modules: tuple[str, ...]
    messages: int
    lines: tuple[StoryLine, ...]
    notes: tuple[str, ...] = ()

    @property
    def seconds(self) -> float:
        """Its length."""
        return (self.end - self.begin) / _SECOND

    def around(self, after: float) -> Story:
        """What happened in the half minute around a time, in seconds from the beginning."""
        lines = tuple(line for line in self.lines if abs(line.after - after) <= _AROUND)
        text = f"Only what happened within {_AROUND} s of {after:.1f} s: {len(lines)} of {len(self.lines)} lines."
        return msgspec.structs.replace(self, lines=lines, notes=(*self.notes, text))


class _Steady:
    """The times of one publisher of a topic."""

    def __init__(self, message: Recorded) -> None:
        self.last = message
        self._periods: deque[float] = deque(maxlen=_USUAL)

    def gap(self, until: int) -> tuple[float, float] | None:
        """The seconds to a time if it was silent, and what is usual; ``None``: it was not, as far as it is known."""
        period = (until - self.last.log_time) / _SECOND
        if period <= _LEAST or len(self._periods) < _KNOWN:
            return None
        periods = sorted(self._periods)
        late = periods[len(periods) * 9 // 10]
        return (period, periods[len(periods) // 2]) if period > _PERIODS * late else None

    def take(self, message: Recorded) -> None:
        self._periods.append((message.log_time - self.last.log_time) / _SECOND)
        self.last = message


class _Teller:
    """Reads a recording once."""

    def __init__(self) -> None:
        self._lines: list[StoryLine] = []
        self.begin = self.end = self.count = 0
        # When each module said something last.
        self.modules: dict[str, int] = {}
        # Messages that the recorders have left out, by topic.
        self.left_out: Counter[str] = Counter()
        self._steady: dict[tuple[str, str, str], _Steady] = {}
        self._profiles: dict[tuple[str, str], str] = {}
        self._logged: set[tuple[str, str, int]] = set()
        # By node since when its errors are counted, how many, and the place of the last line of it.
        self._floods: dict[str, tuple[int, int, int]] = {}

    def take(self, message: Recorded) -> None:
        """Take a message."""
        source = message.source
        self.begin = self.begin or message.log_time
        self.end = max(self.end, message.log_time)
        self.count += 1
        self.modules[source.module] = message.log_time
        if source.topic == EVENTS:
            self._event(message)
            return
        if message.repeated:
            return
        with contextlib.suppress(RmpaError):  # what cannot be read says nothing
            if source.type == _LOG.name:
                self._log(message)
                return
            if source.type == _TEXT.name and source.topic.endswith("/profile"):
                self._profile(message)
        steady = self._steady.setdefault((source.module, source.topic, source.node), _Steady(message))
        if steady.last is not message:
            self._gap(steady, message.log_time, "")
            steady.take(message)

    def finish(self) -> list[StoryLine]:
        """The lines in order."""
        for steady in self._steady.values():
            self._gap(steady, self.modules[steady.last.source.module], ", to the end")
        return sorted(self._lines, key=lambda line: (line.at, line.module, line.text))

    def _add(self, message: Recorded, level: str, kind: str, text: str, place: str = "") -> None:
        at, source = message.log_time, message.source
        text = "".join(letter if letter.isprintable() else " " for letter in text)
        after = round((at - self.begin) / _SECOND, 3)
        self._lines.append(StoryLine(at, after, source.module, level, kind, text, source.topic + place))

    def _event(self, message: Recorded) -> None:
        event = read_event(message.data)
        if event is not None and event.kind == "left_out":
            self.left_out.update({topic: int(count or 0) for topic, count in event.facts.items()})
        elif event is not None and event.kind not in _QUIET:
            self._add(message, _LEVELS.get(event.kind, _INFO), event.kind, event.text)

    def _gap(self, steady: _Steady, until: int, end: str) -> None:
        if (found := steady.gap(until)) is not None:
            source, (period, usual) = steady.last.source, found
            text = f"{source.topic} of {source.node} was silent for {period:.2f} s{end}; usual are {usual:.3g} s"
            self._add(steady.last, _WARN, "gap", text)

    def _log(self, message: Recorded) -> None:
        line = _LOG.deserialize(message.data)
        node, text, stamp = str(line.name), str(line.msg), line.header.stamp
        key = node, text, stamp.sec * _SECOND + stamp.nanosec
        if int(line.level) < _ERROR or key in self._logged:  # /rosout_agg has it again
            return
        self._logged.add(key)
        begin, count, place = self._floods.get(node, (0, 0, 0))
        if message.log_time - begin > _FLOOD * _SECOND:
            begin, count = message.log_time, 0
        if count < _FLOOD_LINES:
            level = "fatal" if int(line.level) > _ERROR else "error"
            place, where = len(self._lines), f" {line.file}:{line.line}" if line.file else ""
            self._add(message, _BAD, "log", f"{node} logs {level}: {text}", where)
        else:
            last, more = self._lines[place], count - _FLOOD_LINES + 1
            text = f"{last.text.removesuffix(_more(more - 1))}{_more(more)}"
            self._lines[place] = msgspec.structs.replace(last, text=text)
        self._floods[node] = begin, count + 1, place

    def _profile(self, message: Recorded) -> None:
        profile = str(_TEXT.deserialize(message.data).data)
        key = message.source.module, message.source.topic.removesuffix("/profile")
        before, self._profiles[key] = self._profiles.get(key), profile
        if before is not None and profile != before:
            text = f"{key[1]} runs {profile or 'no profile'} in place of {before or 'none'}"
            self._add(message, _INFO, "profile", text)


def _more(count: int) -> str:
    return f" (and {count} more within {_FLOOD} s)" if count else ""


def tell(messages: Iterable[Recorded], title: str, notes: Iterable[str] = ()) -> Story:
    """Make the story of a recording.

    Args:
        messages: In order of their log times.
        title: What it is called.
        notes: What limits it, from its merge.
    """
    teller = _Teller()
    for message in messages:
        teller.take(message)
    modules = tuple(sorted(filter(None, teller.modules)))
    if teller.left_out:
        counts = ", ".join(f"{count:,} messages of {topic}" for topic, count in sorted(teller.left_out.items()))
        notes = [*notes, f"Left out, for the budgets of [record] or the disk: {counts}."]
    return Story(title, teller.begin, teller.end, modules, teller.count, tuple(teller.finish()), tuple(notes))


def clock_text(at: int) -> str:
    """A time of a story as people read it: UTC, with milliseconds."""
    seconds, rest = divmod(at, _SECOND)
    return f"{time.strftime('%H:%M:%S', time.gmtime(seconds))}.{rest // 1_000_000:03}"


def render(story: Story, kind: str) -> str:
    """The story as ``md`` or ``html``, the latter with a timeline."""
    from jinja2 import Environment, FileSystemLoader, select_autoescape  # noqa: PLC0415 - only here

    escape = select_autoescape(enabled_extensions=("html.j2",))
    loader = FileSystemLoader(Path(__file__).parent)
    environment = Environment(loader=loader, autoescape=escape, trim_blocks=True, lstrip_blocks=True)  # noqa: S701 - by the extension
    environment.filters["cell"] = _cell
    template = environment.get_template(f"story.{kind}.j2")
    return template.render(
        story=story, clock=clock_text, seconds=max(story.seconds, 1e-9),
        day=time.strftime("%Y-%m-%d", time.gmtime(story.begin / _SECOND)),
    )  # fmt: skip


def _cell(text: str) -> str:
    """Text in Markdown: one line, in which nothing is markup."""
    return re.sub(r"([\\`*_\[\]<>|#~])", r"\\\1", text).replace("\\<", "&lt;")
