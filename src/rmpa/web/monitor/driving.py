"""What a page's joystick drives: which of its commands count, the ramp, and the message of each type of topic."""

from __future__ import annotations

from math import copysign
from typing import TYPE_CHECKING, Any, Final, NamedTuple

from rmpa.core.errors import RmpaError
from rmpa.ros.types.codec import codec_for
from rmpa.web.monitor import limits

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from rmpa.web.hub.graph import GraphTable
    from rmpa.web.hub.hub import HubClient

TWIST: Final = "geometry_msgs/Twist"
# What a robot's own frame is called (REP 105): a stamped speed is in it.
_FRAME: Final = "base_link"


class Joystick:
    """The holds of one page's stick, and which of its commands drive the robot.

    A hold is from the touch of the stick until it is let go. TCP keeps over a cut what the page has sent, and
    delivers all of it when the cable is back, long after the stick was let go. So each command says when it was made,
    and what may be older than ``limits.DRIVE_TIMEOUT`` is dropped.

    The two clocks need not agree. Each ``tick`` has the server's clock; the page takes the one that came fastest
    among the last few, and its own clock counts on from it. A command's ``at`` is then the server's clock at its
    making, less the time that this tick took: ``now - at`` is never less than the command's age, and in a steady
    network it is the round trip. A tick that was held up, or a clock that stood still while the page's machine slept,
    makes commands seem older, never newer.
    """

    def __init__(self) -> None:
        self._hold = 0
        self._number = 0
        self._released = 0
        self._until = 0.0
        self._told_late = False
        # The topic that is driven; empty while the robot is stopped.
        self.topic = ""

    @property
    def due(self) -> float | None:
        """When the robot is to be stopped, if no further command comes."""
        return self._until if self.topic else None

    def takes(self, hold: int, n: int, at: float, now: float) -> bool:
        """Whether a command is to be obeyed: it is not too old, and of the present hold or a later one."""
        if abs(now - at) > limits.DRIVE_TIMEOUT:
            return False
        if hold <= self._released or (hold, n) <= (self._hold, self._number):
            return False
        self._hold, self._number = hold, n
        self._told_late = False
        return True

    def drive(self, topic: str, now: float) -> bool:
        """A command is obeyed; returns whether it may move the robot.

        The first one after a stop only arms: one command alone, whatever kept it, moves nothing.
        """
        armed, self.topic = self.topic == topic, topic
        self._until = now + limits.DRIVE_TIMEOUT
        return armed

    def is_new_late(self, at: float, now: float) -> bool:
        """Whether a refused command is the first since the last obeyed one that came too late."""
        told, self._told_late = self._told_late, self._told_late or now - at > limits.DRIVE_TIMEOUT
        return self._told_late and not told

    def release(self, hold: int = 0) -> None:
        """The stick was let go: nothing more of that hold is obeyed, nor of the present one if none is given."""
        self._released = max(self._released, hold or self._hold)


class Command(NamedTuple):
    """What is asked of a robot: shares of the fastest, from -1 to 1; forwards, left and anticlockwise are positive.

    ``axes`` and ``buttons`` are a gamepad's, as they are.
    """

    linear: float = 0.0
    side: float = 0.0
    angular: float = 0.0
    axes: tuple[float, ...] = ()
    buttons: tuple[bool, ...] = ()


def _twist(command: Command) -> dict[str, Any]:
    linear = {"x": command.linear * limits.DRIVE_SPEED, "y": command.side * limits.DRIVE_SPEED}
    return {"linear": linear, "angular": {"z": command.angular * limits.DRIVE_TURN}}


def _ackermann(command: Command) -> dict[str, Any]:
    return {
        "speed": command.linear * limits.DRIVE_SPEED,
        "steering_angle": command.angular * limits.DRIVE_STEER,
    }


# The values of a message of each type that can be driven.
TYPES: Final[Mapping[str, Callable[[Command], dict[str, Any]]]] = {
    TWIST: _twist,
    "geometry_msgs/TwistStamped": lambda command: {"header": {"frame_id": _FRAME}, "twist": _twist(command)},
    "ackermann_msgs/AckermannDrive": _ackermann,
    "ackermann_msgs/AckermannDriveStamped": lambda command: {
        "header": {"frame_id": _FRAME},
        "drive": _ackermann(command),
    },
    "sensor_msgs/Joy": lambda command: {"axes": [*command.axes], "buttons": [int(each) for each in command.buttons]},
}


def type_driven(graph: GraphTable, topic: str, wanted: str, *, stops: bool = False) -> str:
    """The type with which a topic is driven.

    Args:
        graph: Knows the types of topics that are there.
        topic: What is driven.
        wanted: The type that the page names.
        stops: Whether it is to stop: then the topic's own type counts.

    Raises:
        RmpaError: It cannot be driven, or the topic has another type.
    """
    known = graph.topics.get(topic)
    types = known.types if known is not None else ()
    if stops:
        wanted = next((each for each in types if each in TYPES), wanted)
    if wanted not in TYPES:
        raise RmpaError(f"a joystick cannot drive {wanted[:80]!a}: {', '.join(TYPES)} it can", code="type-mismatch")
    if types and wanted not in types:
        raise RmpaError(f"{topic} has the type {', '.join(types)}, not {wanted}", code="type-mismatch")
    return wanted


def ramped(value: float, wanted: float, step: float) -> float:
    """The next value on the way to another one: away from zero by ``step`` at most, towards it at once."""
    if value * wanted < 0:
        value = 0.0
    return wanted if abs(wanted) <= abs(value) + step else value + copysign(step, wanted)


class Driver:
    """Publishes the commands of one page for one topic, each speed by a ramp. A gamepad's raw axes have none.

    Args:
        client: The page, which may drive.
        topic: The topic.
        type_: Its type, one of ``TYPES``.
        failed: Called where the master refuses the publisher.

    Raises:
        RmpaError: The rules deny it, or the type is not known.
    """

    def __init__(self, client: HubClient, topic: str, type_: str, failed: Callable[[RmpaError], None]) -> None:
        self.topic, self.type = topic, type_
        self._codec = codec_for(client.hub.types.message(type_))
        self._time = client.hub.time
        self._last = Command()
        self._at = 0.0
        self._publication = client.advertise(topic, type_, failed)

    def arm(self, now: float) -> None:
        """The stick is held: the next command drives."""
        self.stop()
        self._at = now

    def command(self, wanted: Command, ramp: float, now: float) -> Command:
        """Publish a command; returns what is commanded.

        Args:
            wanted: What the page asks for.
            ramp: The greatest acceleration, m/s²; turning and steering take as long from 0 to 1.
            now: Seconds of the clock of all calls.
        """
        step = ramp / limits.DRIVE_SPEED * min(now - self._at, limits.DRIVE_TIMEOUT)
        last, self._at = self._last, now
        self._last = wanted._replace(
            linear=ramped(last.linear, wanted.linear, step),
            side=ramped(last.side, wanted.side, step),
            angular=ramped(last.angular, wanted.angular, step),
        )
        self._publish()
        return self._last

    def stop(self) -> None:
        """Publish zeros, at once."""
        last = self._last
        self._last = Command(axes=(0.0,) * len(last.axes), buttons=(False,) * len(last.buttons))
        self._publish()

    def close(self) -> None:
        """Publish no more."""
        self._publication.close()

    def _publish(self) -> None:
        values = TYPES[self.type](self._last)
        self._publication.publish(self._codec.write(values, self._time.now_ns()).payload)
