"""Limits and time-outs of the process: descriptors, threads, garbage collection, logging.

Each has its reason beside it. Seconds and bytes, unless the name says otherwise.
"""

from __future__ import annotations

from typing import Final

from rmpa.core.limits import KIB

# [Agent] Open files that the agent asks for
# At it: it gets as many as the hard limit allows (`LimitNOFILE=` of systemd, `ulimit -Hn`); if none is left, new
#   connections wait
# Told in: `doctor`, `why`, diagnostics, log
# Why: The kernel's own default (fs.nr_open). Containers have hard limits of 10^9, and some old programs close every
#   number at their start.
OPEN_FILES: Final = 1_048_576
# [Agent] Of these, reserved for the core, links and the control socket; a quarter of a limit below 256
# At it: data connections wait; listening sockets of proxies leave twice as many free
# Told in: `doctor`, `why`, diagnostics, log
# Why: Half for the core, half for the links and the control socket. 16 peers that reconnect at once take 32.
DESCRIPTORS_RESERVED: Final = 64
# The reserve is at most the descriptor limit divided by this: 16 of 64.
DESCRIPTORS_RESERVED_PART: Final = 4
# How long after a refusal for want of a descriptor the user is told of it.
DESCRIPTORS_TOLD: Final = 10.0
# Users are warned above this share of the descriptors that are not in the reserve.
DESCRIPTORS_NEAR: Final = 0.8
# The pause after a count of all open descriptors, in multiples of the time that the count took.
DESCRIPTORS_COUNT_SHARE: Final = 100
# Connections that one listening socket accepts in one callback, 15 microseconds each.
ACCEPTS: Final = 16
# Pause before a server without a free descriptor tries again to accept; an attempt costs some 10 microseconds.
ACCEPT_PAUSE: Final = 0.5
# The interpreter's switch interval (``sys.setswitchinterval``). While another thread parses XML, the loop is 3 ms
# late (p50) with Python's default of 5 ms, and 0.16 ms late with this value.
THREAD_SWITCH: Final = 1e-4
# Objects made and not freed since the last collection of young garbage, from which on another one is due: 1 ms at
# most, mostly 0.1 ms. Every fifth takes the next generation too; all objects but the frozen ones are scanned after
# 500,000, if a quarter of them is new (20 ms at 5,000 topics).
COLLECT_THRESHOLDS: Final = (1000, 5, 100)

# One part of a dump; the kernel makes parts of at most 32 KiB.
SOCK_DIAG_BUFFER: Final = 64 * KIB
# Dumps that are tried one after the other while each is interrupted by a change of the kernel's table.
SOCK_DIAG_DUMPS: Final = 3

# [Messages] Time for which an outage may delay a message of a topic with a `depth` of 1, as velocity commands have by
#   default
# At it: it is dropped if a newer one follows
# Told in: `topic info` (*lost*), `message.stale`
# Why: A robot is to follow the present command, not each one of the last second.
STALE_AGE: Final = 0.1
# How long an agent that ends waits for its last bytes to be sent.
DRAIN_TIMEOUT: Final = 1.0
# Connections that the kernel holds until they are accepted (``net.core.somaxconn`` bounds it): all peers of a
# restarted agent dial at once. As many as may be without a finished handshake then; a further peer dials again.
MESH_BACKLOG: Final = 256
# Attempts to find a port number that is free for both TCP and UDP; the first one nearly always succeeds.
MESH_PORT_ATTEMPTS: Final = 32

# Log lines that wait while the reader of the log does not read: some 1 MB. Beyond it the newest lines are lost.
LOG_WAITING: Final = 10_000
# Log lines are gathered for this long before they are written, so that a burst costs one system call.
LOG_GATHER: Final = 0.01
# Log lines in one write.
LOG_BATCH: Final = 1000
# [Resources] Bytes of the log of a program that the agent or a resource has started
# At it: it becomes `NAME.log.1`, which has the place of the one before
# Told in: `resource log`
PROGRAM_LOG_MAX: Final = 2 * 1024 * KIB
# Bytes of such a log that one answer has, and of one line in it.
PROGRAM_LOG_READ: Final = 64 * KIB
PROGRAM_LOG_LINE: Final = 4 * KIB
# Seconds between two looks whether a log has to be rotated.
PROGRAM_LOG_LOOK: Final = 2.0
