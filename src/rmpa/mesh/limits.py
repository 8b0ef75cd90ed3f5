"""Limits and time-outs of links between agents.

Each has its reason beside it. Seconds and bytes, unless the name says otherwise.
"""

from __future__ import annotations

from typing import Final

from rmpa.core.limits import KIB, MIB, PEER_LEASE

# [Graph] Modules of one mesh, this one included
# At it: a further one is refused as *full*, and joins when a place is free; make more of them
#   [sites](../guides/sites.md)
# Told in: its log, `peer list`, `doctor`, `link.refused.full`
# Why: Each has a link to each other one: 255 links and up to 510 sockets.
MODULES_MAX: Final = 256
# [Links] Time without a byte on a link in use
# At it: the link is lost, and dialled again
# Told in: log, `peer list`, diagnostics
# Why: TCP alone would take two hours to notice.
EXPRESS_LEASE: Final = 1.0
# [Links] Time for which topics and services of a silent peer stay in the graph, without a reliable contract
# At it: they leave it
# Told in: log
# Why: A radio that was away for some seconds is back within this time, and no node has to connect again. A peer that
#   ends announces it, and leaves at once.
SILENT_GRACE: Final = 5.0
# [Links] Time for which a silent peer that was in use is dialled every 0.2 s
# At it: it is dialled every 2 s
# Told in: `peer list`
# Why: The network is often back within seconds, and a longer attempt that began shortly before would wait for TCP's
#   own repetition.
PURSUIT: Final = 10.0
# [Links] Time without a byte on a link at rest: above 150 peers 0.3 s each, at most 58 s
# At it: the link is lost, and dialled again
# Told in: log, `peer list`, `peer info` (*Pace*), diagnostics
# Why: No route, no call and no request depends on such a link, and the silence of its peer's beacons has it checked
#   after 16 s. It costs a sixtieth of the packets (``mesh.keepalive.rest_lease``).
IDLE_LEASE: Final = 46.0
# [Links] Time between keepalives of a link in use
# At it: a ping is sent
# Told in: `peer info` (*Pace*)
# Why: A quarter of the lease: three of them may be late before the link falls.
KEEPALIVE_INTERVAL: Final = 0.25
# [Links] Time between keepalives of a link at rest
# At it: a ping is sent
# Told in: `peer info` (*Pace*)
# Why: Two of them may be late before the link falls.
IDLE_KEEPALIVE_INTERVAL: Final = 15.0
# [Links] Keepalives a second on all links at rest
# At it: above 150 peers each link has them more rarely
# Told in: `peer info` (*Pace*)
# Why: Some 3 KB/s.
IDLE_KEEPALIVES_PER_SECOND: Final = 10.0
# [Links] Time between these keepalives, at most
# At it: from 190 peers on there are more than 10 a second
# Told in: `peer info` (*Pace*)
# Why: Three of them and a second fit into ``LINK_LEASE_MAX``.
IDLE_KEEPALIVE_INTERVAL_MAX: Final = 19.0
# Where keepalives at rest come more rarely than every ``IDLE_KEEPALIVE_INTERVAL``, an agent sends those of all its
# links at common times so far apart.
IDLE_KEEPALIVE_GRID: Final = 1.0
# [Links] Time for an answer (or three round trips) on a link at rest that is needed again
# At it: the link is lost
# Told in: log, `peer list`
WAKE_TIMEOUT: Final = 1.5
# Frames of one peer, other than data, that are handled before the other connections are served: a peer that sends
# thousands of requests at once must not let them wait.
FRAMES_AT_ONCE: Final = 16
# [Links] Time without use of a link
# At it: it rests: its keepalives become rare
# Told in: `peer list` (*at rest*)
# Why: So long that a short pause of use changes nothing.
REST_AFTER: Final = 5.0
# [Links] Time from connect to the end of the handshake
# At it: the connection is closed; a peer dials again
# Told in: log
# Why: A connection that takes longer is a port scanner's, or stuck.
HANDSHAKE_TIMEOUT: Final = 3.0
# Time-out of all TCP connects of one dial together.
DIAL_TIMEOUT: Final = 2.0
# Delay before the second attempt to dial.
BACKOFF_FIRST: Final = 0.1
# The longest delay between two attempts to dial: a peer that returns is linked within this time.
BACKOFF_MAX: Final = 2.0
# [Links] Dials a second to peers that were never linked
# At it: further ones wait; a dial that ends in a link is not counted
# Why: Beacons can be forged, and a failed dial takes half a millisecond. The cap of these peers' back-off grows with
#   their number; up to 20 peers are not slowed down.
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
# [Links] TCP connections to the mesh port without a finished handshake
# At it: further ones are closed (in a secured mesh the oldest of the address with the most); peers dial again
# Told in: log, `link.pending_full`
# Why: Some 10 KB each. A member needs a few milliseconds for its handshake, so that a thousand that dial within some
#   seconds find room.
PENDING_CONNECTIONS_MAX: Final = 256
# [Links] Of these, in a secured mesh, those of no member a second
# At it: accepting pauses for 50 ms
# Told in: `link.paused`
# Why: One with a ClientHello takes 0.4 ms: a flood of them does not delay data.
UNPROVEN_RATE: Final = 500.0
# [Messages] Bytes that wait for one lane of a slow link, over all topics
# At it: the oldest message of the topic with the most bytes is dropped, reliable ones last
# Told in: `topic info`, `why` (*sent*), diagnostics
LANE_QUEUE_BYTES: Final = 64 * MIB
# [Messages] Time for which a message of a topic without a `depth` waits for a slow link while more than 256 KiB do
# At it: it is dropped
# Told in: `topic info`, `why` (*sent*), diagnostics
# Why: Where the link is too slow for an image topic the images stay fresh. What a cut has delayed is not counted.
ROUTE_QUEUE_AGE: Final = 0.5
# Bytes of a topic without a `depth` that may wait for longer than that: a second at 2 Mbit/s.
ROUTE_BURST_BYTES: Final = 256 * KIB
# [Messages] Bytes of a topic without a `depth` that wait for a silent peer
# At it: the oldest is dropped
# Told in: `topic info`, `why` (*sent*), diagnostics
# Why: As many as a TCP connection of a ROS node holds in the kernel.
ROUTE_QUEUE_BYTES: Final = 4 * MIB
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
# The number of messages that "all" means for a contract's history; the bound in bytes is reached first.
KEEP_ALL_MESSAGES: Final = 1_000_000
# [Messages] Bytes of a reliable topic that are kept for one peer
# At it: the oldest messages are given up and counted
# Told in: at both ends: `topic info` (*lost*), `why` (*sent*, *contract*), diagnostics, log
REPLAY_BYTES: Final = 64 * MIB
# [Messages] Bytes of a reliable topic that are kept for a peer that goes on by another path
# At it: older messages may be lost when a path changes, and are counted
# Told in: at the receiver: `topic info` (*lost*), `why` (*contract*), diagnostics, log
# Why: What a relay had acknowledged and not passed on when it died: two seconds at 8 MB/s.
HISTORY_BYTES: Final = 16 * MIB
# The shortest lease; a shorter one that a peer claims is raised to it, because no network can keep it.
LINK_LEASE_MIN: Final = 0.1
# The longest lease; a longer one that a peer claims is lowered to it.
LINK_LEASE_MAX: Final = 60.0
# A link that was silent for this long (two keepalive intervals) does not prevent a link to a new run of its peer.
GHOST_QUIET: Final = 0.5
# [Graph] Connections of one certified name
# At it: a further one is refused as *busy*: other machines use the certificate too
# Told in: its log, `peer list`, `doctor`, `link.refused.busy`
# Why: A module has two, one for each lane; twice that while its agent starts anew or dials cross, and twice that
#   after a cut. Each takes some 130 KB.
CONNECTIONS_PER_NAME: Final = 16
# A peer unknown to discovery is dialled for this long after its link ended.
FORGET_UNANNOUNCED: Final = PEER_LEASE
# How far two clocks may drift apart, in seconds per second (PHI of RFC 5905).
CLOCK_DRIFT: Final = 15e-6
# Interval of the pings on a link whose pongs alone keep it alive.
CLOCK_INTERVAL: Final = 1.0
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
# [Messages] Bytes of reliable topics that are kept for peers that are away
# At it: the route that has waited longest is given up: `loss_unknown`
# Told in: at both ends: `topic info` (*lost*), `why` (*sent*, *contract*), diagnostics, log
RESUME_BYTES_MAX: Final = 256 * MIB
# [Messages] Reliable routes whose messages are kept for such peers
# At it: the route that has waited longest is given up: `loss_unknown`
# Told in: at both ends: `topic info` (*lost*), `why` (*sent*, *contract*), diagnostics, log
# Why: Those of one peer with a thousand topics.
RESUMES_MAX: Final = 1024
# Closed reliable routes that are remembered, for each peer at the receiver and over all at the sender: the next one
# reports that messages may be lost.
LOSSES_REMEMBERED: Final = 8192
# Modules whose closed reliable routes are remembered. The one that was linked longest ago is forgotten first.
ABSENT_PEERS_MAX: Final = 1024
