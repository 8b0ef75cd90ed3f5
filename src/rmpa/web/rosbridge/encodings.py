"""Messages for a client in the four encodings: JSON, JSON as a PNG, CBOR, and ROS 1 bytes in CBOR (cbor-raw)."""

from __future__ import annotations

import base64
import binascii
import enum
import math
import struct
import zlib
from collections import OrderedDict
from functools import lru_cache
from typing import TYPE_CHECKING, Any, Final

import cbor2
import msgspec

from rmpa.core.errors import LimitExceeded
from rmpa.web.rosbridge import limits
from rmpa.web.rosbridge.protocol import OpError, RosbridgeFrame, write_op

if TYPE_CHECKING:
    from collections.abc import Mapping

    from rmpa.web.values.codec import MessageCodec

_SIGNATURE: Final = b"\x89PNG\r\n\x1a\n"
_CHUNK: Final = struct.Struct(">I4s")
_IHDR: Final = struct.Struct(">IIBBBBB")
_PNG_LEVEL: Final = 1
"""Of zlib; higher ones take five times as long for a tenth less."""


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


class PublishFrames:
    """Encodes messages for subscribers, each once for all clients of a topic that want it alike.

    A message is recognised by its payload, which must be the same memoryview for all. The last
    `limits.SHARED_FRAMES` are kept.
    """

    def __init__(self) -> None:
        self._kept: OrderedDict[tuple[int, str, Compression], tuple[memoryview, RosbridgeFrame]] = OrderedDict()
        self._bytes = 0

    def encode(
        self, topic: str, payload: memoryview, compression: Compression, codec: MessageCodec
    ) -> RosbridgeFrame:
        """A ``publish`` in JSON, PNG or CBOR.

        Raises:
            MessageError: The payload is not a message of the codec's type.
        """
        key = (id(payload), topic, compression)
        kept = self._kept.get(key)
        if kept is not None:
            # The payload is kept too, so its id cannot have been given to another.
            self._kept.move_to_end(key)
            return kept[1]
        frame = _encode(topic, payload, compression, codec)
        size = frame.size + len(payload)
        if size <= limits.SHARED_BYTES:
            self._kept[key] = (payload, frame)
            self._bytes += size
            while self._bytes > limits.SHARED_BYTES or len(self._kept) > limits.SHARED_FRAMES:
                _, (old, gone) = self._kept.popitem(last=False)
                self._bytes -= gone.size + len(old)
        return frame


def _encode(topic: str, payload: memoryview, compression: Compression, codec: MessageCodec) -> RosbridgeFrame:
    if compression is Compression.CBOR:
        return encode_cbor({"op": "publish", "topic": topic, "msg": codec.cbor_values(payload)})
    head = b'{"op":"publish","topic":' + msgspec.json.encode(topic) + b',"msg":'
    frame = RosbridgeFrame((head, codec.json(payload), b"}"))
    return encode_png(frame.data) if compression is Compression.PNG else frame


def encode_cbor(values: Mapping[str, Any]) -> RosbridgeFrame:
    """An op in CBOR."""
    return RosbridgeFrame((cbor2.dumps(values),), binary=True)


def encode_cbor_raw(topic: str, payload: memoryview, stamp_ns: int) -> RosbridgeFrame:
    """A ``publish`` of ROS 1 bytes, which are not copied: ``msg`` is ``{secs, nsecs, bytes}``."""
    secs, nsecs = divmod(max(0, stamp_ns), 1_000_000_000)
    stamp = b"".join((b"\x64secs", _cbor_length(0, secs), b"\x65nsecs", _cbor_length(0, nsecs)))
    head = b"".join((_cbor_raw_head(topic), stamp, b"\x65bytes", _cbor_length(0x40, len(payload))))
    return RosbridgeFrame((head, payload), binary=True)


@lru_cache(limits.SUBSCRIPTIONS_MAX)
def _cbor_raw_head(topic: str) -> bytes:
    """All before the time: it is the same for each message of a topic."""
    # A map of three: the two keys here, and msg.
    return b"\xa3" + cbor2.dumps({"op": "publish", "topic": topic})[1:] + b"\x63msg\xa3"


def _cbor_length(major: int, length: int) -> bytes:
    if length < 24:
        return bytes((major | length,))
    for code, kind, bound in ((24, ">BB", 1 << 8), (25, ">BH", 1 << 16), (26, ">BI", 1 << 32)):
        if length < bound:
            return struct.pack(kind, major | code, length)
    return struct.pack(">BQ", major | 27, length)


# --- PNG ---------------------------------------------------------------------------------------------------------


def encode_png(text: bytes | bytearray | memoryview) -> RosbridgeFrame:
    """An op ``png``: the bytes of another op as the RGB pixels of a picture that is nearly square.

    Newlines, which JSON allows at its end, fill the last line.
    """
    width = max(1, math.isqrt(len(text) // 3))
    row = 3 * width
    height = max(1, -(-len(text) // row))
    padded = bytes(text).ljust(row * height, b"\n")
    pixels = b"".join(b"\x00" + padded[at : at + row] for at in range(0, len(padded), row))
    picture = _SIGNATURE + _chunk(b"IHDR", _IHDR.pack(width, height, 8, 2, 0, 0, 0))
    picture += _chunk(b"IDAT", zlib.compress(pixels, _PNG_LEVEL)) + _chunk(b"IEND", b"")
    return write_op({"op": "png", "data": base64.b64encode(picture).decode()})


def _chunk(kind: bytes, data: bytes) -> bytes:
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))


def decode_png(text: str) -> str:
    """The op in a client's picture: 8 bits, RGB or RGBA or grey, not interlaced.

    Raises:
        OpError: The text is not such a picture, or its pixels are not UTF-8.
        LimitExceeded: Its pixels are too many.
    """
    try:
        raw = base64.b64decode(text, validate=True)
    except (binascii.Error, ValueError):
        raise OpError("the data of a png is base64") from None
    if not raw.startswith(_SIGNATURE):
        raise OpError("the data of a png is no PNG picture")
    header, packed = _chunks(memoryview(raw)[len(_SIGNATURE) :])
    width, height, bits, colour, _, _, interlaced = header
    step = {0: 1, 2: 3, 6: 4}.get(colour)
    if bits != 8 or step is None or interlaced or not width or not height:
        raise OpError("a png has 8 bits a channel in RGB, RGBA or grey, and is not interlaced")
    size = height * (1 + width * step)
    if size > limits.PNG_MAX:
        raise LimitExceeded("picture of a png", size, limits.PNG_MAX)
    unpacker = zlib.decompressobj()
    try:
        lines = unpacker.decompress(packed, size)
    except zlib.error as error:
        raise OpError(f"the picture of a png cannot be unpacked: {error}") from None
    if len(lines) != size:
        raise OpError(f"the picture of a png has {len(lines)} bytes, not {size}")
    try:
        return _unfilter(lines, width * step, step).decode()
    except UnicodeDecodeError:
        raise OpError("the pixels of a png are not UTF-8") from None


def _chunks(raw: memoryview) -> tuple[tuple[int, ...], bytes]:
    header: tuple[int, ...] | None = None
    packed = bytearray()
    while len(raw) >= 12:
        length, kind = _CHUNK.unpack_from(raw)
        if length > len(raw) - 12:
            break
        data = raw[8 : 8 + length]
        if kind == b"IHDR" and length == _IHDR.size:
            header = _IHDR.unpack(data)
        elif kind == b"IDAT":
            packed += data
        raw = raw[12 + length :]
        if kind == b"IEND" and header is not None:
            return header, bytes(packed)
    raise OpError("the picture of a png ends too early")


def _unfilter(lines: bytes, row: int, step: int) -> bytearray:
    out = bytearray()
    above = bytearray(row)
    for at in range(0, len(lines), row + 1):
        line = bytearray(lines[at + 1 : at + 1 + row])
        kind = lines[at]
        if kind > 4:
            raise OpError(f"the picture of a png has a line with the unknown filter {kind}")
        if kind:
            _undo(kind, line, above, step)
        out += line
        above = line
    return out


def _undo(kind: int, line: bytearray, above: bytearray, step: int) -> None:
    """Undo the filter of one line (PNG, section 9): 1 left, 2 above, 3 their mean, 4 Paeth."""
    for index in range(len(line)):
        left = line[index - step] if index >= step else 0
        up = above[index]
        if kind == 1:
            guess = left
        elif kind == 2:
            guess = up
        elif kind == 3:
            guess = (left + up) // 2
        else:
            guess = _paeth(left, up, above[index - step] if index >= step else 0)
        line[index] = (line[index] + guess) & 0xFF


def _paeth(left: int, up: int, corner: int) -> int:
    sides = abs(up - corner), abs(left - corner), abs(left + up - 2 * corner)
    nearest = min(sides)
    return left if sides[0] == nearest else up if sides[1] == nearest else corner
