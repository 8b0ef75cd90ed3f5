"""Measures the quality of one resource by windows: of outputs, of inputs, and of what the user's code observes.

Only sums are kept, so each message costs the same. Values that a window cannot determine (the standard deviation of a
single period, a latency without a stamp) are left out and not judged.
"""

from __future__ import annotations

import math
import struct
from collections import deque
from typing import TYPE_CHECKING, Final

from rmpa.core.errors import ConfigError
from rmpa.core.identity import SERIAL_HALF, SERIAL_MASK
from rmpa.resource import limits
from rmpa.resource.quality import Direction, find_attribute
from rmpa.ros.wire.slave_api import sent_between

if TYPE_CHECKING:
    from collections.abc import Collection, Iterable, Mapping

    from rmpa.resource.declare import DeclaredTopic
    from rmpa.resource.quality import Attribute, Value
    from rmpa.resource.resource import Resource
    from rmpa.ros.wire.slave_api import Sent

_HEADER: Final = struct.Struct("<III")
_SECOND: Final = 1_000_000_000
# Number of publishers of one topic whose sequence numbers are tracked; one more, and the tracking starts afresh.
_SOURCES: Final = 64
# A rate by counters is that of the last so many messages or seconds: of few messages it would jump by one in each
# window.
_COUNTED: Final = 10
_COUNTED_SPAN: Final = 5.0


class TopicQuality:
    """Measures one output or input.

    Args:
        now: Beginning of the first window, in monotonic seconds.
        stamped: Whether the messages begin with a ``std_msgs/Header``.
        numbered: Whether that header's ``seq`` counts the messages of each source, as client libraries set it.
        deadline: The contract's deadline: longest time between two messages in seconds; ``None``: no deadline.
    """

    def __init__(
        self, now: float, *, stamped: bool = False, numbered: bool = False, deadline: float | None = None
    ) -> None:
        self._stamped = stamped
        self._numbered = stamped and numbered
        self._deadline = deadline
        self._began = now
        self._last: float | None = None
        self._last_age = math.nan
        self._sequences: dict[str, int] = {}
        self._clear()

    def _clear(self) -> None:
        self._count = self._bytes = self._lost = 0
        self._periods = self._missed = self._stamps = 0
        self._sum = self._squares = self._latency = 0.0

    def message(self, raw: bytes | memoryview, now: float, now_ns: int, source: str = "") -> None:
        """Measure one message.

        Args:
            raw: The serialized message, without the length prefix.
            now: When it was sent or received, in monotonic seconds.
            now_ns: The same moment by the wall clock (Unix nanoseconds), to which the message's stamp refers.
            source: Name of the publisher; each has its own sequence numbers.
        """
        last, self._last = self._last, now
        if last is not None:
            period = now - last
            self._periods += 1
            self._sum += period
            self._squares += period * period
            if self._deadline is not None and period > self._deadline:
                self._missed += 1
        self._count += 1
        self._bytes += len(raw)
        if self._stamped and len(raw) >= _HEADER.size:
            sequence, seconds, nanoseconds = _HEADER.unpack_from(raw)
            if seconds or nanoseconds:
                self._last_age = (now_ns - seconds * _SECOND - nanoseconds) / _SECOND
                self._latency += self._last_age
                self._stamps += 1
            if self._numbered:
                if source not in self._sequences and len(self._sequences) >= _SOURCES:
                    self._sequences.clear()
                gap = sequence - self._sequences.get(source, sequence - 1) - 1 & SERIAL_MASK
                self._sequences[source] = sequence
                self._lost += gap if gap < SERIAL_HALF else 0

    def restart(self, now: float) -> None:
        """Discard the measurements so far and begin a new window, because another profile runs."""
        self._began = now
        if self._last is not None:
            self._last = now  # the time from one profile to the other is no period
        self._clear()

    def window(self, now: float) -> dict[str, Value]:
        """End the window and return its values by attribute (``quality.MEASURED``)."""
        span = max(now - self._began, 1e-9)
        silent = now - (self._last if self._last is not None else self._began)
        found: dict[str, Value] = {"bandwidth": self._bytes / span}
        # The present period is at least as long as the silence so far, so the rate falls as soon as a source stops.
        mean = self._sum / self._periods if self._periods else math.inf
        if self._last is None:
            found["rate"] = 0.0
        elif mean < math.inf or silent > 0:
            found["rate"] = 1 / max(mean, silent) if mean < math.inf else 1 / silent
        if self._periods > 1:
            found["period_sd"] = math.sqrt(max(0.0, self._squares / self._periods - mean * mean))
        if self._stamps:
            found["latency"] = max(0.0, self._latency / self._stamps)
        if self._last is not None:
            age = self._last_age if not math.isnan(self._last_age) else 0.0
            found["age"] = max(0.0, age + silent)
        if self._deadline is not None and self._last is not None:
            overdue = silent > self._deadline
            if judged := self._periods + overdue:
                found["deadline_misses"] = (self._missed + overdue) / judged
        if self._numbered and self._count:
            found["loss"] = self._lost / (self._lost + self._count)
        self._began = now
        self._clear()
        return found


class TopicCounters:
    """The rate of an observed output by what its publishers say that they have sent to a subscriber.

    Without a subscriber nothing is known, so nothing is judged.
    """

    def __init__(self) -> None:
        self._before: Mapping[str, Sent] = {}
        self._at: float | None = None
        # Seconds, messages and bytes between two answers, the newest last.
        self._spans: deque[tuple[float, int, int]] = deque(maxlen=64)

    def counted(self, sent: Mapping[str, Sent], now: float) -> None:
        """Take the counts of each publisher that has answered, by its name."""
        found = [sent_between(self._before.get(node, {}), each) for node, each in sent.items()]
        known = [each for each in found if each is not None]
        if known and self._at is not None:
            self._spans.append((now - self._at, sum(count for count, _ in known), sum(size for _, size in known)))
        else:
            self._spans.clear()
        self._before, self._at = sent, now

    def restart(self, _now: float) -> None:
        """Discard the counts so far, because another profile runs."""
        self._spans.clear()
        self._at = None

    def window(self, _now: float) -> dict[str, Value]:
        """``rate`` and ``bandwidth``, if they are known."""
        seconds, messages, size = 0.0, 0, 0
        for span, count, sent in reversed(self._spans):
            seconds, messages, size = seconds + span, messages + count, size + sent
            if messages >= _COUNTED or seconds >= _COUNTED_SPAN:
                break
        return {"rate": messages / seconds, "bandwidth": size / seconds} if seconds else {}


class QualityMeasurement:
    """Measures messages and observations; each window yields their quality.

    Args:
        resource: The resource, completely declared.
        now: Beginning of the first window, in monotonic seconds; all times of this class are.
    """

    def __init__(self, resource: Resource, now: float) -> None:
        self._attributes = resource.attributes
        self._labels = resource.labels
        self._declared = resource.declared_attributes
        self._topics: dict[str, TopicQuality | TopicCounters] = {}
        # Inputs whose type is not known yet, by name; it is learnt from their first publisher.
        self._unknown: dict[str, DeclaredTopic] = {}
        for name, topic in (resource.outputs | resource.inputs).items():
            # The resource numbers its own messages without a gap.
            self._add(topic, now, numbered=name in resource.inputs or getattr(topic, "observed", False))
            if topic.known is None:
                self._unknown[name] = topic
        # The first output; its attributes are also available without the output's label.
        self._primary = next(iter(resource.outputs), "")
        # Sum and number of the window's observations, by declared attribute.
        self._sums: dict[str, tuple[float, int]] = {}
        # The mean of the last window with observations, or the last observed word, by declared attribute.
        #
        # It stays valid without a new observation: a battery's charge remains known between two readings. After a
        # change of profile the attribute is unknown until it is observed again.
        self._observed: dict[str, Value] = {}

    def message(self, topic: str, raw: bytes, now: float, now_ns: int, caller: str = "") -> None:
        """Measure a message that an output has sent or an input has received.

        Args:
            topic: Declared name of the output or input.
            raw: The serialized message.
            now: When it was sent or received.
            now_ns: The same moment by the wall clock (Unix nanoseconds), to which stamps refer.
            caller: For what another node publishes: its name.
        """
        if topic in self._unknown and self._unknown[topic].known is not None:
            self._add(self._unknown.pop(topic), now, numbered=True)
        if isinstance(quality := self._topics.get(topic), TopicQuality):
            quality.message(raw, now, now_ns, caller)

    def counted(self, topic: str, sent: Mapping[str, Sent], now: float) -> None:
        """Measure an observed output by the counts of its publishers, from the first call on (``TopicCounters``)."""
        quality = self._topics[topic]
        if not isinstance(quality, TopicCounters):
            quality = self._topics[topic] = TopicCounters()
        quality.counted(sent, now)

    def _add(self, topic: DeclaredTopic, now: float, *, numbered: bool) -> None:
        fields = topic.known.fields if topic.known is not None else ()
        stamped = bool(fields) and fields[0].name == "header"
        self._topics[topic.name] = TopicQuality(
            now, stamped=stamped, numbered=numbered, deadline=topic.contract.deadline
        )

    def observe(self, attribute: str, value: Value) -> None:
        """Record a valid value that the user's code has observed of a declared attribute; others are ignored."""
        if attribute not in self._declared:
            return
        if isinstance(value, str):
            self._observed[attribute] = value
        else:
            total, count = self._sums.get(attribute, (0.0, 0))
            self._sums[attribute] = total + value, count + 1

    def restart(self, now: float) -> None:
        """Discard the measurements so far and begin a new window, because another profile runs."""
        for topic in self._topics.values():
            topic.restart(now)
        self._sums.clear()
        self._observed.clear()

    def window(self, now: float) -> dict[str, Value]:
        """End the window and return its measured values by attribute."""
        measured: dict[str, Value] = {}
        for name, topic in self._topics.items():
            for key, value in topic.window(now).items():
                measured[f"{self._labels[name]}.{key}"] = value
                if name == self._primary:
                    measured[key] = value
        self._observed |= {name: total / count for name, (total, count) in self._sums.items()}
        self._sums.clear()
        return measured | self._observed

    def format(self, measured: Mapping[str, Value]) -> dict[str, str]:
        """The values of a window as texts with units; the first output's attributes only by their short names."""
        twice = f"{self._labels[self._primary]}." if self._primary else None
        shown = {
            name: self._attributes[name].format(value)
            for name, value in measured.items()
            if name in self._attributes and not (twice and name.startswith(twice))
        }
        counted = [name for name, topic in self._topics.items() if isinstance(topic, TopicCounters)]
        return shown | {f"{self._labels[name]}.measured": "by its node's counters" for name in counted}


# Quality as observed by clients, and things that a resource lacks; both are judged once in each window.
#
# A resource measures the messages that it sends. Fewer may arrive in another module, where only the client can
# measure the loss.


# Consecutive windows for which something must be missing before it is reported, since connecting takes a while.
MISSING_WINDOWS: Final = 2
_WORSE: Final = {Direction.MAX: -1, Direction.MIN: 1}


class ObservedQualities:
    """The last report of each client.

    Args:
        attributes: The resource's attributes, by name.
        resource: Name of the resource, for errors.
        lifespan: Seconds for which a report counts.
    """

    def __init__(self, attributes: Mapping[str, Attribute], resource: str, lifespan: float) -> None:
        self._attributes = attributes
        self._resource = resource
        self._lifespan = lifespan
        self._reports: dict[str, tuple[float, dict[str, Value]]] = {}

    def report(self, client: str, values: Iterable[tuple[str, str]], now: float) -> None:
        """Take a client's report of attributes and values as texts, in place of its previous report.

        Raises:
            ConfigError: An attribute is unknown or a value is invalid; the whole report is dropped.
        """
        found: dict[str, Value] = {}
        for number, (name, text) in enumerate(values):
            where = f"observation of {name}"
            if number >= limits.REQUIREMENT_BOUNDS_MAX:
                raise ConfigError(where, f"more than {limits.REQUIREMENT_BOUNDS_MAX} attributes")
            found[name] = find_attribute(self._attributes, name, self._resource).parse(text, where)
        self._reports[client] = (now, found)

    def observed(self, client: str, name: str) -> Value | None:
        """The value of an attribute in a client's last report; ``None``: it has none."""
        _, found = self._reports.get(client, (0.0, {}))
        return found.get(name)

    def worst(self, measured: Mapping[str, Value], clients: Collection[str], now: float) -> dict[str, Value]:
        """For each attribute the worst of the measured and the reported values.

        Args:
            measured: The resource's own measurements, by attribute.
            clients: The clients that have a requirement; reports of others do not count.
            now: Monotonic seconds.

        Returns:
            Values by attribute. Where no direction is better, a reported value replaces the measured one.
        """
        self._reports = {client: r for client, r in self._reports.items() if now - r[0] <= self._lifespan}
        worst = dict(measured)
        for client, (_, found) in self._reports.items():
            for name, value in found.items() if client in clients else ():
                attribute, known = self._attributes[name], worst.get(name)
                sign = _WORSE.get(attribute.direction)
                if known is None or not sign or sign * (attribute.position(value) - attribute.position(known)) > 0:
                    worst[name] = value
        return worst

    def clear(self) -> None:
        """Drop all reports, because they describe the previous profile."""
        self._reports.clear()


def count_missing(windows: dict[str, int], missing: Iterable[str]) -> list[tuple[str, bool]]:
    """Count what a resource lacks, so that short absences are not reported.

    Args:
        windows: Number of consecutive windows for which each thing has been missing, by text; updated here.
        missing: The texts about everything that is missing in this window.

    Returns:
        The changes to report: each text, with true if it is missing now and false if it is back.
    """
    texts = set(missing)
    back = [text for text in windows if text not in texts]
    changes = [(text, False) for text in back if windows.pop(text) >= MISSING_WINDOWS]
    for text in sorted(texts):
        windows[text] = windows.get(text, 0) + 1
        if windows[text] == MISSING_WINDOWS:
            changes.append((text, True))
    return changes
