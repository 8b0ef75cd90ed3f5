"""Limits and time-outs of Smart Resources, with their reasons; in seconds and bytes unless stated otherwise."""

from __future__ import annotations

from typing import Final

# [Resources] Characters in the request for one attribute
# At it: it is refused
# Told in: its response
REQUIREMENT_TEXT_MAX: Final = 1024
# [Resources] Input messages that wait for a task
# At it: the oldest is dropped
# Why: Control acts on the newest.
TASK_QUEUE_MESSAGES: Final = 10
# A change of profile waits so long for the runs under way; a run that takes longer is stuck or slow.
TASK_PAUSE_TIMEOUT: Final = 1.0
# [Resources] Time for an answer of a precondition
# At it: the profile is not used
# Told in: the resource's state
# Why: Its last result is valid so long.
PRECONDITION_TIMEOUT: Final = 1.0
# [Resources] Bytes of messages that are held while a profile or context is applied
# At it: the oldest is dropped
RESOURCE_HELD_MAX: Final = 64 * 1024 * 1024
# An ending resource waits so long for the last run of a task; a stuck thread is left behind.
TASK_END_TIMEOUT: Final = 2.0
# [Resources] Attributes that one client asks for
# At it: the request is refused
# Told in: its response
REQUIREMENT_BOUNDS_MAX: Final = 256
# A restarted resource keeps the requirement of a client so long until the client connects again: master, agent and
# links may have to start first.
RESOURCE_CLIENT_GRACE: Final = 30.0
# Number of stamps of expiring requests that are kept, so that a latched one that arrives again keeps its expiry.
RESOURCE_STAMPS_MAX: Final = 1024
# A starting resource waits so long for its saved state, and an ending one until it is written: the disk may hang.
STORE_TIMEOUT: Final = 5.0
# [Resources] Characters of the rule of a context
# At it: the resource does not start
# Told in: its error
CONTEXT_RULE_MAX: Final = 1024
# [Resources] Brackets within each other in a rule
# At it: the resource does not start
# Told in: its error
CONTEXT_RULE_DEPTH: Final = 20
# A context that a rule has selected stays at least so long: a value at a threshold must not cause oscillation.
CONTEXT_DWELL: Final = 1.0
# [Resources] Bytes a second up to which an observed topic is measured by subscribing (``measure = "auto"``)
# At it: its node's own counters give rate and bandwidth
# Why: A second subscriber of an image delays the first one.
MEASURED_BYTES: Final = 256 * 1024
# The function of a context may take so long; tasks are paused meanwhile.
CONTEXT_ENTER_TIMEOUT: Final = 5.0
# Seconds from a failed switch until the rules are evaluated again; also the longest between searches for topics.
CONTEXT_RETRY: Final = 5.0
# [Resources] Time for a node that a resource has started to be registered and to answer
# At it: it is ended, and the profile that needs it fails
# Told in: `profile explain`, the resource's log
NODE_START_TIMEOUT: Final = 20.0
# Seconds that a node has to end whose resource does not name it any more.
NODE_END_TIMEOUT: Final = 10.0
# Seconds until a node that has ended is started again; each further time it is twice as long, up to the second.
NODE_RESTART_FIRST: Final = 0.5
NODE_RESTART_MAX: Final = 30.0
# After a run of this length the failures of a node count from the beginning.
NODE_STEADY: Final = 60.0
# [Resources] Times in a row that a node of a resource ends by itself
# At it: it is not started again, and profiles that name it are not used for a minute
# Told in: `profile explain`, the resource's alarms
NODE_FAILURES_MAX: Final = 5
# Seconds for which these profiles are not used.
NODE_BLOCKED: Final = 60.0
