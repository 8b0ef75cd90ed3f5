"""Questions about other sites, which a gateway answers; another agent asks the gateways that it is linked to."""

from __future__ import annotations

import asyncio
from functools import partial
from typing import TYPE_CHECKING, Any, Final, Protocol

import msgspec

from rmpa.bridge import limits as bridge_limits
from rmpa.bridge.policy import Needs
from rmpa.config.peer_rules import Access
from rmpa.core.errors import ConfigError, PeerRefused, RmpaError, UnreachableError

if TYPE_CHECKING:
    from collections.abc import Awaitable

    from rmpa.bridge.bridge import Bridge
    from rmpa.bridge.sessions import PeerSession

Args = dict[str, Any]

# The request for a ``SitesReport`` without sources.
REPORT: Final = "site.report"
# The request for a ``SitesReport`` of one site with its sources: ``{site}``.
SITE_INFO: Final = "site.info"
# The request for the ways of a topic or a service through gateways: ``{name, site, module, service}``.
SITE_WHY: Final = "site.why"
# The request for parameters of a node of ROS 2: ``{site, node}``, with ``key`` and ``text`` as the gateway has them.
PARAM: Final = "site.param"
_SOURCES: Final = Needs(
    (Access.SUBSCRIBE, Access.CALL),
    "each topic and service; of this site the asking module's own alone. Sites and modules are named to all",
)
_WAYS: Final = Needs(
    (Access.SUBSCRIBE, Access.CALL), "the topic or service, by its name here; what leaves is the asking module's own"
)
_PARAMETERS: Final = Needs((Access.CALL,), "a service of parameters of ROS 2, such as `/node/get_parameters`")
# The questions about other sites, with what each needs of a peer that asks.
QUESTIONS: Final = {REPORT: _SOURCES, SITE_INFO: _SOURCES, SITE_WHY: _WAYS, PARAM: _PARAMETERS}


class SiteAnswerer(Protocol):
    """Answers questions about other sites: ``gateway.sites`` has it."""

    def answer(self, what: str, args: dict[str, Any], asker: str = "", /) -> Awaitable[Any]:
        """The reply to one of ``QUESTIONS``, which tells ``asker``, a linked module, only what it may have.

        Without ``asker`` the question is of this machine's user, to which everything is shown.

        Raises:
            RmpaError: It cannot be answered; the text says why.
        """
        ...


class SiteRequests:
    """The operation ``site`` of the control socket, and the peers' requests about sites.

    Args:
        bridge: Carries requests between the modules, and says which peers are believed about other sites.
    """

    def __init__(self, bridge: Bridge) -> None:
        self._bridge = bridge
        # What answers as a gateway; ``None``: this agent is none.
        self.answerer: SiteAnswerer | None = None
        # The gateway that answered for a site, by its GUID.
        self._liked: dict[str, str] = {}

    def serve(self, gateway: SiteAnswerer) -> None:
        """Answer as a gateway from now on."""
        self.answerer = gateway

        def answer(what: str, asker: PeerSession, args: Args) -> Awaitable[object]:
            return gateway.answer(what, args, asker.link.name)

        for what, needs in QUESTIONS.items():
            self._bridge.rpc.on_request(what, partial(answer, what), needs)

    async def answer(self, args: Args) -> Any:
        """The operation ``site``: ``what`` (one of ``QUESTIONS``) and its ``args``.

        ``site.report`` and ``site.why`` return a list with the answers of all gateways; the others one answer.
        """
        what, inner = args.get("what"), args.get("args")
        if not isinstance(what, str) or what not in QUESTIONS or not isinstance(inner, dict):
            raise ConfigError("what", f"{what!r} is no question about sites")
        return await (self.all(what, inner) if what in {REPORT, SITE_WHY} else self.one(what, inner))

    async def all(self, what: str, args: Args) -> list[Any]:
        """The answers of all gateways; those that fail are left out."""
        if self.answerer is not None:
            return [await self.answerer.answer(what, args)]
        # Twice the time: the gateway itself asks the other site for so long.
        asks = [self._bridge.rpc.request(at, what, args, 2 * bridge_limits.ASK_TIMEOUT) for at in self._believed()]
        found = await asyncio.gather(*asks, return_exceptions=True)
        for error in found:
            if isinstance(error, BaseException) and not isinstance(error, RmpaError):
                raise error
        return [value for value in found if not isinstance(value, RmpaError)]

    async def one(self, what: str, args: Args) -> Any:
        """The answer of the first gateway that has one.

        Raises:
            UnreachableError: This module is linked to no gateway.
            RmpaError: No gateway has an answer; the text is that of the one that knew most.
        """
        if self.answerer is not None:
            return await self.answerer.answer(what, args)
        site = str(args.get("site", ""))
        problem: RmpaError | None = None
        for session in sorted(self._believed(), key=lambda each: str(each.link.guid) != self._liked.get(site)):
            try:
                value = await self._bridge.rpc.request(session, what, args, bridge_limits.PARAM_ASK_TIMEOUT)
            except RmpaError as error:
                if not (isinstance(error, PeerRefused) and error.unknown):
                    problem = problem or error
            else:
                self._liked[site] = str(session.link.guid)
                return value
        self._liked.pop(site, None)
        remedy = "start one with `rmpa gateway`; `rmpa peer list` shows the links"
        remedy += ". In a secured mesh `relays` of [trust] names the gateways that are believed"
        raise problem or UnreachableError("gateway", "any linked peer", remedy)

    def _believed(self) -> list[PeerSession]:
        """The linked peers whose word about other sites counts: any member could answer as a gateway."""
        return [at for at in self._bridge.sessions.linked() if self._bridge.gate.may_relay(at.link.name)]


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
