"""One resource at work: its node, its topics, and the parts that make it smart.

The runtime itself only connects: what a part cares for it hears by the methods of ``RuntimePart``.
"""

from __future__ import annotations

import asyncio
import contextlib
import itertools
import logging
import threading
import time
from collections import Counter, deque
from typing import TYPE_CHECKING, Any, Final

from rmpa.core.errors import LocalProtocolError, RmpaError
from rmpa.core.serial_number import SERIAL_MASK
from rmpa.resource import limits
from rmpa.resource.declare.fence import around
from rmpa.resource.run.descriptor import TOPIC, describe, topic_of
from rmpa.ros.types.messages import MessageError, MessageType
from rmpa.ros.wire.tcpros import printable

if TYPE_CHECKING:
    from collections.abc import Mapping

    from rmpa.resource.declare.attributes import Value
    from rmpa.resource.declare.fence import Fence
    from rmpa.resource.declare.resource import Input, Output, Parameter, ParameterValue, Resource
    from rmpa.ros.node.node import Node
    from rmpa.ros.node.topics import Publisher, Received, Subscriber

_log = logging.getLogger(__name__)
_CLOSED: Final = "life cycle"


class RuntimePart:
    """Hears of everything and does nothing; parts override what they care for. All calls come from the loop."""

    async def start(self) -> None:
        """The node is registered and the outputs are advertised; tasks do not run yet."""

    async def close(self) -> None:
        """The resource ends; the node is still registered."""

    def published(self, output: Output, raw: bytes, now_ns: int) -> None:
        """A message has left by an output."""

    def received(self, item: Input, message: Received) -> None:
        """A message has come by an input."""

    def observed(self, attribute: str, value: Value) -> None:
        """An attribute of the user's own was observed."""

    def parameter_changed(self, parameter: Parameter) -> None:
        """A parameter has another value."""


class Runtime:
    """Runs one resource on a node.

    Args:
        resource: Declared completely.
        node: Named as the resource; not yet entered.
    """

    def __init__(self, resource: Resource, node: Node) -> None:
        self.resource = resource
        self.node = node
        self.descriptor = describe(resource, node.name)
        self.parts: list[RuntimePart] = []
        self._publishers: dict[str, Publisher] = {}
        self._subscribers: dict[str, Subscriber] = {}
        self._texts: dict[str, tuple[Publisher, str | None]] = {}
        self._held: deque[tuple[Output, bytes, Fence | None]] = deque()
        self._held_bytes = 0
        self._holders: set[str] = set()
        self._open = True
        self._refused: Counter[str] = Counter()
        """By output: messages that were refused since the outputs were closed."""
        self._unread: set[tuple[str, str]] = set()
        """Inputs and publishers whose definition cannot be used."""
        self.flowing: frozenset[str] | None = None
        """The only outputs whose messages leave in the present context; ``None``: all."""
        self._loop: asyncio.AbstractEventLoop | None = None
        self._thread = 0
        self._undo = contextlib.AsyncExitStack()

    async def start(self) -> None:
        """Register the node, its outputs and inputs, and start the parts in order.

        Raises:
            UnreachableError: The master does not answer.
            PeerRefused: The master refuses a registration.
        """
        self._loop, self._thread = asyncio.get_running_loop(), threading.get_ident()
        async with contextlib.AsyncExitStack() as undo:
            await undo.enter_async_context(self.node)
            for output in self.resource.outputs.values():
                topic = topic_of(output.name, self.node.name)
                self._publishers[output.name] = await self.node.advertise(topic, output.type, latch=output.latch)
                output.outlet = _Outlet(self, output)
                undo.callback(setattr, output, "outlet", None)
            for declared in self.resource.declared_attributes.values():
                declared.observer = _Observer(self)
                undo.callback(setattr, declared, "observer", None)
            watch = _Watch(self)
            for parameter in self.resource.parameters.values():
                parameter.watch = watch
                undo.callback(setattr, parameter, "watch", None)
            await self.say(TOPIC, self.descriptor.serialize())
            for item in self.resource.inputs.values():
                await self._listen(item)
            for part in self.parts:
                await part.start()
                undo.push_async_callback(part.close)
            self._undo = undo.pop_all()

    async def close(self) -> None:
        """End the parts, the last one first, then the node."""
        await self._undo.aclose()

    async def say(self, name: str, text: str) -> None:
        """Publish a text on a latched topic ``std_msgs/String`` of the resource's own; the same text is said once."""
        if name not in self._texts:
            publisher = await self.node.advertise(
                f"{self.node.name}/{name}", MessageType("std_msgs/String"), latch=True
            )
            self._texts[name] = (publisher, None)
        self.say_again(name, text)

    def say_again(self, name: str, text: str) -> None:
        """Publish another text on a topic that ``say`` has made."""
        publisher, before = self._texts[name]
        if text != before:
            self._texts[name] = (publisher, text)
            publisher.publish(publisher.make({"data": text}))

    def describe_again(self) -> None:
        """Say in the descriptor what has changed of it."""
        self.descriptor = describe(self.resource, self.node.name)
        self.say_again(TOPIC, self.descriptor.serialize())

    def set_parameter(self, name: str, value: ParameterValue) -> None:
        """Set a parameter, and let the parts know.

        Raises:
            ConfigError: It cannot have that value.
            KeyError: There is no such parameter.
        """
        self.resource.parameters[name].value = value  # the parts hear of it by its watch

    def parameter_changed(self, parameter: Parameter) -> None:
        """Tell the parts that a parameter has another value."""
        for part in self.parts:
            part.parameter_changed(parameter)

    def publishers_of(self, item: Input) -> int:
        """How many publish what an input needs, here or in other modules."""
        subscriber = self._subscribers.get(item.name)
        return subscriber.publishers if subscriber is not None else 0

    def hold(self, who: str = "profile") -> None:
        """Keep what is published from now on: no output may mix two profiles, or two contexts.

        Args:
            who: What changes; messages leave when the last change is over.
        """
        if not self._open:
            self._keep_of({"profile", "context"} - {who})  # what the one before said is no longer true
        self._holders.add(who)

    def release(self, who: str = "profile", *, drop: bool = False) -> None:
        """Let what was kept leave, in order; or drop it, for it belongs to a profile that was not applied."""
        self._holders.discard(who)
        if drop or not self._holders:
            held, self._held, self._held_bytes = self._held, deque(), 0
            for output, raw, _ in held if not drop else ():
                self._send(output, raw)

    def open_outputs(self) -> None:
        """Let outputs flow; what profiles and contexts had to say meanwhile leaves first."""
        self._open = True
        for name, count in self._refused.items():
            _log.info("= %s: %s flows again; %d messages were refused", self.node.name, name, count)
        self._refused.clear()
        self.release(_CLOSED)

    def close_outputs(self) -> None:
        """Refuse what is published from now on, by whomever; said once for each output.

        Only what the functions of profiles and contexts publish is kept, the last one's of each kind: it is how the
        resource is, and true when outputs flow again.
        """
        self._open = False
        self.hold(_CLOSED)

    def drop(self) -> None:
        """Drop what was kept: it belongs to a profile that was given up. What comes is kept as before."""
        self._held.clear()
        self._held_bytes = 0

    def call_in_loop(self, function: Any, *args: Any) -> None:
        """Call a function in the loop: now if this is its thread, else soon."""
        if threading.get_ident() == self._thread:
            function(*args)
        elif self._loop is not None:
            with contextlib.suppress(RuntimeError):  # the loop has ended: nobody listens any more
                self._loop.call_soon_threadsafe(function, *args)

    # --- inside -------------------------------------------------------------------------------------------------

    async def _listen(self, item: Input) -> None:
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
        """Take the type of an input from its publisher's header; whether it can be used."""
        caller = printable(message.caller_id)
        try:
            kind = message.kind
        except RmpaError as error:
            if (item.name, caller) not in self._unread:
                self._unread.add((item.name, caller))
                text = "its messages are dropped; this is said once"
                _log.warning("! %s: input %s from %s: %s; %s", self.node.name, item.name, caller, error, text)
            return False
        if item.kind.known is None:
            item.kind.known = kind
            _log.info("= %s: %s is learnt from %s", self.node.name, item.kind.name, caller)
        return True

    def send(self, output: Output, raw: bytes, fence: Fence | None = None) -> None:
        """Send one message of an output, or keep it while a profile is being applied.

        Args:
            output: Which one.
            raw: The message.
            fence: Around the function that published it, if that may be given up.
        """
        if fence is not None and fence.closed:
            fence.stopped(f"publish on {output.name}")  # it was on its way from another thread
            return
        if not self._open and fence is None:
            self._refuse(output)
            return
        if self._holders:
            self._held.append((output, raw, fence))
            self._held_bytes += len(raw)
            while self._held_bytes > limits.RESOURCE_HELD_MAX and len(self._held) > 1:
                self._held_bytes -= len(self._held.popleft()[1])  # the oldest gives way
        else:
            self._send(output, raw)

    def _send(self, output: Output, raw: bytes) -> None:
        publisher = self._publishers.get(output.name)
        if publisher is None or (self.flowing is not None and output.name not in self.flowing):
            return
        publisher.publish_raw(raw)
        now_ns = time.time_ns()
        for part in self.parts:
            part.published(output, raw, now_ns)

    def _keep_of(self, kinds: set[str]) -> None:
        """Of what is kept, keep only what such functions published."""
        self._held = deque(kept for kept in self._held if kept[2] is not None and kept[2].who in kinds)
        self._held_bytes = sum(len(raw) for _, raw, _ in self._held)

    def _refuse(self, output: Output) -> None:
        self._refused[output.name] += 1
        if self._refused[output.name] == 1:
            text = "is refused while the resource is not active; this is said once"
            _log.warning("! %s: what is published on %s %s", self.node.name, output.name, text)

    def observe(self, attribute: str, value: Value) -> None:
        """Hand an observation to the parts."""
        for part in self.parts:
            part.observed(attribute, value)


class _Outlet:
    """Where an output's messages go; may be called from any thread."""

    def __init__(self, runtime: Runtime, output: Output) -> None:
        self._runtime = runtime
        self._output = output
        fields = output.type.fields
        self._numbered = bool(fields) and fields[0].name == "header"
        self._number = itertools.count(1)

    def publish(self, values: Mapping[str, Any], message: object | None) -> None:
        """Serialize here, where the mistake is the caller's, and send in the loop."""
        kind = self._output.type
        if message is not None and values:
            raise LocalProtocolError(f"{self._output.name}: a message and fields; give one or the other")
        if message is None:
            message = kind.make(dict(values))
        else:
            given = getattr(message, "__msgtype__", "").replace("/msg/", "/")
            if given != kind.name:
                shown = given or type(message).__name__
                raise MessageError(f"{self._output.name} has messages of type {kind.name}, not {shown}")
        header: Any = getattr(message, "header", None)
        if self._numbered and hasattr(header, "seq"):
            header.seq = next(self._number) & SERIAL_MASK  # as rospy does: whoever receives it sees what was lost
        raw, fence = kind.serialize(message), around()
        if fence is None:
            self._runtime.call_in_loop(self._runtime.send, self._output, raw)
            return
        with fence.passage(f"publish on {self._output.name}"):
            self._runtime.call_in_loop(self._runtime.send, self._output, raw, fence)


class _Observer:
    """Where observations go; may be called from any thread."""

    def __init__(self, runtime: Runtime) -> None:
        self._runtime = runtime

    def observe(self, attribute: str, value: Value) -> None:
        """Hand one on."""
        self._runtime.call_in_loop(self._runtime.observe, attribute, value)


class _Watch:
    """Who hears that a parameter has changed; may be called from any thread."""

    def __init__(self, runtime: Runtime) -> None:
        self._runtime = runtime

    def changed(self, parameter: Parameter) -> None:
        """Tell the parts, in the loop."""
        self._runtime.call_in_loop(self._runtime.parameter_changed, parameter)
