"""The present values of what a resource's expressions refer to: topics, parameters, qualities, processes.

One object serves all expressions of a resource: the rules of contexts, alarms and profiles, and the values of
attributes. It subscribes to the topics that they name; those of the resource itself come by its own subscriptions.
"""

from __future__ import annotations

import asyncio
import logging
from typing import TYPE_CHECKING, Any, Final

from rmpa.core.errors import ConfigError, RmpaError
from rmpa.resource import limits
from rmpa.resource.expression import split_reference
from rmpa.resource.runtime import RuntimePart, topic_of
from rmpa.runtime.tasks import OwnedTasks

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Mapping

    from rmpa.resource.declare import Input, Output, Parameter
    from rmpa.resource.expression import Expression, Scalar, SourceCall
    from rmpa.resource.quality import Value
    from rmpa.resource.runtime import Runtime
    from rmpa.ros.node.endpoints import Received, Subscriber
    from rmpa.ros.types.messages import MessageType

_log = logging.getLogger(__name__)
# Seconds between the first two searches for topics that expressions refer to.
_FIRST_LOOK: Final = 0.5


class ExpressionValues(RuntimePart):
    """The values of all references of one resource's expressions; must be started before the parts that use them.

    Args:
        runtime: The runtime of the resource.
        expressions: The expressions. More may not come later: the topics are looked up once.
    """

    def __init__(self, runtime: Runtime, expressions: Iterable[Expression]) -> None:
        self._runtime = runtime
        # What answers the functions of ``declaration.SOURCES``, by name: called with the arguments.
        self.providers: dict[str, Callable[..., Scalar | None]] = {}
        # Called with the references whose values have changed.
        self.listeners: list[Callable[[set[str]], None]] = []
        references: set[str] = set()
        # The functions that the expressions call, by their text.
        self.sources: dict[str, SourceCall] = {}
        for each in expressions:
            references.update(each.references)
            self.sources.update(each.sources)
        self._parameters = {reference for reference in references if reference.startswith("~")}
        self._fields = {text: TopicField(text) for text in references if text.startswith("/")}
        self._attributes = references - self._parameters - self._fields.keys() - self.sources.keys()
        self._measured: Mapping[str, Value] = {}
        self._subscribers: dict[str, Subscriber] = {}
        # The topic of each input or output of the resource that a reference names, by the declared name.
        self._taps: dict[str, str] = {}
        self._latest: dict[str, tuple[MessageType, bytes]] = {}
        self._work = OwnedTasks()

    async def start(self) -> None:
        """Look for the topics that the expressions name."""
        if self._fields:
            self._work.start(self._find_topics(), "find topics of expressions")

    async def close(self) -> None:
        """Look no more."""
        await self._work.close()

    def problems(self) -> tuple[list[str], list[str]]:
        """Why fields that expressions refer to cannot be read."""
        return [], [f"rule over {field.problem}" for field in self._fields.values() if field.problem]

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
        for text, source in self.sources.items():
            provider = self.providers.get(source.function)
            if provider is not None and (value := provider(*source.arguments)) is not None:
                found[text] = value
        return found

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
        self._changed(self._attributes | self.sources.keys())

    def received(self, item: Input, message: Received) -> None:
        """Keep the message of an input if an expression refers to its topic."""
        if item.name in self._taps:
            self._update(self._taps[item.name], message.kind, message.raw)

    def published(self, output: Output, raw: bytes, now_ns: int, caller: str = "") -> None:  # noqa: ARG002
        """Keep the message of an output if an expression refers to its topic."""
        if output.name in self._taps:
            self._update(self._taps[output.name], output.type, raw)

    def parameter_changed(self, parameter: Parameter) -> None:
        """Tell the listeners."""
        self._changed({f"~{parameter.name}"} & self._parameters)

    def _update(self, topic: str, kind: MessageType, raw: bytes) -> None:
        self._latest[topic] = kind, raw
        self._changed({text for text, field in self._fields.items() if field.topic == topic})

    def _changed(self, references: set[str]) -> None:
        for listener in self.listeners if references else ():
            listener(references)

    def uses(self, name: str) -> bool:
        """Whether an expression has the messages of this input or output from the resource's own subscription."""
        return name in self._taps

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
        heard = [name for name in own if self._runtime.hears(name)]
        self._taps.update(dict.fromkeys(heard, topic))
        if not heard and topic not in self._subscribers:  # else its messages come already
            self._subscribers[topic] = await node.subscribe(
                topic, callback=lambda message: self._update(topic, message.kind, message.raw)
            )


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
