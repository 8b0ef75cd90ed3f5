"""What decides how a route's messages go: the lane, with a fence at each change, and the rate. Pure.

Chooses the lane of a route's messages, and keeps their order when it changes.

Sans-I/O. A contract's priority decides, else the size of the messages: one large message moves a topic to the bulk
lane, a long series of small ones brings it back. Two connections have no common order. Therefore a *fence* is sent
after the last message on the present lane, and messages are held until the peer has answered it; then the other lane
is used::

    ON(express) ──large──► FENCING(express → bulk) ──fenced──► ON(bulk)
         ▲                                                        │ small, for long
         └────fenced──── FENCING(bulk → express) ◄────────────────┘

A new route begins on the express lane, after the control frame that opens it.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final, NamedTuple

from rmpa.core.contract import Contract, History, Priority
from rmpa.mesh import limits
from rmpa.mesh.frames import Lane

if TYPE_CHECKING:
    from rmpa.mesh.reliable import Outgoing

EXPRESS: Final = Lane.EXPRESS
BULK: Final = Lane.BULK


def kept_for(contract: Contract) -> int:
    """How many messages a contract keeps while they cannot be sent."""
    return limits.KEEP_ALL_MESSAGES if contract.history is History.KEEP_ALL else contract.queue_depth


class RouteBegin(NamedTuple):
    """Where a route begins.

    Args:
        epoch: Its numbering; 0 if its numbers mean nothing beyond it.
        first: The sequence of its first message.
        goes_on: Whether the peer has what is before ``first``, or misses it for good.
        kept: The messages to be sent at once.
        resumed: Whether a suspended sender goes on.
    """

    epoch: int
    first: int
    goes_on: bool = False
    kept: tuple[Outgoing, ...] = ()
    resumed: bool = False


class LaneSwitch:
    """The lane of one route.

    Args:
        contract: The contract of the route; only its priority is used.
        large: Whether the source is known to have large messages.

    Attributes:
        lane: The present lane; while fencing, the lane of the last messages.
        target: The lane that messages should use.
    """

    def __init__(self, contract: Contract, *, large: bool = False) -> None:
        self._fixed = {Priority.HIGH: EXPRESS, Priority.LOW: BULK}.get(contract.priority)
        self._large_at = 0.0
        self._small = 0
        self._numbers = 0
        self._fence = 0
        self.lane = EXPRESS
        self.target = BULK if self._fixed is BULK or (large and self._fixed is None) else EXPRESS

    @property
    def fencing(self) -> bool:
        """Whether messages must be held."""
        return bool(self._fence)

    def judge(self, size: int, now: float) -> bool:
        """Consider the size of the next message; return whether the lane must change before it is sent."""
        if self._fixed is None:
            if size > limits.EXPRESS_MESSAGE_MAX:
                self._small = 0
                self._large_at = now
                self.target = BULK
            elif self.target is BULK:
                self._small += 1
                row = self._small >= limits.EXPRESS_AGAIN_MESSAGES
                if row and now - self._large_at >= limits.EXPRESS_AGAIN_AFTER:
                    self.target = EXPRESS
        return self.target is not self.lane

    def fence(self) -> int:
        """Begin to change the lane; return the number of the fence to be sent on the present lane."""
        self._numbers += 1
        self._fence = self._numbers
        return self._fence

    def fenced(self, number: int) -> bool:
        """The peer has answered a fence; return whether it was the last one, so that the target lane is used now."""
        if number != self._fence or not number:
            return False
        self._fence = 0
        self.lane = self.target
        return True

    def lane_lost(self) -> bool:
        """The bulk lane's connection is gone; return whether the target lane is used now.

        What was on that connection does not arrive any more, so it cannot be overtaken.
        """
        if self._fence and self.lane is BULK:
            return self.fenced(self._fence)
        return False

    def restart(self) -> None:
        """Go back to the express lane, on which the routes of a new link begin."""
        self._fence = 0
        self.lane = EXPRESS


class Downsampler:
    """Admits at most ``rate`` messages a second of one route; pure.

    Args:
        rate: Messages a second.

    Attributes:
        due: When the next message may be sent, monotonic seconds.
    """

    def __init__(self, rate: float) -> None:
        self._period = 1 / rate
        self.due = 0.0

    def admit(self, now: float) -> bool:
        """Whether a message may be sent now; if so, the next one is due a period later."""
        # A tenth of the period early is on time: two clocks at the same rate must not lose every other message.
        if now < self.due - self._period / 10:
            return False
        # Keep the phase while messages come faster than the rate; restart it after a pause.
        self.due = max(self.due + self._period, now)
        if self.due < now + self._period / 2:
            self.due = now + self._period
        return True
