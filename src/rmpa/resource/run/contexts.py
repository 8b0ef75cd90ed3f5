"""Brings a resource into its contexts: chosen by hand (a topic, the configuration), or by their rules.

A switch is atomic. No task runs and nothing leaves from the moment at which it begins until the context's function
has ended, its outputs flow, its requirements count, and the profile that follows from them is applied.
"""

from __future__ import annotations

import asyncio
import logging
from typing import TYPE_CHECKING, Any, Final

from rmpa.config.values import did_you_mean
from rmpa.core.errors import ConfigError, PeerRefused, RmpaError
from rmpa.resource import limits
from rmpa.resource.declare.context_rules import Chooser, parse_rule
from rmpa.resource.run.descriptor import topic_of
from rmpa.resource.run.fenced_call import Call
from rmpa.resource.run.runtime import RuntimePart
from rmpa.ros.types.messages import MessageType
from rmpa.ros.wire.tcpros import printable

if TYPE_CHECKING:
    from collections.abc import Callable, Coroutine

    from rmpa.resource.declare.context_rules import Reference, Scalar
    from rmpa.resource.declare.resource import Context, Input, Output, Parameter
    from rmpa.resource.run.adapter import Adapter
    from rmpa.resource.run.runtime import Runtime
    from rmpa.resource.run.tasks import Tasks
    from rmpa.ros.node.topics import Received, Subscriber

_log = logging.getLogger(__name__)
TOPIC: Final = "context"
_WHO: Final = "context"
_SOON: Final = 0.02
"""Seconds from a message until the rules look at it: those that come meanwhile cost nothing."""
_LOOK: Final = 0.25
"""Seconds between looks at rules without news: a dwell time is over, a publisher is gone."""


class Contexts(RuntimePart):
    """The contexts of one resource; to be started behind the adapter.

    Args:
        runtime: Of the resource.
        tasks: Paused during a switch.
        adapter: Takes what a context requires.
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
        self._chooser = Chooser(rules)
        self._sources = {
            reference.text: _Source(reference)
            for rule in rules.values()
            for reference in rule.references
            if not reference.parameter
        }
        self._parameters = {r.text: r.parameter for rule in rules.values() for r in rule.references if r.parameter}
        self._subscribers: dict[str, Subscriber] = {}
        self._taps: dict[str, str] = {}
        """By input or output: its topic, if a rule names it."""
        self._latest: dict[str, tuple[MessageType, bytes]] = {}
        self._current = ""
        self._retry = 0.0
        self._one = asyncio.Lock()
        self._work: set[asyncio.Task[None]] = set()
        self._switching: asyncio.Task[None] | None = None
        self._timers: dict[str, asyncio.TimerHandle] = {}
        self._closed = True
        """Before the start, and after the end."""
        self.listeners: list[Callable[[], None]] = []
        """Called when there is another context, or another choice by hand."""

    @property
    def current(self) -> str:
        """The present context, or empty."""
        return self._current

    @property
    def chosen(self) -> str:
        """The one chosen by hand; empty: the rules decide. May be set before the start."""
        return self._chooser.chosen

    @chosen.setter
    def chosen(self, name: str) -> None:
        self._chooser.chosen = name

    @property
    def problems(self) -> list[str]:
        """What is wrong with the fields that rules name."""
        return [source.problem for source in self._sources.values() if source.problem]

    async def start(self) -> None:
        """Hear what is chosen, and look at the rules."""
        self._loop, self._closed = asyncio.get_running_loop(), False
        await self._runtime.say(TOPIC, "")
        node = self._runtime.node
        if self.chosen and self.chosen not in self._known:
            _log.warning("! %s: there is no context %s any more", node.name, printable(self.chosen))
            self.chosen = ""
        if not self._known:
            return
        await node.subscribe(f"{node.name}/set_context", MessageType("std_msgs/String"), self._heard)
        if self.chosen:
            try:
                await self._switch(self.chosen)
            except RmpaError as error:
                _log.warning("! %s: %s", node.name, error)
                self.chosen = ""
        if self._sources:
            self._do(self._find(), "find topics of rules")
        if self._chooser.rules:
            self._look()

    async def close(self) -> None:
        """Stay as it is."""
        self._closed = True
        for timer in self._timers.values():
            timer.cancel()
        for task in self._work:
            task.cancel()
        await asyncio.gather(*self._work, return_exceptions=True)

    async def choose(self, name: str) -> None:
        """Choose a context by hand; empty: the rules decide again.

        Raises:
            ConfigError: There is no such context; nothing has changed.
            PeerRefused: It could not begin; nothing has changed.
        """
        if name and name not in self._known:
            near = did_you_mean(name, self._known)
            remedy = f"did you mean {near}?" if near else f"it is one of {', '.join(self._known) or 'none'}"
            raise ConfigError(f"resource {self._runtime.resource.name}", f"no context {name[:80]!r}", remedy)
        before, self._chooser.chosen = self._chooser.chosen, name
        try:
            if name:
                await self._switch(name)
        except RmpaError:
            self._chooser.chosen = before
            raise
        if not name:
            self._chooser.since = self._retry = 0.0
            wanted = self._chooser.choose(self._current, self._values(), self._loop.time())
            await self._switch(wanted)
        self._told()

    # --- what rules look at -------------------------------------------------------------------------------------

    def received(self, item: Input, message: Received) -> None:
        """An input's topic may be a rule's too."""
        if item.name in self._taps:
            self._take(self._taps[item.name], message.kind, message.raw)

    def published(self, output: Output, raw: bytes, now_ns: int) -> None:  # noqa: ARG002 - as the others have it
        """An output's likewise."""
        if output.name in self._taps:
            self._take(self._taps[output.name], output.type, raw)

    def parameter_changed(self, parameter: Parameter) -> None:
        """A parameter's value may be a rule's."""
        if parameter.name in self._parameters.values():
            self._soon()

    def _take(self, topic: str, kind: MessageType, raw: bytes) -> None:
        self._latest[topic] = kind, raw
        self._soon()

    def _values(self) -> dict[str, Scalar]:
        parameters = self._runtime.resource.parameters
        found: dict[str, Scalar] = {text: parameters[name].value for text, name in self._parameters.items()}
        for text, source in self._sources.items():
            if (subscriber := self._subscribers.get(source.topic)) is not None and not subscriber.publishers:
                self._latest.pop(source.topic, None)  # nobody says so any more
            if (latest := self._latest.get(source.topic)) is not None and (value := source.read(*latest)) is not None:
                found[text] = value
        return found

    async def _find(self) -> None:
        """Find out which topics rules mean, until all are found."""
        node = self._runtime.node
        delay = limits.CONTEXT_LOOK
        while missing := [source for source in self._sources.values() if not source.topic]:
            try:
                published = {topic for topic, _ in await node.get_published_topics()}
                for source in missing:
                    if source.find(published):
                        await self._listen(source.topic)
            except RmpaError as error:
                _log.debug("! %s: topics of rules: %s", node.name, error)
            await asyncio.sleep(delay)
            delay = min(2 * delay, limits.CONTEXT_RETRY)

    async def _listen(self, topic: str) -> None:
        runtime = self._runtime
        own = [
            n
            for n in (*runtime.resource.inputs, *runtime.resource.outputs)
            if topic_of(n, runtime.node.name) == topic
        ]
        self._taps.update(dict.fromkeys(own, topic))
        if own or topic in self._subscribers:
            return  # it comes to us anyway

        def heard(message: Received) -> None:
            self._take(topic, message.kind, message.raw)

        self._subscribers[topic] = await runtime.node.subscribe(topic, callback=heard)

    # --- deciding -----------------------------------------------------------------------------------------------

    def _soon(self) -> None:
        if "soon" not in self._timers and not self._closed:
            self._timers["soon"] = self._loop.call_later(_SOON, self._now)

    def _now(self) -> None:
        self._timers.pop("soon", None)
        self._evaluate()

    def _look(self) -> None:
        if not self._closed:
            self._timers["look"] = self._loop.call_later(_LOOK, self._look)
            self._evaluate()

    def _evaluate(self) -> None:
        """Begin a switch if the rules want one."""
        now = self._loop.time()
        if self._one.locked() or now < self._retry or (self._switching and not self._switching.done()):
            return
        wanted = self._chooser.choose(self._current, self._values(), now)
        if wanted != self._current:
            self._switching = self._do(self._by_rule(wanted), "switch context")

    async def _by_rule(self, name: str) -> None:
        try:
            await self._switch(name)
        except RmpaError as error:
            _log.warning("! %s: %s", self._runtime.node.name, error)
            self._retry = self._loop.time() + limits.CONTEXT_RETRY

    def _heard(self, message: Received) -> None:
        """Somebody chooses a context by the topic."""
        self._do(self._by_topic(str(message.message.data), message.caller_id), "choose context")

    async def _by_topic(self, name: str, client: str) -> None:
        try:
            await self.choose(name)
        except RmpaError as error:
            self._adapter.refuse(client, printable(str(error)))

    # --- switching ----------------------------------------------------------------------------------------------

    async def _switch(self, name: str) -> None:
        """Bring the resource into a context.

        Raises:
            PeerRefused: Its function failed; the resource stays as it was.
        """
        async with self._one:
            if name == self._current or self._closed:
                return
            runtime, context = self._runtime, self._known.get(name)
            await self._tasks.pause(_WHO)
            runtime.hold(_WHO)
            try:
                if context is not None:
                    await self._enter(context)
                outputs = context.outputs if context is not None else None
                runtime.flowing = frozenset(outputs) if outputs is not None else None
                self._shift(name, context)
                self._current = name
                self._chooser.since = self._loop.time()
                await self._adapter.settled()
            finally:
                runtime.release(_WHO)
                self._tasks.resume(_WHO)
            _log.info("= %s: %s", runtime.node.name, f"context {name}" if name else "no context any more")
        self._told()

    async def _enter(self, context: Context) -> None:
        """Call a context's function."""
        if context.enter is None:
            return
        timeout, call = limits.CONTEXT_ENTER_TIMEOUT, Call("context", context.name, self._stopped)
        limit = asyncio.timeout(timeout)
        try:
            async with limit:
                await call.run(context.enter)
        except Exception as error:
            call.give_up()  # also where it has raised: a coroutine that it began may go on
            why = f"{type(error).__name__}: {error}"
            if isinstance(error, TimeoutError) and limit.expired():
                why = f"its function has not ended after {timeout:g} s"
            raise PeerRefused(f"context {context.name}", why) from error

    def _stopped(self, call: Call, what: str) -> None:
        """A function that was given up wanted to do something; called in any thread."""
        if what not in call.said:
            call.said.add(what)
            text = f"the function of context {call.name} was given up; it has no effect: {what}"
            self._runtime.call_in_loop(self._adapter.late, call.name, text)

    def _shift(self, name: str, context: Context | None) -> None:
        resource = self._runtime.resource
        if context is None:
            self._adapter.shift("", {}, {})
            return
        attributes = resource.attributes
        bounds = {key: wish.bound(attributes[key]) for key, wish in context.requires.items()}
        bars = {
            p: f"not in context {name}" for p in resource.profiles if context.profiles and p not in context.profiles
        }
        self._adapter.shift(name, bounds, bars)

    def _told(self) -> None:
        if not self._closed:
            self._runtime.say_again(TOPIC, self._current)
            for listener in self.listeners:
                listener()

    def _do(self, work: Coroutine[Any, Any, None], name: str) -> asyncio.Task[None]:
        task = self._loop.create_task(work, name=name)
        self._work.add(task)
        task.add_done_callback(self._work.discard)
        return task


class _Source:
    """Where a field of a topic comes from."""

    def __init__(self, reference: Reference) -> None:
        self._reference = reference
        self._fields: tuple[str, ...] = ()
        self._raw: bytes | None = None
        self._value: Scalar | None = None
        """Of the message that was read last: rules are looked at more often than some topics speak."""
        self.topic = ""
        """Empty until it is found."""
        self.problem = ""
        """Why the topic's messages have no such value, or empty."""

    def find(self, published: set[str]) -> bool:
        """See which topic is meant."""
        for topic, fields in self._reference.candidates():
            if topic in published:
                self.topic, self._fields = topic, fields
                return True
        return False

    def read(self, kind: MessageType, raw: bytes) -> Scalar | None:
        """The field of a message; ``None`` if it has none that a rule can look at."""
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
            return self._without(f"{kind.name} has no {'.'.join(fields)}; it has {has}")
        except RmpaError as error:
            return self._without(str(error))
        if hasattr(value, "nanosec"):
            return float(value.sec + value.nanosec / 1e9)
        if isinstance(value, bool | int | float | str):
            self.problem = ""
            return value
        return self._without("it is no number, text or truth; name a field of it")

    def _without(self, why: str) -> Scalar | None:
        problem = f"{self._reference.text}: {why}"
        if problem != self.problem:
            _log.warning("! rule over %s", problem)
        self.problem = problem
        return None
