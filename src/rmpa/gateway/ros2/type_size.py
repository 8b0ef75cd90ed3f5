"""How large a type is with all that it embeds: definitions of a few bytes can embed types billions of times."""

from __future__ import annotations

from typing import TYPE_CHECKING

from rmpa.core.errors import RemoteProtocolError
from rmpa.gateway import limits
from rmpa.ros.limits import DEFINITION_DEPTH_MAX

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Mapping

    from rmpa.ros.types.definitions import Specification


def check_size(name: str, fields_of: Callable[[str], Iterable[tuple[str, int]]]) -> None:
    """Check a type, in time linear in the fields of the types that it embeds.

    Args:
        name: The type.
        fields_of: A type's fields: for each the embedded type (empty for none), and the elements of an array of fixed
            length (else 1).

    Raises:
        RemoteProtocolError: It embeds itself, is nested too deeply, or is larger than ``limits.ROS2_PARTS_MAX`` or
            ``limits.ROS2_ARRAY_MAX`` allow.
    """
    known: dict[str, tuple[int, int]] = {}

    def measure(each: str, inside: tuple[str, ...]) -> tuple[int, int]:
        if each in inside or len(inside) > DEFINITION_DEPTH_MAX:
            raise RemoteProtocolError(f"{each} contains itself, or is nested too deeply")
        if each not in known:
            parts = elements = 1
            for embedded, count in fields_of(each):
                within = measure(embedded, (*inside, each)) if embedded else (1, 1)
                parts += within[0]
                elements += count * within[1]
            known[each] = parts, elements
        return known[each]

    parts, elements = measure(name, ())
    if parts > limits.ROS2_PARTS_MAX:
        raise RemoteProtocolError(f"{name} has more than {limits.ROS2_PARTS_MAX} fields with those of its types")
    if elements > limits.ROS2_ARRAY_MAX:
        raise RemoteProtocolError(f"{name} has arrays of more than {limits.ROS2_ARRAY_MAX} elements")


def check_ros1_size(name: str, specifications: Mapping[str, Specification]) -> None:
    """Check a type of ROS 1; errors as for ``check_size``."""

    def fields_of(each: str) -> Iterable[tuple[str, int]]:
        for field in specifications[each].fields if each in specifications else ():
            yield "" if field.primitive else field.type, field.size or 1

    check_size(name, fields_of)
