from __future__ import annotations

import struct
import subprocess
import sys
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rmpa.ros.types.definitions import (
    ARRAY_TYPE,
    SEPARATOR,
    DiagnosticLevel,
    DiagnosticStatus,
    frame_array,
    known_types,
)
from rmpa.ros.types.messages import MessageError, MessageType, Plain

JOY: Plain = {
    "header": {"seq": 3, "stamp": {"secs": 1, "nsecs": 500_000_000}, "frame_id": "pad"},
    "axes": [0.5, -1.0],
    "buttons": [1, 0, 1],
}


JOY_BYTES = bytes.fromhex(
    "03000000 01000000 0065cd1d 03000000 706164 02000000 0000003f 000080bf 03000000 010000000000000001000000"
)


def test_these_bytes() -> None:
    kind = MessageType("sensor_msgs/Joy")
    assert kind.serialize(kind.make(JOY)) == JOY_BYTES
    assert kind.to_plain(kind.deserialize(JOY_BYTES)) == JOY


def test_received_type_with_all_features() -> None:
    definition = (
        "int32 lower=1\nstring TEXT=a'\"\\ # no comment\ntime[] times\nduration d\nbyte b\nchar c\nbool[2] flags\n"
        f"string[] texts\nInner[] inner\nuint8[] data\nint64 class\nint8 self\n{SEPARATOR}\nMSG: my_msgs/Inner\n"
        "float32 x # note\n"
    )
    kind = MessageType.learn("my_msgs/All", definition)
    values: Plain = {
        "times": [{"secs": 1, "nsecs": 2}],
        "d": {"secs": -1, "nsecs": 5},
        "b": 7,
        "c": 8,
        "flags": [True, False],
        "texts": ["a", "ü"],
        "inner": [{"x": 1.5}, {"x": 2.5}],
        "data": [1, 2, 255],
        "class": -5,
        "self": -1,
    }
    raw = kind.serialize(kind.make(values))
    assert kind.to_plain(kind.deserialize(raw)) == values
    assert kind.to_plain(kind.make())["flags"] == [False, False], "a fixed array has its size"


@pytest.mark.parametrize(
    ("values", "plain"),
    [
        ("hello", {"data": "hello"}), (["hello"], {"data": "hello"}), ({"data": 7}, {"data": "7"}),
        (None, {"data": ""}),
    ],
)  # fmt: skip
def test_short_ways_to_write_a_message(values: Plain, plain: dict[str, Plain]) -> None:
    kind = MessageType("std_msgs/String")
    assert kind.to_plain(kind.make(values)) == plain


def test_times_may_be_seconds_and_byte_arrays_text() -> None:
    kind = MessageType("std_msgs/Header")
    assert kind.to_plain(kind.make({"stamp": 1.25}))["stamp"] == {"secs": 1, "nsecs": 250_000_000}
    array = MessageType("std_msgs/UInt8MultiArray")
    assert array.to_plain(array.make({"data": "ab"}))["data"] == [97, 98]


def test_a_program_may_give_arrays_bytes_and_messages() -> None:
    image, pixels = MessageType("sensor_msgs/Image"), np.arange(6, dtype=np.uint8).reshape(2, 3)
    raw = bytes(range(6))
    for data in (raw, bytearray(raw), memoryview(raw), tuple(raw), pixels, np.arange(6)):
        made = image.make({"data": data})
        assert image.to_plain(image.deserialize(image.serialize(made)))["data"] == list(range(6))
    made = image.make({"data": pixels})
    pixels[:] = 9  # the caller's own, again
    assert list(made.data) == list(range(6))
    scan = MessageType("sensor_msgs/LaserScan")
    made = scan.make({"header": made.header, "ranges": np.array([1.5, np.inf]), "angle_min": np.float32(0.5)})
    assert made.ranges.dtype == np.float32
    assert made.angle_min == 0.5
    again = scan.make({"header": {"stamp": made.header.stamp}, "intensities": made.ranges})
    assert list(scan.deserialize(scan.serialize(again)).intensities) == [1.5, np.inf]
    twist, vector = MessageType("geometry_msgs/Twist"), MessageType("geometry_msgs/Vector3")
    assert twist.to_plain(twist.make({"linear": vector.make([1, 2, 3])}))["linear"] == {"x": 1.0, "y": 2.0, "z": 3.0}
    assert MessageType("std_msgs/Int32").make({"data": np.int64(5)}).data == 5
    assert MessageType("std_msgs/String").make({"data": np.int64(5)}).data == "5"


def test_null_is_a_default_and_words_are_no_numbers() -> None:
    kind = MessageType.learn("my_msgs/N", "string[] s\ntime[] t\nfloat32[] f\nint8 i\n")
    values = {"s": [None], "t": [None, {"secs": 1}], "f": [None, "nan", "-.inf", np.True_], "i": None}
    plain = kind.to_plain(kind.make(values))
    assert plain | {"f": str(plain["f"])} == {
        "s": [""],
        "t": [{"secs": 0, "nsecs": 0}, {"secs": 1, "nsecs": 0}],
        "f": "[0.0, nan, -inf, 1.0]",
        "i": 0,
    }
    assert kind.make({"s": np.array(["a", "b"], object)}).s == ["a", "b"]


@pytest.mark.parametrize(
    ("kind", "values", "error"),
    [
        ("sensor_msgs/Joy", {"axs": []}, "sensor_msgs/Joy has no field 'axs'; it has header, axes, buttons"),
        ("sensor_msgs/Joy", {"header": {"frame_id": 10**5000}}, "is a string, not an integer of 16610 bits"),
        ("sensor_msgs/Joy", {"header": {"frame_id": [1]}}, "header.frame_id: is a string, not a list of 1"),
        ("sensor_msgs/Joy", {"header": {"stamp": "then"}}, "header.stamp: is a time ({secs, nsecs}), not 'then'"),
        ("sensor_msgs/Joy", {"buttons": [1.5]}, "buttons[0]: is a int32, not 1.5"),
        ("sensor_msgs/Joy", [1, 2], "sensor_msgs/Joy has 3 fields, not 2"),
        ("sensor_msgs/Joy", 7, "sensor_msgs/Joy is made of the fields header, axes, buttons, not of 7"),
        ("sensor_msgs/Image", {"data": np.array([256])}, "data: does not fit uint8: 256 to 256"),
        ("sensor_msgs/Image", {"data": np.array([1.0])}, "data: is a list (uint8[]), not one of float64"),
        ("sensor_msgs/LaserScan", {"ranges": b"abcd"}, "ranges: is a list (float32[]), not 4 bytes"),
        ("sensor_msgs/LaserScan", {"ranges": np.array(["a"])}, "ranges: is a list (float32[]), not one of <U1"),
        (
            "geometry_msgs/PoseWithCovariance", {"covariance": np.eye(5)}, "has 36 elements (float64[36]), not 25",
        ),
        (
            "geometry_msgs/PoseWithCovariance", {"covariance": [1.0]}, "has 36 elements (float64[36]), not 1",
        ),
        ("sensor_msgs/LaserScan", {"ranges": bytes(500_000)}, "not 500000 bytes"),
    ],
)  # fmt: skip
def test_what_a_program_gives_that_does_not_fit(kind: str, values: Any, error: str) -> None:
    with pytest.raises(MessageError) as caught:
        MessageType(kind).make(values)
    assert error in str(caught.value)
    assert len(str(caught.value)) < 300


@pytest.mark.parametrize("raw", [b"", JOY_BYTES[:-1], JOY_BYTES + b"x", b"\xff" * 40])
def test_bytes_that_are_no_message(raw: bytes) -> None:
    with pytest.raises(MessageError, match="bytes are not a sensor_msgs/Joy"):
        MessageType("sensor_msgs/Joy").deserialize(raw)


def test_an_object_that_is_no_message() -> None:
    older, newer = (MessageType.learn("my_msgs/M", text) for text in ("int8 a", "int8 a\nint8 b"))
    with pytest.raises(MessageError, match="my_msgs/M has b here, and not in the version given"):
        newer.serialize(older.make())
    with pytest.raises(MessageError, match="Joy is made of the fields header, axes, buttons, not of 'joy'"):
        MessageType("sensor_msgs/Joy").serialize("joy")


def test_sums_are_those_of_rosbags() -> None:
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS1_NOETIC)
    compared = 0
    for name in known_types():
        inner = name.replace("/", "/msg/")
        if inner in store.fielddefs:
            assert store.generate_msgdef(inner)[1] == MessageType(name).md5sum, name
            compared += 1
    assert compared > 150


def test_the_agents_part_of_ros_starts_without_numpy() -> None:
    program = (
        "import pkgutil, sys, importlib, rmpa.ros, rmpa.ros.node\n"
        "for room in (rmpa.ros, rmpa.ros.node):\n"
        "    for module in pkgutil.iter_modules(room.__path__, room.__name__ + '.'):\n"
        "        if module.name != 'rmpa.ros.types.typestore':\n"  # what the first message imports
        "            importlib.import_module(module.name)\n"
        "from rmpa.ros.types.messages import MessageType\n"
        "MessageType('sensor_msgs/Joy').describe()\n"
        "print(sorted({'numpy', 'rosbags', 'rich'} & sys.modules.keys()))\n"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True, timeout=60)
    assert done.stdout == "[]\n"


# DiagnosticArray as bytes: golden, and read by the types that others use.


GOLDEN = (
    "45000000"  # the message's length
    "07000000"  # header: seq
    "05000000"
    "06000000"  # stamp
    "00000000"  # frame_id
    "01000000"  # one status
    "01"  # WARN
    "05000000"
    "726d7061 3a"  # name "rmpa:"
    "03000000"
    "c2b573"  # message, UTF-8
    "01000000"
    "62"  # hardware_id
    "02000000"  # two values
    "04000000"
    "72617465"
    "02000000"
    "3130"
    "01000000"
    "6b"
    "00000000"
).replace(" ", "")


def test_golden_bytes() -> None:
    status = DiagnosticStatus(DiagnosticLevel.WARN, "rmpa:", "µs", "b", {"rate": "10", "k": ""})
    framed = frame_array(7, 5_000_000_006, [status.serialize()])
    assert framed.hex() == GOLDEN
    assert struct.unpack_from("<I", framed)[0] == len(framed) - 4


TEXT = st.text(max_size=20)


STATUS = st.builds(
    DiagnosticStatus, st.sampled_from(DiagnosticLevel), TEXT, TEXT, TEXT, st.dictionaries(TEXT, TEXT, max_size=5)
)


@given(st.integers(0, 1 << 40), st.integers(0, (1 << 31) * 1_000_000_000 - 1), st.lists(STATUS, max_size=5))
def test_others_read_what_we_write(sequence: int, stamp: int, statuses: list[DiagnosticStatus]) -> None:
    framed = frame_array(sequence, stamp, (status.serialize() for status in statuses))
    message = MessageType(ARRAY_TYPE).deserialize(framed[4:])
    assert message.header.seq == sequence & 0xFFFFFFFF
    assert (message.header.stamp.sec, message.header.stamp.nanosec) == divmod(stamp, 1_000_000_000)
    assert [
        DiagnosticStatus(
            DiagnosticLevel(s.level), s.name, s.message, s.hardware_id, {v.key: v.value for v in s.values}
        )
        for s in message.status
    ] == statuses
