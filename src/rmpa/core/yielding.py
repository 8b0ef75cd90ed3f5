"""How long work in the pure rooms gives way without knowing to whom."""

from __future__ import annotations

from typing import TYPE_CHECKING, Protocol, TypeVar

if TYPE_CHECKING:
    from collections.abc import Iterable

_T = TypeVar("_T")


class Yielder(Protocol):
    """Passes on what it is given, one after the other; between two of them something more urgent may be done.

    ``iter`` is one that does nothing. What is iterated over must not change meanwhile: it is a copy, or shared by
    nobody, and nothing of the caller's may be half done.
    """

    def __call__(self, items: Iterable[_T], /) -> Iterable[_T]:
        """The same items."""
        ...
