"""Limits and time-outs of the process: descriptors, threads, garbage collection, logging.

Each has its reason beside it. Seconds and bytes, unless the name says otherwise.
"""

from __future__ import annotations

from typing import Final

from rmpa.core.sizes import KIB, MIB

# --- process ----------------------------------------------------------------------------------------------------
OPEN_FILES: Final = 1_048_576
"""File descriptors that an agent asks for: the hard limit, but no more than the kernel's own default (fs.nr_open).
Containers have hard limits of 10^9, and some old programs close every number at their start."""
DESCRIPTORS_RESERVED: Final = 64
"""Descriptors that data connections must leave free: half for the core, half for the links and the control socket.
16 peers that reconnect at once take 32."""
DESCRIPTORS_RESERVED_PART: Final = 4
"""The reserve is at most the descriptor limit divided by this: 16 of 64."""
DESCRIPTORS_TOLD: Final = 10.0
"""How long after a refusal for want of a descriptor the user is told of it."""
DESCRIPTORS_NEAR: Final = 0.8
"""Users are warned above this share of the descriptors that are not in the reserve."""
DESCRIPTORS_COUNT_SHARE: Final = 100
"""The pause after a count of all open descriptors, in multiples of the time that the count took."""
ACCEPTS: Final = 16
"""Connections that one listening socket accepts in one callback, 15 microseconds each."""
ACCEPT_PAUSE: Final = 0.5
"""Pause before a server without a free descriptor tries again to accept; an attempt costs some 10 microseconds."""
THREAD_SWITCH: Final = 1e-4
"""The interpreter's switch interval (``sys.setswitchinterval``). While another thread parses XML, the loop is 3 ms
late (p50) with Python's default of 5 ms, and 0.16 ms late with this value."""
COLLECT_LOOK: Final = 0.25
"""Time from the moment at which many objects are noticed to the check for cyclic garbage."""
COLLECT_LOOK_IDLE: Final = 5.0
"""Period of these checks while few objects survive: only the growth of the heap is then to be noticed."""
COLLECT_LOOK_AGAIN: Final = 0.02
"""Interval after a check that found many objects. Messages in transit are freed by then, and several small
collections pause the loop less than one large collection."""
COLLECT_YOUNG: Final = 300
"""Objects that survived since the last collection, from which on a collection is due: those of 40 XML-RPC calls,
which take some 0.1 ms to collect."""
COLLECT_BURST: Final = 1000
"""Objects made since the last collection, from which on a collection is due at a yield of long work; it takes some
0.1 ms."""
COLLECT_GROWTH: Final = 50_000
"""Growth of the heap in memory blocks, some 5 MB, that makes a full collection due while no data flows."""
COLLECT_GROWTH_MAX: Final = 500_000
"""Growth of the heap in memory blocks, some 50 MB, that makes a full collection due even while data flows (10 ms)."""
COLLECT_REST: Final = 2.0
"""Seconds without data and with few new objects, after which all objects may be scanned (0.1 s at 20,000 topics)."""
TRIM_GROWTH: Final = 8 * MIB
"""Growth of resident memory after which free memory is returned to the kernel at rest (19 MB took 3 ms)."""
TRIM_FREED: Final = 20_000
"""Memory blocks freed, some 2 MB, after which free memory is returned too: a hundred links that were parked."""
COLLECT_QUIET_BYTES: Final = 16 * KIB
"""Bytes a second, over all links, below which the agent counts as idle: keepalives or very slow streams."""

# --- the kernel's TCP sockets -----------------------------------------------------------------------------------
SOCK_DIAG_BUFFER: Final = 64 * KIB
"""One part of a dump; the kernel makes parts of at most 32 KiB."""
SOCK_DIAG_DUMPS: Final = 3
"""Dumps that are tried one after the other while each is interrupted by a change of the kernel's table."""

# --- mesh -------------------------------------------------------------------------------------------------------
STALE_AGE: Final = 0.1
"""Delay beyond which a best-effort message (held up by an outage) is dropped if a newer one of its topic follows."""
DRAIN_TIMEOUT: Final = 1.0
"""How long an agent that ends waits for its last bytes to be sent."""
MESH_BACKLOG: Final = 256
"""Connections that the kernel holds until they are accepted (``net.core.somaxconn`` bounds it): all peers of a
restarted agent dial at once. As many as may be without a finished handshake then; a further peer dials again."""
MESH_PORT_ATTEMPTS: Final = 32
"""Attempts to find a port number that is free for both TCP and UDP; the first one nearly always succeeds."""

# --- logging ----------------------------------------------------------------------------------------------------
LOG_WAITING: Final = 10_000
"""Log lines that wait while the reader of the log does not read: some 1 MB. Beyond it the newest lines are lost."""
LOG_GATHER: Final = 0.01
"""Log lines are gathered for this long before they are written, so that a burst costs one system call."""
LOG_BATCH: Final = 1000
"""Log lines in one write."""
