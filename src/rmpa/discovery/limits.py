"""Limits and time-outs of discovery.

Each has its reason beside it. Seconds and bytes, unless the name says otherwise.
"""

from __future__ import annotations

from typing import Final

MULTICAST_TTL: Final = 1
"""Multicast time-to-live: beacons stay in their own sub-network."""
BEACON_MAX_BYTES: Final = 1200
"""One beacon fits one packet on every link (IPv6 minimum MTU 1280 less headers)."""
BEACON_ADDRESSES_MAX: Final = 8
"""Addresses that a beacon carries at most: a robot with more of them announces the first eight."""
BEACON_GOSSIP_MAX: Final = 64
"""Peers that one beacon gossips about; if there are more, successive beacons carry them in turn."""
BURST_OFFSETS: Final = (0.0, 0.1, 0.3, 0.7)
"""When a starting agent announces itself, in seconds after its start: Wi-Fi loses multicast, so one beacon is not
enough."""
HEARTBEAT_INTERVAL: Final = 5.0
"""Paper, section 4.3: "each five seconds a heartbeat will check that network is still alive"."""
MANY_MEMBERS: Final = 64
"""Members above which answers and early heartbeats are delayed or gathered, lest a start of many agents be a storm of
packets. Up to here each announcement is answered at once, as in the paper."""
CONFLICT_AFTER: Final = 2.0
"""A packet of a replaced instance after this long is not a late one: two live peers share one GUID."""
ADDRESS_SHARED_AFTER: Final = 5.0
"""Seconds without a link, although its beacons arrive, after which a peer with another's address is shown as in
conflict."""
ADDRESS_SHARED_MARGIN: Final = 1.0
"""Seconds after the end of a peer's link in which its beacon may still be one from before."""
GOODBYE_LATE: Final = 0.2
"""Seconds after a goodbye in which beacons that were sent before it may still come, or be read from another socket. A
beacon that comes later refutes the goodbye."""
ANSWER_INTERVAL: Final = 0.2
"""The shortest time between two unicast answers to one address."""
INTERFACE_SETTLE: Final = 0.2
"""Delay after a reported change of interfaces before they are read, because the kernel reports several at once."""
INTERFACE_LOOK: Final = 5.0
"""How often interfaces are read where the kernel does not report changes."""
BURST_AGAIN_OFFSETS: Final = (0.0, 0.2, 0.6)
"""The shorter burst of beacons after a change of interfaces: most listeners know the agent already."""
BURST_JITTER: Final = 0.05
"""The longest random delay of each but the first beacon of a burst: modules on one power switch start together."""
HEARTBEAT_JITTER: Final = 0.1
"""The largest random part of the interval by which a heartbeat is sent early, because modules start together."""
HEARTBEAT_LATE: Final = 6.0
"""A peer that was silent for this long (a heartbeat and a second) has missed a heartbeat: of two instances it may be
the dead one."""
MULTICAST_SILENCE: Final = 11.0
"""A peer not heard by multicast for this long (two heartbeats and a second) gets its heartbeats by unicast."""
LEASE_MIN: Final = 2.0
"""The shortest lease: with a shorter one a peer would come and go with every lost packet."""
LEASE_MAX: Final = 120.0
"""The longest lease: with a longer one a peer would be shown long after its end."""
ANSWERS_TOGETHER: Final = 8
"""Newcomers of a large mesh that wait for an answer at one time, from which on one multicast answers all of them: it
costs each member one packet to read, as much as the answers would cost their senders."""
ENDPOINT_RUNS_MAX: Final = 4
"""Runs remembered for one (address, port): the present one, the last one and two rivals."""
ANSWER_ADDRESSES_MAX: Final = 1024
"""Addresses remembered for ``ANSWER_INTERVAL``; the oldest is forgotten first."""
ANSWERS_PER_SECOND: Final = 500
"""Unicast answers a second over all addresses: forged beacons must not turn an agent into an amplifier; a start of
100 peers stays below this. In a large mesh it is also the number of answers a second that one newcomer gets: 1,000
members answer within 2 s, each at a random time."""
CANDIDATES_MAX: Final = 1024
"""Addresses kept that are known only from gossip; further ones are ignored until there is room."""
CANDIDATE_RETRY_FIRST: Final = 0.5
"""Delay before the second announcement to an address known from gossip; it doubles each time."""
CANDIDATE_RETRY_MAX: Final = 10.0
"""Longest time between two announcements to an address known from gossip."""
CANDIDATE_LIFETIME: Final = 20.0
"""An address that no gossip had for this long (four heartbeats) is given up."""
DISSEMINATION_INTERVAL: Final = 0.5
"""Newly found peers are gathered for this long before peers without multicast are notified; the first at once."""
DISSEMINATIONS_PER_SECOND: Final = 100.0
"""Such early heartbeats a second, of all members of a large mesh together: while a thousand agents start, each of
them finds new peers all the time."""
CANDIDATES_BURST: Final = 256
"""Announcements to addresses known from gossip that may be sent at once."""
CANDIDATES_PER_SECOND: Final = 25.0
"""Announcements a second to all addresses known from gossip, beyond one for each: gossiped peers may be forged."""
UNICAST_HEARTBEATS_AT_ONCE: Final = 8
"""Unicast heartbeats, to linked and unlinked peers, in one run of the timer; each takes some 0.1 ms."""
STRANGERS_MAX: Final = 1024
"""Peers that were never linked and may be known at one time: they may be forged, and each of them costs a few
microseconds wherever all peers are looked at. Peers of a large mesh are linked once, and then count no more."""
BEACONS_PER_WAKE: Final = 64
"""Packets handled in one callback, 100 microseconds each; pending data is handled between them."""
BEACONS_UNPROVED_PER_SECOND: Final = 4000.0
"""Packets a second without a valid proof that an agent of a secured mesh looks at: 37 microseconds each, 15 % of a
core. Above it the socket is not read for a while, and the kernel drops what does not fit its buffer: beacons of
members too, which are sent again, and which links do not need."""
BEACONS_UNPROVED_BURST: Final = 1000
BEACONS_UNPROVED_PAUSE: Final = 0.05
"""Seconds for which a socket is not read then."""
STRANGERS_SHOWN: Final = 32
"""Modules that are not of this mesh and are shown to users; what they say of themselves may be invented."""
STRANGER_KEPT: Final = 30.0
"""How long such a module is shown after its last beacon: six heartbeats."""
STRANGER_BEACONS_PER_SECOND: Final = 50.0
"""Refused beacons a second that are parsed for the names of such modules: 0.1 % of a core."""
BEACONS_PER_SOURCE: Final = 200
"""Packets a second from one address; a host with twenty agents that all start at once stays below."""
BEACONS_UNLINKED_PER_SECOND: Final = 200.0
"""Beacons a second that are accepted from peers that never had a link, over all addresses (they can be forged): 5 %
of a core."""
BEACONS_UNLINKED_BURST: Final = 4096
"""Beacons of such peers accepted at once, which take 0.4 s: a thousand agents that start together announce themselves
four times each. Data is handled between them."""
RECEIVE_BUFFER_BYTES: Final = 1 << 20
"""The kernel's buffer of each socket that receives beacons (SO_RCVBUF; net.core.rmem_max bounds it): 1,300 packets,
so that the announcements of a thousand agents that start at once wait until they are read."""
BEACON_SOURCES_MAX: Final = 4096
"""Source addresses whose packets are counted; the oldest is forgotten first."""
SEED_RESOLVE_INTERVAL: Final = 60.0
"""A seed's host name is looked up again this often: addresses change."""
SEED_RETRY_FIRST: Final = 1.0
"""Delay before a failed look-up of a seed's name is repeated; it doubles each time (no name server yet)."""
SEED_RETRY_MAX: Final = 30.0
"""The longest delay between two look-ups after failures."""
