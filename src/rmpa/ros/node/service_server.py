"""The serving side of a service: ``SlaveNode.add_service`` attaches an endpoint to the node's TCPROS port."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Awaitable, Callable, Iterable, Mapping
from typing import TYPE_CHECKING, Final

from rmpa.config import limits as config_limits
from rmpa.core.errors import LimitExceeded, RmpaError
from rmpa.core.limits import KIB
from rmpa.core.log import logged_failure
from rmpa.ros import limits
from rmpa.ros.wire import tcpros
from rmpa.runtime import limits as runtime_limits
from rmpa.runtime.tasks import start_task

if TYPE_CHECKING:
    from rmpa.ros.node.publication import AcceptedConnection
    from rmpa.runtime.stream import Stream

_log = logging.getLogger(__name__)

# Time within which the next bytes of a service request (of a single call also the first) must arrive.
SERVICE_STALL: Final = 30.0


# The outbox key of requests and responses.
BODIES: Final = 0
# Larger bodies wait where they are: to copy 64 MiB into a queue would hold up the event loop for 30 ms.
_INLINE: Final = 256 * KIB
# They are queued in parts, since one call of the kernel may take a whole entry: 64 MiB are 15 ms.
_PART: Final = 64 * KIB


def send_body(stream: Stream, head: bytes, body: tcpros.Buffer) -> None:
    """Send a request or a response; one of more than ``_INLINE`` bytes must not change until it is sent."""
    if len(body) <= _INLINE:
        stream.send([head, body], BODIES)
    elif not stream.closed:
        stream.pump()  # what is collected goes first
        stream.outbox.push(head, BODIES, pinned=True)
        # A view may be valid during this call only.
        view = memoryview(bytes(body) if isinstance(body, memoryview) else body)
        for start in range(0, len(view), _PART):
            stream.outbox.push(view[start : start + _PART], BODIES, pinned=True)
        stream.pump()


Describe = Callable[[], Awaitable[tcpros.ServiceDescription | str]]
Serve = Callable[["ServiceCall"], None]


class ServiceCall:
    """One request, until it is answered.

    Attributes:
        service: The service's name in this graph.
        caller_id: The calling node.
        request: The request's bytes, without a length; never changed.
        deadline: ``loop.time()`` at which the client gets an error.
        on_gone: Set by the handler; called at most once when no answer is needed any more, because the client has
            disconnected, the deadline is over, or the service is withdrawn. Never called after ``reply``.
    """

    __slots__ = ("_client", "caller_id", "deadline", "on_gone", "request", "service")

    def __init__(
        self, client: _ClientConnection, service: str, caller_id: str, request: bytes | bytearray, deadline: float
    ) -> None:
        self._client: _ClientConnection | None = client
        self.service = service
        self.caller_id = caller_id
        self.request = request
        self.deadline = deadline
        self.on_gone: Callable[[], object] | None = None

    @property
    def answered(self) -> bool:
        """Whether the call was answered, or needs no answer any more."""
        return self._client is None

    def reply(self, ok: bool, body: tcpros.Buffer) -> None:
        """Answer; ``body`` is the response, or for ``ok=False`` the text of the error. Later answers are ignored."""
        client, self._client = self._client, None
        if client is not None:
            self.on_gone = None
            client.reply(ok, body)

    def fail(self, text: str) -> None:
        """Answer with an error."""
        self.reply(False, text.encode(errors="replace"))

    def abandon(self) -> None:
        """Mark the call as needing no answer, and call ``on_gone``; only the client's connection calls this."""
        self._client = None
        on_gone, self.on_gone = self.on_gone, None
        if on_gone is not None:
            with logged_failure(_log, "%s: the end of a call failed", self.service):
                on_gone()


class ServiceEndpoint:
    """One service of a node: takes its connections, and passes each request on as a ``ServiceCall``.

    Args:
        service: The global name, compared literally.
        caller_id: The serving node's name.
        serve: Called in the loop with each request; answers at once or later by ``call.reply``. An exception becomes
            the client's error.
        describe: Called when a client's header arrives while ``description`` is ``None``. Returns the description,
            or the text of an error header; after an error it is called again for the next client. Clients that
            connect while it runs wait for the same result.
        description: The description, if it is known.
        timeout: Seconds for a call before the client gets an error.
        on_mismatch: ``(fields, text)``: a client with another md5 sum was refused.

    Attributes:
        calls: Requests received.
        failed: Requests answered with an error.
    """

    def __init__(
        self,
        service: str,
        caller_id: str,
        serve: Serve,
        describe: Describe | None = None,
        *,
        description: tcpros.ServiceDescription | None = None,
        timeout: float = config_limits.SERVICE_TIMEOUT,
        on_mismatch: Callable[[Mapping[str, str], str], None] = lambda _, text: _log.warning(
            "! %s [type-mismatch]", text
        ),
    ) -> None:
        self.service = service
        self.caller_id = caller_id
        self.serve = serve
        self.timeout = timeout
        self.description = description
        self.calls = 0
        self.failed = 0
        self._describe = describe
        self.on_mismatch = on_mismatch
        self._clients: set[_ClientConnection] = set()
        self._describing: asyncio.Task[None] | None = None
        self._empty: asyncio.Future[None] | None = None

    @property
    def clients(self) -> int:
        """Connections."""
        return len(self._clients)

    def attach(self, connection: AcceptedConnection) -> None:
        """Take a connection whose header names this service and has the required fields."""
        client = _ClientConnection(self, connection)
        self._clients.add(client)
        if self.description is not None:
            client.open(self.description)
        elif self._describing is None:
            self._describing = start_task(self._fetch_description(), f"describe {self.service}")

    def withdraw(self, text: str = "") -> None:
        """Close all connections; calls under way get an error with ``text``."""
        text = text or f"service [{self.service}] is no longer offered by [{self.caller_id}]"
        if self._describing is not None:
            self._describing.cancel()
        self._each(self._clients, lambda client: client.withdraw(text))

    async def closed(self) -> None:
        """After ``withdraw``: wait until the last replies are sent, at most ``runtime.limits.DRAIN_TIMEOUT``."""
        if self._clients:
            self._empty = asyncio.get_running_loop().create_future()
            await asyncio.wait([self._empty], timeout=runtime_limits.DRAIN_TIMEOUT)
        for client in tuple(self._clients):
            client.close()

    def remove(self, client: _ClientConnection) -> None:
        """Forget a connection that has ended; called by the connection."""
        self._clients.discard(client)
        if not self._clients and self._empty is not None and not self._empty.done():
            self._empty.set_result(None)

    async def _fetch_description(self) -> None:
        name = f"service [{self.service}]"
        answer: tcpros.ServiceDescription | str = (
            f"{name}: [{self.caller_id}] failed to describe it; its log says why"
        )
        try:
            async with asyncio.timeout(self.timeout):
                answer = await self._describe() if self._describe is not None else f"{name} has no description yet"
        except TimeoutError:
            answer = f"{name}: its server did not describe it within {self.timeout:g} s"
        except RmpaError as error:
            answer = str(error)
        finally:
            self._describing = None
            self._described(answer)

    def _described(self, answer: tcpros.ServiceDescription | str) -> None:
        waiting = [client for client in self._clients if not client.opened]
        if isinstance(answer, str):
            self._each(waiting, lambda client: client.refuse(answer))
            return
        self.description = answer
        self._each(waiting, lambda client: client.open(answer))
        self._each(waiting, _ClientConnection.resume)  # with requests that are buffered already

    def _each(self, clients: Iterable[_ClientConnection], answer: Callable[[_ClientConnection], None]) -> None:
        """Answers clients; one whose answer fails loses its connection, and the next ones get theirs."""
        for client in tuple(clients):
            try:
                answer(client)
            except Exception:  # noqa: BLE001 - one client must not cost the others their answers
                _log.exception("! %s: %s could not be answered", self.service, tcpros.printable(client.caller_id))
                client.close()


class _ClientConnection:
    """One client's connection: a request, its reply, and, if the connection is persistent, the next request.

    It waits for the service's description (``opened`` is not set yet), receives a request (``_body``), has a call
    under way (``_call``), or sends a reply (``_sending``). A request that is too large is read away (``_discard``)
    while its error is sent.
    """

    # More than 12 fields: what is above, and the client's time and end.
    def __init__(self, endpoint: ServiceEndpoint, connection: AcceptedConnection) -> None:
        self.caller_id = connection.caller_id
        self._endpoint = endpoint
        self._connection = connection
        self._loop = asyncio.get_running_loop()
        self._persistent = tcpros.is_set(connection.request, "persistent")
        self.opened = self._ended = self._taking = False
        self._body: tcpros.BodyBuffer | None = None
        self._call: ServiceCall | None = None
        self._sending: asyncio.Task[None] | None = None
        self._discard = 0
        # Ends a call that takes too long, or a connection whose client sends nothing.
        self._timer: asyncio.TimerHandle | None = None
        connection.on_data = self._take
        connection.on_end = self._left

    def open(self, description: tcpros.ServiceDescription) -> None:
        """Answer the client's header, or refuse it if the md5 sums differ."""
        connection, endpoint = self._connection, self._endpoint
        problem = tcpros.check_client(connection.request, endpoint.service, endpoint.caller_id, description)
        if problem is not None:
            endpoint.on_mismatch(connection.request, problem)
            self.refuse(problem)
            return
        self.opened = True
        connection.outbox.set_terms(BODIES, limits.SUBSCRIBER_QUEUE_MESSAGES, spared=True)
        header = tcpros.server_header(endpoint.caller_id, description)
        connection.bound(limits.SUBSCRIBER_QUEUE_MESSAGES, limits.SERVICE_MESSAGE_MAX)
        connection.accept(header, nodelay=True)
        if not self._persistent or tcpros.is_set(connection.request, "probe"):
            self._watch(connection.bytes_in)

    def refuse(self, text: str) -> None:
        """Answer with an error header and close."""
        self._connection.refuse(text)
        self._release()

    def withdraw(self, text: str) -> None:
        """Answer a call under way with an error, and close once the last reply is sent."""
        call, self._call = self._call, None
        if not self.opened:
            self.refuse(text)
        elif call is not None and not self._ended:
            call.abandon()
            self._persistent = False
            self._respond(False, text.encode(errors="replace"))
        elif self._sending is not None:
            self._persistent = False
        else:
            self.close()

    def close(self) -> None:
        """Close the connection."""
        self._connection.close()
        self._release()

    def reply(self, ok: bool, body: tcpros.Buffer) -> None:
        """Answer the call that is under way."""
        self._call = None
        if not self._ended:
            self._respond(ok, body)

    def _take(self, data: memoryview) -> tuple[int, int]:
        consumed, wanted, self._taking = 0, 0, True
        try:
            while not self._ended:
                taken, wanted = self._step(data[consumed:])
                consumed += taken
                if not taken or consumed == len(data):
                    break
        finally:
            self._taking = False
        return consumed, wanted

    def _step(self, data: memoryview) -> tuple[int, int]:
        """Consume a request, a part of a large one, or a part of one that is too large."""
        at = 0
        if self._discard:
            count = min(self._discard, len(data))
            self._discard -= count
            if not self._discard:
                self._stop_timer()
                self._proceed()
            return count, 0
        if self._body is None:
            if not self.opened or self._call is not None or self._sending is not None:
                # One request at a time; at most one more is buffered.
                if len(data) > limits.SERVICE_MESSAGE_MAX + tcpros.LENGTH.size:
                    raise LimitExceeded("what was sent ahead of a reply", len(data), limits.SERVICE_MESSAGE_MAX)
                return 0, 0
            at = tcpros.LENGTH.size
            if len(data) < at:
                return 0, at
            (size,) = tcpros.LENGTH.unpack_from(data)
            if size > limits.SERVICE_MESSAGE_MAX:
                self._too_large(size)
                return at, 0
            self._body = tcpros.BodyBuffer(size)
        body = self._body
        at += body.take(data[at:])
        if body.whole:
            self._body = None
            self._start_call(body.data)
        elif self._timer is None:
            self._watch(self._connection.bytes_in)
        return at, 0

    def _start_call(self, request: bytes | bytearray) -> None:
        self._stop_timer()
        endpoint = self._endpoint
        endpoint.calls += 1
        deadline = self._loop.time() + endpoint.timeout
        call = self._call = ServiceCall(self, endpoint.service, self.caller_id, request, deadline)
        try:
            endpoint.serve(call)
        except RmpaError as error:
            call.fail(str(error))
        except Exception:  # noqa: BLE001 - a handler's mistake must not reach the connection
            _log.exception("! %s: a call of %s failed", endpoint.service, tcpros.printable(call.caller_id))
            call.fail(f"service [{endpoint.service}]: [{endpoint.caller_id}] failed at this call; its log says why")
        if not call.answered:
            self._timer = self._loop.call_at(deadline, self._timed_out, call)

    def _timed_out(self, call: ServiceCall) -> None:
        self._call = None
        call.abandon()
        timeout = f"{self._endpoint.timeout:g} s"
        self._respond(False, f"service [{self._endpoint.service}] did not answer within {timeout}".encode())

    def _too_large(self, size: int) -> None:
        self._endpoint.calls += 1
        text = (
            f"request of {size} bytes to service [{self._endpoint.service}] exceeds the limit of "
            f"{limits.SERVICE_MESSAGE_MAX}"
        )
        _log.warning("! %s: a %s [message-too-long]", tcpros.printable(self.caller_id), text)
        self._discard = size
        self._respond(False, text.encode())
        self._watch(self._connection.bytes_in)

    def _respond(self, ok: bool, body: tcpros.Buffer) -> None:
        self._stop_timer()
        if ok and len(body) > limits.SERVICE_MESSAGE_MAX:
            ok, size = False, len(body)
            text = f"response of {size} bytes of service [{self._endpoint.service}] exceeds the limit of "
            body = f"{text}{limits.SERVICE_MESSAGE_MAX}".encode()
        self._endpoint.failed += not ok
        send_body(self._connection, tcpros.REPLY.pack(ok, len(body)), body)
        if self._connection.pending_bytes:
            self._wait_until_sent()  # no request is read from a client that does not read its replies
        else:
            self._proceed()

    def _wait_until_sent(self) -> None:
        self._sending = start_task(self._finish(), f"response of {self._endpoint.service}")

    async def _finish(self) -> None:
        """Once all is sent close, or go on with the next request."""
        try:
            while self._connection.pending_bytes and not self._connection.closed:
                await self._connection.drained()
        finally:
            self._sending = None
        if self._persistent or self._discard:
            self._proceed()
        else:
            self.close()

    def _proceed(self) -> None:
        """Go on after a reply, unless the request is still being read away."""
        if self._discard or self._ended or self._sending is not None or self._call is not None:
            return
        if self._persistent:
            self.resume()
        else:
            # Not closed at once: a reply made during the read of another connection is only sent at the end of that.
            self._wait_until_sent()

    def resume(self) -> None:
        """Take what is buffered, unless this is within the read that would take it."""
        if not self._taking and not self._ended:
            self._connection.feed(b"")

    def _watch(self, seen: int) -> None:
        """Close the connection if no bytes arrive within ``SERVICE_STALL`` seconds."""
        self._stop_timer()
        self._timer = self._loop.call_later(SERVICE_STALL, self._stalled, seen)

    def _stop_timer(self) -> None:
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None

    def _stalled(self, seen: int) -> None:
        if self._connection.bytes_in != seen:
            self._watch(self._connection.bytes_in)
            return
        who = tcpros.printable(self.caller_id)
        _log.debug("! %s: %s sent nothing for %g s; closed", self._endpoint.service, who, SERVICE_STALL)
        self.close()

    def _left(self, _connection: AcceptedConnection, error: Exception | None) -> None:
        if error is not None and not isinstance(error, OSError):
            _log.warning(
                "! %s: %s: %s [protocol-error]", self._endpoint.service, tcpros.printable(self.caller_id), error
            )
        self._release()

    def _release(self) -> None:
        self._ended = True
        self._stop_timer()
        if self._sending is not None:
            self._sending.cancel()
        self._connection.on_data = None
        self._connection.on_end = lambda *_: None
        self._endpoint.remove(self)
        call, self._call = self._call, None
        if call is not None:
            self._endpoint.failed += 1
            call.abandon()
