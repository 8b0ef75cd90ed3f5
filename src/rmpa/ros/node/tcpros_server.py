"""The listening TCPROS socket of one node: passes each connection to the publication or service of its header."""

from __future__ import annotations

import asyncio
import itertools
import logging
import socket
from typing import TYPE_CHECKING

from rmpa.core.counters import Counters, RefusalLog, remedy
from rmpa.core.errors import StartError
from rmpa.ros import limits
from rmpa.ros.node.accepted_connection import AcceptedConnection
from rmpa.ros.wire.tcpros import check_request, printable
from rmpa.runtime.accept import DESCRIPTORS, Acceptor, Use, is_shortage
from rmpa.runtime.loop import SystemClock

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

    from rmpa.core.counters import Clock
    from rmpa.ros.node.publication import Publication
    from rmpa.ros.node.service_server import ServiceEndpoint
    from rmpa.ros.wire.tcpros import Header

_log = logging.getLogger(__name__)


class TcprosServer:
    """Accepts connections for the publications and services of one node.

    Args:
        name: The node's name, for the texts.
        publications: By topic; read again at each header, so that the owner can change it.
        counters: Count ``tcpros.refused.*``.
        numbers: The numbers of connections, shared with the node's outgoing ones.
        services: By name; read again at each header.
        clock: For the rate limit of the log.
    """

    def __init__(
        self,
        name: str,
        publications: Mapping[str, Publication],
        *,
        services: Mapping[str, ServiceEndpoint] | None = None,
        counters: Counters | None = None,
        numbers: Iterator[int] | None = None,
        clock: Clock | None = None,
    ) -> None:
        self._name = name
        self._publications = publications
        self._services: Mapping[str, ServiceEndpoint] = services if services is not None else {}
        self._refusals = RefusalLog(_log, counters if counters is not None else Counters())
        self._numbers = numbers if numbers is not None else itertools.count(1)
        self._clock = clock if clock is not None else SystemClock()
        self._acceptor: Acceptor | None = None
        self._waiting: dict[AcceptedConnection, asyncio.TimerHandle] = {}
        self._accepted: set[AcceptedConnection] = set()
        self._forget_at = 16
        self.address: tuple[str, int] = ("", 0)
        """Where the socket listens."""

    def start(self, host: str = "127.0.0.1", port: int = 0) -> None:
        """Listen; ``port`` 0 lets the system choose.

        Raises:
            StartError: The address cannot be used.
        """
        family = socket.AF_INET6 if ":" in host else socket.AF_INET
        where = f"TCPROS server of {self._name} at {host}:{port}"
        try:
            sock = DESCRIPTORS.open_socket(Use.DATA, family, what=f"TCPROS server of {self._name}")
        except OSError as error:
            if is_shortage(error):
                raise StartError(where, "no file descriptors left", remedy()) from error
            raise StartError(where, str(error)) from error
        try:
            sock.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            sock.bind((host, port))
            sock.listen(limits.TCPROS_BACKLOG)
        except OSError as error:
            sock.close()
            raise StartError(where, str(error)) from error
        self.address = sock.getsockname()[:2]
        self._acceptor = Acceptor(sock, self.adopt, name=f"TCPROS server of {self._name}")
        self._acceptor.start()

    def close(self) -> None:
        """Stop listening, and close the connections without a header; the owner closes the others."""
        if self._acceptor is not None:
            self._acceptor.close()
            self._acceptor = None
        waiting, self._waiting = self._waiting, {}
        for connection, timer in waiting.items():
            timer.cancel()
            connection.close()
        self._accepted.clear()  # breaks a reference cycle

    def adopt(self, sock: socket.socket, _client: tuple[str, int]) -> None:
        """Serve an accepted connection, of this server's own socket or of one that several nodes share.

        Args:
            sock: Non-blocking; owned from here on.
        """
        try:
            connection = AcceptedConnection(sock, next(self._numbers), on_header=self._header, on_end=self._ended)
        except OSError:  # the client has disconnected already
            sock.close()
            return
        if len(self._accepted) >= min(self._forget_at, limits.TCPROS_CONNECTIONS_MAX):
            self._forget_closed()
        if len(self._accepted) >= limits.TCPROS_CONNECTIONS_MAX or len(self._waiting) >= limits.TCPROS_HANDSHAKES_MAX:
            self._refuse(
                "full",
                connection.peer[0],
                f"{self._name}: too many connections, one from {connection.peer[0]} closed",
            )
            connection.close()
            return
        self._accepted.add(connection)
        self._waiting[connection] = asyncio.get_running_loop().call_later(
            limits.TCPROS_HANDSHAKE_TIMEOUT, self._timed_out, connection
        )

    def _forget_closed(self) -> None:
        """Drop closed connections, which publications do not report; called when they may be half of all."""
        self._accepted = {connection for connection in self._accepted if not connection.stream.closed}
        self._forget_at = 2 * len(self._accepted) + 16

    def _header(self, connection: AcceptedConnection, fields: Header) -> None:
        timer = self._waiting.pop(connection, None)
        if timer is not None:
            timer.cancel()
        problem = check_request(fields)
        if problem is not None:
            self._refuse(
                "header", connection.peer[0], f"{self._name}: a connection from {connection.peer[0]}: {problem}"
            )
            connection.refuse(problem)
            return
        if "service" in fields:
            endpoint = self._services.get(fields["service"])
            if endpoint is not None:
                endpoint.attach(connection)
                return
            # At debug level: a client may have looked up a service that is gone by now.
            _log.debug("! %s: no service %s", self._name, printable(fields["service"]))
            connection.refuse(f"[{self._name}] does not offer the service [{printable(fields['service'])}]")
            return
        publication = self._publications.get(fields["topic"])
        if publication is None:
            # At debug level: a subscriber may have the address of a publisher that is gone by now.
            _log.debug("! %s: no publication %s", self._name, printable(fields["topic"]))
            connection.refuse(f"[{self._name}] is not a publisher of [{printable(fields['topic'])}]")
            return
        publication.attach(connection)

    def _ended(self, connection: AcceptedConnection, error: Exception | None) -> None:
        """A connection ended before its header was complete, which is normal for rospy, or broke the protocol."""
        timer = self._waiting.pop(connection, None)
        if timer is not None:
            timer.cancel()
        if error is not None and not isinstance(error, OSError):
            self._refuse(
                "malformed", connection.peer[0], f"{self._name}: a connection from {connection.peer[0]}: {error}"
            )

    def _timed_out(self, connection: AcceptedConnection) -> None:
        del self._waiting[connection]
        connection.close()
        self._refuse(
            "silent",
            connection.peer[0],
            f"{self._name}: {connection.peer[0]} sent no header within {limits.TCPROS_HANDSHAKE_TIMEOUT:g} s; closed",
        )

    def _refuse(self, kind: str, who: str, text: str) -> None:
        self._refusals.refuse(self._clock.now(), f"tcpros.refused.{kind}", who, text)
