"""The calling side of a service: one connection to its server."""

from __future__ import annotations

import asyncio
import contextlib
import socket
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Self

from rmpa.core.errors import (
    LocalProtocolError,
    OutOfDescriptors,
    PeerRefused,
    RemoteProtocolError,
    RmpaError,
    UnreachableError,
)
from rmpa.core.limits import KIB
from rmpa.core.outbox import Outbox
from rmpa.ros import limits
from rmpa.ros.http.client import connect
from rmpa.ros.node.accepted_connection import keep_alive
from rmpa.ros.node.service_stream import BODIES, INLINE, send_large
from rmpa.ros.wire.services import (
    REPLY,
    BodyBuffer,
    ServiceDescription,
    check_server,
    client_header,
    parse_reply_head,
    parse_service_uri,
)
from rmpa.ros.wire.tcpros import ANY, LENGTH, encode_header, parse_header, printable
from rmpa.runtime.accept import OUT_OF_DESCRIPTORS
from rmpa.runtime.stream import Stream

if TYPE_CHECKING:
    from rmpa.ros.wire.tcpros import Buffer, Header

_WHOLE = 64 * KIB

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

    def __str__(self) -> str:
        """The service and the reason."""
        return f"service [{self.service}]: {self.problem}"


class ServiceConnection:
    """A connection to a service's server, made by ``open``; one call at a time.

    Attributes:
        service: The service's name.
        fields: The server's header.
    """

    def __init__(self, sock: socket.socket, service: str, on_closed: Callable[[], None] | None) -> None:
        self.service = service
        self.fields: Header = {}
        self._sock = sock
        self._on_closed = on_closed
        self._loop = asyncio.get_running_loop()
        self._header: asyncio.Future[Header] | None = self._loop.create_future()
        self._done: Done | None = None
        self._timer: asyncio.TimerHandle | None = None
        self._body: BodyBuffer | None = None
        self._ok = False
        self._sending: asyncio.Task[None] | None = None
        outbox = Outbox(limits.SUBSCRIBER_QUEUE_MESSAGES, limits.SERVICE_MESSAGE_MAX)
        outbox.set_terms(BODIES, limits.SUBSCRIBER_QUEUE_MESSAGES, spared=True)
        self._stream = Stream(sock, on_bytes=self._take, on_close=self._ended, outbox=outbox)

    @classmethod
    async def open(
        cls,
        uri: str,
        service: str,
        caller_id: str,
        *,
        md5sum: str = ANY,
        persistent: bool = True,
        probe: bool = False,
        timeout: float = limits.SERVICE_OPEN_TIMEOUT,  # noqa: ASYNC109 - the message names it
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
        host, port = parse_service_uri(uri)
        header = client_header(service, caller_id, md5sum=md5sum, persistent=persistent, probe=probe)
        try:
            async with asyncio.timeout(timeout):
                sock = await connect(host, port)
                sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
                keep_alive(sock)
                made = cls(sock, service, on_closed)
                try:
                    await made._exchange(header, md5sum)
                except BaseException:
                    made.close()
                    raise
        except TimeoutError:
            where = f"{uri} within {timeout:g} s"
            raise UnreachableError(f"server of service {service}", where) from None
        except OSError as error:
            if error.errno in OUT_OF_DESCRIPTORS:
                remedy = "`rmpa doctor` says what to do"
                raise OutOfDescriptors(f"server of service {service}", uri, remedy) from error
            raise UnreachableError(f"server of service {service}", f"{uri} ({error})") from error
        return made

    @property
    def description(self) -> ServiceDescription:
        """The server's description; fields that roscpp clients do not need may be empty."""
        return ServiceDescription.from_header(self.fields)

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
        return self._done is not None or self._sending is not None

    async def call(
        self,
        body: Buffer,
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

    def request(self, body: Buffer, done: Done, timeout: float | None = None) -> None:
        """Send a request without waiting: ``done`` is called once in the event loop, with the reply or the error.

        A ``body`` larger than ``service_stream.INLINE`` must not change until then. ``timeout`` is in seconds;
        ``None`` waits for ever.

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
        head = LENGTH.pack(len(body))
        if len(body) > INLINE:
            self._sending = self._loop.create_task(self._send_large(head, body), name=f"request of {self.service}")
        else:
            self._stream.send([head, body], BODIES)

    def close(self) -> None:
        """Close at once; a call under way fails before this returns."""
        self._on_closed = None
        self._stop("the connection was closed")

    # --- inside -----------------------------------------------------------------------------------------------

    async def _exchange(self, header: Header, md5sum: str) -> None:
        assert self._header is not None  # noqa: S101 - set by __init__
        self._stream.send([encode_header(header)], BODIES)
        self.fields = await self._header
        self._header = None
        problem = check_server(self.fields, self.service, md5sum)
        if problem is not None:
            who = printable(self.caller_id) or "its server"
            raise PeerRefused(f"service {self.service}: {who}", problem)

    def _was_closed_by_server(self) -> bool:
        """Whether the server has closed the connection since the last call; cheaper than a call that fails."""
        try:
            return not self._sock.recv(1, socket.MSG_PEEK | socket.MSG_DONTWAIT)
        except (BlockingIOError, InterruptedError):
            return False
        except OSError:
            return True

    async def _send_large(self, head: bytes, body: Buffer) -> None:
        try:
            await send_large(self._stream, head, body)
        finally:
            self._sending = None

    def _take(self, data: memoryview) -> tuple[int, int]:
        if self._header is not None:
            fields, consumed, wanted = parse_header(data)
            if fields is not None and not self._header.done():
                self._header.set_result(fields)
            return consumed, wanted
        if self._done is None:
            raise RemoteProtocolError(f"the server of {self.service} sent {len(data)} bytes that were not asked for")
        if self._body is not None:
            return self._grow(self._body, data, 0)
        head = parse_reply_head(data)
        if head is None:
            return 0, REPLY.size
        self._ok, size = head
        end = REPLY.size + size
        if size > _WHOLE:
            self._body = BodyBuffer(size)
            return self._grow(self._body, data, REPLY.size)
        if len(data) < end:
            return 0, end
        self._answered((self._ok, bytes(data[REPLY.size : end])))
        return end, 0

    def _grow(self, body: BodyBuffer, data: memoryview, start: int) -> tuple[int, int]:
        count = body.take(data[start:])
        if body.whole:
            self._body = None
            self._answered((self._ok, body.data))
        return start + count, 0

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
        if self._header is not None:
            problem = error or RemoteProtocolError(f"the server of {self.service} closed before its header")
            if not self._header.done():
                self._header.set_exception(problem)
            return
        if error is not None and not isinstance(error, OSError):
            problem_text = f"its server broke the protocol: {error}"
        else:
            problem_text = "its server died, or closed the connection, in the middle of the call"
        self._stop(problem_text)

    def _stop(self, problem: str) -> None:
        self._stream.close()
        self._body = None
        if self._sending is not None:
            self._sending.cancel()
        if self._header is not None and not self._header.done():
            self._header.cancel()
        on_closed, self._on_closed = self._on_closed, None
        if self._done is not None:
            self._answered(ServiceFailed(self.service, problem))
        if on_closed is not None:
            with contextlib.suppress(RmpaError):
                on_closed()
