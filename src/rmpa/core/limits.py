"""Limits and time-outs of names, identities, contracts and queues.

Each has its reason beside it. Seconds and bytes, unless the name says otherwise. In the ``limits.py`` of each room a
comment with ``[section]``, ``At it:`` and ``Told in:`` is a row of docs/reference/limits.md (``make reference``).
"""

from __future__ import annotations

from typing import Final

KIB: Final = 1024
MIB: Final = 1024 * KIB

INT32_MIN: Final = -(1 << 31)
INT32_MAX: Final = (1 << 31) - 1
UINT32_MAX: Final = (1 << 32) - 1

# Random id of one run of one agent: 128 bits, so that two runs never share one.
INSTANCE_ID_BYTES: Final = 16
# [Agent] Characters of a module's name
# At it: it is refused
# Told in: error at start
# Why: A host name's label is at most 63.
PEER_NAME_MAX: Final = 64
# [Agent] The domain (`domain`)
# At it: the settings are refused
# Told in: error at start
# Why: ROS 2's own bound, so that the same ROS_DOMAIN_ID works for both.
DOMAIN_MAX: Final = 232

# [Messages] Messages in `depth` of a `[[contract]]`
# At it: the settings are refused
# Told in: error at start, `reload`
# Why: 100 s of a 1 kHz topic. ``LANE_QUEUE_BYTES`` bounds their bytes.
CONTRACT_DEPTH_MAX: Final = 100_000
# Shortest deadline, lifespan and lease: a timer that is due more often would delay the messages it watches.
CONTRACT_TIME_MIN: Final = 0.001
# Longest deadline, lifespan and lease, a day: more is a mistake in the unit.
CONTRACT_TIME_MAX: Final = 86_400.0
# Lowest ``max_rate`` in messages a second: one in a quarter of an hour.
CONTRACT_RATE_MIN: Final = 0.001
# Highest ``max_rate`` in messages a second: more than any topic reaches.
CONTRACT_RATE_MAX: Final = 1_000_000.0
# [Messages] Time in `outage` of a `[[contract]]`, at least
# At it: the settings are refused
# Told in: error at start, `reload`
# Why: A link that fell silent is noticed no sooner.
OUTAGE_MIN: Final = 1.0
# [Messages] Time in `outage` of a `[[contract]]`, at most
# At it: the settings are refused
# Told in: error at start, `reload`
# Why: As the other times of a contract.
OUTAGE_MAX: Final = 86_400.0

# A peer without a link is gone when it was silent for three heartbeats and a second.
PEER_LEASE: Final = 16.0
# [Graph] Peers that are known
# At it: silent ones are forgotten
# Told in: log
# Why: A hostile sender of forged GUIDs cannot fill the memory (2 KB each).
PEERS_MAX: Final = 4096

# Bytes of one message that are sent before another message of its lane: 10 ms of a 100 Mbit/s link. Longer messages
# are sent in several data frames.
FRAGMENT_BYTES: Final = 128 * KIB
# Waiting bytes that are committed for one write: nothing overtakes them, and they are not dropped.
COMMIT_BYTES: Final = 64 * KIB
# Seconds without a byte that the socket takes, after which it has stood still: the age of what waits begins anew.
# Shorter than the age at which messages are dropped; longer than the pauses of a socket at 2 Mbit/s.
STANDSTILL: Final = 0.3
# [Messages] Messages of one topic that wait for a slow link (`depth` of `[[contract]]`)
# At it: the oldest is dropped
# Told in: `topic info`, `why` (*sent*), diagnostics
ROUTE_QUEUE_MESSAGES: Final = 1000
# Messages with more bytes than this are forwarded while they are still being received.
CUT_THROUGH_BYTES: Final = 96 * KIB
# [Messages] Time for which a reliable topic's messages are kept without a link (`outage` of `[[contract]]`); until
#   then `rmpa topic info` shows `away`
# At it: all are given up: `loss_unknown`
# Told in: at both ends: `topic info` (*lost*), `why` (*sent*, *contract*), diagnostics, log
# Why: A robot drives through a shadow, an access point restarts. Longer is left to contracts: a module that is off
#   seems to publish for as long, and afterwards its subscribers get all of the old messages. Latched topics of a peer
#   that fell silent stay as long.
RESUME_WINDOW: Final = 30.0

# [Agent] Lines about one kind of refusal in 5 s
# At it: further ones are counted in the next
# Told in: log
# Why: Over all addresses, because source addresses can be forged.
LOG_LINES_MAX: Final = 20
# Kinds of refusal remembered to bound the log; the oldest is forgotten first.
LOG_KINDS_MAX: Final = 1024
