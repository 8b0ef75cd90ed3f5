"""The actions that the bridge's machines return to their driver, as frozen values.

``peer`` is the number of a peer's session. It stays the same when the peer's link comes back, and is never used for
another run of a peer.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

from rmpa.bridge import limits
from rmpa.core import limits as core_limits

if TYPE_CHECKING:
    from rmpa.bridge.messages import Description, Message, Origin, Source
    from rmpa.core.contract import Contract


@dataclass(frozen=True, slots=True)
class Send:
    """Send a control message to a peer."""

    peer: int
    message: Message


# --- outbound: from the local graph to the peers ---------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Connect:
    """Subscribe to a local publisher, at its slave API's address."""

    source: Source
    type: str
    uri: str


@dataclass(frozen=True, slots=True)
class Disconnect:
    """Disconnect from a local publisher, and drop its routes."""

    source: Source


@dataclass(frozen=True, slots=True)
class AddRoute:
    """Begin to send a source's messages to a peer; first the kept ones, if its contract or publisher keeps any.

    Args:
        source: Which.
        peer: The peer's number.
        route: The route's id.
        contract: The contract in force.
        epoch: Identifies the numbering of a reliable route; 0 for best effort.
        after: To continue a suspended route: the last message of the epoch that the peer has. ``None``: a new
            numbering.
    """

    source: Source
    peer: int
    route: int
    contract: Contract
    epoch: int = 0
    after: int | None = None


@dataclass(frozen=True, slots=True)
class RemoveRoute:
    """End a source's route to a peer, and drop its waiting messages.

    Args:
        source: Which.
        peer: The peer's number.
        route: The route's id; 0 for a suspended route.
    """

    source: Source
    peer: int
    route: int


@dataclass(frozen=True, slots=True)
class SuspendRoute:
    """Keep the unacknowledged and all further messages of a route, until its peer has a link again.

    Args:
        source: Which.
        peer: The peer's number.
        outage: Seconds for which the messages are kept; after that the route ends.
    """

    source: Source
    peer: int
    outage: float = core_limits.RESUME_WINDOW


# --- inbound: from a peer to the local graph -------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Publish:
    """Publish a peer's source in the local graph.

    Args:
        peer: The peer's number.
        source: The source, by its wire name.
        type: Its message type.
        topic: Its topic in the local graph; empty: the same name.
        origin: Its module and node, if its peer only relays it.
    """

    peer: int
    source: Source
    type: str
    topic: str = ""
    origin: Origin | None = None


@dataclass(frozen=True, slots=True)
class Retract:
    """Remove a peer's source from the local graph: unregister it and close its sockets."""

    peer: int
    source: Source


@dataclass(frozen=True, slots=True)
class Describe:
    """Prepare for data on a newly opened route, and answer the waiting local subscribers with its description.

    Args:
        peer: The peer's number.
        source: Which.
        route: The route's id.
        description: The header of the source's publisher.
        contract: The contract of the route.
        epoch: Identifies the numbering of a reliable route; 0 for best effort.
        first: The numbering's first sequence.
        following: If the numbering goes on: the next message's sequence; ``None``: the peer did not report it.
        unknown: Whether an earlier run of this agent may have missed messages.
    """

    peer: int
    source: Source
    route: int
    description: Description
    contract: Contract
    epoch: int = 0
    first: int = 1
    following: int | None = None
    unknown: bool = False


@dataclass(frozen=True, slots=True)
class Detach:
    """End a route's data; unless ``keep``, the latched message is forgotten (a new route brings it again).

    Args:
        peer: The peer's number.
        source: Which.
        route: The route's id.
        keep: The link is gone, and the next one will continue after the last message that came.
        missed: Local nodes still listen, so they miss what is published before a route is open again.
        last: If the publisher has gone: the sequence of its last message.
    """

    peer: int
    source: Source
    route: int
    keep: bool = False
    missed: bool = False
    last: int | None = None


@dataclass(frozen=True, slots=True)
class Warn:
    """Log a warning about ``who``; ``kind`` is the counter's name."""

    kind: str
    who: str
    text: str


Outgoing = Connect | Disconnect | AddRoute | SuspendRoute | RemoveRoute
Incoming = Publish | Retract | Describe | Detach
Action = Send | Outgoing | Incoming | Warn


# When the next portion of a catalogue is sent to a peer.
#
# Commands share the lane with advertisements, and must not wait until a whole catalogue has been sent.


class Pacing:
    """The time of the last portion for each peer. Topics and services have one instance each."""

    def __init__(self) -> None:
        self._told: dict[int, float] = {}

    def ready(self, peer: int, now: float, *, busy: bool) -> bool:
        """Return whether a portion may be sent to a peer now; if so, remember ``now`` as the time of its last one.

        On a busy lane a portion waits, but no longer than ``limits.TELL_PATIENCE`` after the one before.

        Args:
            peer: The peer's number.
            now: Monotonic seconds.
            busy: Whether the portion would have to wait on the lane.
        """
        if busy and now - self._told.get(peer, -math.inf) < limits.TELL_PATIENCE:
            return False
        self._told[peer] = now
        return True

    def forget(self, peer: int) -> None:
        """Drop what is remembered of a peer whose session has ended."""
        self._told.pop(peer, None)
