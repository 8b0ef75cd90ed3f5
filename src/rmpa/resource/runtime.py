"""The runtime of one resource: its node, its topics, and the events that its parts receive (``RuntimePart``)."""

from __future__ import annotations

import asyncio
import contextlib
import functools
import logging
import threading
import time
from collections import Counter, deque
from enum import StrEnum
from typing import TYPE_CHECKING, Any, Final

import msgspec

from rmpa.core.contract import DEFAULT_CONTRACT, KEYS
from rmpa.core.errors import RmpaError
from rmpa.resource import limits
from rmpa.resource.functions import CALLER
from rmpa.ros.types import descriptor
from rmpa.ros.types.messages import HeaderNumbers, MessageError, MessageType
from rmpa.ros.wire.tcpros import printable
from rmpa.runtime.tasks import OwnedTasks

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable, Mapping

    from rmpa.resource.declare import DeclaredTopic, Output, Parameter
    from rmpa.resource.quality import Value
    from rmpa.resource.resource import Resource
    from rmpa.ros.node.endpoints import Publisher, Received, Subscriber
    from rmpa.ros.node.node import Node

_log = logging.getLogger(__name__)
_CLOSED: Final = "life cycle"


class LifecycleState(StrEnum):
    """State of a resource: as of ROS 2's managed nodes (design.ros2.org/articles/node_lifecycle).

    ::

        unconfigured ──configure──► inactive ──activate──► active
                                        ▲                    │
                                        └─────deactivate─────┘
        any of them ──finalize──► finalized
    """

    # The node is registered; the device is not open yet.
    UNCONFIGURED = "unconfigured"
    # Parameters can be set; no task runs and nothing is published.
    INACTIVE = "inactive"
    # The tasks run, and outputs are published.
    ACTIVE = "active"
    # The resource has ended; no transition leads out of this state.
    FINALIZED = "finalized"


class RuntimePart:
    """Base of the parts of a running resource. The callbacks do nothing here; all are called in the event loop.

    Args:
        runtime: The runtime of the resource.
    """

    def __init__(self, runtime: Runtime) -> None:
        self._runtime = runtime
        # What the part does by itself; it ends with the part.
        self._work = OwnedTasks()

    async def start(self) -> None:
        """Start the part: the node is registered and the outputs are advertised; tasks do not run yet."""

    async def close(self) -> None:
        """End the part: the resource ends; the node is still registered."""
        await self._work.close()

    def parameter_changed(self, parameter: Parameter) -> None:
        """A parameter's value has changed."""

    def window_ended(self, measured: Mapping[str, Value]) -> None:
        """A quality window has ended; the measured values are by attribute."""

    def changed(self) -> None:
        """The requirements, the profile, its cool-downs, the context or a choice by hand may have changed."""

    def problems(self) -> tuple[list[str], list[str]]:
        """Problems apart from the quality, as texts: first what is missing, second what does not work."""
        return [], []

    def blocked(self) -> dict[str, str]:
        """The profiles that cannot run at present, with the reasons."""
        return {}


class Runtime:
    """Runs one resource on a node: connects its declaration, its topics and its parts.

    Args:
        resource: The resource, completely declared.
        node: The resource's node, with the resource's name; not yet entered.
    """

    def __init__(self, resource: Resource, node: Node) -> None:
        self.resource = resource
        self.node = node
        # In the order of their start.
        self.parts: list[RuntimePart] = []
        self.state = LifecycleState.UNCONFIGURED
        # Called in the event loop with each message that an output has sent or that was received: ``(topic, bytes,
        # Unix nanoseconds, received message)``; the last is ``None`` for an output of the resource itself.
        self.listeners: list[Callable[[DeclaredTopic, bytes, int, Received | None], None]] = []
        # The only outputs that are published in the present context; ``None``: all.
        self.context_outputs: tuple[str, ...] | None = None
        self._publishers: dict[str, Publisher] = {}
        # Those of inputs and observed outputs, by the declared name.
        self.subscribers: dict[str, Subscriber] = {}
        self._texts: dict[str, tuple[Publisher, str | None]] = {}
        self._held: deque[tuple[Output, bytes, str]] = deque()
        self._held_bytes = 0
        self._holders: set[str] = set()
        self._open = True
        # Number of messages refused since the outputs were closed, by output.
        self._refused: Counter[str] = Counter()
        # Pairs of an input and a publisher whose message definition cannot be used; each is logged once.
        self._unusable: set[tuple[str, str]] = set()
        self._loop: asyncio.AbstractEventLoop | None = None
        self._thread = 0
        # What is undone at the end, and where the start fails.
        self.undo = contextlib.AsyncExitStack()

    async def start(self, *first: Callable[[], Awaitable[None]]) -> None:
        """Register the node, its outputs and inputs, and start the parts.

        Args:
            first: Called one after the other before the parts start.

        Raises:
            UnreachableError: The master does not answer.
            PeerRefused: The master refuses a registration.
        """
        self._loop, self._thread = asyncio.get_running_loop(), threading.get_ident()
        try:
            await self.undo.enter_async_context(self.node)
            await self._open_topics()
            for step in first:
                await step()
            for part in self.parts:
                await part.start()
                self.undo.push_async_callback(part.close)
        except BaseException:
            await self.close()
            raise

    async def _open_topics(self) -> None:
        for output in self.resource.outputs.values():
            if not output.observed:
                topic = topic_of(output.name, self.node.name)
                self._publishers[output.name] = await self.node.advertise(topic, output.type, latch=output.latch)
                output.on_publish = functools.partial(self._publish, output, HeaderNumbers(output.type))
                self.undo.callback(setattr, output, "on_publish", None)
        for parameter in self.resource.parameters.values():
            self.bind(parameter, "on_change", self._parameter_changed)
        for name in (descriptor.TOPIC, "state", "profile", "decision", "context"):
            kind = MessageType("std_msgs/String")
            publisher = await self.node.advertise(f"{self.node.name}/{name}", kind, latch=True)
            self._texts[name] = publisher, None
        self.publish_descriptor()
        for item in self.resource.inputs.values():
            if not item.observed:
                await self.receive(item)

    async def close(self) -> None:
        """Close the parts in reverse order of their start, then the node."""
        await self.undo.aclose()

    def bind(self, declared: object, field: str, function: Callable[..., None]) -> None:
        """Have a declared thing call a function in the event loop, until the resource ends."""
        setattr(declared, field, functools.partial(self.call_in_loop, function))
        self.undo.callback(setattr, declared, field, None)

    def publish_text(self, name: str, text: str) -> None:
        """Publish a text on one of the resource's latched topics ``std_msgs/String``, if it differs from the last."""
        publisher, before = self._texts[name]
        if text != before:
            self._texts[name] = publisher, text
            publisher.publish(data=text)

    def publish_descriptor(self) -> None:
        """Publish the descriptor, at the start and after the declaration has changed."""
        self.publish_text(descriptor.TOPIC, describe(self.resource, self.node.name).serialize())

    def changed(self) -> None:
        """Tell the parts that requirements, profile, context or a choice may have changed."""
        for part in self.parts:
            part.changed()

    def problems(self) -> tuple[list[str], list[str]]:
        """Problems of all parts apart from the quality, as texts: what is missing, and what does not work."""
        missing = [
            f"no node publishes {name}"
            for name, item in self.resource.inputs.items()
            if item.required
            and not item.observed
            and not ((subscriber := self.subscribers.get(name)) and subscriber.publishers)
        ]
        broken = []
        for part in self.parts:
            lacks, fails = part.problems()
            missing += lacks
            broken += fails
        if self.state is not LifecycleState.ACTIVE:
            broken.append(f"it is {self.state}")
        return missing, broken

    def hears(self, name: str) -> bool:
        """Whether the messages of an input or output, by its declared name, come to the resource itself."""
        return name in self._publishers or name in self.subscribers

    def call_in_loop(self, function: Callable[..., object], *args: Any) -> None:
        """Call a function in the event loop: at once if called in the loop's thread, else as soon as the loop can."""
        if threading.get_ident() == self._thread:
            function(*args)
        elif self._loop is not None:
            with contextlib.suppress(RuntimeError):  # the loop has ended
                self._loop.call_soon_threadsafe(function, *args)

    def _parameter_changed(self, parameter: Parameter) -> None:
        for part in self.parts:
            part.parameter_changed(parameter)

    async def receive(self, item: DeclaredTopic) -> None:
        """Subscribe to an input or an observed output; its messages go to the listeners."""
        unknown = item.known is None

        def received(message: Received) -> None:
            if not unknown or self._learn(item, message):
                for listener in self.listeners:
                    listener(item, message.raw, message.stamp_ns, message)

        name, topic = self.node.name, topic_of(item.name, self.node.name)
        if unknown:
            text = "is not known here; a publisher of"
            _log.info("= %s: the type of %s, %s, %s %s tells it", name, item.name, item.type_name, text, topic)
        self.subscribers[item.name] = await self.node.subscribe(topic, item.known or item.type_name, received)

    def _learn(self, item: DeclaredTopic, message: Received) -> bool:
        """Take the type of a topic from its publisher's header; false if the definition there cannot be used."""
        caller = printable(message.caller_id)
        try:
            kind = message.kind
        except RmpaError as error:
            if (item.name, caller) not in self._unusable:
                self._unusable.add((item.name, caller))
                text = "its messages are dropped; this is said once"
                _log.warning(
                    "! %s: %s from %s: %s; %s [unknown-type]", self.node.name, item.name, caller, error, text
                )
            return False
        if item.known is None:
            item.known = kind
            _log.info("= %s: %s is learnt from %s", self.node.name, item.type_name, caller)
        return True

    def hold(self, holder: str = "profile") -> None:
        """Queue messages from now on, so that no output mixes messages of two profiles or two contexts.

        Args:
            holder: The kind of change: ``profile``, ``context`` or the life cycle. The queue is sent when no holder
                is left.
        """
        if not self._open:
            # Messages of the previous change of this kind are outdated.
            self._held = deque(held for held in self._held if held[2] in {"profile", "context"} - {holder})
            self._held_bytes = sum(len(raw) for _, raw, _ in self._held)
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

    def _publish(
        self, output: Output, numbers: HeaderNumbers, values: Mapping[str, Any], message: object | None
    ) -> None:
        """Serialize a message in the caller's thread, so that the caller gets the errors, and send it in the loop."""
        kind = output.type
        try:
            payload = kind.serialize(kind.given(message, values))
        except MessageError as error:
            raise MessageError(f"{output.name}: {error}") from None
        self.call_in_loop(self._accept, output, bytes(numbers.stamp(payload)), CALLER.get())

    def _accept(self, output: Output, raw: bytes, caller: str) -> None:
        """Send one message, or queue it while a profile or context is being applied; ``caller`` is ``CALLER``."""
        if not self._open and not caller:
            self._refused[output.name] += 1
            if self._refused[output.name] == 1:
                text = "is refused while the resource is not active; this is said once"
                _log.warning("! %s: what is published on %s %s [resource-trouble]", self.node.name, output.name, text)
        elif self._holders:
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
        for listener in self.listeners:
            listener(output, raw, now_ns, None)


def describe(resource: Resource, node: str) -> descriptor.Descriptor:
    """Make the descriptor of a declared resource.

    Args:
        resource: The resource, completely declared.
        node: Global name of the resource's node.
    """
    return descriptor.Descriptor(
        name=resource.name,
        node=node,
        role=resource.role.value,
        physical=resource.physical,
        description=resource.description,
        outputs=tuple(_topic(output, node) for output in resource.outputs.values()),
        inputs=tuple(_topic(item, node, required=item.required) for item in resource.inputs.values()),
        parameters=tuple(_parameter(p) for p in resource.parameters.values()),
        attributes=tuple(
            descriptor.AttributeDescriptor(name, a.direction, a.unit, a.scale, a.category, a.tolerance, a.words)
            for name, a in resource.attributes.items()
        ),
        profiles=tuple(
            msgspec.convert(p, descriptor.ProfileDescriptor, from_attributes=True) for p in resource.profiles.values()
        ),
        contexts=tuple(
            descriptor.ContextDescriptor(
                c.name, str(c.when or ""), {k: str(v) for k, v in c.requires.items()}, c.profiles, c.outputs
            )
            for c in resource.contexts.values()
        ),
        tasks=tuple(
            descriptor.TaskDescriptor(
                t.name, t.rate, t.on.name if t.on else "", t.rate_parameter.name if t.rate_parameter else ""
            )
            for t in resource.tasks.values()
        ),
        asks=tuple(
            descriptor.DemandDescriptor(
                d.resource, {k.replace("__", "."): str(v) for k, v in d.requests.items()}, d.priority
            )
            for d in resource.demands.values()
        ),
        nodes=tuple(descriptor.NodeDescriptor(n.key, n.name, n.how) for n in resource.nodes.values()),
        file=resource.file,
    )


def _parameter(one: Parameter) -> descriptor.ParameterDescriptor:
    binding = str(one.binding) if one.binding is not None else ""
    values = {name: getattr(one, name) for name in descriptor.ParameterDescriptor.__struct_fields__}
    return descriptor.ParameterDescriptor(**values | {"binding": binding})


def topic_of(name: str, node: str) -> str:
    """The global name of an output or input; relative names are in the resource's own namespace."""
    return name if name.startswith("/") else f"{node}/{name}"


def _topic(topic: DeclaredTopic, node: str, *, required: bool = True) -> descriptor.TopicDescriptor:
    values = {key: getattr(topic.contract, key) for key in KEYS}
    contract = {key: value for key, value in values.items() if value != getattr(DEFAULT_CONTRACT, key)}
    full = topic_of(topic.name, node)
    return descriptor.TopicDescriptor(
        topic.name, full, topic.type_name, contract, required, topic.observed, topic.label
    )
