"""Finds the definition of a message or service type by its name, for commands, nodes and Smart Resources.

The search goes through the sourced workspaces (``ros.types.installed``), then the types that rmpa brings, then the
ROS installations of this machine. So a workspace's version of a standard type is preferred, as by the nodes of that
workspace. If an md5 sum is given (of a service's server or a publisher), the first version with that sum is used. A
type that is not found may be fetched from a publisher: ``ros.node.fetch_type``.
"""

from __future__ import annotations

import functools
import os
from time import monotonic
from typing import TYPE_CHECKING, Final, NoReturn, TypeVar

from rmpa.config.values import did_you_mean
from rmpa.core.errors import RmpaError
from rmpa.core.identity import is_type_name
from rmpa.ros import limits
from rmpa.ros.types import definitions
from rmpa.ros.types.installed import (
    SearchPath,
    ServiceType,
    definitions_of,
    find_definitions,
    known_service,
    known_services,
    packages_below,
)
from rmpa.ros.types.messages import MessageType, learnt_type

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping

    from rmpa.ros.types.installed import Found

# Time before an unknown type is searched for again: each message asks for it, and a search takes some 50 ms.
TYPE_MISSING: Final = 10.0

_Type = TypeVar("_Type", MessageType, ServiceType)
# The md5 sum of a message without fields, for which publishers send an empty definition.
EMPTY_MD5: Final = "d41d8cd98f00b204e9800998ecf8427e"
_REMEDIES: Final = {
    "msg": "source the workspace that has it, or let a node that publishes it run, here or at a peer",
    "srv": "source the workspace that has it; no server sends its definition",
}


def find_message_type(name: str, md5: str = "", environ: Mapping[str, str] | None = None) -> MessageType:
    """Find a message type.

    Args:
        name: ``package/Name``.
        md5: The md5 sum of the version; by default the first that is found.
        environ: Replaces this process's environment variables.

    Raises:
        UnknownTypeError: The type is in none of the searched places, which the text names.
        DefinitionError: The definition is malformed, or has another md5 sum.
        LimitExceeded: The definition is too long.
    """
    return _search(_message, "msg", name, md5, SearchPath.read(os.environ if environ is None else environ))


def find_service_type(name: str, md5: str = "", environ: Mapping[str, str] | None = None) -> ServiceType:
    """Find a service type; arguments and errors are those of ``find_message_type``."""
    return _search(_service, "srv", name, md5, SearchPath.read(os.environ if environ is None else environ))


def _search(
    make: Callable[[str, Found | None, SearchPath], _Type], kind: str, name: str, md5: str, path: SearchPath
) -> _Type:
    """The first valid version that has the sum; if none is known, the cache is cleared: it may have been built since.

    Raises:
        UnknownTypeError: There is no version.
        RmpaError: There are versions, but none is valid and has the sum.
    """
    fresh = packages_below.cache_info().currsize == 0
    while True:
        problem: RmpaError | None = None
        for found in _versions(kind, name, path):
            try:
                made = make(name, found, path)
            except RmpaError as error:
                problem = problem or error
                continue
            if not md5 or made.md5sum == md5:
                return made
            text = f"has the md5 sum {made.md5sum} here ({made.source or 'it comes with rmpa'}), and {md5} there"
            remedy = "source the workspace that the node there was built in"
            problem = problem or definitions.DefinitionError(name, text, remedy)
        if problem is not None and (fresh or not isinstance(problem, definitions.UnknownTypeError)):
            raise problem
        if fresh:
            return _unknown(name, path, kind)
        packages_below.cache_clear()
        fresh = True


def _versions(kind: str, name: str, path: SearchPath) -> Iterator[Found | None]:
    """The versions of a type, best first; ``None`` is the one that rmpa brings."""
    yield from find_definitions(kind, name, path, sourced=True)
    if name in (definitions.known_types() if kind == "msg" else known_services()):
        yield None
    yield from find_definitions(kind, name, path, sourced=False)


def _message(name: str, found: Found | None, path: SearchPath) -> MessageType:
    if found is None:
        return MessageType(name)
    text, embedded, where = found
    known = {name: definitions.Specification.parse(name, text)}
    _complete(name, known, embedded, path, "message type")
    made = learnt_type(name, definitions.full_text(name, known), str(where))
    if definitions.known_text(name) is not None and (ours := MessageType(name)).md5sum == made.md5sum:
        return ours  # its serialization code may be generated already
    return made


def _service(name: str, found: Found | None, path: SearchPath) -> ServiceType:
    if found is None:
        return _built_service(name, known_service(name))
    text, embedded, where = found
    known = ServiceType.halves(name, text)
    _complete(name, known, embedded, path, "service type")
    inner = tuple((each, its.text) for each, its in known.items())
    return _built_service(name, text, inner, str(where))


@functools.lru_cache(maxsize=limits.TYPES_FOUND_MAX)
def _built_service(
    name: str, text: str, embedded: tuple[tuple[str, str], ...] | None = None, source: str = ""
) -> ServiceType:
    return ServiceType(name, text, dict(embedded).get if embedded is not None else None, source)


def _complete(
    name: str, known: dict[str, definitions.Specification], embedded: Mapping[str, str], path: SearchPath, what: str
) -> None:
    """Add all types that a found definition embeds: those of its file, else as found by their names."""

    def find(inner: str) -> str | None:
        if inner in embedded:
            return embedded[inner]
        for found in _versions("msg", inner, path):
            return found[0] if found is not None else definitions.known_text(inner)
        return _unknown(inner, path, "msg")

    try:
        definitions.complete(known, find)
    except definitions.UnknownTypeError as error:
        raise definitions.UnknownTypeError(
            name, f"embeds {error.type}, which {error.problem}", error.remedy, what
        ) from None


def _unknown(name: str, path: SearchPath, kind: str) -> NoReturn:
    """Raise the error for a type that was not found, with the searched places and similar names.

    Args:
        name: The type.
        path: The searched places.
        kind: ``msg`` or ``srv``.

    Raises:
        UnknownTypeError: Always.
        DefinitionError: ``name`` is not the name of a type.
    """
    what = "message type" if kind == "msg" else "service type"
    if not is_type_name(name):
        raise definitions.DefinitionError(name[:80], "is not a type's name", "write it like std_msgs/String", what)
    package, _, base = name.partition("/")
    ours = definitions.known_types() if kind == "msg" else known_services()
    siblings = {each for each in ours if each.startswith(f"{package}/")}
    folders, names = definitions_of(package, path, kind)
    if folders:
        problem = f"is not in package {package} ({', '.join(map(str, folders))})"
    elif siblings:
        problem = f"is not in package {package} as it comes with rmpa"
    else:
        problem = "is not known here"
    there = siblings.union(f"{package}/{each}" for each in names)
    near = did_you_mean(name, there or [each for each in ours if each.endswith(f"/{base}")])
    remedy = (f"did you mean {near}? Else " if near else "") + _REMEDIES[kind]
    problem += f"; looked in {path}, and at what comes with rmpa"
    raise definitions.UnknownTypeError(name, problem, remedy, what, fetchable=not siblings)


# Finds the message type of a connection header; results are cached, so it can be called for each message.


@functools.lru_cache(maxsize=limits.TYPES_FOUND_MAX)
def _with_sum(name: str, md5: str, path: SearchPath) -> MessageType:
    # With a sum the result stays valid when the files change.
    return _search(_message, "msg", name, md5, path)


def type_of_header(fields: Mapping[str, str]) -> MessageType:
    """The message type of a publisher's connection header: from its definition, else as found on this machine.

    May be called for each message: results are cached, and a failed search is repeated after ``TYPE_MISSING`` seconds
    at the most.

    Raises:
        DefinitionError: As for ``MessageType.learn`` and ``find_message_type``.
    """
    name, md5 = fields.get("type", ""), fields.get("md5sum", "")
    definition = fields.get("message_definition", "")
    if definition or md5 == EMPTY_MD5:
        return MessageType.learn(name, definition, md5)
    found = _searched(name, md5, SearchPath.read(os.environ), int(monotonic() / TYPE_MISSING))
    if isinstance(found, RmpaError):
        raise found.with_traceback(None)  # the traceback would grow with each message
    return found


@functools.lru_cache(maxsize=limits.TYPES_FOUND_MAX)
def _searched(name: str, md5: str, path: SearchPath, _period: int) -> MessageType | RmpaError:
    """What a search found in a period of time, or its error."""
    try:
        return _with_sum(name, md5, path)
    except RmpaError as error:
        return error
