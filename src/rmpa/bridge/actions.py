"""What the bridge's machines ask their driver to do; frozen values, acted on elsewhere.

``peer`` is a number that the driver gave to one run of a peer. It stays the same when its link comes back,
and is never used again for another one.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from rmpa.core import limits

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
    """Leave a local publisher."""

    source: Source


@dataclass(frozen=True, slots=True)
class AddRoute:
    """Send a source's messages to a peer from now on; first its latched one, where there is one.

    Args:
        source: Which.
        peer: The peer's number.
        route: The route's id.
        contract: What holds for it.
        epoch: Names the numbering of a reliable route.
        after: The peer has all up to this message of the epoch already, and a suspended route goes on; ``None``: a
            new one.
    """

    source: Source
    peer: int
    route: int
    contract: Contract
    epoch: int = 0
    after: int | None = None


@dataclass(frozen=True, slots=True)
class RemoveRoute:
    """Send a source's messages to a peer no longer, and drop what waits.

    Args:
        source: Which.
        peer: The peer's number.
        route: The route's id; 0: one that was suspended.
        wished: Whether the peer wants no more of it; else it may ask what it missed.
        over: Whether nothing more is published that it could miss until it asks again.
    """

    source: Source
    peer: int
    route: int
    wished: bool = False
    over: bool = False


@dataclass(frozen=True, slots=True)
class SuspendRoute:
    """The peer's link is gone; keep what it has not acknowledged, and what comes, until it is back.

    Args:
        source: Which.
        peer: The peer's number.
        outage: Seconds for which it is kept; after them it is only counted.
    """

    source: Source
    peer: int
    outage: float = limits.RESUME_WINDOW


# --- inbound: from a peer to the local graph -------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Publish:
    """Let a peer's source appear in the local graph.

    Args:
        peer: The peer's number.
        source: Which, by the name that its peer has for it.
        type: Its message type.
        topic: What it is called here; empty: the same.
        origin: Its module and node, if its peer only passes it on.
    """

    peer: int
    source: Source
    type: str
    topic: str = ""
    origin: Origin | None = None


@dataclass(frozen=True, slots=True)
class Retract:
    """Let it disappear: unregister and close its sockets."""

    peer: int
    source: Source


@dataclass(frozen=True, slots=True)
class Describe:
    """Tell the waiting local subscribers what the messages are; from now on data comes on ``route``.

    Args:
        peer: The peer's number.
        source: Which.
        route: The route's id.
        description: What the messages are.
        contract: What holds for the route.
        epoch: Names the numbering of a reliable route.
        first: Its first sequence.
        following: The next message's sequence, where a numbering goes on; ``None``: the peer did not say.
        lost: Messages of earlier numberings that never came, where one begins anew; ``None``: the peer does not know.
        at_least: Whether more may be lost than that.
    """

    peer: int
    source: Source
    route: int
    description: Description
    contract: Contract
    epoch: int = 0
    first: int = 1
    following: int | None = None
    lost: int | None = None
    at_least: bool = False


@dataclass(frozen=True, slots=True)
class Detach:
    """No more data comes on this route; forget the latched message (a new route brings it again).

    Args:
        peer: The peer's number.
        source: Which.
        route: The route's id.
        keep: The link is gone, and a new one will go on behind the last message that came.
        missed: Local nodes listen all the same: what is not received until a route is open again counts as lost.
    """

    peer: int
    source: Source
    route: int
    keep: bool = False
    missed: bool = False


@dataclass(frozen=True, slots=True)
class Warn:
    """Tell the user; ``kind`` is the name of the count."""

    kind: str
    who: str
    text: str


Outgoing = Connect | Disconnect | AddRoute | SuspendRoute | RemoveRoute
Incoming = Publish | Retract | Describe | Detach
Action = Send | Outgoing | Incoming | Warn
