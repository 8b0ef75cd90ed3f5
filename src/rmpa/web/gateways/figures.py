"""What the gateways count, for ``/metrics``; no I/O."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

PROTOCOLS: Final = ("foxglove", "monitor", "rosbridge")
"""The gateways, as ``ClientConnection.kind`` names them."""
REASONS: Final = ("handshake", "clients", "message", "message_size", "message_rate")
"""Why WebSocket clients are refused or disconnected, as counted: a handshake that is malformed or asks for another
protocol; too many clients; a malformed frame or message, or one that does not end; one that is too long; too many in
a second."""


@dataclass(frozen=True, slots=True)
class GatewayFigures:
    """The clients of one gateway.

    Attributes:
        clients: Connected at present.
        queued: Bytes that wait for them.
        sent: Messages and answers written so far, to those that have gone too.
        dropped: Messages dropped so far because a client was slow, likewise.
    """

    clients: int = 0
    queued: int = 0
    sent: int = 0
    dropped: int = 0
