"""The last log lines of one module: of its nodes, by /rosout, and of its agent.

Free of I/O. A line is kept as bytes: in the quiet hours of a robot nothing of it is decoded.
"""

from __future__ import annotations

import logging
import re
from collections import deque
from struct import Struct
from typing import TYPE_CHECKING, Annotated, Final

import msgspec
from msgspec import Meta

from rmpa.bridge import limits
from rmpa.config import limits as config_limits
from rmpa.core.errors import ConfigError, RemoteProtocolError
from rmpa.core.facts import ModuleAnswer
from rmpa.core.identity import OWN_NODE, is_global_name, is_own, matches
from rmpa.ros.wire.log import parse_log

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from rmpa.core.timers import Yielder
    from rmpa.ros.wire.tcpros import Buffer

# By the numbers of rosgraph_msgs/Log.
LEVELS: Final = {1: "debug", 2: "info", 4: "warn", 8: "error", 16: "fatal"}
_NUMBERS: Final = {word: number for number, word in LEVELS.items()}
# Of Python's loggers, by the least level.
_OF_PYTHON: Final = {logging.CRITICAL: 16, logging.ERROR: 8, logging.WARNING: 4, logging.INFO: 2}
# Of a kept line: its number, its time in ns since 1970, its level; its text follows. Lines compare by their numbers.
_LINE: Final = Struct(">QqB")
# Colours, as programs write them for a terminal (ECMA-48, SGR).
_COLOURS: Final = re.compile(r"\x1b\[[0-9;]*m")
_SECOND: Final = 1_000_000_000


class LogLine(msgspec.Struct, frozen=True, omit_defaults=True):
    """One line.

    Attributes:
        n: Its number in its module, rising, also over restarts of the agent.
        at: When it was written, seconds since 1970; where the node's stamp is far off, when it came.
        level: A word of ``LEVELS``.
        node: The node that wrote it; the agent's own node for the agent.
        text: It, without colours of a terminal; a long one is cut, and says so.
        agent: Whether the agent wrote it.
    """

    n: Annotated[int, Meta(ge=0, lt=2**53)]
    at: Annotated[float, Meta(ge=0, lt=2**34)]
    level: str
    node: Annotated[str, Meta(max_length=config_limits.CROSSING_NAME_MAX)]
    text: Annotated[str, Meta(max_length=2 * limits.LOG_TEXT_MAX)]
    agent: bool = False


class ModuleLog(ModuleAnswer, frozen=True, kw_only=True, omit_defaults=True):
    """Log lines of one module, as it tells them, or as the module sees them that asks.

    Attributes:
        lines: The newest that were asked for, the oldest first; ``at`` is by the clock of the module that has them.
        next: What the next question has as ``after``, to get what comes behind these; 0 where there is a problem.
        lost: Nodes of which lines since ``after`` are missing: they wrote more than is kept, or than one answer has.
        error: The bound of the error of these times, seconds; ``None``: the two clocks are not compared yet.
    """

    lines: Annotated[tuple[LogLine, ...], Meta(max_length=limits.LOG_LINES_ASKED)] = ()
    next: Annotated[int, Meta(ge=0, lt=2**53)] = 0
    lost: Annotated[tuple[str, ...], Meta(max_length=limits.LOG_LINES_ASKED)] = ()
    error: float | None = None


class LogQuery(msgspec.Struct, frozen=True, omit_defaults=True):
    """Which lines are asked for.

    Attributes:
        after: Only lines with higher numbers; 0: any.
        level: The least level.
        node: A glob over nodes; empty: all. The agent is the node ``/rmpa``.
        since: Only lines of the last so many seconds; 0: any.
        most: At most so many; the newest stay.
    """

    after: Annotated[int, Meta(ge=0, lt=2**53)] = 0
    level: str = "debug"
    node: Annotated[str, Meta(max_length=config_limits.CROSSING_NAME_MAX)] = ""
    since: Annotated[float, Meta(ge=0)] = 0.0
    most: Annotated[int, Meta(ge=1, le=limits.LOG_LINES_ASKED)] = limits.LOG_LINES_ASKED

    @classmethod
    def of(cls, args: Mapping[str, object]) -> LogQuery:
        """The query of a question's arguments.

        Raises:
            ConfigError: One of them is none.
        """
        try:
            query = msgspec.convert(args, cls)
        except msgspec.ValidationError as error:
            raise ConfigError("the question for log lines", str(error)) from None
        if query.level not in _NUMBERS:
            raise ConfigError("level", f"{query.level[:40]!r} is not a level", f"use one of {', '.join(_NUMBERS)}")
        return query


class _NodeLines:
    """The kept lines of one node, their size, and the number of the last one that was dropped."""

    __slots__ = ("dropped", "lines", "size")

    def __init__(self) -> None:
        self.lines: deque[bytes] = deque()
        self.size = self.dropped = 0


class LogRing:
    """Keeps the last lines.

    Where there are more than fit, the node whose lines are largest together loses its oldest: one that writes ten
    thousand a second removes no line of the others.

    Args:
        now_ns: The wall clock. Numbers begin with its microseconds, so that those of the next run are higher.
    """

    def __init__(self, now_ns: int) -> None:
        self._number = now_ns // 1000
        self._nodes: dict[str, _NodeLines] = {}
        self._size = 0

    def take(self, publisher: str, framed: Buffer, now_ns: int) -> None:
        """Keep a message of /rosout, of a publisher; what is no rosgraph_msgs/Log is left out."""
        try:
            node, level, stamp_ns, text = parse_log(framed, limits.LOG_TEXT_MAX)
        except RemoteProtocolError:
            return
        if not is_global_name(node) or is_own(node):  # none that the agent's own lines or a proxy have
            node = publisher
        near = abs(now_ns - stamp_ns) <= limits.LOG_STAMP_OFF * _SECOND
        self.add(node, level, stamp_ns if near else now_ns, text)

    def take_own(self, level: int, at_ns: int, text: str) -> None:
        """Keep a line of the agent; ``level`` is that of Python's ``logging``."""
        number = next((number for least, number in _OF_PYTHON.items() if level >= least), 1)
        self.add(OWN_NODE, number, at_ns, text.encode("utf-8", "replace")[: limits.LOG_TEXT_MAX])

    def add(self, node: str, level: int, at_ns: int, text: bytes) -> None:
        """Keep a line."""
        self._number += 1
        kept = self._nodes.get(node)
        if kept is None:
            kept = self._nodes[node] = _NodeLines()
        kept.lines.append(_LINE.pack(self._number, at_ns, level) + text)
        size = len(text) + limits.LOG_LINE_BYTES
        kept.size += size
        self._size += size
        while self._size > limits.LOG_BYTES_KEPT:
            self._drop()

    def _drop(self) -> None:
        """Drop the oldest lines of the node that has most: many at once, so that it is seldom looked for."""
        node, kept = max(self._nodes.items(), key=lambda item: item[1].size)
        for _ in range(min(len(kept.lines) // 2 + 1, limits.LOG_DROPPED_AT_ONCE)):
            line = kept.lines.popleft()
            size = len(line) - _LINE.size + limits.LOG_LINE_BYTES
            self._size -= size
            kept.size -= size
            kept.dropped = _LINE.unpack_from(line)[0]
        if not kept.lines:
            del self._nodes[node]

    def find(
        self, query: LogQuery, now_ns: int, may: Callable[[str], bool] = lambda _: True, yielder: Yielder = iter
    ) -> ModuleLog:
        """The newest lines that a query asks for.

        Args:
            query: It.
            now_ns: The wall clock.
            may: Whether the lines of a node may be told.
            yielder: Lets data pass.
        """
        after = query.after if query.after <= self._number else 0  # of a run whose clock was ahead
        since = now_ns - round(query.since * 1e9) if query.since else 0
        least = _NUMBERS[query.level]
        found: list[tuple[bytes, str]] = []
        lost = set[str]()
        for node in yielder(self.nodes):
            if (query.node and not matches(query.node, node)) or not may(node):
                continue
            kept = self._nodes[node]
            if after and kept.dropped > after:
                lost.add(node)
            for line in reversed(kept.lines):
                number, at_ns, level = _LINE.unpack_from(line)
                if number <= after:
                    break
                if level >= least and at_ns >= since:
                    found.append((line, node))
        found.sort(reverse=True)
        told = list(yielder(_within(found[: query.most])))
        if after:
            lost.update(node for _, node in found[len(told) :])
        lines = tuple(_told(line, node) for line, node in reversed(told))
        return ModuleLog(lines=lines, next=self._number, lost=tuple(sorted(lost)[: limits.LOG_LINES_ASKED]))

    @property
    def nodes(self) -> tuple[str, ...]:
        """The nodes of which lines are kept."""
        return tuple(self._nodes)


def _within(found: list[tuple[bytes, str]]) -> list[tuple[bytes, str]]:
    """As many of the first ones as an answer may have bytes."""
    left = limits.LOG_ANSWER_BYTES
    for at, (line, _) in enumerate(found):
        left -= len(line)
        if left < 0:
            return found[:at]
    return found


def _told(line: bytes, node: str) -> LogLine:
    number, at_ns, level = _LINE.unpack_from(line)
    word = next((word for least, word in reversed(LEVELS.items()) if level >= least), "debug")
    text = _COLOURS.sub("", str(line[_LINE.size :], "utf-8", "replace"))
    return LogLine(number, max(0.0, at_ns / 1e9), word, node, text, agent=node == OWN_NODE)
