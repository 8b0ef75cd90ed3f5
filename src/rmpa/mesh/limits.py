"""Limits and time-outs of links between agents.

Each has its reason beside it. Seconds and bytes, unless the name says otherwise.
"""

from __future__ import annotations

from typing import Final

from rmpa.core.limits import PEER_LEASE
from rmpa.core.sizes import KIB, MIB, UINT32_MAX

# --- mesh -------------------------------------------------------------------------------------------------------
EXPRESS_LEASE: Final = 1.0
"""A link on which nothing arrived for this long is dead (TCP alone would take two hours)."""
PAUSE_NOTICED: Final = 0.1
"""A timer that fires later than this shows that the process did not run: such time is not counted as a peer's
silence."""
KEEPALIVE_INTERVAL: Final = 0.25
"""A quarter of the lease: three keepalives may be late before the link falls."""
ACCEPTOR_KEEPALIVE_FACTOR: Final = 1.2
"""The acceptor's interval in those of the dialler: the dialler pings, and the pong counts as a sign of life."""
HANDSHAKE_TIMEOUT: Final = 3.0
"""From connect to welcome; a connection that takes longer is a port scanner's, or stuck."""
DIAL_ATTEMPTS: Final = (0.3, 0.5, 1.2)
"""Time-outs of the successive TCP connects of one dial."""
DIAL_TIMEOUT: Final = 2.0
"""For all of them together."""
DIAL_STAGGER: Final = 0.1
"""Before the next address of a peer is tried beside those that have not answered: the least that RFC 8305 allows,
because robots are near each other."""
DIAL_FALLBACK: Final = 2.0
"""The higher GUID waits this long for the lower one's dial, then dials itself (NAT, firewall)."""
BACKOFF_FIRST: Final = 0.1
"""Before the second attempt to dial."""
BACKOFF_MAX: Final = 2.0
"""Between attempts at the most: a peer that comes back is linked within this time."""
DIAL_STRANGERS_RATE: Final = 10.0
"""Dials a second to all peers that were never linked: beacons can be forged, and a dial that fails takes half a
millisecond. The cap of their back-off grows with their number; up to 20 of them are not slowed down."""
DIAL_STRANGERS_BURST: Final = 64
"""Such dials at once. One that ends in a link is not counted, so a network that starts up is not slowed down."""
FRAME_HEADER_BYTES: Final = 24
"""See docs/design/protocol.md."""
DATA_PAYLOAD_MAX: Final = 256 * KIB
"""Data frames longer than this are refused: agents do not send them, and one would delay all others of its lane."""
CONTROL_PAYLOAD_MAX: Final = 16 * MIB
"""A control frame: the graph of a peer with a few thousand topics and their message definitions."""
HELLO_PAYLOAD_MAX: Final = 4 * KIB
"""Before the handshake nothing larger is read from a peer."""
PENDING_CONNECTIONS_MAX: Final = 64
"""Accepted connections that have not finished their handshake."""
LANE_QUEUE_BYTES: Final = 64 * MIB
"""Data that waits for one lane of a slow link, over all topics; beyond it the oldest message is dropped."""
EXPRESS_MESSAGE_MAX: Final = 8 * KIB
"""Messages up to this size are small: they go by the express lane unless their contract says otherwise. A full one
takes 0.7 ms on 100 Mbit/s."""
EXPRESS_AGAIN_MESSAGES: Final = 200
"""Small messages in a row before a topic that had a large one returns to the express lane."""
EXPRESS_AGAIN_AFTER: Final = 5.0
"""Seconds since its last large message, likewise: a topic that mixes both sizes must not change lanes all the
time."""
STALE_TICK: Final = 0.04
"""Between two wake-ups of an agent that receives data: what has come since the last one was not delayed by an
outage."""
STALE_HOLD: Final = 0.03
"""How long a stale message waits for a newer one; the last one of a burst is delivered after this."""
BULK_LEASE: Final = 4.0
"""A bulk lane on which nothing arrived for this long is dead; the express lane shows much sooner that a peer is."""
BULK_UNSENT_BYTES: Final = 16 * KIB
"""Bytes that the kernel keeps of the bulk lane before they can leave (TCP_NOTSENT_LOWAT): with SO_PRIORITY this is
what keeps a command's p99 beside images at 0.4 ms instead of 79 ms on 100 Mbit/s."""
RELIABLE_WINDOW_MESSAGES: Final = 512
"""Reliable messages of one route on their way to a peer and not yet acknowledged."""
RELIABLE_WINDOW_BYTES: Final = 4 * MIB
"""The same in bytes; one message always fits."""
REDIAL_TIMEOUT: Final = 0.2
"""For one attempt to reach a silent peer anew: a lost SYN is repeated by a new attempt, not by TCP a second later."""
REDIAL_PAUSE: Final = 0.05
"""Between such attempts, where the system reports at once that there is no route."""
AWAY_GRACE: Final = 0.5
"""A peer whose link fell silent keeps its proxies in the local graph for this long: after a loose contact of a
second the next link is up within it, and no node needs to connect anew."""
KEEP_ALL_MESSAGES: Final = 1_000_000
"""What "all" means for a contract's history: bytes bound it first."""
BULK_STALE_AGE: Final = 0.5
"""Age at which a best-effort message on the bulk lane is dropped for a newer one of its topic
(``runtime.limits.STALE_AGE`` on the express lane): of a topic that a slow link cannot carry, the newest message is
sent."""
REPLAY_BYTES: Final = 64 * MIB
"""Reliable messages of one route that are kept for a peer; beyond it the oldest is dropped."""
PING_TIMEOUT: Final = 2.0
"""For the answer to a ping on request (``rmpa peer ping``)."""
LINK_LEASE_MIN: Final = 0.1
"""A peer that claims a shorter lease is held to this one: no network keeps less."""
LINK_LEASE_MAX: Final = 60.0
"""A peer that claims a longer lease is held to this one."""
GHOST_QUIET: Final = 0.5
"""Two keepalives: a link that was silent for this long does not keep out a new run of its peer."""
LINKS_MAX: Final = 512
"""Peers that are linked at once; as many as a roster holds."""
LINK_STABLE: Final = 5.0
"""A link that was up for this long was stable: after its loss the back-off begins at the shortest delay."""
REFUSED_RETRY: Final = 5.0
"""Before a peer is dialled again that refused for a reason which waiting seldom mends (version, domain)."""
FORGET_UNANNOUNCED: Final = PEER_LEASE
"""A peer that discovery does not know is dialled again for this long after its link ended."""
LINK_UNACKED: Final = 2.0
"""Sent bytes that were not acknowledged for this long end a connection (TCP_USER_TIMEOUT): two leases, so that the
lease, which can report the reason, ends first."""
SEGMENT_BYTES: Final = (1200, 512)
"""Payload of one packet on a path that drops larger ones, in the order of trials: with TCP_HEADERS 1252 bytes, below
the MTU of all usual tunnels (IPv6 requires 1280), then 564, below IPv4's minimum of 576."""
TCP_HEADERS: Final = 52
"""Bytes of a packet around its payload: IPv4 (20), TCP (20), time stamps (12)."""
EXPRESS_SEGMENT: Final = 1220
"""Payload of one packet of an express lane that leaves this machine (TCP_MAXSEG), 1272 bytes with TCP_HEADERS:
commands, keepalives and the graph fit through usual tunnels from the first packet on."""
STALL_LOOK: Final = 0.1
"""Between two samples of a connection whose data is retransmitted."""
STALL_SUSPECTED: Final = 0.3
"""Seconds without progress, with retransmissions, before a small packet tests the path; TCP retransmits after 0.2
s."""
STALL_ANSWER: Final = 0.08
"""Seconds, or 1.5 round trips if that is more, for the acknowledgement of what was retransmitted after the small
packet's answer; then the path is taken for a black hole. On a LAN 0.8 s after the stall began, within the express
lease."""
PATH_REMEMBERED: Final = 600.0
"""A black hole is remembered for an address this long; the next connection then tries large packets again. The value
of RFC 4821."""
PATH_NO_HELP: Final = 60.0
"""Where smaller packets did not help, they are not tried again for this long."""
PATH_PROVEN_SEGMENTS: Final = 2
"""Full segments of the smaller size that must be acknowledged before the size is known to have been the problem."""
PATHS_MAX: Final = 512
"""Addresses remembered as black holes, as many as there are links; the oldest is forgotten first."""
EXPRESS_UNSENT_BYTES: Final = 64 * KIB
"""Bytes that the kernel queues for one link before they can be sent (TCP_NOTSENT_LOWAT): control frames cannot
overtake what waits there, and no rule can drop it. A pong on 5 Mbit/s was 1.2 s late without it, 0.3 s with it."""
CONNECTION_URGENT_BYTES: Final = 32 * MIB
"""Control frames that wait for one link: two of the longest. Beyond it the link is closed: they are never dropped."""
CLOCK_SAMPLES: Final = 16
"""Exchanges remembered for a peer's clock: 4 to 16 s of keepalives; older ones have a large error (CLOCK_DRIFT)."""
CLOCK_DRIFT: Final = 15e-6
"""Seconds a second that clocks drift apart (PHI of RFC 5905)."""
CLOCK_STEP: Final = 0.05
"""Seconds by which our wall clock must disagree with the monotonic one to count as set; less shows as a
contradiction between two exchanges."""
CLOCK_INTERVAL: Final = 1.0
"""Between pings on a link whose pongs alone keep it alive."""
PENDING_PER_ADDRESS: Final = 8
"""Of the connections without a handshake, those from one address: one scanner must not shut the others out."""
JOIN_RETRY: Final = 1.0
"""Before an agent whose addresses have changed tries again to listen at the new one."""
ACK_MESSAGES: Final = 32
"""Messages of a reliable route that one acknowledgement covers: it costs as much as a message of 64 bytes."""
ACK_BYTES: Final = 1 * MIB
"""The same in bytes: with large messages the sender's window is soon full."""
ACK_DELAY: Final = 0.010
"""After the first unacknowledged message; a route with few messages keeps them in memory for this much longer."""
OUTAGE_COUNTED: Final = 86_400.0
"""Messages of a reliable route are counted for this long after its link ended, though they are not kept any more; for
that the agent stays connected to the publisher. After it, the loss is reported as "more may be lost"."""
RESUME_CLAIM: Final = 10.0
"""Seconds for a peer to reopen a route that waited, after all topics were advertised over its new link: it has read
the last advertisement by then. A route that it has not reopened has no subscriber any more."""
RESUME_CLAIM_MAX: Final = 300.0
"""The same in seconds after its new link, if not all topics could be advertised: 32,768 topics take 51 s on a lane
that is never free (TELL_PATIENCE), and a link that carries nothing ends long before."""
RESUMES_MAX: Final = 1024
"""Reliable routes without a link whose messages are kept: those of one peer with a thousand topics."""
RESUME_BYTES_MAX: Final = 256 * MIB
"""Bytes of messages kept for all of them; those of the route that waited longest are dropped first, and only
counted."""
RESUMES_COUNTED_MAX: Final = 4096
"""Reliable routes without a link whose messages are only counted, 3 KB each."""
LOST_TOLD_MAX: Final = UINT32_MAX
"""Lost messages that one ``opened`` can report."""
LOSSES_REMEMBERED: Final = 8192
"""(peer, source) pairs of reliable routes that are not open, whose losses are remembered."""
ABSENT_PEERS_MAX: Final = 128
"""Peers without a link for longer than their routes wait, whose losses in both directions are remembered; the one
that has been away longest is forgotten first."""

# --- bridge -----------------------------------------------------------------------------------------------------
TELL_BACKLOG: Final = 8 * KIB
"""Bytes in flight to a peer above which the next portion of the graph waits: a portion has some 6 KB, so data waits
for at most 12 ms behind both on 10 Mbit/s. Sending all of 10,000 topics at once delayed it by 0.8 s."""
