"""The peers in an agent's snapshot: each peer of the roster, its link and the link's lanes.

Times are seconds; ``…_ago`` counts back from the snapshot.
"""

from __future__ import annotations

from typing import Final

import msgspec

FOREIGN: Final = "foreign"
"""The state of a module that is heard, or refuses this one, because it is not of this mesh."""


class LaneInfo(msgspec.Struct, kw_only=True, frozen=True):
    """One of the two lanes of a link.

    Attributes:
        name: ``express`` (control and small messages) or ``bulk`` (large ones).
        connected: Whether it has its TCP connection; messages for a lane without one wait.
        unneeded: Whether it has none because nothing was sent on it yet; the first message dials it.
        bytes_in: Bytes that its present connection has received.
        bytes_out: Bytes that its present connection has sent.
        queued: Bytes that wait in its send queue.
        dropped: Messages dropped because it was too slow, since the link came up.
    """

    name: str
    connected: bool
    unneeded: bool = False
    bytes_in: int = 0
    bytes_out: int = 0
    queued: int = 0
    dropped: int = 0


class LinkInfo(msgspec.Struct, kw_only=True, frozen=True):
    """The live link to a peer.

    Attributes:
        remote: ``address:port`` of the other end of the TCP connection.
        dialled: Whether this agent dialled; else the peer did.
        up_ago: Seconds since it came up.
        rtt: The last round trip on the wire, seconds.
        clock_offset: The peer's wall clock less this machine's, seconds.
        clock_error: Bound of that offset's error, ± seconds.
        bytes_in: Received since it came up.
        bytes_out: Sent since it came up.
        queued: Bytes in its send queues.
        dropped: Messages dropped because the link was too slow.
        heard_ago: Seconds since anything arrived.
        rests: Whether the link is at rest: nothing depends on it, and keepalives come every 5 s, with more than 50
            peers more rarely.
        lease: Seconds of silence after which the link counts as lost.
        lanes: Its lanes, ``express`` first; empty from an agent that does not report them.
    """

    remote: str
    dialled: bool
    up_ago: float
    rtt: float | None = None
    clock_offset: float | None = None
    clock_error: float | None = None
    bytes_in: int = 0
    bytes_out: int = 0
    queued: int = 0
    dropped: int = 0
    heard_ago: float | None = None
    rests: bool = False
    lease: float = 1.0
    lanes: tuple[LaneInfo, ...] = ()


class BoundInfo(msgspec.Struct, kw_only=True, frozen=True):
    """What this module hides of a peer because a limit of its ``[limits]`` is exceeded.

    Attributes:
        kind: The limit: ``nodes``, ``topics`` or ``services``.
        limit: Its value.
        hidden: How many are hidden.
        text: Ready to read, with the remedy.
    """

    kind: str
    limit: int
    hidden: int
    text: str


class PeerInfo(msgspec.Struct, kw_only=True, frozen=True):
    """One peer of the roster.

    Attributes:
        name: Its name.
        guid: Its GUID as text.
        instance: The random id of its run, 32 hexadecimal digits.
        addresses: Where it can be reached, best first.
        state: ``linked``; ``linking`` (dialling, or waiting to be dialled); ``refused`` (by either side);
            ``conflict`` (shares a GUID or an address with another, so it cannot be linked); ``relayed`` (has no link;
            another peer relays its topics); ``foreign`` (is not of this mesh).
        since_ago: Seconds since it came into this state.
        found_ago: Seconds since it was found.
        beacon_ago: Seconds since its last beacon.
        source: How it was found: ``multicast``, ``unicast``, ``seed``, ``gossip`` or ``link``.
        link: The link, while there is one.
        last_error: Why the last attempt or link failed, ready to read; empty if none did.
        next_attempt: Seconds until the next attempt to dial.
        conflicts: What is wrong with its identity or its names, each ready to read. Only in the state ``conflict``
            they keep it from being linked; else its messages come.
        topics_in: The number of topics that it offers.
        topics_out: The number of topics that it is offered.
        via: The name of the peer that relays its topics, if one does.
        beyond: What this module hides of it by its limits.
        direct_in: Subscribers here that are connected to its nodes directly.
        direct_out: Its subscribers that may connect to nodes here directly.
    """

    name: str
    guid: str
    instance: str
    state: str
    since_ago: float
    addresses: tuple[str, ...] = ()
    found_ago: float | None = None
    beacon_ago: float | None = None
    source: str = ""
    link: LinkInfo | None = None
    last_error: str = ""
    next_attempt: float | None = None
    conflicts: tuple[str, ...] = ()
    topics_in: int = 0
    topics_out: int = 0
    via: str = ""
    beyond: tuple[BoundInfo, ...] = ()
    direct_in: int = 0
    direct_out: int = 0
