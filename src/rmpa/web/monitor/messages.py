"""What pages are sent: states, their changes as JSON merge patches (RFC 7396), and live messages as they are shown.

The format is that of docs/design/monitor-protocol.md. A state is a tree of JSON values whose objects have no member
that is null: there a missing member says "not known". So a null in a patch always removes. Arrays are replaced as a
whole. Of live messages values are cut to a size, numbers found by a path, scans and images thinned; all are paced.
"""

from __future__ import annotations

import itertools
import math
import re
import struct
from array import array
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final, TypeAlias, Union

import msgspec

from rmpa.core.errors import RemoteProtocolError
from rmpa.web.monitor import limits

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Mapping, Sequence

    from rmpa.web.hub.node_link import Payload
    from rmpa.web.hub.topics import ReceivedMessage

    Decode = Callable[[ReceivedMessage], Any]  # the values of a message, decoded at most once for all clients

Value: TypeAlias = Union[  # noqa: UP007 - | does not take the forward references of a recursive type
    bool, int, float, str, list["Value"], dict[str, "Value"], None
]
Tree: TypeAlias = dict[str, Value]
VERSION: Final = 1
# The WebSocket subprotocol; a version that older pages cannot read has another one.
SUBPROTOCOL: Final = "rmpa.monitor.v1"


def difference(old: Mapping[str, Value], new: Mapping[str, Value]) -> Tree:
    """The merge patch that makes ``new`` of ``old``; empty where they are equal.

    Parts that are the same object in both cost nothing. ``1``, ``1.0`` and ``True`` are different values.
    """
    patch: Tree = {key: None for key in old if key not in new}
    for key, value in new.items():
        before = old.get(key)
        if before is value:
            continue
        if isinstance(value, dict) and isinstance(before, dict):
            if inner := difference(before, value):
                patch[key] = inner
        elif before != value or msgspec.json.encode(before) != msgspec.json.encode(value):
            patch[key] = value
    return patch


def without_nulls(value: object) -> Value:
    """A value for a state: without members that are null, arrays as lists, NaN and infinities left out as unknown.

    In an array, what is unknown stays, as null.
    """
    if isinstance(value, dict):
        members = ((str(key), without_nulls(inner)) for key, inner in value.items())
        return {key: inner for key, inner in members if inner is not None}
    if isinstance(value, list | tuple):
        return [without_nulls(inner) for inner in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value if value is None or isinstance(value, bool | int | float | str) else str(value)


# Kind 1, format, width, height, spare, watch, nanoseconds since the epoch (UTC): in front of an image's bytes.
IMAGE_HEADER: Final = struct.Struct("<BBHHHIQ")
IMAGE: Final = 1
# Formats of an image's bytes; rgb8 and mono8 are rows of pixels without padding.
FORMATS: Final = {"jpeg": 1, "png": 2, "rgb8": 3, "mono8": 4}
_CHANNELS: Final = {"rgb8": 3, "bgr8": 3, "rgba8": 4, "bgra8": 4, "mono8": 1, "8UC1": 1, "8UC3": 3}
# Encodings of one channel, with the letter and bytes of its values; little-endian, as ROS machines are.
_DEPTHS: Final = {"16UC1": ("H", 2), "mono16": ("H", 2), "32FC1": ("f", 4)}
# The largest integer that a browser's numbers hold exactly; a larger one is sent as text.
_EXACT: Final = 2**53
_INDEX: Final = re.compile(r"\[(\d+)\]")


def cut(value: Any) -> Any:
    """A message's values, bounded: a long string ends with ``"… 512 more"``.

    A long array is an object of its first elements and its length: ``{"…": 1000000, "first": [0, 1]}``.
    """
    return _cut(value, [limits.VALUE_NODES])


def cut_text(text: str, most: int) -> str:
    """The first characters of a text, and how many more there are."""
    return text if len(text) <= most else f"{text[:most]}… {len(text) - most} more"


def _cut(value: Any, left: list[int]) -> Any:
    left[0] -= 1
    if left[0] < 0:
        return "…"
    if isinstance(value, dict):
        return {str(key): _cut(inner, left) for key, inner in value.items()}
    if isinstance(value, str):
        return cut_text(value, limits.VALUE_CHARACTERS)
    if isinstance(value, bytes | bytearray) or (isinstance(value, memoryview) and value.format == "B"):
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
    return {"…": len(value), "first": shown} if len(value) > limits.VALUE_ITEMS else shown


def field_path(text: str) -> tuple[str, ...]:
    """The steps of a path: ``ranges[3]`` and ``ranges.3`` are the same.

    Raises:
        RemoteProtocolError: It is no path.
    """
    path = tuple(_INDEX.sub(r".\1", text).split("."))
    if not text or len(text) > 256 or not all(path):
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
    letter, size = _DEPTHS.get(encoding, ("", _CHANNELS.get(encoding, 0)))
    if not size:
        shown = ", ".join((*_CHANNELS, *_DEPTHS))
        raise RemoteProtocolError(f"images of the encoding {encoding[:40]!a} are not shown; these are: {shown}")
    if width <= 0 or height <= 0 or step < width * size or len(data) < step * (height - 1) + width * size:
        raise RemoteProtocolError(f"{len(data)} bytes are no image of {width} x {height} {encoding}")
    every = max(1, math.ceil(math.sqrt(width * height / limits.IMAGE_PIXELS)))
    source = memoryview(data).cast("B")
    lines = [bytes(source[row * step : row * step + width * size]) for row in range(0, height, every)]
    columns = -(-width // every)
    if letter:
        return Picture("mono8", columns, len(lines), _shades([array(letter, line)[::every] for line in lines]), every)
    if size == 1:
        return Picture("mono8", columns, len(lines), b"".join(line[::every] for line in lines), every)
    out = bytearray(columns * len(lines) * 3)
    for at, line in enumerate(lines):
        for colour, channel in enumerate((2, 1, 0) if encoding.startswith("bgr") else (0, 1, 2)):
            out[at * columns * 3 + colour : (at + 1) * columns * 3 : 3] = line[channel :: size * every]
    return Picture("rgb8", columns, len(lines), bytes(out), every)


def _shades(lines: Iterable[Iterable[float]]) -> bytes:
    """Of one channel of 16 or 32 bits, as depth cameras have it: from black for the least value to white."""
    values = [*itertools.chain.from_iterable(lines)]
    measured = [value for value in values if 0 < value < math.inf]  # 0 and NaN: nothing was measured
    least, most = (min(measured), max(measured)) if measured else (0.0, 1.0)
    scale = 254 / (most - least) if most > least else 254.0
    return bytes(1 + int((value - least) * scale) if 0 < value < math.inf else 0 for value in values)


# A moment in seconds since the epoch, and a value for each line; ``None`` where there is none.
Sample: TypeAlias = tuple[float, list[float | None]]


class SampleBuffer:
    """Keeps samples until they are taken.

    Of more than ``most`` samples, each pair of neighbours becomes one or two: for each line the least and the
    greatest value stay, at the moments of the pair. So a peak of one message is still seen.

    Args:
        lines: The number of values of a sample.
        most: Samples that are kept; even.
    """

    def __init__(self, lines: int, most: int = limits.POINTS_MAX) -> None:
        self._lines = lines
        self._most = most
        self._samples: list[Sample] = []

    def __len__(self) -> int:
        return len(self._samples)

    def add(self, moment: float, values: Sequence[float | None]) -> None:
        """Add a sample; NaN and infinities count as no value."""
        clean = [value if value is not None and math.isfinite(value) else None for value in values[: self._lines]]
        self._samples.append((moment, clean))
        if len(self._samples) > 2 * self._most:
            self._samples = self._thinned()

    def take(self) -> list[list[float | None]]:
        """Columns: the moments, then the values of each line; the buffer is empty then."""
        while len(self._samples) > self._most:
            self._samples = self._thinned()
        samples, self._samples = self._samples, []
        if not samples:
            return []
        moments: list[float | None] = [round(moment, 4) for moment, _ in samples]
        return [moments, *([values[line] for _, values in samples] for line in range(self._lines))]

    def _thinned(self) -> list[Sample]:
        """Half as many samples: of each four neighbours the extremes of each line, at the first and last moment."""
        made: list[Sample] = []
        for start in range(0, len(self._samples), 4):
            part = self._samples[start : start + 4]
            if len(part) < 3:
                made += part
                continue
            first: list[float | None] = []
            last: list[float | None] = []
            for line in range(self._lines):
                known = [(values[line], at) for at, (_, values) in enumerate(part) if values[line] is not None]
                least = min(known, default=(None, 0), key=lambda pair: pair[0] or 0.0)
                most = max(known, default=(None, 0), key=lambda pair: pair[0] or 0.0)
                early, late = (least, most) if least[1] <= most[1] else (most, least)
                first.append(early[0])
                last.append(late[0])
            made += [(part[0][0], first), (part[-1][0], last)]
        return made


class WatchState:
    """One watch: the newest message, or samples of its fields, until the next frame is due.

    Args:
        id_: Of the watch.
        how: ``value``, ``plot``, ``image`` or ``scan``.
        fields: The lines of a plot.
        rate: Frames a second.
        decode: Gives a message's values: dicts, lists, numbers, strings; bytes for arrays of bytes.
    """

    def __init__(self, id_: int, how: str, fields: Sequence[str], rate: float, decode: Decode) -> None:
        self._id = id_
        self._how = how
        self._rate = rate
        self._decode = decode
        self._newest: ReceivedMessage | None = None
        self._paths = tuple(field_path(field) for field in fields)
        self._samples = SampleBuffer(len(self._paths))
        self._sent = -1e9
        # Whether a frame is being made in a thread.
        self.busy = False

    def receive(self, message: ReceivedMessage) -> None:
        """Keep a message; a plot takes its numbers at once, all others decode only what is sent.

        Raises:
            RmpaError: It cannot be decoded.
        """
        self._newest = message
        if self._paths:
            values = self._decode(message)
            self._samples.add(message.stamp_ns * 1e-9, [number_at(values, path) for path in self._paths])

    def due(self, now: float) -> float | None:
        """When the next frame may be sent; ``None`` while there is nothing to send."""
        waiting = len(self._samples) > 0 if self._paths else self._newest is not None
        return max(now, self._sent + 1 / self._rate) if waiting else None

    def frame(self, now: float) -> bytes | dict[str, Any] | Callable[[], bytes]:
        """The picture or message that is due.

        Raises:
            RmpaError: The message cannot be shown in that way; the text says why.
        """
        message, self._newest, self._sent = self._newest, None, now
        if self._paths or message is None:
            return {"op": "points", "id": self._id, "columns": self._samples.take()}
        values = self._decode(message)
        about = {"id": self._id, "stamp": message.stamp_ns / 1e9, "type": message.type}
        if self._how == "image":
            return _picture(message, values).frame(self._id, message.stamp_ns)
        if self._how == "scan":
            return {"op": "scan", **about, "scan": scan(values)}
        return {"op": "value", **about, "size": len(message.payload), "value": cut(values)}


def _picture(message: ReceivedMessage, values: Any) -> Picture:
    try:
        if message.type == "sensor_msgs/CompressedImage":
            return compressed_picture(str(values["format"]), values["data"])
        if message.type == "sensor_msgs/Image":
            width, height, step = (int(values[name]) for name in ("width", "height", "step"))
            return raw_picture(width, height, str(values["encoding"]), step, values["data"])
    except (KeyError, TypeError, ValueError):
        pass
    raise RemoteProtocolError(f"{message.type} is not an image")
