"""WebSocket clients: the subprotocol that a client offers chooses, and the pages have a path of their own."""

from __future__ import annotations

import asyncio
import functools
import logging
import time
from collections import Counter
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from aiohttp import WSCloseCode, web

from rmpa.core.errors import PeerRefused
from rmpa.core.log import RefusalLog
from rmpa.core.statistics import Counters
from rmpa.runtime.tasks import start_task
from rmpa.web import limits
from rmpa.web.foxglove import limits as foxglove_limits
from rmpa.web.foxglove.channels import ChannelTable
from rmpa.web.foxglove.protocol import SUBPROTOCOLS
from rmpa.web.foxglove.session import FoxgloveSession
from rmpa.web.hub.frame_writer import FrameSocket
from rmpa.web.monitor.messages import SUBPROTOCOL
from rmpa.web.monitor.session import MonitorSession
from rmpa.web.rosbridge.session import RosbridgeSession

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from rmpa.web.hub.connection import ClientConnection, Session
    from rmpa.web.hub.hub import Hub
    from rmpa.web.hub.node_link import Rights
    from rmpa.web.monitor.monitor import Monitor


_log = logging.getLogger(__name__)
# Our own protocols, as ``Session.kind`` names them.
PROTOCOLS: Final = ("foxglove", "monitor", "rosbridge")
# Why WebSocket clients are refused or disconnected, as counted: a handshake that is malformed or asks for another
# protocol; too many clients; a malformed frame or message, or one that does not end; one that is too long; too many
# in a second.
CLIENT_REFUSALS: Final = ("handshake", "clients", "message", "message_size", "message_rate")


@dataclass(frozen=True, slots=True)
class ClientFigures:
    """The clients of one protocol.

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


MONITOR_PATH: Final = "/monitor"


def is_upgrade(request: web.BaseRequest) -> bool:
    """Whether a request asks for a WebSocket."""
    return request.headers.get("Upgrade", "").lower() == "websocket"


class WebSocketClients:
    """Serves WebSocket clients; its ``handle`` is the handler of one or more paths.

    Args:
        hub: The hub.
        name: The server's name, for users.
        rights: What clients may do.
        monitor: Serves the pages at ``MONITOR_PATH``; without it there are none.
        others: Further protocols.
    """

    def __init__(
        self,
        hub: Hub,
        name: str,
        rights: Rights,
        monitor: Monitor | None = None,
        others: Sequence[type[Session]] = (),
    ) -> None:
        # Clients that were refused or disconnected, by the words of ``CLIENT_REFUSALS``.
        self.counters = Counters()
        self._refusals = RefusalLog(_log, self.counters)
        self._monitor = monitor
        self._hub = hub
        self._rights = rights
        self._channels = ChannelTable(hub, name, services=rights.control)
        foxglove = functools.partial(FoxgloveSession, table=self._channels)
        # By the subprotocol that a client offers; empty for none.
        self._protocols: dict[str, Callable[[Hub, Rights, str], Session]] = {
            **{name: other for other in others for name in other.subprotocols},
            **dict.fromkeys(SUBPROTOCOLS, foxglove),
            "": RosbridgeSession,
        }
        self._kinds = *PROTOCOLS, *(other.kind for other in others)
        self._open: dict[Session, FrameSocket] = {}
        self._sent: Counter[str] = Counter()
        self._dropped: Counter[str] = Counter()

    @property
    def connections(self) -> tuple[ClientConnection, ...]:
        """All clients, with their queues."""
        return tuple(session.connection for session in self._open)

    def figures(self) -> dict[str, ClientFigures]:
        """What each protocol counts."""
        found = {}
        for kind in self._kinds:
            present = [each.connection for each in self._open if each.kind == kind]
            found[kind] = ClientFigures(
                clients=len(present),
                queued=sum(each.queue.bytes for each in present),
                sent=self._sent[kind] + sum(each.sent for each in present),
                dropped=self._dropped[kind] + sum(each.queue.dropped_total for each in present),
            )
        return found

    async def handle(self, request: web.Request) -> web.StreamResponse:
        """Serve one client, whose request asks for the WebSocket, until it has gone."""
        lines = request.headers.getall("Sec-WebSocket-Protocol", ())
        offered = [name.strip() for name in ",".join(lines).split(",") if name.strip()]
        address = request.remote or "?"
        if request.path == MONITOR_PATH:
            if self._monitor is None or SUBPROTOCOL not in offered:
                return self._refuse_protocol(address, f"pages speak {SUBPROTOCOL} here; see /rosbridge")
            await self._monitor.first()
            page = MonitorSession(self._hub, self._rights, address, self._monitor)
            return await self._serve(request, page, page.frame_max)
        chosen = next((name for name in offered if name in self._protocols), None if offered else "")
        if chosen is None:
            spoken = f"{', '.join(filter(None, self._protocols))}, and rosbridge without a subprotocol"
            return self._refuse_protocol(address, f"{', '.join(offered)[:80]!a} is not spoken here: {spoken} are")
        await self._hub.settled(limits.SETTLE)
        session = self._protocols[chosen](self._hub, self._rights, address)
        # Only a client that sends data has a use for large messages: aiohttp keeps what it has gathered to the end.
        most = session.frame_max if self._rights.control else foxglove_limits.TEXT_MAX
        return await self._serve(request, session, most)

    def _refuse_protocol(self, address: str, text: str) -> web.Response:
        self.refuse(address, "handshake", text)
        return web.Response(status=400, text=f"{text}\n")

    async def _serve(self, request: web.Request, session: Session, most: int) -> web.StreamResponse:
        response = FrameSocket(
            protocols=(*filter(None, self._protocols), SUBPROTOCOL),
            autoping=False,
            compress=False,
            max_msg_size=most,
            timeout=limits.CLOSE_TIMEOUT,
        )
        self._open[session] = response
        try:
            refused = functools.partial(self._refuse_client, session)
            await session.connection.run(request, response, refused)
        except PeerRefused as error:
            self.refuse(session.address, "clients", str(error))
            return web.Response(status=503, text=f"{error}\n")
        except Exception:
            if not response.prepared:
                raise
            _log.exception("! serving %s failed", session.address)  # a response in HTTP cannot be sent any more
        finally:
            del self._open[session]
            self._sent[session.kind] += session.connection.sent
            self._dropped[session.kind] += session.connection.queue.dropped_total
        return response

    def refuse(self, address: str, reason: str, text: str) -> None:
        """Count and log why a client is refused or disconnected.

        Args:
            address: The client's.
            reason: One of ``CLIENT_REFUSALS``.
            text: What happened, for the log.
        """
        self._refusals.refuse(time.monotonic(), reason, address, f"{address}: {text}")

    def _refuse_client(self, session: Session, reason: str, text: str) -> None:
        self.refuse(session.address, reason, f"a client of {session.kind} is disconnected: {text}")

    async def close(self) -> None:
        """Tell all clients that the server ends."""
        clients = [each for each in self._open.values() if each.prepared]
        closing = [
            start_task(
                each.close(code=WSCloseCode.GOING_AWAY, message=b"the server ends"), "close", raises=(OSError,)
            )
            for each in clients
        ]
        if closing:
            await asyncio.wait(closing)
        self._channels.close()
