"""Limits and time-outs of links between agents.

Each has its reason beside it. Seconds and bytes, unless the name says otherwise.
"""

from __future__ import annotations

from typing import Final

from rmpa.core.limits import KIB, MIB, PEER_LEASE

# --- mesh -------------------------------------------------------------------------------------------------------
# Modules of one mesh, each with a link to each other one: 255 links and up to 510 sockets. One more is refused; more
# modules are sites, joined by gateways (docs/guides/sites.md).
MODULES_MAX: Final = 256
# A link on which no byte arrived for this long is dead (TCP alone would take two hours to notice).
EXPRESS_LEASE: Final = 1.0
# Interval of the keepalives, a quarter of the lease: three of them may be late before the link falls.
KEEPALIVE_INTERVAL: Final = 0.25
# The lease of a link at rest: no route, no call and no request depends on it. Its silence is noticed later, and it
# costs a twentieth of the packets. Both ends agree on it; an earlier release never does. With more than 50 peers it
# is longer (``mesh.keepalive.rest_lease``).
IDLE_LEASE: Final = 16.0
# Interval of the keepalives of a link at rest: two of them may be late before the link falls.
IDLE_KEEPALIVE_INTERVAL: Final = 5.0
# Keepalives a second on all links at rest of one agent that keeps a link to each peer: some 3 KB/s. With more than 50
# peers each link has them more rarely, and a longer lease.
IDLE_KEEPALIVES_PER_SECOND: Final = 10.0
# Interval of the keepalives of a link at rest at most; it is reached with 190 peers. Three of them and a second fit
# into ``LINK_LEASE_MAX``.
IDLE_KEEPALIVE_INTERVAL_MAX: Final = 19.0
# Where keepalives at rest come more rarely than every ``IDLE_KEEPALIVE_INTERVAL``, an agent sends those of all its
# links at common times so far apart.
IDLE_KEEPALIVE_GRID: Final = 1.0
# A peer at rest that does not answer for this long (or three round trips) when the link is needed again is gone.
WAKE_TIMEOUT: Final = 1.5
# A link rests when nothing has depended on it for this long, so that a short pause of use changes nothing.
REST_AFTER: Final = 5.0
# The longest time from connect to welcome; a connection that takes longer is a port scanner's, or stuck.
HANDSHAKE_TIMEOUT: Final = 3.0
# Time-out of all TCP connects of one dial together.
DIAL_TIMEOUT: Final = 2.0
# Delay before the second attempt to dial.
BACKOFF_FIRST: Final = 0.1
# The longest delay between two attempts to dial: a peer that returns is linked within this time.
BACKOFF_MAX: Final = 2.0
# Dials a second to all peers that were never linked: beacons can be forged, and a failed dial takes half a
# millisecond. The cap of these peers' back-off grows with their number; up to 20 peers are not slowed down.
DIAL_STRANGERS_RATE: Final = 10.0
# Dials of never linked peers that may happen at once. A dial that ends in a link is not counted, so the start of a
# network is not slowed down.
DIAL_STRANGERS_BURST: Final = 64
# The protocol's value; see docs/design/protocol.md.
FRAME_HEADER_BYTES: Final = 24
# Data frames with a longer payload are refused: agents do not send them, and one would delay its whole lane.
DATA_PAYLOAD_MAX: Final = 256 * KIB
# Longest payload of a control frame: the graph of a peer with a few thousand topics and their definitions.
CONTROL_PAYLOAD_MAX: Final = 16 * MIB
# Longest payload of a frame that is accepted before the handshake is done.
HELLO_PAYLOAD_MAX: Final = 4 * KIB
# Accepted connections that may be without a finished handshake at one time, some 10 KB each. A member needs a few
# milliseconds for its handshake, so that a thousand that dial within some seconds find room.
PENDING_CONNECTIONS_MAX: Final = 256
# Bytes of data that may wait for one lane of a slow link, over all topics; beyond it the oldest message is dropped.
LANE_QUEUE_BYTES: Final = 64 * MIB
# Messages up to this size are small: they use the express lane unless their contract says otherwise. A message of
# this size takes 0.7 ms at 100 Mbit/s.
EXPRESS_MESSAGE_MAX: Final = 8 * KIB
# Consecutive small messages after which a topic that had a large message returns to the express lane.
EXPRESS_AGAIN_MESSAGES: Final = 200
# Seconds since its last large message before a topic returns to the express lane, so that a topic with both sizes
# does not change lanes all the time.
EXPRESS_AGAIN_AFTER: Final = 5.0
# How long a stale message waits for a newer one; if none arrives, it is delivered after this time.
STALE_HOLD: Final = 0.03
# A bulk lane on which no byte arrived for this long is dead; a dead peer shows much sooner by the express lane.
BULK_LEASE: Final = 4.0
# Reliable messages of one route that may be sent and not yet acknowledged.
RELIABLE_WINDOW_MESSAGES: Final = 512
# Bytes of reliable messages of one route that may be sent and not yet acknowledged; one message always fits.
RELIABLE_WINDOW_BYTES: Final = 4 * MIB
# Time-out of one attempt to reconnect to a silent peer: after a lost SYN a new attempt follows sooner than TCP's own
# repetition, which takes a second.
REDIAL_TIMEOUT: Final = 0.2
# Pause between attempts to reconnect to a silent peer, where the kernel reports at once that there is no route.
REDIAL_PAUSE: Final = 0.05
# A peer whose link was in use and fell silent is dialled by attempts of REDIAL_TIMEOUT for this long: the network is
# often back within seconds, and a longer attempt that began shortly before would wait for TCP's own repetition.
PURSUIT: Final = 10.0
# A peer whose link fell silent keeps its proxies in the local graph for this long: a radio that was away for some
# seconds is back within this time, and no node has to connect again. A peer that ends says so, and leaves at once.
SILENT_GRACE: Final = 5.0
# The number of messages that "all" means for a contract's history; the bound in bytes is reached first.
KEEP_ALL_MESSAGES: Final = 1_000_000
# Bytes of reliable messages of one route that are kept for a peer; beyond it the oldest message is dropped.
REPLAY_BYTES: Final = 64 * MIB
# The shortest lease; a shorter one that a peer claims is raised to it, because no network can keep it.
LINK_LEASE_MIN: Final = 0.1
# The longest lease; a longer one that a peer claims is lowered to it.
LINK_LEASE_MAX: Final = 60.0
# A link that was silent for this long (two keepalive intervals) does not prevent a link to a new run of its peer.
GHOST_QUIET: Final = 0.5
# Connections that one certified name may have here. A module has two, one for each lane; twice that while its agent
# starts anew or dials cross, and twice that after a cut. Each takes some 130 KB.
CONNECTIONS_PER_NAME: Final = 16
# A peer unknown to discovery is dialled for this long after its link ended.
FORGET_UNANNOUNCED: Final = PEER_LEASE
# How far two clocks may drift apart, in seconds per second (PHI of RFC 5905).
CLOCK_DRIFT: Final = 15e-6
# Interval of the pings on a link whose pongs alone keep it alive.
CLOCK_INTERVAL: Final = 1.0
# Connections a second that are no member's and are read all the same; one with a ClientHello takes 0.4 ms. Above this
# rate the kernel's queue is left to fill up for a moment, so that a flood of them does not delay data.
UNPROVEN_RATE: Final = 500.0
# Connections without a handshake that one address may have: several agents of one machine, and one port scanner does
# not take all places.
PENDING_PER_ADDRESS: Final = 16
# Messages of a reliable route after which an acknowledgement is due; it costs as much as a message of 64 bytes.
ACK_MESSAGES: Final = 32
# Bytes of a reliable route after which an acknowledgement is due: with large messages the sender's window is soon
# full.
ACK_BYTES: Final = 1 * MIB
# Seconds in which a peer must reopen a waiting route after its new link came up, if the contract's outage does not
# end before: 32,768 topics are advertised within 51 s on a lane that is always busy (TELL_PATIENCE).
RESUME_CLAIM: Final = 300.0
# Reliable routes without a link whose messages may be kept: those of one peer with a thousand topics.
RESUMES_MAX: Final = 1024
# Bytes of messages kept for all reliable routes without a link. Beyond it the route that has waited longest ends.
RESUME_BYTES_MAX: Final = 256 * MIB
# Closed reliable routes that are remembered, for each peer at the receiver and over all at the sender: the next one
# reports that messages may be lost.
LOSSES_REMEMBERED: Final = 8192
# Modules whose closed reliable routes are remembered. The one that was linked longest ago is forgotten first.
ABSENT_PEERS_MAX: Final = 1024
