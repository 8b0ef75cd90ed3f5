"""A resource's descriptor: its metadata as one JSON text, on the latched topic ``<resource>/descriptor``.

It crosses the mesh as any topic does, so every module can see what every resource offers and needs.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import msgspec

from rmpa.core.contract import KEYS, Contract
from rmpa.core.errors import LimitExceeded, RemoteProtocolError
from rmpa.resource import limits

if TYPE_CHECKING:
    from rmpa.resource.declare.attributes import Attribute
    from rmpa.resource.declare.resource import Input, Output, Resource

VERSION: Final = 1
TOPIC: Final = "descriptor"
_DEFAULT: Final = Contract()


class TopicDescriptor(msgspec.Struct, frozen=True, kw_only=True):
    """An output or input.

    Attributes:
        name: As declared.
        topic: Its global name in the module.
        type: Message type.
        contract: What is not the default, by key.
        required: Inputs only: whether the resource is stale without it.
    """

    name: str
    topic: str
    type: str
    contract: dict[str, str | int | float | None] = {}
    required: bool = True


class ParameterDescriptor(msgspec.Struct, frozen=True, kw_only=True):
    """A parameter; ``type`` is dynamic_reconfigure's word."""

    name: str
    type: str
    default: bool | int | float | str
    low: float | None = None
    high: float | None = None
    choices: tuple[bool | int | float | str, ...] = ()
    unit: str = ""
    description: str = ""


class AttributeDescriptor(msgspec.Struct, frozen=True, kw_only=True):
    """A quality that can be asked for."""

    name: str
    better: str
    unit: str = ""
    scale: str = "linear"
    category: str = "performance"
    tolerance: float | None = None
    words: tuple[str, ...] = ()


class ProfileDescriptor(msgspec.Struct, frozen=True, kw_only=True):
    """A System Profile; ``offers`` are in the attributes' units."""

    name: str
    offers: dict[str, float | str]
    cost: float = 0.0
    best_effort: bool = False
    description: str = ""


class ContextDescriptor(msgspec.Struct, frozen=True, kw_only=True):
    """A context; an empty ``profiles`` allows any, ``outputs`` that is ``None`` lets all flow."""

    name: str
    when: str = ""
    requires: dict[str, str] = {}
    profiles: tuple[str, ...] = ()
    outputs: tuple[str, ...] | None = None


class TaskDescriptor(msgspec.Struct, frozen=True, kw_only=True):
    """A task: periodic at a rate in Hz, which may follow a parameter, or on an input."""

    name: str
    rate: float | None = None
    on: str = ""
    follows: str = ""


class DemandDescriptor(msgspec.Struct, frozen=True, kw_only=True):
    """What it asks of another resource at present.

    Attributes:
        resource: The other one's node, as this resource's module has it.
        wishes: By the other one's attribute, as a requirement says it: ``>= 20 Hz hard``; empty: nothing.
        priority: The higher one wins a conflict between clients.
    """

    resource: str
    wishes: dict[str, str] = {}
    priority: int = 0


class Descriptor(msgspec.Struct, frozen=True, kw_only=True):
    """A whole resource.

    Attributes:
        version: Of this form.
        name: Its node's base name.
        node: Its node's global name, in its own module.
        role: ``sensing``, ``acting`` or ``controlling``.
        physical: Whether there is a device; else it is simulated.
        description: For people.
        outputs: In order of declaration, as everything else.
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
        """As JSON."""
        return msgspec.json.encode(self).decode()

    @classmethod
    def parse(cls, text: str | bytes) -> Descriptor:
        """Read what a resource says of itself.

        Raises:
            LimitExceeded: It is longer than ``limits.DESCRIPTOR_MAX``.
            RemoteProtocolError: It is no descriptor of this version.
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
    """What a declared resource says of itself.

    Args:
        resource: Declared completely.
        node: Its node's global name.
    """
    return Descriptor(
        name=resource.name,
        node=node,
        role=resource.role.value,
        physical=resource.physical,
        description=resource.description,
        outputs=tuple(_topic(output, node) for output in resource.outputs.values()),
        inputs=tuple(_topic(item, node, required=item.required) for item in resource.inputs.values()),
        parameters=tuple(
            ParameterDescriptor(
                name=p.name,
                type=p.type,
                default=p.default,
                low=p.low,
                high=p.high,
                choices=p.choices,
                unit=p.unit,
                description=p.description,
            )
            for p in resource.parameters.values()
        ),
        attributes=tuple(_attribute(name, attribute) for name, attribute in resource.attributes.items()),
        profiles=tuple(
            ProfileDescriptor(
                name=p.name,
                offers=dict(p.offers),
                cost=p.cost,
                best_effort=p.best_effort,
                description=p.description,
            )
            for p in (declared.profile for declared in resource.profiles.values())
        ),
        contexts=tuple(
            ContextDescriptor(
                name=c.name,
                when=c.when,
                requires={key: str(wish) for key, wish in c.requires.items()},
                profiles=c.profiles,
                outputs=c.outputs,
            )
            for c in resource.contexts.values()
        ),
        tasks=tuple(
            TaskDescriptor(
                name=t.name,
                rate=t.rate,
                on=t.on.name if t.on is not None else "",
                follows=t.follows.name if t.follows is not None else "",
            )
            for t in resource.tasks.values()
        ),
        asks=tuple(
            DemandDescriptor(
                resource=d.resource,
                wishes={key.replace("__", "."): str(wish) for key, wish in d.wishes.items()},
                priority=d.priority,
            )
            for d in resource.demands.values()
        ),
    )


def topic_of(name: str, node: str) -> str:
    """The global name of an output or input: relative ones lie in the resource's own namespace."""
    return name if name.startswith("/") else f"{node}/{name}"


def _topic(topic: Output | Input, node: str, *, required: bool = True) -> TopicDescriptor:
    said = {key: getattr(topic.contract, key) for key in KEYS}
    contract = {key: value for key, value in said.items() if value != getattr(_DEFAULT, key)}
    return TopicDescriptor(
        name=topic.name, topic=topic_of(topic.name, node), type=topic.kind.name, contract=contract, required=required
    )


def _attribute(name: str, attribute: Attribute) -> AttributeDescriptor:
    return AttributeDescriptor(
        name=name,
        better=attribute.direction.value,
        unit=attribute.unit,
        scale=attribute.scale.value,
        category=attribute.category.value,
        tolerance=attribute.tolerance,
        words=attribute.words,
    )
