"""Fuzz target: questions and answers about parameters between sites, and their values as JSON."""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING, Any, Final

import msgspec

from rmpa.core.errors import RemoteProtocolError, RmpaError
from rmpa.gateway.sites.params import (
    GATEWAYS,
    ParamAnswer,
    ParamQuestion,
    from_json,
    lost_with,
    param_key,
    parameters_in,
    parse_param_key,
    read_text_about,
    to_json,
)
from rmpa.ros.wire.xmlrpc import parse_response, serialize_response

if TYPE_CHECKING:
    from collections.abc import Callable

_TEXT: Final = serialize_response({"p": 1.5, "names": ["a", True], "blob": b"\0\1"}).decode()
SEEDS: list[bytes] = [
    b"",
    b"[" * 100_000,
    b'{"a":' * 900 + b"1" + b"}" * 900,
    b"9" * 100_000,
    b'"\\ud800"',
    b"\xff\xfe",
    msgspec.json.encode(ParamQuestion(op="get", key="/gains")),
    msgspec.json.encode(ParamQuestion(op="names", askers=("arm", "base"))),
    msgspec.json.encode(ParamQuestion(op="set", key="/gains/p", text=_TEXT)),
    msgspec.json.encode(ParamQuestion(op="delete", key="/gains")),
    msgspec.json.encode(ParamAnswer(text=_TEXT, names=["/a", "/b"], count=2)),
    b'{"p": 1, "i": [2, 3.5, "x", true], "deep": {"er": {}}}',
    b"[" * 300 + b"]" * 300,
    b"123456789012345678901234567890",
    b'{"": "\\u0000", "a/b": -1e999}',
    param_key("hall", "arm", "/gains/p").encode(),
    param_key("hall", "arm", GATEWAYS).encode(),
    b"rmpa/1/hall/arm/p/-/",
]


def fuzz(data: bytes) -> None:
    """Each text is read as it will be written again, or refused with a text that is safe to log."""
    parsers: list[Callable[[bytes], Any]] = [ParamQuestion.parse, partial(read_text_about, kind=ParamAnswer)]
    for parse in parsers:
        try:
            read = parse(data)
        except RemoteProtocolError as error:
            _check_text(error)
            continue
        if parse(msgspec.json.encode(read)) != read:
            raise AssertionError(f"{read} does not survive its text")
    _fuzz_value(data)
    key = data.decode("utf-8", "replace")
    try:
        module, name = parse_param_key(key)
    except RemoteProtocolError as error:
        _check_text(error)
    else:
        if parse_param_key(param_key("hall", module, name)) != (module, name) and name.strip("/") == name[1:]:
            raise AssertionError(f"{key!r} names another parameter once it is written")


def _fuzz_value(data: bytes) -> None:
    """What a program sets: JSON that becomes the text of XML-RPC, is judged, and is told again."""
    try:
        text = serialize_response(from_json(data))
        value = parse_response(text)
    except RmpaError as error:
        _check_text(error)
        return
    names = parameters_in("/a", value)
    if not all(name.startswith("/a") for name in names):
        raise AssertionError(f"{names} are not below /a")
    if lost_with(["/a"], names) != [name for name in names if name != "/a"]:
        raise AssertionError(f"{names} are all lost with /a")
    to_json(value)


def _check_text(error: RmpaError) -> None:
    if not str(error).isprintable():
        raise AssertionError(f"an error's text is not safe to log: {str(error)!r}")
