"""Measures the quality of one resource by windows: of outputs, of inputs, and of what the user's code observes.

Only sums are kept, so each message costs the same. Values that a window cannot determine (the standard deviation of a
single period, a latency without a stamp) are left out and not judged.

What other nodes publish is measured by subscribing to it, as any node does; nothing of it is passed on. A second
subscriber of much data costs the publisher, so such a topic is measured by what its publishers count themselves
(``getBusStats``): rate and bandwidth to their other subscribers. Whether a topic has a publisher at all is asked of
the master where there is no subscription.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import math
import struct
from collections import deque
from typing import TYPE_CHECKING, Final

from rmpa.core.errors import RmpaError
from rmpa.core.identity import SERIAL_HALF, SERIAL_MASK
from rmpa.resource import limits
from rmpa.resource.declare import DeclaredTopic, Measure, Output
from rmpa.resource.runtime import Runtime, RuntimePart, topic_of
from rmpa.ros.http.rpc import call, call_api, exchange, read_response
from rmpa.ros.wire.slave_api import Sent, read_bus_stats, sent_between
from rmpa.ros.wire.tcpros import printable
from rmpa.ros.wire.xmlrpc import RosFault, RosReply, call_pieces
from rmpa.runtime.tasks import keep_task

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence

    from rmpa.resource.quality import Value
    from rmpa.resource.resource import Resource
    from rmpa.resource.values import ExpressionValues
    from rmpa.ros.node.endpoints import Received

_log = logging.getLogger(__name__)
_HEADER: Final = struct.Struct("<III")
_SECOND: Final = 1_000_000_000
# Number of publishers of one topic whose sequence numbers are tracked; one more, and the tracking starts afresh.
_SOURCES: Final = 64
# A rate by counters is that of the last so many messages or seconds: of few messages it would jump by one in each
# window.
_COUNTED: Final = 10
_COUNTED_SPAN: Final = 5.0
# Consecutive windows for which something must be missing before it is reported, since connecting takes a while.
MISSING_WINDOWS: Final = 2
# The data of so many seconds decide whether a topic carries much; a latched message that comes once does not count.
_SPAN: Final = 5.0
# Seconds between two questions to nodes and master: at least, and where windows are longer.
_LEAST: Final = 0.2
_MOST: Final = 1.0
# Seconds for a node's answer.
_ANSWER: Final = 1.0


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
        self._topics: dict[str, TopicQuality | TopicCounters] = {}
        # Inputs whose type is not known yet, by name; it is learnt from their first publisher.
        self._unknown: dict[str, DeclaredTopic] = {}
        for name, topic in (resource.outputs | resource.inputs).items():
            # The resource numbers its own messages without a gap.
            self._add(topic, now, numbered=name in resource.inputs or topic.observed)
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
        """Measure a message that was sent or received.

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
        """Record a valid value that the user's code has observed of a declared attribute."""
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


class Measuring(RuntimePart):
    """Measures one resource, and looks at the nodes that others start for it; starts before the adapter.

    Args:
        runtime: The runtime of the resource.
        values: A topic that an expression names stays subscribed to.
    """

    def __init__(self, runtime: Runtime, values: ExpressionValues) -> None:
        super().__init__(runtime)
        self._values = values
        self.quality = QualityMeasurement(runtime.resource, 0.0)
        resource, node = runtime.resource, runtime.node.name
        # Observed outputs, and those of them that are counted, by global name.
        self._outputs = {topic_of(one.name, node): one for one in resource.outputs.values() if one.observed}
        self._counted: dict[str, Output] = {
            topic: one for topic, one in self._outputs.items() if one.measure is Measure.COUNTERS
        }
        # Outputs without which a profile does, for it offers no messages of them.
        none = {key for one in resource.profiles.values() for key, value in one.offers.items() if value == 0}
        labels, first = resource.labels, next(iter(resource.outputs), "")
        self._optional = {
            name for name in resource.outputs if f"{labels[name]}.rate" in none or (name == first and "rate" in none)
        }
        # Required inputs that other nodes receive, by global name.
        self._inputs = {
            topic_of(one.name, node): one.name for one in resource.inputs.values() if one.observed and one.required
        }
        # By output that may yet be counted: when the first of the messages that decide has come, and the bytes of the
        # later ones.
        self._carried = {one.name: (-_SPAN, 0) for one in self._outputs.values() if one.measure is Measure.AUTO}
        # What the master said last; empty: it has not been asked. In it: the publishers of each topic, and all nodes.
        self._said = b""
        self._publishers: Mapping[str, Sequence[str]] = {}
        self._present: set[str] = set()
        self._uris: dict[str, str] = {}

    async def start(self) -> None:
        """Begin to measure: by subscribing, or by asking for counters."""
        self._loop = asyncio.get_running_loop()
        # Anew: the types of outputs are learnt by now.
        self.quality = QualityMeasurement(self._runtime.resource, self._loop.time())
        self._runtime.listeners.append(self._heard)
        for declared in self._runtime.resource.declared_attributes.values():
            self._runtime.bind(declared, "on_observation", self.quality.observe)
        for output in self._outputs.values():
            if output.measure is not Measure.COUNTERS:
                await self._runtime.receive(output)
        if self._outputs or self._inputs or self._runtime.resource.nodes:
            with contextlib.suppress(RmpaError):
                await self._look()
            self._work.add(keep_task(self._watch, f"observe for {self._runtime.resource.name}"))

    def _heard(self, topic: DeclaredTopic, raw: bytes, stamp_ns: int, message: Received | None) -> None:
        now = self._loop.time()
        self.quality.message(topic.name, raw, now, stamp_ns, message.caller_id if message is not None else "")
        if topic.name in self._carried:
            self._weigh(topic.name, len(raw), now)

    def problems(self) -> tuple[list[str], list[str]]:
        """Topics that no node publishes, and publishers of another type."""
        absent, named = self._absent()
        missing, broken = [f"node {name} does not run" for key, name in absent.items() if key not in named], []
        for topic, output in self._outputs.items():
            subscriber = self._runtime.subscribers.get(output.name)
            if subscriber is None and (not self._said or self._publishers.get(topic)):
                continue
            if (subscriber is None or not subscriber.publishers) and output.name not in self._optional:
                missing.append(f"no node publishes {output.name}")
                refusals = [*subscriber.refusals.values()][-1:] if subscriber is not None else []
                broken += [f"{output.name}: {printable(text)}" for text in refusals]
        if self._said:
            missing += [
                f"no node publishes {name}" for topic, name in self._inputs.items() if not self._publishers.get(topic)
            ]
        return missing, broken

    def blocked(self) -> dict[str, str]:
        """The profiles that cannot run, with the reason: a node does not run that nothing here starts."""
        absent, named = self._absent()
        return {
            one.name: f"node {name} does not run"
            for one in self._runtime.resource.profiles.values()
            for key, name in absent.items()
            if key not in named or key in one.nodes
        }

    def _absent(self) -> tuple[dict[str, str], set[str]]:
        """The nodes that nothing here starts and that do not run, by their keys, and those that profiles name."""
        resource = self._runtime.resource
        others = {one.key: one.name for one in resource.nodes.values() if not one.started and self._said}
        named = {key for one in resource.profiles.values() for key in one.nodes}
        return {key: name for key, name in others.items() if name not in self._present}, named

    def _weigh(self, name: str, size: int, now: float) -> None:
        """Change to counters if an output carries much."""
        began, carried = self._carried[name]
        carried = carried + size if now - began < _SPAN else 0
        self._carried[name] = (began if carried else now), carried
        much = carried > limits.MEASURED_BYTES * max(1.0, now - began)
        if not much or self._values.uses(name) or name not in self._runtime.subscribers:
            return
        del self._carried[name]
        self._counted[topic_of(name, self._runtime.node.name)] = self._runtime.resource.outputs[name]
        self.quality.counted(name, {}, now)
        self._work.start(self._runtime.subscribers.pop(name).close(), f"measure {name} by counters")
        text = f"more than {limits.MEASURED_BYTES // 1024} KiB a second; it is measured by its node's own counters"
        _log.info("= %s: %s carries %s: rate and bandwidth only", self._runtime.node.name, name, text)

    async def _watch(self) -> None:
        period = min(max(self._runtime.resource.settings.window, _LEAST), _MOST)
        while True:
            try:
                if self._counted or self._inputs or self._runtime.resource.nodes:
                    await self._look()
                    await self._count()
            except (RmpaError, RosFault) as error:
                _log.debug("! %s: %s", self._runtime.node.name, error)
            await asyncio.sleep(period)

    async def _look(self) -> None:
        """Ask the master which nodes publish what; the same answer as before is not read again."""
        node = self._runtime.node
        question = b"".join(call_pieces("getSystemState", [node.name]))
        said = await exchange(node.master_uri, "getSystemState", question, timeout=_ANSWER * 5)
        if said == self._said:
            return
        match RosReply.of(await read_response(said)).value:
            case [[*published], [*subscribed], [*served]]:
                known = {str(topic): list(map(str, names)) for topic, names in published}  # type: ignore[misc, arg-type]
                mine = self._outputs.keys() | self._inputs.keys()
                self._publishers = {topic: [n for n in known.get(topic, ()) if n != node.name] for topic in mine}
                self._present = {str(name) for _, names in (*published, *subscribed, *served) for name in names}  # type: ignore[misc, union-attr]
                self._said, self._uris = said, {}

    async def _count(self) -> None:
        """Ask the publishers of counted topics for their counters."""
        nodes = [*dict.fromkeys(name for topic in self._counted for name in self._publishers.get(topic, ()))]
        answers = dict(zip(nodes, await asyncio.gather(*map(self._ask, nodes)), strict=True))
        for topic, output in self._counted.items():
            names = self._publishers.get(topic, ())
            sent = {name: found.get(topic, {}) for name in names if (found := answers.get(name)) is not None}
            self.quality.counted(output.name, sent, self._loop.time())

    async def _ask(self, node: str) -> dict[str, Sent] | None:
        """What a node has sent, by topic; ``None`` if it does not answer."""
        own = self._runtime.node
        try:
            if node not in self._uris:
                self._uris[node] = str((await call_api(own.master_uri, "lookupNode", own.name, node)).value)
            return read_bus_stats(await call(self._uris[node], "getBusStats", own.name, timeout=_ANSWER))
        except (RmpaError, RosFault) as error:
            _log.debug("! %s: counters of %s: %s", own.name, node, error)
            return None
