"""A rosbags type store without CDR, which prepares a message type in a quarter of the time, with ROS 1's numbers.

rosbags takes a ``byte`` for an unsigned number and the seconds of a time for signed ones, as in ROS 2; in ROS 1 a
``byte`` is an int8, a time two uint32, and a duration two int32 (wiki.ros.org/msg, genpy).

rosbags generates twelve functions for each type when the type is first used; only three of them are for ROS 1, and
only these are generated here. This module is imported when the first message is built or read (see
``ros.types.messages``).
"""

from __future__ import annotations

import dataclasses
from typing import TYPE_CHECKING, Any, Final, NoReturn

from rosbags.interfaces import Msgdef, Nodetype
from rosbags.serde.ros1 import generate_deserialize_ros1, generate_getsize_ros1, generate_serialize_ros1
from rosbags.typesys import Stores, get_typestore
from rosbags.typesys.base import normalize_fieldname
from rosbags.typesys.store import Typestore

if TYPE_CHECKING:
    from rosbags.interfaces.typing import FieldDesc

_BYTE: Final = (Nodetype.BASE, ("byte", 0))
_INT8: Final[FieldDesc] = (Nodetype.BASE, ("int8", 0))
# What the two fields of a time are.
_TIMES: Final[dict[str, FieldDesc]] = {
    "builtin_interfaces/msg/Time": (Nodetype.BASE, ("uint32", 0)),
    "builtin_interfaces/msg/Duration": (Nodetype.BASE, ("int32", 0)),
}


class Ros1Store(Typestore):
    """A store that begins with the types of one of rosbags' stores.

    Args:
        begin: The rosbags store whose types it gets.
    """

    def __init__(self, begin: Stores) -> None:
        super().__init__()
        known = get_typestore(begin)
        self.fielddefs = dict(known.fielddefs)
        self.types = dict(known.types)

    def get_msgdef(self, typename: str) -> Msgdef[object]:
        """The serialization functions of a type, which are generated at the first call.

        Raises:
            KeyError: The type is not known.
        """
        found = self.cache.get(typename)
        if found is None:
            fields = [
                (normalize_fieldname(name), _TIMES.get(typename) or _ros1(kind))
                for name, kind in self.fielddefs[typename][1]
            ]
            getsize, size = generate_getsize_ros1(fields, self)
            cdr: dict[str, Any] = {each.name: _no_cdr for each in dataclasses.fields(Msgdef)}
            ros1: dict[str, Any] = {
                "name": typename,
                "fields": fields,
                "cls": self.types[typename],
                "size_cdr": 0,
                "size_ros1": size,
                "getsize_ros1": getsize,
                "serialize_ros1": generate_serialize_ros1(fields, self),
                "deserialize_ros1": generate_deserialize_ros1(fields, self),
            }
            found = self.cache[typename] = Msgdef(**cdr | ros1)
        return found


def _ros1(kind: FieldDesc) -> FieldDesc:
    """A field with ``int8`` in place of ``byte``."""
    if kind[0] in (Nodetype.ARRAY, Nodetype.SEQUENCE):
        return (kind[0], (_INT8, kind[1][1])) if kind[1][0] == _BYTE else kind  # type: ignore[return-value] # one of two
    return _INT8 if kind == _BYTE else kind


def _no_cdr(*_: object) -> NoReturn:
    raise NotImplementedError("this store reads and writes ROS 1 alone")
