"""Pictures: of ROS's images as browsers take them, and PNG files."""

from __future__ import annotations

import io
import itertools
import math
import struct
import zlib
from array import array
from typing import TYPE_CHECKING, Any, Final, NamedTuple

from rmpa.core.errors import LimitExceeded, RemoteProtocolError, RmpaError
from rmpa.web.monitor import limits

if TYPE_CHECKING:
    from collections.abc import Iterable

    from rmpa.web.hub.node_link import Payload

_CHANNELS: Final = {"rgb8": 3, "bgr8": 3, "rgba8": 4, "bgra8": 4, "mono8": 1, "8UC1": 1, "8UC3": 3}
# Encodings of one channel, with the letter and bytes of its values; little-endian, as ROS machines are.
_DEPTHS: Final = {"16UC1": ("H", 2), "mono16": ("H", 2), "32FC1": ("f", 4)}
_SIGNATURE: Final = b"\x89PNG\r\n\x1a\n"
_IHDR: Final = struct.Struct(">IIBBBBB")
# Bytes in front of the fields of its header: the signature, and the head of the first chunk.
_HEADER: Final = 16
_CHECKSUM: Final = 4
# Of zlib; higher ones take five times as long for a tenth less.
_LEVEL: Final = 1


class Picture(NamedTuple):
    """An image for a browser: its size in pixels, the format of ``data``, and the size of the image it was made of.

    All sizes are 0 for a compressed one, which says them itself.
    """

    format: str
    width: int
    height: int
    data: Payload
    whole: tuple[int, int] = (0, 0)


def compressed_picture(format_: str, data: Payload) -> Picture:
    """Of a sensor_msgs/CompressedImage. The bytes say what they are; ``format`` is free text in ROS 1.

    Raises:
        RemoteProtocolError: It is neither JPEG nor PNG.
    """
    start = bytes(data[:8])
    if start.startswith(b"\xff\xd8\xff"):
        return Picture("jpeg", 0, 0, data)
    if start == _SIGNATURE:
        return Picture("png", 0, 0, data)
    raise RemoteProtocolError(f"an image of the format {format_[:40]!a} is neither JPEG nor PNG")


def raw_picture(width: int, height: int, encoding: str, step: int, data: Payload, place: int = 0) -> Picture:
    """Of a sensor_msgs/Image; of one that is larger than its place every n-th row and column.

    Args:
        width: Pixels.
        height: Pixels.
        encoding: Of ROS (``sensor_msgs/image_encodings.h``).
        step: Bytes of a row.
        data: The rows.
        place: The device's pixels that the page has for the width; 0: not known.

    Raises:
        RemoteProtocolError: The encoding cannot be shown, or the sizes do not fit together.
    """
    letter, size = _DEPTHS.get(encoding, ("", _CHANNELS.get(encoding, 0)))
    if not size:
        shown = ", ".join((*_CHANNELS, *_DEPTHS))
        raise RemoteProtocolError(f"images of the encoding {encoding[:40]!a} are not shown; these are: {shown}")
    if width <= 0 or height <= 0 or step < width * size or len(data) < step * (height - 1) + width * size:
        raise RemoteProtocolError(f"{len(data)} bytes are no image of {width} x {height} {encoding}")
    every = _every(width, height, place, limits.DEPTH_PIXELS if letter else limits.IMAGE_PIXELS)
    source, columns, rows, whole = memoryview(data).cast("B"), width // every, height // every, (width, height)
    row = columns * every * size  # bytes of a row that are used
    starts = range(every // 2 * step, step * height, every * step)[:rows]
    if letter:
        lines = [array(letter, bytes(source[at : at + row]))[every // 2 :: every] for at in starts]
        return Picture("mono8", columns, rows, _shades(lines), whole)
    used: Payload = (
        source[: row * rows] if row == step and every == 1 else b"".join(source[a : a + row] for a in starts)
    )
    if size == 1:
        return Picture("mono8", columns, rows, used[every // 2 :: every] if every > 1 else used, whole)
    name = "bgr8" if encoding.startswith("bgr") else "rgb8"
    if size == 3 and every == 1:
        return Picture(name, columns, rows, used, whole)
    out = bytearray(columns * rows * 3)
    for channel in range(3):
        out[channel::3] = used[every // 2 * size + channel :: size * every]
    return Picture(name, columns, rows, bytes(out), whole)


def _every(width: int, height: int, place: int, most: int) -> int:
    """Of how many rows and columns one is shown: the width is at most a quarter more than its place."""
    fits = math.ceil(width / (1.25 * place)) if place else 1
    return min(max(1, fits, math.ceil(math.sqrt(width * height / most))), width, height)


def _shades(lines: Iterable[Iterable[float]]) -> bytes:
    """Of one channel of 16 or 32 bits, as depth cameras have it: from black for the least value to white."""
    values = [*itertools.chain.from_iterable(lines)]
    measured = [value for value in values if 0 < value < math.inf]  # 0 and NaN: nothing was measured
    least, most = (min(measured), max(measured)) if measured else (0.0, 1.0)
    scale = 254 / (most - least) if most > least else 254.0
    return bytes(1 + int((value - least) * scale) if 0 < value < math.inf else 0 for value in values)


def pillow() -> Any:
    """The module ``PIL.Image``, which takes 30 ms and 10 MB; of the extra "web".

    Raises:
        RmpaError: It is missing.
    """
    try:
        from PIL import Image  # noqa: PLC0415 - as it says
    except ImportError:
        raise RmpaError("raw images need Pillow, which is missing; pip install rmpa[web]") from None
    return Image


def png_file(width: int, height: int, colour: int, rows: Iterable[bytes], before: bytes = b"") -> bytes:
    """A PNG of 8 bits a channel (w3.org/TR/png).

    Args:
        width: Pixels.
        height: Pixels.
        colour: Its type: 0: grey; 2: RGB; 3: of a palette.
        rows: From the top; they are packed one by one, so that a thread leaves others their turns.
        before: Chunks in front of the pixels.
    """
    packer = zlib.compressobj(_LEVEL)
    data = b"".join([*(packer.compress(b"\0" + row) for row in rows), packer.flush()])
    head = png_chunk(b"IHDR", _IHDR.pack(width, height, 8, colour, 0, 0, 0))
    return _SIGNATURE + head + before + png_chunk(b"IDAT", data) + png_chunk(b"IEND", b"")


def png_chunk(kind: bytes, data: bytes) -> bytes:
    """One chunk of a PNG."""
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))


def png_pixels(raw: bytes, most: int) -> bytes:
    """The pixels of a client's PNG: 8 bits, RGB or RGBA or grey, not interlaced.

    Args:
        raw: The file.
        most: Bytes of its pixels.

    Raises:
        RemoteProtocolError: It is no such picture.
        LimitExceeded: Its pixels are too many.
    """
    if not raw.startswith(_SIGNATURE):
        raise RemoteProtocolError("the data of a png is no PNG picture")
    if len(raw) < _HEADER + _IHDR.size + _CHECKSUM:
        raise RemoteProtocolError("the picture of a png ends too early")
    width, height, bits, colour, _, _, interlaced = _IHDR.unpack_from(raw, _HEADER)
    channels = {0: 1, 2: 3, 6: 4}.get(colour)
    if bits != 8 or channels is None or interlaced or not width or not height:
        raise RemoteProtocolError("a png has 8 bits a channel in RGB, RGBA or grey, and is not interlaced")
    if width * height * channels > most:
        raise LimitExceeded("picture of a png", width * height * channels, most)
    image = pillow()
    try:
        picture = image.open(io.BytesIO(raw), formats=("PNG",))
        # A second header may say another size.
        pixels: bytes = picture.tobytes() if picture.size == (width, height) else b""
    except Exception:  # noqa: BLE001 - a client's bytes, of which Pillow says in many ways that they are wrong
        pixels = b""
    if not pixels:
        raise RemoteProtocolError("the picture of a png cannot be unpacked")
    return pixels
