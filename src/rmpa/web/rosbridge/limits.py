"""Bounds and time-outs of one rosbridge client, in seconds and bytes."""

from __future__ import annotations

from typing import Final

from rmpa.core.limits import KIB, MIB

FRAME_MAX: Final = 10 * MIB
"""One frame of a client, and so a message that it publishes, in JSON; rosbridge_suite's default."""
BINARY_FRAME_MAX: Final = 2 * MIB
"""One frame of a client in CBOR: each byte may be a value, which takes up to 64 bytes."""
CONTAINERS_MAX: Final = 200_000
"""Objects and lists in one frame in JSON: an empty object has two characters and takes 64 bytes."""
ID_MAX: Final = 1 * KIB
"""Characters of an ``id``, which is sent back and kept."""
NAME_MAX: Final = 1 * KIB
"""Characters of the name of a topic, service or type."""
FRAGMENTS_MAX: Final = 10_000
"""Fragments of one message, sent or received: a fragment of one character would need 100 bytes around it."""
FRAGMENTED_MAX: Final = 16 * MIB
"""Bytes of all incomplete messages of a client; the oldest incomplete message is dropped."""
FRAGMENTED_MESSAGES_MAX: Final = 16
"""Incomplete messages of a client; the oldest is dropped."""
TYPE_WAIT: Final = 2.0
"""Time for a topic to appear that is subscribed to without a type, as it may begin at the same moment."""
FRAGMENT_TIMEOUT: Final = 60.0
"""Time within which the next fragment of a message must arrive."""
PNG_MAX: Final = 4 * MIB
"""Bytes that a client's PNG unpacks to: its lines may have filters, which are undone in Python."""
SUBSCRIPTIONS_MAX: Final = 1000
"""Subscribed topics of a client; a page that shows all topics of some large modules stays below."""
SUBSCRIBERS_MAX: Final = 100
"""Ids of one client that subscribe to one topic, or advertise it."""
QUEUE_MESSAGES_MAX: Final = 1000
"""Largest ``queue_length`` of a subscription; larger ones are lowered to it."""
QUEUE_BYTES_MAX: Final = 4 * MIB
"""Bytes queued for a throttled subscription; the oldest are dropped, one message always fits."""
QUEUES_BYTES_MAX: Final = 16 * MIB
"""Bytes queued for all throttled subscriptions of a client; the newest message is dropped."""
ADVERTISED_MAX: Final = 500
"""Topics that a client advertises."""
CALLS_MAX: Final = 1000
"""Calls of a client without an answer yet, questions of rosapi included."""
SERVED_MAX: Final = 200
"""Services that a client offers."""
REQUESTS_MAX: Final = 1000
"""Calls to services that a client offers, without its answer yet."""
SHARED_FRAMES: Final = 64
"""Messages kept in the form in which they were sent, for further clients of the same topic."""
SHARED_BYTES: Final = 16 * MIB
"""Bytes of these; larger messages are converted for each client."""
PARAMETER_DEPTH_MAX: Final = 32
"""Lists and dictionaries within each other in a parameter; beyond, other nodes' XML-RPC libraries give up."""
TEXT_MAX: Final = 500
"""Characters of a status message."""
