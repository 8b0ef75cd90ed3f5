"""Parameters between sites. Without I/O.

``get`` on ``rmpa/1/<site>/<module>/p/<name>`` brings a parameter, or a namespace as an object, as JSON; with a
payload it sets it to that JSON. JSON has neither binary data nor dates, so gateways ask at
``rmpa/1/<site>/<module>/p/-`` with values as the text of an XML-RPC response::

    {"op": "get", "key": "/gains"}                          {"text": "<?xml …"}
    {"op": "names"}                                         {"names": ["/gains/p", …]}
    {"op": "set", "key": "/gains/p", "text": "<?xml …"}     {"count": 1}
    {"op": "delete", "key": "/gains/p"}                     {}

Each question has ``"askers": ["arm"]``, the modules of the other site that ask.
"""

from __future__ import annotations

import base64
from dataclasses import dataclass
from datetime import datetime
from typing import TYPE_CHECKING, Any, Final

import msgspec

from rmpa.bridge import limits as bridge_limits
from rmpa.bridge.params.rules import key_problem
from rmpa.core.errors import RemoteProtocolError
from rmpa.core.identity import peer_name_problem
from rmpa.gateway import limits
from rmpa.gateway.sites.keys import ROOT
from rmpa.ros.limits import PARAM_DEPTH_MAX
from rmpa.ros.master.parameters import leaves

if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Iterable

    from rmpa.ros.wire.tcpros import Buffer
    from rmpa.ros.wire.xmlrpc import XmlRpcValue

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
        """A request's arguments (``bridge.params.transfer``), for the module that has the parameters."""
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
