"""Parameters of ROS 2's nodes, by the services of ``rcl_interfaces`` that each node has."""

from __future__ import annotations

import json
import re
import struct
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from rosbags.serde import SerdeError

from rmpa.core.errors import PeerRefused, RmpaError, UnreachableError
from rmpa.gateway.ros2.format import EntityKind
from rmpa.gateway.ros2.graph import SITE
from rmpa.gateway.ros2.types import read_response, service_store
from rmpa.gateway.rules import ForeignSource, SourceKind

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from rmpa.gateway.ros2.services import Ros2Context

_VALUE: Final = "rcl_interfaces/msg/ParameterValue"
_PARAMETER: Final = "rcl_interfaces/msg/Parameter"
# The fields of a value by the numbers of its types, from 1 on, each with what an empty one has; 0 is "not set".
_FIELDS: Final[tuple[tuple[str, Any], ...]] = (
    ("bool_value", False),
    ("integer_value", 0),
    ("double_value", 0.0),
    ("string_value", ""),
    ("byte_array_value", np.array([], np.uint8)),
    ("bool_array_value", np.array([], np.bool_)),
    ("integer_array_value", np.array([], np.int64)),
    ("double_array_value", np.array([], np.float64)),
    ("string_array_value", []),
)
_KINDS: Final = (bool, int, float, str)
_INTEGER, _DOUBLE, _BYTES, _STRINGS = 2, 3, 5, 9
# What is added to a number for an array of it.
_ARRAY: Final = 5
_MALFORMED: Final = (SerdeError, ValueError, IndexError, AssertionError, OverflowError, RecursionError, struct.error)


class Ros2Parameters:
    """Reads and sets parameters of nodes of ROS 2. Each is a call of a service of the node, under its rules.

    Args:
        context: What the parts share.
    """

    def __init__(self, context: Ros2Context) -> None:
        self._context = context

    async def answer(self, args: dict[str, Any], denial: Callable[[str], str]) -> str:
        """The names of all parameters of a ``node``, the value of a ``key``, or nothing once it is set; as JSON.

        Args:
            args: ``node``; with ``key`` one parameter, or the first part of the names of some, or all; with ``text``
                too the JSON that it is set to: a dictionary sets each of its members, ``null`` deletes.
            denial: Why the program that asks may not call a service; empty if it may.

        Raises:
            RmpaError: The node is not there or has no such service or parameter, it refuses, or a rule does.
        """
        node, key, text = str(args.get("node")), args.get("key"), args.get("text")
        try:
            if text is not None:
                await self._set(node, dict(_leaves(str(key or ""), json.loads(str(text)))), denial)
                return ""
            listed = await self._call(node, "list_parameters", denial, prefixes=[], depth=0)
            names = sorted(map(str, listed.result.names))
            return json.dumps(names if key is None else await self._get(node, str(key), names, denial))
        except _MALFORMED as error:
            raise RmpaError(f"parameters of {node}: {error}", code="invalid-value") from error

    async def _get(self, node: str, key: str, names: list[str], denial: Callable[[str], str]) -> Any:
        within = [name for name in names if not key or name == key or name.startswith(f"{key}.")]
        if not within and key:
            raise RmpaError(f"{node} has no parameter {key}; `rmpa param list` has them all", code="unknown-name")
        answer = await self._call(node, "get_parameters", denial, names=within)
        values = [_read(each) for each in answer.values]
        begin = len(key) + 1 if key else 0
        return values[0] if within == [key] else {n[begin:]: v for n, v in zip(within, values, strict=True)}

    async def _set(self, node: str, wanted: dict[str, Any], denial: Callable[[str], str]) -> None:
        """Set all or none."""
        present = await self._call(node, "get_parameters", denial, names=list(wanted))
        # A node answers with nothing at all if one of them is not declared.
        numbers = [each.type for each in present.values] or [0] * len(wanted)
        types, made = service_store().types, []
        for (name, value), number in zip(wanted.items(), numbers, strict=True):
            kind = _kind(value, number)
            fields = {
                field: _cast(value, kind) if at == kind else empty for at, (field, empty) in enumerate(_FIELDS, 1)
            }
            made.append(types[_PARAMETER](name=name, value=types[_VALUE](type=kind, **fields)))
        answer = await self._call(node, "set_parameters_atomically", denial, parameters=made)
        if not answer.result.successful:
            raise PeerRefused(node, answer.result.reason or "it gives no reason")

    async def _call(self, node: str, service: str, denial: Callable[[str], str], **fields: Any) -> Any:
        name, context, store = f"{node}/{service}", self._context, service_store()
        decision = context.rules.incoming(ForeignSource(SourceKind.SERVICE, SITE, "", node, name, "*"))
        if why := denial(decision.name) if decision.allowed else decision.why:
            raise PeerRefused(SITE, why)
        server = next(context.ros2.at(name, EntityKind.SERVICE), None)
        if server is None and node in context.ros2.nodes:
            raise UnreachableError("service", name, "the node was started without services of parameters")
        if server is None:
            raise UnreachableError("node of ROS 2", node, "`rmpa site info ros2` lists what is there")
        kind = f"rcl_interfaces/srv/{re.sub('(?:^|_)(.)', lambda found: found[1].upper(), service)}"
        request = store.serialize_cdr(store.types[f"{kind}_Request"](**fields), f"{kind}_Request")
        reply = await context.asker.call(server, bytes(request))
        if reply is None or not reply.ok:
            raise UnreachableError("node of ROS 2", node, reply.text if reply is not None else "it gave no answer")
        return read_response(reply.payload, f"{kind}_Response")


def _leaves(key: str, value: Any) -> Iterator[tuple[str, Any]]:
    if not isinstance(value, dict):
        yield key, value
        return
    for name, each in value.items():
        yield from _leaves(f"{key}.{name}" if key else name, each)


def _read(told: Any) -> Any:
    """A value of ROS 2 in JSON's types."""
    if not 0 < told.type <= len(_FIELDS):
        return None
    value = getattr(told, _FIELDS[told.type - 1][0])
    return value.tolist() if isinstance(value, np.ndarray) else value


def _kind(value: Any, number: int) -> int:
    """The number of the type that a value is sent as: that of the parameter, ``number``, where the value fits it."""
    if value is None:
        return 0
    if not isinstance(value, list):
        kind = _KINDS.index(type(value)) + 1
        return _DOUBLE if (kind, number) == (_INTEGER, _DOUBLE) else kind
    kinds = {_KINDS.index(type(each)) + 1 for each in value}
    if not kinds:
        return max(number, _BYTES) if number else _STRINGS
    kind = max(kinds)
    if len(kinds) > 1 and kinds != {_INTEGER, _DOUBLE}:
        raise ValueError("a list has values of different types")
    fits = kind == _INTEGER and number in (_BYTES, _DOUBLE + _ARRAY)
    return number if fits else kind + _ARRAY


def _cast(value: Any, kind: int) -> Any:
    empty = _FIELDS[kind - 1][1]
    return np.array(value, empty.dtype) if isinstance(empty, np.ndarray) else type(empty)(value)
