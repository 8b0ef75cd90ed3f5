"""How the messages of one link are dated here."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Callable


def _never() -> float:
    """No silence so far."""
    return -math.inf


class LinkTime:
    """How a link's messages are dated here: one for all of its flows, renewed whenever the link knows better."""

    __slots__ = ("ahead_ns", "error_ns", "resumed_at")

    def __init__(self) -> None:
        self.resumed_at: Callable[[], float] = _never
        """When the link's last silence was last seen, monotonic seconds; see ``runtime.stream``."""
        self.ahead_ns = 0
        """The peer's wall clock less ours."""
        self.error_ns: int | None = None
        """± bound of that; ``None`` while nothing is known."""

    def set(self, offset: float | None, error: float | None) -> None:
        """Take a link's estimate, in seconds."""
        self.ahead_ns = round((offset or 0.0) * 1e9)
        self.error_ns = None if error is None else round(error * 1e9)
