"""Limits and time-outs of Smart Resources.

Each has its reason beside it. Seconds and bytes, unless the name says otherwise.
"""

from __future__ import annotations

from typing import Final

from rmpa.core.sizes import MIB

DESCRIPTOR_MAX: Final = 1 * MIB
"""Characters of a resource's descriptor: one with a hundred profiles of twenty attributes has some 100 KB."""
REQUIREMENT_TEXT_MAX: Final = 1024
"""Characters in what is asked of one attribute."""
TASK_QUEUE_MESSAGES: Final = 10
"""Messages of its input that wait for a task; the oldest is dropped beyond it: control acts on the newest."""
TASK_PAUSE_TIMEOUT: Final = 1.0
"""How long a profile that is to be applied waits for the runs under way; one that takes longer is stuck or slow."""
PRECONDITION_TIMEOUT: Final = 1.0
"""Seconds for which a profile whose precondition does not answer counts as before; then it is left out."""
RESOURCE_HELD_MAX: Final = 64 * 1024 * 1024
"""Bytes of messages that a resource keeps while a profile is applied; the oldest give way."""
TASK_END_TIMEOUT: Final = 2.0
"""How long an ending resource waits for a task's last run; a thread that is stuck is left behind."""
RESOURCE_ANSWER_TIMEOUT: Final = 10.0
"""For a resource's answer to a requirement; it may be in another module, and its route has to open first."""
REQUIREMENT_BOUNDS_MAX: Final = 256
"""Attributes that one client asks for."""
RESOURCE_CLIENT_GRACE: Final = 30.0
"""Seconds that a restarted resource keeps what a client asked before until that connects again: its master, its agent
and the links may all have to come up first."""
RESOURCE_REPORT_WINDOWS: Final = 3
"""Quality windows for which what a client observes counts; one that reports no more observes nothing."""
RESOURCE_STAMPS_MAX: Final = 1024
"""Requests with an expiry whose stamps are remembered, so that a latched one that comes again does not begin anew."""
STORE_WINDOWS_MAX: Final = 3600
"""Quality windows in a resource's history: an hour of them, some 2 MB."""
STORE_EVENTS_MAX: Final = 2000
"""Alarms and changes of the profile in it."""
STORE_DESCRIPTORS_MAX: Final = 20
"""Different descriptors of one resource in it: one more for each change of its file."""
KNOWN_MAX: Final = 256
"""Other resources whose descriptors a module keeps; the one that was not seen for longest gives way."""
KNOWN_TEXT_MAX: Final = 16 * MIB
"""Characters of all of them."""
KNOWN_LOOK: Final = 10.0
"""Seconds between looks which resources there are."""
KNOWN_WRITE: Final = 60.0
"""Seconds between writes of when a resource that is here was seen last, to spare flash memory."""
STORE_BYTES_MAX: Final = 64 * MIB
"""Of the whole file, whatever happens."""
STORE_INTERVAL: Final = 10.0
"""Seconds between writes of the history, to spare flash memory; what must survive a crash is written at once."""
STORE_PENDING_MAX: Final = 600
"""Rows of history that wait for a disk that does not take them; the oldest give way."""
STORE_OPEN_TIMEOUT: Final = 5.0
"""Seconds that a starting resource waits for its store; then it starts without what it remembers."""
STORE_LOCK_TIMEOUT: Final = 1.0
"""Seconds that a store waits for its lock: the process before may still be ending."""
STORE_CLOSE_TIMEOUT: Final = 5.0
"""Seconds that an ending resource waits until everything is written; a disk that hangs is left behind."""
CONTEXT_RULE_MAX: Final = 1024
"""Characters of the rule of a context."""
CONTEXT_RULE_DEPTH: Final = 20
"""Brackets and negations within each other in such a rule."""
CONTEXT_DWELL: Final = 1.0
"""Seconds that a context stays which a rule has chosen: a value at its edge must not make the resource flutter."""
CONTEXT_ENTER_TIMEOUT: Final = 5.0
"""For what a context does when it begins; the tasks rest meanwhile."""
CONTEXT_RETRY: Final = 5.0
"""After a context that could not begin, before its rule is looked at again."""
CONTEXT_LOOK: Final = 0.5
"""Between looks whether topics that rules name are there: one call of the module's own master."""
