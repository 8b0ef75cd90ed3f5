"""Questions about other sites: a gateway answers them; another agent asks the gateways that it is linked to."""

from __future__ import annotations

import asyncio
from functools import partial
from typing import TYPE_CHECKING, Any, Final, Protocol

from rmpa.bridge import limits
from rmpa.bridge.policy import OPEN_GATE, Needs, PermissionGate
from rmpa.bridge.rpc import UNKNOWN_QUESTION
from rmpa.config.peer_rules import Access
from rmpa.core.errors import ConfigError, PeerRefused, RmpaError, UnreachableError

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable, Iterable

    from rmpa.bridge.rpc import PeerRpc
    from rmpa.bridge.sessions import PeerSession

REPORT: Final = "site.report"
"""The request for a ``SitesReport`` without sources."""
INFO: Final = "site.info"
"""The request for a ``SitesReport`` of one site with its sources: ``{site}``."""
PARAM: Final = "site.param"
"""A request about parameters (``bridge.params.transfer``) to a module: ``{site, module, what, key, text}``."""
WHY: Final = "site.why"
"""The request for the ways of a topic or a service through gateways: ``{name, site, module, service}``."""
_ALL: Final = (REPORT, WHY)
"""Those that every gateway answers for itself."""
QUESTIONS: Final = (REPORT, INFO, PARAM, WHY)
_SOURCES: Final = Needs(
    (Access.SUBSCRIBE, Access.CALL),
    "each topic and service; of this site the asking module's own alone. Sites and modules are named to all",
)
_PARAM: Final = Needs(
    (Access.PARAM,),
    "as `param.get` and its like, by this gateway, the other site's and the owner. None of this site",
)
_WAYS: Final = Needs(
    (Access.SUBSCRIBE, Access.CALL), "the topic or service, by its name here; what leaves is the asking module's own"
)


class SiteAnswerer(Protocol):
    """Answers questions about other sites: ``gateway.sites`` has it."""

    def answer(self, what: str, args: dict[str, Any], asker: str = "", /) -> Awaitable[Any]:
        """The reply to one of ``QUESTIONS``, which tells ``asker``, a linked module, only what it may have.

        Without ``asker`` this machine's user asks, who may have everything.

        Raises:
            RmpaError: It cannot be answered; the text says why.
        """
        ...


class SiteRequests:
    """The operation ``site`` of the control socket, and the peers' requests about sites.

    Args:
        rpc: Carries requests between the modules.
        linked: Returns the sessions of the peers that are linked now.
        gate: Decides which peers are believed about other sites.
    """

    def __init__(
        self, rpc: PeerRpc, linked: Callable[[], Iterable[PeerSession]], gate: PermissionGate = OPEN_GATE
    ) -> None:
        self._gate = gate
        self._rpc = rpc
        self._linked = linked
        self._gateway: SiteAnswerer | None = None
        self._liked: dict[str, str] = {}
        """The gateway that answered for a site, by its GUID."""

    @property
    def answerer(self) -> SiteAnswerer | None:
        """What answers as a gateway; ``None``: this agent is none."""
        return self._gateway

    def serve(self, gateway: SiteAnswerer) -> None:
        """Answer as a gateway from now on."""
        self._gateway = gateway
        rpc = self._rpc
        rpc.on_request(REPORT, partial(self._answer_peer, gateway, REPORT), _SOURCES)
        rpc.on_request(INFO, partial(self._answer_peer, gateway, INFO), _SOURCES)
        rpc.on_request(PARAM, partial(self._answer_peer, gateway, PARAM), _PARAM)
        rpc.on_request(WHY, partial(self._answer_peer, gateway, WHY), _WAYS)

    async def answer(self, args: dict[str, Any]) -> Any:
        """The operation ``site``: ``what`` (one of ``QUESTIONS``) and its ``args``.

        ``site.report`` and ``site.why`` return a list with the answers of all gateways; the others one answer.
        """
        what, inner = args.get("what"), args.get("args")
        if what not in QUESTIONS or not isinstance(inner, dict):
            raise ConfigError("what", f"{what!r} is no question about sites")
        return await (self.all(what, inner) if what in _ALL else self.one(what, inner))

    async def all(self, what: str, args: dict[str, Any]) -> list[Any]:
        """The answers of all gateways; those that fail are left out."""
        if self._gateway is not None:
            return [await self._gateway.answer(what, args)]
        sessions = self._believed()
        # Twice the time: the gateway itself asks the other site for so long.
        wait = 2 * limits.ASK_TIMEOUT
        found = await asyncio.gather(*(self._ask(session, what, args, wait) for session in sessions))
        return [value for value, error in found if error is None]

    async def one(self, what: str, args: dict[str, Any]) -> Any:
        """The answer of the first gateway that has one.

        Raises:
            UnreachableError: This module is linked to no gateway.
            RmpaError: No gateway has an answer; the text is that of the one that knew most.
        """
        if self._gateway is not None:
            return await self._gateway.answer(what, args)
        site = str(args.get("site", ""))
        sessions = sorted(self._believed(), key=lambda each: str(each.link.guid) != self._liked.get(site))
        problem: RmpaError | None = None
        for session in sessions:
            value, error = await self._ask(session, what, args, limits.PARAM_ASK_TIMEOUT)
            if error is None:
                self._liked[site] = str(session.link.guid)
                return value
            if not _is_no_gateway(error):
                problem = problem or error
        self._liked.pop(site, None)
        if isinstance(problem, PeerRefused):
            raise PeerRefused(problem.peer, problem.reason, problem.remedy)
        if problem is not None:
            raise problem
        raise UnreachableError(
            "gateway",
            "any linked peer",
            "start one with `rmpa gateway`; `rmpa peer list` shows the links. In a secured mesh "
            "`relays` of [trust] names the gateways that are believed",
        )

    def _believed(self) -> list[PeerSession]:
        """The linked peers whose word about other sites counts: any member could answer as a gateway."""
        return [session for session in self._linked() if self._gate.may_relay(session.link.name)]

    @staticmethod
    def _answer_peer(gateway: SiteAnswerer, what: str, asker: PeerSession, args: dict[str, Any]) -> Awaitable[object]:
        return gateway.answer(what, args, asker.link.name)

    async def _ask(
        self, session: PeerSession, what: str, args: dict[str, Any], wait: float
    ) -> tuple[Any, RmpaError | None]:
        try:
            return await self._rpc.request(session, what, args, wait), None
        except RmpaError as error:
            return None, error


def _is_no_gateway(error: RmpaError) -> bool:
    return isinstance(error, PeerRefused) and UNKNOWN_QUESTION in error.reason
