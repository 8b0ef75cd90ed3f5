"""Behaviour of a resource: its tasks, profiles with their functions, and contexts."""

from __future__ import annotations

from collections.abc import Awaitable, Callable, Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rmpa.resource.declare.connections import Input
    from rmpa.resource.declare.parameters import Parameter
    from rmpa.resource.declare.profiles import Profile
    from rmpa.resource.declare.qos_request import QoSRequest

Hook = Callable[[], Awaitable[None] | None]
TaskFunction = Callable[..., Awaitable[None] | None]
"""The function of a task: a periodic one takes no argument, one that runs on an input takes the message."""


class OnFailure(StrEnum):
    """What happens to a task that has raised or is stuck."""

    RESTART = "restart"
    """The task runs again after a back-off, which grows with each consecutive failure."""
    STOP = "stop"
    """The task ends; the resource reports that and continues without the task."""
    DEACTIVATE = "deactivate"
    """The whole resource becomes inactive."""


@dataclass(frozen=True, slots=True)
class DeclaredProfile:
    """A System Profile with the function that applies it."""

    profile: Profile
    apply: Hook
    needs: Callable[[], str | bool | None] | None = None
    """The precondition: true or ``None`` while the profile may be used, else false or the reason as a text."""


@dataclass(frozen=True, slots=True)
class Context:
    """A state of the world: what it requires, and which profiles and outputs apply in it.

    Args:
        name: Unique within the resource.
        when: A rule over topics and parameters (``resource.declare.context_rules``) that selects the context; empty:
            it is chosen by hand only.
        requires: QoS requests on the resource itself, by attribute.
        profiles: The only profiles that may run in the context; empty: any.
        outputs: The only outputs that are published in the context, by name; ``None``: all.
        enter: Called when the context is entered.
    """

    name: str
    when: str = ""
    requires: Mapping[str, QoSRequest] = field(default_factory=dict, hash=False)
    profiles: tuple[str, ...] = ()
    outputs: tuple[str, ...] | None = None
    enter: Hook | None = None


@dataclass(frozen=True, slots=True)
class Task:
    """A function of the resource that runs periodically or on each message of an input.

    Args:
        name: Unique within the resource; the function's name by default.
        function: A plain function, which runs in a thread of its own, or a coroutine function.
        rate: Rate in Hz of a periodic task; ``None`` for a task that runs on messages.
        on: The input on whose messages the task runs; ``None`` for a periodic task.
        on_failure: What happens when a run raises or is stuck.
        stuck_after: Seconds that one run may take before it counts as stuck; ``None``: ten periods, at least 5 s.
        rate_parameter: The parameter whose value is the rate, or ``None``.
    """

    name: str
    function: TaskFunction
    rate: float | None = None
    on: Input | None = None
    on_failure: OnFailure = OnFailure.RESTART
    stuck_after: float | None = None
    rate_parameter: Parameter | None = None
