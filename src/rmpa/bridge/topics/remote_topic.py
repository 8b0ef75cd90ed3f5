"""One source of a peer as the local graph shows it, and the states of its route. Pure.

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
    from rmpa.core.counters import Backoff


class RouteState(Enum):
    """The state of a remote source's route."""

    IDLE = auto()
    """No route: the source has no local listener."""
    OPENING = auto()
    """Requested; the peer has not answered yet."""
    OPEN = auto()
    """Data flows."""
    LINGERING = auto()
    """Data still flows after the last listener has left; for ``limits.ROUTE_LINGER``."""
    WAITING = auto()
    """The route was lost although a node listens; it will be requested again."""


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
    """One source of one peer.

    Args:
        type: Its message type.
        topic: Its topic in the local graph.
        shown: Whether it is in the local graph.
        hidden: Why it is not, or empty.
        denied: Whether it is hidden because no permission lets its module publish it here.
        conflict: Whether it is hidden because a local node publishes the topic with another type, or, for ``/clock``,
            because time already has another source.
        state: The state of its route.
        route: The route's id while it is requested or open, else 0.
        timer: When the state's time is over, monotonic seconds; ``None``: no timer.
        description: The header of its publisher, once known.
        problem: Why the last attempt failed, or empty.
        wanted: Whether a local node listens.
        contract: The contract of its last open route; ``None`` before the first one.
        asked: The contract that was last requested.
        serial: Identifies the timer among earlier ones.
        origin: Its module and node, if its peer only relays it.
        crowded: Whether it is hidden because of ``limits.nodes``.
        direct: Whether a local node is connected to its publisher directly, and only the peer's agent has died.
        backoff: Delays between attempts to open its route, after the first one that failed.
    """

    type: str
    topic: str
    shown: bool = False
    hidden: str = ""
    denied: bool = False
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
    direct: bool = False
    backoff: Backoff | None = None

    def enter(self, state: RouteState, timer: float | None = None) -> None:
        """Change the route's state.

        Raises:
            LocalProtocolError: ``TRANSITIONS`` does not allow it.
        """
        if state not in TRANSITIONS[self.state]:
            raise LocalProtocolError(f"{self.state.name} does not lead to {state.name}")
        self.state = state
        self.timer = timer

    def outlives(self, *, silent: bool) -> bool:
        """Whether the source stays in the local graph when its peer's link is gone.

        Only a source with a listener does. A reliable one stays, so that no message is lost. A latched one stays if
        the link fell silent (``silent``): its subscribers stay connected and do not get the same message again when
        the peer is back, and new subscribers get it meanwhile. A relayed one does not stay, because another relay may
        offer it. A source with direct subscribers stays if only its agent has died: its messages go on.
        """
        if self.direct:
            return True
        if not self.wanted or self.origin is not None or self.state not in _LISTENED:
            return False
        if silent and self.description is not None and self.description.latching:
            return True
        return self.contract is not None and self.contract.reliability is Reliability.RELIABLE

    @property
    def outage(self) -> float:
        """For how many seconds it outlives its link: the contract's outage, or the default if it is not reliable."""
        if self.contract is not None and self.contract.reliability is Reliability.RELIABLE:
            return self.contract.outage
        return core_limits.RESUME_WINDOW
