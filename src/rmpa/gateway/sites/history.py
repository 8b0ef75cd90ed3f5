"""Which sites were there and are not: for "unreachable since". Without I/O."""

from __future__ import annotations

from typing import TYPE_CHECKING

from rmpa.gateway import limits

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable


class SiteHistory:
    """Remembers since when other sites are there or away.

    Args:
        now: Monotonic seconds.
    """

    def __init__(self, now: Callable[[], float]) -> None:
        self._now = now
        self._there: frozenset[str] = frozenset()
        self._since: dict[str, float] = {}

    @property
    def away(self) -> tuple[str, ...]:
        """The sites that were there and are not, by name."""
        return tuple(sorted(self._since.keys() - self._there))

    def since_ago(self, site: str) -> float | None:
        """Seconds since a site came or left; ``None``: it was never seen."""
        return self._now() - self._since[site] if site in self._since else None

    def seen(self, sites: Iterable[str]) -> None:
        """These sites are there now, and no others."""
        there = frozenset(sites)
        for site in there ^ self._there:
            self._since[site] = self._now()
        self._there = there
        while len(self._since) > limits.SITES_REMEMBERED_MAX and (away := self.away):
            del self._since[min(away, key=self._since.__getitem__)]
