"""Bounds and time-outs of one client of rosbridge; in seconds and bytes unless stated otherwise."""

from __future__ import annotations

from typing import Final

from rmpa.core.limits import KIB, MIB

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
# [Rosbridge] Lists and objects within each other in a parameter
# At it: it is refused
# Told in: status
# Why: Beyond, other nodes' XML-RPC libraries give up.
PARAMETER_DEPTH_MAX: Final = 32
# Characters of a status message.
TEXT_MAX: Final = 500
# [Rosbridge] Requests for transforms (tf2_web_republisher)
# At it: further ones are refused
# Told in: status, the call's failure
TF_REQUESTS_MAX: Final = 64
# [Rosbridge] Source frames of one of them
# At it: it is refused
# Told in: status, the call's failure
TF_FRAMES_MAX: Final = 1000
# [Rosbridge] Transforms a second of one of them
# At it: the newest are sent
TF_RATE_MAX: Final = 50.0
# Seconds that a request is kept whose topic has no subscriber, at least and at most, whatever the client asks for.
TF_TIMEOUT_MIN: Final = 1.0
TF_TIMEOUT_MAX: Final = 60.0
