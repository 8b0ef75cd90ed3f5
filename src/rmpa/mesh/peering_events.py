"""The orders and events of the peering machine, and the status of a peer; see ``mesh.peering``."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum
from typing import TYPE_CHECKING, Final, Literal

from rmpa.mesh.handshake import Refusal, Refuse
from rmpa.trust.certificates import TrustReason

if TYPE_CHECKING:
    from rmpa.core.identity import Guid, Identity

SocketAddress = tuple[str, int]

SELDOM_MENDED: Final = frozenset(
    {
        Refusal.VERSION,
        Refusal.DOMAIN,
        Refusal.DUPLICATE,
        Refusal.MALFORMED,
        Refusal.LANE,
        Refusal.FULL,
        TrustReason.PLAIN,
        TrustReason.FOREIGN,
        TrustReason.EXPIRED,
        TrustReason.REVOKED,
        TrustReason.NAME,
        TrustReason.DOWNGRADE,
    }
)
"""Refusals for reasons that seldom pass by themselves."""
UNPROVEN: Final = frozenset({TrustReason.UNSECURED, TrustReason.CLOCK})
"""Refusals without proof of the sender, or that pass once a clock is set: they are shown, and change no pause."""
OTHER_PEER: Final = frozenset({Refusal.MYSELF, Refusal.WRONG_PEER})
"""Refusals that concern one endpoint only, because another agent, or this agent itself, answered there."""


@dataclass(frozen=True, slots=True)
class Dial:
    """Connect to this peer, at the endpoint that answers first.

    Args:
        guid: The peer.
        endpoints: Its endpoints, best first; a peer with several addresses may be reachable at some of them only.
        briefly: Whether to give up after one short attempt at each, because the next ``Dial`` follows soon.
    """

    guid: Guid
    endpoints: tuple[SocketAddress, ...]
    briefly: bool = False


@dataclass(frozen=True, slots=True)
class CloseLink:
    """Send a bye on this link and close it."""

    link_id: int
    reason: str


@dataclass(frozen=True, slots=True)
class LinkUp:
    """This link is the one that is used with its peer."""

    link_id: int
    identity: Identity


class LinkDownCause(Enum):
    """Why a link is no longer used; the value is the text for users."""

    REPLACED = "replaced by a newer link"
    """The same run of the peer has another link from the same moment on."""
    RESTARTED = "the peer restarted"
    """Another run of the peer has taken its place."""
    ENDED = "the connection ended"
    """The connection of its express lane ended; ``LinkDown.reason`` says how."""


@dataclass(frozen=True, slots=True)
class LinkDown:
    """The link that was used with this peer is no longer used.

    Args:
        link_id: Its number.
        identity: The peer.
        cause: The kind of its end.
        reason: Why, for people.
    """

    link_id: int
    identity: Identity
    cause: LinkDownCause
    reason: str


@dataclass(frozen=True, slots=True)
class LinkRefused:
    """A peer refuses links for a reason that was not reported before; ``refuse`` says what to do."""

    identity: Identity
    refuse: Refuse


PeeringOutput = Dial | CloseLink | LinkUp | LinkDown | LinkRefused


@dataclass(frozen=True, slots=True)
class PeerStatus:
    """The state of one peer, for the snapshot.

    Args:
        identity: The peer.
        state: ``refused``: waiting after a refusal for a reason that seldom passes by itself.
        link_id: Its link, if linked.
        lower: Whether this agent has the lower GUID of the two, and dials first.
        since: When the link came up, or the last link fell, monotonic seconds; ``None`` before the first link.
        attempts: Dials since the last link.
        last_error: Why there is no link, as far as is known; for a linked peer, why its previous link ended.
        next_attempt: When it is dialled next, monotonic seconds.
        endpoint: The endpoint that is dialled, or was dialled last.
        foreign: Why it is not of this mesh, if its last refusal says so.
    """

    identity: Identity
    state: Literal["linked", "dialling", "waiting", "refused"]
    link_id: int | None
    lower: bool
    since: float | None
    attempts: int
    last_error: str
    next_attempt: float | None
    endpoint: SocketAddress | None
    foreign: TrustReason | None = None
