"""Asks other sites about parameters of their modules."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from rmpa.bridge.params import rules as transfer
from rmpa.bridge.params.owner import read_text, write_text
from rmpa.core.errors import PeerRefused, RemoteProtocolError, UnreachableError
from rmpa.gateway import limits
from rmpa.gateway.sites.attachment import SiteAttachment
from rmpa.gateway.sites.params import (
    GATEWAYS,
    ParamAnswer,
    ParamQuestion,
    lost_with,
    param_key,
    parameters_in,
    plain_key,
    refused_one,
)
from rmpa.gateway.sites.services import NO_MD5

if TYPE_CHECKING:
    from collections.abc import Callable

    from rmpa.gateway.zenoh.session import OpenSession


class SiteParamImports:
    """The parameters of other sites' modules.

    Args:
        site: This site's name.
        session: The Zenoh session.
        stamp: The wall clock, nanoseconds since 1970.
        why_not: ``(asker, parameter, told)``: why a module of this site, which asks, may not have a parameter, by its
            name at the other site; empty if it may. ``told`` is the name that it asked for. ``None``: trust is off.
    """

    def __init__(
        self,
        site: str,
        session: OpenSession,
        stamp: Callable[[], int],
        why_not: Callable[[str, str, str], str] | None = None,
    ) -> None:
        self._site = site
        self._session = session
        self._stamp = stamp
        self._why_not = why_not

    async def ask(self, asker: str, site: str, module: str, what: str, args: dict[str, Any]) -> object:
        """Answer a request of ``bridge.params.transfer`` for a module of another site.

        Args:
            asker: The linked module that asks; empty for this machine's user.
            site: The other site.
            module: The module there.
            what: The request.
            args: Its arguments.

        Raises:
            PeerRefused: This gateway, module or site refused.
            UnreachableError: No gateway of that site answers for the module.
        """
        if site == self._site:
            raise PeerRefused(site, f"{module} is a module of this very site: ask it itself, by --peer {module}")
        key, askers = plain_key(str(args.get("key", ""))), (asker,) if asker else ()
        match what:
            case transfer.GET:
                question = ParamQuestion(op="get", key=key, askers=askers)
                return {"text": await self._get(asker, site, module, question)}
            case transfer.NAMES:
                found = await self._names(asker, site, module)
                names = [name for name in found if not self._denial(asker, name, name)]
                return {"text": await write_text("the list of parameters", list(names))}
            case transfer.SET:
                text = transfer.text_of(args)
                written = parameters_in(key, await read_text(text))
                await self._judge_change(asker, site, module, key, written)
                question = ParamQuestion(op="set", key=key, text=text, askers=askers)
                return {"count": (await self._question(site, module, question)).count}
            case transfer.DELETE:
                await self._judge_change(asker, site, module, key, [key])
                await self._question(site, module, ParamQuestion(op="delete", key=key, askers=askers))
                return {}
        raise RemoteProtocolError(f"{what[:40]!r} is no question about parameters")

    async def _get(self, asker: str, site: str, module: str, question: ParamQuestion) -> str:
        key = question.key
        try:
            text = (await self._question(site, module, question)).text
        except PeerRefused:
            self._judge(asker, key, [key])  # it is not told whether it is there
            raise
        self._judge(asker, key, parameters_in(key, await read_text(text)))
        return text

    async def _names(self, asker: str, site: str, module: str) -> list[str]:
        askers = (asker,) if asker else ()
        return (await self._question(site, module, ParamQuestion(op="names", askers=askers))).names

    async def _judge_change(self, asker: str, site: str, module: str, key: str, written: list[str]) -> None:
        self._judge(asker, key, written)
        if asker and self._why_not is not None:
            self._judge(asker, key, lost_with(written, await self._names(asker, site, module)))

    def _judge(self, asker: str, key: str, names: list[str]) -> None:
        if why := refused_one(names, lambda name: self._denial(asker, name, key)):
            raise PeerRefused(f"site {self._site}", why)

    def _denial(self, asker: str, name: str, told: str) -> str:
        return "" if self._why_not is None else self._why_not(asker, name, told)

    async def _question(self, site: str, module: str, question: ParamQuestion) -> ParamAnswer:
        origin = SiteAttachment(1, self._stamp(), NO_MD5, "/rmpa", (self._site,))
        replies = await self._session.get(
            param_key(site, module, GATEWAYS),
            question.serialize(),
            origin.serialize(),
            timeout=limits.SITE_PARAM_TIMEOUT,
        )
        for reply in sorted(replies, key=lambda each: not each.ok):
            if reply.ok:
                return ParamAnswer.parse(reply.payload)
            raise PeerRefused(f"{site}/{module}", reply.payload.decode(errors="replace"))
        raise UnreachableError(
            "gateway", f"site {site} for its module {module}", "`rmpa site info` shows who is there"
        )
