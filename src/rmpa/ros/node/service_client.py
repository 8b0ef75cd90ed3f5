"""The calling side of a service: one connection to its server."""

from __future__ import annotations

import asyncio
import contextlib
import socket
from collections.abc import Callable
from dataclasses import dataclass
from typing import Self

from rmpa.core.errors import (
    LocalProtocolError,
    OutOfDescriptors,
    PeerRefused,
    RemoteProtocolError,
    RmpaError,
    UnreachableError,
)
from rmpa.core.outbox import Outbox
from rmpa.ros import limits
from rmpa.ros.http.rpc import connect, keep_alive
from rmpa.ros.node.ask import exchange_headers
from rmpa.ros.node.service_server import BODIES, send_body
from rmpa.ros.wire import tcpros
from rmpa.runtime.accept import OUT_OF_DESCRIPTORS
from rmpa.runtime.stream import Stream

Done = Callable[["tuple[bool, bytes | bytearray] | ServiceFailed"], None]


@dataclass(eq=False)
class ServiceFailed(RmpaError):  # noqa: N818 - an event's name
    """A call got no response: the server disconnected, was too slow, or broke the protocol.

    Args:
        service: The service's name.
        problem: The reason.
        sent: Whether the request may have reached the server; if not, the call may be repeated.
    """

    service: str
    problem: str
    sent: bool = True
    code = "service-failed"

    def __str__(self) -> str:
        """The service and the reason."""
        return f"service [{self.service}]: {self.problem}"


class ServiceConnection:
    """A connection to a service's server, made by ``open``; one call at a time.

    Attributes:
        service: The service's name.
        fields: The server's header.
    """

    def __init__(
        self, sock: socket.socket, service: str, fields: tcpros.Header, on_closed: Callable[[], None] | None
    ) -> None:
        self.service = service
        self.fields = fields
        self._sock = sock
        self._on_closed = on_closed
        self._loop = asyncio.get_running_loop()
        self._done: Done | None = None
        self._timer: asyncio.TimerHandle | None = None
        self._body: tcpros.BodyBuffer | None = None
        self._ok = False
        outbox = Outbox(limits.SUBSCRIBER_QUEUE_MESSAGES, limits.SERVICE_MESSAGE_MAX)
        outbox.set_terms(BODIES, limits.SUBSCRIBER_QUEUE_MESSAGES, spared=True)
        self._stream = Stream(sock, on_bytes=self._take, on_close=self._ended, outbox=outbox)

    @classmethod
    async def probe(cls, uri: str, service: str, caller_id: str, timeout: float) -> Self:  # noqa: ASYNC109 - as ``open``
        """Ask a server for its description: the closed connection, with ``fields``; raises as ``open``."""
        connection = await cls.open(uri, service, caller_id, probe=True, timeout=timeout)
        connection.close()
        return connection

    @classmethod
    async def open(
        cls,
        uri: str,
        service: str,
        caller_id: str,
        *,
        md5sum: str = tcpros.ANY,
        persistent: bool = True,
        probe: bool = False,
        timeout: float = limits.TCPROS_CONNECT_TIMEOUT,  # noqa: ASYNC109 - the message names it
        on_closed: Callable[[], None] | None = None,
    ) -> Self:
        """Connect and exchange headers.

        Args:
            uri: ``rosrpc://host:port``.
            service: The service's registered name.
            caller_id: The calling node.
            md5sum: ``*`` accepts any.
            persistent: Whether the connection is for more than one call.
            probe: Whether the connection is for no call at all.
            timeout: Seconds for the connection and the headers together.
            on_closed: Called once when the server closes the connection while no call is under way.

        Raises:
            ConfigError: ``uri`` is malformed.
            UnreachableError: The server does not answer, or not in time.
            PeerRefused: The server answers with an error header, or has another md5 sum.
            RemoteProtocolError: The answer is not that of a service's server.
        """
        host, port = tcpros.parse_service_uri(uri)
        header = tcpros.client_header(service, caller_id, md5sum=md5sum, persistent=persistent, probe=probe)
        try:
            async with asyncio.timeout(timeout):
                sock = await connect(host, port)
                try:
                    keep_alive(sock)
                    fields = await exchange_headers(sock, header)
                except BaseException:
                    sock.close()
                    raise
        except TimeoutError:
            where = f"{uri} within {timeout:g} s"
            raise UnreachableError(f"server of service {service}", where) from None
        except OSError as error:
            if error.errno in OUT_OF_DESCRIPTORS:
                remedy = "`rmpa doctor` says what to do"
                raise OutOfDescriptors(f"server of service {service}", uri, remedy) from error
            raise UnreachableError(f"server of service {service}", f"{uri} ({error})") from error
        if fields is None:
            sock.close()
            raise RemoteProtocolError(f"the server of {service} closed before its header")
        if problem := tcpros.check_server(fields, service, md5sum):
            sock.close()
            server = tcpros.printable(fields.get("callerid", "")) or "its server"
            raise PeerRefused(f"service {service}: {server}", problem, code="service-failed")
        return cls(sock, service, fields, on_closed)

    @property
    def description(self) -> tcpros.ServiceDescription:
        """The server's description; fields that roscpp clients do not need may be empty."""
        return tcpros.ServiceDescription.from_header(self.fields)

    @property
    def caller_id(self) -> str:
        """The server's node, from its header; may be empty."""
        return self.fields.get("callerid", "")

    @property
    def closed(self) -> bool:
        """Whether the connection is closed."""
        return self._stream.closed

    @property
    def busy(self) -> bool:
        """Whether a call is under way."""
        return self._done is not None

    async def call(
        self,
        body: tcpros.Buffer,
        timeout: float | None = None,  # noqa: ASYNC109 - the message names it
    ) -> tuple[bool, bytes | bytearray]:
        """Send a request and wait for its reply: the ``ok`` byte, and the response or the text of the error.

        Cancellation closes the connection, because the late reply would be taken for that of the next call.

        Raises:
            LocalProtocolError: Another call is under way.
            ServiceFailed: The server disconnected, or did not answer within ``timeout`` seconds; the connection is
                closed.
        """
        future: asyncio.Future[tuple[bool, bytes | bytearray]] = self._loop.create_future()

        def done(result: tuple[bool, bytes | bytearray] | ServiceFailed) -> None:
            if future.done():
                return
            if isinstance(result, ServiceFailed):
                future.set_exception(result)
            else:
                future.set_result(result)

        self.request(body, done, timeout)
        try:
            return await future
        except asyncio.CancelledError:
            self.close()
            raise

    def request(self, body: tcpros.Buffer, done: Done, timeout: float | None = None) -> None:
        """Send a request without waiting: ``done`` is called once in the event loop, with the reply or the error.

        A large ``body`` must not change until then (``send_body``). ``timeout`` is in seconds; ``None``: no limit.

        Raises:
            LocalProtocolError: Another call is under way.
            ServiceFailed: The server has closed the connection (``sent`` is ``False``), or the request is larger than
                ``limits.SERVICE_MESSAGE_MAX``.
        """
        if self.busy:
            raise LocalProtocolError(f"two calls at once over one connection to {self.service}")
        if len(body) > limits.SERVICE_MESSAGE_MAX:
            text = f"request of {len(body)} bytes exceeds the limit of {limits.SERVICE_MESSAGE_MAX}"
            raise ServiceFailed(self.service, text, sent=False)
        if self._stream.closed or self._was_closed_by_server():
            self._stream.close()
            raise ServiceFailed(self.service, "its server has closed the connection", sent=False)
        self._done = done
        if timeout is not None:
            self._timer = self._loop.call_later(timeout, self._timed_out, timeout)
        send_body(self._stream, tcpros.LENGTH.pack(len(body)), body)

    def close(self) -> None:
        """Close at once; a call under way fails before this returns."""
        self._on_closed = None
        self._stop("the connection was closed")

    def _was_closed_by_server(self) -> bool:
        """Whether the server has closed the connection since the last call; cheaper than a call that fails."""
        try:
            return not self._sock.recv(1, socket.MSG_PEEK | socket.MSG_DONTWAIT)
        except (BlockingIOError, InterruptedError):
            return False
        except OSError:
            return True

    def _take(self, data: memoryview) -> tuple[int, int]:
        if self._done is None:
            raise RemoteProtocolError(f"the server of {self.service} sent {len(data)} bytes that were not asked for")
        at = 0
        if self._body is None:
            head = tcpros.parse_reply_head(data)
            if head is None:
                return 0, tcpros.REPLY.size
            self._ok, size = head
            at, self._body = tcpros.REPLY.size, tcpros.BodyBuffer(size)
        body = self._body
        at += body.take(data[at:])
        if body.whole:
            self._body = None
            self._answered((self._ok, body.data))
        return at, 0

    def _answered(self, result: tuple[bool, bytes | bytearray] | ServiceFailed) -> None:
        done, self._done = self._done, None
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None
        if done is not None:
            done(result)

    def _timed_out(self, timeout: float) -> None:
        self._timer = None
        self._stop(f"no answer within {timeout:g} s")

    def _ended(self, error: Exception | None) -> None:
        if error is not None and not isinstance(error, OSError):
            self._stop(f"its server broke the protocol: {error}")
        else:
            self._stop("its server died, or closed the connection, in the middle of the call")

    def _stop(self, problem: str) -> None:
        self._stream.close()
        self._body = None
        on_closed, self._on_closed = self._on_closed, None
        if self._done is not None:
            self._answered(ServiceFailed(self.service, problem))
        if on_closed is not None:
            with contextlib.suppress(RmpaError):
                on_closed()
