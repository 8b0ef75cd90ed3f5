"""Limits and time-outs of cores, nodes, XML-RPC, TCPROS and message types, in seconds and bytes."""

from __future__ import annotations

from typing import Final

from rmpa.core.limits import KIB, MIB

# [Messages] Bytes of one message, its length included
# At it: it is left out, the topic's others cross
# Told in: at both ends: log, `topic info` (*too long*), `why` (*sent*), diagnostics, counters
# Why: The largest point clouds and images stay below this.
MESSAGE_MAX: Final = 256 * MIB

# [Messages] Bytes of a connection header (TCPROS)
# At it: the connection is refused
# Told in: log, counters
# Why: The longest message definitions are some 100 KB; roscpp would accept 1 GB.
TCPROS_HEADER_MAX: Final = 4 * MIB
# One message without its 4-byte length.
TCPROS_MESSAGE_MAX: Final = MESSAGE_MAX - 4
# [Messages] The length that a local publisher gives for a message
# At it: the stream is corrupt: the connection is made anew
# Told in: log, counters, `why` (*route*)
# Why: As in roscpp; a message between both limits is read and dropped.
TCPROS_LENGTH_MAX: Final = 1_000_000_000
# [Messages] Time for the other side's header
# At it: the connection is closed
# Told in: log, `why` (*route*)
# Why: rospy and roscpp wait without a limit.
TCPROS_HANDSHAKE_TIMEOUT: Final = 10.0
# [Messages] Time for each answer of a local publisher: its port, a connection, its header; for a service's server too
# At it: it is tried again
# Told in: `topic info`, `why` (*route*), log
# Why: As in rospy. A node without processor time is slow, not dead: another attempt would wait behind the first.
TCPROS_CONNECT_TIMEOUT: Final = 60.0
# [Messages] Subscribers connected to one proxy
# At it: further ones are refused, and try again
# Told in: log, counters
# Why: With room for those that reconnect.
TCPROS_CONNECTIONS_MAX: Final = 1024
# [Messages] Of these, without a header yet
# At it: further ones are refused, and try again
# Told in: log, counters
# Why: Port scanners, stuck nodes.
TCPROS_HANDSHAKES_MAX: Final = 128
# Freed addresses that are held back: room for all nodes of some large modules that start and end in that minute.
LOOPBACK_RESTING_MAX: Final = 16_384
# [Services] Bytes of one request or response
# At it: the call fails
# Told in: the caller's error, log
# Why: It is held in memory: maps and point clouds reach some 10 MB.
SERVICE_MESSAGE_MAX: Final = 64 * MIB
# Time-out of a question for a service's type: the connection to its server and the headers together.
SERVICE_OPEN_TIMEOUT: Final = 5.0
# [Messages] Messages that wait for one slow local subscriber (`depth` of `[[contract]]`)
# At it: the oldest is dropped
# Told in: `topic info`, `why` (*reader*)
SUBSCRIBER_QUEUE_MESSAGES: Final = 1000
# [Messages] Bytes that wait for it
# At it: the oldest is dropped
# Told in: `topic info`, `why` (*reader*)
SUBSCRIBER_QUEUE_BYTES: Final = 32 * MIB
# Seconds for which a local subscriber whose publisher has ended gets what waits for it, as from a node
# that ends, whose kernel sends on.
SUBSCRIBER_DRAIN: Final = 10.0
# [Messages] Latched messages of one source that are kept
# At it: the newest are kept
# Why: For late subscribers (durability transient_local), whatever the contract's depth.
LATCHED_MAX: Final = 100

# [Messages] Characters of a message definition
# At it: its type is not learnt; its bytes cross all the same
# Told in: the command's error
# Why: With all that it embeds; the longest known are some 100 KB.
DEFINITION_MAX: Final = 1 * MIB
# [Messages] Fields and constants of a message type
# At it: it is not learnt
# Told in: the command's error
DEFINITION_FIELDS_MAX: Final = 4096
# [Messages] Types within types
# At it: it is not learnt
# Told in: the command's error
# Why: ROS's own go five deep.
DEFINITION_DEPTH_MAX: Final = 32
# [Agent] Folders within folders below an entry of ROS_PACKAGE_PATH that are searched for types
# At it: deeper ones are not searched
# Told in: the command's error
# Why: Usual are four.
PACKAGE_DEPTH_MAX: Final = 32
# [Agent] Folders that are searched there
# At it: the nearest ones are searched
# Told in: the command's error
# Why: In up to 3 s; a workspace has a thousand, which take 40 ms.
PACKAGE_FOLDERS_MAX: Final = 20_000
# [Agent] Files and folders in these
# At it: the rest is not searched
# Told in: the command's error
# Why: A folder of recordings must not take minutes.
PACKAGE_ENTRIES_MAX: Final = 200_000
# Types found on this machine in the cache of a process; the least recently used is dropped.
TYPES_FOUND_MAX: Final = 256
# Unknown types in the cache of a process; the oldest is dropped.
TYPES_MISSING_MAX: Final = 64
# [Agent] Publishers that are asked for a type
# At it: others are not asked
# Told in: the command's error
# Why: One after the other.
FETCH_TYPE_PUBLISHERS: Final = 8
# Characters of a wrong value in an error.
SHOWN: Final = 60

# [Core] Bytes of one call to the core as XML: a parameter, or all those of a launch file
# At it: a fault that names the call, its size and what to do
# Told in: the caller's error (not roscpp's), log, counters
# Why: Maps reach 10 MB; roslaunch sets all parameters of a file in one call.
HTTP_BODY_MAX: Final = 64 * MIB
# [Core] Bytes of large calls under way together
# At it: the slowest one, or the new one, gets a fault
# Told in: the caller's error (not roscpp's), log, counters
# Why: Four of the largest.
HTTP_BODIES_MAX: Final = 256 * MIB
# [Core] Bytes of a refused call that are read
# At it: it is cut off with HTTP 413
# Told in: log, counters
# Why: Its client sends all before it reads.
HTTP_DISCARDED_MAX: Final = 1024 * MIB
# Longer bodies are read and written over several turns of the event loop: 8 MiB of numbers take seconds.
HTTP_BODY_INLINE: Final = 64 * KIB
# [Core] Connections to the core, and to each proxy
# At it: a new one replaces a slow one, else the one idle for longest
# Told in: log, `http.evicted`
# Why: ``ros.http.server`` chooses it. rosmaster takes any number; clients that reconnect whenever they have given way
#   would keep all others out, so there is room for thousands, of 5 KB each.
HTTP_CONNECTIONS_MAX: Final = 4096
# Time after which a kept-alive connection without a call is closed; rospy and roscpp reconnect by themselves.
HTTP_IDLE_TIMEOUT: Final = 60.0
# [Core] Time for a call to arrive
# At it: its connection is closed
# Told in: log, counters
HTTP_REQUEST_TIMEOUT: Final = 10.0
# [Core] XML elements within each other in one call
# At it: a fault
# Told in: the caller's error, log
# Why: Some eighty arrays in arrays, more than any real parameter.
XMLRPC_DEPTH_MAX: Final = 256
# [Core] XML elements in one call; a number is two
# At it: a fault
# Told in: the caller's error, log
# Why: Each takes some hundred bytes of memory.
XMLRPC_ELEMENTS_MAX: Final = 4_000_000
# [Core] Namespaces within each other in a parameter
# At it: it is refused
# Told in: the caller's error
# Why: More is an attack on the recursion.
PARAM_DEPTH_MAX: Final = 64
# Time-out of one XML-RPC call to a node; a stopped node must not hold the others up.
SLAVE_CALL_TIMEOUT: Final = 3.0

# Period in which each registered node is checked: whether it still listens.
NODE_CHECK_INTERVAL: Final = 5.0
# [Core] Time for which a registered node may be unreachable
# At it: it is not offered to peers
# Told in: `why` (*reachable*), `topic info`, `node list`, `doctor`, diagnostics, log
# Why: A cable is put back sooner.
NODE_UNREACHABLE_AFTER: Final = 15.0
# [Core] Notifications (`publisherUpdate`, `paramUpdate`) that wait for one slow node
# At it: the oldest is dropped
# Told in: `notify.dropped`
# Why: For each topic only the latest is queued.
NOTIFY_QUEUE_MAX: Final = 4096
# [Core] Time before a `/rosout` that was ended is started anew
# At it: the core waits while another node has the name
# Told in: log
# Why: roscore takes about as long.
ROSOUT_RESPAWN: Final = 0.5
# [Core] Bytes of registrations and parameters that the core keeps over a restart
# At it: nothing newer is kept
# Told in: `peer list`, diagnostics, log
# Why: A robot's parameters with its description are some MB.
CORE_STATE_BYTES: Final = 64 * MIB
# Namespaces, structs and arrays within each other in a state file: as many as ``setParam`` can make.
CORE_STATE_DEPTH_MAX: Final = PARAM_DEPTH_MAX + XMLRPC_DEPTH_MAX // 3
# Time-out for reading the state file at the start; a disk that hangs must not delay the core longer.
CORE_STATE_OPEN: Final = 3.0
# A write that takes longer is reported: the disk does not answer. The first one may be 64 MiB on a slow card.
CORE_STATE_WRITE: Final = 10.0
# Time-out of the last write of an ending core, whose disk may hang.
CORE_STATE_CLOSE: Final = 3.0
# [Core] Time in which nodes of the last run are asked before the core listens
# At it: the core listens; a node that does not answer within some seconds must be restarted
# Told in: `doctor` (*core memory*), `peer list`, diagnostics, log
CORE_STATE_ASK: Final = 1.0
# [Core] Time for a peer's node to end
# At it: "is still there" is answered
# Told in: `node kill`, log
# Why: One with much to save takes a second or two.
NODE_KILL_WAIT: Final = 3.0
# [Resources] Characters of a descriptor
# At it: clients do not accept it
# Told in: their error
# Why: One with a hundred profiles of twenty attributes has about 100 KB.
DESCRIPTOR_MAX: Final = 1 * MIB
