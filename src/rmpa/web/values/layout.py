"""Sizes of ROS types on the wire, their ``struct`` codes, and the bounds of a type.

ROS 1 is little-endian and unpadded (wiki.ros.org/msg). ``byte`` is an int8 and ``char`` an uint8, as in genpy.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from rmpa.ros.types.definitions import DefinitionError
from rmpa.web.values import limits

if TYPE_CHECKING:
    from collections.abc import Mapping

    from rmpa.ros.types.definitions import Field, Specification

CODES: Final = {
    "bool": "?",
    "int8": "b",
    "byte": "b",
    "uint8": "B",
    "char": "B",
    "int16": "h",
    "uint16": "H",
    "int32": "i",
    "uint32": "I",
    "int64": "q",
    "uint64": "Q",
    "float32": "f",
    "float64": "d",
}
SIZES: Final = {"?": 1, "b": 1, "B": 1, "h": 2, "H": 2, "i": 4, "I": 4, "q": 8, "Q": 8, "f": 4, "d": 8}
TIMES: Final = {"time": "II", "duration": "ii"}
BYTES: Final = ("uint8", "char")
"""Types whose arrays are base64 in JSON and byte strings in CBOR."""
CBOR_TAGS: Final = {"H": 69, "I": 70, "Q": 71, "b": 72, "h": 77, "i": 78, "q": 79, "f": 85, "d": 86}
"""Little-endian typed arrays (RFC 8746), by ``struct`` code."""
HEADER: Final = "std_msgs/Header"


class Layout:
    """Sizes of a type and of all that it embeds.

    Args:
        name: The type.
        known: The type and all that it embeds; no type contains itself.

    Raises:
        DefinitionError: A message without elements would already have too many values or bytes.
    """

    def __init__(self, name: str, known: Mapping[str, Specification]) -> None:
        self.name = name
        self.known = known
        self._values: dict[str, int] = {}
        self._sizes: dict[str, int] = {}
        if self.values(name) > limits.TYPE_VALUES_MAX or self.size(name) > limits.TYPE_SIZE_MAX:
            problem = f"has {self.values(name)} values and {self.size(name)} bytes at least"
            remedy = f"up to {limits.TYPE_VALUES_MAX} values and {limits.TYPE_SIZE_MAX} bytes are converted"
            raise DefinitionError(name, problem, f"{remedy}; subscribe with cbor-raw")

    def fields(self, name: str) -> tuple[Field, ...]:
        """The fields of a type."""
        return self.known[name].fields

    def values(self, name: str) -> int:
        """Values of a message whose arrays of any length are empty, itself included."""
        if name not in self._values:
            self._values[name] = 1 + sum(map(self._field_values, self.fields(name)))
        return self._values[name]

    def size(self, name: str) -> int:
        """Bytes of the smallest message: all zero, and the default."""
        if name not in self._sizes:
            self._sizes[name] = sum(map(self.field_size, self.fields(name)))
        return self._sizes[name]

    def field_size(self, field: Field) -> int:
        """Bytes of the field's default."""
        if field.array and field.size is None:
            return 4
        return self.item_size(field.type) * (1 if field.size is None else field.size)

    def item_size(self, kind: str) -> int:
        """Bytes of the default of a type, which may be a primitive."""
        if kind == "string":
            return 4
        if kind in TIMES:
            return 8
        return SIZES[CODES[kind]] if kind in CODES else self.size(kind)

    def is_flat(self, name: str) -> bool:
        """Whether a message is a few numbers only, without arrays and strings."""
        size = self.size(name)
        return size > 0 and self.values(name) <= limits.INLINE_MAX and all(map(self._flat_field, self.fields(name)))

    def _flat_field(self, field: Field) -> bool:
        if field.array or field.type == "string":
            return False
        return field.primitive or self.is_flat(field.type)

    def _field_values(self, field: Field) -> int:
        if field.primitive or (field.array and field.size is None):
            return 1
        return self.values(field.type) * (1 if field.size is None else field.size)
