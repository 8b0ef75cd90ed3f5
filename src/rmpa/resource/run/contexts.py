"""Switches a resource between its contexts, and keeps its state in a file.

Switches a resource between its contexts: by hand (a topic, the configuration) or by the contexts' rules.

A switch is atomic: no task runs and no message is sent until the context's function has ended, the context's outputs
and requirements are in force, and the resulting profile has been applied.
"""

from __future__ import annotations

import asyncio
import fcntl
import functools
import logging
import os
import time
from typing import TYPE_CHECKING, Any, Final

import msgspec

from rmpa.config.values import did_you_mean
from rmpa.core.errors import ConfigError, PeerRefused, RmpaError
from rmpa.resource import limits
from rmpa.resource.decide.reports import SavedCoolDown, SavedState
from rmpa.resource.declare.attributes import ContextSelector, parse_rule
from rmpa.resource.run.adapter import HungError, call_function
from rmpa.resource.run.descriptor import topic_of
from rmpa.resource.run.runtime import RuntimePart
from rmpa.ros.types.messages import MessageType
from rmpa.ros.wire.tcpros import printable
from rmpa.runtime.accept import in_thread
from rmpa.runtime.loop import MachineTimer

if TYPE_CHECKING:
    from collections.abc import Coroutine
    from pathlib import Path

    from rmpa.resource.declare.attributes import Reference, Scalar
    from rmpa.resource.declare.parameters import Context, Input, Output, Parameter
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


# Keeps the state of a resource in a small file, which is replaced as a whole, and restores it at the start.


class Persistence(RuntimePart):
    """The part of a resource that keeps its state.

    No method blocks the event loop, and no failure of the disk stops the resource: it is logged once (``problem``),
    and writing is tried again.

    Args:
        runtime: The runtime of the resource.
        adapter: Provides the requirements, the cool-downs and the profiles to store.
        contexts: Provides the context chosen by hand.
        path: The file; created with its folders if it does not exist.
    """

    def __init__(self, runtime: Runtime, adapter: Adapter, contexts: Contexts, path: Path) -> None:
        self._runtime = runtime
        self._adapter = adapter
        self._contexts = contexts
        self._path = path
        self._lock: int | None = None
        self._started = False
        self._last = ""
        self._written: SavedState | None = None
        """The state that was written last, with times of the monotonic clock."""
        self._writing: asyncio.Task[None] | None = None
        self.problem = ""
        """Why nothing can be stored at present; empty if storing works."""

    async def restore(self) -> SavedState:
        """Read the file, restore the parameters and return the saved state; called before the parts start."""
        resource, name = self._runtime.resource, self._runtime.node.name
        found, lost = SavedState(), list[str]()
        try:
            async with asyncio.timeout(limits.STORE_TIMEOUT):
                found, lost = (await in_thread(self._read, f"read {self._path}")).checked(resource, time.time_ns())
        except OSError as error:
            self._set_problem(str(error) or "it does not answer")
        for text in lost:
            _log.warning("! %s: not remembered: %s", name, text)
        for key, value in found.parameters.items():
            if not resource.parameters[key].given:
                resource.parameters[key].value = value
        if found.parameters or found.chosen or found.requirements:
            chosen = f", profile {found.chosen} chosen by hand" if found.chosen else ""
            counts = len(found.parameters), len(found.requirements)
            _log.info("= %s: remembered: %d parameters, %d clients%s", name, *counts, chosen)
        self._last = found.last
        return found

    async def start(self) -> None:
        """Write the present state, and each change from now on."""
        self._started = True
        self.changed()

    async def close(self) -> None:
        """Write the last state; a disk that hangs is waited for 5 s at most."""
        if self._writing is not None:
            await asyncio.wait([self._writing], timeout=limits.STORE_TIMEOUT)
        if self._started:
            self._started = False
            await asyncio.wait([asyncio.create_task(self._write())], timeout=limits.STORE_TIMEOUT)
        if self._lock is not None:
            os.close(self._lock)
            self._lock = None

    def parameter_changed(self, parameter: Parameter) -> None:  # noqa: ARG002
        """Write the parameter's value."""
        self.changed()

    def changed(self) -> None:
        """Write the state if it has changed; called with each window too, so a write that failed is tried again."""
        idle = self._writing is None or self._writing.done()
        if self._started and idle and self._state(0.0, 0) != self._written:
            self._writing = asyncio.create_task(self._write(), name=f"write {self._path}")

    # --- inside -------------------------------------------------------------------------------------------------

    def _state(self, now: float, now_ns: int) -> SavedState:
        """The present state.

        Args:
            now: Monotonic seconds.
            now_ns: The same moment by the clock of the result, in nanoseconds.
        """
        loop = self._adapter.loop
        self._last = loop.profile or self._last
        cooling = loop.cooling(asyncio.get_running_loop().time())
        return SavedState(
            parameters={n: p.value for n, p in self._runtime.resource.parameters.items() if p.value != p.default},
            chosen=loop.pinned,
            last=self._last,
            context=self._contexts.chosen,
            requirements=tuple(self._adapter.clients.save(loop.requirements, now, now_ns)),
            cool_downs={
                name: SavedCoolDown(
                    until_ns=now_ns + round((one.until - now) * 1e9), cool_down=one.cool_down, why=one.why
                )
                for name, one in cooling.items()
            },
        )

    async def _write(self) -> None:
        state = self._state(0.0, 0)
        content = msgspec.json.encode(self._state(asyncio.get_running_loop().time(), time.time_ns()))
        try:
            await in_thread(functools.partial(self._replace, content), f"write {self._path}")
        except OSError as error:
            self._set_problem(str(error))
        else:
            self._written = state
            self._set_problem("")

    def _read(self) -> SavedState:
        """The content of the file; a damaged one is set aside.

        Raises:
            OSError: It cannot be read, or another process uses it.
        """
        self._take_lock()
        try:
            return msgspec.json.decode(self._path.read_bytes(), type=SavedState)
        except FileNotFoundError:
            return SavedState()
        except (msgspec.DecodeError, RecursionError) as error:
            aside = self._path.with_name(f"{self._path.name}.damaged")
            self._path.replace(aside)
            _log.warning("! %s is damaged (%s); it is set aside as %s and begun anew", self._path, error, aside.name)
            return SavedState()

    def _replace(self, content: bytes) -> None:
        """Replace the file, so that a crash at any moment leaves the old one or the new one.

        Raises:
            OSError: It cannot be written, or another process uses it.
        """
        self._take_lock()
        new = self._path.with_name(f"{self._path.name}.new")
        with new.open("wb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        new.replace(self._path)

    def _take_lock(self) -> None:
        """Lock the file against a second process: another module of the same name may run the same resource here.

        Raises:
            OSError: Another process holds the lock, or the folder cannot be written.
        """
        self._path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        if self._lock is not None:
            return
        lock = os.open(self._path.with_suffix(".lock"), os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            os.close(lock)
            if isinstance(error, BlockingIOError):
                raise OSError("another process uses it; name this module otherwise, or set --state") from None
            raise
        self._lock = lock

    def _set_problem(self, problem: str) -> None:
        """Log a problem when it begins and when it is over."""
        if problem and not self.problem:
            _log.warning("! %s: nothing is kept: %s", self._path, problem)
        elif self.problem and not problem:
            _log.info("= %s: everything is kept again", self._path)
        self.problem = f"nothing is kept: {problem}" if problem else ""
