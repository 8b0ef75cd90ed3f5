"""One topic of one peer as it stands here, and the states of its route. Pure.

::

    idle ──wanted──► opening ──opened──► open ──unwanted──► lingering ──time──► idle
      ▲                 │ closed, time      │ closed             │ wanted
      │ unwanted        ▼                   ▼                    ▼
      └────────────── waiting ◄────────────────                 open
                        │ time ──► opening
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum, auto
from typing import TYPE_CHECKING, Final

from rmpa.core import limits as core_limits
from rmpa.core.contract import Contract, Reliability
from rmpa.core.errors import LocalProtocolError

if TYPE_CHECKING:
    from collections.abc import Mapping

    from rmpa.bridge.messages import Description, Origin
    from rmpa.core.backoff import Backoff


class RouteState(Enum):
    """Where a remote source's route stands."""

    IDLE = auto()
    """Visible in the local graph, without a listener."""
    OPENING = auto()
    """Asked for, not answered."""
    OPEN = auto()
    """Data flows."""
    LINGERING = auto()
    """Data flows without a listener; perhaps one comes back."""
    WAITING = auto()
    """It was closed although a node listens; it will be asked for again."""


_S = RouteState
TRANSITIONS: Final[Mapping[RouteState, frozenset[RouteState]]] = {
    _S.IDLE: frozenset({_S.OPENING}),
    _S.OPENING: frozenset({_S.OPEN, _S.WAITING, _S.IDLE}),
    _S.OPEN: frozenset({_S.LINGERING, _S.WAITING}),
    _S.LINGERING: frozenset({_S.OPEN, _S.IDLE}),
    _S.WAITING: frozenset({_S.OPENING, _S.IDLE}),
}


_LISTENED: Final = frozenset({RouteState.OPENING, RouteState.OPEN, RouteState.WAITING})


@dataclass(slots=True)
class RemoteTopic:
    """One source of one peer, as we see it.

    Args:
        type: Its message type.
        topic: The topic that it is here.
        backoff: Delays between attempts.
        shown: Whether it is in the local graph.
        hidden: Why it is not, or empty.
        conflict: Whether that is because a local node publishes the topic with another type, or time has come from
            elsewhere before.
        state: Where its route stands.
        route: The route's id while it is asked for or open, else 0.
        timer: When the state is looked at again, monotonic seconds.
        description: What its messages are, once known.
        problem: Why the last attempt failed, or empty.
        wanted: Whether a local node listens.
        contract: What holds for its route, once it was open.
        asked: What was last asked for.
        serial: Of the timer.
        origin: Its module and node, if its peer only passes it on.
        crowded: Whether it is hidden because its node has no place here (``limits.nodes``).
    """

    type: str
    topic: str
    backoff: Backoff
    shown: bool = False
    hidden: str = ""
    conflict: bool = False
    state: RouteState = RouteState.IDLE
    route: int = 0
    timer: float | None = None
    description: Description | None = None
    problem: str = ""
    wanted: bool = False
    contract: Contract | None = None
    asked: Contract | None = None
    serial: int = 0
    origin: Origin | None = None
    crowded: bool = False

    def enter(self, state: RouteState, timer: float | None = None) -> None:
        """Change the route's state as the table allows."""
        if state not in TRANSITIONS[self.state]:
            raise LocalProtocolError(f"{self.state.name} does not lead to {state.name}")
        self.state = state
        self.timer = timer

    def outlives(self, *, silent: bool) -> bool:
        """Whether it stays when its peer's link is gone.

        A reliable one does, so that nothing is lost. A latched one does if the link fell silent: its subscribers stay
        connected, and are not sent again what they have when the peer is back; late ones get it meanwhile. One that
        is relayed does not: another relay may bring it on.
        """
        if not self.wanted or self.origin is not None or self.state not in _LISTENED:
            return False
        if silent and self.description is not None and self.description.latching:
            return True
        return self.contract is not None and self.contract.reliability is Reliability.RELIABLE

    @property
    def outage(self) -> float:
        """For how many seconds it stays when it outlives its link: latched ones wait as by default."""
        if self.contract is not None and self.contract.reliability is Reliability.RELIABLE:
            return self.contract.outage
        return core_limits.RESUME_WINDOW
