"""The actions that the two plans of services return to their driver, as frozen values.

Like ``bridge.actions`` for topics. ``ExportAction`` has those of services of this module that peers call,
``ImportAction`` those of peers' services that local nodes call. ``peer`` is the number of a peer's session.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from rmpa.bridge.actions import Send, Warn

if TYPE_CHECKING:
    from rmpa.bridge.messages import Origin


@dataclass(frozen=True, slots=True)
class LocalService:
    """A service's server in the local graph: its node, its ``rosrpc://`` address, and its origin if relayed."""

    node: str
    uri: str
    origin: Origin | None = None


@dataclass(frozen=True, slots=True)
class ServiceAbout:
    """The type, MD5 sum, request type and response type of a service, as its server states them."""

    type: str
    md5: str
    request_type: str = ""
    response_type: str = ""


@dataclass(frozen=True, slots=True)
class Probe:
    """Ask a local server for its ``ServiceAbout``; the answer goes to ``described`` or ``refused``."""

    service: str
    server: LocalService


@dataclass(frozen=True, slots=True)
class ServeRoute:
    """Serve a peer's calls: requests come in on the route ``requests``, replies go out on ``route``.

    Args:
        peer: The number of the calling peer.
        route: The route of replies; the calling peer has chosen its number.
        requests: The route of requests; this module has chosen its number.
        service: The service's local name.
        server: The service's server in the local graph.
        timeout: Seconds that the calling peer waits for each reply.
    """

    peer: int
    route: int
    requests: int
    service: str
    server: LocalService
    timeout: float


@dataclass(frozen=True, slots=True)
class EndRoute:
    """End an open route: no more requests come, and replies of calls under way are dropped."""

    peer: int
    route: int
    requests: int


@dataclass(frozen=True, slots=True)
class ServerGone:
    """The server of a service left or was replaced: close the connections to it."""

    service: str


ExportAction = Send | Warn | Probe | ServeRoute | EndRoute | ServerGone


@dataclass(frozen=True, slots=True)
class Provide:
    """Register a peer's service in the local graph, at the proxy of the node that provides it.

    Args:
        peer: The peer's number.
        service: The service's name here.
        node: Its node, in the peer's graph.
    """

    peer: int
    service: str
    node: str


@dataclass(frozen=True, slots=True)
class Withdraw:
    """Remove a peer's service from the local graph; its waiting calls fail with the reason."""

    peer: int
    service: str
    node: str
    reason: str


@dataclass(frozen=True, slots=True)
class OpenedService:
    """A service can be called: requests go out on ``requests``, replies come in on ``route``."""

    peer: int
    service: str
    route: int
    requests: int
    about: ServiceAbout


@dataclass(frozen=True, slots=True)
class EndedService:
    """A service cannot be called, or no longer: its calls fail with the reason; ``route`` was that of its replies."""

    peer: int
    service: str
    route: int
    requests: int
    reason: str


@dataclass(frozen=True, slots=True)
class ForgetAbout:
    """What is known of a shown service may no longer be true."""

    peer: int
    service: str


ImportAction = Send | Warn | Provide | Withdraw | OpenedService | EndedService | ForgetAbout
