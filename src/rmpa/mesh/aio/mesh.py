"""The mesh: accepts, dials and drives the links to all peers."""

from __future__ import annotations

import asyncio
import errno
import logging
import os
import random
import socket
from collections.abc import Callable
from dataclasses import dataclass
from itertools import count
from typing import TYPE_CHECKING, Final, Literal

from rmpa.core import limits
from rmpa.core.aio.clock import SystemClock
from rmpa.core.counters import Counters, RefusalLog
from rmpa.mesh.aio.link import MeshLink, OnLinkData
from rmpa.mesh.aio.sockets import tune_express
from rmpa.mesh.handshake import Refusal
from rmpa.mesh.link import Role
from rmpa.mesh.peering import CloseLink, Dial, LinkDown, LinkRefused, LinkUp, Output, Peering, PeerStatus

if TYPE_CHECKING:
    from rmpa.core.clock import Clock
    from rmpa.core.guid import Guid
    from rmpa.core.identity import Identity
    from rmpa.mesh.handshake import Hello, Refuse, Verdict

_log = logging.getLogger(__name__)

_ACCEPTS: Final = 16
_NO_ROOM: Final = frozenset({errno.EMFILE, errno.ENFILE, errno.ENOBUFS, errno.ENOMEM})
_ORDINARY: Final = frozenset({Refusal.ALREADY_LINKED, Refusal.MYSELF})

OnLinkUp = Callable[[MeshLink], None]
OnLinkDown = Callable[[MeshLink, str], None]
OnControl = Callable[[MeshLink, bytes], None]


@dataclass(frozen=True, slots=True)
class LinkStatus:
    """One connection, for the monitor. Times in monotonic seconds, sizes in bytes.

    Args:
        id: The mesh's number for it.
        name: The other side's name, or its address before it said its name.
        guid: The other side's, once known.
        state: ``handshaking``, ``up``, ``closing`` or ``closed``.
        used: Whether it is the link that is used with its peer.
        dialled: Whether we dialled.
        remote_endpoint: The other end.
        since: When it came up.
        rtt: The last round trip in seconds.
        clock_offset: Seconds that the other side's wall clock is ahead of ours.
        clock_error: The offset is true within ± this.
        bytes_in: Received.
        bytes_out: Sent.
        queue_bytes: Waiting for the kernel.
        dropped: Messages dropped, by route.
    """

    id: int
    name: str
    guid: Guid | None
    state: Literal["handshaking", "up", "closing", "closed"]
    used: bool
    dialled: bool
    remote_endpoint: tuple[str, int]
    since: float | None
    rtt: float | None
    clock_offset: float | None
    clock_error: float | None
    bytes_in: int
    bytes_out: int
    queue_bytes: int
    dropped: dict[int, int]


class Mesh:
    """The links to all peers, one used link a peer.

    Each ``on_link_up`` is followed by exactly one ``on_link_down`` of the same link, and what comes on it lies in
    between. All callbacks are called from the loop; they may call any method.

    Args:
        identity: Who we are; the listening socket's port is in its GUID.
        listen_socket: Bound and listening, non-blocking; owned by the mesh from here on.
        on_link_up: A peer is linked.
        on_link_down: It is no more, and why.
        on_control: ``(link, payload)``: a control frame came.
        on_data: ``(link, route, sequence, stamp_ns, payload)``: a message came; the payload is only valid
            during the call.
        clock: The time; its ``now`` must be the loop's own clock.
        counters: Where refusals and failures are counted.
        rng: Uniform numbers in [0, 1), for jitter.
    """

    def __init__(
        self,
        identity: Identity,
        listen_socket: socket.socket,
        *,
        on_link_up: OnLinkUp,
        on_link_down: OnLinkDown,
        on_control: OnControl,
        on_data: OnLinkData,
        clock: Clock | None = None,
        counters: Counters | None = None,
        rng: Callable[[], float] = random.random,
    ) -> None:
        self.identity = identity
        self.counters = counters if counters is not None else Counters()
        self._listen = listen_socket
        self._on_link_up = on_link_up
        self._on_link_down = on_link_down
        self._on_control = on_control
        self._on_data = on_data
        self._clock = clock if clock is not None else SystemClock()
        self._refusals = RefusalLog(_log, self.counters)
        self._peering = Peering(identity, rng=rng, alive=self._alive)
        self._links: dict[int, MeshLink] = {}
        self._pending: set[int] = set()
        self._dialled: dict[int, Guid] = {}
        self._dials: set[asyncio.Task[None]] = set()
        self._ids = count(1)
        self._timer: asyncio.TimerHandle | None = None
        self._accept_timer: asyncio.TimerHandle | None = None
        self._acting = False
        self._running = False

    async def start(self) -> None:
        """Begin to accept and to dial; peers may have been found before."""
        self._running = True
        self._listen.setblocking(False)
        asyncio.get_running_loop().add_reader(self._listen.fileno(), self._acceptable)
        self._act()

    async def close(self) -> None:
        """Say bye on every link, wait at most ``limits.DRAIN_TIMEOUT``, and close all sockets."""
        if not self._running:
            self._listen.close()
            return
        self._running = False
        asyncio.get_running_loop().remove_reader(self._listen.fileno())
        self._listen.close()
        for timer in (self._timer, self._accept_timer):
            if timer is not None:
                timer.cancel()
        dials = list(self._dials)
        for task in dials:
            task.cancel()
        await asyncio.gather(*dials, return_exceptions=True)
        links = list(self._links.values())
        for link in links:
            link.close(f"{self.identity.name} ends")
        ends = [asyncio.ensure_future(link.ended()) for link in links]
        if ends:
            _, late = await asyncio.wait(ends, timeout=limits.DRAIN_TIMEOUT)
            for link in list(self._links.values()):
                link.abort("the bye was not answered in time")
            if late:
                await asyncio.wait(late)

    def peer_found(self, identity: Identity, source: str | None = None) -> None:
        """Discovery knows a peer, or knows it better.

        Args:
            identity: Who; its addresses are dialled in turn.
            source: The address that its own beacon came from, dialled first.
        """
        self._peering.peer_found(identity, self._clock.now(), source)
        self._act()

    def peer_gone(self, guid: Guid) -> None:
        """Discovery gave a peer up: it is dialled no more; a link that is up stays."""
        self._peering.peer_gone(guid, self._clock.now())
        self._act()

    def peers(self) -> list[PeerStatus]:
        """All known peers: linked, or why not and when next."""
        return self._peering.peers()

    def links(self) -> list[LinkStatus]:
        """All connections, those without a handshake too."""
        return [_status(link) for link in self._links.values()]

    def link(self, guid: Guid) -> MeshLink | None:
        """The link that is used with this peer."""
        return next((k for k in self._links.values() if k.used and k.guid == guid), None)

    # --- what links say (LinkOwner) -------------------------------------------------------------------------

    def link_judge(self, link: MeshLink, hello: Hello) -> Verdict:  # noqa: ARG002 - the protocol's form
        """Decide on a hello; the peers' machine knows the links that are up."""
        return self._peering.judge(hello)

    def link_opened(self, link: MeshLink) -> None:
        """A handshake ended well."""
        self._pending.discard(link.id)
        self._dialled.pop(link.id, None)
        self._peering.link_up(
            link.id, link.identity, self._clock.now(), dialled=link.dialled, endpoint=link.remote_endpoint
        )
        self._act()

    def link_refused(self, link: MeshLink, refuse: Refuse, *, by_us: bool) -> None:
        """A handshake ended with a no."""
        now = self._clock.now()
        if refuse.code in _ORDINARY:
            self.counters.add(f"link.refused.{refuse.label}")
            _log.debug("! %s: %s", link.name, refuse)
        elif by_us:
            text = f"refused a link with {link.name} at {link.remote_endpoint[0]}: {refuse.text}"
            self._refusals.refuse(now, f"link.refused.{refuse.label}", link.remote_endpoint[0], text)
        guid = self._dialled.pop(link.id, None)
        if guid is not None:
            self._peering.dial_refused(guid, refuse, now)
            self._act()

    def link_control(self, link: MeshLink, payload: bytes) -> None:
        """A control frame came."""
        if link.used:
            self._on_control(link, payload)

    def link_ended(self, link: MeshLink, reason: str, *, malformed: bool, was_up: bool) -> None:
        """A socket is closed."""
        now = self._clock.now()
        self._links.pop(link.id, None)
        self._pending.discard(link.id)
        if malformed:
            self._refusals.refuse(now, "link.malformed", link.remote_endpoint[0], reason)
        elif not was_up and not link.dialled:
            self.counters.add("link.unfinished")
            _log.debug("! %s: %s", link.name, reason)
        guid = self._dialled.pop(link.id, None)
        if guid is not None:
            self._peering.dial_failed(guid, reason, now)
        if was_up:
            self._peering.link_down(link.id, reason, now)
        self._act(link)

    # --- acting on the peers' machine -----------------------------------------------------------------------

    def _act(self, ended: MeshLink | None = None) -> None:
        """Do what the machine decided; a call from within a callback leaves it to the outer one."""
        if self._acting:
            return
        self._acting = True
        try:
            while outputs := self._peering.take():
                for output in outputs:
                    self._do(output, ended)
        finally:
            self._acting = False
        self._arm()

    def _do(self, output: Output, ended: MeshLink | None) -> None:
        if isinstance(output, Dial):
            if self._running:
                task = asyncio.get_running_loop().create_task(self._dial(output), name=f"dial {output.guid}")
                self._dials.add(task)
                task.add_done_callback(self._dials.discard)
        elif isinstance(output, CloseLink):
            if (link := self._links.get(output.link_id)) is not None:
                link.close(output.reason)
        elif isinstance(output, LinkUp):
            link = self._links[output.link_id]
            link.use(self._on_data)
            _log.info("= %s: linked (%s)", output.identity, "dialled" if link.dialled else "accepted")
            self._on_link_up(link)
        elif isinstance(output, LinkDown):
            _log.info("= %s: link down: %s", output.identity, output.reason)
            down = self._links.get(output.link_id, ended)
            if down is not None:
                down.use(None)
                self._on_link_down(down, output.reason)
        elif isinstance(output, LinkRefused):
            _log.warning("! %s refuses a link: %s", output.identity, output.refuse.text)

    def _arm(self) -> None:
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None
        due = self._peering.next_timer()
        if due is not None and self._running:
            self._timer = asyncio.get_running_loop().call_later(max(0.0, due - self._clock.now()), self._due)

    def _due(self) -> None:
        self._timer = None
        self._peering.handle_timer(self._clock.now())
        self._act()

    def _alive(self, link_id: int) -> bool:
        link = self._links.get(link_id)
        return link is not None and self._clock.now() - link.heard_at < limits.GHOST_QUIET

    # --- connections ----------------------------------------------------------------------------------------

    async def _dial(self, dial: Dial) -> None:
        host, port = dial.endpoint
        _log.debug("> dialling %s at %s:%d", dial.guid, host, port)
        sock: socket.socket | None = None
        try:
            sock = socket.socket(socket.AF_INET, socket.SOCK_STREAM | socket.SOCK_NONBLOCK)
            tune_express(sock, self.counters)
            async with asyncio.timeout(limits.DIAL_TIMEOUT):
                await asyncio.get_running_loop().sock_connect(sock, dial.endpoint)
        except OSError as error:  # TimeoutError is one, no file descriptor for the socket another
            if sock is not None:
                sock.close()
            self.counters.add("link.dial_failed")
            problem = os.strerror(error.errno) if error.errno else f"no answer within {limits.DIAL_TIMEOUT:g} s"
            self._peering.dial_failed(dial.guid, f"{host}:{port}: {problem}", self._clock.now())
            self._act()
        except BaseException:
            if sock is not None:
                sock.close()
            raise
        else:
            self._open(sock, Role.DIALLER, dial.endpoint, dial.guid)

    def _open(self, sock: socket.socket, role: Role, endpoint: tuple[str, int], expected: Guid | None = None) -> None:
        link_id = next(self._ids)
        if expected is not None:
            self._dialled[link_id] = expected
        if role is Role.ACCEPTOR:
            self._pending.add(link_id)
        self._links[link_id] = MeshLink(
            link_id, sock, role, self.identity, owner=self, clock=self._clock, endpoint=endpoint, expected=expected
        )

    def _acceptable(self) -> None:
        for _ in range(_ACCEPTS):
            try:
                sock, address = self._listen.accept()
            except (BlockingIOError, InterruptedError, ConnectionAbortedError):
                return
            except OSError as error:
                self._accept_failed(error)
                return
            if not self._has_room(address[0]):
                sock.close()
                continue
            sock.setblocking(False)
            tune_express(sock, self.counters)
            self._open(sock, Role.ACCEPTOR, (address[0], address[1]))

    def _accept_failed(self, error: OSError) -> None:
        """Pause when the process has no room; a listening socket stays readable and would spin the loop."""
        text = f"cannot accept links: {error.strerror}; retrying every {limits.ACCEPT_PAUSE:g} s"
        if error.errno in _NO_ROOM:
            text += " (raise the limit of open files: ulimit -n, LimitNOFILE)"
        self._refusals.refuse(self._clock.now(), "link.accept_failed", "", text)
        loop = asyncio.get_running_loop()
        loop.remove_reader(self._listen.fileno())
        self._accept_timer = loop.call_later(
            limits.ACCEPT_PAUSE, lambda: loop.add_reader(self._listen.fileno(), self._acceptable)
        )

    def _has_room(self, address: str) -> bool:
        there = sum(self._links[k].remote_endpoint[0] == address for k in self._pending)
        if len(self._pending) < limits.PENDING_LINKS_MAX and there < limits.PENDING_PER_ADDRESS:
            return True
        text = f"closed a connection from {address}: too many have not said who they are ({there} from there)"
        self._refusals.refuse(self._clock.now(), "link.pending_full", address, text)
        return False


def _status(link: MeshLink) -> LinkStatus:
    names: dict[str, Literal["handshaking", "up", "closing", "closed"]] = {
        "HANDSHAKING": "handshaking",
        "UP": "up",
        "CLOSING": "closing",
        "CLOSED": "closed",
    }
    return LinkStatus(
        link.id,
        link.name,
        link.remote_guid,
        names[link.state.name],
        link.used,
        link.dialled,
        link.remote_endpoint,
        link.since,
        link.rtt,
        link.clock_offset,
        link.clock_error,
        link.bytes_in,
        link.bytes_out,
        link.queue_bytes,
        dict(link.dropped),
    )
