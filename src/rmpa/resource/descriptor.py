"""The descriptor of a resource: its metadata as JSON on the latched topic ``<resource>/descriptor``.

The topic crosses the mesh like any other, so every module sees what each resource offers and needs. The names of the
fields are part of the wire format.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final, TypeVar

import msgspec

from rmpa.core.contract import KEYS, Contract
from rmpa.core.errors import LimitExceeded, RemoteProtocolError
from rmpa.resource import limits

if TYPE_CHECKING:
    from rmpa.resource.declare import DeclaredTopic
    from rmpa.resource.resource import Resource

VERSION: Final = 1
TOPIC: Final = "descriptor"
_DEFAULT: Final = Contract()
_Kind = TypeVar("_Kind", bound=msgspec.Struct)


class TopicDescriptor(msgspec.Struct, frozen=True):
    """An output or input.

    Attributes:
        name: The declared name.
        topic: Global name of the topic in the resource's module.
        type: Name of the message type.
        contract: The contract's values that differ from the defaults, by key.
        required: For inputs only: whether the resource is stale without a publisher.
    """

    name: str
    topic: str
    type: str
    contract: dict[str, str | int | float | None] = {}
    required: bool = True


class ParameterDescriptor(msgspec.Struct, frozen=True, kw_only=True):
    """A parameter; ``type`` is the type's name in dynamic_reconfigure."""

    name: str
    type: str
    default: bool | int | float | str
    low: float | None = None
    high: float | None = None
    choices: tuple[bool | int | float | str, ...] = ()
    unit: str = ""
    description: str = ""


class AttributeDescriptor(msgspec.Struct, frozen=True):
    """A quality attribute that clients may request."""

    name: str
    better: str
    unit: str = ""
    scale: str = "linear"
    category: str = "performance"
    tolerance: float | None = None
    words: tuple[str, ...] = ()


class ProfileDescriptor(msgspec.Struct, frozen=True, kw_only=True):
    """A System Profile; ``offers`` has values by attribute, in the attributes' units."""

    name: str
    offers: dict[str, float | str]
    cost: float = 0.0
    best_effort: bool = False
    description: str = ""


class ContextDescriptor(msgspec.Struct, frozen=True):
    """A context; empty ``profiles`` allow every profile, and with ``outputs`` of ``None`` all outputs publish."""

    name: str
    when: str = ""
    requires: dict[str, str] = {}
    profiles: tuple[str, ...] = ()
    outputs: tuple[str, ...] | None = None


class TaskDescriptor(msgspec.Struct, frozen=True):
    """A task: runs at ``rate`` Hz, which the parameter ``follows`` may change, or on messages of the input ``on``."""

    name: str
    rate: float | None = None
    on: str = ""
    follows: str = ""


class DemandDescriptor(msgspec.Struct, frozen=True):
    """The present requirement on another resource.

    Attributes:
        resource: Name of the other resource's node in this module's graph.
        wishes: Requests as texts (``>= 20 Hz hard``), by attribute of the other resource.
        priority: In a conflict between clients the higher priority wins.
    """

    resource: str
    wishes: dict[str, str] = {}
    priority: int = 0


class Descriptor(msgspec.Struct, frozen=True, kw_only=True):
    """A whole resource.

    Attributes:
        version: Version of this format.
        name: Base name of the resource's node.
        node: Global name of the resource's node in its own module.
        role: ``sensing``, ``acting`` or ``controlling``.
        physical: Whether the resource has a real device; else it is simulated.
        description: A text for people.
        outputs: In the order of declaration, as are all the following.
    """

    version: int = VERSION
    name: str
    node: str
    role: str
    physical: bool
    description: str = ""
    outputs: tuple[TopicDescriptor, ...] = ()
    inputs: tuple[TopicDescriptor, ...] = ()
    parameters: tuple[ParameterDescriptor, ...] = ()
    attributes: tuple[AttributeDescriptor, ...] = ()
    profiles: tuple[ProfileDescriptor, ...] = ()
    contexts: tuple[ContextDescriptor, ...] = ()
    tasks: tuple[TaskDescriptor, ...] = ()
    asks: tuple[DemandDescriptor, ...] = ()

    def serialize(self) -> str:
        """The descriptor as JSON."""
        return msgspec.json.encode(self).decode()

    @classmethod
    def parse(cls, text: str | bytes) -> Descriptor:
        """Read the descriptor of a resource.

        Raises:
            LimitExceeded: The text is longer than ``limits.DESCRIPTOR_MAX``.
            RemoteProtocolError: The text is not a descriptor of this version.
        """
        if len(text) > limits.DESCRIPTOR_MAX:
            raise LimitExceeded("descriptor of a resource", len(text), limits.DESCRIPTOR_MAX)
        try:
            found = msgspec.json.decode(text, type=cls)
        except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
            raise RemoteProtocolError(f"descriptor of a resource: {error}") from None
        if found.version != VERSION:
            raise RemoteProtocolError(f"descriptor of version {found.version}; this release reads {VERSION}")
        return found


def describe(resource: Resource, node: str) -> Descriptor:
    """Make the descriptor of a declared resource.

    Args:
        resource: The resource, completely declared.
        node: Global name of the resource's node.
    """
    return Descriptor(
        name=resource.name,
        node=node,
        role=resource.role.value,
        physical=resource.physical,
        description=resource.description,
        outputs=tuple(_topic(output, node) for output in resource.outputs.values()),
        inputs=tuple(_topic(item, node, required=item.required) for item in resource.inputs.values()),
        parameters=tuple(_convert(p, ParameterDescriptor) for p in resource.parameters.values()),
        attributes=tuple(
            AttributeDescriptor(name, a.direction, a.unit, a.scale, a.category, a.tolerance, a.words)
            for name, a in resource.attributes.items()
        ),
        profiles=tuple(_convert(p, ProfileDescriptor) for p in resource.profiles.values()),
        contexts=tuple(
            ContextDescriptor(c.name, c.when, {k: str(v) for k, v in c.requires.items()}, c.profiles, c.outputs)
            for c in resource.contexts.values()
        ),
        tasks=tuple(
            TaskDescriptor(
                t.name, t.rate, t.on.name if t.on else "", t.rate_parameter.name if t.rate_parameter else ""
            )
            for t in resource.tasks.values()
        ),
        asks=tuple(
            DemandDescriptor(d.resource, {k.replace("__", "."): str(v) for k, v in d.requests.items()}, d.priority)
            for d in resource.demands.values()
        ),
    )


def _convert(declared: object, kind: type[_Kind]) -> _Kind:
    """Make a descriptor from a declaration's attributes of the same names."""
    return msgspec.convert(declared, kind, from_attributes=True)


def topic_of(name: str, node: str) -> str:
    """The global name of an output or input; relative names are in the resource's own namespace."""
    return name if name.startswith("/") else f"{node}/{name}"


def _topic(topic: DeclaredTopic, node: str, *, required: bool = True) -> TopicDescriptor:
    values = {key: getattr(topic.contract, key) for key in KEYS}
    contract = {key: value for key, value in values.items() if value != getattr(_DEFAULT, key)}
    return TopicDescriptor(topic.name, topic_of(topic.name, node), topic.type_name, contract, required)
