"""What the bridge's machines ask their driver to do; frozen values, acted on elsewhere.

``peer`` is a number that the driver gave to one link; it is never used again for another one.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rmpa.bridge.messages import Description, Message, Source


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
    """Send a source's messages to a peer from now on; first its latched one, where there is one."""

    source: Source
    peer: int
    route: int


@dataclass(frozen=True, slots=True)
class RemoveRoute:
    """Send a source's messages to a peer no longer, and drop what waits."""

    source: Source
    peer: int
    route: int


# --- inbound: from a peer to the local graph -------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Publish:
    """Let a peer's source appear in the local graph."""

    peer: int
    source: Source
    type: str


@dataclass(frozen=True, slots=True)
class Retract:
    """Let it disappear: unregister and close its sockets."""

    peer: int
    source: Source


@dataclass(frozen=True, slots=True)
class Describe:
    """Tell the waiting local subscribers what the messages are; from now on data comes on ``route``."""

    peer: int
    source: Source
    route: int
    description: Description


@dataclass(frozen=True, slots=True)
class Detach:
    """No more data comes on this route; forget the latched message (a new route brings it again)."""

    peer: int
    source: Source
    route: int


@dataclass(frozen=True, slots=True)
class Warn:
    """Tell the user; ``kind`` is the name of the count."""

    kind: str
    who: str
    text: str


Action = Send | Connect | Disconnect | AddRoute | RemoveRoute | Publish | Retract | Describe | Detach | Warn
