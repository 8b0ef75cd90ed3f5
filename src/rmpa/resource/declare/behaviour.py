"""What a resource does: its tasks, the profiles that it may run in, the contexts that it may be in."""

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
"""Without arguments if periodic; with the message if it runs on an input."""


class OnFailure(StrEnum):
    """What becomes of a task that raised, or that is stuck."""

    RESTART = "restart"
    """It goes on, after a pause that grows with each failure in a row."""
    STOP = "stop"
    """It ends; the resource goes on without it, and says so."""
    DEACTIVATE = "deactivate"
    """The whole resource becomes inactive."""


@dataclass(frozen=True, slots=True)
class DeclaredProfile:
    """A System Profile with what applies it."""

    profile: Profile
    apply: Hook
    needs: Callable[[], str | bool | None] | None = None
    """Its precondition: true or ``None`` while it can be taken; else false, or a text why it cannot."""


@dataclass(frozen=True, slots=True)
class Context:
    """A situation of the robot: what it requires, and which information flows.

    Args:
        name: Unique.
        when: A rule over topics and parameters (``resource.declare.context_rules``) that chooses it, or empty.
        requires: What it asks of the resource's quality, by attribute.
        profiles: The only profiles that may run in it; empty: any.
        outputs: The only outputs that flow in it; ``None``: all.
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
    """Something that the resource does again and again.

    Args:
        name: Unique; the function's name by default.
        function: Plain (then it runs in a thread of its own) or ``async``.
        rate: Hz of a periodic one, else ``None``.
        on: The input whose messages it runs on, else ``None``.
        on_failure: What becomes of it when it raises or is stuck.
        stuck_after: Seconds that one run may take before it counts as stuck; ``None``: ten periods, at least 5 s.
        follows: The parameter whose value is the rate, if there is one; profiles and people change it.
    """

    name: str
    function: TaskFunction
    rate: float | None = None
    on: Input | None = None
    on_failure: OnFailure = OnFailure.RESTART
    stuck_after: float | None = None
    follows: Parameter | None = None
