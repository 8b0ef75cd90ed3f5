"""The part of the neighbour "other sites" for parameters."""

from __future__ import annotations

from typing import TYPE_CHECKING

from rmpa.gateway.sites.part import PassivePart

if TYPE_CHECKING:
    from rmpa.gateway.sites.io.param_exports import SiteParamExports
    from rmpa.gateway.sites.io.param_imports import SiteParamImports
    from rmpa.gateway.sites.keys import SiteModule


class SiteParams(PassivePart):
    """Parameters between sites: a ``SitePart``.

    Args:
        site: This site's name.
        exports: Answers for the modules of this site.
        imports: Asks other sites; it is started here.
    """

    name = "params"

    def __init__(self, site: str, exports: SiteParamExports, imports: SiteParamImports) -> None:
        self._site = site
        self._exports = exports
        self._imports = imports
        imports.start()

    def module_changed(self, module: SiteModule, there: bool) -> None:
        """Answer for a module of this site while it is there."""
        if module.site == self._site:
            (self._exports.export if there else self._exports.withdraw)(module.name)

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
