"""Which gateway of a site leads, where there are several: the others stand by, so that no message crosses twice."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rmpa.gateway.sites.keys import SiteGateway


class Leader:
    """Decides whether this gateway leads its site.

    Liveliness tokens are lost for a moment where a link to a router breaks. So a gateway waits for ``patience``
    before it leads, and one that hears of a better one stops at once: for a moment none leads, never two that hear
    each other.

    Args:
        own: This gateway.
        patience: Seconds for which it must have been the best before it leads.
        now: Monotonic seconds.
    """

    def __init__(self, own: SiteGateway, patience: float, now: float) -> None:
        self._own = own
        self._patience = patience
        self._others: set[SiteGateway] = set()
        self._best_since: float | None = now
        self.leads = False

    @property
    def leader(self) -> SiteGateway:
        """The gateway that leads, or will: the least of those that are known."""
        return min((self._own, *self._others), key=lambda each: each.order)

    def seen(self, other: SiteGateway, now: float) -> None:
        """A gateway's token appeared; those of other sites and this gateway's own are ignored."""
        if other.site == self._own.site and other.instance != self._own.instance:
            self._others.add(other)
            self._judge(now)

    def gone(self, other: SiteGateway, now: float) -> None:
        """A gateway's token disappeared."""
        self._others.discard(other)
        self._judge(now)

    def next_timer(self) -> float | None:
        """When ``handle_timer`` is to be called; ``None``: nothing waits."""
        return None if self.leads or self._best_since is None else self._best_since + self._patience

    def handle_timer(self, now: float) -> None:
        """Begin to lead if it is time."""
        due = self.next_timer()
        if due is not None and now >= due:
            self.leads = True

    def _judge(self, now: float) -> None:
        if self.leader != self._own:
            self.leads, self._best_since = False, None
        elif self._best_since is None:
            self._best_since = now
