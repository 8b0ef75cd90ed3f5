"""Limits and time-outs of discovery.

Each has its reason beside it. Seconds and bytes, unless the name says otherwise.
"""

from __future__ import annotations

from typing import Final

MULTICAST_TEST_PORT: Final = 11410
"""Of ``rmpa multicast``: beside those of all domains, so that no agent hears its packets."""
MULTICAST_TTL: Final = 1
"""Hops: the own sub-network only."""
BEACON_MAX_BYTES: Final = 1200
"""One beacon fits one packet on every link (IPv6 minimum MTU 1280 less headers)."""
BEACON_ADDRESSES_MAX: Final = 8
"""Addresses that a beacon carries: a robot with more interfaces announces the first eight."""
BEACON_GOSSIP_MAX: Final = 64
"""Peers that one beacon gossips about; if there are more they take turns."""
BURST_OFFSETS: Final = (0.0, 0.1, 0.3, 0.7)
"""When a starting peer announces itself: Wi-Fi loses multicast, one beacon is not enough."""
HEARTBEAT_INTERVAL: Final = 5.0
"""Paper, section 4.3: "each five seconds a heartbeat will check that network is still alive"."""
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
LEASE_MIN: Final = 2.0
"""A peer that asks for less would come and go with every lost packet."""
LEASE_MAX: Final = 120.0
"""A peer that asks for more would be shown for long after its end."""
ENDPOINT_RUNS_MAX: Final = 4
"""Runs remembered for one (address, port): the present one, the last one and two rivals."""
ANSWER_ADDRESSES_MAX: Final = 1024
"""Addresses remembered for ``ANSWER_INTERVAL``; the oldest is forgotten first."""
ANSWERS_PER_SECOND: Final = 500
"""Over all addresses: forged beacons must not turn a peer into an amplifier; a start of 100 peers stays below."""
CANDIDATES_MAX: Final = 256
"""Addresses known only from gossip; further ones wait until there is room."""
CANDIDATE_RETRY_FIRST: Final = 0.5
"""Before the second announcement to an address known from gossip; then it doubles."""
CANDIDATE_RETRY_MAX: Final = 10.0
"""Longest time between two such announcements."""
CANDIDATE_LIFETIME: Final = 20.0
"""An address that no gossip had for this long (four heartbeats) is given up."""
DISSEMINATION_INTERVAL: Final = 0.5
"""News of found peers are gathered this long for peers that hear no multicast; the first goes out at once."""
CANDIDATES_PER_SECOND: Final = 25.0
"""Announcements over all such addresses, beyond one for each: gossiped peers may be forged."""
UNICAST_HEARTBEATS_PER_SECOND: Final = 10.0
"""Heartbeats by unicast to peers without a link, over all of them: each takes 0.2 ms, and with as many forged
peers as are accepted each still gets one a minute."""
UNICAST_HEARTBEATS_AT_ONCE: Final = 8
"""Of these and of those to linked peers, some 0.1 ms each, in one run of the timer."""
EVICTIONS_PER_SECOND: Final = 10.0
"""When ``PEERS_MAX`` is reached: peers without a link that missed a heartbeat and are removed for new ones."""
BEACONS_PER_WAKE: Final = 64
"""Packets handled in one callback, 100 microseconds each, with pending data between them."""
BEACONS_PER_SOURCE: Final = 200
"""Packets a second from one address; a host with twenty agents that all start at once stays below."""
BEACONS_UNLINKED_PER_SECOND: Final = 200.0
"""Beacons a second of peers that we have no link with, over all addresses, which can be forged: 5 % of a core."""
BEACONS_UNLINKED_BURST: Final = 1000
"""Such beacons at once: a hundred peers that start together send 400 and answer each other."""
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
