"""Limits and time-outs of the process: descriptors, threads, garbage collection, logging.

Each has its reason beside it. Seconds and bytes, unless the name says otherwise.
"""

from __future__ import annotations

from typing import Final

from rmpa.core.sizes import KIB

# --- process ----------------------------------------------------------------------------------------------------
OPEN_FILES: Final = 1_048_576
"""File descriptors that an agent asks for: the hard limit, but no more than the kernel's own default (fs.nr_open).
Containers have hard limits of 10^9, and some old programs close every number at their start."""
DESCRIPTORS_RESERVED: Final = 64
"""Descriptors that connections for data must leave free, for the core (half of them), the links and the control
socket: 16 peers that come back take 32."""
DESCRIPTORS_RESERVED_PART: Final = 4
"""The reserve is at most one in so many of all: of 64 descriptors 16."""
DESCRIPTORS_QUIET: Final = 2.0
"""A shortage is over after this time without a refusal, if there is room."""
DESCRIPTORS_TELL: Final = 60.0
"""Shortest time between two log lines about shortages of one kind."""
DESCRIPTORS_NEAR: Final = 0.8
"""Users are warned above this share of the descriptors that are not in the reserve."""
DESCRIPTORS_COUNT_SHARE: Final = 100
"""The pause after a count of all open descriptors, in multiples of the time that the count took."""
ACCEPTS: Final = 16
"""Connections that one listening socket accepts in one callback, 15 microseconds each."""
ACCEPT_PAUSE: Final = 0.5
"""Pause of a server that has no descriptor for a connection; a new attempt costs some 10 microseconds."""
THREAD_SWITCH: Final = 1e-4
"""The interpreter's switch interval (``sys.setswitchinterval``). Beside a thread that parses XML the loop is 3 ms
late (p50) with Python's own 5 ms, and 0.16 ms with this."""
COLLECT_LOOK: Final = 0.25
"""Interval of the checks for cyclic garbage."""
COLLECT_LOOK_AGAIN: Final = 0.02
"""Interval after a check that found many objects: passing messages are freed by then, and several small collections
pause the loop less than one large one."""
COLLECT_YOUNG: Final = 300
"""Surviving objects since the last collection that make one due: those of 40 XML-RPC calls, some 0.1 ms."""
COLLECT_BURST: Final = 1000
"""Objects made since the last collection that make one due at a yield of long work: a tenth of a millisecond."""
COLLECT_GROWTH: Final = 50_000
"""Growth of the heap in memory blocks, some 5 MB, that makes a full collection due while no data flows."""
COLLECT_GROWTH_MAX: Final = 500_000
"""Growth of the heap in memory blocks, some 50 MB, that makes a full collection due even while data flows (10 ms)."""
COLLECT_QUIET_BYTES: Final = 16 * KIB
"""No data flows below this many bytes a second over all links: these are keepalives, or very slow streams."""

# --- mesh -------------------------------------------------------------------------------------------------------
STALE_AGE: Final = 0.1
"""A best-effort message that was on its way for longer (a cable was out) gives way to a newer one behind it."""
DRAIN_TIMEOUT: Final = 1.0
"""How long an agent that ends waits until its last bytes are sent."""
MESH_BACKLOG: Final = 64
"""Connections that the kernel holds until we accept them: all peers of a restarted agent dial at once."""
MESH_PORT_ATTEMPTS: Final = 32
"""Tries to find a number that is free for TCP and UDP both; the first nearly always is."""

# --- logging ----------------------------------------------------------------------------------------------------
LOG_WAITING: Final = 10_000
"""Lines that wait for a log reader that has stopped: some 1 MB. Beyond it the newest are lost."""
LOG_GATHER: Final = 0.01
"""Lines are gathered for this long before they are written: a burst costs one system call."""
LOG_BATCH: Final = 1000
"""Lines in one such call."""
