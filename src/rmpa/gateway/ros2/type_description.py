"""The service ``~/get_type_description`` of ROS 2 nodes (REP 2016): its request, and the fields in its response.

A response is checked before it is used: rosbags makes Python code of the names in it.
"""

from __future__ import annotations

import functools
import re
from typing import TYPE_CHECKING, Any, Final

from rosbags.interfaces import Nodetype
from rosbags.serde import SerdeError
from rosbags.typesys import Stores, get_typestore
from rosbags.typesys.store import Typestore

from rmpa.core.errors import RemoteProtocolError
from rmpa.gateway import limits
from rmpa.gateway.ros2.type_size import check_size
from rmpa.ros.limits import DEFINITION_FIELDS_MAX

if TYPE_CHECKING:
    from collections.abc import Iterator

    from rmpa.ros.wire.tcpros import Buffer

SERVICE: Final = "get_type_description"
"""The last part of the service's name; the others are its node's."""
SERVICE_TYPE: Final = "type_description_interfaces/srv/GetTypeDescription"
_REQUEST: Final = f"{SERVICE_TYPE}_Request"
_RESPONSE: Final = f"{SERVICE_TYPE}_Response"
_DESCRIPTION: Final = "type_description_interfaces/msg/TypeDescription"
_BASES: Final = {
    **dict(enumerate(("int8", "uint8", "int16", "uint16", "int32", "uint32", "int64", "uint64"), 2)),
    10: "float32",
    11: "float64",
    13: "uint8",
    15: "bool",
    16: "byte",
    17: "string",
    21: "string",
}
"""type_description_interfaces/msg/FieldType, without those that ROS 1 lacks. ``char`` of C++ (13) is one octet."""
_NESTED: Final = 1
_BOUNDED_STRING: Final = 21
_TYPE_NAME: Final = re.compile(r"[A-Za-z][A-Za-z0-9_]*/(msg|srv|action)/[A-Za-z][A-Za-z0-9_]*")
_FIELD_NAME: Final = re.compile(r"[a-z][a-z0-9_]*")
_ARRAY, _BOUNDED, _UNBOUNDED = 48, 96, 144
"""What is added to a type's number for an array of fixed size, a bounded and an unbounded sequence of it."""


def type_request(name: str, type_hash: str) -> bytes:
    """The CDR of a request for the description of ``package/msg/Name`` with a hash."""
    store = _store()
    message = store.types[_REQUEST](type_name=name, type_hash=type_hash, include_type_sources=False)
    return bytes(store.serialize_cdr(message, _REQUEST))


def parse_type_response(raw: Buffer) -> dict[str, Any]:
    """Read a response: the fields of the type and of all that it embeds, in rosbags' form, without constants.

    Raises:
        RemoteProtocolError: It is malformed, too large, or has a field that neither side's ROS has; or the node does
            not know the type, and the text says why.
    """
    if len(raw) > limits.ROS2_DESCRIPTION_MAX:
        raise RemoteProtocolError(f"a type's description has {len(raw)} bytes; at most {limits.ROS2_DESCRIPTION_MAX}")
    try:
        message: Any = _store().deserialize_cdr(bytes(raw), _RESPONSE)
    except (SerdeError, ValueError, IndexError, AssertionError, OverflowError) as error:
        raise RemoteProtocolError(f"a type's description is malformed: {error}") from error
    if not message.successful:
        raise RemoteProtocolError(f"the node does not describe the type: {message.failure_reason[:200]}")
    described = message.type_description
    all_types = (described.type_description, *described.referenced_type_descriptions)
    if len(all_types) > limits.ROS2_DESCRIBED_TYPES_MAX:
        raise RemoteProtocolError(f"a type's description has {len(all_types)} types")
    made: dict[str, Any] = {_type_name(each.type_name): ([], _fields(each)) for each in all_types}
    _check_size(made)
    return made


def _type_name(name: str) -> str:
    if len(name) > limits.ROS2_NAME_MAX or _TYPE_NAME.fullmatch(name) is None:
        raise RemoteProtocolError(f"{name[:80]!r} is not the name of a type of ROS 2")
    return name


def _fields(described: Any) -> list[tuple[str, Any]]:
    if len(described.fields) > DEFINITION_FIELDS_MAX:
        raise RemoteProtocolError(f"{described.type_name} has {len(described.fields)} fields")
    if not described.fields:  # ROS 2's have one at least; elements without bytes may be claimed without end
        raise RemoteProtocolError(f"{described.type_name[:80]} has no fields")
    for field in described.fields:
        if len(field.name) > limits.ROS2_NAME_MAX or _FIELD_NAME.fullmatch(field.name) is None:
            raise RemoteProtocolError(f"{field.name[:80]!r} is not the name of a field of ROS 2")
    names = [field.name for field in described.fields]
    if len(set(names)) < len(names):
        raise RemoteProtocolError(f"{described.type_name} has two fields of one name")
    return [(field.name, _desc(field.type)) for field in described.fields]


def _check_size(types: dict[str, Any]) -> None:
    """Check that no type contains itself, and how much each is with all that it embeds."""

    def fields_of(name: str) -> Iterator[tuple[str, int]]:
        for _, desc in types[name][1] if name in types else ():
            inner = desc[1][0] if desc[0] in (Nodetype.ARRAY, Nodetype.SEQUENCE) else desc
            count = desc[1][1] if desc[0] == Nodetype.ARRAY else 1
            yield str(inner[1]) if inner[0] == Nodetype.NAME else "", count

    for name in types:
        check_size(name, fields_of)


def _desc(kind: Any) -> Any:
    number, capacity = int(kind.type_id), int(kind.capacity)
    for base, node in ((_UNBOUNDED, Nodetype.SEQUENCE), (_BOUNDED, Nodetype.SEQUENCE), (_ARRAY, Nodetype.ARRAY)):
        if number > base:
            if base == _ARRAY and not capacity:
                raise RemoteProtocolError("a field is an array of no elements")
            return (node, (_inner(kind, number - base), 0 if base == _UNBOUNDED else capacity))
    return _inner(kind, number)


def _inner(kind: Any, number: int) -> Any:
    if number == _NESTED:
        return (Nodetype.NAME, _type_name(kind.nested_type_name))
    if number not in _BASES:
        raise RemoteProtocolError(f"a field has the type {number} of REP 2016, which ROS 1 lacks (wide characters)")
    bound = int(kind.string_capacity) if number == _BOUNDED_STRING else 0
    return (Nodetype.BASE, (_BASES[number], bound))


@functools.cache
def _store() -> Typestore:
    jazzy = get_typestore(Stores.ROS2_JAZZY)
    store = Typestore()
    store.fielddefs, store.types = dict(jazzy.fielddefs), dict(jazzy.types)
    text: Any = (Nodetype.BASE, ("string", 0))
    flag: Any = (Nodetype.BASE, ("bool", 0))
    sources, extra = (f"type_description_interfaces/msg/{each}" for each in ("TypeSource", "KeyValue"))
    response: list[tuple[str, Any]] = [
        ("successful", flag),
        ("failure_reason", text),
        ("type_description", (Nodetype.NAME, _DESCRIPTION)),
        ("type_sources", (Nodetype.SEQUENCE, ((Nodetype.NAME, sources), 0))),
        ("extra_information", (Nodetype.SEQUENCE, ((Nodetype.NAME, extra), 0))),
    ]
    request: list[tuple[str, Any]] = [("type_name", text), ("type_hash", text), ("include_type_sources", flag)]
    store.register({_REQUEST: ([], request), _RESPONSE: ([], response)})
    return store
