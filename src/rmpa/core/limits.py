"""Every cap and time-out, with its unit and its reason. Seconds and bytes unless the name says otherwise.

A room that needs a new number adds it to its own part here, never in its own code.
"""

from __future__ import annotations

from typing import Final

KIB: Final = 1024
MIB: Final = 1024 * KIB

# --- process --------------------------------------------------------------------------------------------------
OPEN_FILES: Final = 1_048_576
"""File descriptors that a process which runs on asks for: as many as the hard limit allows, up to the kernel's own
default (fs.nr_open). Containers have hard limits of 10^9, and an old program that it starts closes each number."""
OPEN_FILES_ADVICE: Final = 65_536
"""What a user is advised to allow: some ten thousand nodes."""
DESCRIPTORS_RESERVED: Final = 64
"""Descriptors that data leaves to the core (half of them), the links and the control socket: 16 peers that come back
take 32."""
DESCRIPTORS_RESERVED_PART: Final = 4
"""The reserve is no more than this part of all: of 64 descriptors 16."""
DESCRIPTORS_QUIET: Final = 2.0
"""Without a refusal, and with room, before a shortage of descriptors is over."""
DESCRIPTORS_TELL: Final = 60.0
"""Between two lines of the log about shortages of one kind, for those that come and go."""
DESCRIPTORS_NEAR: Final = 0.8
"""The share of those that are not in the reserve from which on a user is warned."""
DESCRIPTORS_COUNT_SHARE: Final = 100
"""Times as long as a count of all open descriptors took, before the next one."""
ACCEPTS: Final = 16
"""Connections that one listening socket accepts before the loop does something else, 15 microseconds each."""
ACCEPT_PAUSE: Final = 0.5
"""Before a server that has no descriptor for a connection looks again; a look costs some 10 microseconds."""
THREAD_SWITCH: Final = 1e-4
"""Seconds that a thread keeps the interpreter from one that waits for it. Beside a thread that parses XML the loop is
3 ms late (p50) with Python's own 5 ms, and 0.16 ms with this."""
COLLECT_LOOK: Final = 0.25
"""Between two looks how much cyclic garbage there may be."""
COLLECT_LOOK_AGAIN: Final = 0.02
"""The same after a look that found enough: messages on their way are gone by then, and many small portions hold the
loop for less than a large one."""
COLLECT_YOUNG: Final = 300
"""Objects that came to stay since the last collection, for the next: what 40 XML-RPC calls leave, some 0.1 ms."""
COLLECT_BURST: Final = 1000
"""The same in the midst of work that goes on: a tenth of a millisecond, whatever came to stay."""
COLLECT_GROWTH: Final = 50_000
"""Memory blocks by which the heap grew, some 5 MB, for a full collection while no data flows."""
COLLECT_GROWTH_MAX: Final = 500_000
"""The same, some 50 MB, for one that waits no longer; it takes about 10 ms."""
COLLECT_QUIET_BYTES: Final = 16 * KIB
"""A second, over all links: less than this are keepalives, or streams so slow that they hardly meet a pause."""

# --- identity -------------------------------------------------------------------------------------------------
INSTANCE_ID_BYTES: Final = 16
"""Random id of one run of one agent: 128 bits, so that two runs never share one."""
PEER_NAME_MAX: Final = 64
"""Characters in a peer's name: a host name's label is at most 63."""
DOMAIN_MAX: Final = 232
"""Highest domain id: ROS 2's own bound, so that the same ROS_DOMAIN_ID works for both."""

# --- settings -------------------------------------------------------------------------------------------------
CONFIG_FILE_MAX: Final = 256 * KIB
"""A settings file; ours is some 4 KB, and finding a line in a huge one takes long."""
CONTRACTS_REMEMBERED: Final = 4096
"""(topic, type) pairs whose contract is remembered; the oldest is forgotten first, and found again by the rules."""
NAMES_REMEMBERED: Final = 256
"""Peers for whom the rules of names are remembered: as many as a large network has; found again by the rules."""
REMAPS_MAX: Final = 256
"""Rules for names in one direction of a ``[[peer]]``; each is held against each other one."""
CONTRACT_DEPTH_MAX: Final = 100_000
"""Messages that a contract may let wait: 100 s of a 1 kHz topic. ``LINK_QUEUE_BYTES`` bounds their bytes."""
CONTRACT_TIME_MIN: Final = 0.001
"""Shortest deadline, lifespan and lease: a timer that is due more often would hold up what it watches."""
CONTRACT_TIME_MAX: Final = 86_400.0
"""Longest deadline, lifespan and lease, a day: more is a mistake in the unit."""
CONTRACT_RATE_MIN: Final = 0.001
"""Lowest ``max_rate`` in messages a second: one in a quarter of an hour."""
CONTRACT_RATE_MAX: Final = 1_000_000.0
"""Highest ``max_rate`` in messages a second: more than any topic reaches."""
FOLLOWED_MAX: Final = 256
"""Default of ``limits.params``: parameters that one module follows, and that one peer may follow here; a namespace
counts as one."""
FOLLOW_RULES_MAX: Final = 2048
"""Tables ``[[param]]`` in a file, whatever ``limits.params`` says: each is held against each other one."""
BOUND_MAX: Final = 1_000_000
"""Highest value of a setting in ``[limits]``: such a graph takes some gigabytes."""
CPU_MAX: Final = 1023
"""Highest number of a CPU that an affinity can name: CPU_SETSIZE less one."""

# --- discovery ------------------------------------------------------------------------------------------------
MULTICAST_GROUP: Final = "239.255.82.77"
"""Administratively scoped (RFC 2365), so routers keep it on site; 82.77 is "RM"."""
MULTICAST_PORT: Final = 11411
"""Of domain 0; domain n uses this plus n."""
MULTICAST_TEST_PORT: Final = 11410
"""Of ``rmpa multicast``: beside those of all domains, so that no agent hears its packets."""
MULTICAST_TTL: Final = 1
"""Hops: the own sub-network only."""
BEACON_MAX_BYTES: Final = 1200
"""One beacon fits one packet on every link (IPv6 minimum MTU 1280 less headers)."""
BEACON_ADDRESSES_MAX: Final = 8
"""Addresses that a beacon carries: a robot with more interfaces announces the first eight."""
BEACON_GOSSIP_MAX: Final = 64
"""Peers that one beacon passes on; more are passed on in turn."""
BURST_OFFSETS: Final = (0.0, 0.1, 0.3, 0.7)
"""When a starting peer announces itself: Wi-Fi loses multicast, one beacon is not enough."""
HEARTBEAT_INTERVAL: Final = 5.0
"""Paper, section 4.3: "each five seconds a heartbeat will check that network is still alive"."""
ROSTER_LEASE: Final = 16.0
"""A peer that has no link and was silent for three heartbeats and a second is gone."""
ROSTER_PEERS_MAX: Final = 512
"""Peers in a roster: a hostile sender of invented GUIDs cannot fill the memory."""
CONFLICT_AFTER: Final = 2.0
"""A replaced instance that still speaks after this long is not a late packet: two live peers share one GUID."""
ADDRESS_SHARED_AFTER: Final = 5.0
"""Seconds without a link, though its beacons come, until a peer with another's address is shown as in conflict."""
ADDRESS_SHARED_MARGIN: Final = 1.0
"""Seconds after its link fell in which a beacon may still be one from before."""
ANSWER_INTERVAL: Final = 0.2
"""At most one unicast answer to one address in this time."""
INTERFACE_SETTLE: Final = 0.2
"""After a change of interfaces the kernel reports several more; they are read once."""
INTERFACE_LOOK: Final = 5.0
"""How often interfaces are read where the kernel does not report changes."""
BURST_AGAIN_OFFSETS: Final = (0.0, 0.2, 0.6)
"""The shorter burst after a change of interfaces: most listeners know the peer already."""
BURST_JITTER: Final = 0.05
"""Added at random to all but the first beacon of a burst: modules on one power switch start together."""
HEARTBEAT_JITTER: Final = 0.1
"""The part of the interval by which a heartbeat may come early, for the same reason."""
HEARTBEAT_LATE: Final = 6.0
"""A peer not heard for a heartbeat and a second has missed one: it may be the dead one of two instances."""
MULTICAST_SILENCE: Final = 11.0
"""A peer not heard by multicast for two heartbeats and a second gets its heartbeats by unicast."""
ROSTER_LEASE_MIN: Final = 2.0
"""A peer that asks for less would come and go with every lost packet."""
ROSTER_LEASE_MAX: Final = 120.0
"""A peer that asks for more would haunt the roster."""
SEAT_VOICES_MAX: Final = 4
"""Instances remembered for one (address, port): the present one, the last one and two rivals."""
ANSWER_ADDRESSES_MAX: Final = 1024
"""Addresses remembered for ``ANSWER_INTERVAL``; the oldest is forgotten first."""
ANSWERS_PER_SECOND: Final = 500
"""Over all addresses: forged beacons must not turn a peer into an amplifier; a start of 100 peers stays below."""
GREETINGS_MAX: Final = 256
"""Addresses known only by hearsay; further ones wait until there is room."""
GREETING_FIRST: Final = 0.5
"""Before the second greeting to an address known by hearsay; then it doubles."""
GREETING_MAX: Final = 10.0
"""Between two greetings at the most."""
GREETING_FORGET: Final = 20.0
"""An address of which nobody spoke for this long (four heartbeats) is greeted no more."""
SPREAD_INTERVAL: Final = 0.5
"""News of found peers are gathered this long for those that hear no multicast; the first goes out at once."""
GREETINGS_PER_SECOND: Final = 25.0
"""Over all such addresses, beyond one for each: who is passed on may be invented."""
WHISPERS_PER_SECOND: Final = 10.0
"""Heartbeats by unicast to peers without a link, over all of them: each takes 0.2 ms, and of a roster full of
invented peers each still gets one a minute."""
WHISPERS_AT_ONCE: Final = 8
"""Of these and of those to linked peers, some 0.1 ms each, before anything else has a turn."""
ROSTER_EVICTIONS_PER_SECOND: Final = 10.0
"""In a full roster, peers without a link that missed a heartbeat and give way to new ones."""
BEACONS_PER_WAKE: Final = 64
"""Packets handled, 100 microseconds each with data between them, before the loop gets its turn again."""
BEACONS_PER_SOURCE: Final = 200
"""Packets a second from one address; a host with twenty agents that all start at once stays below."""
BEACONS_UNLINKED_PER_SECOND: Final = 200.0
"""Beacons a second of peers that we have no link with, over all addresses, which can be forged: 5 % of a core."""
BEACONS_UNLINKED_BURST: Final = 1000
"""The same at once: a hundred peers that start together send 400 and answer each other."""
BEACON_SOURCES_MAX: Final = 1024
"""Source addresses counted for that; the oldest is forgotten first."""
BEACON_REPEATS: Final = 128
"""Last packets remembered: one that came over two interfaces is read once."""
SEED_RESOLVE_INTERVAL: Final = 60.0
"""A seed's host name is looked up again this often: addresses change."""
SEED_RETRY_FIRST: Final = 1.0
"""Before a failed look-up is repeated; then it doubles, for there may be no name server yet."""
SEED_RETRY_MAX: Final = 30.0
"""Between two failed look-ups at the most."""

# --- mesh -----------------------------------------------------------------------------------------------------
LINK_LEASE: Final = 1.0
"""A link on which nothing arrived for this long is dead (TCP alone would take two hours)."""
PAUSE_NOTICED: Final = 0.1
"""A timer that comes later than this tells that its process was away: that time counts as no peer's silence."""
KEEPALIVE_INTERVAL: Final = 0.25
"""A quarter of the lease: three keepalives may be late before the link falls."""
KEEPALIVE_ANSWERED: Final = 1.2
"""The acceptor's interval in those of the dialler: the dialler pings, and the pong counts as a sign of life."""
HANDSHAKE_TIMEOUT: Final = 3.0
"""From connect to welcome; whoever takes longer is a port scanner or stuck."""
DIAL_ATTEMPTS: Final = (0.3, 0.5, 1.2)
"""For each of the TCP connects that make a dial."""
DIAL_TIMEOUT: Final = 2.0
"""For all of them."""
DIAL_STAGGER: Final = 0.1
"""Before the next of a peer's addresses is tried beside those that have not answered: the least that RFC 8305 allows;
networks of robots are near."""
DIAL_FALLBACK: Final = 2.0
"""The higher GUID waits this long for the lower one's call, then dials itself (NAT, firewall)."""
BACKOFF_FIRST: Final = 0.1
"""Before the second attempt to dial."""
BACKOFF_MAX: Final = 2.0
"""Between attempts at the most: a peer that comes back is linked within this time."""
DIAL_STRANGERS_RATE: Final = 10.0
"""Dials a second to peers that were never linked, over all of them: beacons can be forged, and a dial that fails
takes half a millisecond. Their back-off's cap grows with their number; up to 20 of them notice nothing."""
DIAL_STRANGERS_BURST: Final = 64
"""Such dials at once. One that ends in a link is not counted, so a network that starts up is not held up."""
FRAME_HEADER_BYTES: Final = 24
"""See docs/design/protocol.md."""
MESSAGE_MAX: Final = 256 * MIB
"""One ROS message with its length; the largest point clouds and images stay below this."""
FRAGMENT_BYTES: Final = 128 * KIB
"""What one message sends before another of its lane has its turn: 10 ms of a 100 Mbit/s link. Longer messages go in
several data frames."""
DATA_PAYLOAD_MAX: Final = 256 * KIB
"""Data frames longer than this are refused: nobody sends them, and one would hold up all others of its lane."""
COMMIT_BYTES: Final = 64 * KIB
"""Waiting bytes that are prepared for one write: what is prepared is overtaken by nothing and dropped by no rule."""
CONTROL_PAYLOAD_MAX: Final = 16 * MIB
"""A control frame: the graph of a peer with a few thousand topics and their message definitions."""
HELLO_PAYLOAD_MAX: Final = 4 * KIB
"""Before a peer has said who it is, nothing larger is read from it."""
PENDING_LINKS_MAX: Final = 64
"""Accepted connections that have not finished their handshake."""
LINK_QUEUE_BYTES: Final = 64 * MIB
"""Data that waits for one slow link, over all topics; the oldest of the same topic is dropped beyond it."""
ROUTE_QUEUE_MESSAGES: Final = 1000
"""Messages of one topic that wait for one slow link."""
EXPRESS_MESSAGE_MAX: Final = 8 * KIB
"""Messages up to this size are small: they go by the express lane unless their contract says otherwise. A full one
takes 0.7 ms on 100 Mbit/s."""
EXPRESS_AGAIN_MESSAGES: Final = 200
"""Small messages in a row before a topic that had a large one goes back to the express lane."""
EXPRESS_AGAIN_AFTER: Final = 5.0
"""Seconds since its last large message, likewise: a topic that mixes both sizes must not go to and fro."""
CUT_THROUGH_BYTES: Final = 96 * KIB
"""Messages above this are handed on while they still arrive."""
STALE_AGE: Final = 0.1
"""A best-effort message that was on its way for longer (a cable was out) gives way to a newer one behind it."""
STALE_TICK: Final = 0.04
"""Between the looks of an agent that receives data: what it finds then came since the last one."""
STALE_HOLD: Final = 0.03
"""How long such a message waits for a newer one; the last one of a burst is delivered after this."""
BULK_LEASE: Final = 4.0
"""A bulk lane on which nothing arrived for this long is dead; the express lane says much sooner when a peer is."""
BULK_UNSENT_BYTES: Final = 16 * KIB
"""Bytes that the kernel keeps of the bulk lane before they can leave (TCP_NOTSENT_LOWAT): with SO_PRIORITY this is
what keeps a command's p99 beside images at 0.4 ms instead of 79 ms on 100 Mbit/s."""
RELIABLE_WINDOW_MESSAGES: Final = 512
"""Reliable messages of one route on their way to a peer and not yet acknowledged."""
RELIABLE_WINDOW_BYTES: Final = 4 * MIB
"""The same in bytes; one message always fits."""
REDIAL_TIMEOUT: Final = 0.2
"""For one attempt to reach a silent peer anew: a lost SYN is repeated by us, not by TCP a second later."""
REDIAL_PAUSE: Final = 0.05
"""Between such attempts, where the system says at once that there is no way."""
AWAY_GRACE: Final = 0.5
"""A peer whose link fell silent keeps its place in the local graph for this long: after a cable's second without
contact the next link stands within it, and no node need connect anew."""
KEEP_ALL_MESSAGES: Final = 1_000_000
"""What "all" means for a contract's history: bytes bound it first."""
BULK_STALE_AGE: Final = 0.5
"""The same on the bulk lane: of a topic that a slow link cannot carry, the newest goes."""
REPLAY_BYTES: Final = 64 * MIB
"""Reliable messages of one route that are kept for a peer, at the most; the oldest is given up beyond it."""
PING_TIMEOUT: Final = 2.0
"""For the answer to a ping that somebody asked for."""
DRAIN_TIMEOUT: Final = 1.0
"""How long an agent that ends waits for its last bytes to leave."""
LINK_LEASE_MIN: Final = 0.1
"""A peer that claims a shorter lease is held to this one: no network keeps less."""
LINK_LEASE_MAX: Final = 60.0
"""A peer that claims a longer lease is held to this one."""
GHOST_QUIET: Final = 0.5
"""Two keepalives: a link that was silent for this long does not keep a new instance of its peer out."""
LINKS_MAX: Final = 512
"""Peers that are linked at once; as many as a roster holds."""
LINK_STABLE: Final = 5.0
"""A link that was up for this long was good: the next loss is retried from the shortest delay."""
REFUSED_RETRY: Final = 5.0
"""Before a peer is called again that said no for a reason which waiting seldom mends (version, domain)."""
FORGET_UNANNOUNCED: Final = ROSTER_LEASE
"""A peer known by its link alone is called again for this long after the link fell."""
LINK_UNACKED: Final = 2.0
"""Sent bytes that nobody acknowledged for this long end a connection (TCP_USER_TIMEOUT): two leases, so that the
lease, which can say why, is the first to speak."""
SEGMENT_BYTES: Final = (1200, 512)
"""Payload of one packet on a path that drops larger ones, in the order in which they are tried: with TCP_HEADERS 1252
bytes, below the MTU of every usual tunnel (1280 is IPv6's least), then 564, below IPv4's least of 576."""
TCP_HEADERS: Final = 52
"""Bytes of a packet around its payload: IPv4 (20), TCP (20), time stamps (12)."""
EXPRESS_SEGMENT: Final = 1220
"""Payload of one packet of an express lane that leaves this machine (TCP_MAXSEG), 1272 bytes with TCP_HEADERS:
commands, keepalives and the graph fit through usual tunnels from the first packet on."""
STALL_LOOK: Final = 0.1
"""Between two looks at a connection whose data is repeated."""
STALL_SUSPECTED: Final = 0.3
"""Seconds without progress, with something repeated, before a small packet tries the way; TCP repeats after 0.2."""
STALL_ANSWER: Final = 0.08
"""Seconds for the acknowledgement of what was repeated behind the small packet's answer, or 1.5 round trips if that
is more; then the path is taken for a black hole. On a LAN 0.8 s after the stall began, within the express lease."""
PATH_REMEMBERED: Final = 600.0
"""A black hole is remembered for an address this long; the next connection then tries large packets again. RFC 4821's
own value."""
PATH_NO_HELP: Final = 60.0
"""Where smaller packets did not help, they are not tried again for this long."""
PATH_PROVEN_SEGMENTS: Final = 2
"""Full segments of the smaller size that were acknowledged: then the size was what it took."""
PATHS_MAX: Final = 512
"""Addresses remembered as black holes, as many as there are links; the oldest is forgotten first."""
LINK_UNSENT_BYTES: Final = 64 * KIB
"""Bytes that the kernel keeps for one link before they can leave (TCP_NOTSENT_LOWAT): what waits there is overtaken
by no control frame and dropped by no rule. A pong on 5 Mbit/s came 1.2 s late without, 0.3 s with it."""
LINK_URGENT_BYTES: Final = 32 * MIB
"""Control frames that wait for one link: two of the longest. Beyond it the link is closed: they are never dropped."""
CLOCK_SAMPLES: Final = 16
"""Exchanges remembered for a peer's clock: 4 to 16 s of keepalives; an old one says little (CLOCK_DRIFT)."""
CLOCK_DRIFT: Final = 15e-6
"""Seconds a second that clocks drift apart (PHI of RFC 5905)."""
CLOCK_STEP: Final = 0.05
"""Seconds by which our wall clock must disagree with the monotonic one to count as set; less shows as a
contradiction between two exchanges."""
CLOCK_INTERVAL: Final = 1.0
"""Between pings on a link whose pongs alone keep it alive."""
PENDING_PER_ADDRESS: Final = 8
"""Of the connections without a handshake, those from one address: one scanner must not shut the others out."""
MESH_BACKLOG: Final = 64
"""Connections that the kernel holds until we accept them: all peers of a restarted agent dial at once."""
MESH_PORT_ATTEMPTS: Final = 32
"""Tries to find a number that is free for TCP and UDP both; the first nearly always is."""
JOIN_RETRY: Final = 1.0
"""Before an agent whose addresses have changed tries again to take a new place."""
ACK_MESSAGES: Final = 32
"""Messages of a reliable route that one acknowledgement covers: it costs as much as a message of 64 bytes."""
ACK_BYTES: Final = 1 * MIB
"""The same in bytes: with large messages the sender's window is soon full."""
ACK_DELAY: Final = 0.010
"""After the first message that was not acknowledged: what a route of few messages keeps in memory for longer."""
RESUME_WINDOW: Final = 30.0
"""How long a reliable route's messages are kept after its link fell, unless its contract says another ``outage``: a
robot drives through a shadow, an access point restarts. More is for the contract to ask for: a module that is off
seems to publish for as long, and afterwards its subscribers get all of the old messages. Latched topics of a peer
that fell silent stay as long, too."""
OUTAGE_MIN: Final = 1.0
"""Shortest ``outage`` of a contract: a link that fell silent is noticed no sooner."""
OUTAGE_MAX: Final = 86_400.0
"""Longest ``outage`` of a contract, a day; as the other times of a contract."""
OUTAGE_COUNTED: Final = 86_400.0
"""Messages of a reliable route are counted for this long after its link fell, though they are not kept any more: the
publisher's agent stays connected to it for that. After it "more may be lost" is said."""
RESUME_CLAIM: Final = 10.0
"""Seconds from a peer's having been told of all topics over its new link to its asking for a route that waited: the
last advertisement has been read by then. What it has not asked for has no listener any more."""
RESUME_CLAIM_MAX: Final = 300.0
"""Seconds from its new link to the same, where it has not even been told everything: 32,768 topics take 51 s on a
lane that is never free (TELL_PATIENCE), and a link that carries nothing ends long before."""
RESUMES_MAX: Final = 1024
"""Reliable routes that wait for their links with messages: all of one peer with a thousand topics."""
RESUME_BYTES_MAX: Final = 256 * MIB
"""Messages kept for them, over all; those of the route that waited longest are given up first, and only counted."""
RESUMES_COUNTED_MAX: Final = 4096
"""Reliable routes without a link whose messages are only counted, 3 KB each."""
LOST_TOLD_MAX: Final = (1 << 32) - 1
"""Lost messages that one ``opened`` tells of; more were never counted."""
LOSSES_REMEMBERED: Final = 8192
"""(peer, source) pairs of reliable routes that are not open, of which it is remembered what was lost."""
ABSENT_PEERS_MAX: Final = 128
"""Peers that have been away for longer than their routes wait, of which it is remembered what they miss, and what is
missed of theirs; the one away for longest is forgotten first."""

# --- ROS ------------------------------------------------------------------------------------------------------
TCPROS_HEADER_MAX: Final = 4 * MIB
"""A connection header: the longest message definitions are some 100 KB; roscpp would accept 1 GB."""
TCPROS_MESSAGE_MAX: Final = MESSAGE_MAX - 4
"""One message, so that it still fits a frame with its length."""
TCPROS_LENGTH_MAX: Final = 1_000_000_000
"""A longer message's length is no length: the stream is out of step, and the connection is closed. It is roscpp's own
bound. A message between both is read and left out."""
TCPROS_HANDSHAKE_TIMEOUT: Final = 10.0
"""For the other side's header; rospy and roscpp wait for ever, and hang for ever."""
TCPROS_CONNECT_TIMEOUT: Final = 3.0
"""For the TCP connect to a local node."""
TCPROS_CONNECTIONS_MAX: Final = 1024
"""Accepted connections of one node: as many subscribers, with room for those that reconnect."""
TCPROS_HANDSHAKES_MAX: Final = 128
"""Of these, connections whose header has not come yet (port scanners, stuck nodes)."""
TCPROS_BACKLOG: Final = 128
"""Connections that the kernel holds until we accept them: all subscribers of a restarted node come at once."""
TCPROS_RETRY_FIRST: Final = 0.1
"""Before the second attempt to reach a publisher; roscpp's own value."""
TCPROS_RETRY_MAX: Final = 2.0
"""Between attempts at the most, as long as the graph lists the publisher."""
SHARED_BACKLOG: Final = 4096
"""Connections that the kernel holds for the one socket of all proxies: all subscribers of a restarted agent come at
once. The kernel lowers it to its own bound (``net.core.somaxconn``)."""
SHARED_PROBE_TIMEOUT: Final = 1.0
"""For the trial whether addresses of 127/8 other than 127.0.0.1 work here; it takes a millisecond where they do."""
LOOPBACK_REST: Final = 60.0
"""Before a freed loopback address is given again: three times the 20 s for which roscpp dials an old one at most."""
LOOPBACK_RESTING_MAX: Final = 16_384
"""Freed addresses that are remembered: all nodes of some large modules that come and go within that minute."""
TCP_KEEPALIVE_IDLE: Final = 60
"""Seconds of silence before the kernel asks whether the other side lives; with the next two roscpp's own values."""
TCP_KEEPALIVE_INTERVAL: Final = 10
"""Seconds between such questions."""
TCP_KEEPALIVE_COUNT: Final = 9
"""Unanswered questions before the connection is dead."""
SERVICE_MESSAGE_MAX: Final = 64 * MIB
"""One request or response of a service: maps and point clouds reach some 10 MB, and each is held as a whole."""
SERVICE_TIMEOUT: Final = 60.0
"""For a call, where nobody says otherwise: planners take tens of seconds; rospy and roscpp wait for ever."""
SERVICE_OPEN_TIMEOUT: Final = 5.0
"""For the connection to a server and its header."""
SERVICE_STALL: Final = 30.0
"""For the next bytes of a request that has begun, or the first ones of a client that wants to call only once."""
SUBSCRIBER_QUEUE_MESSAGES: Final = 1000
"""Messages that wait for one slow local subscriber; the oldest is dropped beyond it."""
LATCHED_MAX: Final = 100
"""Messages of one source that are kept for late subscribers (durability transient_local), whatever the depth."""
SUBSCRIBER_QUEUE_BYTES: Final = 32 * MIB
"""The same in bytes; one message always fits."""
DEFINITION_MAX: Final = 1 * MIB
"""Characters of a message definition that we learn from a publisher; the longest known are some 100 KB."""
DEFINITION_FIELDS_MAX: Final = 4096
"""Fields and constants of one message type."""
DEFINITION_DEPTH_MAX: Final = 32
"""Types within types; ROS's own go five deep."""
LEARNT_TYPES_MAX: Final = 256
"""Message types learnt from publishers that a process remembers; the one unused for longest is forgotten."""
PACKAGE_DEPTH_MAX: Final = 32
"""Folders within folders below an entry of ROS_PACKAGE_PATH that are searched for packages; usual are four."""
PACKAGE_FOLDERS_MAX: Final = 20_000
"""Folders below one entry that are searched, up to 3 s; a workspace has a thousand, 40 ms. Nearer ones come first."""
PACKAGE_ENTRIES_MAX: Final = 200_000
"""Entries of all these folders: one folder of recordings must not take minutes."""
PACKAGE_FILE_MAX: Final = 256 * KIB
"""A package.xml; usual ones have 2 KB."""
TYPES_FOUND_MAX: Final = 256
"""Types that were found on this machine and that a process remembers; the one unused for longest is forgotten."""
TYPE_MISSING: Final = 10.0
"""Seconds that a type which a publisher's header names and nobody knows here is not looked for again: each message
asks for it, and a look goes through the whole workspace, some 50 ms."""
TYPES_MISSING_MAX: Final = 64
"""Such types that a process remembers; the one looked for longest ago is forgotten."""
SEARCHED_SHOWN: Final = 4
"""Entries of one variable that the text of an error shows."""
ASKED_FOR_TYPE_MAX: Final = 8
"""Publishers of a type that are asked for its definition, one behind the other."""
ASKED_FOR_TYPE_TIMEOUT: Final = 3.0
"""For the header of one of them: that of a peer's comes when its route is open."""
TYPE_LOOK: Final = 1.0
"""Between two looks of a resource whether a publisher of a type that it needs has come."""
NODE_MASTER_CHECK: Final = 0.5
"""Between a node's looks whether its master still knows it: a restarted core has its nodes back within a second."""
NODE_UNREGISTER_TIMEOUT: Final = 3.0
"""For an ending node to take all its registrations back; a master that hangs must not keep it from its end."""
NODE_UNREGISTER_AT_ONCE: Final = 16
"""Of these calls at a time: a connection each."""
RECEIVED_QUEUE: Final = 1000
"""Messages that wait for an ``async for``; the oldest is dropped beyond it."""
HTTP_BODY_MAX: Final = 64 * MIB
"""An XML-RPC call, or an answer that we asked for: URDFs and maps reach some 10 MB, and roslaunch sets all parameters
of a launch file in one call."""
HTTP_BODIES_MAX: Final = 256 * MIB
"""All large calls that one server has under way: four of the largest."""
HTTP_DISCARDED_MAX: Final = 1024 * MIB
"""A call that is too large is read to its end, for its caller to read the answer; above this it is only cut off."""
HTTP_PACE_MIN: Final = 64 * KIB
"""Bytes a second: a call that comes more slowly gives way to others where room is short; loopback carries 1 GB/s."""
HTTP_SLOW_AFTER: Final = 1.0
"""Before a call is called slow."""
HTTP_BODY_INLINE: Final = 64 * KIB
"""Bodies above this are read and written over several turns of the loop: 8 MiB of numbers would hold up keepalives
for seconds. Shorter ones take some 5 ms, in which only data goes first."""
XMLRPC_SLICE: Final = 2 * KIB
"""What is parsed at once of a body, some 100 microseconds; then data goes first."""
HTTP_ACCEPTS: Final = 4
"""Connections that are accepted without a pause, 40 microseconds each."""
HTTP_HEADERS_MAX: Final = 64 * KIB
"""A request's headers, all together."""
HTTP_BACKLOG: Final = 1024
"""Connections that the kernel holds until we accept them: all nodes of a robot register at once. One that finds no
place comes again after a second."""
HTTP_CONNECTIONS_MAX: Final = 512
"""Open connections to one XML-RPC server: rospy keeps one per thread alive. A new one takes the place of the one that
is idle for longest, else of the slowest."""
HTTP_IDLE_TIMEOUT: Final = 60.0
"""A kept-alive connection without a call; rospy and roscpp reconnect without a word."""
HTTP_IDLE_MIN: Final = 0.25
"""Without a call, before a kept-alive connection is closed for one that waits for a file descriptor."""
HTTP_REQUEST_TIMEOUT: Final = 10.0
"""From a request's first byte to its last."""
XMLRPC_DEPTH_MAX: Final = 256
"""XML elements inside each other: some eighty arrays in arrays; nobody's parameters come near."""
XMLRPC_ELEMENTS_MAX: Final = 4_000_000
"""XML elements in one body, two for each number: at some hundred bytes of memory each."""
PARAM_DEPTH_MAX: Final = 64
"""Namespaces inside each other in one parameter's name; more is an attack on the recursion."""
SLAVE_CALL_TIMEOUT: Final = 3.0
"""For one XML-RPC call to a node; a stopped node must not hold the others up."""
MASTER_LOOK_FIRST: Final = 0.1
"""Between two looks at a roscore whose graph has just changed: nodes register one thing after the other. An idle look
at a graph of 50 nodes costs it some milliseconds."""
MASTER_LOOK_IDLE: Final = 0.5
"""Between two looks where nothing changes: a look more would cost more than it finds earlier."""
MASTER_LOOK_MAX: Final = 0.8
"""Between two looks at the most, so that whatever changes is seen within a second."""
MASTER_LOOK_SHARE: Final = 20
"""Times what a look took, before the next one: a twentieth of the master's time is ours."""
MASTER_LOOK_SOON: Final = 0.02
"""Before a look that somebody has cause for: what he saw is seldom the only thing."""
MASTER_RETRY: Final = 0.5
"""Between two looks for a roscore that does not answer: one that was started again has us back within a second."""
MASTER_TIMEOUT: Final = 3.0
"""For one look or one write; a roscore on a busy board has answered in 0.3 s."""
MASTER_ASK_TIMEOUT: Final = 10.0
"""For an answer that may be megabytes of parameters."""
MASTER_WRITES_AT_ONCE: Final = 64
"""Registrations in one call to a roscore, some 10 ms of its work."""
MASTER_WRITES_MAX: Final = 20_000
"""Registrations that wait to be told to a roscore: more than a peer may advertise; beyond it a look finds them."""
MASTER_FAREWELL: Final = 2.0
"""For what an agent that ends has to tell a roscore."""
NODE_CHECK_INTERVAL: Final = 5.0
"""How often the core looks whether a registered node still listens."""
NODE_RECHECK_DELAY: Final = 0.2
"""Between the two refused connects that make a node dead: it may be restarting its server."""
NODE_UNREACHABLE_AFTER: Final = 15.0
"""Seconds without one connection to a registered node until peers are not offered it any more: a cable that is pulled
and put back, or an access point that is changed, takes less."""
NODE_UNREACHABLE_CHECKS: Final = 4
"""Unreachable nodes that are tried at once: each attempt may hold a thread of the resolver for seconds."""
NOTIFY_QUEUE_MAX: Final = 4096
"""Topics and parameters that wait to be told to one slow node; of one topic only the latest waits."""
NOTIFY_COALESCE: Final = 64
"""From this many on, of one parameter too only the latest waits; before, a node hears each as from rosmaster."""
NOTIFY_RETRY_FIRST: Final = 0.2
"""Before a node that did not answer is told again."""
NOTIFY_RETRY_MAX: Final = 3.0
"""Between attempts at the most, for as long as the node is registered."""
ROSOUT_QUEUE: Final = 1000
"""Log messages waiting for a slow reader of /rosout_agg."""
ROSOUT_RESPAWN: Final = 0.5
"""Seconds from the end of /rosout (`rosnode kill`) to its next start; roscore takes about as long."""
ROSOUT_LOOK: Final = 1.0
"""Seconds between two looks whether the name /rosout is free again, and between attempts to start."""

CORE_STATE_BYTES: Final = 64 * MIB
"""What a core keeps over its end, over all rows: a robot's parameters with its description are some MB."""
CORE_STATE_NAME_MAX: Final = 4096
"""Characters of a name that is taken from such a file: rosmaster has no limit, and the longest seen have 200."""
CORE_STATE_GATHER: Final = 0.3
"""Changes of the graph are gathered this long before they are kept: what a kill -9 loses, with the write itself half
a second at the most. Nodes that start register a dozen things each."""
CORE_STATE_RETRY: Final = 5.0
"""Before a file that could not be written is tried again: the disk is full, or not there yet."""
CORE_STATE_LOCKED: Final = 1.0
"""For the file's lock: the process before may still be ending."""
CORE_STATE_OPEN: Final = 3.0
"""For reading the file at the start; a disk that hangs must not keep the core from its start."""
CORE_STATE_WRITE: Final = 10.0
"""For one write; then the disk is said not to answer. The first one after a start may be 64 MiB on a slow card."""
CORE_STATE_CLOSE: Final = 3.0
"""For the last write of a core that ends; a disk that hangs is left behind."""
CORE_STATE_UNFIT_SHOWN: Final = 3
"""Names of what did not fit that a text for the user has."""
TAKE_UP_AT_ONCE: Final = 32
"""Nodes of the run before that are asked at the same time: a connection each, and who asks the core meanwhile comes
behind that many."""
TAKE_UP_PROMPT: Final = 0.25
"""A node that has not answered after this long does not count among these: who hangs delays nobody else."""
TAKE_UP_RETRY_FIRST: Final = 0.5
"""Before a node that did not answer is asked again."""
TAKE_UP_RETRY_MAX: Final = 10.0
"""Between two questions at the most."""
TAKE_UP_PATIENCE: Final = 600.0
"""A node that did not answer for this long is given up: one that a debugger stopped may be on again by then."""
TAKE_UP_LISTS: Final = 8
"""Nodes that are asked at the same time what they publish and subscribe to, once all have been asked who they are."""
TAKE_UP_COMPARED: Final = 3
"""Times that a node is asked so; one that registers something each time is busy, and tells everything itself."""
TAKE_UP_ANNOUNCE: Final = 3.0
"""What was taken up is told to subscribers when all have answered or hang, or after this long: to ask 500 nodes takes
a second, and what follows from each (connections to it, the aggregator's among them) would come between."""

# --- bridge ---------------------------------------------------------------------------------------------------
ROUTE_OPEN_TIMEOUT: Final = 5.0
"""From asking a peer for a topic to its answer; then the route is asked for again."""
ROUTE_LINGER: Final = 1.0
"""A route stays open this long after its last local subscriber left: reconnecting nodes flap."""
ADVERTISED_AT_ONCE: Final = 64
"""Sources in one advertisement of ours; more follow in the next turn of the loop."""
TELL_BACKLOG: Final = 8 * KIB
"""Bytes under way to a peer above which the next portion of a graph waits: a portion has some 6 KB, and data does not
wait for more than 12 ms behind both on 10 Mbit/s. All of 10,000 topics at once were 0.8 s."""
TELL_PAUSE: Final = 0.005
"""Before it is looked again."""
TELL_PATIENCE: Final = 0.1
"""A portion waits no longer than this: on a lane that is never empty the graph must get on too, by 0.5 Mbit/s."""
ADVERTISEMENT_MAX: Final = 1 * MIB
"""One advertisement, which is read in one piece: ours are 200 KB with the longest names, and 5 KB with usual ones."""
ADVERTISED_WAITING_BYTES: Final = 4 * MIB
"""Advertisements of all peers that wait to be read: some 40,000 topics. Beyond it they are read at once."""
LEARNT_AT_ONCE: Final = 16
"""Sources of an advertisement that are dealt with at once, some 100 microseconds; then data goes first."""
RESCANNED_AT_ONCE: Final = 16
"""Topics of the local graph that are looked at in one turn of the loop, after a change or to reconcile."""
TOPICS_PER_PEER_MAX: Final = 32_768
"""Default of ``limits.topics``: (topic, node) pairs of one peer that are known here, those that this module offers,
and open routes of one peer. Each takes some 5 KB."""
NODES_PER_PEER_MAX: Final = 4096
"""Default of ``limits.nodes``: nodes of one peer that get a proxy here. Each takes some 15 KB; large robots have some
hundred, fleets behind a relay a few thousand."""
SURPLUS_MAX: Final = 32_768
"""Topics, and services, of one peer beyond ``[limits]`` that are remembered, some 400 B each: they are shown as soon
as there is room. Further ones are counted, and come with the peer's next link."""
ADVERTISED_MAX: Final = 16_384
"""Topics or services in one advertisement of a peer; ours have ``ADVERTISED_AT_ONCE``."""
MISMATCHES_MAX: Final = 16
"""Refused subscribers of one source that are remembered for the user."""
RELAY_HOPS_MAX: Final = 4
"""Relays between two modules: five networks in a row; each adds a hop's delay, and longer rows are a mistake."""
SERVICE_ROUTES: Final = 1 << 31
"""Routes from here on are those of services: topics' are counted from 1."""
SERVICES_PER_PEER_MAX: Final = 16_384
"""Default of ``limits.services``: services of one peer that are known here, those that this module offers, and those
that one peer has open at once. A large robot's nodes have some 500, loggers left out."""
SERVICE_TIMEOUT_MAX: Final = 3600.0
"""Longest time that a call may be given: a caller of a server that hangs is told so within the hour."""
SERVICE_GRACE: Final = 1.0
"""The serving agent waits this much longer than the calling one, whose text says more."""
SERVICE_IDLE: Final = 30.0
"""A service, and a connection to its server, that nobody uses for this long is closed."""
SERVICE_POOL: Final = 32
"""Calls of one service that its server gets at once, each by a connection (and in rospy a thread) of its own."""
SERVICE_QUEUE: Final = 1024
"""Calls of one service that wait for one of those; further ones are refused at once."""
SERVICE_BYTES: Final = 256 * MIB
"""Requests and responses of one peer that are under way or being put together, each way: four of the largest."""
SERVER_LOOK: Final = 0.5
"""Between two looks whether the servers of what is offered still listen: a killed one is gone within 1 s."""
SERVICE_LATENCIES: Final = 512
"""Calls of a service that its latency is made of."""
AUDIENCE_MAX: Final = 64
"""Nodes that listen to one topic and are named to its publisher's agent."""
AUDIENCES_MAX: Final = 1024
"""Connections that stand for one peer's listeners (``bridge.topics.audience``): 512 action servers of one module."""
ASK_NAME_MAX: Final = 64
"""Characters of a question's name."""
ASKS_AT_ONCE: Final = 64
"""Questions of one peer that are being answered; further ones are refused at once."""
ASK_TIMEOUT: Final = 5.0
"""For another agent's answer."""
WHY_WINDOW: Final = 1.0
"""Between the two looks of ``rmpa why`` at what flows: a topic of some messages a second has moved by then."""
WHY_TIMEOUT: Final = 12.0
"""For a peer's own walk: its window, and two questions to us of ASK_TIMEOUT each at the worst."""
WHY_SILENT: Final = 2.0
"""A topic that was silent for less than this is not called so, whatever its rate."""
WHY_SILENT_PERIODS: Final = 10.0
"""In its own longest usual periods, likewise."""
WHY_PROBE: Final = 2.0
"""For a service's server to answer a probe: it is on the same machine as the agent that asks."""
WHY_SOURCES_MAX: Final = 64
"""Publishers of one topic in one module that ``rmpa why`` tells of."""
PARAM_PORTION: Final = 16 * KIB
"""Characters of a parameter that cross at once: a millisecond of a 100 Mbit/s link, and the next portion is asked for
when this one is there, so commands do not wait behind megabytes."""
PARAM_TEXT_MAX: Final = 16 * MIB
"""Characters of a parameter as XML-RPC text that crosses between modules; within one module ``HTTP_BODY_MAX`` holds.
A peer may read and write ``PARAM_TRANSFERS`` of these at a time: 128 MiB."""
PARAM_TRANSFERS: Final = 4
"""Parameters that one peer reads or writes at a time; the one that was begun first gives way."""
PARAM_TRANSFER_IDLE: Final = 30.0
"""A parameter that is read or written in portions is forgotten when nobody went on for this long."""
PARAM_ASK_TIMEOUT: Final = 25.0
"""For a peer's answer about a parameter: its core may need seconds for megabytes of numbers, data going first. Less
than CONTROL_HANDLER_TIMEOUT, so that the user hears who did not answer."""
PARAM_LEAVE_TIMEOUT: Final = 1.0
"""For leaving all parameters that the agent was told of, when it ends."""
PARAM_GATHER: Final = 0.05
"""Changes of a followed parameter are gathered this long: a node that loads twenty keys of a namespace sets each."""
PARAM_SMALL: Final = 64 * KIB
"""Followed parameters up to this size are compared each RECONCILE_INTERVAL; larger ones are trusted to the core's own
notifications, and compared when the core was restarted."""
FOLLOWED_BYTES_MAX: Final = 64 * MIB
"""All followed parameters as they are remembered here, to be put back."""
CROSSING_NAME_MAX: Final = 1024
"""Characters of a topic's, node's or type's name that crosses the mesh; the longest seen have some 200."""
CONTROL_TEXT_MAX: Final = 16 * KIB
"""Characters of a text for people in a control message."""
NODE_KILL_WAIT: Final = 3.0
"""Seconds that a node has to end after it was asked to; a node with much to put away takes a second or two."""
NODE_KILL_LOOK: Final = 0.2
"""Seconds between two looks whether it has ended."""
NODE_KILL_TIMEOUT: Final = 10.0
"""For a peer's agent to end a node: its answer to the call, and the wait."""
NODE_KILLS_AT_ONCE: Final = 16
"""Nodes of peers whose end is asked for at one time; further ones are refused."""
NODE_KILL_ALL: Final = 2.0
"""Seconds in which the caller that asked the agent's own node to end ends no node of another module, counted anew
from each such call: `rosnode kill -a` asks all nodes of the graph, one after the other."""
CALL_BACK_DELAYS: Final = (0.05, 1.0)
"""When a proxy is registered again whose subscribers were hung up on: at once, and for those that noticed late."""
RECONCILE_INTERVAL: Final = 5.0
"""The plan is compared with what is really open this often, so that nothing stays stuck."""
WATCH_RECENT: Final = 16
"""Last events of a topic's contract that are remembered for the user; the counts tell of the others."""
WATCH_LOOK: Final = 0.25
"""A source that is not alive is looked at this often: its messages leave their time behind, and wake nobody."""
WATCH_RUN: Final = 1.0
"""Losses of one kind that follow each other within this time are remembered as one event."""
QUALITY_WINDOW: Final = 512
"""Messages of a remote source that its figures are made of, a power of two: 10 KB a route, and a 99th percentile that
five of them exceed."""
QUALITY_RATE_SPAN: Final = 1.0
"""Seconds that a rate is counted over where the window above is shorter: at 47 kHz that holds one burst of 11 ms."""
QUALITY_SILENCE: Final = 0.1
"""A shorter silence is our own pause between two reads, not the source's, and counts for no rate."""
QUALITY_SPAN: Final = 60.0
"""Older messages tell nothing of how a source is now."""
QUALITY_CLOCKS: Final = 128
"""Estimates remembered of each link's clock: one or two a second over QUALITY_SPAN."""
QUALITY_CLOCK_STEP: Final = 0.9
"""Seconds in which at most two of them are remembered; they come once a second, and whenever somebody asks."""

# --- monitor --------------------------------------------------------------------------------------------------
CONTROL_REQUEST_MAX: Final = 1 * MIB
"""One request on the control socket."""
CONTROL_REPLY_MAX: Final = 64 * MIB
"""One reply: the snapshot of a very large graph."""
CONTROL_CLIENTS_MAX: Final = 32
"""Simultaneous clients of the control socket."""
CONTROL_IDLE_TIMEOUT: Final = 60.0
"""A client that asks nothing for this long is closed."""
CONTROL_CALL_TIMEOUT: Final = 10.0
"""For one call over the control socket; a stopped agent must not hang the command line."""
CONTROL_LOOK_TIMEOUT: Final = 1.0
"""For the connection by which a client sees whether an agent lives: the kernel takes it, even for a stopped one."""
CONTROL_BACKLOG: Final = 128
"""Clients with a time-out are refused by the kernel, not kept waiting, when these are taken."""
CONTROL_PINGS_MAX: Final = 100
"""Pings of one call: it must come to an end. The command line asks for one at a time."""
CONTROL_HANDLER_TIMEOUT: Final = 30.0
"""For the agent's own part of a call."""
CONTROL_PATH_MAX: Final = 107
"""Bytes in a UNIX socket's path: Linux's sun_path less its final zero."""
CPU_INTERVAL: Final = 1.0
"""Over at least so long the agent's use of the CPU is measured; the kernel counts it in ticks of 10 ms."""
DIAGNOSTICS_INTERVAL: Final = 1.0
"""Between two messages on /diagnostics, as ROS's own publishers have it; the links' clocks are followed as often."""
DIAGNOSTICS_STALE: Final = 60.0
"""For this long a peer that is gone, and what came from it, is shown as stale on /diagnostics."""
DIAGNOSTICS_QUEUE: Final = 10
"""Messages waiting for a slow reader of /diagnostics: each holds everything that the one before it did."""

# --- doctor ---------------------------------------------------------------------------------------------------
DOCTOR_HEAR: Final = 1.0
"""For a packet that an interface sends to ourselves; it takes less than a millisecond where it comes at all."""
DOCTOR_PROGRAM: Final = 5.0
"""For one of the system's programs (nft, iptables) to answer."""
DOCTOR_NAME: Final = 5.0
"""For the resolver to say what a host name is: a dead name server takes 5 s for each question."""
DOCTOR_OUTPUT_MAX: Final = 4 * MIB
"""Of such a program; the rules of a Kubernetes node have some 100 KB."""
DOCTOR_FILES_LOW: Final = 4096
"""Open files below which an agent of a large graph runs out: each subscriber takes one, and a proxy two where proxies
cannot share their sockets."""
DOCTOR_CLOCK_LOOK: Final = 0.3
"""Between two looks at both clocks, to see one being set."""
DOCTOR_CLOCK_STEP: Final = 0.005
"""Seconds that the wall clock may go apart from the monotonic one meanwhile; slewing makes 0.15 ms."""
DOCTOR_CLOCK_APART: Final = 0.02
"""Seconds between the clocks of two modules from which on tf complains: two periods of a 100 Hz transform."""

# --- resources ------------------------------------------------------------------------------------------------
DESCRIPTOR_MAX: Final = 1 * MIB
"""Characters of a resource's descriptor: one with a hundred profiles of twenty attributes has some 100 KB."""
REQUIREMENT_TEXT_MAX: Final = 1024
"""Characters in what is asked of one attribute."""
TASK_QUEUE_MESSAGES: Final = 10
"""Messages of its input that wait for a task; the oldest is dropped beyond it: control acts on the newest."""
TASK_PAUSE_TIMEOUT: Final = 1.0
"""How long a profile that is to be applied waits for the runs under way; one that takes longer is stuck or slow."""
PRECONDITION_TIMEOUT: Final = 1.0
"""Seconds for which a profile whose precondition does not answer counts as before; then it is left out."""
RESOURCE_HELD_MAX: Final = 64 * 1024 * 1024
"""Bytes of messages that a resource keeps while a profile is applied; the oldest give way."""
TASK_END_TIMEOUT: Final = 2.0
"""How long an ending resource waits for a task's last run; a thread that is stuck is left behind."""
RESOURCE_ANSWER_TIMEOUT: Final = 10.0
"""For a resource's answer to a requirement; it may be in another module, and its route has to open first."""
REQUIREMENT_BOUNDS_MAX: Final = 256
"""Attributes that one client asks for."""
RESOURCE_CLIENT_GRACE: Final = 30.0
"""Seconds that a restarted resource keeps what a client asked before until that connects again: its master, its agent
and the links may all have to come up first."""
RESOURCE_REPORT_WINDOWS: Final = 3
"""Quality windows for which what a client observes counts; one that reports no more observes nothing."""
RESOURCE_STAMPS_MAX: Final = 1024
"""Requests with an expiry whose stamps are remembered, so that a latched one that comes again does not begin anew."""
STORE_WINDOWS_MAX: Final = 3600
"""Quality windows in a resource's history: an hour of them, some 2 MB."""
STORE_EVENTS_MAX: Final = 2000
"""Alarms and changes of the profile in it."""
STORE_DESCRIPTORS_MAX: Final = 20
"""Different descriptors of one resource in it: one more for each change of its file."""
KNOWN_MAX: Final = 256
"""Other resources whose descriptors a module keeps; the one that was not seen for longest gives way."""
KNOWN_TEXT_MAX: Final = 16 * MIB
"""Characters of all of them."""
KNOWN_LOOK: Final = 10.0
"""Seconds between looks which resources there are."""
KNOWN_WRITE: Final = 60.0
"""Seconds between writes of when a resource that is here was seen last, to spare flash memory."""
STORE_BYTES_MAX: Final = 64 * MIB
"""Of the whole file, whatever happens."""
STORE_INTERVAL: Final = 10.0
"""Seconds between writes of the history, to spare flash memory; what must survive a crash is written at once."""
STORE_PENDING_MAX: Final = 600
"""Rows of history that wait for a disk that does not take them; the oldest give way."""
STORE_OPEN_TIMEOUT: Final = 5.0
"""Seconds that a starting resource waits for its store; then it starts without what it remembers."""
STORE_LOCK_TIMEOUT: Final = 1.0
"""Seconds that a store waits for its lock: the process before may still be ending."""
STORE_CLOSE_TIMEOUT: Final = 5.0
"""Seconds that an ending resource waits until everything is written; a disk that hangs is left behind."""
CONTEXT_RULE_MAX: Final = 1024
"""Characters of the rule of a context."""
CONTEXT_RULE_DEPTH: Final = 20
"""Brackets and negations within each other in such a rule."""
CONTEXT_DWELL: Final = 1.0
"""Seconds that a context stays which a rule has chosen: a value at its edge must not make the resource flutter."""
CONTEXT_ENTER_TIMEOUT: Final = 5.0
"""For what a context does when it begins; the tasks rest meanwhile."""
CONTEXT_RETRY: Final = 5.0
"""After a context that could not begin, before its rule is looked at again."""
CONTEXT_LOOK: Final = 0.5
"""Between looks whether topics that rules name are there: one call of the module's own master."""

# --- logging --------------------------------------------------------------------------------------------------
LOG_WAITING: Final = 10_000
"""Lines that wait for a reader of the log who has stopped: some 1 MB. The newest are lost beyond it."""
LOG_GATHER: Final = 0.01
"""Lines are gathered for this long before they are written: a burst costs one system call."""
LOG_BATCH: Final = 1000
"""Lines in one such call."""
LOG_INTERVAL: Final = 5.0
"""A refusal of one kind from one address is logged at most once in this time; the rest are counted."""
LOG_LINES_MAX: Final = 20
"""Lines about one kind of refusal in this time, whatever the addresses: those of packets can be forged."""
LOG_KINDS_MAX: Final = 1024
"""Kinds of refusal remembered for that; the oldest is forgotten first."""
