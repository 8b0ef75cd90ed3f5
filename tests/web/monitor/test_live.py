"""What a page is shown: live values by path and cut, scans and pictures, samples of a plot, and patches of states."""

from __future__ import annotations

import json
import math
import struct
from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from rmpa.core.errors import RemoteProtocolError
from rmpa.web.monitor import limits
from rmpa.web.monitor.messages import (
    IMAGE_HEADER,
    SampleBuffer,
    cut,
    difference,
    field_path,
    image_frame,
    number_at,
    scan,
    without_nulls,
)
from rmpa.web.pictures import compressed_picture, raw_picture
from tests.web.monitor.patches import apply


def test_a_value_is_cut_and_says_so() -> None:
    long = {"text": "x" * 1000, "ranges": [0.5] * 1000, "data": memoryview(bytes(700)), "nan": float("nan")}
    assert cut(long) == {
        "text": "x" * limits.VALUE_CHARACTERS + f"… {1000 - limits.VALUE_CHARACTERS} more",
        "ranges": {"…": 1000, "first": [0.5] * limits.VALUE_ITEMS},
        "data": "700 bytes",
        "nan": "nan",
    }
    assert cut(memoryview(bytes(4 * 10**6)).cast("f"))["…"] == 10**6
    assert cut({"id": 2**53 + 1, "small": 2**53}) == {"id": str(2**53 + 1), "small": 2**53}  # browsers would round it
    wide: Any = [[[list(range(60)) for _ in range(60)] for _ in range(60)] for _ in range(3)]
    assert len(json.dumps(cut(wide))) < 40 * limits.VALUE_NODES


@pytest.mark.parametrize(
    ("path", "number"),
    [
        ("pose.x", 1.5), ("axes.1", -1.0), ("axes[1]", -1.0), ("axes[2]", None), ("on", 1.0), ("name", None),
        ("stamp", 2.5), ("axes.²", None), ("pose", None), ("pose.y.z", None), ("axes.x", None),
    ],
)  # fmt: skip
def test_a_number_is_found_by_its_path(path: str, number: float | None) -> None:
    stamp = {"secs": 2, "nsecs": 500_000_000}
    values = {"pose": {"x": 1.5}, "axes": [0, -1.0], "on": True, "name": "3", "stamp": stamp}
    assert number_at(values, field_path(path)) == number


@pytest.mark.parametrize("path", ["", ".", "a..b", "x" * 1000])
def test_what_is_no_path_is_refused(path: str) -> None:
    with pytest.raises(RemoteProtocolError):
        field_path(path)


SCAN = {"angle_min": -1.0, "angle_increment": 0.5, "range_min": 0.1, "range_max": 8.0}


def test_a_scan_has_null_where_nothing_was_measured_and_the_nearest_of_each_part() -> None:
    made = scan({**SCAN, "ranges": [1.0, float("inf"), 0.05, None, 2.0004]})
    assert made == {"start": -1.0, "step": 0.5, "most": 8.0, "ranges": [1.0, None, None, None, 2.0]}
    fine = scan({**SCAN, "ranges": [5.0, 1.0] * limits.SCAN_POINTS})
    assert (fine["ranges"], fine["step"]) == ([1.0] * limits.SCAN_POINTS, 1.0)
    with pytest.raises(RemoteProtocolError, match="LaserScan"):
        scan({"data": 3})


def test_an_image_of_each_order_of_colours_is_shown_alike() -> None:
    rgb = raw_picture(2, 2, "rgb8", 8, bytes([1, 2, 3, 4, 5, 6, 0, 0, 7, 8, 9, 10, 11, 12]))
    assert (rgb.format, rgb.width, rgb.height, rgb.data) == ("rgb8", 2, 2, bytes(range(1, 13)))
    bgr = raw_picture(2, 1, "bgr8", 6, bytes([3, 2, 1, 6, 5, 4]))
    assert (bgr.format, bytes(bgr.data)) == ("bgr8", bytes([3, 2, 1, 6, 5, 4]))
    whole = bytes(each for pixel in range(16) for each in (pixel, pixel + 100, pixel + 200))
    assert bytes(raw_picture(4, 4, "bgr8", 12, whole, 2).data)[::3] == bytes([5, 7, 13, 15])
    bgra = raw_picture(1, 1, "bgra8", 4, bytes([3, 2, 1, 255]))
    assert (bgra.format, bgra.data) == ("bgr8", bytes([3, 2, 1]))
    assert raw_picture(2, 1, "mono8", 2, bytes([7, 8])).data == bytes([7, 8])


def test_a_large_image_is_thinned_to_its_place_and_says_its_true_size() -> None:
    made = raw_picture(1280, 720, "rgb8", 1280 * 3, bytes(1280 * 720 * 3))
    assert made.width * made.height <= limits.IMAGE_PIXELS
    assert len(made.data) == made.width * made.height * 3
    assert (made.width, made.height, made.whole) == (1280, 720, (1280, 720))
    for place, width in ((1200, 1280), (780, 640), (320, 320), (1, 1)):
        made = raw_picture(1280, 720, "rgb8", 1280 * 3, bytes(1280 * 720 * 3), place)
        assert (made.width, made.whole) == (width, (1280, 720))
        assert len(made.data) == made.width * made.height * 3
    assert raw_picture(4000, 3000, "mono8", 4000, bytes(4000 * 3000)).width <= limits.IMAGE_PIXELS**0.5 * 2
    depth = raw_picture(640, 480, "16UC1", 1280, bytes(640 * 480 * 2), 1280)
    assert (depth.width, depth.height) == (320, 240)


@pytest.mark.parametrize(
    ("width", "height", "encoding", "step", "size"),
    [
        (2, 2, "rgb8", 6, 11),
        (2, 2, "rgb8", 5, 99),
        (0, 2, "mono8", 0, 0),
        (2, 2, "bayer_rggb8", 8, 16),
        (9**9, 9**9, "mono8", 9**9, 10),
        (10, 10, "16UC1", 20, 199),
    ],
)
def test_an_image_that_cannot_be_is_refused(width: int, height: int, encoding: str, step: int, size: int) -> None:
    with pytest.raises(RemoteProtocolError):
        raw_picture(width, height, encoding, step, bytes(size))


def test_a_compressed_image_is_passed_on_as_it_is() -> None:
    jpeg = b"\xff\xd8\xff\xe0 and so on"
    frame = image_frame(compressed_picture("rgb8; jpeg compressed bgr8", jpeg), 7, 123)
    assert IMAGE_HEADER.unpack_from(frame) == (1, 1, 0, 0, 0, 7, 123, 0, 0)
    assert frame[IMAGE_HEADER.size :] == jpeg
    with pytest.raises(RemoteProtocolError, match="neither JPEG nor PNG"):
        compressed_picture("tiff", b"II*\0")


@pytest.mark.parametrize(
    ("encoding", "letter", "nothing"), [("16UC1", "H", 0), ("mono16", "H", 0), ("32FC1", "f", float("nan"))]
)
def test_a_depth_image_is_shown_from_near_to_far(encoding: str, letter: str, nothing: float) -> None:
    rows: list[list[float]] = [[nothing, 1000, 2000], [3000, 1000, 3000]]
    packed = [struct.pack(f"<3{letter}", *row) for row in rows]
    step = len(packed[0]) + 4
    picture = raw_picture(3, 2, encoding, step, b"".join(row + b"pad!" for row in packed))
    assert (picture.format, picture.width, picture.height) == ("mono8", 3, 2)
    assert list(picture.data) == [0, 1, 128, 255, 1, 255]


VALUE = st.none() | st.integers(-1000, 1000).map(float)


def test_few_samples_stay_as_they_are() -> None:
    buffer = SampleBuffer(2)
    buffer.add(1.0, [1.0, None])
    buffer.add(2.0, [math.nan, math.inf])
    assert buffer.take() == [[1.0, 2.0], [1.0, None], [None, None]]
    assert buffer.take() == []


@given(st.lists(st.tuples(VALUE, VALUE), min_size=20, max_size=60))
def test_the_buffer_is_bounded_and_keeps_the_extremes(rows: list[tuple[float | None, float | None]]) -> None:
    buffer = SampleBuffer(2, most=8)
    for at, row in enumerate(rows):
        buffer.add(float(at), row)
        assert len(buffer) <= 17
    moments, *lines = buffer.take()
    assert len(moments) <= 8
    assert moments == sorted(moments, key=lambda moment: moment or 0.0)
    for number, line in enumerate(lines):
        given = [value for row in rows if (value := row[number]) is not None]
        assert _extremes([value for value in line if value is not None]) == _extremes(given)


def _extremes(values: list[float]) -> tuple[float, float] | None:
    return (min(values), max(values)) if values else None


SCALARS = st.booleans() | st.integers(-3, 3) | st.sampled_from((0.0, 1.0, 1.5, -2.0)) | st.text(max_size=3)
KEYS = st.sampled_from(("a", "b", "/odom", "__proto__", ""))
VALUES: st.SearchStrategy[Any] = st.recursive(
    SCALARS,
    lambda inner: st.lists(inner | st.none(), max_size=3) | st.dictionaries(KEYS, inner, max_size=4),
    max_leaves=12,
)
STATES = st.dictionaries(KEYS, VALUES, max_size=5)


@settings(suppress_health_check=[HealthCheck.too_slow])  # the first example of a recursive strategy is slow
@given(STATES, STATES)
def test_a_patch_applied_to_the_old_state_gives_the_new_one(old: Any, new: Any) -> None:
    before = json.dumps([old, new])
    made = apply(old, difference(old, new))
    assert json.dumps([old, new]) == before
    assert difference(old, json.loads(json.dumps(old))) == {}
    assert json.dumps(made, sort_keys=True) == json.dumps(new, sort_keys=True)  # 1, 1.0 and true are told apart


def test_what_is_not_known_is_left_out_of_a_state() -> None:
    told = {"a": None, "b": float("nan"), "c": (1, None), "d": {"e": None}}
    assert without_nulls(told) == {"c": [1, None], "d": {}}
