"""What pages are sent: states, their changes as JSON merge patches (RFC 7396), and live messages as they are shown.

The format is that of docs/design/monitor-protocol.md. A state is a tree of JSON values whose objects have no member
that is null: there a missing member says "not known". So a null in a patch always removes. Arrays are replaced as a
whole. Of live messages values are cut to a size, numbers found by a path, scans and images thinned; all are paced.
"""

from __future__ import annotations

import math
import re
import struct
import time
from collections import deque
from typing import TYPE_CHECKING, Any, Final, TypeAlias, Union

import msgspec

from rmpa.core.errors import RemoteProtocolError
from rmpa.web.monitor import limits
from rmpa.web.pictures import Picture, compressed_picture, raw_picture

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from rmpa.web.hub.topics import ClientSubscription, ReceivedMessage

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


# Kind 1, format, width, height, spare, watch, nanoseconds since the epoch (UTC), width and height of the whole image:
# in front of an image's bytes.
IMAGE_HEADER: Final = struct.Struct("<BBHHHIQHH")
IMAGE: Final = 1
# Formats of an image's bytes; rgb8, bgr8 and mono8 are rows of pixels without padding.
FORMATS: Final = {"jpeg": 1, "png": 2, "rgb8": 3, "mono8": 4, "bgr8": 5}
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


def image_frame(picture: Picture, watch: int, stamp_ns: int) -> bytes:
    """The binary frame of an image."""
    size = picture.width, picture.height
    whole = (min(each, 0xFFFF) for each in picture.whole)
    return IMAGE_HEADER.pack(IMAGE, FORMATS[picture.format], *size, 0, watch, stamp_ns, *whole) + picture.data


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


def old_after(period: float) -> float:
    """Seconds without a message after which what came last is old: some of its own periods, and 2 s at the least.

    The one rule for all that pages show as live, routes included.
    """
    return max(limits.OLD_AFTER, limits.OLD_PERIODS * period)


class Beat:
    """The rate of what comes, by the last messages: what a page is told so that it can tell when they stop."""

    def __init__(self) -> None:
        self._came: deque[tuple[float, int]] = deque(maxlen=limits.BEAT_MESSAGES)
        self._told: dict[str, float] = {}

    def receive(self, at: float, size: int) -> None:
        """A message of ``size`` bytes has come."""
        self._came.append((at, size))

    def news(self) -> dict[str, float] | None:
        """``rate``, ``bandwidth`` and ``after`` (``old_after``), or ``None`` if they are what was told."""
        span = self._came[-1][0] - self._came[0][0] if len(self._came) > 1 else 0.0
        if span <= 0:
            return None
        rate = (len(self._came) - 1) / span
        told = self._told.get("rate", 0.0)
        if abs(rate - told) <= limits.BEAT_CHANGE * told:
            return None
        size = sum(size for _, size in self._came) / len(self._came)
        self._told = {"rate": float(f"{rate:.3g}"), "bandwidth": round(rate * size), "after": old_after(1 / rate)}
        return self._told


class WatchState:
    """One watch: the newest message, or samples of its fields, until the next frame is due.

    Args:
        id_: Of the watch.
        how: ``value``, ``plot`` or ``image``.
        fields: The lines of a plot.
        rate: Frames a second.
        decode: Gives a message's values: dicts, lists, numbers, strings; bytes for arrays of bytes.
        place: The pixels that the page has for an image's width. It tells each image that it has drawn (``seen``).
    """

    # More than 12 fields: four pace the frames, and the others are the watch's arguments.
    def __init__(
        self, id_: int, how: str, fields: Sequence[str], rate: float, decode: Decode, place: int = 0
    ) -> None:
        self._id = id_
        self._how = how
        self._rate = rate
        self._decode = decode
        self._place = place
        self._newest: ReceivedMessage | None = None
        self._paths = tuple(field_path(field) for field in fields)
        self._samples = SampleBuffer(len(self._paths))
        self._next = -1e9
        # Images that the page has not drawn yet.
        self._unseen = 0
        # The rate of what comes.
        self.beat = Beat()
        # Whether a frame is being made in a thread.
        self.busy = False
        # ``None`` while there is none yet, or it was refused.
        self.subscription: ClientSubscription | None = None

    def receive(self, message: ReceivedMessage) -> None:
        """Keep a message; a plot takes its numbers at once, all others decode only what is sent.

        Raises:
            RmpaError: It cannot be decoded.
        """
        self._newest = message
        self.beat.receive(message.stamp_ns * 1e-9, len(message.payload))
        if self._paths:
            values = self._decode(message)
            self._samples.add(message.stamp_ns * 1e-9, [number_at(values, path) for path in self._paths])

    def seen(self) -> None:
        """The page has drawn an image."""
        self._unseen = max(0, self._unseen - 1)

    def waits(self) -> bool:
        """Whether there is something to send, and the page is not behind."""
        waiting = len(self._samples) > 0 if self._paths else self._newest is not None
        return waiting and self._unseen < limits.UNSEEN_MAX

    def due(self, now: float) -> float | None:
        """When the next frame may be sent; ``None`` while there is nothing to send, or the page is behind."""
        return max(now, self._next) if self.waits() else None

    def frame(self, now: float) -> bytes | dict[str, Any] | Callable[[], bytes]:
        """The picture or message that is due.

        Raises:
            RmpaError: The message cannot be shown in that way; the text says why.
        """
        message, self._newest, self._next = self._newest, None, now + 1 / self._rate
        if self._paths or message is None:
            return {"op": "points", "id": self._id, "columns": self._samples.take()}
        began = time.thread_time()
        values = self._decode(message)
        about = {"id": self._id, "stamp": message.stamp_ns / 1e9, "type": message.type}
        if self._how == "image":
            self._unseen += self._place > 0
            frame = image_frame(_picture(message, values, self._place), self._id, message.stamp_ns)
            # However large it is, pictures take a bounded share of the processor.
            self._next = now + max(1 / self._rate, (time.thread_time() - began) * limits.PICTURE_SHARE)
            return frame
        return {"op": "value", **about, "size": len(message.payload), "value": cut(values)}


def _picture(message: ReceivedMessage, values: Any, place: int) -> Picture:
    try:
        if message.type == "sensor_msgs/CompressedImage":
            return compressed_picture(str(values["format"]), values["data"])
        if message.type == "sensor_msgs/Image":
            width, height, step = (int(values[name]) for name in ("width", "height", "step"))
            return raw_picture(width, height, str(values["encoding"]), step, values["data"], place)
    except (KeyError, TypeError, ValueError):
        pass
    raise RemoteProtocolError(f"{message.type} is not an image")
