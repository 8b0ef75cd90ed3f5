"""Where commands come from: a Linux joystick, or a recording.

The joystick's bytes: the kernel's Documentation/input/joydev/joystick-api.rst.
"""

from __future__ import annotations

import csv
import os
import struct
import time
from pathlib import Path
from typing import TYPE_CHECKING, Protocol, TypeVar

if TYPE_CHECKING:
    from collections.abc import Callable

EVENT = struct.Struct("<IhBB")
"""``struct js_event``: milliseconds, value, type, number."""
BUTTON, AXIS, INIT = 0x01, 0x02, 0x80
"""The types; INIT is set on those that tell the state at opening."""
CONTROLS_MAX = 64
"""Axes or buttons; a joystick with more is no joystick."""
RECORDING = Path(__file__).with_name("drive.csv")
ROWS = 10
"""A second, of a recording."""

T = TypeVar("T")
Deflections = tuple[tuple[float, ...], tuple[int, ...]]
"""Axes (-1 to 1; left and forward positive) and buttons (0 or 1)."""


class Stick(Protocol):
    """What the joystick module asks at each tick."""

    def read(self) -> Deflections:
        """The present state; must not block."""
        ...


class Recording:
    """A drive that was recorded at 10 Hz, played for ever.

    Args:
        path: A CSV file with the columns forward, left, dead_man.
        now: The clock, in seconds.

    Raises:
        ValueError: With file and line, if it is no such file.
    """

    def __init__(self, path: Path = RECORDING, now: Callable[[], float] = time.monotonic) -> None:
        self.rows: list[Deflections] = []
        with path.open(newline="", encoding="utf-8") as file:
            rows = csv.DictReader(file)
            for row in rows:
                try:
                    forward, left, held = float(row["forward"]), float(row["left"]), int(row["dead_man"])
                except (KeyError, TypeError, ValueError):
                    raise ValueError(f"{path}, line {rows.line_num}: not forward,left,dead_man") from None
                if not (abs(forward) <= 1 and abs(left) <= 1 and held in {0, 1}):
                    raise ValueError(
                        f"{path}, line {rows.line_num}: a deflection beyond ±1, or a button beyond 0 and 1"
                    )
                self.rows.append(((left, forward), (held,)))
        if not self.rows:
            raise ValueError(f"{path}: no recorded drive in it")
        self._now = now
        self._began: float | None = None

    def read(self) -> Deflections:
        """The row of this moment, the first one at the first call."""
        now = self._now()
        if self._began is None:
            self._began = now - 0.5 / ROWS  # mid-row: a reader of the same rate gets each row once
        return self.rows[int((now - self._began) * ROWS) % len(self.rows)]


class StickState:
    """Axes and buttons as the kernel's events tell them."""

    def __init__(self) -> None:
        self._axes: list[float] = []
        self._buttons: list[int] = []
        self._rest = b""

    def feed(self, data: bytes) -> None:
        """Take bytes from the device; half an event waits for its other half."""
        data = self._rest + data
        whole = len(data) - len(data) % EVENT.size
        self._rest = data[whole:]
        for _, value, kind, number in EVENT.iter_unpack(data[:whole]):
            if number >= CONTROLS_MAX:
                continue
            if kind & ~INIT == AXIS:
                # The kernel's axes grow to the right and backwards, ROS's to the left and forwards.
                _put(self._axes, number, max(-1.0, min(1.0, -value / 32767)) + 0.0, 0.0)
            elif kind & ~INIT == BUTTON:
                _put(self._buttons, number, int(value != 0), 0)

    @property
    def deflections(self) -> Deflections:
        """The present state."""
        return tuple(self._axes), tuple(self._buttons)


class LinuxJoystick:
    """A joystick such as ``/dev/input/js0``. While it is unplugged everything is released, so the robot stops.

    Args:
        path: The device.
        say: Told, once each, that the joystick went or came back.
    """

    def __init__(self, path: str, say: Callable[[str], None]) -> None:
        self._path = path
        self._say = say
        self._fd = -1
        self._working = False
        self._missed = False
        self._state = StickState()

    def read(self) -> Deflections:
        """The present state; opens the device if it is closed, so a joystick that comes back works again."""
        try:
            if self._fd < 0:
                self._fd = os.open(self._path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)
            self._read_events()
        except OSError as error:
            self._lost(error)
        return self._state.deflections

    def close(self) -> None:
        """Let go of the device."""
        if self._fd >= 0:
            os.close(self._fd)
            self._fd = -1

    def _read_events(self) -> None:
        while True:
            try:
                data = os.read(self._fd, EVENT.size * 64)
            except BlockingIOError:
                return
            if not data:
                raise OSError("end of file")
            self._state.feed(data)
            if not self._working:
                # Said at its first words, not at opening: one with a loose plug opens, and is gone again.
                self._working = True
                self._say(f"joystick {self._path} is there: hold button 1 and steer with the left stick")

    def _lost(self, error: OSError) -> None:
        self.close()
        self._state = StickState()
        if self._working or not self._missed:
            self._working, self._missed = False, True
            why = error.strerror or str(error)
            self._say(f"joystick {self._path} is gone ({why}): the robot stops; plug it in again to go on")


def _put(values: list[T], index: int, value: T, filler: T) -> None:
    values.extend([filler] * (index + 1 - len(values)))
    values[index] = value
