"""Interfaces of a resource: outputs, inputs, attributes that the user's code observes, requirements on others.

While the resource runs, ``rmpa.resource.run`` binds these to a node: it sets their fields ``on_…`` to its functions.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from rmpa.core.errors import LocalProtocolError
from rmpa.ros.types.definitions import UnknownTypeError
from rmpa.ros.types.find import find_message_type

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from rmpa.core.contract import Contract
    from rmpa.resource.declare.answer import RequirementAnswer
    from rmpa.resource.declare.attributes import Attribute, Value
    from rmpa.resource.declare.qos_request import QoSRequest
    from rmpa.ros.types.messages import MessageType


class TopicType:
    """The message type of an output or input: found on this machine, or learnt later from a publisher.

    Args:
        name: ``package/Name``.

    Raises:
        DefinitionError: The name is malformed, or rmpa comes with its package, which has no such type.
    """

    def __init__(self, name: str) -> None:
        self.name = name
        self.known: MessageType | None = None
        """The type; ``None`` until it is known."""
        self.problem: UnknownTypeError | None = None
        """Why the type is not known on this machine; ``None`` if it is."""
        try:
            self.known = find_message_type(name)
        except UnknownTypeError as error:
            if not error.fetchable:
                raise
            self.problem = error

    def get(self) -> MessageType:
        """The message type.

        Raises:
            UnknownTypeError: The type is not known yet.
        """
        if self.known is None:
            assert self.problem is not None  # noqa: S101 - one of them is set
            raise self.problem
        return self.known


@dataclass(eq=False)
class Output:
    """A topic that the resource publishes.

    Args:
        name: The declared name, in the resource's namespace unless it is global.
        kind: The message type, which may be learnt later.
        contract: The offered QoS of the messages; the agent's rules are applied on top.
        latch: Whether a late subscriber gets the last message.
        on_publish: Called in any thread with ``(message fields, whole message)``; ``None`` while the resource does
            not run.
    """

    name: str
    kind: TopicType
    contract: Contract
    latch: bool = False
    on_publish: Callable[[Mapping[str, Any], object | None], None] | None = field(default=None, repr=False)

    @property
    def type(self) -> MessageType:
        """The output's message type.

        Raises:
            UnknownTypeError: The type is unknown on this machine, and no publisher of it has been found yet.
        """
        return self.kind.get()

    def publish(self, message: object | None = None, /, **values: Any) -> None:
        """Publish a message: an object, plain values (see ``MessageType.make``), or fields by name.

        While the resource is not active, messages are dropped, except those of functions of profiles and contexts:
        these are queued until it is active.

        Raises:
            MessageError: The message does not fit the output's type, or both a message and field values are given.
            LocalProtocolError: The resource does not run.
        """
        if self.on_publish is None:
            raise LocalProtocolError(f"{self.name} has nowhere to go: its resource does not run (rmpa run)")
        self.on_publish(values, message)


@dataclass(frozen=True, slots=True)
class Input:
    """A topic that the resource needs.

    Args:
        name: The declared name, in the resource's namespace unless it is global.
        kind: The message type; if it is unknown on this machine, it is learnt from the topic's first publisher.
        contract: The requested QoS of the messages.
        required: Whether the resource is stale while the topic has no publisher.
    """

    name: str
    kind: TopicType
    contract: Contract
    required: bool = True

    @property
    def type(self) -> MessageType:
        """The input's message type; raises ``UnknownTypeError`` while no publisher has been found."""
        return self.kind.get()


@dataclass(eq=False)
class DeclaredAttribute:
    """An attribute that a resource declares itself; the user's code reports its values by ``observe``.

    Args:
        attribute: The attribute.
        on_observation: Called in any thread with ``(attribute's name, value)``; ``None`` unless the resource runs.
    """

    attribute: Attribute
    on_observation: Callable[[str, Value], None] | None = field(default=None, repr=False)

    def observe(self, value: Value) -> None:
        """Report one observed value in the attribute's unit; without effect while the resource does not run.

        Raises:
            ConfigError: The value is not valid for this attribute.
        """
        checked = self.attribute.check(value, f"observation of {self.attribute.name}")
        if self.on_observation is not None:
            self.on_observation(self.attribute.name, checked)


@dataclass(eq=False)
class Demand:
    """The standing requirement of a resource on another one, in the same or another module.

    Args:
        resource: Name of the other resource's node in this module's graph: ``/sonar``, ``/robot1/sonar``.
        requests: QoS requests by attribute of the other resource; empty: none at present.
        priority: In a conflict between clients the higher priority wins.
        answer: The last answer; ``None`` before the first.
        on_change: Called with this demand, in any thread, when the requests change; ``None`` while the resource does
            not run.
    """

    resource: str
    requests: Mapping[str, QoSRequest] = field(default_factory=dict)
    priority: int = 0
    answer: RequirementAnswer | None = field(default=None, repr=False)
    on_change: Callable[[Demand], None] | None = field(default=None, repr=False)

    def ask(self, **requests: QoSRequest) -> None:
        """Replace the requests; without arguments nothing is requested. May be called in any thread."""
        self.requests = requests
        if self.on_change is not None:
            self.on_change(self)
