"""What a page's joystick drives, which of its commands count and as which messages, and which page has the stick."""

from __future__ import annotations

import os
import time
from math import copysign
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import msgspec

from rmpa.core.errors import PeerRefused, RmpaError
from rmpa.ros.types.codec import codec_for
from rmpa.web.monitor import limits

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from rmpa.web.hub.graph import GraphTable
    from rmpa.web.hub.hub import Hub, HubClient
    from rmpa.web.hub.topics import ClientPublication, ClientSubscription, ReceivedMessage

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
        self._told_late = False

    def takes(self, hold: int, n: int, at: float, now: float) -> bool:
        """Whether a command is to be obeyed: it is not too old, and of the present hold or a later one."""
        if abs(now - at) > limits.DRIVE_TIMEOUT:
            return False
        if hold <= self._released or (hold, n) <= (self._hold, self._number):
            return False
        self._hold, self._number = hold, n
        self._told_late = False
        return True

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
        # When the robot is to be stopped, if no further command comes; ``None``: it is stopped.
        self.due: float | None = None
        self._publication = client.advertise(topic, type_, failed)

    def command(self, wanted: Command, ramp: float, now: float) -> Command | None:
        """Publish a command; returns what is commanded.

        The first one after a stop only arms (``None``): one command alone, whatever kept it, moves nothing.

        Args:
            wanted: What the page asks for.
            ramp: The greatest acceleration, m/s²; turning and steering take as long from 0 to 1.
            now: Seconds of the clock of all calls.
        """
        step = ramp / limits.DRIVE_SPEED * min(now - self._at, limits.DRIVE_TIMEOUT)
        last, self._at = self._last, now
        if self.due is None:
            self.stop()
            self.due = now + limits.DRIVE_TIMEOUT
            return None
        self.due = now + limits.DRIVE_TIMEOUT
        self._last = wanted._replace(
            linear=ramped(last.linear, wanted.linear, step),
            side=ramped(last.side, wanted.side, step),
            angular=ramped(last.angular, wanted.angular, step),
        )
        self._publish()
        return self._last

    def stop(self) -> None:
        """Publish zeros, at once."""
        self.due = None
        last = self._last
        self._last = Command(axes=(0.0,) * len(last.axes), buttons=(False,) * len(last.buttons))
        self._publish()

    def close(self) -> None:
        """Publish no more."""
        self._publication.close()

    def _publish(self) -> None:
        values = TYPES[self.type](self._last)
        self._publication.publish(self._codec.write(values, self._time.now_ns()).payload)


# The holder of a driven topic: one page of one module at a time, known to all that show its joystick. Servers
# tell each other by the topic ``TOPIC/holder``, so that it is renamed, permitted and recorded as ``TOPIC`` is. A
# ``Hold`` is said anew every ``limits.STICK_RENEW`` while it lasts; one that is not heard for ``limits.STICK_EXPIRY``
# has ended. Each taking has a higher ``turn`` than what was known, and of two at one moment the higher ``id`` holds:
# all servers decide alike, in whatever order they hear of it.
SUFFIX: Final = "/holder"
_TYPE: Final = "std_msgs/String"


class Hold(msgspec.Struct, frozen=True):
    """One taking of a stick, as the servers tell it: JSON in a std_msgs/String.

    Attributes:
        turn: Numbers the takings.
        id: Of this one.
        by: The address of the page; empty: the stick is free.
        module: The page's module; of a free stick the one that has ended the hold.
        since: When it was taken, in seconds since the epoch.
        ended: Why the hold before ended, where another page has ended it.
    """

    turn: int = 0
    id: str = ""
    by: str = ""
    module: str = ""
    since: float = 0.0
    ended: str = ""

    @property
    def who(self) -> str:
        """The page, for people."""
        return f"the page of {self.by} at {self.module}"


class Stick:
    """The stick of one topic, of all pages of this server.

    Args:
        sticks: Those of this server.
        topic: What is driven.

    Attributes:
        hold: The one that counts.
        holder: The page that has it; ``None``: it is free, or of another server.
        problem: Why other modules are not told; empty: they are.
    """

    def __init__(self, sticks: Sticks, topic: str) -> None:
        self.topic, self.hold, self.problem = topic, Hold(), ""
        self.holder: object | None = None
        # By page, what is called when it has another holder, with whether the page had it before.
        self._pages: dict[object, Callable[[bool], None]] = {}
        self._sticks = sticks
        self._topics = sticks.hub.topics
        self._clock = sticks.clock
        self._heard = 0.0
        self._publication: ClientPublication | None = None
        self._subscription: ClientSubscription | None = None
        try:
            self._subscription = self._topics.subscribe(topic + SUFFIX, _TYPE, self._receive, self._failed)
        except RmpaError as error:
            self._failed(error)

    def show(self, page: object, changed: Callable[[bool], None], *, drives: bool) -> None:
        """A page shows it; arguments as of ``Sticks.show``."""
        self._pages[page] = changed
        if drives:
            self._advertise()

    def hide(self, page: object) -> None:
        """The page does not show it any more; with the last one it ends."""
        del self._pages[page]
        self.leave(page)
        if not self._pages:
            del self._sticks.shown[self.topic]
            for each in (self._subscription, self._publication):
                if each is not None:
                    each.close()

    def _advertise(self) -> None:
        """Connect to the other servers, so that they hear the next word at once."""
        if self._publication is None and not self.problem:
            name = self.topic + SUFFIX
            try:
                self._publication = self._topics.advertise(name, _TYPE, self._failed, latch=True)
            except RmpaError as error:
                self._failed(error)

    def take(self, page: object, by: str, *, over: bool = False) -> None:
        """Give it to a page.

        Args:
            page: The page.
            by: Its address.
            over: Whether to take it from the page that has it.

        Raises:
            PeerRefused: Another page has it.
        """
        if self.holder is page:
            return
        if self.hold.by and not over:
            raise PeerRefused("the stick", f"{self.hold.who} has it", "let that page go, or take it over")
        made = self._next(by)
        ended = f"{made.who} has taken the stick over" if self.hold.by else ""
        self._decide(msgspec.structs.replace(made, ended=ended), page)

    def leave(self, page: object) -> None:
        """A page lets it go."""
        if self.holder is page:
            self._decide(msgspec.structs.replace(self.hold, by="", ended=""), None)

    def stop(self, by: str) -> None:
        """End the hold, whichever page has it."""
        made = self._next(by)
        self._decide(msgspec.structs.replace(made, by="", ended=f"{made.who} has stopped the robot"), None)

    def handle_timer(self, page: object) -> None:
        """Say it anew if the page has it; end one that was not heard for long."""
        silent = self._clock() - self._heard
        if self.holder is page and silent >= limits.STICK_RENEW:
            self._say()
        elif self.holder is None and self.hold.by and silent >= limits.STICK_EXPIRY:
            self._set(Hold(self.hold.turn), None)  # without its id: should it be heard again, it holds again

    def due(self, page: object) -> float | None:
        """In how many seconds ``handle_timer`` is to be called for a page."""
        if not self.hold.by or self.holder not in (None, page):
            return None
        after = limits.STICK_EXPIRY if self.holder is None else limits.STICK_RENEW
        return max(0.0, self._heard + after - self._clock())

    def received(self, hold: Hold) -> None:
        """What another server says, or this one has said."""
        ours, theirs = (self.hold.turn, self.hold.id), (hold.turn, hold.id)
        if theirs == ours:
            if self.hold.by and not hold.by:
                self._set(hold, None)
            elif self.holder is None:
                self._heard = self._clock()
        elif theirs > ours or (not self.hold.by and self._clock() - self._heard >= limits.STICK_EXPIRY):
            self._set(hold, None)

    def _next(self, by: str) -> Hold:
        return Hold(self.hold.turn + 1, os.urandom(8).hex(), by, self._sticks.module(), time.time())

    def _decide(self, hold: Hold, holder: object | None) -> None:
        self._set(hold, holder)
        self._say()

    def _say(self) -> None:
        self._heard = self._clock()
        self._advertise()
        if self._publication is not None:
            text = msgspec.json.encode(self.hold)
            self._publication.publish(len(text).to_bytes(4, "little") + text)

    def _set(self, hold: Hold, holder: object | None) -> None:
        had, self.hold, self.holder, self._heard = self.holder, hold, holder, self._clock()
        self._tell(had)

    def _tell(self, had: object | None) -> None:
        for page, changed in [*self._pages.items()]:
            changed(page is had)

    def _receive(self, message: ReceivedMessage) -> None:
        try:
            hold = msgspec.json.decode(bytes(message.payload[4:]), type=Hold)
        except (msgspec.DecodeError, UnicodeError):
            return  # of another program
        self.received(hold)

    def _failed(self, error: RmpaError) -> None:
        self.problem = f"other modules do not see who drives: {error}"
        self._publication = None
        self._tell(self.holder)


class Sticks:
    """The sticks that pages of this server show.

    Args:
        hub: For each stick.
        module: The name of this module.
        clock: Monotonic seconds.
    """

    def __init__(self, hub: Hub, module: Callable[[], str], clock: Callable[[], float] = time.monotonic) -> None:
        self.hub, self.module, self.clock = hub, module, clock
        # By topic.
        self.shown: dict[str, Stick] = {}

    def show(self, topic: str, page: object, changed: Callable[[bool], None], *, drives: bool) -> Stick:
        """The stick of a topic.

        Args:
            topic: What is driven.
            page: Shows it, until it is hidden.
            changed: ``(had)``: called when it has another holder; whether it was the page before.
            drives: Whether the page may take it.
        """
        stick = self.shown.get(topic)
        if stick is None:
            stick = self.shown[topic] = Stick(self, topic)
        stick.show(page, changed, drives=drives)
        return stick
