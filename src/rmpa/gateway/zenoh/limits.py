"""Every bound of the gateway's Zenoh session, with unit and reason."""

from __future__ import annotations

from typing import Final

LEASE: Final = 1.0
"""Seconds without a sign of life after which a Zenoh transport counts as dead: with the other side's grace a frozen
site is gone within 1.5 s (measured: 1.2 s with a lease of 0.8 s, 1.6 s with one of 1.2 s). Zenoh sends a keep-alive
four times in that time, from a thread of its own, and any data counts too."""
BLOCK_MAX: Final = 5.0
"""Seconds that a query or a declaration may wait for a transport before Zenoh closes it: Zenoh's own value."""
DROP_WAIT: Final = 10.0
"""Seconds that a message, or each fragment of it, waits for room in a transport before Zenoh drops the message and,
at once, those behind it. One batch of Zenoh (64 KB) takes a line of 1 Mbit/s half a second, and longer where packets
are lost: with 1 s here a burst of 1,000 messages lost most of them, with 10 s none. Zenoh's own value, 1 ms, loses
what is large on every slow link. A dead transport ends by its lease. A put that blocks instead would end the link:
Zenoh closes a transport behind which one message, with all its fragments, waits for longer than ``BLOCK_MAX``."""
DROP_WAIT_MAX: Final = 300.0
"""Seconds that all fragments of a message may wait together: 32 MB at 1 Mbit/s."""
SEND_BUFFER: Final = 0.125
"""Seconds of the line's rate that the kernel's buffer of a connection holds, which counts them twice. In that buffer
there are no priorities: on 1 Mbit/s with images a command waited 2.7 s with Linux's own size, 0.3 s with this one,
and as many images came."""
SEND_BUFFER_MIN: Final = 4096
"""Bytes of that buffer at least: the kernel allows no less than about two packets."""
BATCH: Final = 0.0625
"""Seconds of the line's rate in one batch of Zenoh, which a message of a higher priority does not overtake."""
BATCH_MIN: Final = 2048
"""Bytes of a batch at least."""
BATCH_MAX: Final = 65_535
"""Bytes of a batch at most: Zenoh's own."""
UNSENT_BYTES: Final = 16_384
"""Bytes of one connection that the kernel may hold unsent (TCP_NOTSENT_LOWAT): a command does not overtake them.
On 1 Mbit/s with images a command waited 1.0 s with it and 3.4 s without it, both without ``uplink``."""
LOOK_AT_LINKS: Final = 2.0
"""Seconds between two looks at which connections Zenoh has, to bound what the kernel holds of new ones."""
RECONNECT_FIRST: Final = 0.2
"""Seconds before the first attempt to reach a router again."""
RECONNECT_MAX: Final = 2.0
"""Seconds between two later attempts at most; a router that was restarted is reached again within that time."""
RECONNECT_GROWTH: Final = 1.5
"""Factor between the waits of two attempts."""
TURN_MESSAGES: Final = 64
"""Messages of one publisher that are sent in one turn, while others of its priority wait."""
TURN_BYTES: Final = 65_536
"""Bytes of one publisher in one turn: one batch of Zenoh. One message always fits."""
ARRIVED_MESSAGES: Final = 10_000
"""Messages of one subscriber that wait for the event loop; above it the oldest is dropped, and counted. It is several
bursts of 1,000, and 30 ms of what the loop can take."""
ARRIVED_BYTES: Final = 64 * 1024 * 1024
"""Bytes of one subscriber that wait for the event loop; one message always fits. It is 64 images of 1 MB."""
ARRIVED_QUERIES: Final = 1_000
"""Queries of one queryable that wait for the event loop; above it the oldest is finished without an answer."""
ARRIVED_TOKENS: Final = 200_000
"""Changes of tokens of one watcher that wait for the event loop: a hundred sites of a thousand sources, twice."""
ZENOH_MESSAGE_MAX: Final = 257 * 1024 * 1024
"""Bytes of one message of Zenoh that are put together from its fragments: the largest of ROS, and its head. Zenoh's
own value is 1 GiB, which any program that connects could have this process hold."""
ATTACHMENT_MAX: Final = 4096
"""Bytes of an attachment; the longest that this gateway or ROS 2 writes has some 900. A message or query with a
longer one is dropped before it is stored, and counted as ``zenoh.attachment.long``."""
KEY_MAX: Final = 4096
"""Characters of the key of a message, token or query, and of a query's parameters; those of ROS names have at most
some 900. Longer ones are dropped, and counted as ``zenoh.key.long``."""
ARRIVED_TOKEN_BYTES: Final = 64 * 1024 * 1024
"""Characters of the tokens that wait for the event loop."""
REPLIES_MAX: Final = 20_000
"""Answers to one query; further ones are dropped, and counted as ``zenoh.reply.limit``. A gateway
asks for one answer of each gateway of a site."""
REPLY_BYTES_MAX: Final = 256 * 1024 * 1024
"""Bytes of all answers to one query; one answer always fits."""
ANSWER_BYTES_MAX: Final = 256 * 1024 * 1024
"""Bytes of answers that wait for Zenoh in all; one always fits. Above it a query ends without the answer, which is
counted as ``zenoh.answer.limit``: a client that asks and does not read must not fill the memory."""
ANSWERS_WAITING_MAX: Final = 20_000
"""Answers that wait for Zenoh in all, likewise."""
DRAIN_MESSAGES: Final = 256
"""Messages that the event loop takes before it looks at its other work: at most a millisecond or so."""
DRAIN_BYTES: Final = 8 * 1024 * 1024
"""Bytes that the event loop takes before it looks at its other work."""
BUSY_PERIOD: Final = 0.001
"""Seconds between two looks at what arrived while much arrives; the delay that a message may have then."""
BUSY_MESSAGES: Final = 8
"""Messages in ``BUSY_PERIOD`` from which on the loop is not woken for each: 8,000 a second."""
FLUSH_MAX: Final = 1.0
"""Seconds that a publisher which is closed may still send what waits."""
CLOSE_MAX: Final = 3.0
"""Seconds that closing a session may take before it is given up; its threads do not keep the process from ending."""
GET_GRACE: Final = 1.0
"""Seconds beyond a query's own time-out after which its answers are no longer waited for."""
