"""Messages as layers of a map from above, thinned for a screen; and transforms between frames.

A layer is a binary frame (docs/design/monitor-protocol.md): a head as JSON, then points, or a grid as a PNG. What
takes long is made in a thread: zlib, and slices of rows, leave the event loop its turns.
"""

from __future__ import annotations

import functools
import math
import struct
from array import array
from typing import TYPE_CHECKING, Any, Final

import msgspec

from rmpa.core.errors import RemoteProtocolError
from rmpa.web.monitor import limits
from rmpa.web.monitor.messages import WatchState, scan
from rmpa.web.monitor.state import shown_node
from rmpa.web.pictures import png_chunk, png_file

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Mapping, Sequence

    from rmpa.web.hub.topics import ReceivedMessage
    from rmpa.web.monitor.messages import Decode

# Kind 2, spare, the watch, bytes of the head: in front of the head of a layer.
LAYER_HEADER: Final = struct.Struct("<BxxxII")
LAYER: Final = 2
Made = tuple[dict[str, Any], bytes]


def layer_frame(watch: int, message: ReceivedMessage, values: Any, number: int = 1) -> bytes:
    """The binary frame of a message, which is the ``number``-th of its node.

    Raises:
        RemoteProtocolError: It cannot be drawn; the text says why.
    """
    if message.type not in _LAYERS:
        raise RemoteProtocolError(f"{message.type} is no layer of a map; these are: {', '.join(_LAYERS)}")
    kind, make = _LAYERS[message.type]
    try:
        about, body = make(values)
        header = values.get("header")  # a geometry_msgs/Pose has none
        head = {
            "kind": kind,
            "frame": str(header["frame_id"]).lstrip("/") if header else "",
            "at": message.stamp_ns / 1e9,
            "stamp": _seconds(header["stamp"]) if header else 0.0,
            "source": shown_node(message.source),
            "n": number,
            **about,
        }
    except (KeyError, TypeError, ValueError, IndexError, struct.error):
        raise RemoteProtocolError(f"a message of {message.type} contradicts itself: its sizes do not fit") from None
    raw = msgspec.json.encode(head)
    return LAYER_HEADER.pack(LAYER, watch, len(raw)) + raw + body


def _seconds(stamp: Mapping[str, int]) -> float:
    return stamp["secs"] + stamp["nsecs"] * 1e-9


def _pose(pose: Any) -> list[float]:
    """Position x, y, z in metres, and the quaternion x, y, z, w."""
    position, turn = pose["position"], pose["orientation"]
    numbers = [float(value) for value in (*(position[name] for name in "xyz"), *(turn[name] for name in "xyzw"))]
    if not all(map(math.isfinite, numbers)):
        raise RemoteProtocolError("a pose has NaN or infinity in it")
    return numbers


def _one_pose(path: Sequence[str]) -> Callable[[Any], Made]:
    """Of a message with a pose at a path; its covariance where it has one."""

    def make(values: Any) -> Made:
        for step in path:
            values = values[step]
        around = values["pose"] if "covariance" in values else values
        about: dict[str, Any] = {"pose": _pose(around)}
        if "covariance" in values:
            matrix = values["covariance"]
            spread = [float(matrix[at]) for at in (0, 1, 7)]  # xx, xy, yy of 6 by 6
            about["spread"] = spread if all(map(math.isfinite, spread)) and spread[0] + spread[2] > 0 else None
        return about, b""

    return make


def _thinned(items: Sequence[Any], most: int) -> tuple[Sequence[Any], int]:
    every = max(1, -(-len(items) // most))
    return items[::every], every


def _path(values: Any) -> Made:
    poses, every = _thinned(values["poses"], limits.PATH_POINTS)
    positions = [pose["pose"]["position"] for pose in poses]
    if every > 1:
        positions.append(values["poses"][-1]["pose"]["position"])  # the goal
    flat = array("f", (number for at in positions for number in (at["x"], at["y"], at["z"])))
    return {"count": len(values["poses"]), "every": every}, flat.tobytes()


def _poses(values: Any) -> Made:
    poses, every = _thinned(values["poses"], limits.PATH_POINTS)
    flat = array("f")
    for pose in poses:
        turn = pose["orientation"]
        yaw = math.atan2(
            2 * (turn["w"] * turn["z"] + turn["x"] * turn["y"]), 1 - 2 * (turn["y"] ** 2 + turn["z"] ** 2)
        )
        flat.extend((pose["position"]["x"], pose["position"]["y"], yaw))
    return {"count": len(values["poses"]), "every": every}, flat.tobytes()


# Formats of the datatypes of a sensor_msgs/PointField that coordinates have: FLOAT32 and FLOAT64.
_COORDINATES: Final = {7: "f", 8: "d"}


def _cloud(values: Any) -> Made:
    """x, y and z of every n-th point, without those that are not finite."""
    fields = {field["name"]: field for field in values["fields"] if field["name"] in ("x", "y", "z")}
    if len(fields) < 3 or any(field["datatype"] not in _COORDINATES for field in fields.values()):
        raise RemoteProtocolError("a cloud without x, y and z as float32 or float64 is not drawn")
    step, row, width = values["point_step"], values["row_step"], values["width"]
    total = width * values["height"]
    readers = [
        (field["offset"], struct.Struct((">" if values["is_bigendian"] else "<") + _COORDINATES[field["datatype"]]))
        for field in (fields["x"], fields["y"], fields["z"])
    ]
    if total and (step <= 0 or row < step * width or max(at + one.size for at, one in readers) > step):
        raise ValueError("the points overlap")
    every = max(1, -(-total // limits.CLOUD_POINTS))
    data = memoryview(values["data"])
    flat = array("f")
    (at_x, x_of), (at_y, y_of), (at_z, z_of) = ((at, one.unpack_from) for at, one in readers)
    for number in range(0, total, every):
        at = number // width * row + number % width * step
        (x,), (y,), (z,) = x_of(data, at + at_x), y_of(data, at + at_y), z_of(data, at + at_z)
        if x - x + y - y + z - z == 0:  # neither NaN nor infinite
            flat.extend((x, y, z))
    return {"count": total, "every": every}, flat.tobytes()


# Least occupancy (percent) of each level of a grid, and how opaque each is drawn. Level 0: not known; level 1: free.
_GRADES: Final = (1, 20, 40, 55, 65, 80, 99)
_OPACITY: Final = (0, 26, 48, 78, 110, 145, 180, 215, 255)


# For each byte of a grid (an int8) the level as that many bits: of several cells, *or* is the highest level. So a
# wall of one cell is seen in a thinned grid, and cells are compared thousands at a time.
_LEVELS: Final = bytes(
    (1 << (1 + sum(value >= grade for grade in _GRADES))) - 1 if value <= 100 else 0 for value in range(256)
)


def _grid(values: Any) -> Made:
    """The picture has the first row of the grid, which is the lowest, at its top."""
    info, data = values["info"], memoryview(values["data"]).cast("B")
    width, height, resolution = info["width"], info["height"], float(info["resolution"])
    if not 0 < resolution < math.inf or len(data) != width * height:
        raise ValueError("the cells are not those of the size")
    every = max(1, math.ceil(math.sqrt(width * height / limits.GRID_CELLS)))
    wide, high = -(-width // every), -(-height // every)
    about = {
        "origin": _pose(info["origin"]),
        "resolution": resolution,
        "cells": [width, height],
        "size": [wide, high],
        "every": every,
    }
    return about, _png(wide, high, _rows(data, width, height, every)) if wide * high else b""


def _rows(data: memoryview, width: int, height: int, every: int) -> Iterable[bytes]:
    """Rows of levels; of each square of ``every`` cells the highest."""
    columns = -(-width // every)
    for first in range(0, height, every):
        if every == 1:
            yield bytes(data[first * width : (first + 1) * width]).translate(_LEVELS)
            continue
        together = 0
        for row in range(first, min(first + every, height)):
            line = bytes(data[row * width : (row + 1) * width]).translate(_LEVELS)
            for column in range(every):
                together |= int.from_bytes(line[column::every], "little")
        yield together.to_bytes(columns, "little")


def _png(width: int, height: int, rows: Iterable[bytes]) -> bytes:
    """A PNG of levels, whose palette is black of some opacity: the page gives it the colour of its text."""
    opacity = bytearray(256)
    for level, shade in enumerate(_OPACITY):
        opacity[(1 << level) - 1] = shade
    return png_file(width, height, 3, rows, png_chunk(b"PLTE", bytes(768)) + png_chunk(b"tRNS", bytes(opacity)))


# What each type is on a map, and how it is made of its values.
_LAYERS: Final[dict[str, tuple[str, Callable[[Any], Made]]]] = {
    "sensor_msgs/LaserScan": ("scan", lambda values: (scan(values), b"")),
    "nav_msgs/OccupancyGrid": ("grid", _grid),
    "nav_msgs/Path": ("path", _path),
    "nav_msgs/Odometry": ("pose", _one_pose(("pose",))),
    "geometry_msgs/Pose": ("pose", _one_pose(())),
    "geometry_msgs/PoseStamped": ("pose", _one_pose(("pose",))),
    "geometry_msgs/PoseWithCovarianceStamped": ("pose", _one_pose(("pose",))),
    "geometry_msgs/PoseArray": ("poses", _poses),
    "sensor_msgs/PointCloud2": ("cloud", _cloud),
}


class LayerWatch(WatchState):
    """One watch of a map: the newest message of each publishing node, in turns."""

    def __init__(self, id_: int, rate: float, decode: Decode) -> None:
        super().__init__(id_, "map", (), rate, decode)
        self._waiting: dict[str, ReceivedMessage] = {}
        # Messages of each node that was heard.
        self._sources: dict[str, int] = {}

    def receive(self, message: ReceivedMessage) -> None:
        """Keep a message, in place of an earlier one of its node."""
        if message.source in self._sources or len(self._sources) < limits.LAYER_SOURCES:
            self._sources[message.source] = self._sources.get(message.source, 0) + 1
            self._waiting[message.source] = message
            self.beat.receive(message.stamp_ns * 1e-9, len(message.payload))

    def waits(self) -> bool:
        """Whether there is something to send, and no frame is being made."""
        return bool(self._waiting) and not self.busy

    def frame(self, now: float) -> bytes | dict[str, Any] | Callable[[], bytes]:
        """The frame that is due; of a large message the function that makes it, to be called in a thread.

        Raises:
            RmpaError: The message cannot be drawn.
        """
        self._next = now + 1 / (self._rate * len(self._sources))
        message = self._waiting.pop(next(iter(self._waiting)))
        number = self._sources[message.source]
        make = functools.partial(layer_frame, self._id, message, self._decode(message), number)
        return make() if len(message.payload) <= limits.LAYER_AT_ONCE else make


class FramesWatch(WatchState):
    """One watch of tf: the newest transform of each frame and sender that the page was not sent yet."""

    def __init__(self, id_: int, rate: float, decode: Decode) -> None:
        super().__init__(id_, "tf", (), rate, decode)
        self._counts: dict[tuple[str, str], int] = {}
        self._changed: dict[tuple[str, str], list[Any]] = {}
        self._left_out = 0

    def receive(self, message: ReceivedMessage) -> None:
        """Take the transforms of a tf2_msgs/TFMessage.

        Raises:
            RmpaError: It cannot be decoded, or is none.
        """
        source, is_static = shown_node(message.source), message.topic.endswith("tf_static")
        try:
            for each in self._decode(message)["transforms"]:
                cut = limits.FRAME_CHARACTERS
                child, parent = (
                    name.lstrip("/")[:cut] for name in (each["child_frame_id"], each["header"]["frame_id"])
                )
                key = child, source
                if key not in self._counts and len(self._counts) >= limits.FRAMES_MAX:
                    self._left_out += 1
                    continue
                self._counts[key] = count = self._counts.get(key, 0) + 1
                move, turn = each["transform"]["translation"], each["transform"]["rotation"]
                pose = [move["x"], move["y"], move["z"], turn["x"], turn["y"], turn["z"], turn["w"]]
                # One that is not finite, or has no rotation, is null: the page names its sender.
                usable = all(map(math.isfinite, pose)) and any(pose[3:])
                stamps = _seconds(each["header"]["stamp"]), message.stamp_ns / 1e9
                self._changed[key] = [child, parent, source, is_static, *stamps, count, pose if usable else None]
        except (KeyError, TypeError, AttributeError):
            raise RemoteProtocolError(f"{message.type} has no transforms as a tf2_msgs/TFMessage has") from None

    def waits(self) -> bool:
        """Whether there is something to send."""
        return bool(self._changed)

    def frame(self, now: float) -> dict[str, Any]:
        """What changed: lists of child, parent, sender, static, stamp, receipt, count of messages, pose or null."""
        self._next = now + 1 / self._rate
        changed, self._changed = self._changed, {}
        return {"op": "tf", "id": self._id, "frames": [*changed.values()], "left_out": self._left_out}


def watch_of(id_: int, how: str, fields: Sequence[str], rate: float, decode: Decode, place: int = 0) -> WatchState:
    """The watch for one way to show a topic."""
    if how == "map":
        return LayerWatch(id_, rate, decode)
    return FramesWatch(id_, rate, decode) if how == "tf" else WatchState(id_, how, fields, rate, decode, place)
