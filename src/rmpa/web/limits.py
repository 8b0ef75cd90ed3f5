"""Bounds and time-outs of the hub, its clients and the HTTP server; in seconds and bytes unless stated otherwise."""

from __future__ import annotations

from typing import Final

from rmpa.core.limits import KIB, MIB

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
# Messages of which it is kept what was made of them, for further clients of the same topic.
MADE_KEPT: Final = 64
# Bytes of the frames of rosbridge and their messages that are kept so; larger messages are converted for each client.
FRAMES_KEPT_BYTES: Final = 16 * MIB
# Bytes of the messages whose values are kept so; values take some ten times as much.
VALUES_KEPT_BYTES: Final = 4 * MIB
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
# [Web] Characters of a path of the REST API
# At it: 404
# Told in: the response
# Why: A name of 512 characters, percent-encoded.
REST_PATH_MAX: Final = 2048
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
# Frames of the tree of transforms that clients ask about; a humanoid has some 100.
FRAMES_MAX: Final = 5000
# [Web] Streams of pictures, `/stream`
# At it: further ones get 429
# Told in: the response
# Why: Each takes a connection, and some of a core for raw images.
STREAMS_MAX: Final = 32
# [Web] Pictures of a stream a second
# At it: the newest are sent
STREAM_RATE_MAX: Final = 30.0
# [Web] Width and height that are asked of a stream or snapshot, in pixels
# At it: 400
# Told in: the response
PICTURE_SIDE_MAX: Final = 4096
# [Web] Pixels of an image that is encoded
# At it: 415
# Told in: the response
# Why: They take some bytes each; cameras have up to 50 million.
PICTURE_PIXELS_MAX: Final = 64_000_000
# [Web] Time for the first picture
# At it: a snapshot gets 504; a stream waits on
# Told in: the response
PICTURE_WAIT: Final = 5.0
# Pictures that are encoded at one time, each in a thread: the event loop keeps a core.
ENCODERS: Final = 2
# Bytes that the kernel holds of a stream beyond those on their way: the next picture is chosen late.
STREAM_UNSENT: Final = 64 * KIB
# [Web] Files of recordings that clients want at one time
# At it: further ones get 429
# Told in: the response
RECORDINGS_WAITING: Final = 8
# [Web] Time to make a file of a recording
# At it: it is not made
# Told in: the page
RECORDING_TIME: Final = 900.0
# [Web] Bytes of all files of recordings that are made for clients
# At it: the present one is not made
# Told in: the page
# Why: Of some modules, whose rings have half a gigabyte, once in parts and once merged.
RECORDING_BYTES: Final = 4096 * MIB
# [Web] Bytes of the disk that such files leave free
# At it: the present one is not made
# Told in: the page
# Why: The recorder of this module needs the disk more.
RECORDING_FREE: Final = 256 * MIB
# Recordings whose files are kept, and for how long after the last use of any.
RECORDINGS_CACHED: Final = 3
RECORDINGS_KEPT: Final = 600.0
# Seconds between two looks at a process that makes such a file.
RECORDING_LOOK: Final = 0.3
