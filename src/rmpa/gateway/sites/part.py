"""What plugs into the neighbour "other sites": a part carries sources of one kind, or something else of modules."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rmpa.gateway.neighbour import ForeignSource, MeshSource
    from rmpa.gateway.sites.keys import SiteModule, SiteSource


@dataclass(frozen=True, slots=True)
class SiteExport:
    """A source of this site that other sites may have; its liveliness token is declared by the neighbour.

    Args:
        source: The source in the gateway's graph.
        announced: What its token says of it; ``announced.key()`` is the key of its messages or calls. A source that
            is offered to some sites alone has an export for each of them, which ``announced.to`` names.
        rate: Messages a second that cross at most; ``None``: no limit.
        size: Bytes a second that cross at most; ``None``: no limit.
    """

    source: MeshSource
    announced: SiteSource
    rate: float | None = None
    size: int | None = None


@dataclass(frozen=True, slots=True)
class SiteImport:
    """A source of another site that is shown here.

    Args:
        source: The source in the gateway's graph, under its name here.
        announced: What its token says of it; another run of the module makes another one.
    """

    source: ForeignSource
    announced: SiteSource


class SitePart:
    """One part of the neighbour "other sites"; called only while this gateway leads its site, in the event loop.

    A gateway that stops leading withdraws and hides everything, and says of all modules that they are gone. What a
    part does not override it ignores.
    """

    name = ""
    """The key of its report."""

    def export(self, entry: SiteExport) -> None:
        """Offer a source of this site: declare what its messages or calls need."""

    def withdraw(self, entry: SiteExport) -> None:
        """Take back what ``export`` made."""

    def show(self, entry: SiteImport) -> None:
        """Put a source of another site into the graph."""

    def renew(self, old: SiteImport, new: SiteImport) -> None:
        """A source that is shown is now of another run of its module, or its way was interrupted: ask it anew."""

    def hide(self, entry: SiteImport) -> None:
        """Take back what ``show`` made."""

    def module_changed(self, module: SiteModule, there: bool) -> None:
        """A module came or went; one of this site has this site's name."""

    def report(self) -> dict[str, object]:
        """What ``rmpa why`` and ``rmpa site`` are answered from, as JSON values."""
        return {}

    async def close(self) -> None:
        """End it: everything was withdrawn and hidden before."""
