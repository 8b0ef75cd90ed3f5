"""Limits and time-outs of the process: descriptors, threads, garbage collection, logging.

Each has its reason beside it. Seconds and bytes, unless the name says otherwise.
"""

from __future__ import annotations

from typing import Final

from rmpa.core.sizes import KIB

# --- process ----------------------------------------------------------------------------------------------------
OPEN_FILES: Final = 1_048_576
"""File descriptors that a process which runs on asks for: as many as the hard limit allows, up to the kernel's own
default (fs.nr_open). Containers have hard limits of 10^9, and an old program that it starts closes each number."""
DESCRIPTORS_RESERVED: Final = 64
"""Descriptors that data leaves to the core (half of them), the links and the control socket: 16 peers that come back
take 32."""
DESCRIPTORS_RESERVED_PART: Final = 4
"""The reserve is no more than this part of all: of 64 descriptors 16."""
DESCRIPTORS_QUIET: Final = 2.0
"""Without a refusal, and with room, before a shortage of descriptors is over."""
DESCRIPTORS_TELL: Final = 60.0
"""Between two lines of the log about shortages of one kind, for those that come and go."""
DESCRIPTORS_NEAR: Final = 0.8
"""The share of those that are not in the reserve from which on a user is warned."""
DESCRIPTORS_COUNT_SHARE: Final = 100
"""Times as long as a count of all open descriptors took, before the next one."""
ACCEPTS: Final = 16
"""Connections that one listening socket accepts before the loop does something else, 15 microseconds each."""
ACCEPT_PAUSE: Final = 0.5
"""Before a server that has no descriptor for a connection looks again; a look costs some 10 microseconds."""
THREAD_SWITCH: Final = 1e-4
"""Seconds that a thread keeps the interpreter from one that waits for it. Beside a thread that parses XML the loop is
3 ms late (p50) with Python's own 5 ms, and 0.16 ms with this."""
COLLECT_LOOK: Final = 0.25
"""Between two looks how much cyclic garbage there may be."""
COLLECT_LOOK_AGAIN: Final = 0.02
"""The same after a look that found enough: messages on their way are gone by then, and many small portions hold the
loop for less than a large one."""
COLLECT_YOUNG: Final = 300
"""Objects that came to stay since the last collection, for the next: what 40 XML-RPC calls leave, some 0.1 ms."""
COLLECT_BURST: Final = 1000
"""The same in the midst of work that goes on: a tenth of a millisecond, whatever came to stay."""
COLLECT_GROWTH: Final = 50_000
"""Memory blocks by which the heap grew, some 5 MB, for a full collection while no data flows."""
COLLECT_GROWTH_MAX: Final = 500_000
"""The same, some 50 MB, for one that waits no longer; it takes about 10 ms."""
COLLECT_QUIET_BYTES: Final = 16 * KIB
"""A second, over all links: less than this are keepalives, or streams so slow that they hardly meet a pause."""

# --- mesh -------------------------------------------------------------------------------------------------------
STALE_AGE: Final = 0.1
"""A best-effort message that was on its way for longer (a cable was out) gives way to a newer one behind it."""
DRAIN_TIMEOUT: Final = 1.0
"""How long an agent that ends waits for its last bytes to leave."""
MESH_BACKLOG: Final = 64
"""Connections that the kernel holds until we accept them: all peers of a restarted agent dial at once."""
MESH_PORT_ATTEMPTS: Final = 32
"""Tries to find a number that is free for TCP and UDP both; the first nearly always is."""

# --- logging ----------------------------------------------------------------------------------------------------
LOG_WAITING: Final = 10_000
"""Lines that wait for a reader of the log who has stopped: some 1 MB. The newest are lost beyond it."""
LOG_GATHER: Final = 0.01
"""Lines are gathered for this long before they are written: a burst costs one system call."""
LOG_BATCH: Final = 1000
"""Lines in one such call."""
