"""How a parameter crosses in portions, and the requests between two agents about parameters.

Values cross as the text of an XML-RPC response (``ros.wire.xmlrpc``), so that their types survive: JSON has neither
binary data nor dates. Each request of ``bridge.session.peer_rpc`` carries at most ``limits.PARAM_PORTION`` characters
of it, and the next is sent when the last was answered, so megabytes delay no command. ::

    param.get {key}                       → {size, text, reading}     reading: 0, or the number for param.more
    param.names {}                        → likewise; a list of the names of all parameters that may be read
    param.more {reading, offset}          → {text}
    param.put {writing, offset, text}     → {size}
    param.set {key, text}                 → {count}                   text, or what was put: {key, writing, size}
    param.delete {key}                    → {}
    param.follow {keys}                   → {refused}                 from now on their changes, as below
    notification param.value {key, exists, size, text}                without text: larger than a portion; read it

A gateway that asks for another site adds ``site`` (empty for a program that names none) and ``askers``, modules of
that site. Then the owner asks the permissions of the gateway, of the site, and denials of those modules.

The asking side is two generators, used by the agent's event loop and by the command line: they yield requests, and
the answers are sent to them.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Final

from rmpa.bridge import limits
from rmpa.core.errors import LimitExceeded, LocalProtocolError, RemoteProtocolError

if TYPE_CHECKING:
    from collections.abc import Generator, Mapping

GET: Final = "param.get"
NAMES: Final = "param.names"
MORE: Final = "param.more"
PUT: Final = "param.put"
SET: Final = "param.set"
DELETE: Final = "param.delete"
FOLLOW: Final = "param.follow"
VALUE: Final = "param.value"
QUESTIONS: Final = (GET, NAMES, MORE, PUT, SET, DELETE)
"""The requests that the command line may have its agent send."""

Question = tuple[str, dict[str, Any]]
"""The name of a request, and its arguments."""


def reading(what: str, args: dict[str, Any]) -> Generator[Question, object, str]:
    """Read a value (``param.get``, ``param.names``): yields requests, is sent the answers, returns the whole text.

    Args:
        what: The name of the first request.
        args: Its arguments.

    Raises:
        RemoteProtocolError: An answer is malformed, or the portions do not add up to the stated size.
        LimitExceeded: The stated size is above ``limits.PARAM_TEXT_MAX``.
    """
    answer = _answer((yield what, args))
    size, text, number = _whole(answer, "size"), _text(answer), _whole(answer, "reading")
    check_size(size)
    parts, have = [text], len(text)
    while have < size:
        if not parts[-1]:
            raise RemoteProtocolError(f"{what}: {have} of {size} characters came, and no more")
        parts.append(_text(_answer((yield MORE, {"reading": number, "offset": have}))))
        have += len(parts[-1])
    if have != size:
        raise RemoteProtocolError(f"{what}: {have} characters came instead of {size}")
    return "".join(parts)


def writing(key: str, text: str, number: int) -> Generator[Question, object, int]:
    """Set a parameter, a namespace's members one by one: yields requests, is sent the answers.

    Args:
        key: The parameter's name.
        text: The value as XML-RPC text.
        number: Identifies the portions; no other value that is being written through the same agent may have it.

    Returns:
        How many parameters were set.

    Raises:
        RemoteProtocolError: An answer is malformed, or the peer has lost a portion.
        LocalProtocolError: The value is too large.
    """
    if len(text) > limits.PARAM_TEXT_MAX:
        raise LocalProtocolError(too_large(key, len(text)))
    if len(text) <= limits.PARAM_PORTION:
        return _whole(_answer((yield SET, {"key": key, "text": text})), "count")
    for offset in range(0, len(text), limits.PARAM_PORTION):
        portion = text[offset : offset + limits.PARAM_PORTION]
        answer = _answer((yield PUT, {"writing": number, "offset": offset, "text": portion}))
        if _whole(answer, "size") != offset + len(portion):
            raise RemoteProtocolError(f"{key}: the other side has lost a part of it")
    args = {"key": key, "writing": number, "size": len(text)}
    return _whole(_answer((yield SET, args)), "count")


def check_size(size: int) -> None:
    """Check the size of a value, in characters.

    Raises:
        LimitExceeded: It is above ``limits.PARAM_TEXT_MAX``.
    """
    if not 0 <= size <= limits.PARAM_TEXT_MAX:
        raise LimitExceeded("parameter", size, limits.PARAM_TEXT_MAX)


def too_large(key: str, size: int) -> str:
    """The error text for a value that is too large to cross."""
    most = limits.PARAM_TEXT_MAX
    return (
        f"{key} has {size} characters as XML-RPC text, above the {most} ({most >> 20} MiB) that cross between "
        "modules; take its parts one by one, or let a latched topic carry it"
    )


@dataclass(slots=True)
class _Transfer:
    text: str = ""
    parts: list[str] = field(default_factory=list)
    size: int = 0
    seen: float = 0.0


class Transfers:
    """The answering side's state: what one peer is reading or writing in portions."""

    def __init__(self) -> None:
        self._readings: dict[int, _Transfer] = {}
        self._writings: dict[int, _Transfer] = {}
        self._numbers = itertools.count(1)

    def answer(self, text: str, now: float) -> dict[str, object]:
        """The answer to ``param.get`` or ``param.names``: the whole text, or its first portion.

        Args:
            text: The value.
            now: Monotonic seconds.
        """
        if len(text) <= limits.PARAM_PORTION:
            return {"size": len(text), "text": text, "reading": 0}
        number = next(self._numbers)
        self._keep(self._readings, number, _Transfer(text, seen=now), now)
        return {"size": len(text), "text": text[: limits.PARAM_PORTION], "reading": number}

    def more(self, args: Mapping[str, Any], now: float) -> dict[str, object]:
        """The next portion of a value that is being read.

        Raises:
            RemoteProtocolError: No such value is being read, or it was dropped.
        """
        offset = _whole(args, "offset")
        transfer = self._get(self._readings, _whole(args, "reading"), now)
        portion = transfer.text[offset : offset + limits.PARAM_PORTION]
        if offset + len(portion) >= len(transfer.text):
            del self._readings[_whole(args, "reading")]
        return {"text": portion}

    def put(self, args: Mapping[str, Any], now: float) -> dict[str, object]:
        """Store a portion of a value that is to be set; offset 0 begins a value.

        Raises:
            LimitExceeded: The value is too large.
            RemoteProtocolError: The portion is not the next one, or the value was dropped.
        """
        number, offset, text = _whole(args, "writing"), _whole(args, "offset"), _text(args)
        if offset == 0:
            self._keep(self._writings, number, _Transfer(seen=now), now)
        transfer = self._get(self._writings, number, now)
        if offset != transfer.size:
            raise RemoteProtocolError(f"a portion at {offset} where {transfer.size} characters are there")
        check_size(transfer.size + len(text))
        transfer.parts.append(text)
        transfer.size += len(text)
        return {"size": transfer.size}

    def written(self, args: Mapping[str, Any], now: float) -> str:
        """Take the text that is to be set: from the request itself, or from the portions put before.

        Raises:
            RemoteProtocolError: The portions were dropped, or do not add up to the stated size.
        """
        if "writing" not in args:
            return _text(args)
        transfer = self._get(self._writings, _whole(args, "writing"), now)
        del self._writings[_whole(args, "writing")]
        if transfer.size != _whole(args, "size"):
            raise RemoteProtocolError(f"{transfer.size} characters came instead of {args['size']}")
        return "".join(transfer.parts)

    def _keep(self, table: dict[int, _Transfer], number: int, transfer: _Transfer, now: float) -> None:
        for known in [n for n, t in table.items() if now - t.seen > limits.PARAM_TRANSFER_IDLE]:
            del table[known]
        table.pop(number, None)
        while len(table) >= limits.PARAM_TRANSFERS:
            del table[next(iter(table))]
        table[number] = transfer

    def _get(self, table: dict[int, _Transfer], number: int, now: float) -> _Transfer:
        transfer = table.get(number)
        if transfer is None:
            raise RemoteProtocolError("this parameter's transfer was given up; try again")
        transfer.seen = now
        return transfer


def _answer(value: object) -> Mapping[str, Any]:
    if not isinstance(value, dict):
        raise RemoteProtocolError(f"an answer about a parameter that is none: {str(value)[:100]!r}")
    return value


def _whole(args: Mapping[str, Any], name: str) -> int:
    value = args.get(name)
    if not isinstance(value, int) or isinstance(value, bool) or value < 0:
        raise RemoteProtocolError(f"{name} is {str(value)[:100]!r}, not a whole number")
    return value


def _text(args: Mapping[str, Any]) -> str:
    value = args.get("text")
    if not isinstance(value, str) or len(value) > limits.PARAM_PORTION:
        raise RemoteProtocolError("text is missing, or longer than a portion")
    return value
