"""What a receiver remembers of a reliable source whose route has ended."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections import Counter

    from rmpa.bridge.data.qos_events import QosEvent, QosEventKind


@dataclass(slots=True)
class ReceptionHistory:
    """What is known of a reliable source from before its present route.

    Args:
        topic: Its topic in the local graph.
        missed: Whether there were subscribers when the route ended, so that later messages are missed.
        lost: Messages that never came.
        counts: Events of its contract, by kind.
        recent: The last events.
    """

    topic: str
    missed: bool
    lost: int
    counts: Counter[QosEventKind]
    recent: tuple[QosEvent, ...]
