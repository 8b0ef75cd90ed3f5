"""Limits and time-outs of ROS: the core, nodes, XML-RPC, TCPROS and message types.

Each has its reason beside it. Seconds and bytes, unless the name says otherwise.
"""

from __future__ import annotations

from typing import Final

from rmpa.core.sizes import KIB, MIB

# --- mesh -------------------------------------------------------------------------------------------------------
MESSAGE_MAX: Final = 256 * MIB
"""One ROS message with its length; the largest point clouds and images stay below this."""

# --- ROS --------------------------------------------------------------------------------------------------------
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
VERIFY_AT_ONCE: Final = 32
"""Nodes of the run before that are asked at the same time: a connection each, and who asks the core meanwhile comes
behind that many."""
VERIFY_PROMPT: Final = 0.25
"""A node that has not answered after this long does not count among these: who hangs delays nobody else."""
VERIFY_RETRY_FIRST: Final = 0.5
"""Before a node that did not answer is asked again."""
VERIFY_RETRY_MAX: Final = 10.0
"""Between two questions at the most."""
VERIFY_PATIENCE: Final = 600.0
"""A node that did not answer for this long is given up: one that a debugger stopped may be on again by then."""
VERIFY_LISTS: Final = 8
"""Nodes that are asked at the same time what they publish and subscribe to, once all have been asked who they are."""
VERIFY_COMPARED: Final = 3
"""Times that a node is asked so; one that registers something each time is busy, and tells everything itself."""
VERIFY_ANNOUNCE: Final = 3.0
"""What was taken up is told to subscribers when all have answered or hang, or after this long: to ask 500 nodes takes
a second, and what follows from each (connections to it, the aggregator's among them) would come between."""

# --- bridge -----------------------------------------------------------------------------------------------------
NODE_KILL_WAIT: Final = 3.0
"""Seconds that a node has to end after it was asked to; a node with much to put away takes a second or two."""
NODE_KILL_LOOK: Final = 0.2
"""Seconds between two looks whether it has ended."""
