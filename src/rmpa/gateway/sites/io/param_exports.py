"""Answers the questions of other sites about parameters of this site's modules."""

from __future__ import annotations

import asyncio
import logging
from typing import TYPE_CHECKING, Any

from rmpa.bridge.params import rules as transfer
from rmpa.bridge.policy import Needs
from rmpa.config.peer_rules import Access
from rmpa.core.errors import PeerRefused, RmpaError
from rmpa.gateway import limits
from rmpa.gateway.sites.attachment import SiteAttachment
from rmpa.gateway.sites.keys import ROOT
from rmpa.gateway.sites.params import (
    GATEWAYS,
    ParamAnswer,
    ParamQuestion,
    SiteAsker,
    from_json,
    lost_with,
    parameters_in,
    parse_param_key,
    refused_one,
    to_json,
)
from rmpa.gateway.sites.part import SitePart
from rmpa.ros.wire.xmlrpc import parse_response, serialize_response

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable

    from rmpa.gateway.zenoh.queries import ArrivedQuery
    from rmpa.gateway.zenoh.session import Declaration, OpenSession

_log = logging.getLogger(__name__)
_NEEDS = Needs(
    (Access.PARAM,),
    "each parameter, of the site and of the modules that ask; also by the module that has it",
    key="rmpa/1/<site>/<module>/p/**",
)


class SiteParamExports(SitePart):
    """The parameters of this site's modules, as queryables: a ``SitePart``.

    Args:
        site: This site's name.
        session: The Zenoh session.
        ask: Asks a module of this site over the mesh: module, question, arguments; raises ``RmpaError``.
        why_not: ``(asker, module, parameter, told)``: why a site may not have a parameter; empty if it may. ``told``
            is what it asked for: a parameter that was found in that may be a secret.
    """

    name = "params"

    def __init__(
        self,
        site: str,
        session: OpenSession,
        ask: Callable[[str, str, dict[str, Any]], Awaitable[object]],
        why_not: Callable[[SiteAsker, str, str, str], str],
    ) -> None:
        self._site = site
        self._session = session
        self._ask = ask
        self._why_not = why_not
        self._queryable: Declaration | None = None
        self._tasks: set[asyncio.Task[None]] = set()
        self._asked = self._refused = 0

    def lead(self, leads: bool) -> None:
        """Answer while this gateway leads its site."""
        if leads and self._queryable is None:
            self._queryable = self._session.queryable(f"{ROOT}/{self._site}/*/p/**", self._take, _NEEDS)
        elif not leads and self._queryable is not None:
            self._queryable.close()
            self._queryable = None

    def report(self) -> dict[str, object]:
        """Questions of other sites, and how many got an error."""
        return {"asked": self._asked, "refused": self._refused}

    async def close(self) -> None:
        """Answer no more; questions under way get an error."""
        self.lead(leads=False)
        for task in self._tasks:
            task.cancel()
        await asyncio.gather(*self._tasks, return_exceptions=True)

    # --- inside ---------------------------------------------------------------------------------------------------

    def _take(self, query: ArrivedQuery) -> None:
        self._asked += 1
        if len(self._tasks) >= limits.SITE_PARAMS_AT_ONCE:
            self._refused += 1
            query.reply_error("too many questions about parameters at once; try again later")
            return
        task = asyncio.get_running_loop().create_task(self._answer(query), name="parameter for a site")
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)

    async def _answer(self, query: ArrivedQuery) -> None:
        try:
            asker = SiteAsker(SiteAttachment.parse(query.attachment).path[-1] if query.attachment else "")
            module, name = parse_param_key(query.key)
            if name == GATEWAYS:
                question = ParamQuestion.parse(query.payload)
                asker = SiteAsker(asker.site, question.askers)
                reply = (await self._for_gateway(asker, module, question)).serialize()
            elif query.payload:
                text = serialize_response(from_json(query.payload)).decode()
                reply = to_json(await self._set(asker, module, name, text))
            else:
                reply = to_json(parse_response((await self._get(asker, module, name)).encode()))
            query.reply(query.key, reply)
            query.finish()
        except PeerRefused as error:
            self._fail(query, error.reason)
        except RmpaError as error:
            self._fail(query, str(error))
        except asyncio.CancelledError:
            query.reply_error(f"the gateway of site {self._site} ends")
            raise
        except Exception:  # noqa: BLE001 - a task's top
            _log.exception("! a question about a parameter failed")
            self._fail(query, f"the gateway of site {self._site} failed at the parameter; its log says why")

    def _fail(self, query: ArrivedQuery, text: str) -> None:
        self._refused += 1
        query.reply_error(text)

    async def _for_gateway(self, asker: SiteAsker, module: str, question: ParamQuestion) -> ParamAnswer:
        match question.op:
            case "get":
                return ParamAnswer(text=await self._get(asker, module, question.key))
            case "names":
                return ParamAnswer(names=await self._names(asker, module))
            case "set":
                return ParamAnswer(count=await self._set(asker, module, question.key, question.text))
            case _:
                await self._delete(asker, module, question.key)
                return ParamAnswer()

    async def _get(self, asker: SiteAsker, module: str, key: str) -> str:
        try:
            text = transfer.text_of(await self._ask(module, transfer.GET, asker.args({"key": key})))
        except RmpaError:
            self._judge(asker, module, key, [key])  # it is not told whether it is there
            raise
        self._judge(asker, module, key, parameters_in(key, parse_response(text.encode())))
        return text

    async def _present(self, asker: SiteAsker, module: str) -> list[str]:
        text = transfer.text_of(await self._ask(module, transfer.NAMES, asker.args({})))
        names = parse_response(text.encode())
        return [str(name) for name in names] if isinstance(names, list) else []

    async def _names(self, asker: SiteAsker, module: str) -> list[str]:
        found = await self._present(asker, module)
        return [name for name in found if not self._why_not(asker, module, name, name)]

    async def _set(self, asker: SiteAsker, module: str, key: str, text: str) -> int:
        names = parameters_in(key, parse_response(text.encode()))
        self._judge(asker, module, key, names)
        # What the owner does not name it judges itself.
        self._judge(asker, module, key, lost_with(names, await self._present(asker, module)))
        return transfer.count_of(await self._ask(module, transfer.SET, asker.args({"key": key, "text": text})))

    async def _delete(self, asker: SiteAsker, module: str, key: str) -> None:
        self._judge(asker, module, key, [key])
        self._judge(asker, module, key, lost_with([key], await self._present(asker, module)))
        await self._ask(module, transfer.DELETE, asker.args({"key": key}))

    def _judge(self, asker: SiteAsker, module: str, key: str, names: list[str]) -> None:
        if why := refused_one(names, lambda name: self._why_not(asker, module, name, key)):
            raise PeerRefused(f"site {self._site}", why)
