"""The conversions of one message type, compiled when they are first used and kept for the process."""

from __future__ import annotations

import functools
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import msgspec

from rmpa.ros.types.definitions import parse_definition
from rmpa.ros.types.messages import MessageError
from rmpa.web.values import limits
from rmpa.web.values.layout import Layout
from rmpa.web.values.reader import Flavour, Values, compile_reader
from rmpa.web.values.writer import compile_writer, shown

if TYPE_CHECKING:
    from collections.abc import Callable

    from rmpa.ros.types.messages import MessageType
    from rmpa.web.values.reader import Reader
    from rmpa.web.values.writer import Writing


@dataclass(frozen=True, slots=True)
class Written:
    """A message from values.

    Args:
        payload: The ROS 1 bytes.
        missing: The first fields that were not given; a header and its fields do not count.
    """

    payload: bytes
    missing: tuple[str, ...] = ()


class MessageCodec:
    """Converts messages of one type.

    Args:
        name: ``package/Name``.
        definition: The full text with all that it embeds.

    Raises:
        DefinitionError: The definition is malformed, or its smallest message is too large (`limits`).
        LimitExceeded: The definition is too long.
    """

    def __init__(self, name: str, definition: str) -> None:
        self.name = name
        self._layout = Layout(name, parse_definition(name, definition))

    def json_values(self, payload: memoryview) -> Values:
        """Values for msgspec, which writes NaN and infinity as null, and memoryviews in base64.

        Raises:
            MessageError: The bytes are not a message of this type.
        """
        return self._json(payload)

    def json(self, payload: memoryview) -> bytes:
        """The message as a JSON object; errors as for `json_values`."""
        return msgspec.json.encode(self._json(payload))

    def cbor_values(self, payload: memoryview) -> Values:
        """Values for cbor2; errors as for `json_values`."""
        return self._cbor(payload)

    def write(self, values: Any, now_ns: int) -> Written:
        """The ROS 1 bytes of a mapping of fields. `now_ns` (UTC) is for stamps that are not given and for ``"now"``.

        Raises:
            MessageError: A field is unknown, or a value does not fit.
        """
        writing = self._write(values, now_ns)
        return Written(bytes(writing.out), tuple(writing.missing))

    def write_arguments(self, values: Any, now_ns: int) -> Written:
        """As `write`, also from a list of the fields in order; None is no arguments (rosbridge's ``args``)."""
        if isinstance(values, list | tuple):
            fields = self._layout.fields(self.name)
            if len(values) > len(fields):
                raise MessageError(f"{self.name}: has {len(fields)} fields, not {len(values)}")
            values = dict(zip((field.name for field in fields), values, strict=False))
        if values is not None and not isinstance(values, Mapping):
            raise MessageError(f"{self.name}: arguments are an object or a list, not {shown(values)}")
        return self.write(values or {}, now_ns)

    @functools.cached_property
    def _json(self) -> Reader:
        return compile_reader(self._layout, Flavour.JSON)

    @functools.cached_property
    def _cbor(self) -> Reader:
        return compile_reader(self._layout, Flavour.CBOR)

    @functools.cached_property
    def _write(self) -> Callable[[Any, int], Writing]:
        return compile_writer(self._layout)


def codec_for(kind: MessageType) -> MessageCodec:
    """The codec of a type; the last `limits.CODECS_MAX` are kept.

    Raises:
        DefinitionError: As for `MessageCodec`.
        LimitExceeded: Likewise.
    """
    return _codec(kind.name, kind.definition)


@functools.lru_cache(maxsize=limits.CODECS_MAX)
def _codec(name: str, definition: str) -> MessageCodec:
    return MessageCodec(name, definition)
