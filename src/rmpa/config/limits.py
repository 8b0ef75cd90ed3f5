"""Limits and time-outs of settings: their defaults and the values that they may have.

Each has its reason beside it. Seconds and bytes, unless the name says otherwise.
"""

from __future__ import annotations

from typing import Final

from rmpa.core.limits import KIB

# --- settings ---------------------------------------------------------------------------------------------------
# Bytes of a settings file; a usual one has some 4 KB, and finding a line in a huge one takes long.
CONFIG_FILE_MAX: Final = 256 * KIB
# Peers whose result of the naming rules is cached: as many as a large network has.
NAMES_REMEMBERED: Final = 256
# Renaming rules in one direction of a ``[[peer]]``; each is compared with each other one.
REMAPS_MAX: Final = 256
# Default of ``limits.params``: parameters that one module follows, and that one peer may follow here; a namespace
# counts as one.
FOLLOWED_MAX: Final = 256
# Tables ``[[param]]`` in a file, whatever ``limits.params`` says: each is compared with each other one.
FOLLOW_RULES_MAX: Final = 2048
# Tables ``[[permission]]`` in a file; each decision compares a name with all that are about one module.
PERMISSION_RULES_MAX: Final = 4096
# Groups of modules in ``[trust.groups]``: as many as a large network has modules.
GROUPS_MAX: Final = 256
# Tables ``[[gateway.rule]]`` in a file; each source is compared with them in order.
GATEWAY_RULES_MAX: Final = 1024
# Highest rank of a gateway: it has three digits in its liveliness token.
GATEWAY_RANK_MAX: Final = 999
# Characters of a site's name, as for a module's name and for a label of DNS.
SITE_NAME_MAX: Final = 63
# Highest ``size`` of a ``[[gateway.rule]]`` in bytes a second: more than any network carries.
GATEWAY_BYTES_MAX: Final = 100_000_000_000
# Highest value of a setting in ``[limits]``: such a graph takes some gigabytes.
BOUND_MAX: Final = 1_000_000

# --- discovery --------------------------------------------------------------------------------------------------
# Administratively scoped (RFC 2365), so routers keep it on site; 82.77 is "RM".
MULTICAST_GROUP: Final = "239.255.82.77"
# The discovery port of domain 0; domain n uses this port plus n.
MULTICAST_PORT: Final = 11411

# --- ROS --------------------------------------------------------------------------------------------------------
# Default time-out of a call: planners take tens of seconds; rospy and roscpp wait for ever.
SERVICE_TIMEOUT: Final = 60.0

# --- bridge -----------------------------------------------------------------------------------------------------
# Default of ``limits.topics``: (topic, node) pairs of one peer that are known here, those that this module offers,
# and open routes of one peer. Each takes some 5 KB.
TOPICS_PER_PEER_MAX: Final = 32_768
# Default of ``limits.nodes``: nodes of one peer that get a proxy here. Each takes some 15 KB; large robots have some
# hundred, fleets behind a relay a few thousand.
NODES_PER_PEER_MAX: Final = 4096
# Default of ``limits.services``: services of one peer that are known here, those that this module offers, and those
# that one peer has open at once. A large robot's nodes have some 500, loggers left out.
SERVICES_PER_PEER_MAX: Final = 16_384
# Longest time-out of a call: the caller of a server that hangs gets an error within the hour.
SERVICE_TIMEOUT_MAX: Final = 3600.0
# Characters of a topic's, node's or type's name that crosses the mesh; the longest seen have some 200.
CROSSING_NAME_MAX: Final = 1024
