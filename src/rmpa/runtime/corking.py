"""Corking: what is collected while one read is handled is passed on once, at its end, as TCP_CORK does.

One loop and one thread handle reads, one after the other; a read may be handled within another one.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeAlias

_Ends: TypeAlias = list[Callable[[], None]]

collected: _Ends | None = None
"""Called in order at the end of the read that is handled now; ``None``: nothing is collected."""


class CollectedSends:
    """A context that collects the messages that are sent within, whose parts must not change until its end.

    At its end each stream sends them by one system call.
    """

    __slots__ = ("_outer",)

    def __enter__(self) -> None:
        """Begin to collect."""
        global collected  # noqa: PLW0603 - one loop, one thread
        self._outer = collected
        collected = []

    def __exit__(self, *_: object) -> None:
        """Send what was collected."""
        global collected  # noqa: PLW0603 - as above
        try:
            for end in collected or ():
                end()
        finally:
            collected = self._outer


def after_read(call: Callable[[], None]) -> None:
    """Call ``call`` once the present read is handled; at once if none is, or if it is of a few bytes."""
    if collected is not None:
        collected.append(call)
    else:
        call()
