"""The tree of frames as ``/tf`` and ``/tf_static`` have it last, and transforms between any two of its frames."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any, Final, NamedTuple

from rmpa.core.errors import RmpaError
from rmpa.web import limits
from rmpa.web.hub.node_link import Follower

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from rmpa.web.hub.graph import TypeLibrary
    from rmpa.web.hub.topics import ClientSubscription, HubTopics, ReceivedMessage

TOPICS: Final = ("/tf", "/tf_static")
# How far a rotation's norm may be from 1; tf2 refuses others, too.
_NORM: Final = 0.01


class Transform(NamedTuple):
    """Where a frame is in another one: its origin in metres, and its rotation as a quaternion of norm 1."""

    x: float = 0.0
    y: float = 0.0
    z: float = 0.0
    qx: float = 0.0
    qy: float = 0.0
    qz: float = 0.0
    qw: float = 1.0

    def then(self, other: Transform) -> Transform:
        """Where a frame is whose place in this one is ``other``."""
        x, y, z = self._turned(other.x, other.y, other.z)
        ax, ay, az, aw, bx, by, bz, bw = *self[3:], *other[3:]
        return Transform(
            self.x + x,
            self.y + y,
            self.z + z,
            aw * bx + ax * bw + ay * bz - az * by,
            aw * by - ax * bz + ay * bw + az * bx,
            aw * bz + ax * by - ay * bx + az * bw,
            aw * bw - ax * bx - ay * by - az * bz,
        )

    def inverse(self) -> Transform:
        """Where the other frame is in this one."""
        back = Transform(0.0, 0.0, 0.0, -self.qx, -self.qy, -self.qz, self.qw)
        return Transform(*back._turned(-self.x, -self.y, -self.z), *back[3:])

    def distance(self, other: Transform) -> float:
        """Metres between two origins."""
        return math.dist(self[:3], other[:3])

    def angle(self, other: Transform) -> float:
        """Radians between two rotations."""
        return 2 * math.acos(min(1.0, abs(sum(a * b for a, b in zip(self[3:], other[3:], strict=True)))))

    def values(self) -> dict[str, Any]:
        """A geometry_msgs/Transform."""
        x, y, z, qx, qy, qz, qw = self
        return {"translation": {"x": x, "y": y, "z": z}, "rotation": {"x": qx, "y": qy, "z": qz, "w": qw}}

    def _turned(self, x: float, y: float, z: float) -> tuple[float, float, float]:
        """A vector, turned: v + 2 q x (q x v + w v), where x is the cross product."""
        qx, qy, qz, qw = self[3:]
        ux, uy, uz = qy * z - qz * y + qw * x, qz * x - qx * z + qw * y, qx * y - qy * x + qw * z
        return x + 2 * (qy * uz - qz * uy), y + 2 * (qz * ux - qx * uz), z + 2 * (qx * uy - qy * ux)


def frame_name(name: str) -> str:
    """A frame's name; tf1 wrote it with a slash in front."""
    return name.removeprefix("/")


class TransformTree:
    """Follows both topics while it is followed; each frame is where it was last said to be.

    Args:
        topics: Subscribes.
        types: Knows the types of messages.
    """

    def __init__(self, topics: HubTopics, types: TypeLibrary) -> None:
        self._topics = topics
        self._types = types
        self._followers: dict[Follower, Callable[[RmpaError], None]] = {}
        self._subscriptions: list[ClientSubscription] = []
        # By frame: its parent, and where it is in that.
        self._places: dict[str, tuple[str, Transform]] = {}

    def follow(self, failed: Callable[[RmpaError], None]) -> Follower:
        """Keep the tree until the follower is closed; ``failed`` is called where the master refuses a topic.

        Raises:
            PeerRefused: The rules deny it.
        """
        self.rest()
        if not self._subscriptions:
            self._places.clear()
            for topic in TOPICS:
                self._subscriptions.append(self._topics.subscribe(topic, None, self.take, self._failed))
        return Follower(self._followers, failed)

    def rest(self) -> None:
        """Unsubscribe where no follower is left."""
        while self._subscriptions and not self._followers:
            self._subscriptions.pop().close()

    def take(self, message: ReceivedMessage) -> None:
        """A tf2_msgs/TFMessage, or what has the same bytes; what is broken in it is left out, as tf2 does."""
        try:
            rows = self._types.codec(message.type, message.md5sum).json_values(message.payload)["transforms"]
        except (RmpaError, KeyError):
            return  # a message of another type
        for row in rows:
            parent, child = frame_name(row["header"]["frame_id"]), frame_name(row["child_frame_id"])
            place = _transform(row["transform"])
            known = child in self._places or len(self._places) < limits.FRAMES_MAX
            if place is not None and parent and child and parent != child and known:
                self._places[child] = parent, place

    def lookup(self, target: str, source: str) -> Transform | None:
        """Where ``source`` is in ``target``; ``None``: they are not in one tree. A frame is always in itself."""
        above, _ = self._ancestors(target)
        found, order = self._ancestors(source)
        common = next((each for each in order if each in above), None)
        return above[common].inverse().then(found[common]) if common is not None else None

    def _ancestors(self, frame: str) -> tuple[Mapping[str, Transform], list[str]]:
        """Where a frame is in itself, in its parent and so on, and these in order."""
        found, place = {frame: Transform()}, Transform()
        while (entry := self._places.get(frame)) is not None and entry[0] not in found:
            frame, step = entry
            place = found[frame] = step.then(place)
        return found, [*found]

    def _failed(self, error: RmpaError) -> None:
        for failed in [*self._followers.values()]:
            failed(error)


def _transform(values: Mapping[str, Any]) -> Transform | None:
    """Of a geometry_msgs/Transform; ``None`` where a number is not finite, or the rotation is none."""
    place, turn = values["translation"], values["rotation"]
    numbers = place["x"], place["y"], place["z"], turn["x"], turn["y"], turn["z"], turn["w"]
    if not all(isinstance(each, float) and math.isfinite(each) for each in numbers):
        return None
    return Transform(*numbers) if abs(math.hypot(*numbers[3:]) - 1) <= _NORM else None
