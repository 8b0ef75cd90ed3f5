"""The time base of one link: relates the peer's time stamps to the local clock."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Callable


def _never() -> float:
    """Returns minus infinity: there was no silence yet."""
    return -math.inf


class LinkTime:
    """Offset of the peer's clock, and the end of the last silence; shared by all flows of a link."""

    __slots__ = ("ahead_ns", "error_ns", "resumed_at")

    def __init__(self) -> None:
        self.resumed_at: Callable[[], float] = _never
        """Returns when the link's last silence was last seen, monotonic seconds; see ``runtime.stream``."""
        self.ahead_ns = 0
        """The peer's wall clock minus the local one, ns."""
        self.error_ns: int | None = None
        """The bound of the offset's error, ± ns; ``None`` while the offset is unknown."""

    def set(self, offset: float | None, error: float | None) -> None:
        """Set the offset and its error bound, in seconds."""
        self.ahead_ns = round((offset or 0.0) * 1e9)
        self.error_ns = None if error is None else round(error * 1e9)
