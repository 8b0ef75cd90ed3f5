"""The gateways: the subprotocol that a client offers chooses, and the pages have a path of their own."""

from __future__ import annotations

import asyncio
import dataclasses
import functools
import itertools
import logging
import secrets
import struct
import time
from collections import Counter
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from aiohttp import web

from rmpa.core.counters import Counters, RefusalLog
from rmpa.core.errors import PeerRefused, RmpaError
from rmpa.web import limits
from rmpa.web import limits as monitor_limits
from rmpa.web import limits as rosbridge_limits
from rmpa.web.foxglove.protocol import SUBPROTOCOLS, BinaryFrame, StatusLevel, TextFrame, choose_subprotocol
from rmpa.web.foxglove.session import FoxgloveClose, FoxgloveSession
from rmpa.web.gateways.connection import ClientConnection, OutFrame
from rmpa.web.gateways.frame_writer import FrameSocket, Opcode
from rmpa.web.hub.requests import AdvertiseTopic, Failed, PublishMessage, ReceivedMessage, UnadvertiseTopic
from rmpa.web.monitor.messages import SUBPROTOCOL
from rmpa.web.monitor.session import FollowLog, MonitorClose, MonitorSession, Question, Speed
from rmpa.web.rosbridge.calls import RosbridgeSession
from rmpa.web.rosbridge.protocol import PublishFrames
from rmpa.web.rosbridge.rosapi import HubGraph

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator

    from rmpa.web.foxglove.protocol import FoxgloveFrame
    from rmpa.web.foxglove.session import Output
    from rmpa.web.hub.hub import Hub
    from rmpa.web.hub.node_link import Rights
    from rmpa.web.hub.requests import Answer
    from rmpa.web.monitor.messages import Tree
    from rmpa.web.monitor.monitor import Monitor
    from rmpa.web.monitor.session import Output as MonitorOutput
    from rmpa.web.rosbridge.protocol import RosbridgeFrame


# rosbridge v2 over a WebSocket.


class RosbridgeConnection(ClientConnection):
    """One rosbridge client; the arguments are those of ``ClientConnection``.

    Args:
        frames: Encodes messages, once for all clients.
    """

    kind = "rosbridge"

    def __init__(
        self,
        hub: Hub,
        rights: Rights,
        priority: Callable[[str], int],
        address: str,
        *,
        frames: PublishFrames,
    ) -> None:
        super().__init__(hub, rights, priority, address)
        graph = HubGraph(hub, rights)
        self._session = RosbridgeSession(hub.types, graph, hub.time.now_ns, frames=frames)

    def opened(self) -> None:
        """Count the client; nothing is sent first."""
        self.hub.counts.add(self.client.number, self.address)

    def received_frame(self, data: str | bytes) -> None:
        """A frame of the client."""
        self._session.receive_frame(data, self._loop.time())
        self._flush()

    def answered(self, answer: Answer) -> None:
        """An answer of the hub."""
        self._session.receive_answer(answer, self._loop.time())
        self._flush()

    def encode(self, message: ReceivedMessage) -> Iterable[OutFrame]:
        """The frames of a message; none where it is throttled."""
        self._session.receive_answer(message, self._loop.time())
        frames = self._session.frames_to_send()
        # A message that is held back needs the timer; to ask for it at each message would take time.
        self._flush(arm=not frames)
        return (_rosbridge_out(frame) for frame in frames)

    def show_late(self, text: str) -> None:
        """A status of the level ``error``."""
        self._session.warn(text, "error")
        self._flush()

    def show_drops(self, dropped: dict[str, int]) -> None:
        """A status of the level ``warning``."""
        listed = ", ".join(f"{count} of {topic}" for topic, count in dropped.items())
        self._session.warn(f"this client is too slow; messages dropped so far: {listed}")
        self._flush()

    def next_timer(self) -> float | None:
        """The session's."""
        return self._session.next_timer()

    def handle_timer(self) -> None:
        """Do what is due."""
        self._session.handle_timer(self._loop.time())
        self._flush()

    def _flush(self, *, arm: bool = True) -> None:
        for frame in self._session.frames_to_send():
            self.push(_rosbridge_out(frame), frame.handle)
        for request in self._session.requests_to_send():
            self.ask(request)
        if arm:
            self.arm()


def _rosbridge_out(frame: RosbridgeFrame) -> OutFrame:
    return (Opcode.BINARY if frame.binary else Opcode.TEXT, frame.parts)


# The Foxglove WebSocket protocol over a WebSocket.


class FoxgloveConnection(ClientConnection):
    """One Foxglove client; the arguments are those of ``ClientConnection``.

    Args:
        name: The server's, for users.
        session_id: The same for all clients of one run.
    """

    kind = "foxglove"

    def __init__(
        self,
        hub: Hub,
        rights: Rights,
        priority: Callable[[str], int],
        address: str,
        *,
        name: str,
        session_id: str,
    ) -> None:
        super().__init__(hub, rights, priority, address)
        self._session = FoxgloveSession(name, session_id, rights, sim_time=hub.time.simulated)

    def opened(self) -> None:
        """``serverInfo`` and the channels come first."""
        self._do(self._session.open())

    def received_frame(self, data: str | bytes) -> None:
        """A frame of the client."""
        self._do(self._session.receive(data, self._loop.time()))

    def answered(self, answer: Answer) -> None:
        """An answer of the hub."""
        self._do(self._session.answer(answer))

    def encode(self, message: ReceivedMessage) -> Iterable[OutFrame]:
        """The frame of a message; none where its subscription has ended.

        The first message of another version of its type has other ones: of channels, and requests about that version.
        """
        frames = []
        for each in self._session.answer(message):
            if isinstance(each, TextFrame | BinaryFrame):
                frames.append(_foxglove_out(each))
            elif not isinstance(each, FoxgloveClose):
                self.ask(each)
        return frames

    def show_late(self, text: str) -> None:
        """A warning, which a later one replaces."""
        self.push(_foxglove_out(self._session.status(StatusLevel.WARNING, text, "late")))

    def show_drops(self, dropped: dict[str, int]) -> None:
        """A warning for each topic, which a later one replaces."""
        for topic, count in dropped.items():
            text = f"{topic}: {count} messages were dropped so far, as this client is too slow for all that it reads"
            self.push(_foxglove_out(self._session.status(StatusLevel.WARNING, text, f"dropped {topic}")))

    def _do(self, outputs: list[Output]) -> None:
        for output in outputs:
            if isinstance(output, TextFrame | BinaryFrame):
                self.push(_foxglove_out(output))
            elif isinstance(output, FoxgloveClose):
                self.end(output.code, output.reason, "message")
            else:
                self.ask(output)


def _foxglove_out(frame: FoxgloveFrame) -> OutFrame:
    if isinstance(frame, TextFrame):
        return Opcode.TEXT, (frame.data,)
    return Opcode.BINARY, (frame.header, frame.payload)


# One page of the monitor: its session, and what the session asks of the hub, the agent and the robot.


_log = logging.getLogger(__name__)
_TWIST: Final = "geometry_msgs/Twist"
_SPEEDS: Final = struct.Struct("<6d")
"""A geometry_msgs/Twist: linear x, y, z in m/s, then angular x, y, z in rad/s."""


_INTERNAL_ERROR: Final = 1011
"""A WebSocket's close code, RFC 6455, section 7.4.1."""


class MonitorConnection(ClientConnection):
    """One page; the arguments are those of ``ClientConnection``.

    Args:
        monitor: What all pages share.
    """

    kind = "monitor"
    dates_commands = True
    timer_waits = False  # the robot is stopped in time, whatever waits for the page

    def __init__(
        self,
        hub: Hub,
        rights: Rights,
        priority: Callable[[str], int],
        address: str,
        *,
        monitor: Monitor,
    ) -> None:
        # The joystick publishes by the hub, whatever else the page may publish: nothing.
        own = dataclasses.replace(rights, control=rights.drive)
        super().__init__(hub, own, priority, address)
        self._monitor = monitor
        self._session = MonitorSession(
            monitor.mesh.details, monitor.values.of, rights, self._loop.time(), lambda: self.unsent
        )
        self._handles = itertools.count(-1, -1)
        self._driven: dict[str, int] = {}
        """The handle of each topic that is published; below zero, as pages number their watches from 1."""
        self._asking: set[asyncio.Task[None]] = set()

    def opened(self) -> None:
        """Greet the page, and show it the state."""
        self._act(self._session.open(self._monitor.mesh.agent))
        self._monitor.mesh.follow(self, self._show)

    def closing(self) -> None:
        """Stop the robot, and all that the page had open."""
        self._monitor.mesh.unfollow(self)
        self._monitor.log.unfollow(self)
        for task in self._asking:
            task.cancel()
        self._act(self._session.close())

    def received_frame(self, data: str | bytes) -> None:
        """A message of the page."""
        self._act(self._session.receive(data, self._loop.time()))

    def receive(self, answer: Answer) -> None:
        """Take an answer of the hub; the session itself keeps only the newest message of a watch."""
        if isinstance(answer, ReceivedMessage):
            self._act(self._session.receive_message(answer, self._loop.time()))
        else:
            self.answered(answer)

    def answered(self, answer: Answer) -> None:
        """A subscription or the joystick's publisher was refused."""
        if not isinstance(answer, Failed):
            return
        if answer.handle in self._driven.values():
            self._driven = {topic: handle for topic, handle in self._driven.items() if handle != answer.handle}
            self._act(self._session.failed(answer.error, answer.remedy))
        else:
            self._act(self._session.end_watch(answer.handle, answer.error, answer.remedy))

    def encode(self, message: ReceivedMessage) -> Iterable[OutFrame]:  # noqa: ARG002
        """Nothing: ``receive`` queues no message of the hub."""
        return ()

    def show_drops(self, dropped: dict[str, int]) -> None:
        """Nothing: the page is sent the newest message only."""

    def next_timer(self) -> float | None:
        """The session's."""
        return self._session.next_timer()

    def handle_timer(self) -> None:
        """Do what is due."""
        self._act(self._session.handle_timer(self._loop.time()))

    def _show(self, state: Tree) -> None:
        self._act(self._session.update(state, self._loop.time()))

    def _act(self, outputs: Iterator[MonitorOutput]) -> None:
        # What is done here may have the hub deliver at once, which comes back to the session: it must be done first.
        # Of a session that fails, what it said before is done all the same: that may be the robot's stop.
        said: list[MonitorOutput] = []
        try:
            for output in outputs:
                said.append(output)  # noqa: PERF402 - extend() would lose what came before an error
        except Exception:  # noqa: BLE001 - a fault of one page's session must not end the server
            _log.exception("! the session of %s failed", self.client.name)
            self.end(_INTERNAL_ERROR, "the server failed; its log says why")
        for output in said:
            match output:
                case str():
                    self.push((Opcode.TEXT, (output.encode(),)))
                case bytes():
                    self.push((Opcode.BINARY, (output,)))
                case Question():
                    self._ask(output)
                case Speed():
                    self._drive(output)
                case FollowLog(on=True):
                    self._follow_log()
                case FollowLog():
                    self._monitor.log.unfollow(self)
                case MonitorClose():
                    self.end(output.code, output.reason, output.refusal)
                case _:
                    self.ask(output)
        self.arm()

    def _follow_log(self) -> None:
        log = self._monitor.log
        if kept := log.follow(self, lambda lines: self._act(self._session.log(lines))):
            self._act(self._session.log(kept, kept=True))
        if log.refused is not None:
            self._act(self._session.failed(str(log.refused)))

    def _ask(self, question: Question) -> None:
        async def answer() -> None:
            try:
                value = await self._monitor.answers.answer(question.what, question.args)
            except RmpaError as error:
                failed = Failed.of(0, error)
                self._act(self._session.refuse(question.id, failed.error, failed.remedy))
            except Exception:  # noqa: BLE001 - a task's top
                _log.exception("! the question %s of %s failed", question.what, self.client.name)
                self._act(self._session.refuse(question.id, "the web server failed; its log says why"))
            else:
                self._act(self._session.answer(question.id, value))

        task = self._loop.create_task(answer(), name=f"question of {self.client.name}")
        self._asking.add(task)
        task.add_done_callback(self._asking.discard)

    def _drive(self, speed: Speed) -> None:
        if speed.topic not in self._driven:
            for handle in self._driven.values():
                self.ask(UnadvertiseTopic(handle))
            self._driven = {speed.topic: next(self._handles)}
            self.ask(AdvertiseTopic(self._driven[speed.topic], speed.topic, _TWIST))
        if speed.topic in self._driven:  # it was not refused at once
            handle = self._driven[speed.topic]
            self.ask(PublishMessage(handle, _SPEEDS.pack(speed.linear, 0, 0, 0, 0, speed.angular)))


# What the gateways count, for ``/metrics``; no I/O.


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


MONITOR_PATH: Final = "/monitor"


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
        # Only a client that sends data has a use for large messages: aiohttp keeps what it has gathered to the end.
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
