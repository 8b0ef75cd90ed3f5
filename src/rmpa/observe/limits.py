"""Limits and time-outs of snapshot, control socket, ``/diagnostics`` and doctor.

Each has its reason beside it. Seconds and bytes, unless the name says otherwise.
"""

from __future__ import annotations

from typing import Final

from rmpa.core.sizes import MIB

# --- control socket, snapshot, /diagnostics ------------------------------------------------------------------------
CONTROL_REQUEST_MAX: Final = 1 * MIB
"""One request; the longest names the topics that a client wants."""
CONTROL_REPLY_MAX: Final = 64 * MIB
"""One reply: the snapshot of a very large graph."""
CONTROL_CLIENTS_MAX: Final = 32
"""Simultaneous clients of the control socket."""
CONTROL_IDLE_TIMEOUT: Final = 60.0
"""A connection without a request for this long is closed."""
CONTROL_CALL_TIMEOUT: Final = 10.0
"""For one call of a client: a stopped agent must not hang the command line."""
CONTROL_LOOK_TIMEOUT: Final = 1.0
"""For a connection that only shows whether an agent lives; the kernel accepts it even for a stopped one."""
CONTROL_BACKLOG: Final = 128
"""Connections that wait to be accepted; the kernel refuses further ones at once."""
CONTROL_PINGS_MAX: Final = 100
"""Pings of one call, which must end within its time-out. The command line asks for one at a time."""
CONTROL_HANDLER_TIMEOUT: Final = 30.0
"""For an operation in the agent; ``rmpa why`` waits for peers."""
CONTROL_PATH_MAX: Final = 107
"""Bytes in a UNIX socket's path: Linux's sun_path less its final zero."""
CPU_INTERVAL: Final = 1.0
"""The least time over which the agent's CPU share is measured; the kernel counts in ticks of 10 ms."""
DIAGNOSTICS_INTERVAL: Final = 1.0
"""Between two messages on /diagnostics, as diagnostic_updater has it; peers' clocks are recorded as often."""
DIAGNOSTICS_STALE: Final = 60.0
"""For this long a peer that is gone and its topics are shown as stale on /diagnostics."""
DIAGNOSTICS_QUEUE: Final = 10
"""Messages that wait for a slow subscriber of /diagnostics; a newer one repeats all of an older one."""

# --- doctor -----------------------------------------------------------------------------------------------------
DOCTOR_HEAR: Final = 1.0
"""For a multicast packet to come back to its sender; where it comes at all, it takes less than a millisecond."""
DOCTOR_PROGRAM: Final = 5.0
"""For a program of the system (nft, iptables)."""
DOCTOR_NAME: Final = 5.0
"""For the resolver: it waits 5 s for a dead name server."""
DOCTOR_OUTPUT_MAX: Final = 4 * MIB
"""Output of such a program; the rules of a Kubernetes node have some 100 KB."""
DOCTOR_FILES_LOW: Final = 4096
"""A limit of open files that is too low for a large graph: each subscriber takes one, and a proxy two where proxies
cannot share their sockets."""
DOCTOR_CLOCK_LOOK: Final = 0.3
"""For watching both clocks, to see the wall clock being set."""
DOCTOR_CLOCK_STEP: Final = 0.005
"""That the wall clock may move against the monotonic one meanwhile; slewing makes 0.15 ms."""
DOCTOR_CLOCK_APART: Final = 0.02
"""Between the clocks of two modules, from which on tf complains: two periods of a 100 Hz transform."""

# --- why --------------------------------------------------------------------------------------------------------
WHY_WINDOW: Final = 1.0
"""Between the two looks of ``rmpa why`` at what flows: a topic of some messages a second has moved by then."""
WHY_TIMEOUT: Final = 12.0
"""For a peer's own walk: its window, and two questions to us of ASK_TIMEOUT each at the worst."""
WHY_SILENT: Final = 2.0
"""A topic that was silent for less than this is not called so, whatever its rate."""
WHY_SILENT_PERIODS: Final = 10.0
"""In its own longest usual periods, likewise."""
WHY_PROBE: Final = 2.0
"""For a service's server to answer a probe: it is on the same machine as the agent that asks."""
WHY_SOURCES_MAX: Final = 64
"""Publishers of one topic in one module that ``rmpa why`` tells of."""
