"""The life cycle of a resource, with the states of ROS 2's managed nodes (design.ros2.org/articles/node_lifecycle).

::

    unconfigured ──configure──► inactive ──activate──► active
         ▲                       │  ▲                   │
         └───────cleanup─────────┘  └────deactivate─────┘
    any of them ──finalize──► finalized
"""

from __future__ import annotations

from enum import StrEnum
from typing import TYPE_CHECKING, Final

from rmpa.core.errors import LocalProtocolError

if TYPE_CHECKING:
    from collections.abc import Mapping


class LifecycleState(StrEnum):
    """State of a resource."""

    UNCONFIGURED = "unconfigured"
    """Registered; holds no resources of the device yet."""
    INACTIVE = "inactive"
    """Parameters can be set; no task runs and nothing is published."""
    ACTIVE = "active"
    """Its tasks run."""
    FINALIZED = "finalized"
    """Terminal."""


class Transition(StrEnum):
    """Transition between two states."""

    CONFIGURE = "configure"
    CLEANUP = "cleanup"
    ACTIVATE = "activate"
    DEACTIVATE = "deactivate"
    FINALIZE = "finalize"


_S, _T = LifecycleState, Transition
TRANSITIONS: Final[Mapping[tuple[LifecycleState, Transition], LifecycleState]] = {
    (_S.UNCONFIGURED, _T.CONFIGURE): _S.INACTIVE,
    (_S.INACTIVE, _T.CLEANUP): _S.UNCONFIGURED,
    (_S.INACTIVE, _T.ACTIVATE): _S.ACTIVE,
    (_S.ACTIVE, _T.DEACTIVATE): _S.INACTIVE,
    (_S.UNCONFIGURED, _T.FINALIZE): _S.FINALIZED,
    (_S.INACTIVE, _T.FINALIZE): _S.FINALIZED,
    (_S.ACTIVE, _T.FINALIZE): _S.FINALIZED,
}
"""Target state of each valid transition."""


class LifeCycle:
    """State machine of one resource; the driver calls the user's callbacks and reports how they ended."""

    def __init__(self) -> None:
        self._state = LifecycleState.UNCONFIGURED
        self._under_way: Transition | None = None
        self.problem = ""
        """Why the last transition failed, or empty."""

    @property
    def state(self) -> LifecycleState:
        """The state; during a transition the one where that began."""
        return self._state

    @property
    def under_way(self) -> Transition | None:
        """The transition whose callback runs."""
        return self._under_way

    def begin(self, transition: Transition) -> None:
        """Begin a transition; ``succeeded`` or ``failed`` ends it.

        Raises:
            LocalProtocolError: It is not valid in this state, or another one is under way.
        """
        if self._under_way is not None:
            raise LocalProtocolError(f"{transition} while {self._under_way} is under way")
        if (self._state, transition) not in TRANSITIONS:
            raise LocalProtocolError(f"{self._state} does not lead anywhere by {transition}")
        self._under_way = transition

    def succeeded(self) -> LifecycleState:
        """The callback has returned; return the new state."""
        if self._under_way is None:
            raise LocalProtocolError("no transition is under way")
        self._state = TRANSITIONS[self._state, self._under_way]
        self._under_way = None
        self.problem = ""
        return self._state

    def failed(self, why: str) -> LifecycleState:
        """The callback has raised; return the state.

        That is the old one, except after ``finalize`` and ``deactivate``: an error must not prevent the end.
        """
        transition = self._under_way
        if transition in (Transition.FINALIZE, Transition.DEACTIVATE):
            state = self.succeeded()
        else:
            self._under_way = None
            state = self._state
        self.problem = f"{transition}: {why}"
        return state
