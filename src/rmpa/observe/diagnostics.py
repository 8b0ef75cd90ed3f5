"""What ``/diagnostics`` (REP 107) says of all modules: the newest status of each component, and how it came to it.

``StatusTable`` is a machine without I/O: decoded messages and ``now`` go in. A status of which no news came for
``limits.DIAGNOSTIC_STALE`` is stale, whatever it said last. A publisher may be hostile: its messages, statuses,
values and texts are bounded, and what it sends too much costs none of the others.
"""

from __future__ import annotations

import math
import re
from collections import Counter, deque
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Final, NamedTuple

from rmpa.core.identity import is_own, proxied_node
from rmpa.core.limits import MIB
from rmpa.core.timers import TokenBucket
from rmpa.observe import limits
from rmpa.ros.types.definitions import DiagnosticLevel

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Mapping

OK, WARN, ERROR, STALE = (level.name for level in DiagnosticLevel)
# From the best to the worst; a part of a robot that is stale may hide an error, but one that is seen goes first.
LEVELS: Final = (OK, WARN, STALE, ERROR)
# A number, perhaps with a unit behind it; not an address, a version or a time.
_NUMBER: Final = re.compile(r"\s*([-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?)\s*(?:[^\d\s.:/-][^\d:/]*)?")


class StatusKey(NamedTuple):
    """Whose status it is: of the module (empty: this one), its hardware, and the name of the component."""

    module: str
    hardware: str
    name: str


@dataclass(slots=True, eq=False)
class Status:
    """The newest status of a component.

    Args:
        key: Whose it is.
        node: Its publisher, as its own module names it.
        source: That node in the graph of this module.
        level: ``OK``, ``WARN``, ``ERROR`` or ``STALE``.
        message: What it says.
        values: Its figures and facts, as texts.
        heard: When it came, seconds of the wall clock.
        last: The level that it said itself: where it is stale, the one before.
        levels: When it had another level than before, with that level, oldest first.
        samples: When values came, with those that are numbers in the order of ``values``; NaN for others.
    """

    key: StatusKey
    node: str
    source: str
    level: str = ""
    message: str = ""
    values: dict[str, str] = field(default_factory=dict)
    heard: float = 0.0
    last: str = ""
    levels: deque[tuple[float, str]] = field(default_factory=lambda: deque(maxlen=limits.DIAGNOSTIC_LEVELS))
    samples: deque[tuple[float, tuple[float, ...]]] = field(default_factory=deque)

    @property
    def since(self) -> float:
        """Since when it has its level."""
        return self.levels[-1][0] if self.levels else self.heard

    @property
    def is_agents(self) -> bool:
        """Whether the agent says it of itself, its links and topics."""
        return is_own(self.source) and proxied_node(self.source) is None

    def become(self, level: str, now: float) -> bool:
        """Have this level from now on; returns whether it is another one."""
        if level == self.level:
            return False
        self.level = level
        self.levels.append((now, level))
        return True


class StatusTable:
    """The statuses of all publishers of ``/diagnostics``.

    Args:
        history: Numbers that are kept of all values together; 0: none.
    """

    def __init__(self, history: int = 0) -> None:
        self.statuses: dict[StatusKey, Status] = {}
        # Why a publisher was heard in part lately, by its name in this module's graph, and when.
        self._problems: dict[str, tuple[float, str]] = {}
        self._history = history
        self._buckets: dict[str, TokenBucket] = {}
        self._counts = Counter[str]()
        self._resumed = -math.inf

    @property
    def problems(self) -> dict[str, str]:
        """Why a publisher is heard in part, by its name in this module's graph."""
        return {source: text for source, (_, text) in self._problems.items()}

    def admits(self, source: str, length: int, now: float) -> bool:
        """Whether a message is to be decoded: its publisher has not sent too much, and it is not too long.

        Args:
            source: Its publisher, as this module's graph names it.
            length: Its bytes.
            now: Seconds of the wall clock.
        """
        if length > limits.DIAGNOSTIC_BYTES:
            text = f"a message of {length} bytes is left out, at most {limits.DIAGNOSTIC_BYTES} are read"
            self._problems[source] = now, text
            return False
        if source not in self._buckets:
            if len(self._buckets) >= limits.DIAGNOSTICS_MAX:
                del self._buckets[next(iter(self._buckets))]
            self._buckets[source] = TokenBucket(limits.DIAGNOSTIC_FLOW, 3 * limits.DIAGNOSTIC_FLOW)
        bucket, cost = self._buckets[source], max(length, limits.DIAGNOSTIC_FLOW / limits.DIAGNOSTIC_RATE)
        if bucket.has(now, cost):
            bucket.spend(cost)
            return True
        most = f"{limits.DIAGNOSTIC_RATE:g} messages and {limits.DIAGNOSTIC_FLOW // MIB} MiB a second are read"
        text = f"it sends too much, at most {most}"
        self._problems[source] = now, text
        return False

    def take(self, source: str, statuses: Iterable[Mapping[str, Any]], now: float) -> list[Status]:
        """Take the statuses of one message; returns those whose level is another one than before.

        Args:
            source: The publisher, as this module's graph names it: a proxy for a node of a peer.
            statuses: Each with the members of ``diagnostic_msgs/DiagnosticStatus``.
            now: Seconds of the wall clock.
        """
        module, node = proxied_node(source) or ("", source)
        changed = []
        for one in statuses:
            key = StatusKey(module, _text(one["hardware_id"], 256).strip(), _text(one["name"], 256).strip())
            status = self.statuses.get(key)
            if status is None:
                if not self._make_room(source, now):
                    break
                status = self.statuses[key] = Status(key, node, source)
                self._counts[source] += 1
            elif status.source != source:  # two nodes say it: the newest counts
                self._counts.update({status.source: -1, source: 1})
                status.node, status.source = node, source
            pairs = one["values"][: limits.DIAGNOSTIC_VALUES]
            values = {_text(pair["key"], 256): _text(pair["value"], 512) for pair in pairs}
            self._sample(status, values, now)
            level = one["level"]
            status.last = DiagnosticLevel(level).name if level in (0, 1, 2) else STALE
            status.message, status.values, status.heard = _text(one["message"], 1024), values, now
            if status.become(status.last, now):
                changed.append(status)
        return changed

    def touch(self, source: str, now: float) -> None:
        """A publisher has sent a message that is not read: its statuses are as they were."""
        for status in self.statuses.values():
            if status.source == source:
                status.heard = now

    def resume(self, now: float) -> None:
        """Listen again after a pause, in which silence meant nothing."""
        self._resumed = now

    def judge(self, now: float) -> list[Status]:
        """Mark what is stale, and forget what is gone; returns those that have become stale."""
        changed = []
        recent = now - limits.DIAGNOSTIC_PROBLEM
        self._problems = {source: one for source, one in self._problems.items() if one[0] >= recent}
        for status in [*self.statuses.values()]:
            silent = now - max(status.heard, self._resumed)
            if silent > limits.DIAGNOSTIC_FORGET:
                self._forget(status)
            elif silent > limits.DIAGNOSTIC_STALE and status.become(STALE, now):
                changed.append(status)
        return changed

    def worst(self) -> str:
        """The worst level of all; OK where there is no status."""
        return max((status.level for status in self.statuses.values()), key=LEVELS.index, default=OK)

    def _make_room(self, source: str, now: float) -> bool:
        """Forget the oldest status of the publisher with the most, if the table is full; not for that one itself."""
        if len(self.statuses) < limits.DIAGNOSTICS_MAX:
            return True
        most, _ = self._counts.most_common(1)[0]
        text = f"it has {self._counts[most]} statuses or more, {limits.DIAGNOSTICS_MAX} of all publishers are kept"
        self._problems[most] = now, text
        if most == source:
            return False
        self._forget(min((s for s in self.statuses.values() if s.source == most), key=lambda s: s.heard))
        return True

    def _forget(self, status: Status) -> None:
        del self.statuses[status.key]
        self._counts[status.source] -= 1
        if not self._counts[status.source]:
            del self._counts[status.source]
            self._buckets.pop(status.source, None)

    def _sample(self, status: Status, values: Mapping[str, str], now: float) -> None:
        """Keep the numbers of a status. All statuses have an equal share of what is kept."""
        if not self._history or not values:
            return
        if values.keys() != status.values.keys():
            status.samples.clear()  # they would belong to other names
        numbers = tuple(map(number_of, values.values()))
        if all(map(math.isnan, numbers)):
            return
        status.samples.append((now, numbers))
        most = max(2, self._history // len(self.statuses) // len(numbers))
        while len(status.samples) > most:
            status.samples.popleft()


def number_of(text: str) -> float:
    """The number that a value begins with, ``12.4 V``; NaN where it is none."""
    match = _NUMBER.fullmatch(text)
    number = float(match[1]) if match else math.nan
    return number if math.isfinite(number) else math.nan


def history(status: Status) -> Iterator[tuple[str, list[float | None]]]:
    """The values of a status that are numbers, each with its past; first the moments, under an empty name."""
    yield "", [round(at, 2) for at, _ in status.samples]
    for place, name in enumerate(status.values):
        column = [None if math.isnan(numbers[place]) else numbers[place] for _, numbers in status.samples]
        if name and any(number is not None for number in column):
            yield name, column


def _text(value: object, most: int) -> str:
    text = value if isinstance(value, str) else str(value)
    return text if len(text) <= most else f"{text[:most]}…"
