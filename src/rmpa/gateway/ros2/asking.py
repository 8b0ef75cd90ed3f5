"""What nodes of ROS 2 are asked for, by services that each of them has: the fields of types, and parameters.

The fields come by ``~/get_type_description`` (REP 2016). A response is checked before it is used: rosbags makes
Python code of the names in it. Parameters are read and set by the services of ``rcl_interfaces``.
"""

from __future__ import annotations

import asyncio
import functools
import json
import re
import struct
from typing import TYPE_CHECKING, Any, Final

from rosbags.interfaces import Nodetype
from rosbags.serde import SerdeError
from rosbags.typesys import get_types_from_msg

from rmpa.core.errors import PeerRefused, RemoteProtocolError, RmpaError, UnreachableError
from rmpa.gateway import limits
from rmpa.gateway.ros2.conversion import MALFORMED, NoConversion, Ros2Codec
from rmpa.gateway.ros2.format import EntityKind, Ros2Endpoint, Ros2Node, gid_of
from rmpa.gateway.ros2.graph import SITE, OwnRos2Nodes, Ros2Graph
from rmpa.gateway.ros2.pairs import described_types
from rmpa.gateway.ros2.types import Fields, Ros2Types, check_size, ros2_fields
from rmpa.gateway.rules import CrossingRules, ForeignSource, SourceKind
from rmpa.ros.limits import DEFINITION_FIELDS_MAX

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from rmpa.gateway.zenoh.threads import ZenohSample
    from rmpa.ros.wire.tcpros import Buffer

# The last part of the name of the service that describes types; the others are its node's.
SERVICE: Final = "get_type_description"
SERVICE_TYPE: Final = "type_description_interfaces/srv/GetTypeDescription"
_REQUEST: Final = f"{SERVICE_TYPE}_Request"
_RESPONSE: Final = f"{SERVICE_TYPE}_Response"
_PARTS: Final = {
    "rcl_interfaces/srv/ListParameters_Request": "string[] prefixes; uint64 depth",
    "rcl_interfaces/srv/ListParameters_Response": "rcl_interfaces/ListParametersResult result",
    "rcl_interfaces/srv/GetParameters_Request": "string[] names",
    "rcl_interfaces/srv/GetParameters_Response": "rcl_interfaces/ParameterValue[] values",
    "rcl_interfaces/srv/SetParametersAtomically_Request": "rcl_interfaces/Parameter[] parameters",
    "rcl_interfaces/srv/SetParametersAtomically_Response": "rcl_interfaces/SetParametersResult result",
    _REQUEST: "string type_name; string type_hash; bool include_type_sources",
    _RESPONSE: (
        "bool successful; string failure_reason; type_description_interfaces/TypeDescription type_description;"
        "type_description_interfaces/TypeSource[] sources; type_description_interfaces/KeyValue[] extra_information"
    ),
}
_NUMBERS: Final = ("int8", "uint8", "int16", "uint16", "int32", "uint32", "int64", "uint64", "float32", "float64")
# type_description_interfaces/msg/FieldType, without those that ROS 1 lacks. ``char`` of C++ (13) is one octet.
_BASES: Final = dict(enumerate(_NUMBERS, 2)) | {13: "uint8", 15: "bool", 16: "byte", 17: "string", 21: "string"}
_NESTED: Final = 1
_BOUNDED_STRING: Final = 21
_TYPE_NAME: Final = re.compile(r"[A-Za-z][A-Za-z0-9_]*/(msg|srv|action)/[A-Za-z][A-Za-z0-9_]*")
_FIELD_NAME: Final = re.compile(r"[a-z][a-z0-9_]*")
# What is added to a type's number for an array of fixed size, a bounded and an unbounded sequence of it.
_FIXED, _BOUNDED, _UNBOUNDED = 48, 96, 144
_SCALARS: Final = ("bool", "integer", "double", "string")
# The fields of rcl_interfaces/msg/ParameterValue by the numbers of its types; 0 is a parameter that is not set.
_VALUE_FIELDS: Final = (
    "",
    *(f"{each}_value" for each in (*_SCALARS, *(f"{each}_array" for each in ("byte", *_SCALARS)))),
)
_VALUE_KINDS: Final = (bool, int, float, str)
_INTEGER, _DOUBLE, _BYTES, _STRINGS = 2, 3, 5, 9
# What is added to a number for an array of it.
_ARRAY: Final = 5


@functools.cache
def service_types() -> Ros2Types:
    """The types with requests and responses of the services that each node of ROS 2 has and the gateway calls."""
    types = Ros2Types("jazzy")
    for name, text in _PARTS.items():
        [fields] = get_types_from_msg(text.replace(";", "\n"), name).values()
        types.take({name: fields})
    return types


def type_request(name: str, type_hash: str) -> bytes:
    """The CDR of a request for the description of ``package/msg/Name`` with a hash."""
    message = service_types().store.types[_REQUEST](type_name=name, type_hash=type_hash, include_type_sources=False)
    return bytes(service_types().store.serialize_cdr(message, _REQUEST))


def parse_type_response(raw: Buffer) -> dict[str, Any]:
    """Read a response: the fields of the type and of all that it embeds, in rosbags' form, without constants.

    Raises:
        RemoteProtocolError: It is malformed, too large, or has a field that neither side's ROS has; or the node does
            not know the type, and the text says why.
    """
    if len(raw) > limits.ROS2_DESCRIPTION_MAX:
        raise RemoteProtocolError(f"a type's description has {len(raw)} bytes; at most {limits.ROS2_DESCRIPTION_MAX}")
    store = service_types().store
    kind = store.get_msgdef(_RESPONSE)
    try:  # not by the store, which takes no garbage behind a message: rmw_fastrtps pads more than it does
        read = kind.deserialize_cdr_le if raw[1] else kind.deserialize_cdr_be
        message: Any = read(bytes(raw[4:]), 0, kind.cls, store)[0]
    except (SerdeError, ValueError, IndexError, AssertionError, OverflowError, struct.error) as error:
        raise RemoteProtocolError(f"a type's description is malformed: {error}") from error
    if not message.successful:
        raise RemoteProtocolError(f"the node does not describe the type: {message.failure_reason[:200]}")
    described = message.type_description
    all_types = (described.type_description, *described.referenced_type_descriptions)
    if len(all_types) > limits.ROS2_DESCRIBED_TYPES_MAX:
        raise RemoteProtocolError(f"a type's description has {len(all_types)} types")
    made: dict[str, Any] = {_checked(each.type_name, _TYPE_NAME): ([], _fields(each)) for each in all_types}
    for name in made:
        check_size(name, lambda each: ros2_fields(made[each][1]) if each in made else ())
    return made


def _checked(name: str, form: re.Pattern[str]) -> str:
    if len(name) > limits.ROS2_NAME_MAX or form.fullmatch(name) is None:
        raise RemoteProtocolError(f"{name[:80]!r} is not the name of a type or field of ROS 2")
    return name


def _fields(described: Any) -> Fields:
    if not described.fields:  # ROS 2's have one at least; elements without bytes may be claimed without end
        raise RemoteProtocolError(f"{described.type_name[:80]} has no fields")
    if len(described.fields) > DEFINITION_FIELDS_MAX:
        raise RemoteProtocolError(f"{described.type_name[:80]} has {len(described.fields)} fields")
    made = {_checked(field.name, _FIELD_NAME): _description(field.type) for field in described.fields}
    if len(made) < len(described.fields):
        raise RemoteProtocolError(f"{described.type_name[:80]} has two fields of one name")
    return list(made.items())


def _description(kind: Any) -> Any:
    number, capacity = int(kind.type_id), int(kind.capacity)
    if number > _UNBOUNDED:
        return (Nodetype.SEQUENCE, (_inner(kind, number - _UNBOUNDED), 0))
    if number > _BOUNDED:
        return (Nodetype.SEQUENCE, (_inner(kind, number - _BOUNDED), capacity))
    if number > _FIXED and not capacity:
        raise RemoteProtocolError("a field is an array of no elements")
    return (Nodetype.ARRAY, (_inner(kind, number - _FIXED), capacity)) if number > _FIXED else _inner(kind, number)


def _inner(kind: Any, number: int) -> Any:
    if number == _NESTED:
        return (Nodetype.NAME, _checked(kind.nested_type_name, _TYPE_NAME))
    if number not in _BASES:
        raise RemoteProtocolError(f"a field has the type {number} of REP 2016, which ROS 1 lacks (wide characters)")
    return (Nodetype.BASE, (_BASES[number], int(kind.string_capacity) if number == _BOUNDED_STRING else 0))


class Ros2Asker:
    """Asks for types, at most ``limits.ROS2_ASKS_MAX`` nodes at one time; reads and sets parameters.

    Args:
        nodes: Our nodes in ROS 2's graph.
        ros2: ROS 2's graph.
        types: The types of ROS 2's distribution.
        rules: Decide which services of parameters may be called.
    """

    def __init__(self, nodes: OwnRos2Nodes, ros2: Ros2Graph, types: Ros2Types, rules: CrossingRules) -> None:
        self._rules = rules
        self._nodes = nodes
        self._ros2 = ros2
        self._types = types
        self._appeared = asyncio.Event()
        self._asking = 0

    def appeared(self) -> None:
        """An endpoint is new in ROS 2's graph."""
        if self._asking:
            self._appeared.set()
            self._appeared = asyncio.Event()

    async def learn(self, *endpoints: tuple[str, EntityKind], of: Ros2Endpoint) -> dict[str, Any]:
        """The fields of the types of some endpoints of one node, which waits for those that have not appeared yet.

        Args:
            endpoints: The names and kinds of the endpoints; none: the type of ``of`` itself is meant.
            of: An endpoint of the node, which has appeared.

        Returns:
            The fields of the types and of all that they embed, in rosbags' form; each type has the hash of its key.

        Raises:
            NoConversion: The node does not describe them, or describes others.
            RemoteProtocolError: Its answer is malformed.
        """
        found: dict[str, Any] = {}
        if self._asking >= limits.ROS2_ASKS_MAX:
            raise NoConversion(f"{self._asking} ROS 2 nodes are asked for types already; this one is not")
        self._asking += 1
        try:
            for name, kind in endpoints or ((of.name, of.kind),):
                endpoint = of if (name, kind) == (of.name, of.kind) else await self._wait(name, kind, of.node)
                if endpoint is None:
                    raise NoConversion(f"node {of.node.name} has no {name}")
                fields = await self._ask(endpoint)
                described_types(self._types, endpoint.type, endpoint.type_hash, fields)
                found |= fields
        finally:
            self._asking -= 1
        return found

    async def _ask(self, endpoint: Ros2Endpoint) -> dict[str, Any]:
        server = await self._wait(f"{endpoint.node.name}/{SERVICE}", EntityKind.SERVICE, endpoint.node)
        if server is None:
            raise NoConversion(self._unknown(endpoint))
        answer = await self.call(server, type_request(endpoint.type, endpoint.type_hash))
        if answer is None or not answer.ok:
            raise NoConversion(f"{server.name} does not answer; {self._unknown(endpoint)}")
        return parse_type_response(answer.payload)

    async def call(self, server: Ros2Endpoint, request: bytes) -> ZenohSample | None:
        """Call one of the services that each node has; ``None``: it has not answered in time."""
        gid = gid_of(f"{self._nodes.own_name}/{SERVICE}")
        return await self._nodes.call(server.key(), gid, request, limits.ROS2_SERVICE_WAIT)

    async def _wait(self, name: str, kind: EntityKind, node: Ros2Node) -> Ros2Endpoint | None:
        """An endpoint of a node, once it is there; ``None`` if it does not appear."""
        try:
            async with asyncio.timeout(limits.ROS2_SERVICE_WAIT):
                while True:
                    for found in self._ros2.at(name, kind):
                        if found.node.name == node.name:
                            return found
                    await self._appeared.wait()
        except TimeoutError:
            return None

    def _unknown(self, endpoint: Ros2Endpoint) -> str:
        distribution = self._types.distribution
        if endpoint.type in self._types:
            return (
                f"its type hash {endpoint.type_hash} is not that of {distribution}'s {endpoint.type}, and node "
                f"{endpoint.node.name} offers no get_type_description: set gateway.ros2.distribution to the one of "
                "that node, or start it with the parameter start_type_description_service"
            )
        return (
            f"the fields of {endpoint.type} are not known, and node {endpoint.node.name} offers no "
            "get_type_description: start the node with the parameter start_type_description_service, or source a "
            "ROS 1 workspace that has the type, with the same fields, where the gateway runs"
        )

    async def parameters(self, args: dict[str, Any], denial: Callable[[str], str]) -> str:
        """The names of all parameters of a ``node``, the value of a ``key``, or nothing once it is set; as JSON.

        Each is a call of a service of the node, under its rules.

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
            names = sorted((await self._of_parameters(node, "list_parameters", denial))["result"]["names"])
            return json.dumps(names if key is None else await self._get(node, str(key), names, denial))
        except (*MALFORMED, RecursionError) as error:
            if isinstance(error, PeerRefused | UnreachableError):
                raise
            raise RmpaError(f"parameters of {node}: {error}", code="invalid-value") from error

    async def _get(self, node: str, key: str, names: list[str], denial: Callable[[str], str]) -> Any:
        within = [name for name in names if not key or name == key or name.startswith(f"{key}.")]
        if not within and key:
            raise PeerRefused(node, f"it has no parameter {key}", "`rmpa param list` has them all")
        answer = await self._of_parameters(node, "get_parameters", denial, names=within)
        values = [_read(each) for each in answer["values"]]
        begin = len(key) + 1 if key else 0
        return values[0] if within == [key] else {n[begin:]: v for n, v in zip(within, values, strict=True)}

    async def _set(self, node: str, wanted: dict[str, Any], denial: Callable[[str], str]) -> None:
        """Set all or none."""
        present = (await self._of_parameters(node, "get_parameters", denial, names=list(wanted)))["values"]
        # A node answers with nothing at all if one of them is not declared.
        numbers = [each["type"] for each in present] or [0] * len(wanted)
        made = [{"name": name, "value": _write(wanted[name], at)} for name, at in zip(wanted, numbers, strict=True)]
        result = (await self._of_parameters(node, "set_parameters_atomically", denial, parameters=made))["result"]
        if not result["successful"]:
            raise PeerRefused(node, result["reason"] or "it gives no reason")

    async def _of_parameters(
        self, node: str, service: str, denial: Callable[[str], str], **fields: Any
    ) -> dict[str, Any]:
        """Call one of the services for parameters."""
        name = f"{node}/{service}"
        decision = self._rules.incoming(ForeignSource(SourceKind.SERVICE, SITE, "", node, name, "*"))
        if why := denial(decision.name) if decision.allowed else decision.why:
            raise PeerRefused(SITE, why)
        server = next(self._ros2.at(name, EntityKind.SERVICE), None)
        if server is None and node in self._ros2.nodes:
            raise UnreachableError("service", name, "the node was started without services of parameters")
        if server is None:
            raise UnreachableError("node of ROS 2", node, "`rmpa site info ros2` lists what is there")
        kind = f"rcl_interfaces/srv/{re.sub('(?:^|_)(.)', lambda found: found[1].upper(), service)}"
        request = Ros2Codec(service_types(), f"{kind}_Request").write(fields)
        reply = await self.call(server, request)
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
    value = told[_VALUE_FIELDS[kind]] if 0 < kind < len(_VALUE_FIELDS) else None
    if kind <= _BYTES - 1 or value is None:
        return value
    # A byte is signed in ROS 1.
    return [each & 0xFF if kind == _BYTES else bool(each) if kind == _BYTES + 1 else each for each in value]


def _write(value: Any, number: int) -> dict[str, Any]:
    """A value by the type of the parameter, ``number``, where it fits it; ``None`` is no value."""
    if not (kind := _kind(value, number)):
        return {"type": 0}
    signed = [each - 256 if each > 127 else each for each in value] if kind == _BYTES else value
    return {"type": kind, _VALUE_FIELDS[kind]: signed}


def _kind(value: Any, number: int) -> int:
    """The number of the type that a value is sent as."""
    if value is None:
        return 0
    if not isinstance(value, list):
        kind = _VALUE_KINDS.index(type(value)) + 1
        return _DOUBLE if (kind, number) == (_INTEGER, _DOUBLE) else kind
    kinds = {_VALUE_KINDS.index(type(each)) + 1 for each in value}
    if not kinds:
        return max(number, _BYTES) if number else _STRINGS
    kind = max(kinds)
    if len(kinds) > 1 and kinds != {_INTEGER, _DOUBLE}:
        raise ValueError("a list has values of different types")
    fits = kind == _INTEGER and number in (_BYTES, _DOUBLE + _ARRAY)
    return number if fits else kind + _ARRAY
