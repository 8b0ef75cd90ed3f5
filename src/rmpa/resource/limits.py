"""Limits and time-outs of Smart Resources, with their reasons; in seconds and bytes unless stated otherwise."""

from __future__ import annotations

from typing import Final

from rmpa.core.limits import MIB

# Characters of a descriptor: one with a hundred profiles of twenty attributes has about 100 KB.
DESCRIPTOR_MAX: Final = 1 * MIB
# Characters of the request for one attribute.
REQUIREMENT_TEXT_MAX: Final = 1024
# Input messages that wait for a task; drop-oldest, because control acts on the newest.
TASK_QUEUE_MESSAGES: Final = 10
# A change of profile waits so long for the runs under way; a run that takes longer is stuck or slow.
TASK_PAUSE_TIMEOUT: Final = 1.0
# While a call does not return, the precondition's last result is valid so long; then the profile is excluded.
PRECONDITION_TIMEOUT: Final = 1.0
# Bytes of the messages that a resource queues while a profile or context is applied; drop-oldest.
RESOURCE_HELD_MAX: Final = 64 * 1024 * 1024
# An ending resource waits so long for the last run of a task; a stuck thread is left behind.
TASK_END_TIMEOUT: Final = 2.0
# Attributes in the requirement of one client.
REQUIREMENT_BOUNDS_MAX: Final = 256
# A restarted resource keeps the requirement of a client so long until the client connects again: master, agent and
# links may have to start first.
RESOURCE_CLIENT_GRACE: Final = 30.0
# Number of stamps of expiring requests that are kept, so that a latched one that arrives again keeps its expiry.
RESOURCE_STAMPS_MAX: Final = 1024
# A starting resource waits so long for its saved state, and an ending one until it is written: the disk may hang.
STORE_TIMEOUT: Final = 5.0
# Characters of the rule of a context.
CONTEXT_RULE_MAX: Final = 1024
# Nested brackets and negations in a rule.
CONTEXT_RULE_DEPTH: Final = 20
# A context that a rule has selected stays at least so long: a value at a threshold must not cause oscillation.
CONTEXT_DWELL: Final = 1.0
# The function of a context may take so long; tasks are paused meanwhile.
CONTEXT_ENTER_TIMEOUT: Final = 5.0
# Seconds from a failed switch until the rules are evaluated again; also the longest between searches for topics.
CONTEXT_RETRY: Final = 5.0
