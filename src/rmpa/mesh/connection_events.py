"""The events that the protocol machine of a connection reports; see ``mesh.connection``."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rmpa.mesh.frames import FrameKind
    from rmpa.mesh.handshake import Hello, Refuse


@dataclass(frozen=True, slots=True)
class HelloReceived:
    """Acceptor: a hello was received; the driver answers it with ``accept`` or ``refuse``."""

    hello: Hello


@dataclass(frozen=True, slots=True)
class HandshakeDone:
    """Both sides accepted the connection; frames may be sent."""

    hello: Hello


@dataclass(frozen=True, slots=True)
class ControlReceived:
    """A control frame was received.

    Args:
        payload: A copy of its bytes.
    """

    payload: bytes


@dataclass(frozen=True, slots=True)
class PongReceived:
    """The answer to a ping was received.

    Args:
        stamp: The time stamp of the ping, which identifies it.
        rtt: Round trip on the wire in seconds, without the time that the remote side took to answer.
    """

    stamp: int
    rtt: float


@dataclass(frozen=True, slots=True)
class Refused:
    """One of the two sides refused the connection. ``ConnectionClosed`` follows.

    Args:
        refuse: Why.
        by_us: Whether this side refused.
    """

    refuse: Refuse
    by_us: bool


@dataclass(frozen=True, slots=True)
class ConnectionClosed:
    """The connection is over: the driver sends the remaining output and closes the socket.

    Args:
        reason: Why, for people.
    """

    reason: str


@dataclass(frozen=True, slots=True)
class MarkReceived:
    """An acknowledgement, a fence, the answer to a fence, or the wish for the bulk lane was received.

    Args:
        kind: ``ACK``, ``FENCE``, ``FENCED`` or ``LANE``.
        route: The id of the route.
        sequence: For ``ACK`` the last message that arrived; otherwise the fence's number.
    """

    kind: FrameKind
    route: int
    sequence: int


ConnectionEvent = (
    HelloReceived | HandshakeDone | ControlReceived | PongReceived | MarkReceived | Refused | ConnectionClosed
)
