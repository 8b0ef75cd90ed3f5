"""Limits of the web server, the monitor, rosbridge and the conversion of values.

Limits of the web server's clients.

Each has its reason beside it. Seconds and bytes, unless the name says otherwise.
"""

from __future__ import annotations

from typing import Final

from rmpa.core.limits import KIB, MIB

# --- the hub ------------------------------------------------------------------------------------------------------
# Bytes that wait for one client, of all its subscriptions; beyond, the oldest messages are dropped. One message
# always fits where no other waits.
CLIENT_QUEUE_BYTES: Final = 16 * MIB
# Bytes that wait for one subscription of one client; its newest message always fits.
SUBSCRIPTION_QUEUE_BYTES: Final = 8 * MIB
# Bytes from which on a received message is copied into a buffer that was used before; smaller ones cost little.
PAYLOAD_BUFFER_MIN: Final = 64 * KIB
# Such buffers, used and unused; each is looked at until one is unused.
PAYLOAD_BUFFERS_MAX: Final = 64
# WebSocket clients, pages of the monitor included. The rest of ``WEB_CONNECTIONS_MAX`` is for requests: further ones
# are told why they are refused, and the files of the pages and /metrics are still served.
CLIENTS_MAX: Final = 224
# Time that the hub stays subscribed to a topic without a client: pages reload, and panels move.
SUBSCRIPTION_LINGER: Final = 2.0
# Topics that the hub subscribes to for all clients; beyond, only those with a publisher are added. Each name is
# registered with the master, which takes a millisecond and some kilobytes.
SUBSCRIBED_TOPICS_MAX: Final = 4000
# Time until a topic is withdrawn that no client advertises any more, as rosbridge_suite does: many advertise it again
# at once, and pages reload.
UNADVERTISE_DELAY: Final = 10.0
# Topics that the hub publishes, those included that wait for their withdrawal.
PUBLISHERS_MAX: Final = 2000
# Pause between two attempts to reach the master, or to register.
NODE_RETRY: Final = 1.0
# Pause before an agent that has ended is looked for again, doubled up to ``NODE_RETRY``: one that comes back secured
# is not shown as an open one for longer.
TRUST_RETRY: Final = 0.1
# Bytes of latched messages that the hub keeps for newcomers: maps and robot descriptions have some 10 MB. Beyond, the
# oldest is forgotten, and a newcomer gets none.
LATCHED_BYTES: Final = 64 * MIB
# Time for a service call of a client that names none.
CALL_TIMEOUT: Final = 30.0
# The longest time that a client may give a call.
CALL_TIMEOUT_MAX: Final = 3600.0
# Connections to one service's server; further calls wait. rospy serves each connection by a thread.
CALLS_AT_ONCE: Final = 8
# Calls that wait for a free connection to one service's server.
CALLS_WAITING: Final = 1000
# Calls of one service that a client serves and that wait for its answer.
SERVED_CALLS_MAX: Final = 1000
# Time of one question to the agent for the next change of the graph.
GRAPH_WAIT: Final = 20.0
# Time in which changes that the hub itself makes are gathered before it looks at the graph.
GRAPH_GATHER: Final = 0.01
# Time in which all servers that did not tell their service's type yet are asked, for one question of a client.
FIND_ALL_TIMEOUT: Final = 3.0
# Time before a server that did not tell its service's type, or a type that was not found, is asked for again.
PROBE_RETRY: Final = 10.0
# Types of one topic's publishers that are listed.
SEEN_TYPES_MAX: Final = 16
# Publishers of one topic whose headers are kept.
SEEN_PUBLISHERS_MAX: Final = 256
# Time that a message waits at most for its topic to be registered, as while the core is away: an older one is
# dropped, if it is not latched.
EARLY_AGE: Final = 3.0

# --- gateways -----------------------------------------------------------------------------------------------------
# Time that the first client waits for the graph and the parameters, before it is told that there are none.
SETTLE: Final = 2.0
# Time for a client to confirm the end of its WebSocket.
CLOSE_TIMEOUT: Final = 2.0
# Time without a sign of life of a client, half of it after a ping; after half of it more it is disconnected, as it
# may have left the Wi-Fi.
PING_INTERVAL: Final = 20.0
# Time for a client's message to arrive, all its fragments: the largest one at 5 Mbit/s.
MESSAGE_TIMEOUT: Final = 120.0
# Bytes in the connection's own buffer above which nothing more is written to it.
WRITE_BUFFER: Final = 64 * KIB
# Shortest time between two texts to a client on the messages that it misses.
DROPS_SHOWN: Final = 1.0

# --- Foxglove WebSocket -----------------------------------------------------------------------------------------
# Bytes of one JSON message of a client; the longest name the parameters that it wants.
FOXGLOVE_TEXT_MAX: Final = 1 * MIB
# Bytes of one binary message of a client: an image or a map that it publishes.
FOXGLOVE_BINARY_MAX: Final = 64 * MIB
# Subscriptions of one client; each has a queue of its own.
FOXGLOVE_SUBSCRIPTIONS_MAX: Final = 4096
# Topics that one client publishes at one time; each is a publisher in the graph.
FOXGLOVE_ADVERTISED_MAX: Final = 256
# Service calls of one client that wait for their response.
FOXGLOVE_CALLS_MAX: Final = 256
# Parameters in one message of a client, and parameters that it follows by name.
FOXGLOVE_PARAMETERS_MAX: Final = 4096
# Requests for parameters of one client that wait for their answer.
FOXGLOVE_PARAMETER_REQUESTS_MAX: Final = 64
# Lists and maps within each other in a parameter's value, as XML-RPC values are bounded.
FOXGLOVE_PARAMETER_DEPTH_MAX: Final = 32
# Assets that one client waits for at one time.
FOXGLOVE_ASSETS_MAX: Final = 16
# Bytes of one asset: the mesh of a large robot has some 20 MB.
FOXGLOVE_ASSET_MAX: Final = 64 * MIB
# Characters of a name, a type, an encoding or an asset's URI in a message of a client.
FOXGLOVE_NAME_MAX: Final = 1024
# Characters of schemas in one advertise message; further channels go into further messages.
FOXGLOVE_ADVERTISE_BYTES: Final = 256 * KIB
# Status messages a second for errors of one client, in the long run.
FOXGLOVE_STATUS_RATE: Final = 5.0
# Errors of one client at once. Beyond that and the rate, what it may not do is refused without a status, and a
# malformed message disconnects it: it does not speak the protocol.
FOXGLOVE_STATUS_BURST: Final = 100.0

# --- /metrics -----------------------------------------------------------------------------------------------------
# Peers in /metrics, each with some fifteen time series.
METRIC_PEERS: Final = 1024
# Routes in /metrics, each with some twenty time series; a module of 300 topics and three peers has some 1,000.
METRIC_ROUTES: Final = 2000
# Services in /metrics, each with some six time series.
METRIC_SERVICES: Final = 1000
# Counters of what was refused or dropped in /metrics; there are some hundred.
METRIC_REASONS: Final = 256
# Characters of a label's value in /metrics, which Prometheus keeps with each time series.
METRIC_LABEL_CHARACTERS: Final = 256

# --- REST ---------------------------------------------------------------------------------------------------------
# Characters of a path: a name of 512 characters, percent-encoded.
REST_PATH_MAX: Final = 2048

# --- HTTP server --------------------------------------------------------------------------------------------------
# Connections at one time: a browser has six, Prometheus one. Each takes some 10 KiB and a file descriptor, and a
# WebSocket one more.
WEB_CONNECTIONS_MAX: Final = 256
# Bytes of a request line: twice the longest path of the API, for a token behind it.
WEB_LINE_MAX: Final = 4096
# Bytes of one header: a browser sends the cookies of all servers of one host.
WEB_FIELD_MAX: Final = 8 * KIB
# Headers of a request; browsers send some 20.
WEB_HEADERS_MAX: Final = 64
# Bytes that one connection may send until a response begins: a request, or several in a row.
WEB_REQUEST_MAX: Final = 32 * KIB
# Seconds for a request to arrive, from its first byte or, for the first one, from the connection on.
WEB_REQUEST_TIMEOUT: Final = 10.0
# Seconds from a request to the end of its response; a client that does not read is disconnected then.
WEB_RESPONSE_TIMEOUT: Final = 30.0
# Seconds that a connection is kept without a request; Prometheus asks every 15 to 60 s.
WEB_IDLE_TIMEOUT: Final = 75.0
# Topics and services beyond which those that nothing uses are left out of the snapshots that the server reads again
# and again: the monitor and /metrics show no more of them, and each takes the agent 0.03 ms.
WEB_TOPICS: Final = 2000
# Seconds that a snapshot of which nothing is left out is shared; the API alone asks for it.
WEB_WHOLE_AGE: Final = 2.0
# Seconds that a snapshot is shared before the agent is asked again: less than the monitor's pause between two.
WEB_SNAPSHOT_AGE: Final = 0.1
# Seconds for the agent to answer; it takes milliseconds, and Prometheus waits for 10 s.
WEB_AGENT_TIMEOUT: Final = 2.0
# Characters of a token that the user chose.
WEB_TOKEN_LENGTH_MIN: Final = 16
# Bytes of a token's file; a larger one is no token.
WEB_TOKEN_FILE_MAX: Final = 4096
# Seconds between two looks at the files of the certificate: a renewed one is served long before the old one ends.
CERTIFICATE_LOOK_PERIOD: Final = 5.0


# --- Limits of the monitor's clients --------------------------------------------------------------------------------
#
# Each has its reason beside it. Seconds and bytes, unless the name says otherwise.


# Between two patches of one client: some 7 a second, which looks live and is read at leisure.
PATCH_PERIOD: Final = 0.15
# Shortest time from one snapshot of the agent to the next while pages are open.
STATE_PERIOD: Final = 0.15
# The pause between two snapshots is at least so many times as long as a snapshot takes: a fifth of a core.
STATE_SHARE: Final = 4.0
# States and patches that a client has not acknowledged yet. A slow browser gets fewer patches, never a queue.
UNACKNOWLEDGED_MAX: Final = 2
# Bytes of one message of a client: a parameter's value, or the arguments of a call.
REQUEST_MAX: Final = 64 * KIB
# Messages of one client a second, in the long run: a joystick sends 10, acknowledgements 7.
REQUEST_RATE: Final = 50.0
# Messages of one client at once: a page that reconnects and asks for all that it shows.
REQUEST_BURST: Final = 200.0
# Things whose details one client is shown at one time; a page shows one or two.
LOOKS_MAX: Final = 4
# Topics whose messages one client is shown at one time.
WATCHES_MAX: Final = 16
# Values, images and scans a second of one watch.
WATCH_RATE_MAX: Final = 10.0
# Numeric fields of one plot: as many lines as can be told apart.
FIELDS_MAX: Final = 8
# Questions of one client (why, calls, parameters) that wait for their answer.
ASKS_MAX: Final = 16
# Samples of a plot in one message. Of more, the least and the greatest of each part are kept.
POINTS_MAX: Final = 64
# Characters of a string in a live value; the rest is cut.
VALUE_CHARACTERS: Final = 512
# Elements of an array in a live value; the rest is counted.
VALUE_ITEMS: Final = 64
# Values in one live value, all levels together.
VALUE_NODES: Final = 2000
# Ranges of a laser scan that are sent: two a degree. Of more, the nearest of each part is kept.
SCAN_POINTS: Final = 720
# Pixels of an uncompressed image that are sent; of more, every n-th row and column.
IMAGE_PIXELS: Final = 320 * 240
# Topics in a state; further ones are counted.
TOPICS_SHOWN: Final = 2000
# Services in a state; further ones are counted.
SERVICES_SHOWN: Final = 2000
# Nodes in a state; further ones are counted.
NODES_SHOWN: Final = 2000
# Modules in a state; further ones are counted. A ring of more could not be read.
MODULES_SHOWN: Final = 256
# Lines of the log that are kept for a page that opens it.
LOG_LINES: Final = 500
# Characters of one line of the log; the rest is cut.
LOG_CHARACTERS: Final = 1024
# Time after the start of this module's agent in which peers that it has not found yet do not count as lost: beacons
# come every 5 s at the latest, and links take seconds where names or addresses are resolved.
AGENT_SETTLES: Final = 10.0
# Time for which a module that has left the roster is still shown.
FORGET_AFTER: Final = 600.0
# Seconds that an order of a page may be old: less than the page waits for a word before it gives all up.
ORDER_AGE: Final = 5.0
# Time after the last command of a joystick after which the robot is stopped; a joystick sends every 0.1 s.
DRIVE_TIMEOUT: Final = 0.3
# Magnitude of a linear speed that a joystick may command, m/s.
DRIVE_SPEED: Final = 2.0
# Magnitude of an angular speed that a joystick may command, rad/s.
DRIVE_TURN: Final = 4.0
# Paths of Smart Resources that are followed; each is up to nine subscriptions.
RESOURCES_MAX: Final = 256
# Time for which the details of a Smart Resource are followed after a page has shown it.
LOOK_KEPT: Final = 10.0
# Time between two signs of life to a page, which takes its connection for lost after three without any.
TICK_PERIOD: Final = 2.0
# Pause before it is looked again whether a page has taken what was sent.
UNSENT_RETRY: Final = 0.1
# Questions of all pages together that wait for the agent, each in a thread: `why` takes seconds.
ANSWERS_AT_ONCE: Final = 4
# The longest pause between two snapshots.
STATE_PAUSE_MAX: Final = 0.5


# --- Bounds and time-outs of one rosbridge client, in seconds and bytes ---------------------------------------------


# One frame of a client, and so a message that it publishes, in JSON; rosbridge_suite's default.
FRAME_MAX: Final = 10 * MIB
# One frame of a client in CBOR: each byte may be a value, which takes up to 64 bytes.
BINARY_FRAME_MAX: Final = 2 * MIB
# Objects and lists in one frame in JSON: an empty object has two characters and takes 64 bytes.
CONTAINERS_MAX: Final = 200_000
# Characters of an ``id``, which is sent back and kept.
ID_MAX: Final = 1 * KIB
# Characters of the name of a topic, service or type.
NAME_MAX: Final = 1 * KIB
# Fragments of one message, sent or received: a fragment of one character would need 100 bytes around it.
FRAGMENTS_MAX: Final = 10_000
# Bytes of all incomplete messages of a client; the oldest incomplete message is dropped.
FRAGMENTED_MAX: Final = 16 * MIB
# Incomplete messages of a client; the oldest is dropped.
FRAGMENTED_MESSAGES_MAX: Final = 16
# Time for a topic to appear that is subscribed to without a type, as it may begin at the same moment.
TYPE_WAIT: Final = 2.0
# Time within which the next fragment of a message must arrive.
FRAGMENT_TIMEOUT: Final = 60.0
# Bytes that a client's PNG unpacks to: its lines may have filters, which are undone in Python.
PNG_MAX: Final = 4 * MIB
# Subscribed topics of a client; a page that shows all topics of some large modules stays below.
SUBSCRIPTIONS_MAX: Final = 1000
# Ids of one client that subscribe to one topic, or advertise it.
SUBSCRIBERS_MAX: Final = 100
# Largest ``queue_length`` of a subscription; larger ones are lowered to it.
QUEUE_MESSAGES_MAX: Final = 1000
# Bytes queued for a throttled subscription; the oldest are dropped, one message always fits.
QUEUE_BYTES_MAX: Final = 4 * MIB
# Bytes queued for all throttled subscriptions of a client; the newest message is dropped.
QUEUES_BYTES_MAX: Final = 16 * MIB
# Topics that a client advertises.
ADVERTISED_MAX: Final = 500
# Calls of a client without an answer yet, questions of rosapi included.
CALLS_MAX: Final = 1000
# Services that a client offers.
SERVED_MAX: Final = 200
# Calls to services that a client offers, without its answer yet.
REQUESTS_MAX: Final = 1000
# Messages kept in the form in which they were sent, for further clients of the same topic.
SHARED_FRAMES: Final = 64
# Bytes of these; larger messages are converted for each client.
SHARED_BYTES: Final = 16 * MIB
# Lists and dictionaries within each other in a parameter; beyond, other nodes' XML-RPC libraries give up.
PARAMETER_DEPTH_MAX: Final = 32
# Characters of a status message.
TEXT_MAX: Final = 500
