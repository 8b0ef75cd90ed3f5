"""Other sites as a gateway sees them: what ``rmpa site`` shows."""

from __future__ import annotations

import msgspec

from rmpa.core.errors import ConfigError
from rmpa.core.identity import peer_name_problem


class SiteModuleInfo(msgspec.Struct, frozen=True, kw_only=True):
    """A module of a site.

    Attributes:
        name: The module.
        instance: Its run, 32 hexadecimal digits.
        topics: Its topics that its site offers, each publisher counted.
        services: Its services that its site offers.
        shown: How many of both are in the graph here; for a module of this site: how many are offered.
    """

    name: str
    instance: str = ""
    topics: int = 0
    services: int = 0
    shown: int = 0


class SiteSourceInfo(msgspec.Struct, frozen=True, kw_only=True):
    """A topic of one publisher, or a service, of a site.

    Attributes:
        kind: ``topic`` or ``service``.
        module: The module.
        node: The node in its module's graph.
        name: Its name there.
        type: ``package/Name``; ``*`` for a service whose server was not asked.
        here: Its name in the gateway's graph; empty if it is not shown.
        problem: Why it does not cross, or does not work; empty for nothing.
    """

    kind: str
    module: str
    node: str
    name: str
    type: str = "*"
    here: str = ""
    problem: str = ""


class SiteInfo(msgspec.Struct, frozen=True, kw_only=True):
    """A site.

    Attributes:
        name: The site.
        state: ``this site``; ``joined``; ``no gateway``: its modules are announced and no gateway leads it;
            ``unreachable``: it was there, and is not now.
        since_ago: Seconds since that is so; ``None``: unknown.
        gateways: How many gateways it has.
        modules: Its modules.
        sources: What it offers, in ``rmpa site info`` alone.
        not_shown: How many sources a rule or a conflict of names keeps out.
        beyond: Sources that were left out because there are too many.
    """

    name: str
    state: str = "joined"
    since_ago: float | None = None
    gateways: int = 0
    modules: tuple[SiteModuleInfo, ...] = ()
    sources: tuple[SiteSourceInfo, ...] = ()
    not_shown: int = 0
    beyond: int = 0


class SitesReport(msgspec.Struct, frozen=True, kw_only=True):
    """What one gateway joins.

    Attributes:
        gateway: The gateway's name among its peers.
        site: Its site.
        leads: Whether it is the one that exports and imports.
        rank: Of gateways of one site the lowest leads.
        problem: Why no other site can be reached; empty for nothing.
        endpoints: The Zenoh endpoints that it is connected to.
        sites: This site first, then the others.
    """

    gateway: str
    site: str
    leads: bool = False
    rank: int = 0
    problem: str = ""
    endpoints: tuple[str, ...] = ()
    sites: tuple[SiteInfo, ...] = ()


def read_site_module(text: str) -> tuple[str, str]:
    """Split ``warehouse/arm`` into the site and the module.

    Raises:
        ConfigError: It is not the name of a site and of a module.
    """
    site, slash, module = text.partition("/")
    if not slash or peer_name_problem(site) is not None or peer_name_problem(module) is not None:
        raise ConfigError("SITE/MODULE", f"{text!r} is not a site and a module", "write one as warehouse/arm")
    return site, module
