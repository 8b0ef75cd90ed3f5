"""Encodes large JSON values in pieces, between which other work can be done."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import msgspec

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

_BATCH: Final = 16
"""Elements of a list in one piece: some 50 microseconds where they are topics."""


def json_pieces(value: object) -> Iterator[bytes]:
    """The output of ``msgspec.json.encode`` in pieces: long lists, also those in fields of structs, are cut.

    Args:
        value: Must not change meanwhile.

    Raises:
        TypeError, ValueError, RecursionError: JSON cannot hold it.
    """
    if isinstance(value, list | tuple) and len(value) > _BATCH:
        yield from _list(value)
    elif isinstance(value, msgspec.Struct) and not type(value).__struct_config__.tag:
        yield from _struct(value)
    else:
        yield msgspec.json.encode(value)


def _list(values: Sequence[object]) -> Iterator[bytes]:
    for begin in range(0, len(values), _BATCH):
        yield b"[" if begin == 0 else b","
        yield msgspec.json.encode(values[begin : begin + _BATCH])[1:-1]
    yield b"]"


def _struct(value: msgspec.Struct) -> Iterator[bytes]:
    omit = type(value).__struct_config__.omit_defaults
    separator = b"{"
    for field in msgspec.structs.fields(value):
        content = getattr(value, field.name)
        if omit and content == _default(field):
            continue
        yield separator + msgspec.json.encode(field.encode_name) + b":"
        yield from json_pieces(content)
        separator = b","
    yield b"{}" if separator == b"{" else b"}"


def _default(field: msgspec.structs.FieldInfo) -> object:
    return field.default if field.default_factory is msgspec.NODEFAULT else field.default_factory()
