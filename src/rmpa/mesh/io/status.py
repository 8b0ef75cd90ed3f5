"""What the monitor is told of each connection."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

from rmpa.mesh.handshake import Lane

if TYPE_CHECKING:
    from rmpa.core.guid import Guid
    from rmpa.mesh.io.link import MeshLink


@dataclass(frozen=True, slots=True)
class LinkStatus:
    """One connection, for the monitor. Times in monotonic seconds, sizes in bytes.

    Args:
        id: The mesh's number for it.
        name: The other side's name, or its address before it said its name.
        guid: The other side's, once known.
        state: ``handshaking``, ``up``, ``closing`` or ``closed``.
        used: Whether it is the link that is used with its peer.
        dialled: Whether we dialled.
        remote_endpoint: The other end.
        since: When it came up.
        rtt: The last round trip in seconds.
        clock_offset: Seconds that the other side's wall clock is ahead of ours.
        clock_error: The offset is true within ± this.
        bytes_in: Received.
        bytes_out: Sent.
        queue_bytes: Waiting for the kernel.
        dropped: Messages dropped because the peer took them too slowly.
        bulk: Whether it is a bulk lane's connection.
    """

    id: int
    name: str
    guid: Guid | None
    state: Literal["handshaking", "up", "closing", "closed"]
    used: bool
    dialled: bool
    remote_endpoint: tuple[str, int]
    since: float | None
    rtt: float | None
    clock_offset: float | None
    clock_error: float | None
    bytes_in: int
    bytes_out: int
    queue_bytes: int
    dropped: int
    bulk: bool


def link_status(link: MeshLink) -> LinkStatus:
    """What the monitor is told of a connection."""
    names: dict[str, Literal["handshaking", "up", "closing", "closed"]] = {
        "HANDSHAKING": "handshaking",
        "UP": "up",
        "CLOSING": "closing",
        "CLOSED": "closed",
    }
    return LinkStatus(
        link.id,
        link.name,
        link.remote_guid,
        names[link.state.name],
        link.used,
        link.dialled,
        link.remote_endpoint,
        link.since,
        link.rtt,
        link.clock_offset,
        link.clock_error,
        link.bytes_in,
        link.bytes_out,
        link.queue_bytes,
        link.dropped,
        link.lane == Lane.BULK,
    )
