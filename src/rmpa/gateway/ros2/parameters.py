"""Parameters of ROS 2's nodes, by the services of ``rcl_interfaces`` that each node has."""

from __future__ import annotations

import json
import re
from typing import TYPE_CHECKING, Any, Final

from rmpa.core.errors import PeerRefused, RmpaError, UnreachableError
from rmpa.gateway import limits
from rmpa.gateway.ros2.conversion import MALFORMED, Ros2Codec
from rmpa.gateway.ros2.format import EntityKind
from rmpa.gateway.ros2.graph import SITE
from rmpa.gateway.ros2.types import service_types
from rmpa.gateway.rules import ForeignSource, SourceKind

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from rmpa.gateway.ros2.services import Ros2Context

_SCALARS: Final = ("bool", "integer", "double", "string")
# The fields of rcl_interfaces/msg/ParameterValue by the numbers of its types; 0 is a parameter that is not set.
_FIELDS: Final = ("", *(f"{each}_value" for each in (*_SCALARS, *(f"{each}_array" for each in ("byte", *_SCALARS)))))
_KINDS: Final = (bool, int, float, str)
_INTEGER, _DOUBLE, _BYTES, _STRINGS = 2, 3, 5, 9
# What is added to a number for an array of it.
_ARRAY: Final = 5


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
            names = sorted((await self._call(node, "list_parameters", denial))["result"]["names"])
            return json.dumps(names if key is None else await self._get(node, str(key), names, denial))
        except (*MALFORMED, RecursionError) as error:
            if isinstance(error, PeerRefused | UnreachableError):
                raise
            raise RmpaError(f"parameters of {node}: {error}", code="invalid-value") from error

    async def _get(self, node: str, key: str, names: list[str], denial: Callable[[str], str]) -> Any:
        within = [name for name in names if not key or name == key or name.startswith(f"{key}.")]
        if not within and key:
            raise PeerRefused(node, f"it has no parameter {key}", "`rmpa param list` has them all")
        answer = await self._call(node, "get_parameters", denial, names=within)
        values = [_read(each) for each in answer["values"]]
        begin = len(key) + 1 if key else 0
        return values[0] if within == [key] else {n[begin:]: v for n, v in zip(within, values, strict=True)}

    async def _set(self, node: str, wanted: dict[str, Any], denial: Callable[[str], str]) -> None:
        """Set all or none."""
        present = (await self._call(node, "get_parameters", denial, names=list(wanted)))["values"]
        # A node answers with nothing at all if one of them is not declared.
        numbers = [each["type"] for each in present] or [0] * len(wanted)
        made = [{"name": name, "value": _write(wanted[name], at)} for name, at in zip(wanted, numbers, strict=True)]
        result = (await self._call(node, "set_parameters_atomically", denial, parameters=made))["result"]
        if not result["successful"]:
            raise PeerRefused(node, result["reason"] or "it gives no reason")

    async def _call(self, node: str, service: str, denial: Callable[[str], str], **fields: Any) -> dict[str, Any]:
        name, context = f"{node}/{service}", self._context
        decision = context.rules.incoming(ForeignSource(SourceKind.SERVICE, SITE, "", node, name, "*"))
        if why := denial(decision.name) if decision.allowed else decision.why:
            raise PeerRefused(SITE, why)
        server = next(context.ros2.at(name, EntityKind.SERVICE), None)
        if server is None and node in context.ros2.nodes:
            raise UnreachableError("service", name, "the node was started without services of parameters")
        if server is None:
            raise UnreachableError("node of ROS 2", node, "`rmpa site info ros2` lists what is there")
        kind = f"rcl_interfaces/srv/{re.sub('(?:^|_)(.)', lambda found: found[1].upper(), service)}"
        request = Ros2Codec(service_types(), f"{kind}_Request").write(fields)
        reply = await context.asker.call(server, request)
        if reply is None or not reply.ok:
            raise UnreachableError("node of ROS 2", node, reply.text if reply is not None else "it gave no answer")
        if len(reply.payload) > limits.ROS2_DESCRIPTION_MAX:
            raise ValueError(f"the answer of {name} has {len(reply.payload)} bytes")
        return Ros2Codec(service_types(), f"{kind}_Response").read(reply.payload)


def _leaves(key: str, value: Any) -> Iterator[tuple[str, Any]]:
    if not isinstance(value, dict):
        yield key, value
        return
    for name, each in value.items():
        yield from _leaves(f"{key}.{name}" if key else name, each)


def _read(told: dict[str, Any]) -> Any:
    """A value of ROS 2 in JSON's types."""
    kind = told["type"]
    value = told[_FIELDS[kind]] if 0 < kind < len(_FIELDS) else None
    if kind <= _BYTES - 1 or value is None:
        return value
    # A byte is signed in ROS 1.
    return [each & 0xFF if kind == _BYTES else bool(each) if kind == _BYTES + 1 else each for each in value]


def _write(value: Any, number: int) -> dict[str, Any]:
    """A value by the type of the parameter, ``number``, where it fits it; ``None`` is no value."""
    if not (kind := _kind(value, number)):
        return {"type": 0}
    signed = [each - 256 if each > 127 else each for each in value] if kind == _BYTES else value
    return {"type": kind, _FIELDS[kind]: signed}


def _kind(value: Any, number: int) -> int:
    """The number of the type that a value is sent as."""
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
