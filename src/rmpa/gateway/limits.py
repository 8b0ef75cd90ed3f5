"""Every bound of the gateway, with unit and reason."""

from __future__ import annotations

from typing import Final

from rmpa.config import limits as config_limits
from rmpa.core.limits import MIB

# Characters of a key expression or a liveliness token that another site or a ROS 2 node sent. Longer ones are
# not read; the longest that ROS names and types make is some 900.
KEY_MAX: Final = 2048
# The largest number in a QoS of ROS 2: they are 64-bit there.
QOS_NUMBER_MAX: Final = 2**63 - 1
# [Gateway] Sites that one message passes
# At it: it is not passed on
# Why: More mean a loop.
PATH_MAX: Final = 8
# [Gateway] Calls of other sites that one service gets at once
# At it: further ones wait
# Why: As many as an agent opens connections to a server for.
SITE_CALLS_AT_ONCE: Final = 32
# [Gateway] Calls that wait for one of these
# At it: further ones fail at once
# Told in: the caller's error
SITE_CALLS_WAITING: Final = 1024
# Seconds that a topic is there before the gateway asks its publisher whether it is latched.
LATCH_LOOK_AFTER: Final = 5.0
# Bytes of what another site's gateway tells of a topic for ``rmpa why``.
SITE_WHY_MAX: Final = MIB // 16
# Sites that are remembered as unreachable; those that left first are forgotten first.
SITES_REMEMBERED_MAX: Final = 256
# [Gateway] Topics and services of one site in `rmpa site info`
# At it: others are left out
# Why: Some 2 MB of JSON.
SITE_REPORT_SOURCES_MAX: Final = 5000
# [Gateway] Connections to action servers here for other sites' clients, two for each
# At it: further clients are not seen by the server
SITE_ACTIONS_MAX: Final = 1024
# Characters of a site's name, as settings have it.
SITE_NAME_MAX: Final = config_limits.SITE_NAME_MAX
# [ROS 2] Characters of a name
# At it: it is not shown
# Told in: `site info ros2`, log
# Why: Its own limit is about that for topics.
ROS2_NAME_MAX: Final = 255
# [ROS 2] Nodes
# At it: further ones stay hidden
# Told in: `site info ros2`, log
# Why: Any program that reaches the router can declare more.
ROS2_NODES_MAX: Final = 2000
# [ROS 2] Their publishers, subscriptions, services and clients
# At it: further ones stay hidden
# Told in: `site info ros2`, log
# Why: Each costs some 3 KB.
ROS2_ENDPOINTS_MAX: Final = 20000
# Problems of the neighbour ROS 2 that are kept for ``rmpa site``; the oldest go first.
ROS2_PROBLEMS_MAX: Final = 500
# [ROS 2] Types that are learnt
# At it: further ones do not cross
# Told in: `site info ros2`, log
# Why: From publishers and ROS 2 nodes, and pairs that are kept; ROS has some 160 of its own.
ROS2_TYPES_MAX: Final = 500
# [ROS 2] Bytes of a type's description
# At it: it does not cross
# Told in: `site info ros2`, log
# Why: The largest of ROS 2's own types has 30 KB.
ROS2_DESCRIPTION_MAX: Final = 256 * 1024
# [ROS 2] Types in one description
# At it: it does not cross
# Told in: `site info ros2`, log
# Why: For each, rosbags makes a class. The most that one of ROS 2's own has are some 20.
ROS2_DESCRIBED_TYPES_MAX: Final = 128
# [ROS 2] Fields of a type, with those of each type that it embeds
# At it: it does not cross
# Told in: `site info ros2`, log
# Why: Conversions are made of these. Some bytes of a definition can embed billions. The largest type of ROS has some
#   200.
ROS2_PARTS_MAX: Final = 20_000
# [ROS 2] Fields and types of all descriptions
# At it: further ones do not cross
# Told in: `site info ros2`, log
# Why: Some 1 KB each.
ROS2_LEARNT_FIELDS_MAX: Final = 100_000
# [ROS 2] Elements of one message that are converted one by one
# At it: it is dropped
# Told in: `site info ros2`, log
# Why: And each 64 bytes that are made up for fields that its sender lacks: a second of the gateway's time. Arrays of
#   numbers are copied whole, and do not count.
ROS2_WORK_MAX: Final = 2_000_000
# [ROS 2] Elements of all arrays of fixed size in a type
# At it: it does not cross
# Told in: `site info ros2`, log
# Why: An empty message must have them all.
ROS2_ARRAY_MAX: Final = 1_000_000


# [Gateway] Other sites
# At it: further ones are not shown
# Told in: `site list`
# Why: Their tokens are counted.
SITES_MAX: Final = 256
# [Gateway] Modules of one other site
# At it: further ones are not shown
# Told in: `site info`
# Why: As many as the mesh has peers.
SITE_MODULES_MAX: Final = 512
# [Gateway] Topics, once for each publisher, and services of one site
# At it: further ones are not shown, and not offered
# Told in: `site info`
SITE_SOURCES_MAX: Final = 16_384
# [Gateway] Topics and services of all other sites
# At it: further ones are not shown
# Told in: `doctor` (`site.limit`)
# Why: Some 5 KB each. Any program that reaches the router can announce more.
SITES_SOURCES_MAX: Final = 65_536
# Sources that wait for one name here which another one holds; each is judged again whenever it is free.
SITE_NAMES_WAITING_MAX: Final = 64
# [Gateway] Time for which a lost site stays in the graph
# At it: its sources leave it
# Why: Longer than another gateway of that site needs to take over. A site that is frozen is noticed within 1 s by
#   Zenoh's lease, and must be gone within 1.5 s.
SITE_GRACE: Final = 0.5
# Seconds for which a gateway must have been the first of its site before it leads; below ``SITE_GRACE``, so that
# the other sites keep the sources.
LEADER_PATIENCE: Final = 0.3
# Bytes of a publisher's header from another site, with the definition; the longest of ROS 1 has some 30 KB.
HEADER_MAX: Final = 512 * 1024
# [Gateway] Messages of one topic that wait for its publisher's header
# At it: the oldest is dropped
# Told in: `site info`
HELD_MESSAGES_MAX: Final = 1000
# [Gateway] Bytes of one best-effort topic that wait for a slow link (messages: `depth` of `[[contract]]`)
# At it: the oldest is dropped
# Told in: `site info` of both sites
# Why: What is older than that is of no use. One message always fits, and a burst of 1,000 small ones.
BEST_EFFORT_BYTES: Final = 8 * 1024 * 1024
# [Gateway] Bytes of one reliable topic that wait for a slow link (messages: `depth` of `[[contract]]`)
# At it: the oldest is dropped
# Told in: `site info` of both sites
# Why: As in a lane of the mesh.
RELIABLE_BYTES: Final = 64 * 1024 * 1024
# Bytes from which on a topic's messages yield to those of others, if its contract has no priority: on a line of
# 1 Mbit/s one such message takes 65 ms, for which all others of its priority wait.
LARGE_MESSAGE: Final = 8 * 1024
# Seconds after a topic of another site is back within which a subscriber counts as the one from before: what was
# lost meanwhile is counted. roscpp's and rospy's nodes are back within two.
RESUMED_WITHIN: Final = 10.0
# Topics whose counts are kept while their site is away; of more, the oldest begin anew.
INTERRUPTED_TOPICS_MAX: Final = 1024
# [ROS 2] Time for a call (`services.timeout` of the caller's module ends it before)
# At it: it fails
# Told in: the caller's error
# Why: Clients of ROS 1 and of rmw_zenoh wait without end; a server that dies ends its calls at once.
ROS2_CALL_TIMEOUT: Final = 600.0
# [ROS 2] Calls of one service under way, each way
# At it: further ones fail at once
# Told in: the caller's error
ROS2_CALLS_MAX: Final = 64
# Publishers of one topic of ROS 2 whose sequence numbers are followed; the one silent for longest is forgotten.
ROS2_PUBLISHERS_MAX: Final = 1000
# [ROS 2] ROS 2 nodes that are asked for types at one time
# At it: others when a further publisher of their topics appears
# Told in: `site info ros2`, log
# Why: Any program can declare tokens of types that are not known.
ROS2_ASKS_MAX: Final = 200
# Seconds in which a ROS 2 node's get_type_description may appear after its first publisher, and in which it
# answers: a node declares one after the other.
ROS2_SERVICE_WAIT: Final = 3.0
# Seconds between two looks whether a session that listens has to be opened anew: its certificate was renewed,
# which is each 3.5 days, or a module has joined that the table of access must name. Some 2 ms each.
CERTIFICATE_LOOK_PERIOD: Final = 5.0
# Seconds until a session is opened again, at first, whose router did not answer.
OPEN_RETRY_FIRST: Final = 0.5
# [ROS 2] Goals of one action under way, each way
# At it: the next one is rejected
# Told in: the client's status
ROS2_GOALS_MAX: Final = 1000
# Seconds for which a goal that has ended stays in the status of ROS 1; actionlib's ``status_list_timeout``.
ROS2_GOAL_KEPT: Final = 5.0
# Seconds for which a client of ROS 2 may ask for the result of a goal that has ended; rcl's default is 10.
ROS2_RESULT_KEPT: Final = 60.0
# Seconds for an action server of ROS 1 to show a goal in its status; then the goal counts as not accepted.
ROS2_ACCEPT_TIMEOUT: Final = 10.0
# [ROS 2] Actions that are joined, each way
# At it: others are left out
# Told in: `site info ros2`, log
ROS2_ACTIONS_MAX: Final = 500


# Seconds without a sign of life after which a Zenoh transport counts as dead: with the other side's grace a
# frozen site is gone within 1.5 s (measured: 1.2 s with a lease of 0.8 s, 1.6 s with one of 1.2 s). Zenoh sends
# a keep-alive four times in that time, from a thread of its own, and any data counts too.
LEASE: Final = 1.0
# Seconds that a query or a declaration may wait for a transport before Zenoh closes it: Zenoh's own value.
BLOCK_MAX: Final = 5.0
# Seconds that a message, or each fragment of it, waits for room in a transport before Zenoh drops the message
# and, at once, those behind it. One batch of Zenoh (64 KB) takes a line of 1 Mbit/s half a second, and longer
# where packets are lost: with 1 s here a burst of 1,000 messages lost most of them, with 10 s none. Zenoh's own
# value, 1 ms, loses what is large on every slow link. A dead transport ends by its lease. A put that blocks
# instead would end the link: Zenoh closes a transport behind which one message, with all its fragments, waits
# for longer than ``BLOCK_MAX``.
DROP_WAIT: Final = 10.0
# [Gateway] Time for which one large message waits for a slow link, all parts together
# At it: it is dropped
# Told in: the other site's `site info` (*lost*)
# Why: 32 MB at 1 Mbit/s.
DROP_WAIT_MAX: Final = 300.0
# [Gateway] Messages of one topic from other sites or ROS 2 that wait for the gateway
# At it: the oldest is dropped
# Told in: `site info` (*lost*)
# Why: Several bursts of 1,000, and 30 ms of what the loop can take.
ARRIVED_MESSAGES: Final = 10_000
# [Gateway] Bytes of these
# At it: the oldest is dropped
# Told in: `site info` (*lost*)
# Why: 64 images of 1 MB; one message always fits.
ARRIVED_BYTES: Final = 64 * 1024 * 1024
# [Gateway] Calls of one service, and questions of one kind, that wait for the gateway
# At it: the oldest is not answered
# Told in: the caller's error
ARRIVED_QUERIES: Final = 1_000
# [Gateway] Announcements of other sites or ROS 2 that wait for the gateway
# At it: the oldest is dropped: a source is missing, or stays
# Why: A hundred sites of a thousand sources, twice.
ARRIVED_TOKENS: Final = 200_000
# [Gateway] Bytes of a message from other sites or ROS 2
# At it: the connection that sends it ends
# Why: The largest of ROS, and its head. Zenoh's own value is 1 GiB, which any program that connects could have this
#   process hold.
ZENOH_MESSAGE_MAX: Final = 257 * 1024 * 1024
# [Gateway] Bytes of an attachment
# At it: the message or question is dropped
# Told in: `zenoh.attachment.long` of `doctor`
# Why: The longest that this gateway or ROS 2 writes has some 900.
ATTACHMENT_MAX: Final = 4096
# Characters of the key of a message, token or query, and of a query's parameters; those of ROS names have at
# most some 900. Longer ones are dropped, and counted as ``zenoh.key.long``.
ZENOH_KEY_MAX: Final = 4096
# Characters of the tokens that wait for the event loop.
ARRIVED_TOKEN_BYTES: Final = 64 * 1024 * 1024
# [Gateway] Answers to one question
# At it: further ones are dropped
# Told in: `zenoh.reply.limit`
# Why: A gateway asks for one answer of each gateway of a site.
REPLIES_MAX: Final = 20_000
# [Gateway] Bytes of these
# At it: further ones are dropped
# Told in: `zenoh.reply.limit`
# Why: One answer always fits.
REPLY_BYTES_MAX: Final = 256 * 1024 * 1024
# [Gateway] Answers of the gateway that wait to be sent
# At it: the question gets an error
# Told in: `zenoh.answer.limit`
ANSWERS_WAITING_MAX: Final = 20_000
# [Gateway] Bytes of these
# At it: the question gets an error
# Told in: `zenoh.answer.limit`
# Why: One always fits: a client that asks and does not read must not fill the memory.
ANSWER_BYTES_MAX: Final = 256 * 1024 * 1024
# Seconds between two looks at what arrived while much arrives; the delay that a message may have then.
BUSY_PERIOD: Final = 0.001
# Seconds that a publisher which is closed may still send what waits.
FLUSH_MAX: Final = 1.0
