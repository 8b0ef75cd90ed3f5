"""Switches a resource between its contexts: by hand (a topic, the configuration) or by the contexts' rules.

A switch is atomic: no task runs and no message is sent until the context's function has ended, the context's outputs
and requirements are in force, and the resulting profile has been applied.
"""

from __future__ import annotations

import asyncio
import logging
from typing import TYPE_CHECKING, Any, Final

from rmpa.config.values import did_you_mean
from rmpa.core.errors import ConfigError, PeerRefused, RmpaError
from rmpa.resource import limits
from rmpa.resource.declare.context_rules import ContextSelector, parse_rule
from rmpa.resource.run.applier import HungError, call_function
from rmpa.resource.run.descriptor import topic_of
from rmpa.resource.run.runtime import RuntimePart
from rmpa.ros.types.messages import MessageType
from rmpa.ros.wire.tcpros import printable
from rmpa.runtime.loop import MachineTimer

if TYPE_CHECKING:
    from collections.abc import Coroutine

    from rmpa.resource.declare.behaviour import Context
    from rmpa.resource.declare.connections import Input, Output
    from rmpa.resource.declare.context_rules import Reference, Scalar
    from rmpa.resource.declare.parameters import Parameter
    from rmpa.resource.run.adapter import Adapter
    from rmpa.resource.run.runtime import Runtime
    from rmpa.resource.run.tasks import Tasks
    from rmpa.ros.node.endpoints import Received, Subscriber

_log = logging.getLogger(__name__)
TOPIC: Final = "context"
_HOLDER: Final = "context"
_DEBOUNCE: Final = 0.02
"""Seconds from a change of a value until the rules are evaluated; changes within that time share one evaluation."""
_INTERVAL: Final = 0.25
"""Seconds between evaluations without a change: a dwell time may have ended, or a publisher may be gone."""


class Contexts(RuntimePart):
    """The contexts of one resource; must be started after the adapter.

    Args:
        runtime: The runtime of the resource.
        tasks: The resource's tasks, paused during a switch.
        adapter: Puts the requirements of contexts in force.
    """

    def __init__(self, runtime: Runtime, tasks: Tasks, adapter: Adapter) -> None:
        resource = runtime.resource
        self._runtime = runtime
        self._tasks = tasks
        self._adapter = adapter
        self._known = resource.contexts
        rules = {
            name: parse_rule(context.when, resource.parameters, f"context {name} of {resource.name}")
            for name, context in self._known.items()
            if context.when
        }
        self._selector = ContextSelector(rules)
        self._topic_fields = {
            reference.text: _TopicField(reference)
            for rule in rules.values()
            for reference in rule.references
            if not reference.parameter
        }
        self._parameters = {r.text: r.parameter for rule in rules.values() for r in rule.references if r.parameter}
        self._subscribers: dict[str, Subscriber] = {}
        self._taps: dict[str, str] = {}
        """The topic of each input or output of the resource that a rule refers to, by the declared name."""
        self._latest: dict[str, tuple[MessageType, bytes]] = {}
        self._current = ""
        self._retry = 0.0
        self._choice_lock = asyncio.Lock()
        self._switch_lock = asyncio.Lock()
        self._work: set[asyncio.Task[None]] = set()
        self._switching: asyncio.Task[None] | None = None
        self._next_evaluation: float | None = None
        self._timer = MachineTimer(lambda: self._next_evaluation, self._evaluate)
        self._closed = True
        """True before ``start`` and after ``close``."""

    @property
    def current(self) -> str:
        """Name of the present context; empty: none."""
        return self._current

    @property
    def chosen(self) -> str:
        """Name of the context chosen by hand; empty: the rules decide."""
        return self._selector.chosen

    def preset(self, name: str) -> None:
        """Choose a context by hand before ``start``; an empty name lets the rules decide."""
        self._selector.chosen = name

    @property
    def problems(self) -> list[str]:
        """Why fields that rules refer to cannot be read; empty if all can."""
        return [field.problem for field in self._topic_fields.values() if field.problem]

    async def start(self) -> None:
        """Enter the chosen context, if any, and evaluate the rules from now on."""
        self._loop, self._closed = asyncio.get_running_loop(), False
        await self._runtime.advertise_text(TOPIC, "")
        node = self._runtime.node
        if self.chosen and self.chosen not in self._known:
            _log.warning("! %s: there is no context %s any more", node.name, printable(self.chosen))
            self.preset("")
        if not self._known:
            return
        await node.subscribe(f"{node.name}/set_context", MessageType("std_msgs/String"), self._choice_received)
        if self.chosen:
            try:
                await self._switch(self.chosen)
            except RmpaError as error:
                _log.warning("! %s: %s", node.name, error)
                self.preset("")
        if self._topic_fields:
            self._spawn(self._find_topics(), "find topics of rules")
        if self._selector.rules:
            self._evaluate(self._loop.time())
            self._timer.arm()

    async def close(self) -> None:
        """Stop the evaluation of rules; the present context stays."""
        self._closed = True
        self._timer.close()
        for task in self._work:
            task.cancel()
        await asyncio.gather(*self._work, return_exceptions=True)

    async def choose(self, name: str) -> None:
        """Choose a context by hand; an empty name lets the rules decide again.

        Raises:
            ConfigError: The resource has no context of this name; nothing has changed.
            PeerRefused: The function of the context failed; the present context stays.
        """
        if name and name not in self._known:
            near = did_you_mean(name, self._known)
            remedy = f"did you mean {near}?" if near else f"it is one of {', '.join(self._known) or 'none'}"
            raise ConfigError(f"resource {self._runtime.resource.name}", f"no context {name[:80]!r}", remedy)
        async with self._choice_lock:  # one that fails must not put the one before in the place of the next
            before, self._selector.chosen = self._selector.chosen, name
            try:
                if name:
                    await self._switch(name)
            except RmpaError:
                self._selector.chosen = before
                raise
            if not name:
                self._selector.since = self._retry = 0.0
                wanted = self._selector.select(self._current, self._values(), self._loop.time())
                await self._switch(wanted)
        self._publish()

    # --- values of rules ----------------------------------------------------------------------------------------

    def received(self, item: Input, message: Received) -> None:
        """Keep the message of an input if a rule refers to its topic."""
        if item.name in self._taps:
            self._update(self._taps[item.name], message.kind, message.raw)

    def published(self, output: Output, raw: bytes, now_ns: int) -> None:  # noqa: ARG002
        """Keep the message of an output if a rule refers to its topic."""
        if output.name in self._taps:
            self._update(self._taps[output.name], output.type, raw)

    def parameter_changed(self, parameter: Parameter) -> None:
        """Evaluate the rules soon if one of them refers to the parameter."""
        if parameter.name in self._parameters.values():
            self._evaluate_soon()

    def _update(self, topic: str, kind: MessageType, raw: bytes) -> None:
        self._latest[topic] = kind, raw
        self._evaluate_soon()

    def _values(self) -> dict[str, Scalar]:
        parameters = self._runtime.resource.parameters
        found: dict[str, Scalar] = {text: parameters[name].value for text, name in self._parameters.items()}
        for text, item in self._topic_fields.items():
            if (subscriber := self._subscribers.get(item.topic)) is not None and not subscriber.publishers:
                self._latest.pop(item.topic, None)  # without a publisher the value is unknown
            if (latest := self._latest.get(item.topic)) is not None and (value := item.read(*latest)) is not None:
                found[text] = value
        return found

    async def _find_topics(self) -> None:
        """Look up the topics that rules refer to, and subscribe to them, until all are found."""
        node = self._runtime.node
        delay = limits.CONTEXT_LOOK
        while missing := [item for item in self._topic_fields.values() if not item.topic]:
            try:
                published = {topic for topic, _ in await node.get_published_topics()}
                for item in missing:
                    if item.find(published):
                        await self._subscribe(item.topic)
            except RmpaError as error:
                _log.debug("! %s: topics of rules: %s", node.name, error)
            await asyncio.sleep(delay)
            delay = min(2 * delay, limits.CONTEXT_RETRY)

    async def _subscribe(self, topic: str) -> None:
        runtime = self._runtime
        own = [
            n
            for n in (*runtime.resource.inputs, *runtime.resource.outputs)
            if topic_of(n, runtime.node.name) == topic
        ]
        self._taps.update(dict.fromkeys(own, topic))
        if own or topic in self._subscribers:
            return  # the resource or an earlier call has subscribed already

        def update(message: Received) -> None:
            self._update(topic, message.kind, message.raw)

        self._subscribers[topic] = await runtime.node.subscribe(topic, callback=update)

    # --- decision -----------------------------------------------------------------------------------------------

    def _evaluate_soon(self) -> None:
        if self._next_evaluation is not None:
            self._next_evaluation = min(self._next_evaluation, self._loop.time() + _DEBOUNCE)
            self._timer.arm()

    def _evaluate(self, now: float) -> None:
        """Begin a switch if the rules select another context."""
        self._next_evaluation = now + _INTERVAL
        if self._switch_lock.locked() or now < self._retry or (self._switching and not self._switching.done()):
            return
        wanted = self._selector.select(self._current, self._values(), now)
        if wanted != self._current:
            self._switching = self._spawn(self._switch_by_rule(wanted), "switch context")

    async def _switch_by_rule(self, name: str) -> None:
        try:
            await self._switch(name)
        except RmpaError as error:
            _log.warning("! %s: %s", self._runtime.node.name, error)
            self._retry = self._loop.time() + limits.CONTEXT_RETRY

    def _choice_received(self, message: Received) -> None:
        self._spawn(self._choose_by_topic(str(message.message.data), message.caller_id), "choose context")

    async def _choose_by_topic(self, name: str, client: str) -> None:
        try:
            await self.choose(name)
        except RmpaError as error:
            self._adapter.refuse(client, printable(str(error)))

    # --- switch -------------------------------------------------------------------------------------------------

    async def _switch(self, name: str) -> None:
        """Switch to a context.

        Raises:
            PeerRefused: The context's function failed; the resource stays in its present context.
        """
        async with self._switch_lock:
            if name == self._current or self._closed:
                return
            runtime, context = self._runtime, self._known.get(name)
            await self._tasks.pause(_HOLDER)
            runtime.hold(_HOLDER)
            try:
                if context is not None:
                    await self._enter(context)
                outputs = context.outputs if context is not None else None
                runtime.context_outputs = frozenset(outputs) if outputs is not None else None
                self._apply(name, context)
                self._current = name
                self._selector.since = self._loop.time()
                await self._adapter.settled()
            finally:
                runtime.release(_HOLDER)
                self._tasks.resume(_HOLDER)
            _log.info("= %s: %s", runtime.node.name, f"context {name}" if name else "no context any more")
        self._publish()

    async def _enter(self, context: Context) -> None:
        """Call a context's function, if it has one.

        Raises:
            PeerRefused: The function raised.
            HungError: It did not return within ``limits.CONTEXT_ENTER_TIMEOUT`` seconds.
        """
        if context.enter is None:
            return
        limit, remedy = limits.CONTEXT_ENTER_TIMEOUT, "mend it, or leave to a task what takes longer"
        try:
            await call_function(context.enter, "context", context.name, limit, remedy)
        except HungError as error:
            self._runtime.release(_HOLDER, drop=True)
            self._adapter.end(error)
            raise
        except Exception as error:
            raise PeerRefused(f"context {context.name}", f"{type(error).__name__}: {error}") from error

    def _apply(self, name: str, context: Context | None) -> None:
        resource = self._runtime.resource
        if context is None:
            self._adapter.enter_context("", {}, {})
            return
        attributes = resource.attributes
        bounds = {key: request.bound(attributes[key]) for key, request in context.requires.items()}
        blocked = {
            p: f"not in context {name}" for p in resource.profiles if context.profiles and p not in context.profiles
        }
        self._adapter.enter_context(name, bounds, blocked)

    def _publish(self) -> None:
        if not self._closed:
            self._runtime.publish_text(TOPIC, self._current)
            for part in self._runtime.parts:
                part.changed()

    def _spawn(self, work: Coroutine[Any, Any, None], name: str) -> asyncio.Task[None]:
        task = self._loop.create_task(work, name=name)
        self._work.add(task)
        task.add_done_callback(self._work.discard)
        return task


class _TopicField:
    """A field of a topic that rules refer to."""

    def __init__(self, reference: Reference) -> None:
        self._reference = reference
        self._fields: tuple[str, ...] = ()
        self._raw: bytes | None = None
        self._value: Scalar | None = None
        """The value read from ``_raw``, kept because several evaluations may read one message."""
        self.topic = ""
        """Global name of the topic; empty until it is found."""
        self.problem = ""
        """Why the field cannot be read from the topic's messages; empty if it can."""

    def find(self, published: set[str]) -> bool:
        """Find the topic among the published ones; false if none of the candidates is published."""
        for topic, fields in self._reference.candidates():
            if topic in published:
                self.topic, self._fields = topic, fields
                return True
        return False

    def read(self, kind: MessageType, raw: bytes) -> Scalar | None:
        """The field's value in a serialized message; ``None`` if it does not exist or is no scalar."""
        if raw is not self._raw:
            self._raw, self._value = raw, self._read(kind, raw)
        return self._value

    def _read(self, kind: MessageType, raw: bytes) -> Scalar | None:
        fields = self._fields
        if not fields and len(kind.fields) == 1:
            fields = (kind.fields[0].name,)
        try:
            value: Any = kind.deserialize(raw)
            for name in fields:
                value = getattr(value, name)
        except AttributeError:
            has = ", ".join(field.name for field in kind.fields)
            return self._fail(f"{kind.name} has no {'.'.join(fields)}; it has {has}")
        except RmpaError as error:
            return self._fail(str(error))
        if hasattr(value, "nanosec"):
            return float(value.sec + value.nanosec / 1e9)
        if isinstance(value, bool | int | float | str):
            self.problem = ""
            return value
        return self._fail("it is no number, text or truth; name a field of it")

    def _fail(self, why: str) -> Scalar | None:
        problem = f"{self._reference.text}: {why}"
        if problem != self.problem:
            _log.warning("! rule over %s", problem)
        self.problem = problem
        return None
