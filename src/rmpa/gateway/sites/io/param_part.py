"""The part of the neighbour "other sites" for parameters."""

from __future__ import annotations

from typing import TYPE_CHECKING

from rmpa.gateway.sites.part import PassivePart

if TYPE_CHECKING:
    from rmpa.gateway.sites.io.param_exports import SiteParamExports
    from rmpa.gateway.sites.io.param_imports import SiteParamImports


class SiteParams(PassivePart):
    """Parameters between sites: a ``SitePart``.

    Args:
        exports: Answers for the modules of this site.
        imports: Asks other sites; it is started here.
    """

    name = "params"

    def __init__(self, exports: SiteParamExports, imports: SiteParamImports) -> None:
        self._exports = exports
        self._imports = imports
        imports.start()

    def lead(self, leads: bool) -> None:
        """Answer for the modules of this site while this gateway leads it."""
        self._exports.lead(leads)

    def report(self) -> dict[str, object]:
        """Questions of other sites, and what is followed from them."""
        return {
            "asked": self._exports.asked,
            "refused": self._exports.refused,
            "followed": self._imports.followed,
            "problems": dict(self._imports.problems),
        }

    async def close(self) -> None:
        """End all questions."""
        await self._imports.close()
        await self._exports.close()
