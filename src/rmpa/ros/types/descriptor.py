"""The descriptor of a resource: its metadata as JSON on the latched topic ``<resource>/descriptor``.

The topic crosses the mesh like any other, so every module sees what each resource offers and needs. The names of the
fields are part of the wire format.
"""

from __future__ import annotations

from typing import Final

import msgspec

from rmpa.core.errors import LimitExceeded, RemoteProtocolError
from rmpa.ros import limits

VERSION: Final = 1
TOPIC: Final = "descriptor"
# Of the topic of its parameters, and of the service that sets them.
CONFIG_TYPE: Final = "dynamic_reconfigure/Config"
SERVICE_TYPE: Final = "dynamic_reconfigure/Reconfigure"
# The value of the topic ``quality`` that says for how long its level has been the same.
LEVEL_FOR: Final = "level_for"


class TopicDescriptor(msgspec.Struct, frozen=True):
    """An output or input.

    Attributes:
        name: The declared name.
        topic: Global name of the topic in the resource's module.
        type: Name of the message type.
        contract: The contract's values that differ from the defaults, by key.
        required: For inputs only: whether the resource is stale without a publisher.
        observed: Whether another node has the topic, and the resource only measures it.
        label: The prefix of its measured attributes, where that is not made of its name.
    """

    name: str
    topic: str
    type: str
    contract: dict[str, str | int | float | None] = {}
    required: bool = True
    observed: bool = False
    label: str = ""


class ParameterDescriptor(msgspec.Struct, frozen=True, kw_only=True):
    """A parameter.

    Attributes:
        type: The type's name in dynamic_reconfigure.
        binding: Where another node has the value: ``driver dynamic frame_rate``; empty: the resource itself has it.
    """

    name: str
    type: str
    default: bool | int | float | str
    low: float | None = None
    high: float | None = None
    choices: tuple[bool | int | float | str, ...] = ()
    unit: str = ""
    description: str = ""
    binding: str = ""


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
    """A System Profile.

    Attributes:
        offers: Values by attribute, in the attributes' units, as its author declared them.
        sets: The values of parameters in it, by name.
        nodes: The declared nodes that must run in it, besides those that always run.
    """

    name: str
    offers: dict[str, float | str]
    cost: float = 0.0
    best_effort: bool = False
    description: str = ""
    sets: dict[str, bool | int | float | str] = {}
    nodes: tuple[str, ...] = ()


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


class NodeDescriptor(msgspec.Struct, frozen=True):
    """A node that exists without the resource.

    Attributes:
        key: Its name in the declaration.
        name: Its global name in the resource's module.
        how: How it is started: ``run PACKAGE EXECUTABLE``, ``launch PACKAGE FILE``, ``command``; else ``attached``.
    """

    key: str
    name: str
    how: str = "attached"


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
        file: Base name of the file that declares it, or empty.
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
    nodes: tuple[NodeDescriptor, ...] = ()
    file: str = ""

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
