"""Parameters of ROS 1 and ROS 2: values, names, and the services of rcl_interfaces. Without I/O.

A parameter of ROS 2 belongs to a node and has one of nine types; ``a.b`` is its name. ROS 1 has one tree for all
nodes: the parameter ``a.b`` of ``/ns/node`` is ``/ros2/ns/node/a/b`` there, and ``/a/b`` of a module is ``a.b`` of
the node ``/rmpa/<module>``.
"""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Any, Final

from rosbags.interfaces import Nodetype

from rmpa.core.errors import RemoteProtocolError

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

    from rmpa.gateway.ros2.types import Ros2Types
    from rmpa.ros.wire.xmlrpc import XmlRpcValue

PACKAGE: Final = "rcl_interfaces"
EVENT_TYPE: Final = "rcl_interfaces/msg/ParameterEvent"
EVENTS: Final = "/parameter_events"
"""The topic on which each node of ROS 2 tells of its parameters."""
ROOT: Final = "/ros2"
"""Below it the parameters of ROS 2's nodes are in ROS 1's tree."""
_VALUE: Final = "rcl_interfaces/msg/ParameterValue"
_NOT_SET: Final = 0
_STRING: Final = 4
_TYPES: Final = {
    1: "bool_value",
    2: "integer_value",
    3: "double_value",
    4: "string_value",
    5: "byte_array_value",
    6: "bool_array_value",
    7: "integer_array_value",
    8: "double_array_value",
    9: "string_array_value",
}
"""The field of each type of a ParameterValue (rcl_interfaces/ParameterType)."""
_INT_MAX: Final = 2**31
"""Integers of ROS 1 have 32 bits (XML-RPC); larger ones become doubles there."""


def _strings(name: str) -> tuple[str, Any]:
    return name, (Nodetype.SEQUENCE, ((Nodetype.BASE, ("string", 0)), 0))


def _many(name: str, kind: str) -> tuple[str, Any]:
    return name, (Nodetype.SEQUENCE, ((Nodetype.NAME, f"rcl_interfaces/msg/{kind}"), 0))


def _one(name: str, kind: str) -> tuple[str, Any]:
    return name, (Nodetype.NAME, f"rcl_interfaces/msg/{kind}")


_SERVICES: Final = {
    "get_parameters": ("GetParameters", [_strings("names")], [_many("values", "ParameterValue")]),
    "get_parameter_types": (
        "GetParameterTypes",
        [_strings("names")],
        [("types", (Nodetype.SEQUENCE, ((Nodetype.BASE, ("uint8", 0)), 0)))],
    ),
    "set_parameters": (
        "SetParameters",
        [_many("parameters", "Parameter")],
        [_many("results", "SetParametersResult")],
    ),
    "set_parameters_atomically": (
        "SetParametersAtomically",
        [_many("parameters", "Parameter")],
        [_one("result", "SetParametersResult")],
    ),
    "list_parameters": (
        "ListParameters",
        [_strings("prefixes"), ("depth", (Nodetype.BASE, ("uint64", 0)))],
        [_one("result", "ListParametersResult")],
    ),
    "describe_parameters": (
        "DescribeParameters",
        [_strings("names")],
        [_many("descriptors", "ParameterDescriptor")],
    ),
}
SERVICES: Final = tuple(_SERVICES)
"""The last parts of the names of the services that each node of ROS 2 has for its parameters."""


class ParamTypes:
    """The types of rcl_interfaces: requests, responses and values, to and from CDR.

    Args:
        types: ROS 2's types.
    """

    def __init__(self, types: Ros2Types) -> None:
        self._types = types
        for base, request, response in _SERVICES.values():
            types.define_service(f"rcl_interfaces/srv/{base}", request, response)

    def service(self, name: str) -> tuple[str, str]:
        """The type of a service, and its hash, by the last part of its name."""
        kind = f"rcl_interfaces/srv/{_SERVICES[name][0]}"
        return kind, self._types.type_hash(kind)

    def event_hash(self) -> str:
        """The hash of ParameterEvent."""
        return self._types.type_hash(EVENT_TYPE)

    def write(self, kind: str, **fields: Any) -> bytes:
        """Make CDR of a message of rcl_interfaces."""
        return bytes(self._types.store.serialize_cdr(self.make(kind, **fields), kind))

    def make(self, kind: str, **fields: Any) -> Any:
        """Make a message object."""
        return self._types.store.types[kind](**fields)

    def read(self, kind: str, raw: bytes) -> Any:
        """Read CDR.

        Raises:
            RemoteProtocolError: The bytes are no such message.
        """
        try:
            return self._types.store.deserialize_cdr(raw, kind)
        except Exception as error:  # rosbags does not check everything
            raise RemoteProtocolError(f"{len(raw)} bytes are no {kind}: {error}") from error

    def value(self, value: XmlRpcValue) -> Any:
        """A ParameterValue of a value of ROS 1; what ROS 2 has no type for becomes JSON as a string."""
        import numpy as np  # noqa: PLC0415 - it takes 70 ms, and few gateways have ROS 2

        kind, content = _typed(value)
        fields: dict[str, Any] = {
            "type": kind,
            "bool_value": False,
            "integer_value": 0,
            "double_value": 0.0,
            "string_value": "",
            "byte_array_value": np.zeros(0, np.uint8),
            "bool_array_value": np.zeros(0, np.bool_),
            "integer_array_value": np.zeros(0, np.int64),
            "double_array_value": np.zeros(0, np.float64),
            "string_array_value": [],
        }
        if kind in _TYPES:
            name = _TYPES[kind]
            empty = fields[name]
            fields[name] = np.array(content, empty.dtype) if isinstance(empty, np.ndarray) else content
        return self.make(_VALUE, **fields)

    @staticmethod
    def plain(value: Any) -> XmlRpcValue:
        """A value of ROS 1 of a ParameterValue; ``None`` for one that is not set, or of an unknown type."""
        name = _TYPES.get(int(value.type))
        if name is None:
            return None
        found = getattr(value, name)
        if name == "byte_array_value":
            return bytes(found)
        values: list[Any] = found if not hasattr(found, "tolist") else found.tolist()
        if not name.endswith("_array_value"):
            values = [found]
        if name.startswith("integer") and not all(-_INT_MAX <= each < _INT_MAX for each in values):
            values = [float(each) for each in values]
        made: XmlRpcValue = values if name.endswith("_array_value") else values[0]
        return made


def _typed(value: XmlRpcValue) -> tuple[int, Any]:
    """The type of a value in ROS 2, and its content."""
    if value is None:
        return _NOT_SET, None
    for kind, python in ((1, bool), (2, int), (3, float), (4, str)):
        if isinstance(value, python):
            return kind, value
    if isinstance(value, bytes | bytearray):
        return 5, list(value)
    if isinstance(value, list):
        if all(isinstance(each, bool) for each in value) and value:
            return 6, value
        if not any(isinstance(each, bool) for each in value) and value:
            if all(isinstance(each, int) for each in value):
                return 7, value
            if all(isinstance(each, int | float) for each in value):
                return 8, value
        if all(isinstance(each, str) for each in value):
            return 9, value
    return _STRING, json.dumps(value, default=str)


def name_in_ros2(key: str) -> str:
    """``/a/b`` of ROS 1 as the name of a parameter of ROS 2."""
    return key.strip("/").replace("/", ".")


def key_of(name: str) -> str:
    """The name of a parameter of ROS 2 as a key of ROS 1, ``/a/b``."""
    return "/" + name.strip(".").replace(".", "/")


def listed(names: Iterable[str], prefixes: Iterable[str], depth: int) -> tuple[list[str], list[str]]:
    """What ``list_parameters`` returns: the names, and the namespaces before their last part.

    Args:
        names: All names.
        prefixes: The namespaces that are asked for; none: all.
        depth: How many parts below a prefix a name may have; 0: any number.
    """
    wanted = list(prefixes)
    found = []
    for name in sorted(names):
        if not wanted:
            fits = depth == 0 or name.count(".") < depth
        else:
            fits = any(
                name == prefix
                or (name.startswith(f"{prefix}.") and (not depth or name[len(prefix) + 1 :].count(".") < depth))
                for prefix in wanted
            )
        if fits:
            found.append(name)
    return found, sorted({name.rpartition(".")[0] for name in found if "." in name})


def flat(values: Mapping[str, XmlRpcValue], below: str = "") -> dict[str, XmlRpcValue]:
    """The values of a tree of ROS 1 by the names of ROS 2; empty namespaces are left out."""
    found: dict[str, XmlRpcValue] = {}
    for name, value in values.items():
        full = f"{below}.{name}" if below else name
        if isinstance(value, dict):
            found |= flat(value, full)
        else:
            found[full] = value
    return found
