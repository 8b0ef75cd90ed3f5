"""Drives one link machine by one stream and one timer."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING, Protocol

from rmpa.core import limits
from rmpa.core.aio.stream import Stream
from rmpa.core.errors import RemoteProtocolError
from rmpa.core.outbox import URGENT, Outbox
from rmpa.mesh.frames import pack_data_header
from rmpa.mesh.link import Closed, ControlReceived, Event, HelloReceived, Link, Ponged, Refused, Role, State, Up

if TYPE_CHECKING:
    import socket
    from collections import Counter

    from rmpa.core.clock import Clock
    from rmpa.core.guid import Guid
    from rmpa.core.identity import Identity
    from rmpa.mesh.handshake import Hello, Refuse, Verdict

_log = logging.getLogger(__name__)

Buffer = bytes | bytearray | memoryview
OnLinkData = Callable[["MeshLink", int, int, int, memoryview], None]


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

    def link_ended(self, link: MeshLink, reason: str, *, malformed: bool, was_up: bool) -> None:
        """The socket is closed, once a link."""
        ...


class MeshLink:
    """One link, as the rooms above see it.

    Args:
        link_id: The mesh's number for it.
        sock: Connected, non-blocking; owned by the link from here on.
        role: Whether we dialled.
        ours: Who we are.
        owner: Whom it tells.
        clock: The time.
        expected: Whom we believe we dialled.
        endpoint: The other end's address and port.
    """

    def __init__(
        self,
        link_id: int,
        sock: socket.socket,
        role: Role,
        ours: Identity,
        *,
        owner: LinkOwner,
        clock: Clock,
        endpoint: tuple[str, int],
        expected: Guid | None = None,
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
        self._malformed = False
        self.used = False
        """Whether this is the link that is used with its peer."""
        self._outbox = Outbox(limits.ROUTE_QUEUE_MESSAGES, limits.LINK_QUEUE_BYTES)
        self._stream = Stream(sock, on_bytes=self._take, on_close=self._lost, outbox=self._outbox)
        self._machine = Link(
            role,
            ours,
            clock.now(),
            wall_ns=clock.wall_ns,
            on_event=self._event,
            on_data=_ignore,
            expected=expected,
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
        return self._machine.role is Role.DIALLER

    @property
    def up(self) -> bool:
        """Whether messages go through."""
        return self._machine.state is State.UP and not self._ended

    @property
    def state(self) -> State:
        """The machine's state."""
        return self._machine.state

    @property
    def lane(self) -> int:
        """What the connection is for (``handshake.Lane``); only once it is up."""
        return self._hello.lane

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
    def bytes_in(self) -> int:
        """Bytes received, headers included."""
        return self._stream.bytes_in

    @property
    def bytes_out(self) -> int:
        """Bytes that the kernel took, headers included."""
        return self._stream.bytes_out

    @property
    def queue_bytes(self) -> int:
        """Bytes that wait for the kernel."""
        return self._outbox.pending_bytes

    @property
    def dropped(self) -> Counter[int]:
        """Messages dropped so far, by route."""
        return self._outbox.dropped

    @property
    def heard_at(self) -> float:
        """Monotonic seconds at which bytes last came."""
        return max(self._machine.heard_at, self._stream.last_in)

    def send_data(self, route: int, sequence: int, stamp_ns: int, payload: Buffer) -> int:
        """Send one message; what the socket does not take is queued, keep-last, and copied only then.

        Args:
            route: The route's id, 32 bits.
            sequence: The message's number on its route; its low 32 bits are sent.
            stamp_ns: When it was published, wall clock.
            payload: Its bytes, not kept after the call.

        Returns:
            How many older messages were dropped to make room. Without effect (0) once the link is leaving.
        """
        if self._machine.state is not State.UP:
            return 0
        return self._stream.send((pack_data_header(len(payload), route, sequence, stamp_ns), payload), route)

    def send_control(self, payload: bytes) -> None:
        """Send one control frame, before all data that waits; never dropped.

        If more than ``limits.LINK_URGENT_BYTES`` wait the link is closed: the other side does not read.
        """
        if self._machine.state is not State.UP:
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

    def close_route(self, route: int) -> int:
        """Discard what waits of a closed route; return how many messages that were. Its drop count ends too."""
        self._outbox.dropped.pop(route, None)
        return self._outbox.discard(route)

    def close(self, reason: str) -> None:
        """Say bye, let the last bytes leave for at most ``limits.DRAIN_TIMEOUT``, and close."""
        self._machine.close(reason, self._clock.now())
        self._after()

    def abort(self, reason: str) -> None:
        """Close at once, without a word."""
        self._machine.lost(reason)

    async def ended(self) -> None:
        """Wait until the socket is closed and the owner knows."""
        await asyncio.shield(self._end)

    def use(self, on_data: OnLinkData | None) -> None:
        """Whether this is the link that is used with its peer: data goes to ``on_data``, or nowhere."""
        self.used = on_data is not None
        self._machine.on_data = _ignore if on_data is None else partial(on_data, self)

    # --- inside ---------------------------------------------------------------------------------------------

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
        elif isinstance(event, Ponged):
            if (answer := self._pings.get(event.stamp)) is not None and not answer.done():
                answer.set_result(event.rtt)
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
            self._owner.link_opened(self)
        elif isinstance(event, Refused):
            self._owner.link_refused(self, event.refuse, by_us=event.by_us)
        elif isinstance(event, Closed):
            self._finish(event.reason)

    def _after(self) -> None:
        """Send what the machine has to say; a link that leaves waits for the other end, or its time."""
        if self._machine.has_output:
            self._stream.send((self._machine.take_output(),), URGENT)
            self._check_urgent()
        if self._machine.state is State.CLOSING and not self._leaving:
            # Closing at once would turn what the other side still sends into a reset that overtakes our bye.
            self._leaving = True
            self._stream.finish()
            self._arm()

    def _check_urgent(self) -> None:
        if self._outbox.urgent_bytes > limits.LINK_URGENT_BYTES:
            self.abort(f"{self.name} does not read: {self._outbox.urgent_bytes} bytes of control frames wait for it")

    def _lost(self, error: Exception | None) -> None:
        reason = f"{self.name} closed the connection" if error is None else f"connection to {self.name} lost: {error}"
        self._machine.lost(reason)

    def _finish(self, reason: str) -> None:
        if self._ended:
            return
        self._ended = True
        if self._timer is not None:
            self._timer.cancel()
        # Not from here: this may be ``receive``, or a ``send`` in the middle of the owner's loop over its links.
        self._loop.call_soon(self._report_end, reason)

    def _report_end(self, reason: str) -> None:
        self._stream.close()
        self.use(None)
        self._end.set_result(None)
        self._owner.link_ended(self, reason, malformed=self._malformed, was_up=self.since is not None)

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
        self._machine.handle_timer(self._clock.now())
        self._after()
        self._arm()


def _ignore(_route: int, _sequence: int, _stamp_ns: int, _payload: memoryview) -> None:
    """Data on a link that is not used (another one with the same peer is)."""
