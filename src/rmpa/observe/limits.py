"""Limits and time-outs of snapshot, control socket, ``/diagnostics`` and doctor.

Each has its reason beside it. Seconds and bytes, unless the name says otherwise.
"""

from __future__ import annotations

from typing import Final

from rmpa.core.limits import MIB

# Bytes of one request; the longest request names the topics that a client wants.
CONTROL_REQUEST_MAX: Final = 1 * MIB
# Bytes of a text that follows a request: a parameter.
CONTROL_TEXT_BYTES_MAX: Final = 17 * MIB
# [Agent] Bytes of an answer of the agent to a command
# At it: the command fails
# Told in: its error
# Why: The snapshot of a very large graph.
CONTROL_REPLY_MAX: Final = 64 * MIB
# [Agent] Commands that ask one agent at a time
# At it: further ones are refused
# Told in: their error
CONTROL_CLIENTS_MAX: Final = 32
# A connection without a request for this long is closed.
CONTROL_IDLE_TIMEOUT: Final = 60.0
# Time-out of one call of a client: a stopped agent must not block the command line.
CONTROL_CALL_TIMEOUT: Final = 10.0
# Time-out of a connection that only tests whether an agent runs; the kernel accepts it even for a stopped agent.
CONTROL_LOOK_TIMEOUT: Final = 1.0
# Pings of one call, which must end within its time-out. The command line asks for one at a time.
CONTROL_PINGS_MAX: Final = 100
# [Agent] Time for the agent's answer to a command
# At it: the command fails
# Told in: its error
# Why: ``rmpa why`` waits for peers.
CONTROL_HANDLER_TIMEOUT: Final = 30.0
# The longest wait for a change of the graph in one request: it must end within ``CONTROL_HANDLER_TIMEOUT``.
CONTROL_WAIT_MAX: Final = 25.0
# Changes of the graph that are kept for clients of ``graph``: the start of a large graph makes fewer while a slow
# client does not ask. A client that is further behind gets the whole graph. Some 0.5 MB.
GRAPH_HISTORY: Final = 4096
# [Agent] Bytes of the control socket's path
# At it: the agent does not start
# Told in: error at start
# Why: Linux's sun_path less its final zero.
CONTROL_PATH_MAX: Final = 107
# How long a peer that is gone, with its topics, is shown as stale on /diagnostics.
DIAGNOSTICS_STALE: Final = 60.0
# [Agent] Topics, and services, in `/diagnostics`
# At it: further ones that nothing here uses are left out
# Why: Each second it would take 0.03 ms for each of them, two thirds of a core with 20,000.
DIAGNOSTICS_TOPICS: Final = 2000

# [Agent] Statuses of `/diagnostics` that `rmpa diagnostics` and the page keep
# At it: of the publisher with the most, the oldest is forgotten
# Told in: both
DIAGNOSTICS_MAX: Final = 2000
# [Agent] Time without news after which a status is stale
# At it: it is shown as stale, with its last level
# Told in: `rmpa diagnostics`, the page of diagnostics
# Why: As rqt_robot_monitor has it; diagnostic_updater sends once a second.
DIAGNOSTIC_STALE: Final = 3.0
# How long a status without news is shown.
DIAGNOSTIC_FORGET: Final = 600.0
# [Agent] Messages of one publisher of `/diagnostics` a second, in the long run
# At it: further ones are left out
# Told in: `rmpa diagnostics`, the page of diagnostics
DIAGNOSTIC_RATE: Final = 20.0
# [Agent] Bytes of its messages a second, in the long run
# At it: further ones are left out
# Told in: `rmpa diagnostics`, the page of diagnostics
# Why: Reading them takes a tenth of a core.
DIAGNOSTIC_FLOW: Final = MIB
# How long it is said that a publisher of ``/diagnostics`` is heard in part.
DIAGNOSTIC_PROBLEM: Final = 30.0
# [Agent] Bytes of one message on `/diagnostics`
# At it: it is left out
# Told in: `rmpa diagnostics`, the page of diagnostics
# Why: 2,000 statuses of an agent are some 1.5 MB.
DIAGNOSTIC_BYTES: Final = 4 * MIB
# Values of a status; further ones are left out.
DIAGNOSTIC_VALUES: Final = 256
# Changes of a status' level that are remembered.
DIAGNOSTIC_LEVELS: Final = 32

# Time-out for a multicast packet to return to its sender; where that works, it takes less than a millisecond.
DOCTOR_HEAR: Final = 1.0
# Time-out of a program of the system (nft, iptables).
DOCTOR_PROGRAM: Final = 5.0
# Time-out of a command of ``--fix``: sudo waits for the password, and systemd 90 s for a unit.
DOCTOR_REPAIR: Final = 300.0
# Time-out of a name look-up: the resolver itself waits 5 s for a dead name server.
DOCTOR_NAME: Final = 5.0
# Peers of an agent that are listed one by one; of more, those with a problem are, and the others are counted.
DOCTOR_PEERS_LISTED: Final = 16
# How long both clocks are watched, to notice that the wall clock is set.
DOCTOR_CLOCK_LOOK: Final = 0.3

# Time between the two counts that ``rmpa why`` compares: a topic of some messages a second has moved by then.
WHY_WINDOW: Final = 1.0
# [Agent] Publishers of one topic that `rmpa why` reports
# At it: others are left out
WHY_SOURCES_MAX: Final = 64
# Seconds in which a core tells the addresses of its nodes; each takes a millisecond.
DOCTOR_NODES_TIMEOUT: Final = 2.0
# [Agent] Nodes of a core whose ports `rmpa doctor` checks
# At it: others are left out
# Why: So that the check ends in time.
DOCTOR_NODES_MAX: Final = 500
