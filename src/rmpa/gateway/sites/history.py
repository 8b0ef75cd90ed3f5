"""Which sites were there and are not: for "unreachable since". Without I/O."""

from __future__ import annotations

from typing import TYPE_CHECKING

from rmpa.gateway import limits
from rmpa.gateway.sites.part import PassivePart

if TYPE_CHECKING:
    from collections.abc import Callable

    from rmpa.gateway.sites.keys import SiteModule


class SiteHistory(PassivePart):
    """Remembers since when sites are there or away: a ``SitePart``.

    Args:
        now: Monotonic seconds.
    """

    name = "history"

    def __init__(self, now: Callable[[], float]) -> None:
        self._now = now
        self._modules: dict[str, set[SiteModule]] = {}
        self._since: dict[str, float] = {}

    @property
    def away(self) -> tuple[str, ...]:
        """The sites that have no module any more, by name."""
        return tuple(sorted(site for site in self._since if not self._modules.get(site)))

    def since_ago(self, site: str) -> float | None:
        """Seconds since a site came or left; ``None``: it was never seen."""
        return self._now() - self._since[site] if site in self._since else None

    def module_changed(self, module: SiteModule, there: bool) -> None:
        """A module came or went."""
        modules = self._modules.setdefault(module.site, set())
        was = bool(modules)
        (modules.add if there else modules.discard)(module)
        if bool(modules) != was or module.site not in self._since:
            self._since[module.site] = self._now()
        if not modules:
            del self._modules[module.site]
        while len(self._since) > limits.SITES_REMEMBERED_MAX and self.away:
            del self._since[min(self.away, key=self._since.__getitem__)]

    def report(self) -> dict[str, object]:
        """The sites that are away, with the seconds since they left."""
        return {site: self.since_ago(site) for site in self.away}
