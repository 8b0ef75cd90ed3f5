"""rosbridge v2: a client's frames, messages in JSON, JSON as a PNG, CBOR and cbor-raw (ROS 1 bytes), and their pace.

An op is a JSON object; of a binary frame, a CBOR map with the same keys. ``package/msg/Name``, as ROS 2 clients write
it, is read as ``package/Name``.
"""

from __future__ import annotations

import base64
import enum
import json
import math
from collections import OrderedDict
from dataclasses import dataclass, field
from functools import lru_cache
from typing import TYPE_CHECKING, Any, TypeAlias

import cbor2
import msgspec

from rmpa.core.errors import LimitExceeded, RemoteProtocolError
from rmpa.core.identity import is_type_name, resolve_name
from rmpa.web.hub.frame_writer import Opcode, OutFrame, size_of
from rmpa.web.pictures import png_file, png_pixels
from rmpa.web.rosbridge import limits

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

    from rmpa.ros.types.codec import MessageCodec


Id: TypeAlias = str | int | None
Part: TypeAlias = bytes | bytearray | memoryview


@dataclass
class OpError(RemoteProtocolError):
    """A client's op cannot be done."""

    problem: str
    remedy: str = ""

    def __str__(self) -> str:
        """The problem and the remedy."""
        return f"{self.problem}; {self.remedy}" if self.remedy else self.problem


def parse_frame(data: str | Part) -> dict[str, Any]:
    """Read a frame: text is JSON, bytes are CBOR.

    Raises:
        OpError: The frame is neither, or no object with text keys.
        LimitExceeded: The frame is too long.
    """
    most = limits.FRAME_MAX if isinstance(data, str) else limits.BINARY_FRAME_MAX
    if len(data) > most:
        raise LimitExceeded("frame", len(data), most)
    values = _json(data) if isinstance(data, str) else _cbor(data)
    if not isinstance(values, dict):
        raise OpError(f"a frame is an object with an 'op', not a {type(values).__name__}")
    return values


def read_op(values: Mapping[str, Any], ops: Mapping[str, type[msgspec.Struct]]) -> tuple[str, dict[str, Any]]:
    """The op of a frame, and its fields.

    Unknown keys are ignored, as rosbridge_suite does.

    Args:
        values: The frame.
        ops: The structs of all ops, by name.

    Raises:
        OpError: The op is unknown, a key is missing, or a value has the wrong type.
    """
    name = values.get("op")
    if not isinstance(name, str):
        if "receiver" in values:
            raise OpError("this is a message of rosbridge v1", "write it as rosbridge v2, with an 'op'")
        raise OpError("the message has no 'op'", f"it is one of {', '.join(ops)}")
    kind = ops.get(name)
    if kind is None:
        raise OpError(f"unknown op {_short(name)}", f"it is one of {', '.join(ops)}")
    try:
        fields = msgspec.structs.asdict(msgspec.convert(values, kind))
    except (msgspec.ValidationError, RecursionError) as error:
        raise OpError(f"{name}: {str(error)[: limits.TEXT_MAX]}") from None
    mid = fields["id_"]
    if isinstance(mid, str) and len(mid) > limits.ID_MAX:
        raise LimitExceeded("id", len(mid), limits.ID_MAX)
    if isinstance(mid, int) and abs(mid) >= 1 << 63:
        raise OpError("an id that is a number has 64 bits")
    return name, fields


def id_of(values: Mapping[str, Any]) -> Id:
    """The id of a frame, for its status messages; None where it is no id."""
    found = values.get("id")
    if isinstance(found, str):
        return found if len(found) <= limits.ID_MAX else None
    return found if isinstance(found, int) and abs(found) < 1 << 63 else None


def graph_name(name: str) -> str:
    """The global name of what a client calls by `name`.

    Raises:
        OpError: It is no name.
    """
    if not name or len(name) > limits.NAME_MAX:
        raise OpError(f"a name has 1 to {limits.NAME_MAX} characters, not {len(name)}")
    try:
        return resolve_name(name, "/", "/rosbridge")
    except ValueError:
        problem = f"{_short(name)} is not a ROS name"
        raise OpError(problem, "allowed are letters, digits, _ and /, after a letter, / or ~") from None


def type_name(name: str) -> str:
    """``package/Name`` of a type, from that or ``package/msg/Name`` (``srv``).

    Raises:
        OpError: It is no type's name.
    """
    parts = name.split("/") if len(name) <= limits.NAME_MAX else []
    if len(parts) == 3 and parts[1] in ("msg", "srv"):
        del parts[1]
    plain = "/".join(parts)
    if not is_type_name(plain):
        raise OpError(f"{_short(name)} is not a type's name", "write it like std_msgs/String")
    return plain


def whole(value: float | None, what: str, least: int = 0) -> int:
    """An integer that some clients write as a fraction; None is `least`.

    Raises:
        OpError: It is negative, not finite, or less than `least`.
    """
    if value is None:
        return least
    if not math.isfinite(value) or value < least:
        raise OpError(f"{what} is {least} or more, not {value}")
    return int(min(value, 1 << 53))


def check_count(count: int, limit: int, what: str) -> None:
    """Refuse one more where `count` are there.

    Raises:
        OpError: The limit is reached.
    """
    if count >= limit:
        raise OpError(f"this client has {count} {what} already", f"{limit} are allowed; end some first")


def _short(text: str) -> str:
    return repr(text[:80].encode("utf-8", "backslashreplace").decode())


def _json(text: str) -> object:
    # Brackets within strings count, too: they are rare, and counting them takes no time.
    if (count := text.count("{") + text.count("[")) > limits.CONTAINERS_MAX:
        raise OpError(f"the message has {count} objects and lists", f"up to {limits.CONTAINERS_MAX} are read")
    try:
        return msgspec.json.decode(text)
    except RecursionError:
        raise OpError("the message is nested too deep") from None
    except (msgspec.DecodeError, UnicodeError) as error:
        first = error
    # Python's clients write NaN and Infinity, which are no JSON and which rosbridge_suite accepts.
    if "NaN" not in text and "Infinity" not in text:
        raise OpError(f"the message is not JSON: {first}"[: limits.TEXT_MAX])
    try:
        values: object = json.loads(text)
        msgspec.json.encode(values)  # Python also takes half of a surrogate pair, which cannot be sent back
    except RecursionError:
        raise OpError("the message is nested too deep") from None
    except (ValueError, OverflowError):
        raise OpError(f"the message is not JSON: {first}"[: limits.TEXT_MAX]) from None
    return values


def _cbor(data: Part) -> object:
    try:
        values: object = cbor2.loads(data, max_depth=64, allow_duplicate_keys=False)
    except (cbor2.CBORError, RecursionError, ValueError, TypeError, OverflowError, MemoryError) as error:
        raise OpError(f"a binary message is CBOR: {error}"[: limits.TEXT_MAX]) from None
    return values


class Compression(enum.IntEnum):
    """The ``compression`` of a subscription; of several, the highest is used."""

    NONE = 0
    PNG = 1
    CBOR = 2
    CBOR_RAW = 3

    @classmethod
    def parse(cls, name: str | None) -> Compression:
        """Read it as clients write it.

        Raises:
            OpError: It is unknown.
        """
        for each in cls:
            if (name or "none") == each.name.lower().replace("_", "-"):
                return each
        raise OpError(f"unknown compression {str(name)[:40]!r}", "it is none, png, cbor or cbor-raw")


def encode_message(topic: str, payload: memoryview, compression: Compression, codec: MessageCodec) -> OutFrame:
    """A ``publish`` in JSON, PNG or CBOR.

    Raises:
        MessageError: The payload is not a message of the codec's type.
    """
    if compression is Compression.CBOR:
        return encode({"op": "publish", "topic": topic, "msg": codec.cbor_values(payload)}, compression)
    head = b'{"op":"publish","topic":' + msgspec.json.encode(topic) + b',"msg":'
    frame = Opcode.TEXT, (head, codec.json(payload), b"}")
    return encode_png(data_of(frame)) if compression is Compression.PNG else frame


def encode(values: Mapping[str, Any], compression: Compression = Compression.NONE) -> OutFrame:
    """An op."""
    if compression >= Compression.CBOR:
        return Opcode.BINARY, (cbor2.dumps(values),)
    text = msgspec.json.encode(values)
    return encode_png(text) if compression is Compression.PNG else (Opcode.TEXT, (text,))


def data_of(frame: OutFrame) -> Part:
    """The parts of a frame as one."""
    return frame[1][0] if len(frame[1]) == 1 else b"".join(frame[1])


def encode_cbor_raw(topic: str, payload: memoryview, stamp_ns: int) -> OutFrame:
    """A ``publish`` of ROS 1 bytes, which are not copied: ``msg`` is ``{secs, nsecs, bytes}``."""
    secs, nsecs = divmod(max(0, stamp_ns), 1_000_000_000)
    stamp = b"".join((b"\x64secs", _cbor_length(0, secs), b"\x65nsecs", _cbor_length(0, nsecs)))
    head = b"".join((_cbor_raw_head(topic), stamp, b"\x65bytes", _cbor_length(0x40, len(payload))))
    return Opcode.BINARY, (head, payload)


@lru_cache(limits.SUBSCRIPTIONS_MAX)
def _cbor_raw_head(topic: str) -> bytes:
    """All before the time: it is the same for each message of a topic."""
    # A map of three: the two keys here, and msg.
    return b"\xa3" + cbor2.dumps({"op": "publish", "topic": topic})[1:] + b"\x63msg\xa3"


def _cbor_length(major: int, length: int) -> bytes:
    encoded = cbor2.dumps(length)
    return bytes((major | encoded[0],)) + encoded[1:]


def encode_png(text: Part) -> OutFrame:
    """An op ``png``: the bytes of another op as the RGB pixels of a picture that is nearly square.

    Newlines, which JSON allows at its end, fill the last line.
    """
    width = max(1, math.isqrt(len(text) // 3))
    row = 3 * width
    height = max(1, -(-len(text) // row))
    padded = bytes(text).ljust(row * height, b"\n")
    picture = png_file(width, height, 2, (padded[at : at + row] for at in range(0, len(padded), row)))
    return encode({"op": "png", "data": base64.b64encode(picture).decode()})


def decode_png(text: str) -> str:
    """The op in a client's picture, as ``png_pixels`` reads it.

    Raises:
        RemoteProtocolError: The text is not such a picture, or its pixels are not UTF-8.
        LimitExceeded: Its pixels are too many.
    """
    try:
        return png_pixels(base64.b64decode(text, validate=True), limits.PNG_MAX).decode()
    except UnicodeDecodeError:
        raise OpError("the pixels of a png are not UTF-8") from None
    except ValueError:
        raise OpError("the data of a png is base64") from None


def split(frame: OutFrame, size: int, mid: Id) -> list[OutFrame]:
    """Cut a frame of JSON into fragments of up to `size` characters; a frame that fits, and CBOR, stay whole.

    Args:
        frame: The op.
        size: Characters, 1 or more.
        mid: The id of all fragments.

    Raises:
        OpError: The fragments are too many.
    """
    opcode, _ = frame
    if opcode is Opcode.BINARY or size_of(frame) <= size:
        return [frame]
    text = bytes(data_of(frame)).decode()
    total = -(-len(text) // size)
    if total > limits.FRAGMENTS_MAX:
        problem = f"a message of {len(text)} characters would be {total} fragments of {size}"
        raise OpError(problem, f"ask for a fragment_size of {-(-len(text) // limits.FRAGMENTS_MAX)} or more")
    if total == 1:
        return [frame]
    pieces = (text[at : at + size] for at in range(0, len(text), size))
    return [
        encode({"op": "fragment", "id": mid, "data": piece, "num": num, "total": total})
        for num, piece in enumerate(pieces)
    ]


@dataclass(slots=True)
class _Incomplete:
    total: int
    deadline: float
    size: int = 0
    pieces: dict[int, str] = field(default_factory=dict)


class Assembler:
    """Puts a client's fragments together. They may come in any order; a repeated one is ignored."""

    def __init__(self) -> None:
        self._messages: OrderedDict[tuple[str, str | int], _Incomplete] = OrderedDict()
        self._bytes = 0

    def add(self, kind: str, mid: str | int, num: int, total: int, data: str, now: float) -> str | None:
        """Take one fragment.

        Args:
            kind: Its op, fragment or png.
            mid: Its id.
            num: Its place, from 0.
            total: How many there are.
            data: Its text.
            now: The present time.

        Returns:
            The whole text with the last missing fragment; else None.

        Raises:
            OpError: The numbers are impossible.
            LimitExceeded: The message has too many fragments, or is too long.
        """
        if total > limits.FRAGMENTS_MAX:
            raise LimitExceeded("total of fragments", total, limits.FRAGMENTS_MAX)
        if total < 1 or not 0 <= num < total:
            raise OpError(f"fragment {num} of {total} cannot be: they count from 0")
        key = (kind, mid)
        message = self._messages.get(key)
        if message is None:
            message = self._messages[key] = _Incomplete(total, now)
        elif message.total != total:
            self._drop(key)
            raise OpError(f"the fragments of {str(mid)[:80]!r} disagree: {message.total} or {total} in all")
        message.deadline = now + limits.FRAGMENT_TIMEOUT
        self._messages.move_to_end(key)
        if num not in message.pieces:
            self._store(key, message, num, data)
        if len(message.pieces) < total:
            return None
        self._drop(key)
        return "".join(message.pieces[index] for index in range(total))

    def _store(self, key: tuple[str, str | int], message: _Incomplete, num: int, data: str) -> None:
        # Python keeps up to four bytes a character, and some 200 bytes for each piece.
        size = len(data) * (1 if data.isascii() else 4) + 200
        if message.size + size > limits.FRAGMENTED_MAX:
            self._drop(key)
            raise LimitExceeded("message in fragments", message.size + size, limits.FRAGMENTED_MAX)
        message.pieces[num] = data
        message.size += size
        self._bytes += size
        while self._bytes > limits.FRAGMENTED_MAX or len(self._messages) > limits.FRAGMENTED_MESSAGES_MAX:
            self._drop(next(iter(self._messages)))

    def next_timer(self) -> float | None:
        """When `expire` is to be called; None for never."""
        return min((each.deadline for each in self._messages.values()), default=None)

    def expire(self, now: float) -> Iterator[str | int]:
        """Drop the messages whose next fragment is overdue; yields their ids."""
        for key, message in list(self._messages.items()):
            if message.deadline <= now:
                self._drop(key)
                yield key[1]

    def _drop(self, key: tuple[str, str | int]) -> None:
        self._bytes -= self._messages.pop(key).size
