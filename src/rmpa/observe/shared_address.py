"""Finds peers that share an IP address with another machine.

Each agent has a mesh port of its own, so the GUIDs of two machines with one address differ, and the roster takes them
for two agents of one machine. TCP shows the difference: the beacons of both arrive, because multicast needs no reply,
but connections to the address reach only one machine, and it refuses the other machine's port.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import msgspec

from rmpa.discovery import limits

if TYPE_CHECKING:
    from collections.abc import Collection, Sequence

    from rmpa.observe.peer_info import PeerInfo


def mark_shared_addresses(peers: Sequence[PeerInfo], own: Collection[str]) -> tuple[PeerInfo, ...]:
    """Set the state ``conflict`` for peers whose address seems to be another machine's too.

    Args:
        peers: All peers.
        own: This machine's addresses.

    Returns:
        The same peers in the same order.
    """
    holders: dict[str, list[PeerInfo]] = {}
    for peer in peers:
        holders.setdefault(_address(peer), []).append(peer)
    return tuple(_marked(peer, holders[_address(peer)], own) if _unreachable_by_tcp(peer) else peer for peer in peers)


def _address(peer: PeerInfo) -> str:
    return peer.guid.rpartition(":")[0]


def _unreachable_by_tcp(peer: PeerInfo) -> bool:
    """Whether its beacons arrive though TCP has not reached it for ``limits.ADDRESS_SHARED_AFTER``."""
    return (
        peer.state == "linking"
        and peer.since_ago >= limits.ADDRESS_SHARED_AFTER
        and peer.beacon_ago is not None
        # An agent that was killed sends no beacons after its link has fallen.
        and peer.beacon_ago < peer.since_ago - limits.ADDRESS_SHARED_MARGIN
        and not _address(peer).startswith("127.")
    )


def _marked(peer: PeerInfo, holders: Sequence[PeerInfo], own: Collection[str]) -> PeerInfo:
    address = _address(peer)
    others = [f"peer {other.name}" for other in holders if other is not peer]
    if address in own:
        others.append("this machine")
    if not others:
        return peer
    port = peer.guid.partition("#")[0].rpartition(":")[2]
    text = (
        f"its address {address} is also that of {' and '.join(others)}, and its port {port} does not answer there: "
        "two machines seem to have one address; give one of them another (was an image copied with its address?), "
        f"or, if both run on one machine, open port {port} in its firewall"
    )
    return msgspec.structs.replace(peer, state="conflict", conflicts=(*peer.conflicts, text))
