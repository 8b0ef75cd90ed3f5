"""Drives one link machine by one stream and one timer."""

from __future__ import annotations

import asyncio
import errno
import logging
import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Final, Protocol

from rmpa.core.errors import RemoteProtocolError
from rmpa.core.outbox import URGENT, Outbox
from rmpa.mesh import limits
from rmpa.mesh.frames import Frame, FrameKind
from rmpa.mesh.handshake import Lane
from rmpa.mesh.io.lane import LaneSender
from rmpa.mesh.io.sockets import reset_at_close, unacknowledged
from rmpa.mesh.link import (
    ControlReceived,
    Event,
    HelloReceived,
    LinkClosed,
    LinkProtocol,
    LinkRole,
    LinkState,
    Marked,
    Ponged,
    Refused,
    Up,
)
from rmpa.mesh.path_mtu import StallWatch
from rmpa.runtime.stream import Stream

if TYPE_CHECKING:
    import socket

    from rmpa.core.clock import Clock
    from rmpa.core.guid import Guid
    from rmpa.core.identity import Identity
    from rmpa.mesh.handshake import Hello, Refuse, Verdict

_log = logging.getLogger(__name__)

_SILENCE: Final = frozenset(
    {errno.ETIMEDOUT, errno.EHOSTUNREACH, errno.ENETUNREACH, errno.ENETDOWN, errno.ECONNRESET, errno.EPIPE}
)
"""How a connection ends whose other side gave it up after a silence, or whose process died with bytes unread."""

_ANSWERED: Final = -1
"""In place of a probe's stamp."""

OnLinkData = Callable[["MeshLink", int, int, int, memoryview], None]
OnLinkPart = Callable[["MeshLink", int, int, int, int, memoryview], None]
OnLinkMark = Callable[["MeshLink", FrameKind, int, int], None]


class LinkOwner(Protocol):
    """What a link tells the mesh; each is called from the loop."""

    def link_judge(self, link: MeshLink, hello: Hello) -> Verdict:
        """Somebody wants this link: ``None`` welcomes."""
        ...

    def link_opened(self, link: MeshLink) -> None:
        """The handshake ended well."""
        ...

    def link_refused(self, link: MeshLink, refuse: Refuse, *, by_us: bool) -> None:
        """The handshake ended with a no; ``link_ended`` follows."""
        ...

    def link_control(self, link: MeshLink, payload: bytes) -> None:
        """A control frame came."""
        ...

    def link_quiet(self, link: MeshLink) -> None:
        """Nothing came for ``limits.GHOST_QUIET``; called again from time to time while that lasts."""
        ...

    def link_tick(self, link: MeshLink) -> None:
        """The timer of a link that is used: once in a keepalive's interval or so."""
        ...

    def link_ended(self, link: MeshLink, reason: str, *, malformed: bool, was_up: bool) -> None:
        """The socket is closed, once a link."""
        ...


@dataclass(frozen=True, slots=True)
class LinkHandlers:
    """Who takes what comes on a link that is used with its peer.

    Args:
        data: ``(link, route, sequence, stamp_ns, payload)``: a whole message; the payload is only valid during the
            call.
        part: ``(link, route, sequence, stamp_ns, flags, part)``: a part of one, likewise.
        mark: ``(link, kind, route, sequence)``: an acknowledgement, or the answer to a fence.
        clock: ``(link)``: the peer's clock is known, or known better.
        lane_lost: ``(link)``: the bulk lane's connection is gone, and what was on its way; the link is not.
    """

    data: OnLinkData
    part: OnLinkPart
    mark: OnLinkMark
    clock: Callable[[MeshLink], None]
    lane_lost: Callable[[MeshLink], None]


class MeshLink:
    """One connection with a peer.

    That of the express lane is the link, as the rooms above see it; it has the bulk lane's while there is one.

    Args:
        link_id: The mesh's number for it.
        sock: Connected, non-blocking; owned by the link from here on.
        role: Whether we dialled.
        ours: Who we are.
        owner: Whom it tells.
        clock: The time.
        expected: Whom we believe we dialled.
        endpoint: The other end's address and port.
        lane: What we dial for; of an accepted one the other side's hello says it.
        segment: Bytes that one packet may carry, ``None`` for as many as the kernel likes.
    """

    def __init__(
        self,
        link_id: int,
        sock: socket.socket,
        role: LinkRole,
        ours: Identity,
        *,
        owner: LinkOwner,
        clock: Clock,
        endpoint: tuple[str, int],
        expected: Guid | None = None,
        lane: Lane = Lane.EXPRESS,
        segment: int | None = None,
    ) -> None:
        self.id = link_id
        self.remote_endpoint = endpoint
        self.since: float | None = None
        """Monotonic seconds at which it came up."""
        self.expected = expected
        self._owner = owner
        self._clock = clock
        self._loop = asyncio.get_running_loop()
        self._timer: asyncio.TimerHandle | None = None
        self._pings: dict[int, asyncio.Future[float]] = {}
        self._end: asyncio.Future[None] = self._loop.create_future()
        self._ended = False
        self._leaving = False
        self._mark_to: Callable[[FrameKind, int, int], None] | None = None
        self._of: MeshLink | None = None
        """Of a bulk lane's connection: the express lane's."""
        self._malformed = False
        self.silent = False
        """Once it has ended: whether nobody said so; its peer may be there, and the cable is not."""
        self.discarded = 0
        """Once it has ended: messages that still waited for it."""
        self.used = False
        """Whether this is the link that is used with its peer."""
        self.express = LaneSender("express")
        self.bulk = LaneSender("bulk")
        self._bulk_link: MeshLink | None = None
        self._takers: LinkHandlers | None = None
        self._asked = lane
        self._bulk_before = [0, 0]
        self.sock = sock
        self.stalls = StallWatch(segment, clock.now())
        """Whether what is sent gets through."""
        self._probe: int | None = None
        self._probed_at = -math.inf
        self._sent_before = 0
        self._stream = Stream(
            sock,
            on_bytes=self._take,
            on_close=self._lost,
            outbox=Outbox(1, limits.LINK_URGENT_BYTES),
            segment=segment,
        )
        self._machine = LinkProtocol(
            role,
            ours,
            clock.now(),
            wall_ns=clock.wall_ns,
            on_event=self._event,
            on_data=_ignore,
            expected=expected,
            lane=lane,
            lease=limits.BULK_LEASE if lane is Lane.BULK else limits.LINK_LEASE,
            label=f"{endpoint[0]}:{endpoint[1]}",
        )
        self._after()
        self._arm()

    @property
    def identity(self) -> Identity:
        """The other side; only once it is up."""
        return self._hello.identity

    @property
    def guid(self) -> Guid:
        """The other side's GUID; only once it is up."""
        return self._hello.guid

    @property
    def remote_guid(self) -> Guid | None:
        """The other side's GUID as soon as it said it."""
        return None if self._machine.remote is None else self._machine.remote.guid

    @property
    def name(self) -> str:
        """The other side's name, or its address while that is not known."""
        remote = self._machine.remote
        return remote.name if remote is not None else f"{self.remote_endpoint[0]}:{self.remote_endpoint[1]}"

    @property
    def dialled(self) -> bool:
        """Whether we dialled."""
        return self._machine.role is LinkRole.DIALLER

    @property
    def up(self) -> bool:
        """Whether messages go through."""
        return self._machine.state is LinkState.UP and not self._ended

    @property
    def state(self) -> LinkState:
        """The machine's state."""
        return self._machine.state

    @property
    def lane(self) -> int:
        """What the connection is for (``handshake.Lane``); of an accepted one once the other side said it."""
        remote = self._machine.remote
        return self._asked if self.dialled or remote is None else remote.lane

    @property
    def bulk_link(self) -> MeshLink | None:
        """The bulk lane's connection, while there is one."""
        return self._bulk_link

    @property
    def rtt(self) -> float | None:
        """The last round trip in seconds; ``None`` before the first."""
        return self._machine.clock.rtt

    @property
    def clock_offset(self) -> float | None:
        """Seconds that the other side's wall clock is ahead of ours; ``None`` if unknown."""
        estimate = self._machine.clock.estimate(self._clock.now())
        return None if estimate is None else estimate[0]

    @property
    def clock_error(self) -> float | None:
        """The offset is true within ± this many seconds; ``None`` if unknown."""
        estimate = self._machine.clock.estimate(self._clock.now())
        return None if estimate is None else estimate[1]

    @property
    def resumed_at(self) -> float:
        """When the express lane's last silence was last seen, monotonic seconds; see ``Stream``."""
        return self._stream.resumed_at

    @property
    def bytes_in(self) -> int:
        """Bytes received, headers included, by both lanes."""
        return self._stream.bytes_in + self._bulk_before[0] + (self._bulk_link.bytes_in if self._bulk_link else 0)

    @property
    def bytes_out(self) -> int:
        """Bytes that the kernel took, headers included, on both lanes."""
        return self._stream.bytes_out + self._bulk_before[1] + (self._bulk_link.bytes_out if self._bulk_link else 0)

    @property
    def queue_bytes(self) -> int:
        """Bytes that wait for the kernel, on both lanes."""
        return self._stream.pending_bytes + self.bulk.outbox.pending_bytes

    @property
    def busy(self) -> bool:
        """Whether news of the graph would wait on the express lane, and commands behind them."""
        return self._stream.pending_bytes > 0 or self._stream.unacknowledged > limits.TELL_BACKLOG

    @property
    def dropped(self) -> int:
        """Messages dropped so far because the peer took them too slowly."""
        return self.express.outbox.dropped.total() + self.bulk.outbox.dropped.total()

    @property
    def expired(self) -> int:
        """Messages dropped so far because they had become too old before the peer took them."""
        return self.express.outbox.expired.total() + self.bulk.outbox.expired.total()

    @property
    def heard_at(self) -> float:
        """Monotonic seconds at which bytes last came."""
        return max(self._machine.heard_at, self._stream.last_in)

    def mark(self, kind: FrameKind, route: int, sequence: int) -> None:
        """Acknowledge messages of a route, or answer a fence: in front of all data that waits."""
        if self._machine.state is LinkState.UP:
            frame = Frame(kind, route=route, sequence=sequence & 0xFFFFFFFF).serialize()
            self._stream.send((frame,), URGENT)

    def send_control(self, payload: bytes) -> None:
        """Send one control frame, before all data that waits; never dropped.

        If more than ``limits.LINK_URGENT_BYTES`` wait the link is closed: the other side does not read.
        """
        if self._machine.state is not LinkState.UP:
            return
        self._stream.send((self._machine.control(payload),), URGENT)
        self._check_urgent()

    async def ping(self) -> float | None:
        """Measure one round trip now, in seconds; ``None`` if no answer came within ``limits.PING_TIMEOUT``."""
        if not self.up:
            return None
        answer: asyncio.Future[float] = self._loop.create_future()
        stamp = self._machine.ping(self._clock.now())
        self._pings[stamp] = answer
        self._after()
        try:
            async with asyncio.timeout(limits.PING_TIMEOUT):
                return await answer
        except TimeoutError:
            return None
        finally:
            self._pings.pop(stamp, None)

    def probe(self) -> None:
        """Send a small packet now; ``take_probe`` tells when it was answered."""
        now = self._clock.now()
        if self.up and now - self._probed_at >= limits.STALL_SUSPECTED:
            self._probe, self._probed_at = self._machine.ping(now), now
            self._after()

    def take_probe(self) -> bool:
        """Whether the last ``probe`` has been answered since this was asked last."""
        answered = self._probe == _ANSWERED
        if answered:
            self.forget_probe()
        return answered

    def forget_probe(self) -> None:
        """An answer to the last ``probe`` says nothing any more."""
        self._probe = None

    def has_sent(self) -> bool:
        """Whether bytes left by this connection since this was asked last, or were not acknowledged then."""
        before, self._sent_before = self._sent_before, self._stream.bytes_out
        return self._sent_before != before or unacknowledged(self.sock) > 0

    def segment(self, size: int) -> None:
        """Send in packets of at most ``size`` bytes from now on."""
        self.stalls = StallWatch(size, self._clock.now(), self.stalls)
        self._stream.segment(size)

    def close_route(self, route: int) -> int:
        """Discard what waits of a closed route; return how many messages that were. Its drop counts end too."""
        return self.express.close_route(route) + self.bulk.close_route(route)

    def close(self, reason: str) -> None:
        """Say bye, let the last bytes leave for at most ``limits.DRAIN_TIMEOUT``, and close."""
        self._machine.close(reason, self._clock.now())
        self._after()

    def abort(self, reason: str) -> None:
        """Close at once, without a word."""
        self._machine.lost(reason)

    def reset(self, reason: str) -> None:
        """Close at once, and let the other side know at once though what was sent before is lost on the way."""
        self.silent = True
        reset_at_close(self.sock)
        self.abort(reason)

    async def ended(self) -> None:
        """Wait until the socket is closed and the owner knows."""
        await asyncio.shield(self._end)

    def use(self, takers: LinkHandlers | None) -> None:
        """Whether this is the link that is used with its peer: data goes to its takers, or nowhere."""
        self.used = takers is not None
        self._takers = takers
        self._listen(self, takers)
        if self._bulk_link is not None:
            self._bulk_link._listen(self, takers)  # noqa: SLF001 - its own class

    def attach(self, bulk: MeshLink) -> None:
        """Carry the bulk lane by this connection from now on; an older one is closed without a word."""
        if self._bulk_link is not None:
            old = self._bulk_link
            self.detach(old)
            old._sever("replaced by a newer bulk lane")  # noqa: SLF001 - its own class
        self._bulk_link = bulk
        bulk._listen(self, self._takers)
        self.bulk.connect(bulk._stream)

    def detach(self, bulk: MeshLink) -> bool:
        """The bulk lane's connection is gone; whether it was this one."""
        if self._bulk_link is not bulk:
            return False
        self._bulk_link = None
        self._bulk_before[0] += bulk.bytes_in
        self._bulk_before[1] += bulk.bytes_out
        bulk._listen(self, None)
        self.bulk.disconnect()
        if self._takers is not None:
            self._takers.lane_lost(self)
        return True

    # --- inside ---------------------------------------------------------------------------------------------

    def _listen(self, link: MeshLink, takers: LinkHandlers | None) -> None:
        """Hand what comes to the takers, as of ``link``, the peer's express lane."""
        self._machine.on_data = _ignore if takers is None else partial(takers.data, link)
        self._machine.on_part = _ignore_part if takers is None else partial(takers.part, link)
        self._mark_to = None if takers is None else partial(takers.mark, link)
        self._of = link if link is not self else None

    @property
    def _hello(self) -> Hello:
        remote = self._machine.remote
        if remote is None:
            raise AttributeError("the other side of this link has not said who it is")
        return remote

    def _take(self, view: memoryview) -> tuple[int, int]:
        try:
            taken = self._machine.receive(view, self._clock.now())
        except RemoteProtocolError:
            self._malformed = True
            raise
        if self._machine.has_output:
            self._after()
        return taken

    def _event(self, event: Event) -> None:
        if isinstance(event, ControlReceived):
            self._owner.link_control(self, event.payload)
        elif isinstance(event, Marked):
            self._marked(event)
        elif isinstance(event, Ponged):
            self._ponged(event)
        elif isinstance(event, HelloReceived):
            verdict = self._owner.link_judge(self, event.hello)
            if verdict is None:
                self._machine.accept(self._clock.now())
            else:
                self._machine.refuse(verdict, self._clock.now())
        elif isinstance(event, Up):
            self.since = self._clock.now()
            # The welcome leaves before whatever the owner sends now.
            self._after()
            self._arm()
            if self.lane != Lane.BULK:
                self.express.connect(self._stream)
            self._owner.link_opened(self)
        elif isinstance(event, Refused):
            self._owner.link_refused(self, event.refuse, by_us=event.by_us)
        elif isinstance(event, LinkClosed):
            self._finish(event.reason)

    def _ponged(self, event: Ponged) -> None:
        if event.stamp == self._probe:
            self._probe = _ANSWERED
        if (answer := self._pings.get(event.stamp)) is not None and not answer.done():
            answer.set_result(event.rtt)
        if self._takers is not None:
            self._takers.clock(self)

    def _marked(self, event: Marked) -> None:
        """A fence is answered on the express lane, whichever it came by; the rest is the takers'.

        One on a connection that is no longer used is not: what was in front of it was not taken.
        """
        if self._mark_to is None:
            return
        if event.kind is FrameKind.FENCE:
            (self._of or self).mark(FrameKind.FENCED, event.route, event.sequence)
        else:
            self._mark_to(event.kind, event.route, event.sequence)

    def _after(self) -> None:
        """Send what the machine has to say; a link that leaves waits for the other end, or its time."""
        if self._machine.has_output:
            self._stream.send((self._machine.take_output(),), URGENT)
            self._check_urgent()
        if self._machine.state is LinkState.CLOSING and not self._leaving:
            # Closing at once would turn what the other side still sends into a reset that overtakes our bye.
            self._leaving = True
            self._end_lanes(f"{self.name}: its express lane ends")
            self._stream.finish()
            self._arm()

    def _check_urgent(self) -> None:
        waiting = self._stream.outbox.urgent_bytes
        if waiting > limits.LINK_URGENT_BYTES:
            self.abort(f"{self.name} does not read: {waiting} bytes of control frames wait for it")

    def _end_lanes(self, reason: str) -> None:
        self.express.end()
        self.bulk.end()
        if self._bulk_link is not None:
            bulk, self._bulk_link = self._bulk_link, None
            bulk._listen(self, None)  # noqa: SLF001 - its own class
            bulk.close(reason)

    def _lost(self, error: Exception | None) -> None:
        self.silent = isinstance(error, OSError) and error.errno in _SILENCE
        reason = f"{self.name} closed the connection" if error is None else f"connection to {self.name} lost: {error}"
        self._machine.lost(reason)

    def _sever(self, reason: str) -> None:
        """End at once, where the outbox is another connection's now: not a byte of it may leave by this one."""
        self._stream.close()
        self._machine.lost(reason)

    def _finish(self, reason: str) -> None:
        if self._ended:
            return
        self._ended = True
        self._end_lanes(reason)
        if self._timer is not None:
            self._timer.cancel()
        # Not from here: this may be ``receive``, or a ``send`` in the middle of the owner's loop over its links.
        self._loop.call_soon(self._report_end, reason)

    def _report_end(self, reason: str) -> None:
        self._stream.close()
        self.use(None)
        self._let_go()
        self._end.set_result(None)
        self._owner.link_ended(self, reason, malformed=self._malformed, was_up=self.since is not None)

    def _let_go(self) -> None:
        """Break what would make a cycle: the collector finds an old one late, and what waits here may be large."""
        self.discarded = self.express.outbox.waiting_entries + self.bulk.outbox.waiting_entries
        self.express.clear()
        self.bulk.clear()
        self._machine.on_event = _ignore_event

    def _arm(self) -> None:
        due = self._machine.next_timer()
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None
        if due is not None and not self._ended:
            self._timer = self._loop.call_later(max(0.0, due - self._clock.now()), self._due)

    def _due(self) -> None:
        self._timer = None
        # A large message renews the lease while it arrives, long before the machine sees a whole frame of it.
        self._machine.heard(self._stream.last_in)
        was_up = self._machine.state is LinkState.UP
        if was_up and self.used:
            self._owner.link_tick(self)
        self._machine.handle_timer(self._clock.now())
        self.silent = was_up and self._machine.state is LinkState.CLOSED
        if was_up and not self.silent and self._clock.now() - self.heard_at > limits.GHOST_QUIET:
            self._owner.link_quiet(self)
        self._after()
        self._arm()


def _ignore(_route: int, _sequence: int, _stamp_ns: int, _payload: memoryview) -> None:
    """Data on a link that is not used (another one with the same peer is)."""


def _ignore_event(_event: Event) -> None:
    """What a link that has ended still says."""


def _ignore_part(_route: int, _sequence: int, _stamp_ns: int, _flags: int, _part: memoryview) -> None:
    """The same for data in parts."""
