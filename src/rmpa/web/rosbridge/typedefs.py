"""rosapi's TypeDef: a message type as lists of names, types and examples, for clients that make forms of them."""

from __future__ import annotations

import functools
from typing import TYPE_CHECKING, Any, Final

from rmpa.ros.types.definitions import parse_definition

if TYPE_CHECKING:
    from collections.abc import Mapping

    from rmpa.ros.types.definitions import Field, Specification
    from rmpa.ros.types.messages import MessageType

_TIMES: Final = ("time", "duration")
_EXAMPLES: Final = {"string": "", "bool": "False", "float32": "0.0", "float64": "0.0", "time": "{}", "duration": "{}"}


def typedefs_of(kind: MessageType) -> list[dict[str, Any]]:
    """The type, then all that it embeds, each once, in the order of the fields."""
    return _typedefs(kind.name, kind.definition)


@functools.lru_cache(maxsize=64)
def _typedefs(name: str, definition: str) -> list[dict[str, Any]]:
    known = parse_definition(name, definition)
    order: dict[str, None] = {}
    _visit(name, known, order)
    return [_time(each) if each in _TIMES else _typedef(known[each]) for each in order]


def _visit(name: str, known: Mapping[str, Specification], order: dict[str, None]) -> None:
    order[name] = None
    for field in known[name].fields if name in known else ():
        # The depth is bounded by the definition's parser.
        if field.type not in order and (field.type in _TIMES or not field.primitive):
            _visit(field.type, known, order)


def _typedef(specification: Specification) -> dict[str, Any]:
    fields = specification.fields
    constants = sorted(_constant(each) for each in specification.constants)
    return {
        "type": specification.name,
        "fieldnames": [field.name for field in fields],
        "fieldtypes": [field.type for field in fields],
        "fieldarraylen": [(field.size or 0) if field.array else -1 for field in fields],
        "examples": [_example(field) for field in fields],
        "constnames": [name for name, _ in constants],
        "constvalues": [value for _, value in constants],
    }


def _constant(text: str) -> tuple[str, str]:
    """The name and value of ``type name=value``."""
    name, _, value = text.partition(" ")[2].partition("=")
    return name, value


def _example(field: Field) -> str:
    if field.array:
        return "[]"
    return _EXAMPLES.get(field.type, "0") if field.primitive else "{}"


def _time(name: str) -> dict[str, Any]:
    return {
        "type": name,
        "fieldnames": ["secs", "nsecs"],
        "fieldtypes": ["int32", "int32"],
        "fieldarraylen": [-1, -1],
        "examples": ["0", "0"],
        "constnames": [],
        "constvalues": [],
    }
