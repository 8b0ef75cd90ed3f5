"""The life cycle of a resource: the states of ROS 2's managed nodes (design.ros2.org/articles/node_lifecycle).

::

    unconfigured ──configure──► inactive ──activate──► active
                                    ▲                    │
                                    └─────deactivate─────┘
    any of them ──finalize──► finalized
"""

from __future__ import annotations

from enum import StrEnum
from typing import TYPE_CHECKING, Final

from rmpa.core.errors import LocalProtocolError

if TYPE_CHECKING:
    from collections.abc import Mapping


class LifecycleState(StrEnum):
    """State of a resource in its life cycle."""

    UNCONFIGURED = "unconfigured"
    """The node is registered; the device is not open yet."""
    INACTIVE = "inactive"
    """Parameters can be set; no task runs and nothing is published."""
    ACTIVE = "active"
    """The tasks run, and outputs are published."""
    FINALIZED = "finalized"
    """The resource has ended; no transition leads out of this state."""


class Transition(StrEnum):
    """Transition between two states of the life cycle."""

    CONFIGURE = "configure"
    ACTIVATE = "activate"
    DEACTIVATE = "deactivate"
    FINALIZE = "finalize"


_S, _T = LifecycleState, Transition
TRANSITIONS: Final[Mapping[tuple[LifecycleState, Transition], LifecycleState]] = {
    (_S.UNCONFIGURED, _T.CONFIGURE): _S.INACTIVE,
    (_S.INACTIVE, _T.ACTIVATE): _S.ACTIVE,
    (_S.ACTIVE, _T.DEACTIVATE): _S.INACTIVE,
    (_S.UNCONFIGURED, _T.FINALIZE): _S.FINALIZED,
    (_S.INACTIVE, _T.FINALIZE): _S.FINALIZED,
    (_S.ACTIVE, _T.FINALIZE): _S.FINALIZED,
}
"""Target state of each valid transition."""


class LifeCycle:
    """State machine of one resource's life cycle; its driver calls the user's callbacks and reports their outcome."""

    def __init__(self) -> None:
        self._state = LifecycleState.UNCONFIGURED
        self._under_way: Transition | None = None

    @property
    def state(self) -> LifecycleState:
        """The present state; during a transition the state in which the transition began."""
        return self._state

    @property
    def under_way(self) -> Transition | None:
        """The transition whose callback runs; ``None``: no transition is under way."""
        return self._under_way

    def begin(self, transition: Transition) -> None:
        """Begin a transition; ``succeeded`` or ``failed`` ends it.

        Raises:
            LocalProtocolError: The transition is not valid in this state, or another one is under way.
        """
        if self._under_way is not None:
            raise LocalProtocolError(f"{transition} while {self._under_way} is under way")
        if (self._state, transition) not in TRANSITIONS:
            raise LocalProtocolError(f"{self._state} does not lead anywhere by {transition}")
        self._under_way = transition

    def succeeded(self) -> LifecycleState:
        """End the transition after its callback has returned, and return the new state.

        Raises:
            LocalProtocolError: No transition is under way.
        """
        if self._under_way is None:
            raise LocalProtocolError("no transition is under way")
        self._state = TRANSITIONS[self._state, self._under_way]
        self._under_way = None
        return self._state

    def failed(self) -> LifecycleState:
        """End the transition after its callback has raised, and return the resulting state.

        The state stays the same, except after ``finalize`` and ``deactivate``: an error must not prevent these.
        """
        if self._under_way in (Transition.FINALIZE, Transition.DEACTIVATE):
            return self.succeeded()
        self._under_way = None
        return self._state
