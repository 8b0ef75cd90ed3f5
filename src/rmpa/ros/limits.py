"""Limits and time-outs of cores, nodes, XML-RPC, TCPROS and message types, in seconds and bytes."""

from __future__ import annotations

from typing import Final

from rmpa.core.limits import KIB, MIB

MESSAGE_MAX: Final = 256 * MIB
"""One ROS message with its length; the largest point clouds and images stay below this."""

# --- TCPROS and services ------------------------------------------------------------------------------------------
TCPROS_HEADER_MAX: Final = 4 * MIB
"""A connection header: the longest message definitions are some 100 KB; roscpp would accept 1 GB."""
TCPROS_MESSAGE_MAX: Final = MESSAGE_MAX - 4
"""One message without its 4-byte length."""
TCPROS_LENGTH_MAX: Final = 1_000_000_000
"""Above it, as in roscpp, the stream is out of step and closed; a message between both limits is read and dropped."""
TCPROS_HANDSHAKE_TIMEOUT: Final = 10.0
"""Time within which the other side's header must arrive; rospy and roscpp wait without a limit."""
TCPROS_CONNECT_TIMEOUT: Final = 3.0
"""Time-out of a TCP connect to a node."""
TCPROS_CONNECTIONS_MAX: Final = 1024
"""Accepted connections of one node: its subscribers, with room for those that reconnect."""
TCPROS_HANDSHAKES_MAX: Final = 128
"""Accepted connections without a header yet (port scanners, stuck nodes)."""
TCPROS_BACKLOG: Final = 128
"""Length of the listen queue: all subscribers of a restarted node connect at once."""
TCPROS_RETRY_FIRST: Final = 0.1
"""Pause before the second attempt to reach a publisher; roscpp's own value."""
TCPROS_RETRY_MAX: Final = 2.0
"""The longest pause between attempts, while the graph lists the publisher."""
SHARED_BACKLOG: Final = 4096
"""Listen queue of all proxies' one socket: all subscribers of a restarted agent connect at once."""
SHARED_PROBE_TIMEOUT: Final = 1.0
"""Time-out of the test whether addresses of 127/8 other than 127.0.0.1 work here; if so, it takes a millisecond."""
LOOPBACK_REST: Final = 60.0
"""Time before a freed loopback address is used again: three times the 20 s for which roscpp dials an old one."""
LOOPBACK_RESTING_MAX: Final = 16_384
"""Freed addresses that are held back: room for all nodes of some large modules that start and end in that minute."""
TCP_KEEPALIVE_IDLE: Final = 60
"""Seconds of silence before the first keepalive probe; this and the next two are roscpp's values."""
TCP_KEEPALIVE_INTERVAL: Final = 10
"""Seconds between probes."""
TCP_KEEPALIVE_COUNT: Final = 9
"""Unanswered probes before the connection is dead."""
SERVICE_MESSAGE_MAX: Final = 64 * MIB
"""One request or response of a service, which is held in memory: maps and point clouds reach some 10 MB."""
SERVICE_OPEN_TIMEOUT: Final = 5.0
"""Time-out of the connection to a service's server and the exchange of headers together."""
SERVICE_STALL: Final = 30.0
"""Time within which the next bytes of a service request (of a single call also the first) must arrive."""
SUBSCRIBER_QUEUE_MESSAGES: Final = 1000
"""Messages queued for one slow local subscriber; above it the oldest is dropped."""
LATCHED_MAX: Final = 100
"""Messages of one source kept for late subscribers (durability transient_local), whatever the contract's depth."""
SUBSCRIBER_QUEUE_BYTES: Final = 32 * MIB
"""Bytes queued for one slow local subscriber; one message always fits."""

# --- message types ------------------------------------------------------------------------------------------------
DEFINITION_MAX: Final = 1 * MIB
"""Characters of a message definition with all that it embeds; the longest known are some 100 KB."""
DEFINITION_FIELDS_MAX: Final = 4096
"""Fields and constants of one message type."""
DEFINITION_DEPTH_MAX: Final = 32
"""Types within types; ROS's own go five deep."""
RECEIVED_TYPES_MAX: Final = 256
"""Message types from publishers' headers in the cache of a process; the least recently used is dropped."""
PACKAGE_DEPTH_MAX: Final = 32
"""Folders within folders below an entry of ROS_PACKAGE_PATH that are searched for packages; usual are four."""
PACKAGE_FOLDERS_MAX: Final = 20_000
"""Folders searched below one entry, nearer ones first, in up to 3 s; a workspace has a thousand, which take 40 ms."""
PACKAGE_ENTRIES_MAX: Final = 200_000
"""Directory entries of all searched folders together: a folder of recordings must not take minutes."""
PACKAGE_FILE_MAX: Final = 256 * KIB
"""A package.xml; usual ones have 2 KB."""
TYPES_FOUND_MAX: Final = 256
"""Types found on this machine in the cache of a process; the least recently used is dropped."""
TYPE_MISSING: Final = 10.0
"""Time before an unknown type is searched for again: each message asks for it, and a search takes some 50 ms."""
TYPES_MISSING_MAX: Final = 64
"""Unknown types in the cache of a process; the oldest is dropped."""
SEARCHED_SHOWN: Final = 4
"""Entries of one environment variable that an error shows."""
FETCH_TYPE_PUBLISHERS: Final = 8
"""Publishers of a type that are asked for its definition, one after the other."""
FETCH_TYPE_TIMEOUT: Final = 3.0
"""Time-out for the header of one such publisher; a peer's publisher answers when its route is open."""
TYPE_LOOK: Final = 1.0
"""Time between two checks of a resource whether a publisher of a type that it needs has appeared."""
# --- values of messages (`ros.types.codec`) ---
CODECS_MAX: Final = 512
"""Compiled types in the cache of the process; a module has some 50 types. The least recently used is dropped."""
TYPE_VALUES_MAX: Final = 100_000
"""Values that a message without elements in its arrays of any length has; a covariance has 36, a type rarely 200."""
TYPE_SIZE_MAX: Final = 16 * MIB
"""Bytes of the smallest message of a type: it has fixed arrays of this size together."""
WRITTEN_MAX: Final = 64 * MIB
"""Bytes of a message that is written from values."""
VALUES_PER_BYTE: Final = 16
"""Values read for each byte of a message: messages within arrays that have no bytes could be any number."""
VALUES_FREE: Final = 10_000
"""Values that any message may have beyond that."""
INLINE_MAX: Final = 64
"""Numbers of an embedded message that are read in one step with those around it."""
MISSING_NAMED: Final = 8
"""Fields that were not given and are named to the client."""
SHOWN: Final = 60
"""Characters of a wrong value in an error."""

# --- nodes of this process ----------------------------------------------------------------------------------------
NODE_MASTER_CHECK: Final = 0.5
"""Time between a node's checks whether its master knows it: a restarted core has the node back within a second."""
NODE_UNREGISTER_TIMEOUT: Final = 3.0
"""Time in which an ending node unregisters everything; a master that hangs must not delay it longer."""
NODE_UNREGISTER_AT_ONCE: Final = 16
"""Concurrent calls to unregister, each on a connection of its own."""
RECEIVED_QUEUE: Final = 1000
"""Messages queued for an ``async for``; above it the oldest is dropped."""

# --- XML-RPC over HTTP --------------------------------------------------------------------------------------------
HTTP_BODY_MAX: Final = 64 * MIB
"""One XML-RPC call or response: maps reach 10 MB; roslaunch sets all parameters of a file in one call."""
HTTP_BODIES_MAX: Final = 256 * MIB
"""All large calls of one server together: four of the largest."""
HTTP_DISCARDED_MAX: Final = 1024 * MIB
"""A call that is too large is read to its end, for its client sends all before it reads; above this it is cut."""
HTTP_PACE_MIN: Final = 64 * KIB
"""Bytes a second: the connection of a slower call is closed where room is short; loopback carries 1 GB/s."""
HTTP_SLOW_AFTER: Final = 1.0
"""Time before the pace of a call is judged."""
HTTP_BODY_INLINE: Final = 64 * KIB
"""Longer bodies are read and written over several turns of the event loop: 8 MiB of numbers take seconds."""
XMLRPC_SLICE: Final = 2 * KIB
"""Bytes of XML parsed at once, some 100 microseconds; then pending data is served."""
HTTP_ACCEPTS: Final = 4
"""Connections accepted in one turn of the event loop, 40 microseconds each."""
HTTP_HEADERS_MAX: Final = 64 * KIB
"""All headers of one request."""
HTTP_BACKLOG: Final = 1024
"""Length of the listen queue: all nodes of a robot register at once, and a refused SYN is repeated after 1 s."""
HTTP_CONNECTIONS_MAX: Final = 512
"""Open connections to one XML-RPC server; beyond it ``ros.http.server`` chooses one to close for a new one."""
HTTP_IDLE_TIMEOUT: Final = 60.0
"""Time after which a kept-alive connection without a call is closed; rospy and roscpp reconnect by themselves."""
HTTP_REQUEST_TIMEOUT: Final = 10.0
"""Time from a request's first byte to its last."""
XMLRPC_DEPTH_MAX: Final = 256
"""Nested XML elements: some eighty arrays in arrays, more than any real parameter."""
XMLRPC_ELEMENTS_MAX: Final = 4_000_000
"""XML elements in one body, two for each number; each takes some hundred bytes of memory."""
PARAM_DEPTH_MAX: Final = 64
"""Nested namespaces in one parameter's name; more is an attack on the recursion."""
SLAVE_CALL_TIMEOUT: Final = 3.0
"""Time-out of one XML-RPC call to a node; a stopped node must not hold the others up."""

# --- a roscore in place of the embedded core ----------------------------------------------------------------------
MASTER_OTHER_AGENT: Final = 10.0
"""Time for which another agent at the same roscore is told after its last registration was seen."""
MASTER_LOOK_FIRST: Final = 0.1
"""Time between two polls of a roscore whose graph has just changed; a poll of 50 nodes costs it some milliseconds."""
MASTER_LOOK_IDLE: Final = 0.5
"""Time between two polls while nothing changes."""
MASTER_LOOK_MAX: Final = 0.8
"""The longest pause between two polls, so that a change is seen within a second."""
MASTER_LOOK_SHARE: Final = 20
"""The pause is at least this many times the duration of the poll: polls take at most a twentieth of its time."""
MASTER_LOOK_SOON: Final = 0.02
"""Delay of a poll out of turn, after a node is suspected to be dead or moved: one change is seldom alone."""
MASTER_RETRY: Final = 0.5
"""Time between two polls of a roscore that does not answer: a restarted one has our registrations within a second."""
MASTER_TIMEOUT: Final = 3.0
"""Time-out of one poll of or write to a roscore; one on a busy board answered in 0.3 s."""
MASTER_ASK_TIMEOUT: Final = 10.0
"""Time-out for calls of a roscore with parameters, which may be megabytes."""
MASTER_WRITES_AT_ONCE: Final = 64
"""Registrations in one call to a roscore, some 10 ms of its work."""
MASTER_WRITES_MAX: Final = 20_000
"""Registrations queued for a roscore; above it the queue is dropped, and the next poll finds what is missing."""
MASTER_FAREWELL: Final = 2.0
"""Time in which an ending agent unregisters at a roscore."""

# --- cores --------------------------------------------------------------------------------------------------------
NODE_CHECK_INTERVAL: Final = 5.0
"""Period in which each registered node is checked: whether it still listens."""
NODE_RECHECK_DELAY: Final = 0.2
"""Time between the two refused connects that prove a node dead: it may be restarting its server."""
NODE_UNREACHABLE_AFTER: Final = 15.0
"""Seconds for which connects to a node fail until peers are no longer offered it: a cable is put back sooner."""
NODE_UNREACHABLE_CHECKS: Final = 4
"""Concurrent attempts to reach unreachable nodes: each may hold a thread of the resolver for seconds."""
NOTIFY_QUEUE_MAX: Final = 4096
"""Updates of topics and parameters queued for one slow node; for each topic only the latest is queued."""
NOTIFY_COALESCE: Final = 64
"""With this many updates queued for a node, only the latest of each parameter is kept; with fewer all of them."""
NOTIFY_RETRY_FIRST: Final = 0.2
"""Pause before an update is sent again to a node that did not answer."""
NOTIFY_RETRY_MAX: Final = 3.0
"""The longest pause between attempts, while the node is registered."""
WITHDRAWN_LATELY: Final = 5.0
"""Seconds within which a publisher that was withdrawn and is registered again, with the same URI, has its topic's
list of publishers repeated: a busy subscriber may not have read yet that its old connection ended."""
PUBLISHERS_AGAIN: Final = 2.0
"""Seconds from its return until the list is repeated, with those of the topics that return meanwhile."""
WITHDRAWN_KEPT: Final = 16_384
"""Withdrawn publishers that are remembered; the oldest is forgotten first."""
ROSOUT_QUEUE: Final = 1000
"""Log messages queued for a slow reader of /rosout_agg."""
ROSOUT_RESPAWN: Final = 0.5
"""Seconds from the end of /rosout (`rosnode kill`) to its next start; roscore takes about as long."""
ROSOUT_LOOK: Final = 1.0
"""Seconds between two checks whether the name /rosout is free again, and between attempts to start."""
CORE_STATE_BYTES: Final = 64 * MIB
"""A core's state file: a robot's parameters with its description are some MB."""
CORE_STATE_NAME_MAX: Final = 4096
"""Characters of a name that is read from a state file: rosmaster has no limit, and the longest seen have 200."""
CORE_STATE_DEPTH_MAX: Final = PARAM_DEPTH_MAX + XMLRPC_DEPTH_MAX // 3
"""Namespaces, structs and arrays within each other in a state file: as many as ``setParam`` can make."""
CORE_STATE_GATHER: Final = 0.3
"""Changes are gathered this long before they are written: a starting node registers a dozen things."""
CORE_STATE_SHARE: Final = 20
"""After a write, a pause of this many times its processor time: a large state is written less often."""
CORE_STATE_REST: Final = 10.0
"""The longest such pause."""
CORE_STATE_RETRY: Final = 5.0
"""Pause before a failed write is tried again: the disk is full, or not mounted yet."""
CORE_STATE_OPEN: Final = 3.0
"""Time-out for reading the state file at the start; a disk that hangs must not delay the core longer."""
CORE_STATE_WRITE: Final = 10.0
"""A write that takes longer is reported: the disk does not answer. The first one may be 64 MiB on a slow card."""
CORE_STATE_CLOSE: Final = 3.0
"""Time-out of the last write of an ending core, whose disk may hang."""
CORE_STATE_ASK: Final = 1.0
"""The nodes of the run before are asked for this long before the core listens."""
NODE_KILL_WAIT: Final = 3.0
"""Seconds for a node to end after it was asked to; one with much to save takes a second or two."""
NODE_KILL_LOOK: Final = 0.2
"""Seconds between two checks whether a node that was asked to end has ended."""
NODE_CONNECTIONS_SHOWN: Final = 500
"""Connections of one node that are told: some 80 kB in one answer, and more than can be read."""
