"""The present values of what a resource's expressions refer to: topics, parameters, qualities, figures, diagnostics.

One object serves all expressions of a resource: the rules of contexts, alarms and profiles, and the values of
attributes. It subscribes to the topics that they name; those of the resource itself come by its own subscriptions.
Figures of processes and of the machine are read once in each window, and only those that an expression uses. What is
not known has no value.
"""

from __future__ import annotations

import asyncio
import logging
import re
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from rmpa.core.errors import ConfigError, RmpaError
from rmpa.resource import limits
from rmpa.resource.expression import Scalar, SourceCall, split_reference
from rmpa.resource.runtime import Runtime, RuntimePart, topic_of
from rmpa.ros.types.definitions import ARRAY_TYPE
from rmpa.ros.types.messages import MessageType
from rmpa.runtime.accept import in_thread
from rmpa.runtime.programs import CpuShares, figures
from rmpa.runtime.tasks import keep_task

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from rmpa.resource.declare import DeclaredTopic, Parameter
    from rmpa.resource.processes import Processes
    from rmpa.resource.quality import Value
    from rmpa.ros.node.endpoints import Received, Subscriber

_log = logging.getLogger(__name__)
# Seconds between the first two searches for topics that expressions refer to.
_FIRST_LOOK: Final = 0.5
_ZONES: Final = Path("/sys/class/thermal")
_NUMBER: Final = re.compile(r"\s*([-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?)")
_FIGURES: Final = frozenset({"cpu", "memory", "temperature"})


class ExpressionValues(RuntimePart):
    """The values of all references of one resource's expressions; must be started before the parts that use them.

    Args:
        runtime: The runtime of the resource.
        processes: Knows the processes of nodes.
    """

    # More than 12 fields: what is referred to, and what is known of it.
    def __init__(self, runtime: Runtime, processes: Processes) -> None:
        super().__init__(runtime)
        self._processes = processes
        # Called with the references whose values have changed.
        self.on_change: Callable[[set[str]], None] = lambda _: None
        expressions = [each for _, each in runtime.resource.expressions()]
        references = {reference for each in expressions for reference in each.references}
        # The functions that the expressions call, by their text.
        self._sources: dict[str, SourceCall] = {k: v for each in expressions for k, v in each.sources.items()}
        self._parameters = {reference for reference in references if reference.startswith("~")}
        self._fields = {text: TopicField(text) for text in references if text.startswith("/")}
        self._attributes = references - self._parameters - self._fields.keys() - self._sources.keys()
        self._measured: Mapping[str, Value] = {}
        self._subscribers: dict[str, Subscriber] = {}
        # The topic of each input or output of the resource that a reference names, by the declared name.
        self._taps: dict[str, str] = {}
        self._latest: dict[str, tuple[MessageType, bytes]] = {}
        # By node: shares of a core, and bytes; by type of thermal zone: °C.
        self._cpu: dict[str, float] = {}
        self._memory: dict[str, float] = {}
        self._zones: Mapping[str, float] = {}
        # By name of a status that an expression names: when it has come, its level, and its values.
        self._diagnostics: dict[str, tuple[float, int, dict[str, str]]] = {}

    async def start(self) -> None:
        """Look for the topics that the expressions name, and read what their functions answer."""
        used = {source.function for source in self._sources.values()}
        if "diagnostics" in used:
            await self._runtime.node.subscribe("/diagnostics", MessageType(ARRAY_TYPE), self._diagnosed)
        if self._fields:
            self._work.start(self._find_topics(), "find topics of expressions")
        if used & _FIGURES:
            self._work.add(keep_task(self._read_figures, f"figures for {self._runtime.resource.name}"))

    def problems(self) -> tuple[list[str], list[str]]:
        """Why fields that expressions refer to cannot be read."""
        return [], [f"rule over {field.problem}" for field in self._fields.values() if field.problem]

    def blocked(self) -> dict[str, str]:
        """The profiles whose rule is false; an unknown rule blocks none."""
        profiles = self._runtime.resource.profiles.values()
        rules = {one.name: one.rule for one in profiles if one.rule is not None}
        values = self.now() if rules else {}
        return {
            name: f"its rule does not hold: {rule}" for name, rule in rules.items() if rule.holds(values) is False
        }

    def now(self) -> dict[str, Scalar]:
        """The known values, by reference."""
        found: dict[str, Scalar] = {}
        for text in self._parameters:
            found[text] = self._runtime.resource.parameters[text[1:]].value
        for text in self._attributes & self._measured.keys():
            found[text] = self._measured[text]
        for text, field in self._fields.items():
            if (subscriber := self._subscribers.get(field.topic)) is not None and not subscriber.publishers:
                self._latest.pop(field.topic, None)  # without a publisher the value is unknown
            if (latest := self._latest.get(field.topic)) and (value := field.read(*latest)) is not None:
                found[text] = value
        answers = {text: self._answer(source.function, *source.arguments) for text, source in self._sources.items()}
        return found | {text: answer for text, answer in answers.items() if answer is not None}

    def derive(self, measured: Mapping[str, Value]) -> dict[str, Value]:
        """The values of a window, with those of attributes that have an expression and are known.

        Args:
            measured: The measured values of the window, by attribute.
        """
        found = dict(measured)
        self._measured = found  # an attribute may refer to those declared before it
        for name, declared in self._runtime.resource.declared_attributes.items():
            if declared.value is None:
                continue
            value: Any = declared.value.value(self.now())
            if isinstance(value, bool):
                value = float(value)
            if value is not None:
                try:
                    found[name] = declared.attribute.check(value, name)
                except ConfigError as error:
                    _log.debug("! %s: %s", self._runtime.node.name, error)
        return found

    def window_ended(self, measured: Mapping[str, Value]) -> None:
        """Take the values of a window."""
        self._measured = measured
        self._changed(self._attributes | self._sources.keys())

    def parameter_changed(self, parameter: Parameter) -> None:
        """Tell of it."""
        self._changed({f"~{parameter.name}"} & self._parameters)

    def uses(self, name: str) -> bool:
        """Whether an expression has the messages of this input or output from the resource's own subscription."""
        return name in self._taps

    def _changed(self, references: set[str]) -> None:
        if references:
            self.on_change(references)

    async def _find_topics(self) -> None:
        """Look up the topics that expressions refer to, and subscribe to them, until all are found."""
        node, delay = self._runtime.node, _FIRST_LOOK
        while missing := [field for field in self._fields.values() if not field.topic]:
            try:
                published = {topic for topic, _ in await node.get_published_topics()}
                for field in missing:
                    if field.find(published):
                        await self._subscribe(field.topic)
            except RmpaError as error:
                _log.debug("! %s: topics of rules: %s", node.name, error)
            await asyncio.sleep(delay)
            delay = min(2 * delay, limits.CONTEXT_RETRY)

    async def _subscribe(self, topic: str) -> None:
        resource, node = self._runtime.resource, self._runtime.node
        own = [name for name in (*resource.inputs, *resource.outputs) if topic_of(name, node.name) == topic]
        if heard := [name for name in own if self._runtime.hears(name)]:  # its messages come already
            if not self._taps:
                self._runtime.listeners.append(self._heard)
            self._taps.update(dict.fromkeys(heard, topic))
        elif topic not in self._subscribers:
            self._subscribers[topic] = await node.subscribe(
                topic, callback=lambda message: self._update(topic, message.kind, message.raw)
            )

    def _heard(self, topic: DeclaredTopic, raw: bytes, _now_ns: int, message: Received | None) -> None:
        if topic.name in self._taps:
            self._update(self._taps[topic.name], topic.type if message is None else message.kind, raw)

    def _update(self, topic: str, kind: MessageType, raw: bytes) -> None:
        self._latest[topic] = kind, raw
        self._changed({text for text, field in self._fields.items() if field.topic == topic})

    def _answer(self, function: str, first: str = "", key: str = "") -> Scalar | None:
        """What a function of ``expression.SOURCES`` has for an answer; a node that is left out is the only one."""
        node = first or next(iter(self._runtime.resource.nodes), "")
        match function:
            case "cpu":
                return self._cpu.get(node)
            case "memory":
                return self._memory.get(node)
            case "running":
                return self._processes.pid(node) is not None
            case "temperature":
                return self._zones.get(first) if first else max(self._zones.values(), default=None)
        at, level, values = self._diagnostics.get(first, (-limits.DIAGNOSTICS_LIFESPAN, 0, {}))
        if time.monotonic() - at > limits.DIAGNOSTICS_LIFESPAN:
            return None
        if not key:
            return level
        if (text := values.get(key)) is None:
            return None
        number = _NUMBER.match(text)  # such as of "61.5 C"; a text without one is the answer itself
        return float(number[1]) if number else text

    async def _read_figures(self) -> None:
        shares, zones = CpuShares(), any(one.function == "temperature" for one in self._sources.values())
        while True:
            pids = {key: pid for key in self._runtime.resource.nodes if (pid := self._processes.pid(key)) is not None}
            found = {key: one for key, pid in pids.items() if (one := figures(pid)) is not None}
            self._memory = {key: float(one.rss) for key, one in found.items()}
            told = [(key, shares.known(pids[key]), shares.of(pids[key], one)) for key, one in found.items()]
            self._cpu = {key: share for key, known, share in told if known}  # the first is since the node began
            shares.keep(set(pids.values()))
            if zones:
                self._zones = await in_thread(read_zones, "thermal zones")
            await asyncio.sleep(max(self._runtime.resource.settings.window, limits.FIGURES_PAUSE))

    def _diagnosed(self, message: Received) -> None:
        names = {one.arguments[0] for one in self._sources.values() if one.function == "diagnostics"}
        for status in message.message.status:
            if (name := str(status.name)) in names:
                values = {str(pair.key): str(pair.value) for pair in status.values}
                self._diagnostics[name] = time.monotonic(), int(status.level), values


class TopicField:
    """A field of a topic that expressions refer to."""

    def __init__(self, reference: str) -> None:
        self._reference = reference
        self._fields: tuple[str, ...] = ()
        # Global name of the topic; empty until it is found.
        self.topic = ""
        # Why the field cannot be read from the topic's messages; empty if it can.
        self.problem = ""

    def find(self, published: set[str]) -> bool:
        """Find the topic among the published ones; false if none of the candidates is published."""
        for topic, fields in split_reference(self._reference):
            if topic in published:
                self.topic, self._fields = topic, fields
                return True
        return False

    def read(self, kind: MessageType, raw: bytes) -> Any:
        """The field's value in a serialized message; ``None`` if it does not exist or is no scalar."""
        fields, problem, value = self._fields, "", None
        if not fields and len(kind.fields) == 1:
            fields = (kind.fields[0].name,)
        try:
            value = kind.deserialize(raw)
            for name in fields:
                value = getattr(value, name)
            if hasattr(value, "nanosec"):
                value = float(value.sec + value.nanosec / 1e9)
            if not isinstance(value, bool | int | float | str):
                problem = "it is no number, text or truth; name a field of it"
        except AttributeError:
            has = ", ".join(field.name for field in kind.fields)
            problem = f"{kind.name} has no {'.'.join(fields)}; it has {has}"
        except RmpaError as error:
            problem = str(error)
        before, self.problem = self.problem, f"{self._reference}: {problem}" if problem else ""
        if problem and self.problem != before:
            _log.warning("! the rule with %s [resource-trouble]", self.problem)
        return None if problem else value


def read_zones(folder: Path = _ZONES) -> dict[str, float]:
    """The temperature of each type of thermal zone in °C, of several of one type the hottest; may block."""
    found: dict[str, float] = {}
    for zone in folder.glob("thermal_zone*"):
        try:
            kind, value = (zone / "type").read_text().strip(), int((zone / "temp").read_text()) / 1000
        except (OSError, ValueError):
            continue  # a sensor that is switched off
        found[kind] = max(value, found.get(kind, value))
    return found
