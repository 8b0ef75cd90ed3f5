"""Answers the questions of other sites about parameters of this site's modules."""

from __future__ import annotations

import asyncio
import base64
import logging
from dataclasses import dataclass
from datetime import datetime
from typing import TYPE_CHECKING, Any, Final

import msgspec

from rmpa.bridge import limits as bridge_limits
from rmpa.bridge.params import rules as transfer
from rmpa.bridge.params.owner import read_text, write_text
from rmpa.bridge.params.rules import key_problem
from rmpa.bridge.policy import Needs
from rmpa.config.peer_rules import Access
from rmpa.core.errors import PeerRefused, RemoteProtocolError, RmpaError, UnreachableError
from rmpa.core.identity import peer_name_problem
from rmpa.gateway import limits
from rmpa.gateway.sites.keys import ROOT, SiteAttachment
from rmpa.gateway.sites.plans import SitePart
from rmpa.gateway.sites.services import NO_MD5
from rmpa.ros.limits import PARAM_DEPTH_MAX
from rmpa.ros.master.parameters import leaves
from rmpa.ros.wire.xmlrpc import parse_response, serialize_response

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable, Collection, Iterable

    from rmpa.gateway.zenoh.config import ArrivedQuery
    from rmpa.gateway.zenoh.session import Declaration, OpenSession
    from rmpa.ros.wire.tcpros import Buffer
    from rmpa.ros.wire.xmlrpc import XmlRpcValue


# Parameters between sites. Without I/O.
#
# ``get`` on ``rmpa/1/<site>/<module>/p/<name>`` brings a parameter, or a namespace as an object, as JSON; with a
# payload it sets it to that JSON. JSON has neither binary data nor dates, so gateways ask at
# ``rmpa/1/<site>/<module>/p/-`` with values as the text of an XML-RPC response::
#
#     {"op": "get", "key": "/gains"}                          {"text": "<?xml …"}
#     {"op": "names"}                                         {"names": ["/gains/p", …]}
#     {"op": "set", "key": "/gains/p", "text": "<?xml …"}     {"count": 1}
#     {"op": "delete", "key": "/gains/p"}                     {}
#
# Each question has ``"askers": ["arm"]``, the modules of the other site that ask.


GATEWAYS: Final = "-"
"""The last chunk of the key at which gateways ask."""
OPERATIONS: Final = ("get", "names", "set", "delete")


class ParamQuestion(msgspec.Struct, omit_defaults=True, kw_only=True):
    """One question of a gateway; see the module's text.

    Attributes:
        op: One of ``OPERATIONS``.
        key: The parameter's global name in its module.
        text: The value as XML-RPC text.
        askers: The modules for which the gateway asks.
    """

    op: str
    key: str = ""
    text: str = ""
    askers: tuple[str, ...] = ()

    def serialize(self) -> bytes:
        """As JSON."""
        return msgspec.json.encode(self)

    @classmethod
    def parse(cls, data: Buffer) -> ParamQuestion:
        """Read one.

        Raises:
            RemoteProtocolError: It is none, or names something that is no parameter.
        """
        found: ParamQuestion = _decode(data, cls)
        if found.op not in OPERATIONS:
            raise RemoteProtocolError(f"{found.op[:40]!r} is no question about parameters")
        if len(found.askers) > bridge_limits.PARAM_ASKERS_MAX or any(map(peer_name_problem, found.askers)):
            raise RemoteProtocolError("askers are not the names of modules, or too many")
        if found.op != "names" and (problem := key_problem(found.key)):
            raise RemoteProtocolError(problem)
        found.key = plain_key(found.key)
        return found


@dataclass(frozen=True, slots=True)
class SiteAsker:
    """What asks for parameters of this site.

    Args:
        site: The other site; empty for a program that names none.
        modules: Its modules that ask, as its gateway says.
    """

    site: str
    modules: tuple[str, ...] = ()

    def args(self, args: dict[str, Any]) -> dict[str, Any]:
        """A request's arguments (``bridge.params.rules``), for the module that has the parameters."""
        return {**args, "site": self.site, "askers": list(self.modules)}


class ParamAnswer(msgspec.Struct, omit_defaults=True, kw_only=True):
    """The answer to a ``ParamQuestion``; the fields are those that its text names."""

    text: str = ""
    names: list[str] = []
    count: int = 0

    def serialize(self) -> bytes:
        """As JSON."""
        return msgspec.json.encode(self)

    @classmethod
    def parse(cls, data: Buffer) -> ParamAnswer:
        """Read one.

        Raises:
            RemoteProtocolError: It is none.
        """
        found: ParamAnswer = _decode(data, cls)
        return found


def _decode(data: Buffer, kind: type[Any]) -> Any:
    if len(data) > limits.SITE_PARAM_BYTES_MAX:
        raise RemoteProtocolError(f"a text about parameters has {len(data)} bytes")
    try:
        return msgspec.json.decode(data, type=kind)
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
        raise RemoteProtocolError(f"not a text about parameters: {error}") from None


def param_key(site: str, module: str, name: str) -> str:
    """The key of a parameter."""
    return f"{ROOT}/{site}/{module}/p/{name.strip('/')}"


def parse_param_key(key: str) -> tuple[str, str]:
    """Module and parameter of a key; the parameter is ``-`` where gateways ask.

    Raises:
        RemoteProtocolError: It is not the key of one parameter.
    """
    chunks = key.split("/")
    if len(key) > limits.KEY_MAX or len(chunks) < 6 or "/".join(chunks[:2]) != ROOT or chunks[4] != "p":
        raise RemoteProtocolError(f"{key[:120]!r} is not the key of a parameter")
    if any("*" in chunk for chunk in chunks):
        raise RemoteProtocolError(f"{key[:120]!r} names several; ask for one, or for a namespace")
    name = plain_key("/" + "/".join(chunks[5:]))
    return chunks[3], GATEWAYS if name == "/" + GATEWAYS else name


def plain_key(key: str) -> str:
    """A key as masters take it and rules are written: without the slashes at its end."""
    return key.rstrip("/") or key[:1]


def parameters_in(key: str, value: XmlRpcValue) -> list[str]:
    """The parameters of a value: itself, or those of a namespace."""
    if not isinstance(value, dict) or not value:
        return [key]
    return [plain_key(name) for name, _ in leaves(key, value)]


def lost_with(written: Iterable[str], present: Iterable[str]) -> list[str]:
    """The parameters that are lost if others are written or deleted: those within them, and those around them.

    Args:
        written: The parameters.
        present: All that are there.
    """
    wanted = {plain_key(name) for name in written}
    around = {name[:at] for name in wanted for at, letter in enumerate(name) if letter == "/" and at}
    return [name for name in present if name in around or (name not in wanted and _is_within(name, wanted))]


def _is_within(name: str, namespaces: Collection[str]) -> bool:
    return "/" in namespaces or any(name[:at] in namespaces for at, letter in enumerate(name) if letter == "/" and at)


def refused_one(names: Iterable[str], why_not: Callable[[str], str]) -> str:
    """Why parameters may not cross: the first reason for one of them; empty if all may."""
    return next((why for name in names if (why := why_not(name))), "")


def to_json(value: XmlRpcValue) -> bytes:
    """A value as JSON: binary data in base64, dates in ISO 8601."""
    return msgspec.json.encode(_plain(value))


def _plain(value: Any) -> Any:
    if isinstance(value, dict):
        return {name: _plain(member) for name, member in value.items()}
    if isinstance(value, list):
        return [_plain(member) for member in value]
    if isinstance(value, bytes):
        return base64.b64encode(value).decode()
    return value.isoformat() if isinstance(value, datetime) else value


def from_json(data: Buffer) -> Any:
    """The value of a JSON text.

    Raises:
        RemoteProtocolError: It is none, too large, nested too deeply, or contains null, which ROS does not have.
    """
    if len(data) > bridge_limits.PARAM_TEXT_MAX:
        raise RemoteProtocolError(f"a value of {len(data)} bytes; at most {bridge_limits.PARAM_TEXT_MAX} cross")
    value = _decode(data, object)
    _check_members(value)
    return value


def _check_members(value: object, depth: int = 0) -> None:
    if value is None:
        raise RemoteProtocolError("the value is null or contains one, which ROS does not have; leave it out")
    if depth > PARAM_DEPTH_MAX:
        raise RemoteProtocolError(f"the value is nested deeper than {PARAM_DEPTH_MAX} levels")
    for member in value.values() if isinstance(value, dict) else value if isinstance(value, list) else ():
        _check_members(member, depth + 1)


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


# Asks other sites about parameters of their modules.


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
        """Answer a request of ``bridge.params.rules`` for a module of another site.

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
            "gateway", f"site {site} for its module {module}", "`rmpa site info` shows which modules are there"
        )
