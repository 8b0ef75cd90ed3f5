"""Limits and time-outs of settings: their defaults and the values that they may have.

Each has its reason beside it. Seconds and bytes, unless the name says otherwise.
"""

from __future__ import annotations

from typing import Final

from rmpa.core.limits import KIB

# [Agent] Bytes of a settings file
# At it: it is refused
# Told in: error at start
# Why: A usual one has some 4 KB, and finding a line in a huge one takes long.
CONFIG_FILE_MAX: Final = 256 * KIB
# Peers whose result of the naming rules is cached: as many as a large network has.
NAMES_REMEMBERED: Final = 256
# [Agent] Rules for names in one direction of a `[[peer]]`
# At it: the settings are refused
# Told in: error at start, `reload`
# Why: Each is compared with each other one.
REMAPS_MAX: Final = 256
# [Agent] Tables `[[param]]`, whatever `limits.params` is
# At it: the settings are refused
# Told in: error at start, `reload`
# Why: Each is compared with each other one.
FOLLOW_RULES_MAX: Final = 2048
# [Agent] Tables `[[permission]]`
# At it: the settings are refused
# Told in: error at start, `reload`
# Why: Each decision compares a name with all that are about one module.
PERMISSION_RULES_MAX: Final = 4096
# [Agent] Groups in `[trust.groups]`
# At it: the settings are refused
# Told in: error at start, `reload`
# Why: As many as a large network has modules.
GROUPS_MAX: Final = 256
# [Agent] Tables `[[gateway.rule]]`
# At it: the settings are refused
# Told in: error at start, `reload`
# Why: Each source is compared with them in order.
GATEWAY_RULES_MAX: Final = 1024
# [Agent] The rank of a gateway
# At it: the settings are refused
# Told in: error at start
# Why: It has three digits in its liveliness token.
GATEWAY_RANK_MAX: Final = 999
# [Agent] Characters of a site's name
# At it: the settings are refused
# Told in: error at start
# Why: As for a module's name and for a label of DNS.
SITE_NAME_MAX: Final = 63
# Highest ``size`` of a ``[[gateway.rule]]`` in bytes a second: more than any network carries.
GATEWAY_BYTES_MAX: Final = 100_000_000_000
# Highest value of a setting in ``[limits]``: such a graph takes some gigabytes.
BOUND_MAX: Final = 1_000_000

# Administratively scoped (RFC 2365), so routers keep it on site; 82.77 is "RM".
MULTICAST_GROUP: Final = "239.255.82.77"
# The discovery port of domain 0; domain n uses this port plus n.
MULTICAST_PORT: Final = 11411

# [Services] Time for a call (`services.timeout`, `[[service]]`)
# At it: the call fails
# Told in: the caller's error, `service info`
# Why: Planners take tens of seconds; rospy and roscpp wait for ever.
SERVICE_TIMEOUT: Final = 60.0

# [Graph] Nodes of one peer in the local graph (`limits.nodes`)
# At it: further ones stay hidden, with their topics and services
# Told in: `peer info`, `peer list`, `why` (*limit*), diagnostics, log
# Why: Each takes some 15 KB; large robots have some hundred, fleets behind a relay a few thousand.
NODES_PER_PEER_MAX: Final = 4096
# [Graph] Topics of one peer, once for each publisher; topics that this module offers, or one peer has open
#   (`limits.topics`)
# At it: further ones stay hidden; do not cross
# Told in: `peer info`, `peer list`, `why` (*limit*, *offer*), diagnostics, log
# Why: Each takes some 5 KB.
TOPICS_PER_PEER_MAX: Final = 32_768
# [Graph] Services of one peer, that this module offers, or one peer has open (`limits.services`)
# At it: further ones stay hidden; do not cross
# Told in: `peer info`, `peer list`, `why` (*limit*, *offer*), diagnostics, log
# Why: A large robot's nodes have some 500, loggers left out.
SERVICES_PER_PEER_MAX: Final = 16_384
# [Graph] Parameters that this module follows, and that one peer may follow here (`limits.params`)
# At it: the settings are refused; so are a peer's further ones
# Told in: error at start; the peer's `peer list`, diagnostics, log
# Why: A namespace counts as one.
FOLLOWED_MAX: Final = 256
# [Services] Time for a call that settings may give
# At it: the settings are refused
# Told in: error at start
# Why: The caller of a server that hangs gets an error within the hour.
SERVICE_TIMEOUT_MAX: Final = 3600.0
# [Graph] Characters of a topic's, node's, service's or type's name
# At it: it does not cross
# Told in: `why` (*offer*)
# Why: The longest seen have some 200.
CROSSING_NAME_MAX: Final = 1024
