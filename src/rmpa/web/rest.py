"""The REST API: parts of the agent's snapshot as JSON; no I/O.

The types are those of ``observe.snapshot``, as ``--json`` of the commands gives them. Errors are problem details
(RFC 9457).
"""

from __future__ import annotations

import difflib
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, NamedTuple
from urllib.parse import unquote

import msgspec

from rmpa.core.identity import is_legal_name
from rmpa.web import limits

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from rmpa.observe.snapshot import Snapshot

PREFIX: Final = "/api/v1"
"""Begins each path; a later version that breaks clients has another number."""
_JSON: Final = "application/json"
_PROBLEM_JSON: Final = "application/problem+json"
_NAME: Final = "{name}"


class Problem(msgspec.Struct, kw_only=True, frozen=True):
    """Why a request has no result (RFC 9457).

    Attributes:
        title: What happened, the same for all errors of this status.
        status: The HTTP status.
        detail: What happened with this request, and what to do.
    """

    title: str
    status: int
    detail: str


@dataclass(frozen=True, slots=True)
class RestResponse:
    """An HTTP response: status, body, its type, and further headers."""

    status: int
    body: bytes
    content_type: str = _JSON
    headers: tuple[tuple[str, str], ...] = ()


class _Missing(NamedTuple):
    """No resource has the name that was asked for; ``names`` are those that there are."""

    what: str
    name: str
    names: tuple[str, ...]


def _peer(snapshot: Snapshot, name: str) -> object:
    found = next((each for each in snapshot.peers if each.name == name), None)
    return found or _Missing("peer", name, tuple(each.name for each in snapshot.peers))


def _topic(snapshot: Snapshot, name: str) -> object:
    wanted = _global(name)
    found = next((each for each in snapshot.topics if each.name == wanted), None)
    return found or _Missing("topic", wanted, tuple(each.name for each in snapshot.topics))


def _service(snapshot: Snapshot, name: str) -> object:
    wanted = _global(name)
    found = tuple(each for each in snapshot.services if each.name == wanted)
    return found or _Missing("service", wanted, tuple(each.name for each in snapshot.services))


def _global(name: str) -> str:
    return name if name.startswith("/") else f"/{name}"


_RESOURCES: Final[Mapping[str, Callable[[Snapshot, str], object]]] = {
    "/snapshot": lambda s, _: s,
    "/agent": lambda s, _: s.agent,
    "/peers": lambda s, _: s.peers,
    "/peers/{name}": _peer,
    "/topics": lambda s, _: s.topics,
    "/topics/{name}": _topic,
    "/services": lambda s, _: s.services,
    "/services/{name}": _service,
    "/counters": lambda s, _: s.counters,
    "/notes": lambda s, _: s.notes,
    "/unreachable": lambda s, _: s.unreachable,
}
"""What each path below ``PREFIX`` gives."""


def respond(path: str, snapshot: Snapshot | None, why: str = "") -> RestResponse:
    """The response to a request by GET or HEAD.

    Args:
        path: Percent-encoded, without the query. Slashes of a topic's or a service's name need no encoding.
        snapshot: The newest; ``None`` while the agent does not answer.
        why: Why it does not, and what to do, where that is known.
    """
    read, name = _find(path)
    if read is None:
        return problem(404, f"there is no {_short(path)}; below {PREFIX} there are {', '.join(_RESOURCES)}")
    if snapshot is None:
        return problem(503, why or "the agent does not answer; start it with rmpa up, or look at its log")
    result = read(snapshot, name)
    if isinstance(result, _Missing):
        return problem(404, _missing(result))
    return RestResponse(200, msgspec.json.encode(result))


def _find(path: str) -> tuple[Callable[[Snapshot, str], object] | None, str]:
    below = path.removeprefix(PREFIX)
    if below == path or len(path) > limits.REST_PATH_MAX:
        return None, ""
    if below in _RESOURCES and _NAME not in below:
        return _RESOURCES[below], ""
    kind, _, rest = below.removeprefix("/").partition("/")
    read = _RESOURCES.get(f"/{kind}/{_NAME}")
    return (read, unquote(rest, errors="replace")) if read and rest else (None, "")


def _missing(missing: _Missing) -> str:
    text = f"there is no {missing.what} {_short(missing.name)}"
    near = difflib.get_close_matches(missing.name, missing.names[: limits.REST_NAMES_COMPARED], 1)
    if near:
        return f"{text}; did you mean {near[0]}?"
    if missing.what != "peer" and not is_legal_name(missing.name):
        return f"{text}: that is not a ROS name"
    return f"{text}; {PREFIX}/{missing.what}s lists all"


def _short(text: str) -> str:
    return ascii(text if len(text) <= 80 else f"{text[:80]}…")


_TITLES: Final = {
    400: "Bad request",
    401: "A token is needed",
    403: "Refused",
    404: "Not found",
    405: "Method not allowed",
    413: "Too large",
    500: "Internal error",
    503: "The agent does not answer",
}


def detail_of(response: RestResponse) -> str:
    """The text of a response that ``problem`` made."""
    return msgspec.json.decode(response.body, type=Problem).detail


def problem(status: int, detail: str, headers: tuple[tuple[str, str], ...] = ()) -> RestResponse:
    """The problem details of a status, as a response."""
    body = msgspec.json.encode(Problem(title=_TITLES[status], status=status, detail=detail))
    return RestResponse(status, body, _PROBLEM_JSON, headers)
