"""Limits and time-outs of links between agents.

Each has its reason beside it. Seconds and bytes, unless the name says otherwise.
"""

from __future__ import annotations

from typing import Final

from rmpa.core.limits import KIB, MIB, PEER_LEASE

# --- mesh -------------------------------------------------------------------------------------------------------
MODULES_MAX: Final = 256
"""Modules of one mesh, each with a link to each other one: 255 links and up to 510 sockets. One more is refused; more
modules are sites, joined by gateways (docs/sites.md)."""
EXPRESS_LEASE: Final = 1.0
"""A link on which no byte arrived for this long is dead (TCP alone would take two hours to notice)."""
PAUSE_NOTICED: Final = 0.1
"""A timer that fires later than this shows that the process did not run. That time does not count as a peer's
silence."""
KEEPALIVE_INTERVAL: Final = 0.25
"""Interval of the keepalives, a quarter of the lease: three of them may be late before the link falls."""
IDLE_LEASE: Final = 16.0
"""The lease of a link at rest: no route, no call and no request depends on it. Its silence is noticed later, and it
costs a twentieth of the packets. Both ends agree on it; an earlier release never does. With more than 50 peers it is
longer (``mesh.keepalive.rest_lease``)."""
IDLE_KEEPALIVE_INTERVAL: Final = 5.0
"""Interval of the keepalives of a link at rest: two of them may be late before the link falls."""
IDLE_KEEPALIVES_PER_SECOND: Final = 10.0
"""Keepalives a second on all links at rest of one agent that keeps a link to each peer: some 3 KB/s. With more than
50 peers each link has them more rarely, and a longer lease."""
IDLE_KEEPALIVE_INTERVAL_MAX: Final = 19.0
"""Interval of the keepalives of a link at rest at most; it is reached with 190 peers. Three of them and a second fit
into ``LINK_LEASE_MAX``."""
IDLE_KEEPALIVE_GRID: Final = 1.0
"""Where keepalives at rest come more rarely than every ``IDLE_KEEPALIVE_INTERVAL``, an agent sends those of all its
links at common times so far apart."""
WAKE_TIMEOUT: Final = 1.5
"""A peer at rest that does not answer for this long (or three round trips) when the link is needed again is gone."""
WAKE_PINGS: Final = 5
"""Pings that follow each other when a link's rest ends: the best of them gives the latency of the first messages an
exact clock."""
WAKE_PING_INTERVAL: Final = 0.02
"""Interval of these pings."""
REST_AFTER: Final = 5.0
"""A link rests when nothing has depended on it for this long, so that a short pause of use changes nothing."""
ACCEPTOR_KEEPALIVE_FACTOR: Final = 1.2
"""The acceptor's keepalive interval, as a multiple of the dialler's: on an idle link only the dialler pings, and each
ping and pong is a sign of life."""
HANDSHAKE_TIMEOUT: Final = 3.0
"""The longest time from connect to welcome; a connection that takes longer is a port scanner's, or stuck."""
DIAL_ATTEMPTS: Final = (0.3, 0.5, 1.2)
"""Time-outs of the successive TCP connects of one dial."""
DIAL_TIMEOUT: Final = 2.0
"""Time-out of all TCP connects of one dial together."""
DIAL_STAGGER: Final = 0.1
"""Delay before the next address of a peer is tried in parallel to those that have not answered: the shortest that
RFC 8305 allows, because robots are near each other."""
DIAL_FALLBACK: Final = 2.0
"""The higher GUID waits this long for the lower one's dial, then dials itself (NAT, firewall)."""
CROSSING_TIME: Final = 0.5
"""How long the lower GUID refuses the dial of a peer to which it has sent a hello itself: more than a round trip. If
its own hello is not answered for longer, the peer's dial is accepted."""
BACKOFF_FIRST: Final = 0.1
"""Delay before the second attempt to dial."""
BACKOFF_MAX: Final = 2.0
"""The longest delay between two attempts to dial: a peer that returns is linked within this time."""
DIAL_STRANGERS_RATE: Final = 10.0
"""Dials a second to all peers that were never linked: beacons can be forged, and a failed dial takes half a
millisecond. The cap of these peers' back-off grows with their number; up to 20 peers are not slowed down."""
DIAL_STRANGERS_BURST: Final = 64
"""Dials of never linked peers that may happen at once. A dial that ends in a link is not counted, so the start of a
network is not slowed down."""
FRAME_HEADER_BYTES: Final = 24
"""The protocol's value; see docs/design/protocol.md."""
DATA_PAYLOAD_MAX: Final = 256 * KIB
"""Data frames with a longer payload are refused: agents do not send them, and one would delay its whole lane."""
CONTROL_PAYLOAD_MAX: Final = 16 * MIB
"""Longest payload of a control frame: the graph of a peer with a few thousand topics and their definitions."""
HELLO_PAYLOAD_MAX: Final = 4 * KIB
"""Longest payload of a frame that is accepted before the handshake is done."""
PENDING_CONNECTIONS_MAX: Final = 256
"""Accepted connections that may be without a finished handshake at one time, some 10 KB each. A member needs a few
milliseconds for its handshake, so that a thousand that dial within some seconds find room."""
LANE_QUEUE_BYTES: Final = 64 * MIB
"""Bytes of data that may wait for one lane of a slow link, over all topics; beyond it the oldest message is
dropped."""
EXPRESS_MESSAGE_MAX: Final = 8 * KIB
"""Messages up to this size are small: they use the express lane unless their contract says otherwise. A message of
this size takes 0.7 ms at 100 Mbit/s."""
EXPRESS_AGAIN_MESSAGES: Final = 200
"""Consecutive small messages after which a topic that had a large message returns to the express lane."""
EXPRESS_AGAIN_AFTER: Final = 5.0
"""Seconds since its last large message before a topic returns to the express lane, so that a topic with both sizes
does not change lanes all the time."""
STALE_TICK: Final = 0.04
"""The longest time between two wake-ups of an agent that receives data: data that arrived since the last one was not
delayed by an outage."""
STALE_HOLD: Final = 0.03
"""How long a stale message waits for a newer one; if none arrives, it is delivered after this time."""
BULK_LEASE: Final = 4.0
"""A bulk lane on which no byte arrived for this long is dead; a dead peer shows much sooner by the express lane."""
BULK_UNSENT_BYTES: Final = 16 * KIB
"""Unsent bytes of the bulk lane that the kernel may hold (TCP_NOTSENT_LOWAT). Together with SO_PRIORITY it holds the
p99 latency of commands during image transfers at 0.4 ms instead of 79 ms on 100 Mbit/s."""
RELIABLE_WINDOW_MESSAGES: Final = 512
"""Reliable messages of one route that may be sent and not yet acknowledged."""
RELIABLE_WINDOW_BYTES: Final = 4 * MIB
"""Bytes of reliable messages of one route that may be sent and not yet acknowledged; one message always fits."""
REDIAL_TIMEOUT: Final = 0.2
"""Time-out of one attempt to reconnect to a silent peer: after a lost SYN a new attempt follows sooner than TCP's own
repetition, which takes a second."""
REDIAL_PAUSE: Final = 0.05
"""Pause between attempts to reconnect to a silent peer, where the kernel reports at once that there is no route."""
PURSUIT: Final = 10.0
"""A peer whose link was in use and fell silent is dialled by attempts of REDIAL_TIMEOUT for this long: the network is
often back within seconds, and a longer attempt that began shortly before would wait for TCP's own repetition."""
PURSUITS_PER_SECOND: Final = 200.0
"""Such attempts a second to all these peers together, half a millisecond each: 64 peers whose network failed at once
are dialled every 0.5 s, and take less than a tenth of a core for ten seconds."""
AWAY_GRACE: Final = 0.5
"""A peer whose agent died keeps its proxies in the local graph for this long: it may be started again at once."""
SILENT_GRACE: Final = 5.0
"""A peer whose link fell silent keeps its proxies in the local graph for this long: a radio that was away for some
seconds is back within this time, and no node has to connect again. A peer that ends says so, and leaves at once."""
KEEP_ALL_MESSAGES: Final = 1_000_000
"""The number of messages that "all" means for a contract's history; the bound in bytes is reached first."""
BULK_STALE_AGE: Final = 0.5
"""Age at which a best-effort message on the bulk lane is dropped in favour of a newer one of its topic (on the
express lane it is ``runtime.limits.STALE_AGE``). If a link is too slow for a topic, the newest message is sent."""
REPLAY_BYTES: Final = 64 * MIB
"""Bytes of reliable messages of one route that are kept for a peer; beyond it the oldest message is dropped."""
PING_TIMEOUT: Final = 2.0
"""Time-out of a ping on request (``rmpa peer ping``)."""
LINK_LEASE_MIN: Final = 0.1
"""The shortest lease; a shorter one that a peer claims is raised to it, because no network can keep it."""
LINK_LEASE_MAX: Final = 60.0
"""The longest lease; a longer one that a peer claims is lowered to it."""
GHOST_QUIET: Final = 0.5
"""A link that was silent for this long (two keepalive intervals) does not prevent a link to a new run of its peer."""
CONNECTIONS_PER_NAME: Final = 16
"""Connections that one certified name may have here. A module has two, one for each lane; twice that while its agent
starts anew or dials cross, and twice that after a cut. Each takes some 130 KB."""
LINK_STABLE: Final = 5.0
"""After the loss of a link that was up for at least this long, the back-off begins at the shortest delay."""
REFUSED_RETRY: Final = 5.0
"""Delay before another dial to a peer that refused for a reason that seldom passes by itself (version, domain)."""
FORGET_UNANNOUNCED: Final = PEER_LEASE
"""A peer unknown to discovery is dialled for this long after its link ended."""
LINK_UNACKED: Final = 2.0
"""Sent bytes without an acknowledgement for this long end a connection (TCP_USER_TIMEOUT). It is two leases, so that
the lease, which can report the reason, ends first."""
SEGMENT_BYTES: Final = 1148
"""Payload of one packet to another machine, both ways (TCP_MAXSEG): 1200 bytes with the headers of IPv4 and TCP (40)
and time stamps (12). They fit through usual tunnels, also where the path drops larger ones silently, and carry 1.5 %
less of a full cable than packets of 1500 bytes."""
TIME_STAMP_BYTES: Final = 12
"""What TCP_MAXSEG counts beside the payload (RFC 7323)."""
EXPRESS_UNSENT_BYTES: Final = 64 * KIB
"""Unsent bytes of one link that the kernel may hold (TCP_NOTSENT_LOWAT): control frames cannot overtake them, and the
drop policy does not reach them. On 5 Mbit/s a pong was 1.2 s late without this bound, 0.3 s with it."""
BULK_QUEUE: Final = 0.01
"""Seconds of data that a bulk lane without BBR may have in the queues of the path. Behind 100 ms of queue at
20 Mbit/s commands wait for 25 to 30 ms in place of 90, and no image is lost by it."""
BULK_WINDOW_MIN: Final = 64 * KIB
"""Bytes that such a lane may have on the way at the least."""
BULK_WINDOW_MAX: Final = 16 * MIB
"""And at the most: 1 Gbit/s at a round trip of 0.1 s."""
EXPRESS_RTO_MIN_US: Final = 5000
"""Microseconds that TCP waits on the express lane for an acknowledgement, beyond the round trip and its variation,
before it repeats a packet (TCP_RTO_MIN_US); its own value is 200 ms. At 5 % loss 95 % of commands at 50 Hz came
within 50 ms without it, and 100 % with it."""
EXPRESS_RTO_MAX_MS: Final = 1000
"""Milliseconds that TCP waits there between two repetitions at most (TCP_RTO_MAX_MS): the least that Linux takes."""
CONNECTION_URGENT_BYTES: Final = 32 * MIB
"""Bytes of control frames that may wait for one link: two of the longest. They are never dropped, so beyond this the
link is closed."""
CLOCK_SAMPLES: Final = 16
"""Exchanges of ping and pong kept for a peer's clock, 4 to 16 s of keepalives; older ones have a large error
(CLOCK_DRIFT)."""
CLOCK_DRIFT: Final = 15e-6
"""How far two clocks may drift apart, in seconds per second (PHI of RFC 5905)."""
CLOCK_STEP: Final = 0.05
"""Seconds by which the local wall clock must deviate from the monotonic one to count as set. A smaller step shows as
a contradiction between two exchanges."""
CLOCK_INTERVAL: Final = 1.0
"""Interval of the pings on a link whose pongs alone keep it alive."""
SECURING_TIMEOUT: Final = 3.0
"""The longest time from an accepted connection to the end of its TLS handshake in a secured mesh: two round trips and
3 ms of work."""
PLAIN_ANSWERS_RATE: Final = 20.0
"""Connections a second, over all addresses, that are told that they do not speak TLS; the others are closed without
an answer, which takes half the time."""
UNPROVEN_RATE: Final = 500.0
"""Connections a second that are no member's and are read all the same; one with a ClientHello takes 0.4 ms. Above
this rate the kernel's queue is left to fill up for a moment, so that a flood of them does not delay data."""
UNPROVEN_BURST: Final = 200
"""Such connections that may come at once: the tests of reachability of a large network."""
UNPROVEN_PAUSE: Final = 0.05
"""Pause of accepting above that rate; a member's dial is repeated after 0.3 s."""
REFUSAL_LINGER: Final = 0.5
"""How long a connection whose certificate was refused may still send, so that it reads the alert."""
PENDING_PER_ADDRESS: Final = 16
"""Connections without a handshake that one address may have: several agents of one machine, and one port scanner does
not take all places."""
JOIN_RETRY: Final = 1.0
"""Delay before an agent whose addresses have changed tries again to listen at the new address."""
ACK_MESSAGES: Final = 32
"""Messages of a reliable route after which an acknowledgement is due; it costs as much as a message of 64 bytes."""
ACK_BYTES: Final = 1 * MIB
"""Bytes of a reliable route after which an acknowledgement is due: with large messages the sender's window is soon
full."""
ACK_DELAY: Final = 0.010
"""The longest delay of an acknowledgement after the first message that it covers. The sender of few messages keeps
them in memory for this much longer."""
RESUME_CLAIM: Final = 300.0
"""Seconds in which a peer must reopen a waiting route after its new link came up, if the contract's outage does not
end before: 32,768 topics are advertised within 51 s on a lane that is always busy (TELL_PATIENCE)."""
RESUMES_MAX: Final = 1024
"""Reliable routes without a link whose messages may be kept: those of one peer with a thousand topics."""
RESUME_BYTES_MAX: Final = 256 * MIB
"""Bytes of messages kept for all reliable routes without a link. Beyond it the route that has waited longest ends."""
LOSSES_REMEMBERED: Final = 8192
"""Closed reliable routes that are remembered, for each peer at the receiver and over all at the sender: the next one
reports that messages may be lost."""
ABSENT_PEERS_MAX: Final = 1024
"""Modules whose closed reliable routes are remembered. The one that was linked longest ago is forgotten first."""

# --- bridge -----------------------------------------------------------------------------------------------------
TELL_BACKLOG: Final = 8 * KIB
"""Bytes in flight to a peer above which the next portion of the catalogue waits. A portion has some 6 KB, so data
waits for at most 12 ms on 10 Mbit/s. Sending all of 10,000 topics at once delayed data by 0.8 s."""
