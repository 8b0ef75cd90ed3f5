"""What ``rmpa site`` shows of other sites, as JSON values. Sans-I/O."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from rmpa.core.counters import Counters
    from rmpa.gateway.sites.catalogue import SiteCatalogue
    from rmpa.gateway.sites.exports import SiteExports
    from rmpa.gateway.sites.imports import SiteImports

REFUSALS_SHOWN: Final = 1000
"""Sources that do not cross, of each way, that a report names; the others are counted."""


def sites_report(catalogue: SiteCatalogue, imports: SiteImports) -> dict[str, object]:
    """Each other site: its gateways, modules, and how many sources of each are there and shown here."""
    found: dict[str, object] = {}
    for site in catalogue.sites:
        modules = []
        for module in catalogue.modules(site):
            sources = catalogue.sources(module)
            shown = sum(imports.entry(source) is not None for source in sources)
            modules.append(
                {"name": module.name, "instance": module.instance, "sources": len(sources), "shown": shown}
            )
        found[site] = {
            "gateways": [{"rank": each.rank, "instance": each.instance} for each in catalogue.gateways(site)],
            "modules": modules,
            "beyond_limits": catalogue.refused(site),
        }
    return found


def site_counts(counters: Counters) -> dict[str, int]:
    """The counts that are about sites, of counters that may be the agent's."""
    return {name: count for name, count in counters.as_dict().items() if name.startswith("site.")}


def refusals_report(exports: SiteExports, imports: SiteImports) -> dict[str, object]:
    """What does not cross, with the reason."""
    out = [
        {"kind": source.kind, "module": source.module, "node": source.node, "name": source.name, "why": why}
        for source, why in exports.refusals()
    ]
    into = [
        {
            "kind": source.kind,
            "site": source.module.site,
            "module": source.module.name,
            "node": source.node,
            "name": source.name,
            "why": why,
        }
        for source, why in imports.refusals()
    ]
    return {
        "out": out[:REFUSALS_SHOWN],
        "in": into[:REFUSALS_SHOWN],
        "more": max(0, len(out) - REFUSALS_SHOWN) + max(0, len(into) - REFUSALS_SHOWN),
    }
