"""The descriptor of a resource, and the schedule of its tasks.

The descriptor of a resource: its metadata as JSON on the latched topic ``<resource>/descriptor``.

The topic crosses the mesh like any other, so every module sees what each resource offers and needs. The names of the
fields are part of the wire format.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, TypeVar

import msgspec

from rmpa.core.contract import KEYS, Contract
from rmpa.core.errors import LimitExceeded, RemoteProtocolError
from rmpa.resource import limits

if TYPE_CHECKING:
    from rmpa.resource.declare.attributes import Attribute
    from rmpa.resource.declare.parameters import Input, Output
    from rmpa.resource.declare.resource import Resource

VERSION: Final = 1
TOPIC: Final = "descriptor"
_DEFAULT: Final = Contract()
_Kind = TypeVar("_Kind", bound=msgspec.Struct)


class TopicDescriptor(msgspec.Struct, frozen=True, kw_only=True):
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


class AttributeDescriptor(msgspec.Struct, frozen=True, kw_only=True):
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


class ContextDescriptor(msgspec.Struct, frozen=True, kw_only=True):
    """A context; empty ``profiles`` allow every profile, and with ``outputs`` of ``None`` all outputs publish."""

    name: str
    when: str = ""
    requires: dict[str, str] = {}
    profiles: tuple[str, ...] = ()
    outputs: tuple[str, ...] | None = None


class TaskDescriptor(msgspec.Struct, frozen=True, kw_only=True):
    """A task: runs at ``rate`` Hz, which the parameter ``follows`` may change, or on messages of the input ``on``."""

    name: str
    rate: float | None = None
    on: str = ""
    follows: str = ""


class DemandDescriptor(msgspec.Struct, frozen=True, kw_only=True):
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
        attributes=tuple(_attribute(name, attribute) for name, attribute in resource.attributes.items()),
        profiles=tuple(_convert(p.profile, ProfileDescriptor) for p in resource.profiles.values()),
        contexts=tuple(
            ContextDescriptor(
                name=c.name,
                when=c.when,
                requires={key: str(request) for key, request in c.requires.items()},
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
                follows=t.rate_parameter.name if t.rate_parameter is not None else "",
            )
            for t in resource.tasks.values()
        ),
        asks=tuple(
            DemandDescriptor(
                resource=d.resource,
                wishes={key.replace("__", "."): str(request) for key, request in d.requests.items()},
                priority=d.priority,
            )
            for d in resource.demands.values()
        ),
    )


def _convert(declared: object, kind: type[_Kind]) -> _Kind:
    """Make a descriptor from a declaration's attributes of the same names."""
    return msgspec.convert(declared, kind, from_attributes=True)


def topic_of(name: str, node: str) -> str:
    """The global name of an output or input; relative names are in the resource's own namespace."""
    return name if name.startswith("/") else f"{node}/{name}"


def _topic(topic: Output | Input, node: str, *, required: bool = True) -> TopicDescriptor:
    values = {key: getattr(topic.contract, key) for key in KEYS}
    contract = {key: value for key, value in values.items() if value != getattr(_DEFAULT, key)}
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


# Schedules and statistics of tasks, and back-off times after failures. Pure: the time is an argument.


RESTART_FIRST: Final = 0.1
"""Seconds of the back-off after a task's first failure."""
RESTART_MAX: Final = 5.0
"""Seconds of the longest back-off."""
STUCK_PERIODS: Final = 10
"""Number of periods after which a run is stuck, unless declared otherwise."""
STUCK_LEAST: Final = 5.0
"""Lower bound in seconds of the time after which a run is stuck, unless declared otherwise."""
_EARLY: Final = 1e-9


class Schedule:
    """The due times of a periodic task: start, start + period, start + 2 periods and so on.

    The times are absolute, so that lateness does not add up. A due time that is a whole period past is skipped.

    Args:
        period: The period in seconds, above 0.
        start: The first due time, in monotonic seconds.
    """

    def __init__(self, period: float, start: float) -> None:
        self.period = period
        self.missed = 0
        """Number of skipped due times."""
        self._start = start
        self._tick = -1

    def next_due(self, now: float) -> float:
        """Advance to the next due time and return it, in monotonic seconds like ``now``."""
        self._tick += 1
        late = math.floor((now - self._start) / self.period + _EARLY) - self._tick
        if late > 0:
            self._tick += late
            self.missed += late
        return self._start + self._tick * self.period


@dataclass(frozen=True, slots=True)
class TaskReport:
    """Statistics of a task over one window.

    Args:
        runs: Number of runs.
        overruns: Runs that took more than a period.
        missed: Due times that were skipped because of overruns.
        dropped: Messages of the task's input that were dropped because the task was too slow.
    """

    runs: int = 0
    overruns: int = 0
    missed: int = 0
    dropped: int = 0


def too_slow(report: TaskReport, period: float | None) -> str:
    """The reason why a task was too slow in a window, for people; empty if it was not.

    A task was too slow if more than a tenth of its runs took longer than its period, or if messages of its input were
    dropped. A single slow run does not count, because load of the machine may have caused it.

    Args:
        report: The statistics of the window.
        period: The period in seconds; ``None`` for a task that runs on messages.
    """
    if report.dropped:
        return f"{report.dropped} messages of its input gave way to newer ones, {report.runs} were taken"
    if period is None or report.overruns * 10 <= report.runs:
        return ""
    left_out = f", {report.missed} times left out" if report.missed else ""
    return f"{report.overruns} of {report.runs} runs took longer than its period of {period:.3g} s{left_out}"


class TaskFigures:
    """Measures one task: updated by the thread that runs the task, read by the event loop.

    Args:
        period: The period in seconds; ``None`` for a task that runs on messages.
    """

    def __init__(self, period: float | None) -> None:
        self.period = period
        self.running_since: float | None = None
        """When the present run began, in monotonic seconds; ``None`` between two runs."""
        self.in_a_row = 0
        """Number of failures since the last run that succeeded."""
        self.missed = 0
        self.dropped = 0
        self._runs = 0
        self._overruns = 0

    def ended(self, now: float, *, failed: bool = False) -> None:
        """Record that the run has ended; ``now`` in monotonic seconds."""
        took = now - self.running_since if self.running_since is not None else 0.0
        self.running_since = None
        self._runs += 1
        self._overruns += self.period is not None and took > self.period
        self.in_a_row = self.in_a_row + 1 if failed else 0

    def window(self) -> TaskReport:
        """End the window and return its statistics."""
        report = TaskReport(self._runs, self._overruns, self.missed, self.dropped)
        self._runs = self._overruns = self.missed = self.dropped = 0
        return report


def restart_delay(in_a_row: int) -> float:
    """The back-off in seconds after ``in_a_row`` consecutive failures."""
    return min(RESTART_FIRST * 2.0 ** min(max(0, in_a_row - 1), 16), RESTART_MAX)


def stuck_after(period: float | None, declared: float | None) -> float:
    """Seconds after which a run counts as stuck: as declared, or else from the period (``None``: on messages)."""
    if declared is not None:
        return declared
    return max(STUCK_LEAST, STUCK_PERIODS * period) if period is not None else STUCK_LEAST
