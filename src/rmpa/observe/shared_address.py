"""Finds peers that share an IP address with another machine.

Each agent has a mesh port of its own, so two machines with one address do not share a GUID: the roster takes them for
two agents of one machine. What tells them apart is TCP. The beacons of both come, because multicast needs no reply;
connections to the address reach only one machine, and the other machine's port is refused there.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import msgspec

from rmpa.discovery import limits

if TYPE_CHECKING:
    from collections.abc import Collection, Sequence

    from rmpa.observe.snapshot import PeerInfo


def mark_shared_addresses(peers: Sequence[PeerInfo], own: Collection[str]) -> tuple[PeerInfo, ...]:
    """Put peers whose address seems to be another machine's too into the state ``conflict``.

    Args:
        peers: All peers.
        own: This machine's addresses.

    Returns:
        The same peers in the same order.
    """
    holders: dict[str, list[PeerInfo]] = {}
    for peer in peers:
        holders.setdefault(_address(peer), []).append(peer)
    return tuple(_marked(peer, holders[_address(peer)], own) if _is_deaf(peer) else peer for peer in peers)


def _address(peer: PeerInfo) -> str:
    return peer.guid.rpartition(":")[0]


def _is_deaf(peer: PeerInfo) -> bool:
    """Whether its beacons come, though TCP has not reached it for a while."""
    return (
        peer.state == "linking"
        and peer.since_ago >= limits.ADDRESS_SHARED_AFTER
        and peer.beacon_ago is not None
        # An agent that was killed is silent from the moment that its link fell.
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
