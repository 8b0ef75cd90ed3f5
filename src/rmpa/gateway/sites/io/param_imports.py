"""Asks other sites about parameters of their modules, and keeps those equal that modules here follow."""

from __future__ import annotations

import asyncio
import logging
from collections import defaultdict
from typing import TYPE_CHECKING, Any, Protocol

from rmpa.bridge.params import transfer
from rmpa.bridge.params.io.core import read_text, write_text
from rmpa.core.counters import Counters, RefusalLog
from rmpa.core.errors import PeerRefused, RemoteProtocolError, RmpaError, UnreachableError
from rmpa.gateway import limits
from rmpa.gateway.sites.attachment import SiteAttachment
from rmpa.gateway.sites.params import GATEWAYS, ParamAnswer, ParamNews, ParamQuestion, digest, followed_of, param_key
from rmpa.gateway.sites.services import NO_MD5

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable

    from rmpa.gateway.zenoh_api import ZenohSession
    from rmpa.ros.wire.xmlrpc import XmlRpcValue

_log = logging.getLogger(__name__)


class FollowedCore(Protocol):
    """The gateway's own parameters: ``bridge.params.io.part.Params``."""

    @property
    def followed_by_peers(self) -> Iterable[str]:
        """The keys that a linked module follows."""

    async def provide(self, key: str, value: XmlRpcValue) -> None:
        """Set a parameter, of which the linked modules are notified; ``None`` deletes it."""


class SiteParamImports:
    """The parameters of other sites' modules.

    Args:
        site: This site's name.
        session: The Zenoh session.
        stamp: The wall clock, nanoseconds since 1970.
        core: The gateway's own parameters, which hold followed ones as ``/<site>/<module>/<name>``.
        sites: Returns the names of the sites that are there.
    """

    def __init__(
        self,
        site: str,
        session: ZenohSession,
        stamp: Callable[[], int],
        core: FollowedCore,
        sites: Callable[[], Iterable[str]],
    ) -> None:
        self._site = site
        self._session = session
        self._stamp = stamp
        self._core = core
        self._sites = sites
        self._transfers: dict[tuple[str, str], transfer.Transfers] = defaultdict(transfer.Transfers)
        self._known: dict[str, str] = {}
        """The digest of each followed parameter, by its key here."""
        self.problems: dict[str, str] = {}
        """Why a followed parameter is not as at its module, by its key here."""
        self._counters = Counters()
        self._log = RefusalLog(_log, self._counters)
        self._following: asyncio.Task[None] | None = None

    def start(self) -> None:
        """Begin to follow."""
        if self._following is None:
            self._following = asyncio.get_running_loop().create_task(self._follow(), name="follow other sites")

    async def close(self) -> None:
        """Stop following; the values stay."""
        if self._following is not None:
            self._following.cancel()
            await asyncio.gather(self._following, return_exceptions=True)
            self._following = None

    @property
    def followed(self) -> int:
        """The number of parameters that are followed from other sites."""
        return len(self._known)

    async def ask(self, site: str, module: str, what: str, args: dict[str, Any]) -> object:
        """Answer a request of ``bridge.params.transfer`` for a module of another site.

        Raises:
            PeerRefused: Module or site refused.
            UnreachableError: No gateway of that site answers for the module.
        """
        transfers, now = self._transfers[site, module], asyncio.get_running_loop().time()
        while len(self._transfers) > limits.SITE_PARAM_TRANSFERS_MAX:
            del self._transfers[next(iter(self._transfers))]
        key = str(args.get("key", ""))
        match what:
            case transfer.GET:
                found = await self._question(site, module, ParamQuestion(op="get", key=key))
                return transfers.answer(found.text, now)
            case transfer.NAMES:
                found = await self._question(site, module, ParamQuestion(op="names"))
                return transfers.answer(await write_text("the list of parameters", list(found.names)), now)
            case transfer.MORE:
                return transfers.more(args, now)
            case transfer.PUT:
                return transfers.put(args, now)
            case transfer.SET:
                text = transfers.written(args, now)
                found = await self._question(site, module, ParamQuestion(op="set", key=key, text=text))
                return {"count": found.count}
            case transfer.DELETE:
                await self._question(site, module, ParamQuestion(op="delete", key=key))
                return {}
        raise RemoteProtocolError(f"{what[:40]!r} is no question about parameters")

    async def _question(self, site: str, module: str, question: ParamQuestion) -> ParamAnswer:
        asker = SiteAttachment(1, self._stamp(), NO_MD5, "/rmpa", (self._site,))
        replies = await self._session.get(
            param_key(site, module, GATEWAYS),
            question.serialize(),
            asker.serialize(),
            timeout=limits.SITE_PARAM_TIMEOUT,
        )
        for reply in sorted(replies, key=lambda each: not each.ok):
            if reply.ok:
                return ParamAnswer.parse(reply.payload)
            raise PeerRefused(f"{site}/{module}", reply.payload.decode(errors="replace"))
        raise UnreachableError(
            "gateway", f"site {site} for its module {module}", "`rmpa site info` shows who is there"
        )

    # --- following --------------------------------------------------------------------------------------------------

    async def _follow(self) -> None:
        while True:
            await asyncio.sleep(limits.SITE_FOLLOW_INTERVAL)
            try:
                await self.look()
            except RmpaError as error:
                self._log.refuse(asyncio.get_running_loop().time(), "param.failed", "", f"following: {error}")
            except Exception:  # noqa: BLE001 - a task's top
                _log.exception("! following parameters of other sites failed")

    async def look(self) -> None:
        """Ask once for all that modules here follow, and set what has changed; values of absent sites stay."""
        wanted: dict[tuple[str, str], dict[str, str]] = {}
        there = {*self._sites(), self._site}
        for key in list(self._core.followed_by_peers):
            found = followed_of(key)
            if (
                found is not None
                and found[0] in there
                and sum(map(len, wanted.values())) < limits.SITE_PARAMS_AT_ONCE
            ):
                wanted.setdefault(found[:2], {})[key] = found[2]
        keys = {key for names in wanted.values() for key in names}
        for table in (self._known, self.problems):
            for key in [key for key in table if key not in keys]:
                del table[key]
        await asyncio.gather(*(self._look_at(site, module, names) for (site, module), names in wanted.items()))

    async def _look_at(self, site: str, module: str, names: dict[str, str]) -> None:
        last = {name: self._known.get(key, "") for key, name in names.items()}
        try:
            found = (await self._question(site, module, ParamQuestion(op="values", last=last))).values
        except RmpaError as error:
            found = {name: ParamNews(problem=str(error)) for name in last}
        for key, name in names.items():
            news = found.get(name)
            if news is None:
                self.problems.pop(key, None)
            elif news.problem:
                self.problems[key] = news.problem
                text = f"{key} is not followed from {site}/{module}: {news.problem}"
                self._log.refuse(asyncio.get_running_loop().time(), "param.refused", key, text)
            else:
                await self._take(key, news.text)

    async def _take(self, key: str, text: str | None) -> None:
        if text is not None or key in self._known:  # what was never there does not delete what is here
            await self._core.provide(key, await read_text(text) if text is not None else None)
        self._known[key] = digest(text)
        self.problems.pop(key, None)
