"""The gateways: the subprotocol that a client offers chooses, and the pages have a path of their own."""

from __future__ import annotations

import asyncio
import functools
import logging
import secrets
import time
from collections import Counter
from typing import TYPE_CHECKING, Final

from aiohttp import web

from rmpa.core.counters import Counters, RefusalLog
from rmpa.core.errors import PeerRefused
from rmpa.web import limits
from rmpa.web.foxglove.protocol import SUBPROTOCOLS, choose_subprotocol
from rmpa.web.gateways.figures import PROTOCOLS, GatewayFigures
from rmpa.web.gateways.foxglove import FoxgloveConnection
from rmpa.web.gateways.frame_writer import FrameSocket
from rmpa.web.gateways.monitor import MonitorConnection
from rmpa.web.gateways.rosbridge import RosbridgeConnection
from rmpa.web.monitor import limits as monitor_limits
from rmpa.web.monitor.messages import SUBPROTOCOL
from rmpa.web.rosbridge import limits as rosbridge_limits
from rmpa.web.rosbridge.encodings import PublishFrames

if TYPE_CHECKING:
    from collections.abc import Callable

    from rmpa.web.gateways.connection import ClientConnection
    from rmpa.web.hub.hub import Hub
    from rmpa.web.hub.rights import Rights
    from rmpa.web.monitor.io.monitor import Monitor

MONITOR_PATH: Final = "/monitor"
_log = logging.getLogger(__name__)


def is_upgrade(request: web.BaseRequest) -> bool:
    """Whether a request asks for a WebSocket."""
    return request.headers.get("Upgrade", "").lower() == "websocket"


_GOING_AWAY: Final = 1001
"""A WebSocket's close code, RFC 6455, section 7.4.1."""


class Gateways:
    """Serves WebSocket clients; its ``handle`` is the handler of one or more paths.

    Args:
        hub: The hub.
        name: The server's name, for users.
        rights: What clients may do.
        priority: The priority of a topic's messages: higher ones go first.
        monitor: Serves the pages at ``MONITOR_PATH``; without it there are none.
    """

    def __init__(
        self,
        hub: Hub,
        name: str,
        rights: Rights,
        priority: Callable[[str], int] = lambda _: 0,
        monitor: Monitor | None = None,
    ) -> None:
        self.counters = Counters()
        """Clients that were refused or disconnected, by the words of ``figures.REASONS``."""
        self._refusals = RefusalLog(_log, self.counters)
        self.upgraded: Callable[[web.Request, Callable[[], None]], Callable[[], int]] = lambda *_: int
        """Called when the handshake of a WebSocket is done, with what is to be called if a frame of the client is not
        masked; returns a counter of the bytes that its client has sent, which is 0 where they are not counted."""
        self._monitor = monitor
        self._hub = hub
        self._name = name
        self._rights = rights
        self._priority = priority
        self._session_id = secrets.token_hex(8)
        self._frames = PublishFrames()
        self._open: dict[ClientConnection, FrameSocket] = {}
        self._sent: Counter[str] = Counter()
        self._dropped: Counter[str] = Counter()

    @property
    def connections(self) -> tuple[ClientConnection, ...]:
        """All clients, with their queues."""
        return tuple(self._open)

    def figures(self) -> dict[str, GatewayFigures]:
        """What each gateway counts."""
        found = {}
        for kind in PROTOCOLS:
            present = [each for each in self._open if each.kind == kind]
            found[kind] = GatewayFigures(
                clients=len(present),
                queued=sum(each.queue.bytes for each in present),
                sent=self._sent[kind] + sum(each.sent for each in present),
                dropped=self._dropped[kind] + sum(each.queue.dropped_total for each in present),
            )
        return found

    async def handle(self, request: web.Request) -> web.StreamResponse:
        """Serve one client until it has gone."""
        offered = [name.strip() for name in request.headers.get("Sec-WebSocket-Protocol", "").split(",")]
        protocol = choose_subprotocol(offered)
        address = request.remote or "?"
        connection: ClientConnection
        if request.path == MONITOR_PATH:
            if self._monitor is None or SUBPROTOCOL not in offered:
                text = f"pages speak {SUBPROTOCOL} here; see /rosbridge"
                self.refuse(address, "handshake", text)
                return web.Response(status=400, text=f"{text}\n")
            await self._monitor.ready()
            connection = MonitorConnection(self._hub, self._rights, self._priority, address, monitor=self._monitor)
            return await self._serve(request, connection, monitor_limits.REQUEST_MAX + 1)
        await self._hub.settled(limits.SETTLE)
        rights = self._rights
        # Only who sends data has a use for large messages: what aiohttp gathers of one is kept until its end.
        if protocol is not None:
            connection = FoxgloveConnection(
                self._hub, rights, self._priority, address, name=self._name, session_id=self._session_id
            )
            most = limits.FOXGLOVE_BINARY_MAX if rights.control else limits.FOXGLOVE_TEXT_MAX
        else:
            connection = RosbridgeConnection(self._hub, rights, self._priority, address, frames=self._frames)
            most = rosbridge_limits.FRAME_MAX if rights.control else limits.FOXGLOVE_TEXT_MAX
        return await self._serve(request, connection, most)

    async def _serve(self, request: web.Request, connection: ClientConnection, most: int) -> web.StreamResponse:
        response = FrameSocket(
            protocols=(*SUBPROTOCOLS, SUBPROTOCOL),
            autoping=False,
            compress=False,
            max_msg_size=most,
            timeout=limits.CLOSE_TIMEOUT,
        )

        def upgraded(request: web.Request) -> Callable[[], int]:
            return self.upgraded(request, connection.unmasked)

        self._open[connection] = response
        try:
            refused = functools.partial(self._refuse_client, connection)
            await connection.run(request, response, upgraded, refused)
        except PeerRefused as error:
            self.refuse(connection.address, "clients", str(error))
            return web.Response(status=503, text=f"{error}\n")
        except Exception:
            if not response.prepared:
                raise
            _log.exception("! serving %s failed", connection.address)  # a response in HTTP cannot be sent any more
        finally:
            del self._open[connection]
            self._sent[connection.kind] += connection.sent
            self._dropped[connection.kind] += connection.queue.dropped_total
        return response

    def refuse(self, address: str, reason: str, text: str) -> None:
        """Count and log why a client is refused or disconnected.

        Args:
            address: The client's.
            reason: One of ``figures.REASONS``.
            text: What happened, for the log.
        """
        self._refusals.refuse(time.monotonic(), reason, address, f"{address}: {text}")

    def _refuse_client(self, connection: ClientConnection, reason: str, text: str) -> None:
        self.refuse(connection.address, reason, f"a client of {connection.kind} is disconnected: {text}")

    async def close(self) -> None:
        """Tell all clients that the server ends."""
        clients = [each for each in self._open.values() if each.prepared]
        closing = [each.close(code=_GOING_AWAY, message=b"the server ends") for each in clients]
        await asyncio.gather(*closing, return_exceptions=True)
