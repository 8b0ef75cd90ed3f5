"""Counters of refused and dropped things, and a log of refusals that is limited in rate."""

from __future__ import annotations

from collections import Counter, OrderedDict
from typing import TYPE_CHECKING

from rmpa.core import limits

if TYPE_CHECKING:
    import logging


class Counters:
    """Named counters of one room, shown in snapshots (``beacon.malformed``, ``link.refused.version``)."""

    def __init__(self) -> None:
        self._counts: Counter[str] = Counter()

    def add(self, name: str, amount: int = 1) -> None:
        """Add to a count; a new name starts at 0."""
        self._counts[name] += amount

    def __getitem__(self, name: str) -> int:
        return self._counts[name]

    def as_dict(self) -> dict[str, int]:
        """All counts, by name in order."""
        return dict(sorted(self._counts.items()))


class _RefusalMemory:
    """When a refusal of each kind was logged last, and the lines of each name."""

    __slots__ = ("last", "lines")

    def __init__(self) -> None:
        self.last: OrderedDict[tuple[str, str], tuple[float, int]] = OrderedDict()
        # By name: the start of the interval, the lines written in it, and the lines suppressed in it.
        self.lines: dict[str, tuple[float, int, int]] = {}


class RefusalLog:
    """Counts each refusal, and logs each kind (name and address) at most once in ``limits.LOG_INTERVAL`` seconds.

    At most ``limits.LOG_LINES_MAX`` lines of one name are written in that time, over all addresses.

    Args:
        logger: Gets the lines, at WARNING.
        counters: Counts every refusal, logged or not.
    """

    __slots__ = ("_counters", "_logger", "_memory")

    def __init__(self, logger: logging.Logger, counters: Counters) -> None:
        self._logger = logger
        self._counters = counters
        self._memory: _RefusalMemory | None = None

    def count(self, name: str) -> None:
        """Count ``name`` without a line in the log."""
        self._counters.add(name)

    def refuse(self, now: float, name: str, who: str, text: str) -> None:
        """Count ``name``, and log ``text`` within the limits.

        Args:
            now: Monotonic seconds.
            name: The counter's name; with ``who`` it makes the kind.
            who: The source address of the refused item, without the port (a port scanner has many).
            text: What happened and what to do, for the user.
        """
        self._counters.add(name)
        if self._memory is None:  # most logs of an agent with thousands of proxies never have a line
            self._memory = _RefusalMemory()
        memory, kind = self._memory, (name, who)
        last, suppressed = memory.last.get(kind, (float("-inf"), 0))
        if now - last < limits.LOG_INTERVAL:
            memory.last[kind] = (last, suppressed + 1)
            return
        since, lines, hidden = memory.lines.get(name, (now, 0, 0))
        if now - since >= limits.LOG_INTERVAL:
            since, lines = now, 0
        if lines >= limits.LOG_LINES_MAX:
            memory.lines[name] = (since, lines, hidden + 1)
            return
        memory.lines[name] = (since, lines + 1, 0)
        suppressed += hidden
        memory.last[kind] = (now, 0)
        memory.last.move_to_end(kind)
        if len(memory.last) > limits.LOG_KINDS_MAX:
            memory.last.popitem(last=False)
        if suppressed:
            self._logger.warning("! %s (%d more like this since the last line)", text, suppressed)
        else:
            self._logger.warning("! %s", text)
