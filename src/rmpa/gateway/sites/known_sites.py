"""What the neighbour "other sites" knows of them, for the parts that answer questions."""

from __future__ import annotations

from typing import TYPE_CHECKING, Protocol

if TYPE_CHECKING:
    from rmpa.gateway.sites.catalogue import SiteCatalogue
    from rmpa.gateway.sites.exports import SiteExports
    from rmpa.gateway.sites.imports import SiteImports


class Sites(Protocol):
    """What is known of sites: ``SiteNeighbour``."""

    catalogue: SiteCatalogue
    exports: SiteExports
    imports: SiteImports

    @property
    def leads(self) -> bool:
        """Whether this gateway leads its site."""

    def report(self) -> dict[str, object]:
        """Of its parts, among others."""
