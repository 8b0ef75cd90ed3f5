"""How both sides agree to end the connection of a link that nothing needs, so that no frame of either is lost. Pure.

The peer is *parked* then: both sides make the link again as soon as something needs it.

::

    dialler                                   acceptor
       │ ◄── pace: parks ────────────────────────│     nothing needs the link, here or there, for PARK_AFTER
       │ ─── pace: parks, parting ─────────────► │     shall we part?
       │ ◄── pace: parks, parting ───────────────│     yes; from here on it holds back what it would send
       │ ─── bye: parked ──────────────────────► │     over
       │ or: pace: needed ─────────────────────► │     the dialler needs the link meanwhile; the acceptor goes on

TCP keeps the order, so when the dialler reads the answer it has everything that the acceptor sent; and it says the
bye only if it sent nothing itself since. What the acceptor holds back is sent over the next link.
"""

from __future__ import annotations

from enum import Enum, auto
from typing import TYPE_CHECKING

from rmpa.mesh import limits
from rmpa.mesh.frames import PaceFlag

if TYPE_CHECKING:
    from rmpa.mesh.keepalive import Keepalive


class PartingStep(Enum):
    """What the connection does after a pace frame was received."""

    NOTHING = auto()
    ANSWER = auto()
    """Acceptor: agree by a pace frame."""
    PART = auto()
    """Dialler: send the bye."""
    GO_ON = auto()
    """Acceptor: send what was held back."""


class Parting:
    """The agreement to end a connection for now, as one side sees it.

    Args:
        keepalive: Knows what both sides need, and whether they would part.
        dialler: Whether this side dialled: then it is the one that asks, and that says the bye.
    """

    __slots__ = ("_asked", "_dialler", "_keepalive", "_willing_since", "holding")

    def __init__(self, keepalive: Keepalive, *, dialler: bool) -> None:
        self._keepalive = keepalive
        self._dialler = dialler
        self._willing_since: float | None = None
        self._asked = False
        self.holding = False
        """Acceptor: whether it has agreed, and sends nothing until the dialler has decided."""

    @property
    def _willing(self) -> bool:
        return self._keepalive.parks and self._keepalive.remote_parks

    @property
    def flags(self) -> PaceFlag:
        """What this side says in a pace frame."""
        parting = self._asked or self.holding
        return self._keepalive.flags | (PaceFlag.PARTING if parting else PaceFlag(0))

    def changed(self, now: float) -> None:
        """This side began or ceased to need the connection, or to be willing to part."""
        if not self._willing:
            self._willing_since, self._asked = None, False
        elif self._willing_since is None:
            self._willing_since = now

    def paced(self, flags: int, now: float) -> PartingStep:
        """Take the bits of a received pace frame, which the keepalive has taken already."""
        self.changed(now)
        parting = bool(flags & PaceFlag.PARTING) and self._keepalive.remote_parks
        if self._dialler:
            return PartingStep.PART if parting and self._asked else PartingStep.NOTHING
        if self.holding and not parting:
            self.holding = False
            return PartingStep.GO_ON
        if parting and not self.holding and self._keepalive.parks:
            self.holding = True
            return PartingStep.ANSWER
        return PartingStep.NOTHING

    def ask(self, now: float) -> bool:
        """Whether the dialler is to ask now; at most once while both sides stay willing."""
        since = self._willing_since
        if not self._dialler or self._asked or since is None or now - since < limits.PARK_AFTER:
            return False
        self._asked = True
        return True
