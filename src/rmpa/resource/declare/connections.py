"""What connects a resource with others: outputs, inputs, what it observes of itself, what it asks of another one."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Protocol

from rmpa.core.errors import LocalProtocolError
from rmpa.resource.declare.fence import passage
from rmpa.ros.types.definitions import UnknownTypeError
from rmpa.ros.types.find import find_message_type

if TYPE_CHECKING:
    from collections.abc import Mapping

    from rmpa.core.contract import Contract
    from rmpa.resource.declare.answer import RequirementAnswer
    from rmpa.resource.declare.attributes import Attribute, Value
    from rmpa.resource.declare.qos_request import QoSRequest
    from rmpa.ros.types.messages import MessageType


class OutputSink(Protocol):
    """Where an output's messages go while the resource is active."""

    def publish(self, values: Mapping[str, Any], message: object | None) -> None:
        """Send a message, built from values or given whole."""
        ...


class ObservationSink(Protocol):
    """Where an attribute's observations go."""

    def observe(self, attribute: str, value: Value) -> None:
        """Take one."""
        ...


class DemandCarrier(Protocol):
    """Carries what a resource asks of others while it runs."""

    def asked(self, demand: Demand) -> None:
        """It asks for something else; called in any thread."""
        ...


class TopicType:
    """The message type of an output or input: found on this machine, or told later by a publisher.

    Args:
        name: ``package/Name``.

    Raises:
        DefinitionError: It is malformed, or of a package that comes with rmpa, and not in it.
    """

    def __init__(self, name: str) -> None:
        self.name = name
        self.known: MessageType | None = None
        """The type, once it is known."""
        self.problem: UnknownTypeError | None = None
        """Where it was looked for in vain."""
        try:
            self.known = find_message_type(name)
        except UnknownTypeError as error:
            if not error.fetchable:
                raise
            self.problem = error

    def get(self) -> MessageType:
        """The type.

        Raises:
            UnknownTypeError: It is not known yet.
        """
        if self.known is None:
            assert self.problem is not None  # noqa: S101 - it is either
            raise self.problem
        return self.known


@dataclass(eq=False)
class Output:
    """A topic that the resource publishes.

    Args:
        name: As declared, in the resource's namespace unless it is global.
        kind: Its message type, which may be told later.
        contract: What its messages need; the agent's rules apply on top.
        latch: Whether a late subscriber gets the last message.
    """

    name: str
    kind: TopicType
    contract: Contract
    latch: bool = False
    outlet: OutputSink | None = field(default=None, repr=False)

    @property
    def type(self) -> MessageType:
        """Its message type.

        Raises:
            UnknownTypeError: It is not known here, and no publisher has told it yet.
        """
        return self.kind.get()

    def publish(self, message: object | None = None, /, **values: Any) -> None:
        """Send a message: whole, or its fields; it is dropped while the resource is not active.

        Raises:
            MessageError: It does not fit the output's type.
            LocalProtocolError: The resource does not run, or the profile whose function calls was given up.
        """
        if self.outlet is None:
            raise LocalProtocolError(f"{self.name} has nowhere to go: its resource does not run (rmpa run)")
        self.outlet.publish(values, message)


@dataclass(frozen=True, slots=True)
class Input:
    """A topic that the resource needs.

    Args:
        name: As declared.
        kind: Its message type, which its first publisher tells where it is not known here.
        contract: What is asked of its messages.
        required: Whether the resource is stale while nobody publishes it.
    """

    name: str
    kind: TopicType
    contract: Contract
    required: bool = True

    @property
    def type(self) -> MessageType:
        """Its message type; errors as of ``Output.type``."""
        return self.kind.get()


@dataclass(eq=False)
class DeclaredAttribute:
    """An attribute of the user's own; ``observe`` what was measured of it."""

    attribute: Attribute
    observer: ObservationSink | None = field(default=None, repr=False)

    def observe(self, value: Value) -> None:
        """Take one observation, in the attribute's unit; without effect while the resource does not run.

        Raises:
            ConfigError: It is no value of this attribute.
            LocalProtocolError: The profile whose function calls was given up.
        """
        checked = self.attribute.check(value, f"observation of {self.attribute.name}")
        if self.observer is not None:
            with passage(f"observe {self.attribute.name}"):
                self.observer.observe(self.attribute.name, checked)


@dataclass(eq=False)
class Demand:
    """What a resource asks of another one, here or in another module, for as long as it runs.

    Args:
        resource: The other one's node, as this module's graph has it: ``sonar``, ``/robot1/sonar``.
        wishes: By attribute; empty: nothing at present.
        priority: The higher one wins a conflict between clients.
        answer: What the other one says to it, the last time; ``None`` before it said anything.
    """

    resource: str
    wishes: Mapping[str, QoSRequest] = field(default_factory=dict)
    priority: int = 0
    answer: RequirementAnswer | None = field(default=None, repr=False)
    asker: DemandCarrier | None = field(default=None, repr=False)

    def ask(self, **wishes: QoSRequest) -> None:
        """Ask for this instead, from now on; from a profile or a task, in any thread. Nothing: ask for nothing.

        Raises:
            LocalProtocolError: The profile whose function calls was given up.
        """
        with passage(f"ask {self.resource}"):
            self.wishes = wishes
            if self.asker is not None:
                self.asker.asked(self)
