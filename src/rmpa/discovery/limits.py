"""Limits and time-outs of discovery.

Each has its reason beside it. Seconds and bytes, unless the name says otherwise.
"""

from __future__ import annotations

from typing import Final

# Multicast time-to-live: beacons stay in their own sub-network.
MULTICAST_TTL: Final = 1
# One beacon fits one packet on every link (IPv6 minimum MTU 1280 less headers).
BEACON_MAX_BYTES: Final = 1200
# Addresses that a beacon carries at most: a robot with more of them announces the first eight.
BEACON_ADDRESSES_MAX: Final = 8
# Peers that one beacon gossips about; if there are more, successive beacons carry them in turn.
BEACON_GOSSIP_MAX: Final = 64
# [Links] Modules of a mesh above which answers to beacons become rarer
# At it: they are delayed, and gathered
# Told in: `beacon.answer_spared`
# Why: Lest a start of many agents be a storm of packets. Up to here each announcement is answered at once, as in the
#   paper.
MANY_MEMBERS: Final = 64
# Seconds without a link, although its beacons arrive, after which a peer with another's address is shown as in
# conflict.
ADDRESS_SHARED_AFTER: Final = 5.0
# The shortest time between two unicast answers to one address.
ANSWER_INTERVAL: Final = 0.2
# Members from which on heartbeats by multicast do not wake this agent, as they come more often than once a second
# then, and the time that they may wait to be read.
HEARTBEATS_WAIT_MEMBERS: Final = 8
HEARTBEATS_WAIT: Final = 1.0
# A peer that was silent for this long (a heartbeat and two seconds) has missed one: of two instances it may be the
# dead one.
HEARTBEAT_LATE: Final = 7.0
# A peer not heard by multicast for this long (two heartbeats and two seconds) gets its heartbeats by unicast.
MULTICAST_SILENCE: Final = 12.0
# Unicast answers a second over all addresses: forged beacons must not turn an agent into an amplifier; a start of 100
# peers stays below this. In a large mesh it is also the number of answers a second that one newcomer gets: 1,000
# members answer within 2 s, each at a random time.
ANSWERS_PER_SECOND: Final = 500
# [Graph] Peers that are known and were never linked
# At it: further ones are ignored until some are linked or silent
# Told in: `roster.full`
# Why: They may be forged, and each of them costs a few microseconds wherever all peers are looked at. Peers of a
#   large mesh are linked once, and then count no more.
STRANGERS_MAX: Final = 1024
BEACONS_UNPROVED_BURST: Final = 1000
# [Graph] Modules of no mesh, or another one, that are shown
# At it: the list is full: further ones are not shown until one was silent for 30 s
# Told in: `peer list`, `doctor`
# Why: What they say of themselves may be invented.
STRANGERS_SHOWN: Final = 32
# [Links] Beacons a second from one address
# At it: further ones are not read
# Told in: log, `beacon.flood`
# Why: A host with twenty agents that all start at once stays below.
BEACONS_PER_SOURCE: Final = 200
# [Links] Beacons a second from peers that were never linked
# At it: further ones are not read; they come again
# Told in: `beacon.unlinked_limited`
# Why: Over all addresses, which can be forged: 5 % of a core.
BEACONS_UNLINKED_PER_SECOND: Final = 200.0
# Beacons of peers without a link accepted at once, which take 0.4 s: a thousand agents that start together announce
# themselves four times each. Data is handled between them.
BEACONS_UNLINKED_BURST: Final = 4096
# The kernel's buffer of each socket that receives beacons (SO_RCVBUF; net.core.rmem_max bounds it): 1,300 packets, so
# that the announcements of a thousand agents that start at once wait until they are read.
RECEIVE_BUFFER_BYTES: Final = 1 << 20
