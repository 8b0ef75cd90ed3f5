"""Limits and time-outs of cores, nodes, XML-RPC, TCPROS and message types, in seconds and bytes."""

from __future__ import annotations

from typing import Final

from rmpa.core.limits import KIB, MIB

# One ROS message with its length; the largest point clouds and images stay below this.
MESSAGE_MAX: Final = 256 * MIB

# --- TCPROS and services ------------------------------------------------------------------------------------------
# A connection header: the longest message definitions are some 100 KB; roscpp would accept 1 GB.
TCPROS_HEADER_MAX: Final = 4 * MIB
# One message without its 4-byte length.
TCPROS_MESSAGE_MAX: Final = MESSAGE_MAX - 4
# Above it, as in roscpp, the stream is out of step and closed; a message between both limits is read and dropped.
TCPROS_LENGTH_MAX: Final = 1_000_000_000
# Time within which the other side's header must arrive; rospy and roscpp wait without a limit.
TCPROS_HANDSHAKE_TIMEOUT: Final = 10.0
# Time-out of a TCP connect to a node.
TCPROS_CONNECT_TIMEOUT: Final = 3.0
# Accepted connections of one node: its subscribers, with room for those that reconnect.
TCPROS_CONNECTIONS_MAX: Final = 1024
# Accepted connections without a header yet (port scanners, stuck nodes).
TCPROS_HANDSHAKES_MAX: Final = 128
# Freed addresses that are held back: room for all nodes of some large modules that start and end in that minute.
LOOPBACK_RESTING_MAX: Final = 16_384
# One request or response of a service, which is held in memory: maps and point clouds reach some 10 MB.
SERVICE_MESSAGE_MAX: Final = 64 * MIB
# Time-out of the connection to a service's server and the exchange of headers together.
SERVICE_OPEN_TIMEOUT: Final = 5.0
# Messages queued for one slow local subscriber; above it the oldest is dropped.
SUBSCRIBER_QUEUE_MESSAGES: Final = 1000
# Messages of one source kept for late subscribers (durability transient_local), whatever the contract's depth.
LATCHED_MAX: Final = 100
# Bytes queued for one slow local subscriber; one message always fits.
SUBSCRIBER_QUEUE_BYTES: Final = 32 * MIB

# --- message types ------------------------------------------------------------------------------------------------
# Characters of a message definition with all that it embeds; the longest known are some 100 KB.
DEFINITION_MAX: Final = 1 * MIB
# Fields and constants of one message type.
DEFINITION_FIELDS_MAX: Final = 4096
# Types within types; ROS's own go five deep.
DEFINITION_DEPTH_MAX: Final = 32
# Folders within folders below an entry of ROS_PACKAGE_PATH that are searched for packages; usual are four.
PACKAGE_DEPTH_MAX: Final = 32
# Folders searched below one entry, nearer ones first, in up to 3 s; a workspace has a thousand, which take 40 ms.
PACKAGE_FOLDERS_MAX: Final = 20_000
# Directory entries of all searched folders together: a folder of recordings must not take minutes.
PACKAGE_ENTRIES_MAX: Final = 200_000
# Types found on this machine in the cache of a process; the least recently used is dropped.
TYPES_FOUND_MAX: Final = 256
# Unknown types in the cache of a process; the oldest is dropped.
TYPES_MISSING_MAX: Final = 64
# Publishers of a type that are asked for its definition, one after the other.
FETCH_TYPE_PUBLISHERS: Final = 8
# --- values of messages (`ros.types.codec`) ---
# Characters of a wrong value in an error.
SHOWN: Final = 60

# --- XML-RPC over HTTP --------------------------------------------------------------------------------------------
# One XML-RPC call or response: maps reach 10 MB; roslaunch sets all parameters of a file in one call.
HTTP_BODY_MAX: Final = 64 * MIB
# All large calls of one server together: four of the largest.
HTTP_BODIES_MAX: Final = 256 * MIB
# A call that is too large is read to its end, for its client sends all before it reads; above this it is cut.
HTTP_DISCARDED_MAX: Final = 1024 * MIB
# Longer bodies are read and written over several turns of the event loop: 8 MiB of numbers take seconds.
HTTP_BODY_INLINE: Final = 64 * KIB
# Open connections to one XML-RPC server; beyond it ``ros.http.server`` chooses one to close for a new one.
HTTP_CONNECTIONS_MAX: Final = 512
# Time after which a kept-alive connection without a call is closed; rospy and roscpp reconnect by themselves.
HTTP_IDLE_TIMEOUT: Final = 60.0
# Time from a request's first byte to its last.
HTTP_REQUEST_TIMEOUT: Final = 10.0
# Nested XML elements: some eighty arrays in arrays, more than any real parameter.
XMLRPC_DEPTH_MAX: Final = 256
# XML elements in one body, two for each number; each takes some hundred bytes of memory.
XMLRPC_ELEMENTS_MAX: Final = 4_000_000
# Nested namespaces in one parameter's name; more is an attack on the recursion.
PARAM_DEPTH_MAX: Final = 64
# Time-out of one XML-RPC call to a node; a stopped node must not hold the others up.
SLAVE_CALL_TIMEOUT: Final = 3.0

# --- cores --------------------------------------------------------------------------------------------------------
# Period in which each registered node is checked: whether it still listens.
NODE_CHECK_INTERVAL: Final = 5.0
# Seconds for which connects to a node fail until peers are no longer offered it: a cable is put back sooner.
NODE_UNREACHABLE_AFTER: Final = 15.0
# Updates of topics and parameters queued for one slow node; for each topic only the latest is queued.
NOTIFY_QUEUE_MAX: Final = 4096
# Seconds from the end of /rosout (`rosnode kill`) to its next start; roscore takes about as long.
ROSOUT_RESPAWN: Final = 0.5
# A core's state file: a robot's parameters with its description are some MB.
CORE_STATE_BYTES: Final = 64 * MIB
# Namespaces, structs and arrays within each other in a state file: as many as ``setParam`` can make.
CORE_STATE_DEPTH_MAX: Final = PARAM_DEPTH_MAX + XMLRPC_DEPTH_MAX // 3
# Time-out for reading the state file at the start; a disk that hangs must not delay the core longer.
CORE_STATE_OPEN: Final = 3.0
# A write that takes longer is reported: the disk does not answer. The first one may be 64 MiB on a slow card.
CORE_STATE_WRITE: Final = 10.0
# Time-out of the last write of an ending core, whose disk may hang.
CORE_STATE_CLOSE: Final = 3.0
# The nodes of the run before are asked for this long before the core listens.
CORE_STATE_ASK: Final = 1.0
# Seconds for a node to end after it was asked to; one with much to save takes a second or two.
NODE_KILL_WAIT: Final = 3.0
