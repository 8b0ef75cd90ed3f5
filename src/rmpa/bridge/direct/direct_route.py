"""One local subscriber of one remote source: its state, and the actions of the machine that decides about it. Pure.

The machine is ``DirectSubscriptions`` (``bridge.direct.subscriber_side``).
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass, field
from enum import Enum, auto
from typing import TYPE_CHECKING, NamedTuple

from rmpa.bridge import limits

if TYPE_CHECKING:
    from rmpa.bridge.direct.conditions import Grant, Unmet
    from rmpa.bridge.messages import Source
    from rmpa.core.contract import Transport


class DirectKey(NamedTuple):
    """One local subscriber of one remote source.

    Args:
        peer: The number of the peer's session.
        source: The source, by its wire name.
        subscriber: The subscribing node.
    """

    peer: int
    source: Source
    subscriber: str


class DirectState(Enum):
    """The decision about a subscriber."""

    ASKING = auto()
    """The peer's agent is asked."""
    PROBING = auto()
    """The peer allows it; the publisher's port is probed."""
    DIRECT = auto()
    """It may connect to the publisher."""
    RELAYED = auto()
    """A condition does not hold."""


class Path(Enum):
    """The answer that a subscriber's last ``requestTopic`` got."""

    NONE = auto()
    """None yet, or it has hung up since."""
    RELAY = auto()
    """The proxy's own address."""
    DIRECT = auto()
    """The publisher's address."""


@dataclass(slots=True)
class DirectRoute:
    """The state of one subscriber.

    Args:
        wanted: The transport that this module's contract asks for.
        state: The decision.
        unmet: Why it is relayed; ``None`` in other states.
        local: Whether ``unmet`` was found here, not at the peer.
        grant: The peer's permission, from ``PROBING`` on.
        path: What the subscriber was last answered.
        endpoint: The address and port of that answer, if it was direct.
        stranded: Whether it was made to hang up, so that it must be called back.
        attempt: Counts the requests to the peer, to tell their responses apart.
        since: When the state began, monotonic seconds.
        breaks: When its direct connections broke, monotonic seconds.
        answered_at: When it was last answered, monotonic seconds.
        held: Whether the peer may hold a grant for it.
        asked_at: When the peer was last asked, monotonic seconds.
        doubtful: Whether a notification of the peer came while it was asked, so that its response may be outdated.
        stuck: Why its direct connection cannot be ended although it has to be relayed; empty: it can.
    """

    wanted: Transport
    state: DirectState
    unmet: Unmet | None = None
    local: bool = False
    grant: Grant | None = None
    path: Path = Path.NONE
    endpoint: tuple[str, int] | None = None
    stranded: bool = False
    attempt: int = 0
    since: float = 0.0
    breaks: deque[float] = field(default_factory=lambda: deque(maxlen=limits.DIRECT_BREAKS))
    answered_at: float = 0.0
    held: bool = False
    asked_at: float = -math.inf
    doubtful: bool = False
    stuck: str = ""

    def allows(self, endpoint: tuple[str, int] | None) -> bool:
        """Whether a direct connection to this address and port is what was decided."""
        if self.state is not DirectState.DIRECT or self.grant is None or endpoint is None:
            return False
        return endpoint[1] == self.grant.port


@dataclass(slots=True)
class Interruption:
    """That a subscriber was without its direct path: what was published meanwhile is lost to it, and not counted.

    Args:
        count: How often.
        began: When the last one began, monotonic seconds.
        ended: When it ended; ``None`` while it lasts.
    """

    count: int
    began: float
    ended: float | None = None


class Interruptions:
    """The interruptions of direct paths, by the peer's name, the source and the subscriber. They outlast links."""

    def __init__(self) -> None:
        self._all: dict[tuple[str, Source, str], Interruption] = {}

    def get(self, peer: str, source: Source, subscriber: str) -> Interruption | None:
        """The interruptions of one subscriber; ``None``: there was none."""
        return self._all.get((peer, source, subscriber))

    def begin(self, peer: str, source: Source, subscriber: str, now: float) -> None:
        """Note that a path is gone; does nothing while it was gone already."""
        key = (peer, source, subscriber)
        before = self._all.pop(key, None)
        if before is not None and before.ended is None:
            self._all[key] = before
            return
        self._all[key] = Interruption(before.count + 1 if before is not None else 1, now)
        if len(self._all) > limits.DIRECT_MAX:
            del self._all[next(iter(self._all))]

    def end(self, peer: str, source: Source, subscriber: str, now: float) -> None:
        """Note that a subscriber has a path again, direct or relayed."""
        found = self._all.get((peer, source, subscriber))
        if found is not None and found.ended is None:
            found.ended = now


@dataclass(frozen=True, slots=True)
class Ask:
    """Ask the peer for a grant; pass the response to ``replied`` with this attempt."""

    key: DirectKey
    attempt: int


@dataclass(frozen=True, slots=True)
class ProbeNode:
    """Try to connect to the node of a grant; pass the outcome to ``probed``."""

    peer: int
    grant: Grant


@dataclass(frozen=True, slots=True)
class Decided:
    """Answer the subscriber's ``requestTopic`` if it waits."""

    key: DirectKey


@dataclass(frozen=True, slots=True)
class Move:
    """Make the subscriber hang up if it is connected, and call it back; see ``hung_up``."""

    key: DirectKey


@dataclass(frozen=True, slots=True)
class HangUp:
    """End the subscriber's direct connection; it is called back by a later ``Move``.

    Args:
        key: The subscriber.
        endpoint: The address and port of its connection.
    """

    key: DirectKey
    endpoint: tuple[str, int]


@dataclass(frozen=True, slots=True)
class Release:
    """Tell the peer that the subscriber does not use its grant any more.

    Args:
        key: The subscriber.
        broken: Whether its connection broke, so that the publisher may be dead.
    """

    key: DirectKey
    broken: bool = False


@dataclass(frozen=True, slots=True)
class Fallback:
    """Warn: this module's contract says ``direct``, and a condition does not hold."""

    key: DirectKey
    unmet: Unmet


DirectAction = Ask | ProbeNode | Decided | Move | HangUp | Release | Fallback
