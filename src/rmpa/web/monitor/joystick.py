"""Which commands of a page's joystick drive the robot; no I/O.

TCP keeps over a cut what the page has sent, and delivers all of it when the cable is back, long after the stick was
let go. So each command says when it was made, and what may be older than ``limits.DRIVE_TIMEOUT`` is dropped.

The two clocks need not agree. Each ``tick`` has the server's clock; the page takes the one that came fastest among
the last few, and its own clock counts on from it. A command's ``at`` is then the server's clock at its making, less
the time that this tick took: ``now - at`` is never less than the command's age, and in a steady network it is the
round trip. A tick that was held up, or a clock that stood still while the page's machine slept, makes commands seem
older, never newer.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from rmpa.web.monitor import limits

if TYPE_CHECKING:
    from rmpa.web.monitor.messages import Drive


class Joystick:
    """The holds of one page's stick. A hold is from the touch of the stick until it is let go."""

    def __init__(self) -> None:
        self._hold = 0
        self._number = 0
        self._released = 0
        self._until = 0.0
        self._topic = ""
        self._told_late = False

    @property
    def topic(self) -> str:
        """The topic that is driven; empty while the robot is stopped."""
        return self._topic

    @property
    def due(self) -> float | None:
        """When the robot is to be stopped, if no further command comes."""
        return self._until if self._topic else None

    def takes(self, command: Drive, now: float) -> bool:
        """Whether a command is to be obeyed: it is not too old, and of the present hold or a later one."""
        if abs(now - command.at) > limits.DRIVE_TIMEOUT:
            return False
        if command.hold <= self._released or (command.hold, command.n) <= (self._hold, self._number):
            return False
        self._hold, self._number = command.hold, command.n
        self._told_late = False
        return True

    def drive(self, topic: str, now: float) -> bool:
        """A command is obeyed; returns whether it may move the robot.

        The first one after a stop only arms: one command alone, whatever kept it, moves nothing.
        """
        armed, self._topic = self._topic == topic, topic
        self._until = now + limits.DRIVE_TIMEOUT
        return armed

    def is_new_late(self, command: Drive, now: float) -> bool:
        """Whether a refused command is the first since the last obeyed one that came too late."""
        told, self._told_late = self._told_late, self._told_late or now - command.at > limits.DRIVE_TIMEOUT
        return self._told_late and not told

    def release(self, hold: int) -> None:
        """The stick was let go: nothing more of that hold is obeyed."""
        self._released = max(self._released, hold)

    def stop(self) -> str:
        """The robot stops; returns the topic that was driven, or nothing."""
        topic, self._topic = self._topic, ""
        return topic
