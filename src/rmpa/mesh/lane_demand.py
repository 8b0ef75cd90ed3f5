"""When the bulk lane of a link has a connection: it is dialled when a message first wants it, and ends unused.

Sans-I/O; one machine for each side of a link. Only the side that dialled the link dials its bulk lane; the other side
asks for it. Three words (``LaneWord``), in lane frames on the express lane, keep messages from being lost at the end
of the lane::

    ABSENT ──want, or the other side's WANT──► WANTED ──connected──► UP ◄──────────┐
      ▲                                          ▲                   │ unused      │ KEEP
      │                                          └── lost ───────────┤ LEAVE sent  │
      └──────────── the acceptor's bye ◄──────────────────────── LEAVING ──────────┘

The dialler stops sending, and says LEAVE. The acceptor ends the connection if it has nothing on the way; otherwise it
answers KEEP. So neither side sends on a connection that the other side is about to end.

A peer of an earlier release does not know these words: its lane is dialled with the link, and stays.
"""

from __future__ import annotations

from enum import Enum, auto

from rmpa.mesh import limits
from rmpa.mesh.frames import LaneWord


class LaneState(Enum):
    """The state of the bulk lane, as one side sees it."""

    ABSENT = auto()
    WANTED = auto()
    """The dialler dials; the acceptor has asked for it."""
    UP = auto()
    LEAVING = auto()
    """Dialler: it has proposed to end the lane, and sends nothing."""


class LaneAction(Enum):
    """What the driver does."""

    NOTHING = auto()
    DIAL = auto()
    SAY_WANT = auto()
    SAY_LEAVE = auto()
    """Send no more on the connection, which stays, and say LEAVE."""
    SAY_KEEP = auto()
    RESUME = auto()
    """Send on the connection again."""
    CLOSE = auto()
    """End the connection by a bye; the lane has none then."""


class LaneDemand:
    """The bulk lane of one link.

    Args:
        dialled: Whether this side dialled the link.
        agreed: Whether both sides know the words; otherwise the lane is always wanted.
    """

    __slots__ = ("_agreed", "_asked", "_dialled", "_used_at", "state")

    def __init__(self, *, dialled: bool, agreed: bool) -> None:
        self._dialled = dialled
        self._agreed = agreed
        self._asked = not agreed
        """Dialler: whether the other side wants the lane, although it cannot be dialled now."""
        self._used_at = 0.0
        self.state = LaneState.ABSENT

    def begin(self) -> LaneAction:
        """The link is used from now on."""
        if not self._dialled or not (self._asked or self.state is LaneState.WANTED):
            return LaneAction.NOTHING
        self.state = LaneState.WANTED
        return LaneAction.DIAL

    def want(self) -> LaneAction:
        """A message of this side waits for the lane."""
        if self.state is not LaneState.ABSENT or not (self._dialled or self._agreed):
            return LaneAction.NOTHING
        self.state = LaneState.WANTED
        return LaneAction.DIAL if self._dialled else LaneAction.SAY_WANT

    def said(self, word: int, now: float, *, used: bool) -> LaneAction:
        """Take a word of the other side; unknown ones, and those that come too late, have no effect.

        Args:
            word: A ``LaneWord``, or a number of a later version.
            now: Monotonic seconds.
            used: Whether this side sent data since the last call of ``said`` or ``check``, or has some on the way.
        """
        if used:
            self._used_at = now
        if word == LaneWord.WANT and self._dialled:
            self._asked = True
            return self.want()
        if word == LaneWord.LEAVE and not self._dialled and self.state is LaneState.UP:
            if now - self._used_at < limits.BULK_UNUSED:
                return LaneAction.SAY_KEEP
            self.state = LaneState.ABSENT
            return LaneAction.CLOSE
        if word == LaneWord.KEEP and self.state is LaneState.LEAVING:
            self.state = LaneState.UP
            self._used_at = now
            return LaneAction.RESUME
        return LaneAction.NOTHING

    def up(self, now: float) -> None:
        """The lane has a connection."""
        self.state = LaneState.UP
        self._used_at = now
        self._asked = not self._agreed

    def down(self, *, orderly: bool, waiting: bool) -> tuple[LaneAction, bool]:
        """Handle the end of the connection, or of an attempt to dial it.

        Args:
            orderly: Whether the other side ended it by a bye.
            waiting: Whether messages of this side wait for the lane.

        Returns:
            What to do, and whether messages on the way may be lost.
        """
        left = self.state is LaneState.LEAVING and orderly
        wanted = waiting or self._asked or (self._dialled and not left)
        self.state = LaneState.ABSENT
        return (self.want() if wanted else LaneAction.NOTHING), not left

    def check(self, now: float, *, used: bool) -> LaneAction:
        """Look from time to time whether the lane is used; ``used`` as for ``said``."""
        if used:
            self._used_at = now
        unused = now - self._used_at >= limits.BULK_UNUSED
        if self.state is LaneState.UP and unused and self._dialled and self._agreed:
            self.state = LaneState.LEAVING
            return LaneAction.SAY_LEAVE
        return LaneAction.NOTHING
