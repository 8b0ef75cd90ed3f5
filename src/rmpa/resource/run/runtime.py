"""The runtime of one resource: its node, its topics, and the events that its parts receive (``RuntimePart``)."""

from __future__ import annotations

import asyncio
import contextlib
import functools
import logging
import threading
import time
from collections import Counter, deque
from contextvars import ContextVar
from typing import TYPE_CHECKING, Any, Final

import msgspec

from rmpa.core.errors import RmpaError
from rmpa.resource import limits
from rmpa.resource.run.descriptor import TOPIC, describe, topic_of
from rmpa.ros.types.definitions import ARRAY_TYPE, DiagnosticLevel, DiagnosticStatus, frame_array
from rmpa.ros.types.messages import HeaderNumbers, MessageError, MessageType
from rmpa.ros.wire.tcpros import LENGTH, printable
from rmpa.runtime.accept import in_thread

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Mapping, Sequence

    from rmpa.resource.declare.attributes import Value
    from rmpa.resource.declare.parameters import DeclaredProfile, Input, Output, Parameter
    from rmpa.resource.declare.resource import Resource
    from rmpa.ros.node.endpoints import Publisher, Received, Subscriber
    from rmpa.ros.node.node import Node

_log = logging.getLogger(__name__)
_CLOSED: Final = "life cycle"
CALLER: ContextVar[str] = ContextVar("caller", default="")
"""``profile`` or ``context`` in such a function and in the coroutines, tasks and ``asyncio.to_thread`` calls that it
begins; else empty."""


class RuntimePart:
    """Base of the parts of a running resource. The callbacks do nothing here; all are called in the event loop."""

    async def start(self) -> None:
        """Start the part: the node is registered and the outputs are advertised; tasks do not run yet."""

    async def close(self) -> None:
        """End the part: the resource ends; the node is still registered."""

    def published(self, output: Output, raw: bytes, now_ns: int) -> None:
        """An output has sent a message."""

    def received(self, item: Input, message: Received) -> None:
        """An input has received a message."""

    def observed(self, attribute: str, value: Value) -> None:
        """The user's code has observed one of its attributes."""

    def parameter_changed(self, parameter: Parameter) -> None:
        """A parameter's value has changed."""

    def window_ended(self, level: DiagnosticLevel, message: str, measured: Mapping[str, Value]) -> None:
        """A quality window has ended.

        Args:
            level: The resource's health.
            message: The health as a text.
            measured: Measured values by attribute.
        """

    def changed(self) -> None:
        """The requirements, the profile, its cool-downs, the context or a choice by hand may have changed."""


class Runtime:
    """Runs one resource on a node: connects its declaration, its topics and its parts.

    Args:
        resource: The resource, completely declared.
        node: The resource's node, with the resource's name; not yet entered.
    """

    def __init__(self, resource: Resource, node: Node) -> None:
        self.resource = resource
        self.node = node
        self.descriptor = describe(resource, node.name)
        self.parts: list[RuntimePart] = []
        self.context_outputs: frozenset[str] | None = None
        """The only outputs that are published in the present context; ``None``: all."""
        self._publishers: dict[str, Publisher] = {}
        self._subscribers: dict[str, Subscriber] = {}
        self._texts: dict[str, tuple[Publisher, str | None]] = {}
        self._held: deque[tuple[Output, bytes, str]] = deque()
        self._held_bytes = 0
        self._holders: set[str] = set()
        self._open = True
        self._refused: Counter[str] = Counter()
        """Number of messages refused since the outputs were closed, by output."""
        self._unusable: set[tuple[str, str]] = set()
        """Pairs of an input and a publisher whose message definition cannot be used; each is logged once."""
        self._loop: asyncio.AbstractEventLoop | None = None
        self._thread = 0
        self._undo = contextlib.AsyncExitStack()

    async def start(self, parts: Iterable[RuntimePart] = ()) -> None:
        """Register the node, its outputs and inputs, and start the parts in the given order.

        Raises:
            UnreachableError: The master does not answer.
            PeerRefused: The master refuses a registration.
        """
        self.parts = list(parts)
        self._loop, self._thread = asyncio.get_running_loop(), threading.get_ident()
        async with contextlib.AsyncExitStack() as undo:
            await undo.enter_async_context(self.node)
            for output in self.resource.outputs.values():
                topic = topic_of(output.name, self.node.name)
                self._publishers[output.name] = await self.node.advertise(topic, output.type, latch=output.latch)
                output.on_publish = functools.partial(self._publish, output, HeaderNumbers(output.type))
                undo.callback(setattr, output, "on_publish", None)
            for declared in self.resource.declared_attributes.values():
                declared.on_observation = functools.partial(self.call_in_loop, self._observed)
                undo.callback(setattr, declared, "on_observation", None)
            for parameter in self.resource.parameters.values():
                parameter.on_change = functools.partial(self.call_in_loop, self._parameter_changed)
                undo.callback(setattr, parameter, "on_change", None)
            await self.advertise_text(TOPIC, self.descriptor.serialize())
            for item in self.resource.inputs.values():
                await self._subscribe(item)
            for part in self.parts:
                await part.start()
                undo.push_async_callback(part.close)
            self._undo = undo.pop_all()

    async def close(self) -> None:
        """Close the parts in reverse order of their start, then the node."""
        await self._undo.aclose()

    async def advertise_text(self, name: str, text: str) -> None:
        """Publish a text on a latched topic ``std_msgs/String`` below the node; advertises it if necessary."""
        if name not in self._texts:
            publisher = await self.node.advertise(
                f"{self.node.name}/{name}", MessageType("std_msgs/String"), latch=True
            )
            self._texts[name] = (publisher, None)
        self.publish_text(name, text)

    def publish_text(self, name: str, text: str) -> None:
        """Publish a text on a topic that ``advertise_text`` has advertised, if it differs from the last text."""
        publisher, before = self._texts[name]
        if text != before:
            self._texts[name] = (publisher, text)
            publisher.publish(data=text)

    def publish_descriptor(self) -> None:
        """Publish the descriptor again after the declaration has changed."""
        self.descriptor = describe(self.resource, self.node.name)
        self.publish_text(TOPIC, self.descriptor.serialize())

    def publishers_of(self, item: Input) -> int:
        """The number of publishers of an input's topic, in this module and others."""
        subscriber = self._subscribers.get(item.name)
        return subscriber.publishers if subscriber is not None else 0

    def hold(self, holder: str = "profile") -> None:
        """Queue messages from now on, so that no output mixes messages of two profiles or two contexts.

        Args:
            holder: The kind of change: ``profile``, ``context`` or the life cycle. The queue is sent when no holder
                is left.
        """
        if not self._open:
            self._retain({"profile", "context"} - {holder})  # the previous change's messages are outdated
        self._holders.add(holder)

    def release(self, holder: str = "profile", *, drop: bool = False) -> None:
        """End a ``hold``; without another holder the queued messages are sent in order.

        Args:
            holder: As given to ``hold``.
            drop: Drop the queued messages instead: they belong to a profile that was not applied.
        """
        self._holders.discard(holder)
        if drop or not self._holders:
            held, self._held, self._held_bytes = self._held, deque(), 0
            for output, raw, _ in held if not drop else ():
                self._send(output, raw)

    def open_outputs(self) -> None:
        """Send messages from now on; first those that functions of profiles and contexts published while closed."""
        self._open = True
        for name, count in self._refused.items():
            _log.info("= %s: %s flows again; %d messages were refused", self.node.name, name, count)
        self._refused.clear()
        self.release(_CLOSED)

    def close_outputs(self) -> None:
        """Refuse messages from now on; the first refusal of each output is logged.

        Messages of the function of the last profile and of the last context are queued instead: they describe the
        state that the resource has when the outputs open again.
        """
        self._open = False
        self.hold(_CLOSED)

    def call_in_loop(self, function: Callable[..., object], *args: Any) -> None:
        """Call a function in the event loop: at once if called in the loop's thread, else as soon as the loop can."""
        if threading.get_ident() == self._thread:
            function(*args)
        elif self._loop is not None:
            with contextlib.suppress(RuntimeError):  # the loop has ended
                self._loop.call_soon_threadsafe(function, *args)

    # --- inside -------------------------------------------------------------------------------------------------

    async def _subscribe(self, item: Input) -> None:
        topic = topic_of(item.name, self.node.name)

        def received(message: Received) -> None:
            for part in self.parts:
                part.received(item, message)

        def learnt(message: Received) -> None:
            if self._learn(item, message):
                received(message)

        if item.kind.known is not None:
            self._subscribers[item.name] = await self.node.subscribe(topic, item.kind.known, received)
            return
        text = "is not known here; a publisher of"
        _log.info(
            "= %s: the type of input %s, %s, %s %s tells it", self.node.name, item.name, item.kind.name, text, topic
        )
        self._subscribers[item.name] = await self.node.subscribe(topic, item.kind.name, learnt)

    def _learn(self, item: Input, message: Received) -> bool:
        """Take the type of an input from its publisher's header; false if the definition there cannot be used."""
        caller = printable(message.caller_id)
        try:
            kind = message.kind
        except RmpaError as error:
            if (item.name, caller) not in self._unusable:
                self._unusable.add((item.name, caller))
                text = "its messages are dropped; this is said once"
                _log.warning("! %s: input %s from %s: %s; %s", self.node.name, item.name, caller, error, text)
            return False
        if item.kind.known is None:
            item.kind.known = kind
            _log.info("= %s: %s is learnt from %s", self.node.name, item.kind.name, caller)
        return True

    def send(self, output: Output, raw: bytes, caller: str = "") -> None:
        """Send one message, or queue it while a profile or context is being applied.

        Args:
            output: The output that publishes the message.
            raw: The serialized message.
            caller: ``profile`` or ``context`` if such a function publishes; see ``CALLER``.
        """
        if not self._open and not caller:
            self._refuse(output)
            return
        if self._holders:
            self._held.append((output, raw, caller))
            self._held_bytes += len(raw)
            while self._held_bytes > limits.RESOURCE_HELD_MAX and len(self._held) > 1:
                self._held_bytes -= len(self._held.popleft()[1])  # drop-oldest
        else:
            self._send(output, raw)

    def _send(self, output: Output, raw: bytes) -> None:
        publisher = self._publishers.get(output.name)
        if publisher is None or (self.context_outputs is not None and output.name not in self.context_outputs):
            return
        publisher.publish_raw(raw)
        now_ns = time.time_ns()
        for part in self.parts:
            part.published(output, raw, now_ns)

    def _retain(self, kinds: set[str]) -> None:
        """Drop the queued messages except those of functions of these kinds (``profile``, ``context``)."""
        self._held = deque(held for held in self._held if held[2] in kinds)
        self._held_bytes = sum(len(raw) for _, raw, _ in self._held)

    def _refuse(self, output: Output) -> None:
        self._refused[output.name] += 1
        if self._refused[output.name] == 1:
            text = "is refused while the resource is not active; this is said once"
            _log.warning("! %s: what is published on %s %s", self.node.name, output.name, text)

    def _observed(self, attribute: str, value: Value) -> None:
        for part in self.parts:
            part.observed(attribute, value)

    def _parameter_changed(self, parameter: Parameter) -> None:
        for part in self.parts:
            part.parameter_changed(parameter)

    def _publish(
        self, output: Output, numbers: HeaderNumbers, values: Mapping[str, Any], message: object | None
    ) -> None:
        """Serialize a message in the caller's thread, so that the caller gets the errors, and send it in the loop."""
        kind = output.type
        try:
            payload = kind.serialize(kind.given(message, values))
        except MessageError as error:
            raise MessageError(f"{output.name}: {error}") from None
        self.call_in_loop(self.send, output, bytes(numbers.stamp(payload)), CALLER.get())


# Evaluates the preconditions of profiles (``needs=``), each in a thread of its own, because they may block.


class Preconditions:
    """The preconditions of one resource.

    Args:
        profiles: The declared profiles, by name.
    """

    def __init__(self, profiles: Mapping[str, DeclaredProfile]) -> None:
        self._needs = {name: one.needs for name, one in profiles.items() if one.needs is not None}
        self._calls: dict[str, asyncio.Task[str | bool | None]] = {}
        """The call under way, by profile."""

    async def check(self) -> dict[str, str]:
        """Call all preconditions, except those whose last call has not returned; at most one check at a time.

        Returns:
            The profiles that must not run, with the reason, after ``limits.PRECONDITION_TIMEOUT`` seconds at most.
        """
        for name, needs in self._needs.items():
            if name not in self._calls:
                self._calls[name] = asyncio.create_task(in_thread(needs, f"needs of {name}"), name=f"needs of {name}")
        if not self._calls:
            return {}
        done, _ = await asyncio.wait(self._calls.values(), timeout=limits.PRECONDITION_TIMEOUT)
        found = {}
        for name, call in list(self._calls.items()):
            why: str | bool | None = f"its precondition has not answered for {limits.PRECONDITION_TIMEOUT:g} s"
            if call in done:
                del self._calls[name]
                error = call.exception()
                why = f"its precondition failed: {type(error).__name__}: {error}" if error else call.result()
            if why is False:
                why = "its precondition does not hold"
            if why and isinstance(why, str):
                found[name] = why
        return found

    async def close(self) -> None:
        """Stop waiting for calls; threads that hang are left behind."""
        for call in self._calls.values():
            call.cancel()
        await asyncio.gather(*self._calls.values(), return_exceptions=True)


# Publishes the reports of a resource: quality, diagnostics, alarms, responses, profile and decision.


LEVEL_FOR: Final = "level_for"
"""The value of ``quality`` that has how long its level has stood: an age, since the clocks of modules differ."""
_LATCHED: Final = {"quality": False, "alarms": False, "responses": True}


class StatusPublisher:
    """The report topics of one resource (``docs/smart-resources.md`` lists them).

    Args:
        runtime: The runtime of the resource.
    """

    def __init__(self, runtime: Runtime) -> None:
        self._runtime = runtime
        self._name = runtime.resource.name
        self.publishers: dict[str, Publisher] = {}
        self._responses: list[bytes] | None = None
        self._level: tuple[DiagnosticLevel, float] | None = None
        """The level of ``quality``, and since when, in monotonic seconds."""

    async def start(self) -> None:
        """Advertise the topics."""
        node = self._runtime.node
        for name, latch in _LATCHED.items():
            topic = f"{node.name}/{name}"
            self.publishers[name] = await node.advertise(topic, MessageType(ARRAY_TYPE), latch=latch)
        self.publishers["diagnostics"] = await node.advertise("/diagnostics", MessageType(ARRAY_TYPE))
        for name in ("profile", "decision"):
            await self._runtime.advertise_text(name, "")

    def close(self) -> None:
        """Stop publishing; later reports of quality, alarms and responses are dropped."""
        self.publishers.clear()

    def quality(self, level: DiagnosticLevel, message: str, values: Mapping[str, str]) -> None:
        """Publish the quality of a window, also on ``/diagnostics``, with how long it has had this level."""
        now = time.monotonic()
        if self._level is None or self._level[0] != level:
            self._level = level, now
        lasting = {LEVEL_FOR: f"{now - self._level[1]:.1f} s"}
        status = [DiagnosticStatus(level, self._name, message, self._name, {**values, **lasting})]
        self._publish("quality", status)
        self._publish("diagnostics", status)

    def alarm(self, level: DiagnosticLevel, message: str, values: Mapping[str, str]) -> None:
        """Publish an alarm."""
        self._publish("alarms", [DiagnosticStatus(level, self._name, message, self._name, values)])

    def responses(self, statuses: Sequence[DiagnosticStatus]) -> None:
        """Publish the responses to all clients, if they differ from the last ones."""
        serialized = [status.serialize() for status in statuses]
        if serialized != self._responses and "responses" in self.publishers:
            self._responses = serialized
            self._publish("responses", statuses)

    def decision(self, profile: str, decision: Mapping[str, Any]) -> None:
        """Publish the profile that runs and the decision (see ``decision_report``), each if it has changed."""
        self._runtime.publish_text("profile", profile)
        self._runtime.publish_text("decision", msgspec.json.encode(decision).decode())

    def _publish(self, topic: str, statuses: Sequence[DiagnosticStatus]) -> None:
        if (publisher := self.publishers.get(topic)) is not None:
            array = frame_array(0, time.time_ns(), [status.serialize() for status in statuses])[LENGTH.size :]
            publisher.publish_raw(publisher.numbers.stamp(array) if publisher.numbers is not None else array)
