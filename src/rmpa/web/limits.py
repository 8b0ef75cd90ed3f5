"""Limits of the web server, the monitor, rosbridge and the conversion of values.

Limits of the web server's clients.

Each has its reason beside it. Seconds and bytes, unless the name says otherwise.
"""

from __future__ import annotations

from typing import Final

from rmpa.core.limits import KIB, MIB

# --- the hub ------------------------------------------------------------------------------------------------------
# [Web] Bytes that wait for one client
# At it: the oldest messages are dropped, low priorities first; a client that does not read answers is disconnected
# Told in: status, log
# Why: Of all its subscriptions. One message always fits where no other waits.
CLIENT_QUEUE_BYTES: Final = 16 * MIB
# [Web] Bytes that wait for one of its subscriptions
# At it: the oldest messages are dropped
# Told in: status
# Why: Its newest message always fits.
SUBSCRIPTION_QUEUE_BYTES: Final = 8 * MIB
# Bytes from which on a received message is copied into a buffer that was used before; smaller ones cost little.
PAYLOAD_BUFFER_MIN: Final = 64 * KIB
# Such buffers, used and unused; each is looked at until one is unused.
PAYLOAD_BUFFERS_MAX: Final = 64
# [Web] WebSocket clients, pages of the monitor included
# At it: further ones get 503
# Told in: the response, `rmpa_web_refused_total`, log
# Why: The rest of ``WEB_CONNECTIONS_MAX`` is for requests: further ones are told why they are refused, and the files
#   of the pages and /metrics are still served.
CLIENTS_MAX: Final = 224
# Time that the hub stays subscribed to a topic without a client: pages reload, and panels move.
SUBSCRIPTION_LINGER: Final = 2.0
# [Web] Topics to which all clients subscribe
# At it: further ones without a publisher are refused
# Told in: status
# Why: Each name is registered with the master, which takes a millisecond and some kilobytes.
SUBSCRIBED_TOPICS_MAX: Final = 4000
# Time until a topic is withdrawn that no client advertises any more, as rosbridge_suite does: many advertise it again
# at once, and pages reload.
UNADVERTISE_DELAY: Final = 10.0
# [Web] Topics that all clients publish
# At it: further ones are refused
# Told in: status
# Why: Those included that wait for their withdrawal.
PUBLISHERS_MAX: Final = 2000
# Pause between two attempts to reach the master, or to register.
NODE_RETRY: Final = 1.0
# Pause before an agent that has ended is looked for again, doubled up to ``NODE_RETRY``: one that comes back secured
# is not shown as an open one for longer.
TRUST_RETRY: Final = 0.1
# [Web] Bytes of latched messages that are kept for newcomers
# At it: the oldest is forgotten
# Why: Maps and robot descriptions have some 10 MB.
LATCHED_BYTES: Final = 64 * MIB
# [Web] Time for a service call whose client gives none
# At it: it fails
# Told in: the call's failure
CALL_TIMEOUT: Final = 30.0
# [Web] Time for a service call that its client gives
# At it: a longer one is shortened
# Told in: the call's failure
CALL_TIMEOUT_MAX: Final = 3600.0
# Connections to one service's server; further calls wait. rospy serves each connection by a thread.
CALLS_AT_ONCE: Final = 8
# [Web] Calls that wait for one service's server
# At it: further ones fail
# Told in: the call's failure
CALLS_WAITING: Final = 1000
# [Web] Calls of one service that wait for the client that offers it
# At it: further ones fail
# Told in: the call's failure
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

# --- clients ------------------------------------------------------------------------------------------------------
# Time that the first client waits for the graph and the parameters, before it is told that there are none.
SETTLE: Final = 2.0
# Time for a client to confirm the end of its WebSocket.
CLOSE_TIMEOUT: Final = 2.0
# [Web] Time without a sign of life of a client
# At it: it is disconnected, after up to 10 s more
# Told in: log
# Why: Half of it after a ping; it may have left the Wi-Fi.
PING_INTERVAL: Final = 20.0
# [Web] Time for a client's message to arrive, with all its fragments
# At it: it is disconnected, after up to 10 s more
# Told in: the close reason, `rmpa_web_refused_total`, log
# Why: The largest one at 5 Mbit/s.
MESSAGE_TIMEOUT: Final = 120.0
# Bytes in the connection's own buffer above which nothing more is written to it.
WRITE_BUFFER: Final = 64 * KIB
# Shortest time between two texts to a client on the messages that it misses.
DROPS_SHOWN: Final = 1.0

# --- Foxglove WebSocket -----------------------------------------------------------------------------------------
# [Foxglove] Bytes of a JSON message
# At it: it is refused
# Told in: status
# Why: The longest name the parameters that a client wants.
FOXGLOVE_TEXT_MAX: Final = 1 * MIB
# [Foxglove] Bytes of a binary message: one that is published, or a call
# At it: it is refused
# Told in: status
# Why: An image or a map that a client publishes.
FOXGLOVE_BINARY_MAX: Final = 64 * MIB
# [Foxglove] Subscriptions
# At it: further ones are refused
# Told in: status
# Why: Each has a queue of its own.
FOXGLOVE_SUBSCRIPTIONS_MAX: Final = 4096
# [Foxglove] Topics that it publishes
# At it: further ones are refused
# Told in: status
# Why: Each is a publisher in the graph.
FOXGLOVE_ADVERTISED_MAX: Final = 256
# [Foxglove] Service calls under way
# At it: further ones fail
# Told in: the call's failure
FOXGLOVE_CALLS_MAX: Final = 256
# [Foxglove] Parameters that one message names, or that are followed by name
# At it: the message is refused; all can be asked for at once
# Told in: status
FOXGLOVE_PARAMETERS_MAX: Final = 4096
# [Foxglove] Requests for parameters under way
# At it: further ones are refused
# Told in: status
FOXGLOVE_PARAMETER_REQUESTS_MAX: Final = 64
# [Foxglove] Lists and maps within each other in a parameter
# At it: it is refused
# Told in: status
# Why: As XML-RPC values are bounded.
FOXGLOVE_PARAMETER_DEPTH_MAX: Final = 32
# [Foxglove] Assets that are being fetched
# At it: further ones are refused
# Told in: the asset's failure
FOXGLOVE_ASSETS_MAX: Final = 16
# [Foxglove] Bytes of an asset
# At it: it is refused
# Told in: the asset's failure
# Why: The mesh of a large robot has some 20 MB.
FOXGLOVE_ASSET_MAX: Final = 64 * MIB
# [Foxglove] Characters of a name, type, encoding or asset's URI
# At it: the message is refused
# Told in: status
FOXGLOVE_NAME_MAX: Final = 1024
# Characters of schemas in one advertise message; further channels go into further messages.
FOXGLOVE_ADVERTISE_BYTES: Final = 256 * KIB
# Status messages a second for errors of one client, in the long run.
FOXGLOVE_STATUS_RATE: Final = 5.0
# [Foxglove] Errors at once
# At it: further ones are reported five times a second; a malformed message ends the connection
# Told in: the close reason
# Why: Beyond that and the rate, what a client may not do is refused without a status: it does not speak the protocol.
FOXGLOVE_STATUS_BURST: Final = 100.0

# --- /metrics -----------------------------------------------------------------------------------------------------
# [Web] Peers in `/metrics`
# At it: others are left out
# Told in: `rmpa_metrics_omitted`
# Why: Each with some fifteen time series.
METRIC_PEERS: Final = 1024
# [Web] Routes in `/metrics`
# At it: others are left out
# Told in: `rmpa_metrics_omitted`
# Why: Each with some twenty time series; a module of 300 topics and three peers has some 1,000.
METRIC_ROUTES: Final = 2000
# [Web] Services in `/metrics`
# At it: others are left out
# Told in: `rmpa_metrics_omitted`
# Why: Each with some six time series.
METRIC_SERVICES: Final = 1000
# Counters of what was refused or dropped in /metrics; there are some hundred.
METRIC_REASONS: Final = 256
# Characters of a label's value in /metrics, which Prometheus keeps with each time series.
METRIC_LABEL_CHARACTERS: Final = 256

# --- REST ---------------------------------------------------------------------------------------------------------
# [Web] Characters of a path of the REST API
# At it: 404
# Told in: the response
# Why: A name of 512 characters, percent-encoded.
REST_PATH_MAX: Final = 2048

# --- HTTP server --------------------------------------------------------------------------------------------------
# [Web] Connections of all clients
# At it: the one without a request for longest is closed
# Told in: `rmpa_web_refused_total`, log
# Why: A browser has six, Prometheus one. Each takes some 10 KiB and a file descriptor, and a WebSocket one more.
WEB_CONNECTIONS_MAX: Final = 256
# [Web] Bytes of a request line
# At it: 400
# Told in: the response, `rmpa_web_refused_total`, log
# Why: Twice the longest path of the API, for a token behind it.
WEB_LINE_MAX: Final = 4096
# [Web] Bytes of a header
# At it: 400
# Told in: the response, `rmpa_web_refused_total`, log
# Why: A browser sends the cookies of all servers of one host.
WEB_FIELD_MAX: Final = 8 * KIB
# [Web] Headers of a request
# At it: 400
# Told in: the response, `rmpa_web_refused_total`, log
# Why: Browsers send some 20.
WEB_HEADERS_MAX: Final = 64
# [Web] Bytes that a connection sends before it gets a response
# At it: it is closed
# Told in: `rmpa_web_refused_total`, log
# Why: A request, or several in a row.
WEB_REQUEST_MAX: Final = 32 * KIB
# [Web] Time for a request to arrive
# At it: its connection is closed
# Told in: `rmpa_web_refused_total`, log
# Why: From its first byte or, for the first one, from the connection on.
WEB_REQUEST_TIMEOUT: Final = 10.0
# [Web] Time for its response
# At it: its connection is closed
# Told in: `rmpa_web_refused_total`, log
# Why: From a request to the end of its response; a client that does not read is disconnected then.
WEB_RESPONSE_TIMEOUT: Final = 30.0
# Seconds that a connection is kept without a request; Prometheus asks every 15 to 60 s.
WEB_IDLE_TIMEOUT: Final = 75.0
# [Web] Topics, and services, in what `rmpa web` reads again and again
# At it: further ones that nothing here uses are left out; `/api/v1` has them
# Told in: the pages, `rmpa_metrics_omitted`
# Why: The monitor and /metrics show no more of them, and each takes the agent 0.03 ms.
WEB_TOPICS: Final = 2000
# Seconds that a snapshot of which nothing is left out is shared; the API alone asks for it.
WEB_WHOLE_AGE: Final = 2.0
# Seconds that a snapshot is shared before the agent is asked again: less than the monitor's pause between two.
WEB_SNAPSHOT_AGE: Final = 0.1
# [Web] Time for the agent to answer `rmpa web`
# At it: it counts as away
# Told in: the response, `rmpa_up`, log
# Why: It takes milliseconds, and Prometheus waits for 10 s.
WEB_AGENT_TIMEOUT: Final = 2.0
# [Web] Characters of a token of the user's own, at least (`web.token_file`)
# At it: it is refused
# Told in: error at start
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
# [Pages] Bytes of one message of a page: a call, or a parameter
# At it: its connection is made anew
# Told in: the line at the top of the page
REQUEST_MAX: Final = 64 * KIB
# [Pages] Messages of one page a second, in the long run
# At it: its connection is made anew
# Told in: the line at the top of the page
# Why: A joystick sends 10, acknowledgements 7.
REQUEST_RATE: Final = 50.0
# Messages of one client at once: a page that reconnects and asks for all that it shows.
REQUEST_BURST: Final = 200.0
# Things whose details one client is shown at one time; a page shows one or two.
LOOKS_MAX: Final = 4
# [Pages] Live topics of one page
# At it: a further one is refused
# Told in: the page
WATCHES_MAX: Final = 16
# [Pages] Values, images and scans of one topic a second
# At it: the newest is shown
WATCH_RATE_MAX: Final = 10.0
# [Pages] Lines of one plot
# At it: the first one is replaced
# Told in: the page
# Why: As many as can be told apart.
FIELDS_MAX: Final = 8
# [Pages] Questions of one page under way (*Why?*, calls, parameters)
# At it: a further one is refused
# Told in: the page
ASKS_MAX: Final = 16
# Samples of a plot in one message. Of more, the least and the greatest of each part are kept.
POINTS_MAX: Final = 64
# [Pages] Characters of a text in a live value
# At it: the rest is cut
# Told in: the value
VALUE_CHARACTERS: Final = 512
# [Pages] Elements of an array in a live value
# At it: the rest is cut
# Told in: the value
VALUE_ITEMS: Final = 64
# Values in one live value, all levels together.
VALUE_NODES: Final = 2000
# [Pages] Ranges of a laser scan
# At it: of neighbours the nearest is shown
# Why: Two a degree.
SCAN_POINTS: Final = 720
# [Pages] Pixels of a raw image
# At it: every n-th row and column is shown
# Told in: the size below the image
IMAGE_PIXELS: Final = 320 * 240
# [Pages] Topics
# At it: further ones are counted; `rmpa topic list` has them
# Told in: the page of all topics
TOPICS_SHOWN: Final = 2000
# [Pages] Services
# At it: further ones are counted; `rmpa topic list` has them
# Told in: the page of all services
SERVICES_SHOWN: Final = 2000
# Nodes in a state; further ones are counted.
NODES_SHOWN: Final = 2000
# [Pages] Modules
# At it: further ones are counted; `rmpa topic list` has them
# Told in: the page of the mesh
# Why: A ring of more could not be read.
MODULES_SHOWN: Final = 256
# [Pages] Lines of the log
# At it: the oldest are forgotten
LOG_LINES: Final = 500
# [Pages] Characters of one of them
# At it: the rest is cut
LOG_CHARACTERS: Final = 1024
# Time after the start of this module's agent in which peers that it has not found yet do not count as lost: beacons
# come every 5 s at the latest, and links take seconds where names or addresses are resolved.
AGENT_SETTLES: Final = 10.0
# [Pages] Time for which a module that is gone is shown
# At it: it leaves the ring
FORGET_AFTER: Final = 600.0
# Seconds that an order of a page may be old: less than the page waits for a word before it gives all up.
ORDER_AGE: Final = 5.0
# [Pages] Time after a joystick's last command
# At it: the robot is stopped
# Why: A joystick sends every 0.1 s.
DRIVE_TIMEOUT: Final = 0.3
# How often the server of the page that has the stick tells other servers; a second may lose two of them.
STICK_RENEW: Final = 0.5
# [Pages] Time without a word of the server whose page has the stick
# At it: the stick is free
# Why: It tells it every 0.5 s.
STICK_EXPIRY: Final = 2.0
# Magnitude of a linear speed that a joystick may command, m/s.
DRIVE_SPEED: Final = 2.0
# Magnitude of an angular speed that a joystick may command, rad/s.
DRIVE_TURN: Final = 4.0
# [Pages] Smart Resources that are followed
# At it: others are not shown
# Why: Paths of them; each is up to nine subscriptions.
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


# [Rosbridge] Bytes of a frame in JSON
# At it: it is refused
# Told in: status
# Why: And so of a message that a client publishes; rosbridge_suite's default.
FRAME_MAX: Final = 10 * MIB
# [Rosbridge] Bytes of a frame in CBOR
# At it: it is refused
# Told in: status
# Why: Each byte may be a value, which takes up to 64 bytes.
BINARY_FRAME_MAX: Final = 2 * MIB
# [Rosbridge] Objects and lists in a frame in JSON
# At it: it is refused
# Told in: status
# Why: An empty object has two characters and takes 64 bytes.
CONTAINERS_MAX: Final = 200_000
# [Rosbridge] Characters of an `id`
# At it: the frame is refused
# Told in: status
# Why: It is sent back and kept.
ID_MAX: Final = 1 * KIB
# [Rosbridge] Characters of a topic's, service's or type's name
# At it: the frame is refused
# Told in: status
NAME_MAX: Final = 1 * KIB
# [Rosbridge] Fragments of a message
# At it: they are refused
# Told in: status
# Why: Sent or received: a fragment of one character would need 100 bytes around it.
FRAGMENTS_MAX: Final = 10_000
# [Rosbridge] Bytes of all incomplete messages
# At it: the oldest one is dropped; a longer one is refused
# Told in: status
FRAGMENTED_MAX: Final = 16 * MIB
# Incomplete messages of a client; the oldest is dropped.
FRAGMENTED_MESSAGES_MAX: Final = 16
# [Rosbridge] Time for a topic to appear that is subscribed to without a type
# At it: the subscription is refused
# Told in: status
# Why: It may begin at the same moment.
TYPE_WAIT: Final = 2.0
# [Rosbridge] Time for the next fragment
# At it: the message is forgotten
# Told in: status
FRAGMENT_TIMEOUT: Final = 60.0
# [Rosbridge] Bytes that a `png` unpacks to
# At it: it is refused
# Told in: status
# Why: Its lines may have filters, which are undone in Python.
PNG_MAX: Final = 4 * MIB
# [Rosbridge] Subscribed topics
# At it: further ones are refused
# Told in: status
# Why: A page that shows all topics of some large modules stays below.
SUBSCRIPTIONS_MAX: Final = 1000
# [Rosbridge] Ids of one topic
# At it: further ones are refused
# Told in: status
# Why: Of one client that subscribe to one topic, or advertise it.
SUBSCRIBERS_MAX: Final = 100
# [Rosbridge] `queue_length`
# At it: a larger one is lowered
QUEUE_MESSAGES_MAX: Final = 1000
# [Rosbridge] Advertised topics
# At it: further ones are refused
# Told in: status
ADVERTISED_MAX: Final = 500
# [Rosbridge] Open calls
# At it: further ones are refused
# Told in: status
# Why: Without an answer yet, questions of rosapi included.
CALLS_MAX: Final = 1000
# [Rosbridge] Advertised services
# At it: further ones are refused
# Told in: status
SERVED_MAX: Final = 200
# [Rosbridge] Open calls to these
# At it: further ones are refused
# Told in: status
REQUESTS_MAX: Final = 1000
# Messages kept in the form in which they were sent, for further clients of the same topic.
SHARED_FRAMES: Final = 64
# Bytes of these; larger messages are converted for each client.
SHARED_BYTES: Final = 16 * MIB
# [Rosbridge] Lists and objects within each other in a parameter
# At it: it is refused
# Told in: status
# Why: Beyond, other nodes' XML-RPC libraries give up.
PARAMETER_DEPTH_MAX: Final = 32
# Characters of a status message.
TEXT_MAX: Final = 500
