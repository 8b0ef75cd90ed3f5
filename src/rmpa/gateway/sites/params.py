"""Parameters between sites: gateways ask each other for their modules, and judge every one, as its owner does."""

from __future__ import annotations

import base64
import time
from datetime import datetime
from functools import partial
from typing import TYPE_CHECKING, Any, Final, TypeVar

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
from rmpa.gateway.foreign import Answering
from rmpa.gateway.sites.keys import ROOT, MessageSource, read_json
from rmpa.gateway.sites.services import NO_MD5, caller
from rmpa.gateway.zenoh.threads import first_answer
from rmpa.ros.limits import PARAM_DEPTH_MAX
from rmpa.ros.master.parameters import leaves
from rmpa.ros.wire.xmlrpc import parse_response, serialize_response

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable, Iterable, Iterator

    from rmpa.gateway.sites.topics import SiteContext
    from rmpa.gateway.zenoh.queries import ArrivedQuery
    from rmpa.gateway.zenoh.session import Declaration
    from rmpa.ros.wire.tcpros import Buffer
    from rmpa.ros.wire.xmlrpc import XmlRpcValue

# Questions of other sites about parameters that are answered at once.
_SITE_PARAMS_AT_ONCE: Final = 256

_T = TypeVar("_T")
_NEEDS: Final = Needs(
    (Access.PARAM,),
    "each parameter, of the site and of the modules that ask; also by the module that has it",
    key="rmpa/1/<site>/<module>/p/**",
)


# --- Parameters between sites ---------------------------------------------------------------------------------------
#
# Without I/O.
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


# The last chunk of the key at which gateways ask.
GATEWAYS: Final = "-"
# The requests of ``bridge.params.rules`` without ``param.``.
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

    @classmethod
    def parse(cls, data: Buffer) -> ParamQuestion:
        """Read one.

        Raises:
            RemoteProtocolError: It is none, or names something that is no parameter.
        """
        found = read_text_about(data, cls)
        if found.op not in OPERATIONS:
            raise RemoteProtocolError(f"{found.op[:40]!r} is no question about parameters")
        if len(found.askers) > bridge_limits.PARAM_ASKERS_MAX or any(map(peer_name_problem, found.askers)):
            raise RemoteProtocolError("askers are not the names of modules, or too many")
        if found.op != "names" and (problem := key_problem(found.key)):
            raise RemoteProtocolError(problem)
        found.key = plain_key(found.key)
        return found


class ParamAnswer(msgspec.Struct, omit_defaults=True, kw_only=True):
    """The answer to a ``ParamQuestion``; the fields are those that its text names."""

    text: str = ""
    names: list[str] = []
    count: int = 0


def read_text_about(data: Buffer, kind: type[_T]) -> _T:
    """Read a text about parameters; raises ``RemoteProtocolError`` if it is none."""
    return read_json(data, kind, "a text about parameters", limits.SITE_PARAM_BYTES_MAX)


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
    around = {space for name in wanted for space in _namespaces(name)}
    return [
        name
        for name in present
        if name in around
        or (name not in wanted and ("/" in wanted or any(space in wanted for space in _namespaces(name))))
    ]


def _namespaces(name: str) -> Iterator[str]:
    return (name[:at] for at, letter in enumerate(name) if letter == "/" and at)


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
    value = read_text_about(data, object)
    _check_members(value)
    return value


def _check_members(value: object, depth: int = 0) -> None:
    if value is None:
        raise RemoteProtocolError("the value is null or contains one, which ROS does not have; leave it out")
    if depth > PARAM_DEPTH_MAX:
        raise RemoteProtocolError(f"the value is nested deeper than {PARAM_DEPTH_MAX} levels")
    for member in value.values() if isinstance(value, dict) else value if isinstance(value, list) else ():
        _check_members(member, depth + 1)


async def ask_judged(
    ask: Callable[[str, dict[str, Any]], Awaitable[object]],
    what: str,
    key: str,
    text: str,
    why_not: Callable[[str, str], str] | None,
) -> dict[str, Any]:
    """Ask for parameters what may be asked: each one, all within a namespace, and all that would be lost.

    Args:
        ask: Asks the owner, or the gateway there: a request of ``bridge.params.rules`` and its arguments.
        what: That request.
        key: The parameter's name, or a namespace.
        text: What it is set to.
        why_not: ``(parameter, told)``: why it may not be had; empty if it may. ``told`` is what was asked for: a
            parameter that was found in that may be a secret. ``None``: everything may.

    Raises:
        PeerRefused: It may not, or the other side has refused.
    """

    def judge(names: Iterable[str]) -> None:
        why = next((why for name in names if (why := why_not(name, key))), "") if why_not is not None else ""
        if why:
            raise PeerRefused("this gateway", why)

    async def present() -> list[str]:
        names = await read_text(transfer.text_of(await ask(transfer.NAMES, {})))
        return [str(name) for name in names] if isinstance(names, list) else []

    match what:
        case transfer.NAMES:
            found = [name for name in await present() if why_not is None or not why_not(name, name)]
            return {"text": await write_text("the list of parameters", list(found))}
        case transfer.GET:
            try:
                got = transfer.text_of(await ask(what, {"key": key}))
            except RmpaError:
                judge([key])  # it is not told whether it is there
                raise
            judge(parameters_in(key, await read_text(got)))
            return {"text": got}
        case transfer.SET | transfer.DELETE:
            setting = what == transfer.SET
            written = parameters_in(key, await read_text(text)) if setting else [key]
            judge(written)
            if why_not is not None:
                judge(lost_with(written, await present()))  # what the owner does not name it judges itself
            answer = await ask(what, {"key": key, "text": text} if setting else {"key": key})
            return {"count": transfer.count_of(answer)} if setting else {}
    raise RemoteProtocolError(f"{what[:40]!r} is no question about parameters")


class SiteParams:
    """Answers the questions of other sites about parameters of this site's modules, and asks them about theirs.

    Args:
        context: What is shared with topics and services.
        ask: Asks a module of this site over the mesh: module, question, arguments; raises ``RmpaError``.
    """

    def __init__(self, context: SiteContext, ask: Callable[[str, str, dict[str, Any]], Awaitable[object]]) -> None:
        self._context = context
        self._ask = ask
        self._answering = Answering("parameters", f"the gateway of site {context.name} ends", _SITE_PARAMS_AT_ONCE)
        self.close: Final = self._answering.close

    def answer(self) -> Declaration:
        """Answer questions, until that is closed."""
        take = partial(self._answering.take, respond=self._respond)
        return self._context.session.queryable(f"{ROOT}/{self._context.name}/*/p/**", take, _NEEDS)

    # --- questions of other sites ---------------------------------------------------------------------------------

    async def _respond(self, query: ArrivedQuery) -> tuple[bytes, bytes]:
        site, _ = caller(query)
        module, name = parse_param_key(query.key)
        if name == GATEWAYS:
            asked = ParamQuestion.parse(query.payload)
            found = await self._owner(site, module, asked)
            if asked.op == "names":
                found = {"names": await read_text(found["text"])}
            return msgspec.json.encode(ParamAnswer(**found)), b""
        if query.payload:
            text = serialize_response(from_json(query.payload)).decode()
            found = await self._owner(site, module, ParamQuestion(op="set", key=name, text=text))
            return to_json(found["count"]), b""
        found = await self._owner(site, module, ParamQuestion(op="get", key=name))
        return to_json(parse_response(found["text"].encode())), b""

    async def _owner(self, site: str, module: str, asked: ParamQuestion) -> dict[str, Any]:
        """Ask a module of this site what another site may ask."""

        def ask(what: str, args: dict[str, Any]) -> Awaitable[object]:
            return self._ask(module, what, {**args, "site": site, "askers": list(asked.askers)})

        def why_not(name: str, told: str) -> str:
            return self._context.rules.refusal(site, module, name, Access.PARAM, asked.askers, told)

        return await ask_judged(ask, f"param.{asked.op}", asked.key, asked.text, why_not)

    # --- questions of this site -----------------------------------------------------------------------------------

    async def ask(self, asker: str, site: str, module: str, args: dict[str, Any]) -> object:
        """Answer a request of ``bridge.params.rules`` for a module of another site.

        Args:
            asker: The linked module that asks; empty for this machine's user.
            site: The other site.
            module: The module there.
            args: The request, as ``what``, and its arguments.

        Raises:
            PeerRefused: This gateway, module or site refused.
            UnreachableError: No gateway of that site answers for the module.
        """
        if site == self._context.name:
            raise PeerRefused(site, f"{module} is a module of this very site: ask it itself, by --peer {module}")
        what, key = str(args.get("what", "")), plain_key(str(args.get("key", "")))
        text = transfer.text_of(args) if what == transfer.SET else ""
        rules = self._context.rules

        def why_not(name: str, told: str) -> str:
            return rules.denial(asker, name, Access.PARAM, told=told)

        judge = why_not if asker and rules.secured else None
        return await ask_judged(partial(self._other_site, asker, site, module), what, key, text, judge)

    async def _other_site(self, asker: str, site: str, module: str, what: str, args: dict[str, Any]) -> object:
        question = ParamQuestion(op=what.removeprefix("param."), askers=(asker,) if asker else (), **args)
        attachment = MessageSource(NO_MD5, "/rmpa", (self._context.name,)).writer()
        replies = await self._context.session.get(
            param_key(site, module, GATEWAYS),
            msgspec.json.encode(question),
            attachment(1, time.time_ns()),
            timeout=limits.SITE_PARAM_TIMEOUT,
        )
        if (reply := first_answer(replies)) is None:
            where = f"site {site} for its module {module}"
            raise UnreachableError("gateway", where, "`rmpa site info` shows which modules are there")
        if not reply.ok:
            raise PeerRefused(f"{site}/{module}", reply.text)
        answer = read_text_about(reply.payload, ParamAnswer)
        if what == transfer.NAMES:
            return {"text": await write_text("the list of parameters", list(answer.names))}
        return {"text": answer.text, "count": answer.count}
