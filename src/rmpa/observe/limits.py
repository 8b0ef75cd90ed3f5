"""Limits and time-outs of what agents show of themselves.

Each has its reason beside it. Seconds and bytes, unless the name says otherwise.
"""

from __future__ import annotations

from typing import Final

from rmpa.core.sizes import MIB

# --- monitor ----------------------------------------------------------------------------------------------------
CONTROL_REQUEST_MAX: Final = 1 * MIB
"""One request on the control socket."""
CONTROL_REPLY_MAX: Final = 64 * MIB
"""One reply: the snapshot of a very large graph."""
CONTROL_CLIENTS_MAX: Final = 32
"""Simultaneous clients of the control socket."""
CONTROL_IDLE_TIMEOUT: Final = 60.0
"""A client that asks nothing for this long is closed."""
CONTROL_CALL_TIMEOUT: Final = 10.0
"""For one call over the control socket; a stopped agent must not hang the command line."""
CONTROL_LOOK_TIMEOUT: Final = 1.0
"""For the connection by which a client sees whether an agent lives: the kernel takes it, even for a stopped one."""
CONTROL_BACKLOG: Final = 128
"""Clients with a time-out are refused by the kernel, not kept waiting, when these are taken."""
CONTROL_PINGS_MAX: Final = 100
"""Pings of one call: it must come to an end. The command line asks for one at a time."""
CONTROL_HANDLER_TIMEOUT: Final = 30.0
"""For the agent's own part of a call."""
CONTROL_PATH_MAX: Final = 107
"""Bytes in a UNIX socket's path: Linux's sun_path less its final zero."""
CPU_INTERVAL: Final = 1.0
"""Over at least so long the agent's use of the CPU is measured; the kernel counts it in ticks of 10 ms."""
DIAGNOSTICS_INTERVAL: Final = 1.0
"""Between two messages on /diagnostics, as ROS's own publishers have it; the links' clocks are followed as often."""
DIAGNOSTICS_STALE: Final = 60.0
"""For this long a peer that is gone, and what came from it, is shown as stale on /diagnostics."""
DIAGNOSTICS_QUEUE: Final = 10
"""Messages waiting for a slow reader of /diagnostics: each holds everything that the one before it did."""

# --- doctor -----------------------------------------------------------------------------------------------------
DOCTOR_HEAR: Final = 1.0
"""For a packet that an interface sends to ourselves; it takes less than a millisecond where it comes at all."""
DOCTOR_PROGRAM: Final = 5.0
"""For one of the system's programs (nft, iptables) to answer."""
DOCTOR_NAME: Final = 5.0
"""For the resolver to say what a host name is: a dead name server takes 5 s for each question."""
DOCTOR_OUTPUT_MAX: Final = 4 * MIB
"""Of such a program; the rules of a Kubernetes node have some 100 KB."""
DOCTOR_FILES_LOW: Final = 4096
"""Open files below which an agent of a large graph runs out: each subscriber takes one, and a proxy two where proxies
cannot share their sockets."""
DOCTOR_CLOCK_LOOK: Final = 0.3
"""Between two looks at both clocks, to see one being set."""
DOCTOR_CLOCK_STEP: Final = 0.005
"""Seconds that the wall clock may go apart from the monotonic one meanwhile; slewing makes 0.15 ms."""
DOCTOR_CLOCK_APART: Final = 0.02
"""Seconds between the clocks of two modules from which on tf complains: two periods of a 100 Hz transform."""
