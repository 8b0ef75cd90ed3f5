"""One WebSocket client: its queue, and the tasks that read and write.

Messages wait in the queue as the hub delivers them, and are encoded when the connection can take them: what a slow
client does not get costs no encoding, and payloads are shared by all clients.
"""

from __future__ import annotations

import asyncio
import contextlib
import functools
import inspect
import logging
import operator
import socket
from abc import abstractmethod
from collections import deque
from functools import partial
from typing import TYPE_CHECKING, Any, ClassVar, Final, TypeAlias, get_type_hints

import msgspec
from aiohttp import WebSocketError, WSCloseCode, WSMsgType, web

from rmpa.core.errors import RmpaError
from rmpa.core.limits import KIB, MIB
from rmpa.runtime.tasks import OwnedTasks
from rmpa.web import limits
from rmpa.web.hub.frame_writer import FairQueue, FrameSocket, FrameWriter, Opcode, OutFrame, size_of
from rmpa.web.hub.hub import Hub, HubClient
from rmpa.web.server.access import GuardedConnection, guard_of

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Mapping, Sequence

    from rmpa.web.hub.node_link import Payload, Rights
    from rmpa.web.hub.topics import ReceivedMessage

_log = logging.getLogger(__name__)
# Pings without an answer, behind which no further one is sent: they wait as the client's frames do.
_UNANSWERED_MAX: Final = 8
# Bytes that an entry of the queue takes beside its payload.
_OVERHEAD: Final = 128
# Entries that are written before other tasks have their turn.
_TURN: Final = 16
# Looks without a sign of life, each after half of ``limits.PING_INTERVAL``.
_SILENT_LOOKS: Final = 3
# Makes the frames of an entry of the queue, when they can be written.
_Entry: TypeAlias = "Callable[[], Iterable[OutFrame]]"
# Pings within the age that a client's commands may have.
_AGE_PINGS: Final = 4


def ops_of(
    session: type[Session], rename: Callable[[str], str], *, tagged: bool = False
) -> dict[str, type[msgspec.Struct]]:
    """The structs of what clients send, by op: for each method ``op_NAME`` of a session.

    Args:
        session: The keyword arguments of its methods are the fields, with their types and defaults.
        rename: The protocol's name of an op or a field.
        tagged: Whether the struct itself says the op, in its field ``op``.
    """
    names = {rename(name.removeprefix("op_")): name for name in vars(session) if name.startswith("op_")}
    tags: dict[str, Any] = {op: {"tag_field": "op", "tag": op} if tagged else {} for op in names}
    return {op: _struct_of(getattr(session, name), rename=rename, **tags[op]) for op, name in names.items()}


def decoder_of(ops: Mapping[str, type[msgspec.Struct]]) -> msgspec.json.Decoder[msgspec.Struct]:
    """Decodes any message of tagged ops."""
    return msgspec.json.Decoder(functools.reduce(operator.or_, ops.values()))


def _struct_of(method: Callable[..., None], **config: Any) -> type[msgspec.Struct]:
    hints = get_type_hints(method, include_extras=True)
    keywords = [each for each in inspect.signature(method).parameters.values() if each.kind is each.KEYWORD_ONLY]
    fields = [
        (each.name, hints[each.name]) if each.default is each.empty else (each.name, hints[each.name], each.default)
        for each in keywords
    ]
    return msgspec.defstruct(method.__name__, fields, kw_only=True, frozen=True, **config)


class Session(HubClient):
    """What a client's frames mean in its protocol, and its messages; no I/O.

    Args:
        hub: The hub.
        rights: What the client may do.
        address: The client's, for logs.
    """

    # The protocol's name, for logs and lists.
    kind: ClassVar = ""
    # The WebSocket subprotocols that mean it (RFC 6455, section 1.9).
    subprotocols: ClassVar[Sequence[str]] = ()
    # Bytes of a client's frame, where clients may send data.
    frame_max: ClassVar = 1 * MIB
    # Whether the protocol itself says how old a command is.
    dates_commands = False

    def __init__(self, hub: Hub, rights: Rights, address: str) -> None:
        super().__init__(hub, f"{self.kind} {address}", rights)
        self.address = address
        self._late_told = -limits.DROPS_SHOWN
        self.connection = ClientConnection(self)

    def late(self) -> str:
        """Why a command that comes now may be too old, by the pings that the client has answered."""
        age, most = self.connection.age(), self.rights.command_age
        return f"it may have come {age:.1f} s late, more than {most:g} s, and is dropped" if age > most else ""

    def show_late(self, text: str) -> None:
        """Warn of what is published too late, now and then."""
        now = self.connection.now()
        if now - self._late_told >= limits.DROPS_SHOWN:
            self._late_told = now
            self.warn(text, "late")

    @abstractmethod
    def opened(self) -> None:
        """The WebSocket is open."""

    @abstractmethod
    def received_frame(self, data: str | bytes, now: float) -> None:
        """A frame of the client."""

    @abstractmethod
    def warn(self, text: str, subject: str) -> None:
        """Tell the client that it misses something; ``subject`` is ``late``, or a topic and what is dropped of it."""

    def closing(self) -> None:
        """The connection has ended; the hub still takes requests."""

    def next_timer(self) -> float | None:
        """When ``handle_timer`` is to be called; ``None`` for never."""
        return None

    def handle_timer(self, now: float) -> None:
        """Do what is due."""


class ClientStream:
    """A subscription whose messages wait in a queue of its own. ``topic`` is the global name."""

    topic: str

    @abstractmethod
    def frames(self, message: ReceivedMessage) -> Iterable[OutFrame]:
        """The frames of a message; called when the connection can take them."""


class CommandAge:
    """Bounds the age of what a client sends by the pings that it answers; no clocks are compared.

    A client answers pings in order with its other frames, and TCP keeps that order: what comes behind the answer to a
    ping was sent after that ping, so it is younger. What TCP kept over a cut comes in front of the answers to all
    pings since. The bound is never too low. It is too high by the round trip, and by the time between two pings.

    Args:
        now: When the handshake was answered, which the client awaits before its first frame.
    """

    def __init__(self, now: float) -> None:
        self._number = 0
        self._sent: deque[tuple[int, float]] = deque()
        self._younger_than = now

    def ping(self, now: float) -> bytes | None:
        """The payload of the next ping; ``None`` while too many have no answer."""
        if len(self._sent) >= _UNANSWERED_MAX:
            return None
        self._number = self._number + 1 & 0xFFFFFFFF
        self._sent.append((self._number, now))
        return self._number.to_bytes(4, "big")

    def pong(self, payload: bytes) -> None:
        """A ping is answered, and with it all before it (RFC 6455, section 5.5.3)."""
        number = int.from_bytes(payload, "big")
        if any(each == number for each, _ in self._sent):
            while self._sent:
                each, self._younger_than = self._sent.popleft()
                if each == number:
                    return

    def bound(self, now: float) -> float:
        """Seconds that the frame which comes now may be old at most."""
        return now - self._younger_than


class ClientConnection:
    """One client of a protocol.

    Args:
        session: Its protocol.
    """

    # More than 12 fields: the socket, the two timers, and what is known of both directions.
    def __init__(self, session: Session) -> None:
        self._session = session
        self.queue: FairQueue[_Entry] = FairQueue()
        # Messages and answers that were written.
        self.sent = 0
        self._heard = 0
        self._guard: GuardedConnection | None = None
        self._age: CommandAge | None = None
        self._wake = asyncio.Event()
        self._timer: asyncio.TimerHandle | None = None
        self._transport: asyncio.Transport | None = None
        self._out: FrameWriter | None = None
        self._close: tuple[int, str] | None = None
        self._close_timer: asyncio.TimerHandle | None = None
        self._refused: Callable[[str, str], None] = lambda *_: None
        self._drops_shown = 0
        self._drops_at = 0.0

    def push(self, *frames: OutFrame) -> None:
        """Queue frames that are not dropped."""
        for frame in frames:
            self._queue(None, partial(tuple, (frame,)), size_of(frame))

    def push_message(self, stream: ClientStream, message: ReceivedMessage) -> None:
        """Queue a message of a subscription."""
        self._queue(stream, partial(stream.frames, message), len(message.payload))

    def pace(self, stream: ClientStream, interval: float, length: int) -> None:
        """Hold the messages of a subscription back; see ``FairQueue.pace``."""
        self.queue.pace(stream, interval, length)
        self._wake.set()

    def age(self) -> float:
        """Seconds that the frame which comes now may be old at most; 0 where that is not bounded."""
        return self._age.bound(self.now()) if self._age is not None else 0.0

    def end(self, code: int, reason: str, refusal: str = "") -> None:
        """Close the WebSocket; what the client still sends is ignored.

        Args:
            code: Of RFC 6455, section 7.4.
            reason: For the client and the log.
            refusal: Which of ``clients.CLIENT_REFUSALS`` is counted, where the client is the cause.
        """
        if self._close is not None:
            return
        self._close = (code, reason)
        self._wake.set()
        # A client that does not read would hold the close frame up for long.
        self._close_timer = asyncio.get_running_loop().call_later(2 * limits.CLOSE_TIMEOUT, self._abort)
        if refusal:
            self._refused(refusal, reason)

    def unmasked(self) -> None:
        """Disconnect a client that sent a frame without a mask (RFC 6455, section 5.1)."""
        self.end(WSCloseCode.PROTOCOL_ERROR, "a frame of a client is masked; this one is not", "message")

    def arm(self) -> None:
        """Set the timer anew, after each call of the session."""
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None
        at = self._session.next_timer()
        if at is not None:
            self._timer = asyncio.get_running_loop().call_at(at, self._due)

    @property
    def unsent(self) -> int:
        """Bytes that wait, here and behind the queue."""
        return self.queue.bytes + self._waiting

    async def run(
        self,
        request: web.Request,
        socket_: FrameSocket,
        refused: Callable[[str, str], None],
    ) -> None:
        """Serve the client until it has gone.

        Args:
            request: Asks for the WebSocket.
            socket_: Not prepared yet.
            refused: ``(reason, text)``: called if the client is disconnected for one of ``clients.CLIENT_REFUSALS``.

        Raises:
            PeerRefused: There are too many clients.
        """
        self._refused = refused
        session = self._session
        session.hub.connect(session)
        tasks = OwnedTasks()
        try:
            writer = await socket_.prepare(request)
            self._guard = guard_of(request)
            if self._guard is not None:
                self._guard.upgrade(self.unmasked)
            self._transport = request.transport
            if self._transport is None:
                return  # it went during the handshake
            tune(self._transport)
            self._out = FrameWriter(self._transport, writer.drain)
            socket_.before_close = self._out.hand_over
            session.opened()
            tasks.start(self._write(socket_, self._out), f"write to {session.name}")
            tasks.start(self._watch(), f"watch {session.name}")
            if session.rights.command_age and not session.dates_commands:
                self._age = CommandAge(self.now())
                tasks.start(self._ask_age(self._age), f"ask the age of {session.name}")
            await self._read(socket_)
        finally:
            try:
                session.closing()
            finally:
                for timer in (self._timer, self._close_timer):
                    if timer is not None:
                        timer.cancel()
                session.hub.disconnect(session)
                if self._out is not None:
                    self._out.close()
                await tasks.close()

    async def _read(self, socket_: FrameSocket) -> None:
        async for message in socket_:
            self._heard += 1
            if self._heard % _TURN == 0:
                await asyncio.sleep(0)  # frames that have arrived already do not suspend this task
            if message.type == WSMsgType.PONG and self._age is not None:
                self._age.pong(bytes(message.data))
            if message.type == WSMsgType.ERROR:
                self._failed(message.data)
            if self._gone:
                return
            if self._close is not None:
                continue  # the other task closes it
            if message.type == WSMsgType.PING:
                if self._waiting <= limits.WRITE_BUFFER:  # a client that takes nothing is owed no pong
                    self._send(Opcode.PONG, (message.data,))
            elif message.type in (WSMsgType.TEXT, WSMsgType.BINARY):
                try:
                    self._session.received_frame(message.data, self.now())
                    self.arm()
                except Exception:  # noqa: BLE001 - a fault of one client's session must not end the server
                    _log.exception("! a frame of %s failed", self._session.name)
                    text = b"the server failed; its log says why"
                    await socket_.close(code=WSCloseCode.INTERNAL_ERROR, message=text)
                    return

    def _failed(self, error: object) -> None:
        """The WebSocket has ended by an error: of the connection, or a frame that breaks RFC 6455 or is too long."""
        if isinstance(error, WebSocketError):
            too_big = error.code == WSCloseCode.MESSAGE_TOO_BIG
            self._refused("message_size" if too_big else "message", str(error))
        else:
            _log.debug("! %s: %s", self._session.name, error)

    async def _watch(self) -> None:
        """Disconnect a client without a sign of life: it sends nothing, answers no ping, and takes nothing.

        A large message on a slow link holds up the ping behind it; that it goes on is a sign of life, too. A client
        whose message never ends is disconnected as well, alive or not.
        """
        silent, heard, waiting = 0, (-1, 0), 0
        while silent < _SILENT_LOOKS:
            await asyncio.sleep(limits.PING_INTERVAL / 2)
            now, guard = self._waiting, self._guard
            received, since = (guard.received, guard.frames.since) if guard is not None else (0, None)
            if since is not None and self.now() - since >= limits.MESSAGE_TIMEOUT:
                self.end(WSCloseCode.POLICY_VIOLATION, "a message did not end in time", "message")
                return
            alive = (self._heard, received) != heard or (waiting and now != waiting)
            silent = 0 if alive else silent + 1
            heard, waiting = (self._heard, received), now
            if not waiting:
                self._send(Opcode.PING, ())
        _log.info("= %s gave no sign of life, and is disconnected", self._session.name)
        self._abort()

    async def _ask_age(self, age: CommandAge) -> None:
        while True:
            payload = age.ping(self.now())
            if payload is not None:
                self._send(Opcode.PING, (payload,))
            await asyncio.sleep(self._session.rights.command_age / _AGE_PINGS)

    async def _write(self, socket_: FrameSocket, out: FrameWriter) -> None:
        try:
            turn = 0
            while not socket_.closed and not self._gone:
                if self._close is not None:
                    await socket_.close(code=self._close[0], message=self._close[1].encode()[:120])
                    return
                entry = self.queue.pop(self.now())
                if entry is None:
                    self._wake.clear()
                    with contextlib.suppress(TimeoutError):
                        async with asyncio.timeout_at(self.queue.due):
                            await self._wake.wait()
                    continue
                for opcode, parts in entry():
                    self._send(opcode, parts)
                self._tell_drops()
                await out.drain()
                turn += 1
                if turn % _TURN == 0:
                    await asyncio.sleep(0)
        except ConnectionError as error:
            _log.debug("= %s: %s", self._session.name, error)
        except Exception:
            self._abort()
            raise

    @property
    def _gone(self) -> bool:
        return self._transport is None or self._transport.is_closing()

    @property
    def _waiting(self) -> int:
        return self._out.unsent if self._out is not None else 0

    @staticmethod
    def now() -> float:
        """Seconds of the clock of all calls of the session."""
        return asyncio.get_running_loop().time()

    def _send(self, opcode: Opcode, parts: Sequence[Payload]) -> None:
        if self._out is None or self._out.is_closing:
            return
        self.sent += opcode in (Opcode.TEXT, Opcode.BINARY)
        self._out.write(opcode, parts)

    def _queue(self, stream: ClientStream | None, entry: _Entry, size: int) -> None:
        if self._gone:
            return
        priority = self._session.hub.priority(stream.topic) if stream else 0
        self.queue.push(stream, entry, size + _OVERHEAD, priority, self.now())
        if self.queue.overflow:
            _log.warning("! %s does not read its answers, and is disconnected [reader-slow]", self._session.name)
            self._abort()
        self._wake.set()

    def _tell_drops(self) -> None:
        if self.queue.dropped_total == self._drops_shown or self.now() < self._drops_at:
            return
        self._drops_shown = self.queue.dropped_total
        self._drops_at = self.now() + limits.DROPS_SHOWN
        for stream, count in self.queue.dropped.items():
            text = f"{count} messages were dropped so far, as this client is too slow for all that it reads"
            self._session.warn(f"{stream.topic}: {text}", f"dropped {stream.topic}")

    def _due(self) -> None:
        self._timer = None
        try:
            self._session.handle_timer(self.now())
        except RmpaError:
            _log.exception("! a timer of %s failed", self._session.name)
        self.arm()

    def _abort(self) -> None:
        if self._transport is not None:
            self._transport.abort()


def tune(transport: asyncio.Transport, unsent: int = 512 * KIB) -> None:
    """Set the options of a client's connection; those that a kernel lacks are left out.

    Args:
        transport: Its transport.
        unsent: Bytes that the kernel holds beyond those on their way.
    """
    transport.set_write_buffer_limits(high=limits.WRITE_BUFFER)
    sock = transport.get_extra_info("socket")
    options = (
        ("TCP_NODELAY", 1),
        ("TCP_USER_TIMEOUT", 30_000),  # ms in which the client's machine must acknowledge what was sent
        # A ping behind them must pass in time, and commands overtake images in the queue, not there.
        ("TCP_NOTSENT_LOWAT", unsent),
    )
    for name, value in options:
        option = getattr(socket, name, None)
        if sock is not None and option is not None:
            with contextlib.suppress(OSError):
                sock.setsockopt(socket.IPPROTO_TCP, option, value)
