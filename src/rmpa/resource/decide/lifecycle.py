"""The life cycle of a resource, in the words of ROS 2's managed nodes (design.ros2.org/articles/node_lifecycle).

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
    """Where a resource stands."""

    UNCONFIGURED = "unconfigured"
    """It is there, and has nothing of what it works with."""
    INACTIVE = "inactive"
    """Ready: parameters can be set; nothing runs and nothing is published."""
    ACTIVE = "active"
    """Its tasks run."""
    FINALIZED = "finalized"
    """Over."""


class Transition(StrEnum):
    """What leads from one state to another."""

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
"""Where each transition leads; what is not here cannot be."""


class LifeCycle:
    """One resource's state; the driver calls the hooks and then says how they ended."""

    def __init__(self) -> None:
        self._state = LifecycleState.UNCONFIGURED
        self._under_way: Transition | None = None
        self.problem = ""
        """Why the last transition failed, or empty."""

    @property
    def state(self) -> LifecycleState:
        """Where it stands; during a transition still where that began."""
        return self._state

    @property
    def under_way(self) -> Transition | None:
        """The transition whose hook runs."""
        return self._under_way

    def begin(self, transition: Transition) -> None:
        """Begin a transition; ``succeeded`` or ``failed`` ends it.

        Raises:
            LocalProtocolError: It does not begin at this state, or another one is under way.
        """
        if self._under_way is not None:
            raise LocalProtocolError(f"{transition} while {self._under_way} is under way")
        if (self._state, transition) not in TRANSITIONS:
            raise LocalProtocolError(f"{self._state} does not lead anywhere by {transition}")
        self._under_way = transition

    def succeeded(self) -> LifecycleState:
        """The hook has ended well; return the new state."""
        if self._under_way is None:
            raise LocalProtocolError("no transition is under way")
        self._state = TRANSITIONS[self._state, self._under_way]
        self._under_way = None
        self.problem = ""
        return self._state

    def failed(self, why: str) -> LifecycleState:
        """The hook has raised; return the state, which is the old one, but ``finalize`` and ``deactivate`` succeed.

        What ends must end, whatever its own clearing up says.
        """
        transition = self._under_way
        if transition in (Transition.FINALIZE, Transition.DEACTIVATE):
            state = self.succeeded()
        else:
            self._under_way = None
            state = self._state
        self.problem = f"{transition}: {why}"
        return state
