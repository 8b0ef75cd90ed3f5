"""Lets long computations yield to pending data without importing the event loop."""

from __future__ import annotations

from typing import TYPE_CHECKING, Protocol, TypeVar

if TYPE_CHECKING:
    from collections.abc import Iterable

_T = TypeVar("_T")


class Yielder(Protocol):
    """Iterates over items; between two of them data may be handled (``runtime.event_loop.yielding_to_data``).

    ``iter`` is a yielder that handles nothing. The items must not change meanwhile: pass a copy, or a collection that
    nothing else changes. The caller's own data must be consistent during the iteration.
    """

    def __call__(self, items: Iterable[_T], /) -> Iterable[_T]:
        """The same items."""
        ...
