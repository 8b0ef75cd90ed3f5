"""One service of one peer, and the states in which it can be called or not. Pure."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum, auto
from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from collections.abc import Mapping

    from rmpa.bridge.messages import Origin
    from rmpa.bridge.services.actions import ServiceAbout


class ServiceRouteState(Enum):
    """Whether a service of a peer can be called now."""

    IDLE = auto()
    """No route is open or asked for."""
    OPENING = auto()
    """The route is asked for, and the peer has not answered."""
    OPEN = auto()
    """The service can be called."""


_S = ServiceRouteState
TRANSITIONS: Final[Mapping[ServiceRouteState, frozenset[ServiceRouteState]]] = {
    _S.IDLE: frozenset({_S.OPENING}),
    _S.OPENING: frozenset({_S.OPEN, _S.IDLE}),
    _S.OPEN: frozenset({_S.IDLE}),
}


@dataclass(slots=True)
class RemoteService:
    """One service of one peer.

    Args:
        wire: Its name on the wire.
        node: Its node, in the peer's graph.
        name: Its name here.
        shown: Whether it is in the local graph.
        hidden: Why it is not in the local graph, or empty.
        denied: Whether it is hidden because no permission lets its module serve it here.
        state: Whether it can be called now.
        route: The route of its replies while it is asked for or open; else 0.
        requests: The route of its requests while it is open; else 0.
        due: While it is asked for: when the peer's answer is overdue, in monotonic seconds.
        about: What its server said of it; ``None`` while that is unknown.
        problem: Why it could not be opened or was closed last, or empty.
        origin: Its module and node, if the peer relays it.
    """

    wire: str
    node: str
    name: str
    shown: bool = False
    hidden: str = ""
    denied: bool = False
    state: ServiceRouteState = ServiceRouteState.IDLE
    route: int = 0
    requests: int = 0
    due: float = 0.0
    about: ServiceAbout | None = None
    problem: str = ""
    origin: Origin | None = None
