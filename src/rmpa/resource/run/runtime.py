"""The runtime of one resource: its node and topics, and the events that its parts receive (``RuntimePart``)."""

from __future__ import annotations

import asyncio
import contextlib
import functools
import itertools
import logging
import threading
import time
from collections import Counter, deque
from typing import TYPE_CHECKING, Any, Final

from rmpa.core.errors import LocalProtocolError, RmpaError
from rmpa.core.serial_number import SERIAL_MASK
from rmpa.resource import limits
from rmpa.resource.declare.fence import current_fence
from rmpa.resource.run.descriptor import TOPIC, describe, topic_of
from rmpa.ros.types.messages import MessageError, MessageType
from rmpa.ros.wire.tcpros import printable

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Mapping

    from rmpa.resource.decide.actions import Action
    from rmpa.resource.declare.attributes import Value
    from rmpa.resource.declare.connections import Input, Output
    from rmpa.resource.declare.fence import Fence
    from rmpa.resource.declare.parameters import Parameter
    from rmpa.resource.declare.resource import Resource
    from rmpa.ros.node.node import Node
    from rmpa.ros.node.topics import Publisher, Received, Subscriber
    from rmpa.ros.types.diagnostic_array import DiagnosticLevel

_log = logging.getLogger(__name__)
_CLOSED: Final = "life cycle"


class RuntimePart:
    """A part of a running resource: its callbacks, which do nothing here. All are called in the event loop."""

    async def start(self) -> None:
        """The node is registered and the outputs are advertised; tasks do not run yet."""

    async def close(self) -> None:
        """The resource ends; the node is still registered."""

    def published(self, output: Output, raw: bytes, now_ns: int) -> None:
        """An output has sent a message."""

    def received(self, item: Input, message: Received) -> None:
        """An input has received a message."""

    def observed(self, attribute: str, value: Value) -> None:
        """The user's code has observed one of its attributes."""

    def parameter_changed(self, parameter: Parameter) -> None:
        """A parameter has another value."""

    def acted(self, action: Action) -> None:
        """The control loop has acted: applied a profile, raised or cleared an alarm."""

    def window_ended(self, level: DiagnosticLevel, message: str, measured: Mapping[str, Value]) -> None:
        """A quality window has ended: the resource's health, and the measured values by attribute."""

    def requirements_changed(self) -> None:
        """The requirements, the profile or its cool-downs may have changed."""

    def missing_changed(self, text: str, *, missing: bool) -> None:
        """Something that the resource needs is missing, or is back."""

    def late_action(self, text: str) -> None:
        """A function that was given up has ended, or attempted an action."""

    def context_changed(self) -> None:
        """Another context is active, or was chosen by hand."""

    def descriptor_received(self, resource: str, message: Received) -> None:
        """A resource that this one requests something of has published its descriptor."""


class Runtime:
    """Runs one resource on a node: connects its declaration, its topics and its parts.

    Args:
        resource: Declared completely.
        node: Named as the resource; not yet entered.
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
        self._held: deque[tuple[Output, bytes, Fence | None]] = deque()
        self._held_bytes = 0
        self._holders: set[str] = set()
        self._open = True
        self._refused: Counter[str] = Counter()
        """By output: messages that were refused since the outputs were closed."""
        self._unusable: set[tuple[str, str]] = set()
        """Inputs and publishers whose message definition cannot be used."""
        self._loop: asyncio.AbstractEventLoop | None = None
        self._thread = 0
        self._undo = contextlib.AsyncExitStack()

    async def start(self, parts: Iterable[RuntimePart] = ()) -> None:
        """Register the node, its outputs and inputs, and start the parts in order.

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
                output.on_publish = functools.partial(self._publish, output, itertools.count(1))
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
        """End the parts, the last one first, then the node."""
        await self._undo.aclose()

    async def advertise_text(self, name: str, text: str) -> None:
        """Advertise a latched topic ``std_msgs/String`` below the node, unless it is, and publish a text."""
        if name not in self._texts:
            publisher = await self.node.advertise(
                f"{self.node.name}/{name}", MessageType("std_msgs/String"), latch=True
            )
            self._texts[name] = (publisher, None)
        self.publish_text(name, text)

    def publish_text(self, name: str, text: str) -> None:
        """Publish a text on a topic of ``advertise_text``, if it differs from the last one."""
        publisher, before = self._texts[name]
        if text != before:
            self._texts[name] = (publisher, text)
            publisher.publish(publisher.make({"data": text}))

    def publish_descriptor(self) -> None:
        """Publish the descriptor anew, because the declaration has changed."""
        self.descriptor = describe(self.resource, self.node.name)
        self.publish_text(TOPIC, self.descriptor.serialize())

    def publishers_of(self, item: Input) -> int:
        """The number of publishers of an input's topic, here or in other modules."""
        subscriber = self._subscribers.get(item.name)
        return subscriber.publishers if subscriber is not None else 0

    def hold(self, holder: str = "profile") -> None:
        """Queue messages from now on, so that no output mixes two profiles or two contexts.

        Args:
            holder: The kind of change: ``profile`` or ``context``; messages are sent when the last one is complete.
        """
        if not self._open:
            self._retain({"profile", "context"} - {holder})  # the messages of the previous one are outdated
        self._holders.add(holder)

    def release(self, holder: str = "profile", *, drop: bool = False) -> None:
        """Send the queued messages in order, or drop them, because they are of a profile that was not applied."""
        self._holders.discard(holder)
        if drop or not self._holders:
            held, self._held, self._held_bytes = self._held, deque(), 0
            for output, raw, _ in held if not drop else ():
                self._send(output, raw)

    def open_outputs(self) -> None:
        """Send messages from now on, and first those that profiles and contexts have published meanwhile."""
        self._open = True
        for name, count in self._refused.items():
            _log.info("= %s: %s flows again; %d messages were refused", self.node.name, name, count)
        self._refused.clear()
        self.release(_CLOSED)

    def close_outputs(self) -> None:
        """Refuse messages from now on; logged once for each output.

        Messages of the last profile's and the last context's function are queued: they describe the state in which
        the resource is when the outputs open again.
        """
        self._open = False
        self.hold(_CLOSED)

    def drop(self) -> None:
        """Drop the queued messages, which are of a profile that was given up; later ones are queued as before."""
        self._held.clear()
        self._held_bytes = 0

    def call_in_loop(self, function: Callable[..., object], *args: Any) -> None:
        """Call a function in the event loop: now in the loop's own thread, else soon."""
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
        """Take the type of an input from its publisher's header; false if its definition cannot be used."""
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

    def send(self, output: Output, raw: bytes, fence: Fence | None = None) -> None:
        """Send one message, or queue it while a profile or context is being applied.

        Args:
            output: Its output.
            raw: The serialized message.
            fence: Around the publishing function, if that can be given up.
        """
        if fence is not None and fence.closed:
            fence.report_blocked(f"publish on {output.name}")  # it was on its way from another thread
            return
        if not self._open and fence is None:
            self._refuse(output)
            return
        if self._holders:
            self._held.append((output, raw, fence))
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
        """Drop the queued messages except those of functions of these kinds."""
        self._held = deque(held for held in self._held if held[2] is not None and held[2].kind in kinds)
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
        self, output: Output, numbers: Iterator[int], values: Mapping[str, Any], message: object | None
    ) -> None:
        """Serialize a message in the caller's thread, which gets its errors, and send it in the event loop."""
        kind = output.type
        if message is not None and values:
            raise LocalProtocolError(f"{output.name}: a message and fields; give one or the other")
        if message is None:
            message = kind.make(dict(values))
        else:
            given = getattr(message, "__msgtype__", "").replace("/msg/", "/")
            if given != kind.name:
                shown = given or type(message).__name__
                raise MessageError(f"{output.name} has messages of type {kind.name}, not {shown}")
        if kind.fields and kind.fields[0].name == "header":
            header: Any = getattr(message, "header", None)
            if hasattr(header, "seq"):
                header.seq = next(numbers) & SERIAL_MASK  # as rospy does, so that receivers can count losses
        raw, fence = kind.serialize(message), current_fence()
        if fence is None:
            self.call_in_loop(self.send, output, raw)
            return
        with fence.action(f"publish on {output.name}"):
            self.call_in_loop(self.send, output, raw, fence)
