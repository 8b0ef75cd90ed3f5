"""Layers of a map as pages get them: what is drawn of each message, what is thinned, and what is refused."""

from __future__ import annotations

import array
import json
import math
import struct
import zlib
from typing import Any

import pytest

from rmpa.core.errors import RmpaError
from rmpa.ros.types.codec import codec_for
from rmpa.ros.types.messages import MessageType
from rmpa.web.hub.topics import ReceivedMessage
from rmpa.web.monitor import limits
from rmpa.web.monitor.layers import LAYER_HEADER, FramesWatch, LayerWatch, layer_frame

HEADER = {"frame_id": "/laser", "stamp": {"secs": 5, "nsecs": 500_000_000}}
SOURCE = "/rmpa/base/driver"
UNKNOWN, FREE, WALL = 0, 26, 255


def message(kind: str, values: dict[str, Any], source: str = SOURCE, topic: str = "/x") -> ReceivedMessage:
    fields = {key: value for key, value in {"header": HEADER, **values}.items() if value is not None}
    payload = codec_for(MessageType(kind)).write(fields, 0).payload
    return ReceivedMessage(topic, kind, memoryview(payload), 7_000_000_000, source)


def decode(received: ReceivedMessage) -> Any:
    return codec_for(MessageType(received.type)).views(received.payload)


def read(frame: bytes) -> tuple[dict[str, Any], bytes]:
    kind, _, size = LAYER_HEADER.unpack_from(frame)
    assert kind == 2
    return json.loads(frame[12 : 12 + size]), frame[12 + size :]


def layer(kind: str, **values: Any) -> tuple[dict[str, Any], bytes]:
    received = message(kind, values)
    return read(layer_frame(3, received, decode(received)))


def floats(body: bytes) -> list[float]:
    return array.array("f", body).tolist()


def pose(x: float, y: float = 0.0, w: float = 1.0) -> dict[str, Any]:
    return {"position": {"x": x, "y": y, "z": 0.5}, "orientation": {"w": w}}


def opacities(png: bytes) -> list[list[int]]:
    """The rows of a picture with a palette and without filters."""
    assert png[:8] == b"\x89PNG\r\n\x1a\n"
    at, found = 8, {}
    while at < len(png):
        (size,) = struct.unpack_from(">I", png, at)
        name, data = png[at + 4 : at + 8], png[at + 8 : at + 8 + size]
        assert struct.unpack_from(">I", png, at + 8 + size) == (zlib.crc32(name + data),)
        found[name] = data
        at += size + 12
    width, height = struct.unpack_from(">II", found[b"IHDR"])
    raw = zlib.decompress(found[b"IDAT"])
    rows = [raw[row * (width + 1) : (row + 1) * (width + 1)] for row in range(height)]
    assert all(row[0] == 0 for row in rows)
    return [[found[b"tRNS"][level] for level in row[1:]] for row in rows]


def grid(width: int, height: int, cells: list[int]) -> tuple[dict[str, Any], bytes]:
    info = {"width": width, "height": height, "resolution": 0.5, "origin": pose(-1)}
    received = message("nav_msgs/OccupancyGrid", {"info": info, "data": cells})
    return read(layer_frame(3, received, decode(received)))


def test_a_layer_says_its_frame_its_times_and_who_sends_it() -> None:
    head, body = layer("geometry_msgs/PoseStamped", pose=pose(1, 2))
    assert head == {
        "kind": "pose", "frame": "laser", "at": 7.0, "stamp": 5.5, "source": "base:/driver", "n": 1,
        "pose": [1.0, 2.0, 0.5, 0.0, 0.0, 0.0, 1.0],
    }  # fmt: skip
    assert body == b""


def test_a_pose_without_a_header_has_no_frame() -> None:
    head, _ = layer("geometry_msgs/Pose", header=None, **pose(1, 2))
    assert (head["frame"], head["stamp"], head["pose"][:2]) == ("", 0.0, [1.0, 2.0])


def test_odometry_has_its_spread_from_above() -> None:
    covariance = [float(at) for at in range(36)]
    head, _ = layer("nav_msgs/Odometry", pose={"pose": pose(1), "covariance": covariance})
    assert head["spread"] == [0, 1, 7]
    assert layer("nav_msgs/Odometry", pose={"pose": pose(1)})[0]["spread"] is None


def test_a_long_path_is_thinned_and_keeps_its_goal() -> None:
    count = 2 * limits.PATH_POINTS
    head, body = layer("nav_msgs/Path", poses=[{"pose": pose(at)} for at in range(count)])
    assert (head["count"], head["every"], len(body)) == (count, 2, (limits.PATH_POINTS + 1) * 12)
    assert floats(body)[:6] == [0, 0, 0.5, 2, 0, 0.5]
    assert floats(body)[-3] == count - 1
    assert layer("nav_msgs/Path", poses=[])[1] == b""


def test_poses_have_their_heading() -> None:
    left = {"position": {"x": 1.0}, "orientation": {"z": math.sqrt(0.5), "w": math.sqrt(0.5)}}
    _, body = layer("geometry_msgs/PoseArray", poses=[left])
    assert floats(body) == pytest.approx([1, 0, math.pi / 2])


@pytest.mark.parametrize("order", ["<", ">"])
@pytest.mark.parametrize(("letter", "datatype"), [("f", 7), ("d", 8)])
def test_a_cloud_is_its_finite_points(order: str, letter: str, datatype: int) -> None:
    points = [(1, 2, 3), (math.nan, 0, 0), (4, 5, 6), (math.inf, 0, 0)]
    one = struct.Struct(f"{order}2x3{letter}3x")
    rows = [b"".join(one.pack(*point) for point in points[at : at + 2]) + b"pad" for at in (0, 2)]
    size = struct.calcsize(letter)
    fields = [
        {"name": name, "offset": 2 + at * size, "datatype": datatype, "count": 1} for at, name in enumerate("xyz")
    ]
    about = {"width": 2, "height": 2, "point_step": one.size, "row_step": 2 * one.size + 3, "fields": fields}
    head, body = layer("sensor_msgs/PointCloud2", data=b"".join(rows), is_bigendian=order == ">", **about)
    assert floats(body) == [1, 2, 3, 4, 5, 6]
    assert (head["count"], head["every"]) == (4, 1)


def test_a_grid_is_a_picture_of_what_is_known_free_and_occupied() -> None:
    head, body = grid(3, 2, [-1, 0, 100, 50, 0, -1])
    shades = opacities(body)
    assert (head["cells"], head["size"], head["every"], head["resolution"]) == ([3, 2], [3, 2], 1, 0.5)
    assert (shades[0], shades[1][1:]) == ([UNKNOWN, FREE, WALL], [FREE, UNKNOWN])
    assert FREE < shades[1][0] < WALL
    assert grid(0, 0, [])[1] == b""


def test_a_wall_of_one_cell_stays_in_a_thinned_grid(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(limits, "GRID_CELLS", 12)
    cells = [0] * 49
    cells[3 * 7 + 4] = 100
    cells[0] = cells[1] = cells[7] = cells[8] = -1
    head, body = grid(7, 7, cells)
    assert (head["every"], head["size"]) == (3, [3, 3])
    assert opacities(body) == [[FREE] * 3, [FREE, WALL, FREE], [FREE] * 3]
    cells = [-1] * 49
    assert opacities(grid(7, 7, cells)[1]) == [[UNKNOWN] * 3] * 3


CLOUD = {"width": 1, "height": 1, "point_step": 4, "row_step": 4, "data": b"abcd"}
X = {"name": "x", "offset": 0, "datatype": 7, "count": 1}
FAR = {**X, "name": "z", "offset": 2**32 - 1}


@pytest.mark.parametrize(
    ("kind", "values"),
    [
        ("nav_msgs/OccupancyGrid", {"info": {"width": 2, "height": 2, "resolution": 1.0}, "data": [0] * 3}),
        ("nav_msgs/OccupancyGrid", {"info": {"width": 2**32 - 1, "height": 2**32 - 1, "resolution": 1.0}}),
        ("nav_msgs/OccupancyGrid", {"info": {"width": 1, "height": 1, "resolution": math.nan}, "data": [0]}),
        ("geometry_msgs/PoseStamped", {"pose": pose(math.nan)}),
        ("sensor_msgs/PointCloud2", {**CLOUD, "fields": [X]}),
        ("sensor_msgs/PointCloud2", {**CLOUD, "fields": [X, {**X, "name": "y"}, FAR]}),
        ("sensor_msgs/PointCloud2", {**CLOUD, "width": 2**32 - 1, "height": 2**32 - 1, "point_step": 0,
                                     "fields": [X, {**X, "name": "y"}, {**X, "name": "z"}]}),
        ("sensor_msgs/PointCloud2", {**CLOUD, "width": 2**32 - 1, "row_step": 2**32 - 1,
                                     "fields": [X, {**X, "name": "y"}, {**X, "name": "z"}]}),
        ("std_msgs/String", {}),
    ],
)  # fmt: skip
def test_what_contradicts_itself_is_refused(kind: str, values: dict[str, Any]) -> None:
    received = message(kind, values) if kind != "std_msgs/String" else ReceivedMessage("/x", kind, memoryview(b""), 0)
    with pytest.raises(RmpaError):
        layer_frame(3, received, decode(received) if received.payload else {})


def test_nodes_of_one_topic_take_turns_and_are_counted() -> None:
    watch = LayerWatch(1, 5.0, decode)
    for x in range(3):
        for source in ("/a", "/b"):
            watch.receive(message("geometry_msgs/PoseStamped", {"pose": pose(x)}, source))
    made = []
    while (due := watch.due(0.0)) is not None:
        frame = watch.frame(due)
        assert isinstance(frame, bytes)
        made.append(read(frame)[0])
    assert [(head["source"], head["n"], head["pose"][0]) for head in made] == [("/a", 3, 2), ("/b", 3, 2)]
    watch.receive(message("geometry_msgs/PoseStamped", {"pose": pose(9)}, "/a"))
    assert watch.due(0.1) == pytest.approx(0.2)  # twice as often as one node's


def test_a_large_message_is_made_elsewhere_and_one_at_a_time() -> None:
    watch = LayerWatch(1, 5.0, decode)
    info = {"width": 1000, "height": 100, "resolution": 0.5, "origin": pose(0)}
    for _ in range(2):
        watch.receive(message("nav_msgs/OccupancyGrid", {"info": info, "data": [0] * 100_000}))
    make = watch.frame(0.0)
    assert callable(make)
    assert read(make())[0]["cells"] == [1000, 100]


def transform(child: str, parent: str = "map", x: float = 0.0, w: float = 1.0) -> dict[str, Any]:
    header = {"frame_id": parent, "stamp": {"secs": 5}}
    return {
        "header": header,
        "child_frame_id": child,
        "transform": {"translation": {"x": x}, "rotation": {"w": w}},
    }


def frames(*transforms: dict[str, Any], source: str = SOURCE, topic: str = "/tf") -> ReceivedMessage:
    payload = codec_for(MessageType("tf2_msgs/TFMessage")).write({"transforms": transforms}, 0).payload
    return ReceivedMessage(topic, "tf2_msgs/TFMessage", memoryview(payload), 7_000_000_000, source)


def test_the_newest_transform_of_each_frame_and_sender_is_sent_once() -> None:
    watch = FramesWatch(1, 10.0, decode)
    watch.receive(frames(transform("/odom"), transform("base", "odom", 1)))
    watch.receive(frames(transform("base", "odom", 2)))
    watch.receive(frames(transform("base", "odom", 3), source="/other"))
    watch.receive(frames(transform("laser", "base", math.nan), transform("arm", "base", w=0), topic="/tf_static"))
    assert watch.due(0.0) == 0.0
    sent = watch.frame(0.0)
    assert [(row[0], row[1], row[2], row[3], row[6], row[7] and row[7][0]) for row in sent["frames"]] == [
        ("odom", "map", "base:/driver", False, 1, 0.0),
        ("base", "odom", "base:/driver", False, 2, 2.0),
        ("base", "odom", "/other", False, 1, 3.0),
        ("laser", "base", "base:/driver", True, 1, None),
        ("arm", "base", "base:/driver", True, 1, None),
    ]
    assert watch.due(0.0) is None
    watch.receive(frames(transform("odom")))
    assert (watch.due(0.0), len(watch.frame(0.1)["frames"])) == (0.1, 1)


def test_frames_and_their_names_are_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(limits, "FRAMES_MAX", 3)
    watch = FramesWatch(1, 10.0, decode)
    watch.receive(
        frames(*(transform("x" * 1000 + str(at)) for at in range(9)), *(transform(str(at)) for at in range(4)))
    )
    sent = watch.frame(0.0)
    assert [row[0] for row in sent["frames"]] == ["x" * limits.FRAME_CHARACTERS, "0", "1"]
    assert sent["left_out"] == 2
    with pytest.raises(RmpaError, match="no transforms"):
        FramesWatch(1, 10.0, lambda _: {"data": 1}).receive(frames())
