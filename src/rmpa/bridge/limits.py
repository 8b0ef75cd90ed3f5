"""Limits and time-outs of the bridge: catalogues, routes, services and parameters.

Each has its reason beside it. Seconds and bytes, unless the name says otherwise.
"""

from __future__ import annotations

from typing import Final

from rmpa.core.sizes import KIB, MIB

ROUTE_OPEN_TIMEOUT: Final = 5.0
"""From asking a peer for a topic to its answer; then the route is asked for again."""
ROUTE_LINGER: Final = 1.0
"""A route stays open this long after its last local subscriber left: reconnecting nodes flap."""
ADVERTISED_AT_ONCE: Final = 64
"""Sources in one advertisement of ours; more follow in the next turn of the loop."""
TELL_PAUSE: Final = 0.005
"""Before it is looked again."""
TELL_PATIENCE: Final = 0.1
"""A portion waits no longer than this: on a lane that is never empty the graph must get on too, by 0.5 Mbit/s."""
ADVERTISEMENT_MAX: Final = 1 * MIB
"""One advertisement, which is read in one piece: ours are 200 KB with the longest names, and 5 KB with usual ones."""
ADVERTISED_WAITING_BYTES: Final = 4 * MIB
"""Advertisements of all peers that wait to be read: some 40,000 topics. Beyond it they are read at once."""
APPLIED_AT_ONCE: Final = 16
"""Sources of an advertisement that are dealt with at once, some 100 microseconds; then data goes first."""
RESCANNED_AT_ONCE: Final = 16
"""Topics of the local graph that are looked at in one turn of the loop, after a change or to reconcile."""
SURPLUS_MAX: Final = 32_768
"""Topics, and services, of one peer beyond ``[limits]`` that are remembered, some 400 B each: they are shown as soon
as there is room. Further ones are counted, and come with the peer's next link."""
ADVERTISED_MAX: Final = 16_384
"""Topics or services in one advertisement of a peer; ours have ``ADVERTISED_AT_ONCE``."""
MISMATCHES_MAX: Final = 16
"""Refused subscribers of one source that are remembered for the user."""
RELAY_HOPS_MAX: Final = 4
"""Relays between two modules: five networks in a row; each adds a hop's delay, and longer rows are a mistake."""
SERVICE_ROUTES: Final = 1 << 31
"""Routes from here on are those of services: topics' are counted from 1."""
SERVICE_GRACE: Final = 1.0
"""The serving agent waits this much longer than the calling one, whose text says more."""
SERVICE_IDLE: Final = 30.0
"""A service, and a connection to its server, that is not used for this long is closed."""
SERVICE_POOL: Final = 32
"""Calls of one service that its server gets at once, each by a connection (and in rospy a thread) of its own."""
SERVICE_QUEUE: Final = 1024
"""Calls of one service that wait for one of those; further ones are refused at once."""
SERVICE_BYTES: Final = 256 * MIB
"""Requests and responses of one peer that are under way or being put together, each way: four of the largest."""
SERVER_LOOK: Final = 0.5
"""Between two looks whether the servers of what is offered still listen: a killed one is gone within 1 s."""
SERVICE_LATENCIES: Final = 512
"""Calls of a service that its latency is made of."""
AUDIENCE_MAX: Final = 64
"""Nodes that listen to one topic and are named to its publisher's agent."""
AUDIENCES_MAX: Final = 1024
"""Connections that stand for one peer's listeners (``bridge.topics.audience``): 512 action servers of one module."""
ASK_NAME_MAX: Final = 64
"""Characters of a question's name."""
ASKS_AT_ONCE: Final = 64
"""Questions of one peer that are being answered; further ones are refused at once."""
ASK_TIMEOUT: Final = 5.0
"""For another agent's answer."""
PARAM_PORTION: Final = 16 * KIB
"""Characters of a parameter that cross at once: a millisecond of a 100 Mbit/s link, and the next portion is asked for
when this one is there, so commands do not wait behind megabytes."""
PARAM_TEXT_MAX: Final = 16 * MIB
"""Characters of a parameter as XML-RPC text that crosses between modules; within one module ``HTTP_BODY_MAX`` holds.
A peer may read and write ``PARAM_TRANSFERS`` of these at a time: 128 MiB."""
PARAM_TRANSFERS: Final = 4
"""Parameters that one peer reads or writes at a time; the one that was begun first gives way."""
PARAM_TRANSFER_IDLE: Final = 30.0
"""A parameter that is read or written in portions is forgotten when it does not go on for this long."""
PARAM_ASK_TIMEOUT: Final = 25.0
"""For a peer's answer about a parameter: its core may need seconds for megabytes of numbers, data going first. Less
than CONTROL_HANDLER_TIMEOUT, so that the user is told which agent did not answer."""
PARAM_LEAVE_TIMEOUT: Final = 1.0
"""For leaving all parameters that the agent was told of, when it ends."""
PARAM_GATHER: Final = 0.05
"""Changes of a followed parameter are gathered this long: a node that loads twenty keys of a namespace sets each."""
PARAM_SMALL: Final = 64 * KIB
"""Followed parameters up to this size are compared each RECONCILE_INTERVAL; larger ones are trusted to the core's own
notifications, and compared when the core was restarted."""
FOLLOWED_BYTES_MAX: Final = 64 * MIB
"""All followed parameters as they are remembered here, to be put back."""
CONTROL_TEXT_MAX: Final = 16 * KIB
"""Characters of a text for people in a control message."""
NODE_KILL_TIMEOUT: Final = 10.0
"""For a peer's agent to end a node: its answer to the call, and the wait."""
NODE_KILLS_AT_ONCE: Final = 16
"""Nodes of peers whose end is asked for at one time; further ones are refused."""
NODE_KILL_ALL: Final = 2.0
"""Seconds in which the caller that asked the agent's own node to end ends no node of another module, counted anew
from each such call: `rosnode kill -a` asks all nodes of the graph, one after the other."""
CALL_BACK_DELAYS: Final = (0.05, 1.0)
"""When a proxy is registered again whose subscribers were hung up on: at once, and later for slow ones."""
RECONCILE_INTERVAL: Final = 5.0
"""The plan is compared with what is really open this often, so that nothing stays stuck."""
WATCH_RECENT: Final = 16
"""Last events of a topic's contract that are remembered for the user; the counts tell of the others."""
WATCH_LOOK: Final = 0.25
"""A source that is not alive is looked at this often: its messages only leave their time behind, and call nothing."""
WATCH_RUN: Final = 1.0
"""Losses of one kind that follow each other within this time are remembered as one event."""
QUALITY_WINDOW: Final = 512
"""Messages of a remote source that its figures are made of, a power of two: 10 KB a route, and a 99th percentile that
five of them exceed."""
QUALITY_RATE_SPAN: Final = 1.0
"""Seconds that a rate is counted over where the window above is shorter: at 47 kHz that holds one burst of 11 ms."""
QUALITY_SILENCE: Final = 0.1
"""A shorter silence is our own pause between two reads, not the source's, and counts for no rate."""
QUALITY_SPAN: Final = 60.0
"""Older messages tell nothing of how a source is now."""
QUALITY_CLOCKS: Final = 128
"""Estimates remembered of each link's clock: one or two a second over QUALITY_SPAN."""
QUALITY_CLOCK_STEP: Final = 0.9
"""Seconds in which at most two of them are remembered; they come once a second, and whenever they are asked for."""
