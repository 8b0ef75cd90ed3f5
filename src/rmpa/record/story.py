"""What happened in a recording, in plain words: alarms, lost links, missed deadlines, profiles, gaps, errors in logs.

A story is made of the recording alone: of its events, of what nodes said (/rosout, alarms, profiles), and of what is
missing in it. Each line names its evidence.
"""

from __future__ import annotations

import statistics
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
# A topic has a gap where a message comes so many usual periods late, and so many seconds.
_PERIODS: Final = 5
_LEAST: Final = 0.5
# The periods of which the usual one is the median.
_USUAL: Final = 64
# Events that are no line of a story: what comes and goes in order.
_QUIET: Final = (
    "topic_came", "topic_gone", "service_came", "service_gone", "note_over", "alarm_over", "peer_linked", "kept",
)  # fmt: skip
_WARN, _BAD, _INFO = "warn", "error", "info"
_LEVELS: Final = {
    "alarm": _WARN,
    "peer_lost": _BAD,
    "node_died": _BAD,
    "clock_step": _WARN,
    "node_gone": _WARN,
    "contract": _WARN,
    "stop": _BAD,
    "agent_lost": _BAD,
}


class StoryLine(msgspec.Struct, frozen=True):
    """One thing that happened.

    Attributes:
        at: When, Unix nanoseconds.
        module: Where; empty: not known.
        level: ``info``, ``warn`` or ``error``.
        kind: ``alarm``, ``gap``, ``log`` …
        text: A sentence.
        evidence: The topic that it was read from.
    """

    at: int
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


class _Teller:
    """Reads a recording once."""

    def __init__(self) -> None:
        self.lines: list[StoryLine] = []
        self.begin = self.end = self.count = 0
        self.modules: dict[str, None] = {}
        # Messages that the recorders have left out, by topic.
        self.left_out: Counter[str] = Counter()
        self._last: dict[tuple[str, str, str], int] = {}
        self._periods: dict[tuple[str, str, str], deque[float]] = {}
        self._profiles: dict[str, str] = {}
        self._logged: dict[tuple[str, str], int] = {}

    def take(self, message: Recorded) -> None:
        """Take a message."""
        source = message.source
        self.begin = self.begin or message.log_time
        self.end = max(self.end, message.log_time)
        self.count += 1
        self.modules[source.module] = None
        if source.topic == EVENTS:
            self._event(message)
            return
        if message.publish_time != message.log_time:
            return  # repeated
        self._gap(message)
        if source.type == _LOG.name:
            self._log(message)
        elif source.type == _TEXT.name and source.topic.endswith("/profile"):
            self._profile(message)

    def _add(self, message: Recorded, level: str, kind: str, text: str) -> None:
        self.lines.append(StoryLine(message.log_time, message.source.module, level, kind, text, message.source.topic))

    def _event(self, message: Recorded) -> None:
        event = read_event(message.data)
        if event is not None and event.kind == "left_out":
            self.left_out.update({topic: int(count or 0) for topic, count in event.facts.items()})
        elif event is not None and event.kind not in _QUIET:
            self._add(message, _LEVELS.get(event.kind, _INFO), event.kind, event.text)

    def _gap(self, message: Recorded) -> None:
        source = message.source
        key = source.module, source.topic, source.node
        before, self._last[key] = self._last.get(key), message.log_time
        if before is None:
            return
        period = (message.log_time - before) / _SECOND
        periods = self._periods.setdefault(key, deque(maxlen=_USUAL))
        usual = statistics.median(periods) if len(periods) >= 8 else None
        if usual is not None and period > max(_PERIODS * usual, _LEAST):
            text = f"{source.topic} of {source.node} was silent for {period:.2f} s; usual are {usual:.3g} s"
            self.lines.append(StoryLine(before, source.module, _WARN, "gap", text, source.topic))
        periods.append(period)

    def _log(self, message: Recorded) -> None:
        try:
            line = _LOG.deserialize(message.data)
        except RmpaError:
            return
        key = str(line.name), str(line.msg)
        if int(line.level) >= _ERROR and message.log_time - self._logged.get(key, 0) > 10 * _SECOND:
            self._logged[key] = message.log_time
            self._add(message, _BAD, "log", f"{line.name} says: {line.msg}")

    def _profile(self, message: Recorded) -> None:
        try:
            profile = str(_TEXT.deserialize(message.data).data)
        except RmpaError:
            return
        resource = message.source.topic.removesuffix("/profile")
        before, self._profiles[resource] = self._profiles.get(resource), profile
        if before is not None and profile != before:
            self._add(message, _INFO, "profile", f"{resource} runs {profile or 'no profile'} in place of {before}")


def tell(messages: Iterable[Recorded], title: str, notes: Iterable[str] = (), around: float | None = None) -> Story:
    """Make the story of a recording.

    Args:
        messages: In order of their log times.
        title: What it is called.
        notes: What limits it, from its merge.
        around: Seconds of the recording, from its beginning; then what happened in the half minute around it alone.
    """
    teller = _Teller()
    for message in messages:
        teller.take(message)
    lines = sorted(teller.lines, key=lambda line: (line.at, line.module, line.text))
    if around is not None:
        at = teller.begin + round(around * _SECOND)
        lines = [line for line in lines if abs(line.at - at) <= 15 * _SECOND]
    modules = tuple(sorted(filter(None, teller.modules)))
    if teller.left_out:
        counts = ", ".join(f"{count:,} messages of {topic}" for topic, count in sorted(teller.left_out.items()))
        notes = [*notes, f"Left out, for the budgets of [record]: {counts}."]
    return Story(title, teller.begin, teller.end, modules, teller.count, tuple(lines), tuple(notes))


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
    span = max(story.end - story.begin, 1)
    rows = {module: index for index, module in enumerate(story.modules or ("",))}
    marks = [(100 * (line.at - story.begin) / span, rows.get(line.module, 0), line) for line in story.lines]
    template = environment.get_template(f"story.{kind}.j2")
    return template.render(
        story=story, rows=rows, marks=marks, seconds=span / _SECOND, clock=clock_text,
        day=time.strftime("%Y-%m-%d", time.gmtime(story.begin / _SECOND)),
    )  # fmt: skip
