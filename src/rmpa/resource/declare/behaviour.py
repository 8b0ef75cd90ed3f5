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
"""Takes no argument if periodic, the message if it runs on an input."""


class OnFailure(StrEnum):
    """Restart policy of a task that raised or is stuck."""

    RESTART = "restart"
    """It runs again, after a back-off that grows with each failure in a row."""
    STOP = "stop"
    """It ends; the resource runs on without it and reports it."""
    DEACTIVATE = "deactivate"
    """The whole resource becomes inactive."""


@dataclass(frozen=True, slots=True)
class DeclaredProfile:
    """A System Profile with the function that applies it."""

    profile: Profile
    apply: Hook
    needs: Callable[[], str | bool | None] | None = None
    """Its precondition: true or ``None`` while the profile may be used; else false, or a text with the reason."""


@dataclass(frozen=True, slots=True)
class Context:
    """A situation of the robot: what it requires, and which outputs are published in it.

    Args:
        name: Unique.
        when: A rule over topics and parameters (``resource.declare.context_rules``) that selects it, or empty.
        requires: QoS requests to the resource itself, by attribute.
        profiles: The only profiles that may run in it; empty: any.
        outputs: The only outputs that are published in it; ``None``: all.
        enter: Called when it begins.
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
        name: Unique; the function's name by default.
        function: Plain (then it runs in a thread of its own) or ``async``.
        rate: Hz of a periodic one, else ``None``.
        on: The input whose messages it runs on, else ``None``.
        on_failure: Restart policy when it raises or is stuck.
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
