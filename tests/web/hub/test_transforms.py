"""The tree of frames: transforms between any two, whatever was said of them, against rotations by matrices."""

from __future__ import annotations

import math
import random
from typing import Any

import pytest

from rmpa.ros.types.codec import codec_for
from rmpa.ros.types.messages import MessageType
from rmpa.web import limits
from rmpa.web.hub.topics import ReceivedMessage
from rmpa.web.hub.transforms import Transform, TransformTree
from tests.web.recorder import FakeHub

TYPE = "tf2_msgs/TFMessage"


def row(parent: str, child: str, place: Transform) -> dict[str, Any]:
    return {"header": {"frame_id": parent}, "child_frame_id": child, "transform": place.values()}


def message(*rows: dict[str, Any], topic: str = "/tf") -> ReceivedMessage:
    payload = codec_for(MessageType(TYPE)).write({"transforms": [*rows]}, 0).payload
    return ReceivedMessage(topic, TYPE, memoryview(payload), 0)


def tree(*rows: dict[str, Any]) -> TransformTree:
    made = FakeHub().transforms
    made.take(message(*rows))
    return made


def turned(yaw: float, x: float = 0.0, y: float = 0.0) -> Transform:
    return Transform(x, y, 0.0, 0.0, 0.0, math.sin(yaw / 2), math.cos(yaw / 2))


def matrix(place: Transform) -> list[list[float]]:
    x, y, z, w = place[3:]
    return [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w), place.x],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w), place.y],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y), place.z],
        [0.0, 0.0, 0.0, 1.0],
    ]


def product(a: list[list[float]], b: list[list[float]]) -> list[float]:
    return [sum(a[i][k] * b[k][j] for k in range(4)) for i in range(4) for j in range(4)]


@pytest.mark.parametrize("seed", range(20))
def test_transforms_are_composed_and_inverted_as_matrices_are(seed: int) -> None:
    rng = random.Random(seed)

    def some() -> Transform:
        turn = [rng.gauss(0, 1) for _ in range(4)]
        norm = math.hypot(*turn)
        return Transform(*(rng.uniform(-9, 9) for _ in range(3)), *(each / norm for each in turn))

    a, b = some(), some()
    assert [each for line in matrix(a.then(b)) for each in line] == pytest.approx(product(matrix(a), matrix(b)))
    same = [float(i == j) for i in range(4) for j in range(4)]
    assert product(matrix(a), matrix(a.inverse())) == pytest.approx(same, abs=1e-9)
    assert a.then(b).angle(a) == pytest.approx(b.angle(Transform()))


def test_frames_in_different_branches_meet_at_their_common_one() -> None:
    made = tree(
        row("map", "odom", turned(math.pi / 2, 1.0)), row("/odom", "/base", turned(0.0, 2.0)),
        row("base", "laser", turned(math.pi, 0.5)), row("base", "camera", turned(0.0, 0.0, 1.0)),
    )  # fmt: skip
    found = made.lookup("laser", "camera")
    assert found is not None
    assert found[:3] == pytest.approx((0.5, -1.0, 0.0))
    found = made.lookup("map", "laser")
    assert found is not None
    assert found[:2] == pytest.approx((1.0, 2.5))
    assert made.lookup("base", "base") == Transform()


def test_what_is_unknown_broken_or_in_a_loop_has_no_transform() -> None:
    bad = Transform(math.nan)
    made = tree(
        row("a", "b", turned(1.0)), row("x", "y", turned(1.0)), row("a", "c", bad),
        row("a", "d", Transform(qw=0.5)), row("e", "e", turned(0.0)), row("f", "g", turned(0.0)),
        row("g", "f", turned(0.0)),
    )  # fmt: skip
    for target, source in (("a", "y"), ("a", "c"), ("a", "d"), ("a", "e"), ("a", "nothing"), ("a", "f")):
        assert made.lookup(target, source) is None, (target, source)
    made.take(ReceivedMessage("/tf", "std_msgs/String", memoryview(b"\x02\0\0\0hi"), 0))
    assert made.lookup("a", "b") == pytest.approx(turned(1.0))


def test_frames_are_bounded() -> None:
    made = tree(*(row("map", f"f{number}", turned(0.0)) for number in range(limits.FRAMES_MAX + 1)))
    assert made.lookup("map", f"f{limits.FRAMES_MAX - 1}") is not None
    assert made.lookup("map", f"f{limits.FRAMES_MAX}") is None
