"""Limits and time-outs of the bridge: catalogues, routes, services and parameters.

Each has its reason beside it. Times are in seconds and sizes in bytes, unless the text says otherwise.
"""

from __future__ import annotations

from typing import Final

from rmpa.core.limits import KIB, MIB

# Seconds that a topic's route stays open after its last local subscriber left: a reconnecting node finds it open.
ROUTE_LINGER: Final = 1.0
# [Messages] Time for which a topic whose publisher has ended goes on, until all that it has published has crossed
# At it: the rest is dropped and counted
# Told in: `topic info` (*lost*), diagnostics
# Why: 10 MB on a radio of 10 Mbit/s.
ROUTE_DRAIN: Final = 10.0
# Seconds for which a publisher that has unregistered, and whose connection stands, may go on to send.
ROUTE_END: Final = 1.0
# Entries that one advertisement of this module takes from the pending changes, which takes a millisecond; the rest
# follows in later turns of the event loop.
ADVERTISED_AT_ONCE: Final = 32
# Seconds until the next attempt to advertise, while the portions sent before still wait on the lane.
TELL_PAUSE: Final = 0.005
# Seconds after which a portion is sent although the lane is busy. On a lane that is never empty the graph still
# advances, at some 0.5 Mbit/s.
TELL_PATIENCE: Final = 0.05
# Bytes of one advertisement, which is parsed in one piece. This module's own take 100 KB with the longest names, and
# 3 KB with usual ones.
ADVERTISEMENT_MAX: Final = 1 * MIB
# Bytes of received advertisements, of all peers, that may wait to be parsed: some 40,000 topics. Beyond it the oldest
# are parsed at once.
ADVERTISED_WAITING_BYTES: Final = 4 * MIB
# Notifications of peers' subscriptions that may wait to be applied; beyond it the oldest are applied at once.
SUBSCRIPTIONS_WAITING: Final = 64
# Routes whose timers are due, and parameters of one request, that are handled in one turn of the event loop, which
# takes some 100 microseconds; then data goes first.
APPLIED_AT_ONCE: Final = 16
# Topics, and likewise services, of one peer beyond ``[limits]`` that are remembered, some 400 B each; they are taken
# when there is room. Further ones come with the peer's next link.
REFUSED_MAX: Final = 32_768
# Topics or services in one advertisement of a peer, else it is refused; this module's have at most
# ``ADVERTISED_AT_ONCE``.
ADVERTISED_MAX: Final = 16_384
# Refused subscribers of one source that are remembered, to show them to the user.
MISMATCHES_MAX: Final = 16
# [Graph] Relays in a row
# At it: what has passed them is not passed on
# Told in: `why`
# Why: Five networks in a row. Each adds a hop's delay, and longer rows are a mistake.
RELAY_HOPS_MAX: Final = 4
# The lowest route number of a service; topics' routes are counted from 1.
SERVICE_ROUTES: Final = 1 << 31
# Seconds that the serving agent waits longer than the calling one, so that the calling agent's time-out, which has
# the more useful error text, comes first.
SERVICE_GRACE: Final = 1.0
# Seconds without a call after which a service's route, and a connection to its server, is closed.
SERVICE_IDLE: Final = 30.0
# [Services] Calls of one service that its server gets at once
# At it: further ones wait
# Told in: `service info`
# Why: Each connection carries one call at a time, and rospy runs a thread for each.
SERVICE_POOL: Final = 32
# [Services] Calls that wait for one of these
# At it: further ones fail at once
# Told in: the caller's error
SERVICE_QUEUE: Final = 1024
# [Services] Bytes of requests and responses of one peer under way, each way
# At it: further calls fail
# Told in: the caller's error
# Why: In transfer or being reassembled: four of the largest messages.
SERVICE_BYTES: Final = 256 * MIB
# Seconds between two checks that the servers of offered services still listen; a killed one is noticed within 1 s.
SERVER_LOOK: Final = 0.5
# The latest calls of a service from which its latency figures are computed.
SERVICE_LATENCIES: Final = 512
# Nodes subscribed to one topic that are named to the agent of its publisher.
AUDIENCE_MAX: Final = 64
# Seconds for which a publisher is connected to once more for a subscriber that joins: a connect callback of roscpp
# waits for its turn in the node.
JOIN_WINDOW: Final = 3.0
# Seconds for which a message of that connection waits for the same one on the agent's own.
JOIN_HOLD: Final = 0.02
# The latest messages of a latching publisher, which may send one of them once more to a new connection.
JOIN_LATCHED: Final = 8
# Messages for the joining subscriber alone that are remembered, in case all get them later.
JOIN_REMEMBERED: Final = 256
# [Graph] Subscribers of one peer that join topics here at the same time
# At it: for further ones the publisher has no new connection
# Told in: log (debug)
JOINS_MAX: Final = 64
# [Graph] Connections to action servers here for one peer's clients
# At it: further clients are not seen by the server
# Told in: log
# Why: They represent its subscribers (``Exports.named``): enough for 512 action servers of one module.
AUDIENCES_MAX: Final = 1024
# Characters in the name of a request between agents.
ASK_NAME_MAX: Final = 64
# Requests of one peer that are being answered; further ones are refused at once.
ASKS_AT_ONCE: Final = 64
# Seconds that another agent has to answer a request.
ASK_TIMEOUT: Final = 5.0
# Bytes of a request or response, or characters of the text in one, that take the control lane: a millisecond on a 100
# Mbit/s link. Larger ones take the bulk lane, so commands do not wait for megabytes to pass.
ASK_EXPRESS_MAX: Final = 16 * KIB
# Bytes of one request or response: the text of a parameter, and what is around it.
ASK_BYTES_MAX: Final = 17 * MIB
# [Core] Bytes of large questions and answers between two modules, such as parameters, each way
# At it: further ones fail
# Told in: the command's error; of a followed parameter `peer list`, diagnostics, log
# Why: That wait, are reassembled or are answered: four of the largest parameters.
ASK_BYTES: Final = 64 * MIB
# [Core] Bytes of a parameter that crosses between modules
# At it: it is not read, set or followed
# Told in: the command's error; of a followed parameter `peer list`, diagnostics, log
# Why: Characters of its XML-RPC text; within one module ``HTTP_BODY_MAX`` holds.
PARAM_TEXT_MAX: Final = 16 * MIB
# [Core] Parameters in one value that a peer sets
# At it: none is set
# Told in: the command's error
# Why: Each takes the core some 0.25 ms, between data; a large robot has some thousand in all.
PARAMS_SET_MAX: Final = 10_000
# Seconds that a peer has to answer a request about a parameter: as data goes first, its core may need seconds for
# megabytes of numbers. Less than CONTROL_HANDLER_TIMEOUT, so that the error names the agent that did not answer.
PARAM_ASK_TIMEOUT: Final = 25.0
# Seconds for the agent, when it ends, to unsubscribe from all parameters at the local core.
PARAM_LEAVE_TIMEOUT: Final = 1.0
# Seconds over which changes of a followed parameter are gathered: a node that loads twenty keys of a namespace sets
# each of them.
PARAM_GATHER: Final = 0.05
# Characters up to which a followed parameter is compared each RECONCILE_INTERVAL. For larger ones the core's own
# notifications are relied on; they are compared when one has come, or the core was restarted.
PARAM_SMALL: Final = 64 * KIB
# [Core] Bytes of all followed parameters
# At it: further ones are not followed
# Told in: `peer list`, diagnostics, log
# Why: Characters, which are kept here so that they can be put back.
FOLLOWED_BYTES_MAX: Final = 64 * MIB
# Characters of a human-readable text in a control message.
CONTROL_TEXT_MAX: Final = 16 * KIB
# Seconds that a peer's agent has to end a node: the node's answer to the call, and the wait for its end.
NODE_KILL_TIMEOUT: Final = 10.0
# [Core] Nodes of peers that one agent is ending at a time
# At it: further ones are refused
# Told in: `node kill`, log
NODE_KILLS_AT_ONCE: Final = 16
# [Core] Time after `rosnode kill -a` asked the agent's own node
# At it: until then it ends no node of a peer
# Told in: log
# Why: Each further call of it starts the time anew: it asks all nodes of the graph, one after the other.
NODE_KILL_ALL: Final = 2.0
# [Core] Bytes of the log lines of a module, its agent's too, that are kept
# At it: the node with most of them loses its oldest
# Told in: `log`, the page Log
# Why: Some 3,000 lines, ``LOG_LINE_BYTES`` counted for each.
LOG_BYTES_KEPT: Final = 512 * KIB
# What a kept line counts for beside its text.
LOG_LINE_BYTES: Final = 96
# Lines that are dropped at once: the node with most is looked for as seldom.
LOG_DROPPED_AT_ONCE: Final = 32
# [Core] Bytes of one line's text
# At it: the rest is left out
# Told in: the line
LOG_TEXT_MAX: Final = 4 * KIB
# Seconds between a node's stamp and the arrival of its line, above which the line has the time of its arrival: the
# node follows simulated time, or stamps nothing.
LOG_STAMP_OFF: Final = 60.0
# [Core] Log lines of a module in one answer
# At it: the older ones are left out
# Told in: `log`, the page Log
LOG_LINES_ASKED: Final = 500
# Bytes of them: one answer takes the bulk lane for 10 ms at 100 Mbit/s.
LOG_ANSWER_BYTES: Final = 128 * KIB
# Seconds that a peer has to answer a question about its log: one that hangs holds up the lines of the others so long.
LOG_ASK_TIMEOUT: Final = 2.0
# Seconds after which a proxy whose subscribers were disconnected is registered again: at once, and once more for slow
# subscribers.
CALL_BACK_DELAYS: Final = (0.05, 1.0)
# Seconds from a change of the graph until peers are told of the nodes of which nothing crosses: a node that starts
# registers in several steps.
NODES_PAUSE: Final = 1.0
# Seconds between two comparisons of the plan with what is really open, so that nothing stays stuck.
RECONCILE_INTERVAL: Final = 5.0
# Comparisons in a row that leave out names while the local graph has not changed: all are compared once a minute.
RECONCILE_SKIPS: Final = 11
# The latest events of a topic's contract that are remembered, to show them to the user; the counts include all
# others.
WATCH_RECENT: Final = 16
# Seconds between two checks of a source whose liveliness is lost: its messages only store their arrival time and call
# nothing, so its return is found by these checks.
WATCH_LOOK: Final = 0.25
# Losses of one kind that are at most this many seconds apart are remembered as one event.
WATCH_RUN: Final = 1.0
# Messages of a remote source from which its figures are computed. They take 10 KB a route, and five of them lie above
# the 99th percentile.
QUALITY_WINDOW: Final = 512
# Seconds over which a rate is counted where ``QUALITY_WINDOW`` spans less: at 47 kHz it holds one burst of 11 ms.
QUALITY_RATE_SPAN: Final = 1.0
# Seconds. A shorter silence is a pause of this agent between two reads, not one of the source, and does not lower the
# rate.
QUALITY_SILENCE: Final = 0.1
# Seconds after which a message no longer counts for the figures of its source.
QUALITY_SPAN: Final = 60.0
# Estimates that are remembered of each link's clock: one or two a second over ``QUALITY_SPAN``.
QUALITY_CLOCKS: Final = 128
# Seconds in which at most two of these estimates are remembered. An estimate comes once a second, and at each request
# for it.
QUALITY_CLOCK_STEP: Final = 0.9
# [Direct] Time for which a subscriber's `requestTopic` waits for the decision
# At it: it is relayed at first, and moved later
# Told in: `direct.undecided`
# Why: The decision takes one round trip between the agents, one call of the publisher and one connection to it: a few
#   milliseconds.
DIRECT_HOLD: Final = 0.25
# Seconds that a peer has to answer a request for a direct connection; its publisher may be slow.
DIRECT_ASK_TIMEOUT: Final = 5.0
# Requests for direct connections that this agent sends at a time; less than `ASKS_AT_ONCE`, so that others pass.
# Services of one peer have as many places for themselves.
DIRECT_ASKS: Final = 16
# Seconds that a local node has to answer a question about direct transport.
DIRECT_NODE_TIMEOUT: Final = 2.0
# Seconds for which a node's TCPROS port is not asked for again; it changes only with the node's process.
DIRECT_PORT_KNOWN: Final = 10.0
# Seconds that a peer's node has to answer a probe. A firewall that drops packets costs this once for each node.
DIRECT_PROBE_TIMEOUT: Final = 1.0
# [Direct] Time after a refusal that may pass by itself
# At it: the connection is tried again; it is relayed until then
# Told in: `why`
# Why: The node does not answer, or the port cannot be reached.
DIRECT_RETRY: Final = 30.0
# Seconds between two requests for one subscriber that a peer's notifications cause.
DIRECT_RETRY_PAUSE: Final = 1.0
# Seconds between two looks at the kernel's table, whether direct connections still stand.
DIRECT_CHECK: Final = 1.0
# Seconds that a subscriber has to connect after it was answered the publisher's address.
DIRECT_SETTLE: Final = 2.0
# [Direct] Connections of one peer to publishers of this module, and as many to its services
# At it: further ones are relayed
# Told in: `topic info`, `service info`, `why` (*limit*)
DIRECT_MAX: Final = 1024
# Seconds after the start of an agent within which each subscriber that asks for a topic is looked at: it may have a
# direct connection from an earlier run of the agent.
DIRECT_ADOPT: Final = 10.0
# [Direct] Time for which directly called services stay after their agent crashed
# At it: they leave the graph
# Told in: `service info`
# Why: As topics do (``core.limits.RESUME_WINDOW``).
DIRECT_KEEP: Final = 30.0
# [Direct] Breaks of a connection within 10 s
# At it: its subscriber is relayed for 30 s
# Told in: `topic info`, `why` (*stable*)
# Why: Within ``DIRECT_BREAKS_SPAN``, for ``DIRECT_RETRY``.
DIRECT_BREAKS: Final = 3
# Seconds; see `DIRECT_BREAKS`.
DIRECT_BREAKS_SPAN: Final = 10.0
# Seconds that a move waits until an ended connection is gone. Without CAP_NET_ADMIN a roscpp subscriber closes it by
# itself in this time.
DIRECT_MOVE_WAIT: Final = 0.5
# Seconds after which a subscriber that was made to hang up gets the list of publishers once more: a roscore's graph
# is known up to 1.3 s late, and a call to a busy node may fail.
DIRECT_LIST_AGAIN: Final = 3.0
# Seconds between two looks while a move waits.
DIRECT_LOOK: Final = 0.02

# Modules and sites that are logged as refused by one rule for one kind of access; further ones, whose names may be
# invented, are only counted until the rules change.
REFUSALS_LOGGED: Final = 128
# Time for which the rates of topics are measured after they were asked for: a list that is open asks every 3 s.
RATES_KEPT: Final = 6.0
# Pause between two nodes that are asked for their counts; an answer of 40 topics takes some 2 ms to read.
RATES_PAUSE: Final = 0.25
# Topics without a subscriber that are subscribed to at one time, and for how long at most.
RATES_AT_ONCE: Final = 8
RATES_SAMPLE: Final = 2.0
# Messages, and bytes from the third message on, that are enough for a rate.
RATES_MESSAGES: Final = 50
RATES_BYTES: Final = 1 * MIB
# [Graph] Topics of one module whose rates are told
# At it: the rate of others is not known
# Told in: the page of all topics
RATES_MAX: Final = 2000

# Seconds over which the processor time of nodes is measured for the first time.
TOP_FIRST: Final = 0.3
# Seconds that a node has to tell its process, and nodes that are asked at one time.
TOP_ANSWER: Final = 1.0
TOP_AT_ONCE: Final = 16
# [Resources] Files in the folder of `[resources]` that are looked at, and bytes of one of them
# At it: further ones are not started
# Told in: `resource list`
LAUNCH_FILES_MAX: Final = 256
# Bytes of a file that are read for its table `[start]`.
LAUNCH_FILE_BYTES: Final = 256 * KIB
# Seconds until a resource that has failed is started again; each further time it is twice as long, up to the second.
LAUNCH_RESTART_FIRST: Final = 1.0
LAUNCH_RESTART_MAX: Final = 60.0
# Seconds that a resource has to end, with its nodes, before it is killed; a node has 10 s by default.
LAUNCH_END: Final = 20.0
# Seconds that an answer waits until the resource is active or has ended, and that the asking agent waits for it: a
# command has 30 s (``observe.limits.CONTROL_HANDLER_TIMEOUT``).
LAUNCH_WAIT: Final = 20.0
LAUNCH_ASK_TIMEOUT: Final = 25.0
# Lines of each log in one answer, and logs of one resource.
LAUNCH_LOG_LINES: Final = 500
LAUNCH_LOGS_MAX: Final = 16
# [Recording] Bytes of a file of a recording that one request of another module gets
RECORDING_PART: Final = 256 * 1024
# Seconds that a module has to send it: a radio of 50 kbit/s needs four of them for the least part.
RECORDING_TIMEOUT: Final = 20.0
# [Recording] Requests to keep that wait for modules that are not linked
# At it: the oldest is forgotten
KEEPS_WAITING: Final = 64
# A recorder that has not written its status for so long does not run.
RECORDER_SILENT: Final = 20.0
