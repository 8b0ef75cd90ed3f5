"""The lanes of a link: their TCP connections, the race of all addresses of a peer, and what is sent on each.

A lane need not have its connection. Messages that are sent while it has none wait within the lane's bounds, and go
first over the next one.
"""

from __future__ import annotations

import asyncio
import contextlib
import errno
import os
import socket
import struct
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from rmpa.core import limits as core_limits
from rmpa.core.facts import LaneInfo
from rmpa.core.identity import SERIAL_MASK
from rmpa.core.limits import KIB, MIB
from rmpa.core.outbox import Outbox, QueuedMessage
from rmpa.mesh import limits
from rmpa.mesh.frames import Frame, FrameKind, Lane, pack_data_header, pack_fragment_header
from rmpa.runtime.accept import DESCRIPTORS, Use
from rmpa.runtime.tasks import start_task

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from rmpa.config.settings import LaneSettings
    from rmpa.core.statistics import Counters
    from rmpa.mesh.peering import SocketAddress
    from rmpa.runtime.stream import Stream
    from rmpa.runtime.tls import Buffer

# Time-outs of the successive TCP connects of one dial.
DIAL_ATTEMPTS: Final = (0.3, 0.5, 1.2)
# Unsent bytes of the bulk lane that the kernel may hold (TCP_NOTSENT_LOWAT). Together with SO_PRIORITY it holds the
# p99 latency of commands during image transfers at 0.4 ms instead of 79 ms on 100 Mbit/s.
BULK_UNSENT_BYTES: Final = 16 * KIB
# Sent bytes without an acknowledgement for this long end a connection (TCP_USER_TIMEOUT). It is two leases, so that
# the lease, which can report the reason, ends first.
LINK_UNACKED: Final = 2.0
# Unsent bytes of one link that the kernel may hold (TCP_NOTSENT_LOWAT): control frames cannot overtake them, and the
# drop policy does not reach them. On 5 Mbit/s a pong was 1.2 s late without this bound, 0.3 s with it.
EXPRESS_UNSENT_BYTES: Final = 64 * KIB
# Bytes that a bulk lane without BBR may have on the way at the least.
BULK_WINDOW_MIN: Final = 64 * KIB
# And at the most: 1 Gbit/s at a round trip of 0.1 s.
BULK_WINDOW_MAX: Final = 16 * MIB

# Delay before the next address of a peer is tried in parallel to those that have not answered: the shortest that RFC
# 8305 allows, because robots are near each other.
_DIAL_STAGGER: Final = 0.1
# Payload of one packet to another machine, both ways (TCP_MAXSEG): 1200 bytes with the headers of IPv4 and TCP (40)
# and time stamps (12). They fit through usual tunnels, also where the path drops larger ones silently, and carry 1.5
# % less of a full cable than packets of 1500 bytes.
_SEGMENT_BYTES: Final = 1148
# What TCP_MAXSEG counts beside the payload (RFC 7323).
_TIME_STAMP_BYTES: Final = 12
# Seconds of data that a bulk lane without BBR may have in the queues of the path. Behind 100 ms of queue at 20 Mbit/s
# commands wait for 25 to 30 ms in place of 90, and no image is lost by it.
_BULK_QUEUE: Final = 0.01
# Microseconds that TCP waits on the express lane for an acknowledgement, beyond the round trip and its variation,
# before it repeats a packet (TCP_RTO_MIN_US); its own value is 200 ms. At 5 % loss 95 % of commands at 50 Hz came
# within 50 ms without it, and 100 % with it.
_EXPRESS_RTO_MIN_US: Final = 5000
# Milliseconds between two repetitions on the express lane at most (TCP_RTO_MAX_MS): the least that Linux takes.
_EXPRESS_RTO_MAX_MS: Final = 1000


_RTO_MIN_US: Final = 45
# Options with their values on the express lane, and Linux's own; Python's ``socket`` lacks these numbers of
# linux/tcp.h.
_REPETITION: Final = (
    (16, 1, 0),  # TCP_THIN_LINEAR_TIMEOUTS, Linux 2.6.34
    (44, _EXPRESS_RTO_MAX_MS, 120_000),  # TCP_RTO_MAX_MS, 6.15
    (_RTO_MIN_US, _EXPRESS_RTO_MIN_US, 200_000),  # TCP_RTO_MIN_US, 6.18
)
_BBR: Final = b"bbr"
_INFO_BYTES: Final = 256
_MIN_RTT: Final = struct.Struct("=148xI")  # microseconds, in struct tcp_info of linux/tcp.h
_DELIVERY_RATE: Final = struct.Struct("=160xQ")  # bytes a second, since Linux 4.9


def bound_queue(sock: socket.socket) -> None:
    """Bound what a bulk lane without BBR has on the way: two round trips and ``_BULK_QUEUE`` at its rate.

    To be called from time to time while it sends: where the window itself was the bound, it grows.
    """
    try:
        if sock.getsockopt(socket.IPPROTO_TCP, socket.TCP_CONGESTION, 16).rstrip(b"\0") == _BBR:
            return
        info = sock.getsockopt(socket.IPPROTO_TCP, socket.TCP_INFO, _INFO_BYTES)
        rate: int = _DELIVERY_RATE.unpack_from(info)[0]
        window = round(rate * (2e-6 * _MIN_RTT.unpack_from(info)[0] + _BULK_QUEUE))
        if not rate:
            return
        window = max(BULK_WINDOW_MIN, min(window, BULK_WINDOW_MAX))
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, window // 2)  # the kernel doubles it
    except (OSError, struct.error):
        return


def repeats_quickly() -> bool:
    """Whether this kernel lets the express lane repeat lost packets within milliseconds."""
    with socket.socket() as sock:
        return _try(sock, _RTO_MIN_US, _EXPRESS_RTO_MIN_US)


def may_use_bbr() -> bool:
    """Whether this process may use BBR for the bulk lane."""
    with socket.socket() as sock:
        return _try(sock, socket.TCP_CONGESTION, _BBR)


def _try(sock: socket.socket, name: int, value: int | bytes, level: int = socket.IPPROTO_TCP) -> bool:
    """Set an option that a kernel may lack or not permit; return whether it did."""
    try:
        sock.setsockopt(level, name, value)
    except OSError:
        return False
    return True


@dataclass(eq=False)
class Dialler:
    """Opens the TCP connections that this side dials.

    Args:
        lanes: The options of the lanes' sockets.
        counters: Where options that the system refuses are counted.
    """

    lanes: LaneSettings
    counters: Counters

    def tune(self, sock: socket.socket, lane: int) -> None:
        """Set up the socket of a lane.

        Both have no Nagle, a time-out for dead peers and a short kernel queue. The express lane has a high priority,
        and repeats lost packets sooner where the kernel has options for it: TCP waits 0.2 s before the first
        repetition, and each time twice as long as before. The bulk lane has a low priority, and BBR if that is
        permitted: it keeps the queues short that are behind this host, as in a radio or router; *cubic* fills them
        until packets are lost, and commands wait there too. A route's own ``congctl`` replaces what is set before a
        connection is made, and the lane of an accepted one is known late, so this is called again then.

        An option that the system refuses only costs quality of service: it is counted as ``link.option_refused``.
        """
        express, lanes = lane != Lane.BULK, self.lanes
        unsent = EXPRESS_UNSENT_BYTES if express else BULK_UNSENT_BYTES
        priority = lanes.express_priority if express else lanes.bulk_priority
        options = (
            (socket.IPPROTO_TCP, socket.TCP_NODELAY, 1),
            (socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT, round(LINK_UNACKED * 1000)),
            (socket.IPPROTO_TCP, socket.TCP_NOTSENT_LOWAT, unsent),
            (socket.IPPROTO_IP, socket.IP_TOS, (lanes.express_dscp if express else lanes.bulk_dscp) << 2),
            (socket.SOL_SOCKET, socket.SO_PRIORITY, priority),  # after IP_TOS, which sets it too
        )
        for level, name, value in options:
            if not _try(sock, name, value, level):
                self.counters.add("link.option_refused")
        for name, quick, usual in _REPETITION:
            _try(sock, name, quick if express else usual)
        if not express:
            _try(sock, socket.TCP_CONGESTION, _BBR)

    async def connect(
        self, endpoint: SocketAddress, lane: Lane, within: float = limits.DIAL_TIMEOUT
    ) -> socket.socket:
        """Connect once, for one lane.

        Raises:
            OSError: It failed, or took longer than ``within`` seconds (``TimeoutError``).
        """
        sock = DESCRIPTORS.open_socket(Use.LINK, what=f"a link to {endpoint[0]}:{endpoint[1]}")
        try:
            self.tune(sock, lane)
            # Both sides send packets that fit through usual tunnels, whatever the path's MTU is.
            segment = _SEGMENT_BYTES + _TIME_STAMP_BYTES
            if not endpoint[0].startswith("127.") and not _try(sock, socket.TCP_MAXSEG, segment):
                self.counters.add("link.option_refused")
            async with asyncio.timeout(within):
                await asyncio.get_running_loop().sock_connect(sock, endpoint)
        except BaseException:
            sock.close()
            raise
        return sock

    async def dial(
        self, endpoints: Sequence[SocketAddress], *, briefly: bool = False
    ) -> tuple[socket.socket, SocketAddress]:
        """Connect for the express lane where a peer answers first (RFC 8305).

        The next endpoint has its turn when the one before it failed, or was silent for ``_DIAL_STAGGER``.

        Args:
            endpoints: Best first.
            briefly: One short attempt at each, for a peer that was linked until now.

        Raises:
            OSError: No endpoint answers; the error is the one that came first.
        """
        left = list(endpoints)
        if len(left) == 1:
            return await self._attempt(left[0], briefly=briefly), left[0]
        running: dict[asyncio.Task[socket.socket], SocketAddress] = {}
        first: OSError | None = None
        try:
            while left or running:
                if left:
                    endpoint = left.pop(0)
                    task = start_task(
                        self._attempt(endpoint, briefly=briefly), f"dial {endpoint[0]}", raises=(OSError,)
                    )
                    running[task] = endpoint
                pause = _DIAL_STAGGER if left else None
                done, _ = await asyncio.wait(running, timeout=pause, return_when=asyncio.FIRST_COMPLETED)
                for task in [task for task in running if task in done]:
                    endpoint = running.pop(task)
                    try:
                        return task.result(), endpoint
                    except OSError as error:  # TimeoutError is one, no file descriptor for the socket another
                        first = first if first is not None else error
        finally:
            for task in running:  # not awaited: the link does not wait for the slower attempts
                task.add_done_callback(_close_late)
                task.cancel()
        raise first if first is not None else OSError(errno.EHOSTUNREACH, os.strerror(errno.EHOSTUNREACH))

    async def _attempt(self, endpoint: SocketAddress, *, briefly: bool) -> socket.socket:
        """Connect; a lost SYN is repeated by new attempts, because TCP waits a second."""
        *short, last = (limits.REDIAL_TIMEOUT,) if briefly else DIAL_ATTEMPTS
        for within in short:
            with contextlib.suppress(TimeoutError):
                return await self.connect(endpoint, Lane.EXPRESS, within)
        return await self.connect(endpoint, Lane.EXPRESS, last)


def _close_late(task: asyncio.Task[socket.socket]) -> None:
    """Close the socket of an attempt that succeeded although another one was faster."""
    if not task.cancelled() and task.exception() is None:
        task.result().close()


def _nothing() -> None:
    """The ``on_wanted`` of a lane that always has a connection, or that has ended."""


class LaneSender:
    """Sends data frames by one lane of a link.

    Args:
        name: ``express`` or ``bulk``, for people.
        on_wanted: Called when something is queued while the lane has no connection.

    Attributes:
        ended: Whether the link is closing: nothing is sent or queued any more.
    """

    def __init__(self, name: str, on_wanted: Callable[[], None] = _nothing) -> None:
        self.name = name
        self._on_wanted = on_wanted
        self.outbox = Outbox(core_limits.ROUTE_QUEUE_MESSAGES, limits.LANE_QUEUE_BYTES, frame=pack_fragment_header)
        self.ended = False
        self._stream: Stream | None = None
        # The messages that ``open`` has begun, by route.
        self._open: dict[int, QueuedMessage] = {}
        self._loop = asyncio.get_running_loop()

    def info(self, *, unneeded: bool = False) -> LaneInfo:
        """Its piece of the snapshot; ``unneeded``: no message has wanted it yet."""
        it, dropped = self._stream, self.outbox.dropped.total()
        counts = (0, 0, self.outbox.pending_bytes) if it is None else (it.bytes_in, it.bytes_out, it.pending_bytes)
        return LaneInfo(self.name, it is not None, unneeded, *counts, dropped)

    def connect(self, stream: Stream) -> None:
        """Use a connection from now on; waiting messages are sent first."""
        self._stream = stream
        stream.adopt(self.outbox, pack_fragment_header)

    def disconnect(self) -> int:
        """Handle the end of the connection; return how many messages were cut off, without those in the kernel."""
        self._stream = None
        for parcel in self._open.values():
            if 0 < parcel.sent < parcel.size:
                parcel.dropped = True  # its first bytes were lost with the connection
        self._open.clear()
        return self.outbox.reset()

    def end(self) -> None:
        """Take no more messages, because the link closes; waiting ones are sent within the drain time."""
        self.ended = True
        self._on_wanted = _nothing  # its link holds this lane
        self._stream = None

    def clear(self) -> None:
        """Drop the waiting messages, because the link is gone."""
        self.outbox.clear()
        self._open.clear()

    def send(self, route: int, sequence: int, stamp_ns: int, payload: Buffer) -> int:
        """Send one message; bytes that the socket does not take are copied into a keep-last queue.

        Args:
            route: The route's id, 32 bits.
            sequence: The message's number on its route; its low 32 bits are sent.
            stamp_ns: When it was published, wall clock.
            payload: Its bytes, not kept after the call.

        Returns:
            How many older messages were dropped to make room. Without effect (0) once the link is closing.
        """
        size = len(payload)
        if size > core_limits.FRAGMENT_BYTES:
            return self.extend(self._parcel(route, size, sequence, stamp_ns), payload)
        header = pack_data_header(size, route, sequence, stamp_ns)
        if self._stream is not None:
            return self._stream.send((header, payload), route)
        if self.ended:
            return 0
        dropped = self.outbox.push(b"".join((header, payload)), route, self._loop.time())
        self._on_wanted()
        return dropped

    def open(self, route: int, size: int, sequence: int, stamp_ns: int) -> QueuedMessage:
        """Begin a message of ``size`` bytes that follow by ``extend``, before the next one of its route."""
        parcel = self._open[route] = self._parcel(route, size, sequence, stamp_ns)
        return parcel

    def _parcel(self, route: int, size: int, sequence: int, stamp_ns: int) -> QueuedMessage:
        return QueuedMessage(route, size, sequence & SERIAL_MASK, stamp_ns, self._loop.time())

    def extend(self, parcel: QueuedMessage, data: Buffer) -> int:
        """Send further bytes of an opened message; return how many older messages were dropped to make room."""
        if self._stream is not None:
            return self._stream.extend(parcel, data)
        if self.ended:
            return 0
        dropped = self.outbox.extend(parcel, bytes(data))
        self._on_wanted()
        return dropped

    def abandon(self, parcel: QueuedMessage) -> None:
        """Give up a message whose rest will never come."""
        if self._stream is not None:
            self._stream.abandon(parcel)
        elif not self.ended:
            self.outbox.abandon(parcel)

    def fence(self, route: int, number: int) -> None:
        """Send a fence after the messages of a route; the peer answers it when all of them have arrived."""
        frame = Frame(FrameKind.FENCE, route=route, sequence=number).serialize()
        if self._stream is not None:
            self._stream.send_mark(frame, route)
        elif not self.ended:
            self.outbox.push(frame, route, self._loop.time(), pinned=True)
            self._on_wanted()

    def set_terms(
        self, route: int, depth: int, max_age: float | None = None, *, above: int = 0, spared: bool = False
    ) -> None:
        """Bound the waiting messages of one route; see ``core.outbox``.

        ``above`` as there; 0: also the newest message is dropped beyond ``max_age``, which is a lifespan.
        """
        self.outbox.set_terms(route, depth, max_age, strict=not above, above=above, spared=spared)

    def discard(self, route: int) -> int:
        """Drop the waiting messages of a route, and its bounds; the route stays open. Returns their number."""
        count = self.outbox.discard(route)
        self._open.pop(route, None)
        if self._stream is not None:
            self._stream.pump()
        return count

    def close_route(self, route: int) -> int:
        """Discard the waiting messages of a closed route, and its counts; return the number of messages."""
        count = self.discard(route)
        self.outbox.dropped.pop(route, None)
        self.outbox.expired.pop(route, None)
        return count
