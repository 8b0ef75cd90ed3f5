"""The REST API: parts of the agent's snapshot as JSON, and the OpenAPI 3.1 document that describes it; no I/O.

All resources are read with GET. The types are those of ``observe.snapshot``, as ``--json`` of the commands gives
them; their schemas and texts are made from these types. Errors are problem details (RFC 9457).
"""

from __future__ import annotations

import difflib
import functools
import inspect
import re
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final, NamedTuple
from urllib.parse import unquote

import msgspec

from rmpa.core.names import is_legal_name
from rmpa.observe.peer_info import PeerInfo
from rmpa.observe.snapshot import AgentInfo, ServiceInfo, Snapshot, TopicInfo, UnreachableInfo
from rmpa.web import limits

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Mapping, Sequence

PREFIX: Final = "/api/v1"
"""Begins each path; a later version that breaks clients has another number."""
OPENAPI_PATH: Final = f"{PREFIX}/openapi.json"
_JSON: Final = "application/json"
_PROBLEM_JSON: Final = "application/problem+json"
_METHODS: Final = ("GET", "HEAD")
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


@dataclass(frozen=True, slots=True)
class RestResource:
    """One path of the API.

    Attributes:
        path: Below ``PREFIX``; may end with ``{name}``.
        summary: One line for the document.
        type: Of the result.
        read: Takes it from a snapshot, for a name where the path has one.
    """

    path: str
    summary: str
    type: Any  # a type of msgspec, as a value
    read: Callable[[Snapshot, str], object]

    @property
    def identity(self) -> str:
        """The operation's id in the document, unique in it."""
        words = self.path.strip("/").removesuffix(f"s/{_NAME}")
        return f"get{words.capitalize()}"


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


RESOURCES: Final = (
    RestResource("/snapshot", "The whole state of the agent.", Snapshot, lambda s, _: s),
    RestResource("/agent", "The agent itself.", AgentInfo, lambda s, _: s.agent),
    RestResource("/peers", "All peers.", tuple[PeerInfo, ...], lambda s, _: s.peers),
    RestResource("/peers/{name}", "One peer, by its name.", PeerInfo, _peer),
    RestResource("/topics", "All topics, with their routes.", tuple[TopicInfo, ...], lambda s, _: s.topics),
    RestResource("/topics/{name}", "One topic, by its global name.", TopicInfo, _topic),
    RestResource("/services", "All services.", tuple[ServiceInfo, ...], lambda s, _: s.services),
    RestResource("/services/{name}", "All services of a global name.", tuple[ServiceInfo, ...], _service),
    RestResource("/counters", "What was refused or dropped, by its reason.", dict[str, int], lambda s, _: s.counters),
    RestResource("/notes", "What the user should know.", tuple[str, ...], lambda s, _: s.notes),
    RestResource(
        "/unreachable",
        "Nodes to which no connection can be made.",
        tuple[UnreachableInfo, ...],
        lambda s, _: s.unreachable,
    ),
)
_BY_PATH: Final = {resource.path: resource for resource in RESOURCES}


def respond(method: str, path: str, snapshot: Snapshot | None, why: str = "") -> RestResponse:
    """The response to a request.

    Args:
        method: As in the request: ``GET``, or ``HEAD``, of which the server sends no body.
        path: Percent-encoded, without the query. Slashes of a topic's or a service's name need no encoding.
        snapshot: The newest; ``None`` while the agent does not answer.
        why: Why it does not, and what to do, where that is known.
    """
    if method not in _METHODS:
        allowed = ", ".join(_METHODS)
        return problem(405, f"{method[:20]} is not supported; this API is read with GET", (("Allow", allowed),))
    if path == OPENAPI_PATH:
        return RestResponse(200, openapi_json())
    resource, name = _find(path)
    if resource is None:
        return problem(404, f"there is no {_short(path)}; {OPENAPI_PATH} lists all paths")
    if snapshot is None:
        return problem(503, why or "the agent does not answer; start it with rmpa up, or look at its log")
    result = resource.read(snapshot, name)
    if isinstance(result, _Missing):
        return problem(404, _missing(result))
    return RestResponse(200, msgspec.json.encode(result))


def _find(path: str) -> tuple[RestResource | None, str]:
    below = path.removeprefix(PREFIX)
    if below == path or len(path) > limits.REST_PATH_MAX:
        return None, ""
    if below in _BY_PATH and _NAME not in below:
        return _BY_PATH[below], ""
    kind, _, rest = below.removeprefix("/").partition("/")
    resource = _BY_PATH.get(f"/{kind}/{_NAME}")
    return (resource, unquote(rest, errors="replace")) if resource and rest else (None, "")


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


# --- the document ---


@functools.cache
def openapi_json() -> bytes:
    """The OpenAPI document as JSON."""
    return msgspec.json.encode(openapi())


def openapi() -> dict[str, object]:
    """The OpenAPI 3.1 document: paths from ``RESOURCES``, schemas and texts from the types."""
    types = [*(resource.type for resource in RESOURCES), Problem]
    schemas, components = msgspec.json.schema_components(types, ref_template="#/components/schemas/{name}")
    for component in _structs(types):
        _describe(components[component.__name__], component)
    return {
        "openapi": "3.1.0",
        "info": {
            "title": "RMPA",
            "version": "1",
            "description": "The state of an RMPA agent: its peers, topics and services, read from its snapshot.",
            "license": {"name": "Apache-2.0", "identifier": "Apache-2.0"},
        },
        "servers": [{"url": "/"}],
        "security": [{}, {"token": []}],
        "paths": {
            PREFIX + resource.path: {"get": _operation(resource, schema)}
            for resource, schema in zip(RESOURCES, schemas, strict=False)
        },
        "components": {
            "schemas": components,
            "responses": {
                "Problem": {
                    "description": "No result; the body says why.",
                    "content": {_PROBLEM_JSON: {"schema": {"$ref": "#/components/schemas/Problem"}}},
                }
            },
            "securitySchemes": {
                "token": {
                    "type": "http",
                    "scheme": "bearer",
                    "description": "The token of rmpa web, where it listens beyond loopback.",
                }
            },
        },
    }


def _operation(resource: RestResource, schema: Mapping[str, Any]) -> dict[str, object]:
    problem = {"$ref": "#/components/responses/Problem"}
    operation: dict[str, object] = {
        "operationId": resource.identity,
        "summary": resource.summary,
        "responses": {
            "200": {"description": resource.summary, "content": {_JSON: {"schema": schema}}},
            **({"404": problem} if _NAME in resource.path else {}),
            "503": problem,
        },
    }
    if _NAME in resource.path:
        operation["parameters"] = [
            {
                "name": "name",
                "in": "path",
                "required": True,
                "description": "The name, percent-encoded; the first slash of a global name may be left out.",
                "schema": {"type": "string"},
            }
        ]
    return operation


def _structs(types: Iterable[object]) -> list[type[msgspec.Struct]]:
    """All struct types that these types are made of."""
    found: dict[type[msgspec.Struct], None] = {}
    todo: list[msgspec.inspect.Type] = list(msgspec.inspect.multi_type_info(types))
    while todo:
        info = todo.pop()
        if isinstance(info, msgspec.inspect.StructType):
            if info.cls in found:
                continue
            found[info.cls] = None
            todo += [each.type for each in info.fields]
        todo += _inner(info)
    return list(found)


def _inner(info: msgspec.inspect.Type) -> Sequence[msgspec.inspect.Type]:
    match info:
        case msgspec.inspect.UnionType():
            return info.types
        case msgspec.inspect.VarTupleType() | msgspec.inspect.ListType():
            return (info.item_type,)
        case msgspec.inspect.DictType():
            return (info.key_type, info.value_type)
    return ()


_ATTRIBUTE: Final = re.compile(r"^    (\w+): ")


def _describe(schema: dict[str, Any], type_: type[msgspec.Struct]) -> None:
    """Set the texts of a struct's schema from its docstring, each attribute's at its property."""
    head, _, _ = (inspect.getdoc(type_) or "").partition("\n\nAttributes:\n")
    schema["description"] = _text(head)
    for base in reversed(type_.__mro__):
        _, _, attributes = (inspect.cleandoc(base.__doc__ or "")).partition("Attributes:\n")
        for lines in re.split(r"\n(?=    \w+: )", attributes):
            if (match := _ATTRIBUTE.match(lines)) and match[1] in schema.get("properties", {}):
                schema["properties"][match[1]]["description"] = _text(lines[match.end() :])


def _text(docstring: str) -> str:
    return " ".join(docstring.replace("``", "`").split())
