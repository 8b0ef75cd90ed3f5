"""Live messages as a page shows them: values cut to a size, numbers by a path, scans and images thinned."""

from __future__ import annotations

import math
import re
import struct
from array import array
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

from rmpa.core.errors import RemoteProtocolError
from rmpa.web.monitor import limits

if TYPE_CHECKING:
    from collections.abc import Mapping

    from rmpa.web.hub.requests import Payload

IMAGE_HEADER: Final = struct.Struct("<BBHHHIQ")
"""Kind 1, format, width, height, spare, watch, nanoseconds since the epoch (UTC): in front of an image's bytes."""
IMAGE: Final = 1
FORMATS: Final = {"jpeg": 1, "png": 2, "rgb8": 3, "mono8": 4}
"""Formats of an image's bytes; rgb8 and mono8 are rows of pixels without padding."""
_CHANNELS: Final = {"rgb8": 3, "bgr8": 3, "rgba8": 4, "bgra8": 4, "mono8": 1, "8UC1": 1, "8UC3": 3}
_DEPTHS: Final = {"16UC1": ("H", 2), "mono16": ("H", 2), "32FC1": ("f", 4)}
"""Encodings of one channel, with the letter and bytes of its values; little-endian, as ROS machines are."""
_EXACT: Final = 2**53
"""The largest integer that a browser's numbers hold exactly; a larger one is sent as text."""
_INDEX: Final = re.compile(r"\[(\d+)\]")


def cut(value: Any) -> Any:
    """A message's values, bounded: long strings and arrays are cut, and ``"… 512 more"`` says so."""
    return _cut(value, [limits.VALUE_NODES])


def _cut(value: Any, left: list[int]) -> Any:
    left[0] -= 1
    if left[0] < 0:
        return "…"
    if isinstance(value, dict):
        return {str(key): _cut(inner, left) for key, inner in value.items()}
    if isinstance(value, str):
        most = limits.VALUE_CHARACTERS
        return value if len(value) <= most else f"{value[:most]}… {len(value) - most} more"
    if isinstance(value, bytes | bytearray | memoryview):
        return f"{len(value)} bytes"
    if isinstance(value, float):
        return value if math.isfinite(value) else str(value)
    if isinstance(value, int) and abs(value) > _EXACT:
        return str(value)
    if value is None or isinstance(value, bool | int):
        return value
    if not hasattr(value, "__len__"):
        return str(value)
    shown = [_cut(inner, left) for inner in value[: limits.VALUE_ITEMS]]
    if len(value) > limits.VALUE_ITEMS:
        shown.append(f"… {len(value) - limits.VALUE_ITEMS} more")
    return shown


def field_path(text: str) -> tuple[str, ...]:
    """The steps of a path: ``ranges[3]`` and ``ranges.3`` are the same.

    Raises:
        RemoteProtocolError: It is no path.
    """
    path = tuple(_INDEX.sub(r".\1", text).split("."))
    if not text or len(text) > limits.FIELD_CHARACTERS or not all(path):
        raise RemoteProtocolError(f"not a field's path: {text[:80]!a}")
    return path


def number_at(values: Any, path: tuple[str, ...]) -> float | None:
    """The number at a path of a message's values; ``None`` where there is none. Stamps are in seconds."""
    for step in path:
        if isinstance(values, dict):
            values = values.get(step)
        elif step.isascii() and step.isdecimal() and hasattr(values, "__len__") and not isinstance(values, str):
            values = values[int(step)] if int(step) < len(values) else None
        else:
            return None
    if isinstance(values, dict) and values.keys() == {"secs", "nsecs"}:
        return float(values["secs"]) + float(values["nsecs"]) * 1e-9
    return float(values) if isinstance(values, bool | int | float) else None


def scan(values: Mapping[str, Any]) -> dict[str, Any]:
    """A sensor_msgs/LaserScan for drawing: angles in radians, ranges in metres, rounded to millimetres.

    A range that is not finite, or outside of the sensor's limits, is null.

    Raises:
        RemoteProtocolError: It is no laser scan.
    """
    try:
        low, high = float(values["range_min"]), float(values["range_max"])
        ranges = [_range(each, low, high) for each in values["ranges"]]
        start, step = float(values["angle_min"]), float(values["angle_increment"])
    except (KeyError, TypeError, ValueError):
        raise RemoteProtocolError("not a sensor_msgs/LaserScan") from None
    every = max(1, -(-len(ranges) // limits.SCAN_POINTS))
    if every > 1:
        parts = (ranges[at : at + every] for at in range(0, len(ranges), every))
        ranges = [min((each for each in part if each is not None), default=None) for part in parts]
    return {"start": start, "step": step * every, "most": high, "ranges": ranges}


def _range(value: Any, low: float, high: float) -> float | None:
    return round(float(value), 3) if value is not None and low <= value <= high else None


@dataclass(frozen=True, slots=True)
class Picture:
    """An image for a browser: its size in pixels, the format of ``data``; of its rows and columns, each ``every``-th.

    Width and height are 0 for a compressed one, which says them itself.
    """

    format: str
    width: int
    height: int
    data: Payload
    every: int = 1

    def frame(self, watch: int, stamp_ns: int) -> bytes:
        """The binary frame."""
        head = IMAGE_HEADER.pack(IMAGE, FORMATS[self.format], self.width, self.height, 0, watch, stamp_ns)
        return head + self.data


def compressed_picture(format_: str, data: Payload) -> Picture:
    """Of a sensor_msgs/CompressedImage. The bytes say what they are; ``format`` is free text in ROS 1.

    Raises:
        RemoteProtocolError: It is neither JPEG nor PNG.
    """
    start = bytes(data[:8])
    if start.startswith(b"\xff\xd8\xff"):
        return Picture("jpeg", 0, 0, data)
    if start == b"\x89PNG\r\n\x1a\n":
        return Picture("png", 0, 0, data)
    raise RemoteProtocolError(f"an image of the format {format_[:40]!a} is neither JPEG nor PNG")


def raw_picture(width: int, height: int, encoding: str, step: int, data: Payload) -> Picture:
    """Of a sensor_msgs/Image; of a large one every n-th row and column.

    Raises:
        RemoteProtocolError: The encoding cannot be shown, or the sizes do not fit together.
    """
    if encoding in _DEPTHS:
        return _depth_picture(width, height, encoding, step, data)
    channels = _CHANNELS.get(encoding)
    if channels is None:
        shown = ", ".join((*_CHANNELS, *_DEPTHS))
        raise RemoteProtocolError(f"images of the encoding {encoding[:40]!a} are not shown; these are: {shown}")
    if width <= 0 or height <= 0 or step < width * channels or len(data) < step * (height - 1) + width * channels:
        raise RemoteProtocolError(f"{len(data)} bytes are no image of {width} x {height} {encoding}")
    every = max(1, math.ceil(math.sqrt(width * height / limits.IMAGE_PIXELS)))
    source = memoryview(data)
    columns = -(-width // every)
    rows = range(0, height, every)
    if channels == 1:
        pixels = b"".join(bytes(source[row * step : row * step + width : every]) for row in rows)
        return Picture("mono8", columns, len(rows), pixels, every)
    order = (2, 1, 0) if encoding.startswith("bgr") else (0, 1, 2)
    out = bytearray(columns * len(rows) * 3)
    for at, row in enumerate(rows):
        line = source[row * step : row * step + width * channels]
        for colour, channel in enumerate(order):
            out[at * columns * 3 + colour : (at + 1) * columns * 3 : 3] = bytes(line[channel :: channels * every])
    return Picture("rgb8", columns, len(rows), bytes(out), every)


def _depth_picture(width: int, height: int, encoding: str, step: int, data: Payload) -> Picture:
    """Of one channel of 16 or 32 bits, as depth cameras have it: from black for the least value to white."""
    letter, size = _DEPTHS[encoding]
    if width <= 0 or height <= 0 or step < width * size or len(data) < step * (height - 1) + width * size:
        raise RemoteProtocolError(f"{len(data)} bytes are no image of {width} x {height} {encoding}")
    every = max(1, math.ceil(math.sqrt(width * height / limits.IMAGE_PIXELS)))
    source = memoryview(data).cast("B")
    rows = range(0, height, every)
    values: list[float] = []
    for row in rows:
        line = source[row * step : row * step + width * size]
        values += array(letter, bytes(line))[::every]
    measured = [value for value in values if value > 0 and value < math.inf]  # 0 and NaN: nothing was measured
    least, most = (min(measured), max(measured)) if measured else (0.0, 1.0)
    scale = 254 / (most - least) if most > least else 254.0
    pixels = bytes(1 + int((value - least) * scale) if 0 < value < math.inf else 0 for value in values)
    return Picture("mono8", -(-width // every), len(rows), pixels, every)
