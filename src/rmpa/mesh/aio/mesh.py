"""The mesh: accepts, dials and drives the links to all peers."""

from __future__ import annotations

import asyncio
import contextlib
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
from rmpa.core.backoff import Backoff
from rmpa.core.config import LaneSettings
from rmpa.core.counters import Counters, RefusalLog
from rmpa.mesh.aio.link import MeshLink, Takers
from rmpa.mesh.aio.sockets import tune_bulk, tune_express, unacknowledged
from rmpa.mesh.handshake import Lane, Refusal
from rmpa.mesh.link import Role
from rmpa.mesh.peering import REPLACED, CloseLink, Dial, LinkDown, LinkRefused, LinkUp, Output, Peering, PeerStatus

if TYPE_CHECKING:
    from collections.abc import Coroutine, Iterable

    from rmpa.core.clock import Clock
    from rmpa.core.guid import Guid
    from rmpa.core.identity import Identity
    from rmpa.mesh.handshake import Hello, Refuse, Verdict
    from rmpa.mesh.peering import Endpoint

_log = logging.getLogger(__name__)

_ACCEPTS: Final = 16
_NO_ROOM: Final = frozenset({errno.EMFILE, errno.ENFILE, errno.ENOBUFS, errno.ENOMEM})
_ORDINARY: Final = frozenset({Refusal.ALREADY_LINKED, Refusal.MYSELF, Refusal.NO_EXPRESS})

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
        dropped: Messages dropped because the peer took them too slowly.
        bulk: Whether it is a bulk lane's connection.
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
    dropped: int
    bulk: bool


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
        takers: What takes the messages that come.
        lanes: What the lanes' sockets are asked for.
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
        takers: Takers,
        lanes: LaneSettings | None = None,
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
        self._takers = takers
        self._lanes = lanes if lanes is not None else LaneSettings()
        self._clock = clock if clock is not None else SystemClock()
        self._refusals = RefusalLog(_log, self.counters)
        self._peering = Peering(identity, rng=rng, alive=self._alive)
        self._links: dict[int, MeshLink] = {}
        self._pending: set[int] = set()
        self._dialled: dict[int, Guid] = {}
        self._dials: set[asyncio.Task[None]] = set()
        self._attempts: set[asyncio.Task[socket.socket]] = set()
        self._bulk_dials: dict[int, asyncio.Task[None]] = {}
        self._bulk_backoffs: dict[int, Backoff] = {}
        self._redials: dict[int, asyncio.Task[None]] = {}
        self._rng = rng
        self._ids = count(1)
        self._timer: asyncio.TimerHandle | None = None
        self._timer_at: float | None = None
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
        dials = [*self._dials, *self._attempts, *self._bulk_dials.values(), *self._redials.values()]
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

    def _express_of(self, bulk: MeshLink) -> MeshLink | None:
        """The used link of the peer that a bulk lane's connection belongs to."""
        instance = bulk.identity.instance
        return next((k for k in self._links.values() if k.used and k.identity.instance == instance), None)

    # --- what links say (LinkOwner) -------------------------------------------------------------------------

    def link_judge(self, link: MeshLink, hello: Hello) -> Verdict:  # noqa: ARG002 - the protocol's form
        """Decide on a hello; the peers' machine knows the links that are up."""
        return self._peering.judge(hello)

    def link_opened(self, link: MeshLink) -> None:
        """A handshake ended well."""
        self._pending.discard(link.id)
        self._dialled.pop(link.id, None)
        if link.lane == Lane.BULK:
            self._bulk_opened(link)
            return
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
        if link.lane == Lane.BULK:
            return  # its end, which follows, is what makes us try again
        guid = self._dialled.pop(link.id, None)
        if guid is not None:
            self._peering.dial_refused(guid, refuse, now, link.remote_endpoint)
            self._act()

    def link_control(self, link: MeshLink, payload: bytes) -> None:
        """A control frame came."""
        if link.used:
            self._on_control(link, payload)

    def link_quiet(self, link: MeshLink) -> None:
        """A link is silent: TCP repeats ever more rarely, so try whether a new connection gets through."""
        if self._running and link.used and link.dialled and link.id not in self._redials:
            task = asyncio.get_running_loop().create_task(self._redial(link), name=f"redial {link.name}")
            self._redials[link.id] = task
            task.add_done_callback(lambda _: self._redials.pop(link.id, None))

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
        if link.lane == Lane.BULK:
            self._bulk_ended(link, reason)
            return
        if link.discarded:
            self.counters.add("link.discarded", link.discarded)
        self._bulk_backoffs.pop(link.id, None)
        guid = self._dialled.pop(link.id, None)
        if guid is not None:
            self._peering.dial_failed(guid, reason, now, link.remote_endpoint)
        if was_up:
            self._peering.link_down(link.id, reason, now, silent=link.silent)
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
            link.use(self._takers)
            _log.info("= %s: linked (%s)", output.identity, "dialled" if link.dialled else "accepted")
            self._on_link_up(link)
            self._bulk_wanted(link)
        elif isinstance(output, LinkDown):
            _log.info("= %s: link down: %s", output.identity, output.reason)
            self.counters.add("link.replaced" if output.reason == REPLACED else "link.down")
            down = self._links.get(output.link_id, ended)
            if down is not None:
                down.silent = down.silent or output.reason == REPLACED
                down.use(None)
                self._on_link_down(down, output.reason)
        elif isinstance(output, LinkRefused):
            _log.warning("! %s refuses a link: %s", output.identity, output.refuse.text)

    def _arm(self) -> None:
        due = self._peering.next_timer() if self._running else None
        if due == self._timer_at:
            return
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None
        self._timer_at = due
        if due is not None:
            self._timer = asyncio.get_running_loop().call_later(max(0.0, due - self._clock.now()), self._due)

    def _due(self) -> None:
        self._timer = self._timer_at = None
        self._peering.handle_timer(self._clock.now())
        self._act()

    def _alive(self, link_id: int) -> bool:
        link = self._links.get(link_id)
        return link is not None and self._clock.now() - link.heard_at < limits.GHOST_QUIET

    # --- bulk lanes -----------------------------------------------------------------------------------------

    def _bulk_wanted(self, link: MeshLink, delay: float = 0.0) -> None:
        """Dial a link's bulk lane, if it is ours to dial: who reached the other once will do so again."""
        ours = self._running and link.used and link.dialled
        if ours and link.bulk_link is None and link.id not in self._bulk_dials:
            task = asyncio.get_running_loop().create_task(self._dial_bulk(link, delay), name=f"bulk {link.name}")
            self._bulk_dials[link.id] = task
            task.add_done_callback(lambda _: self._bulk_dials.pop(link.id, None))

    async def _dial_bulk(self, link: MeshLink, delay: float) -> None:
        backoff = self._bulk_backoffs.setdefault(
            link.id, Backoff(limits.BACKOFF_FIRST, limits.BACKOFF_MAX, self._rng)
        )
        await asyncio.sleep(delay)
        while link.used:
            try:
                sock = await self._connect(link.remote_endpoint, Lane.BULK)
            except OSError as error:
                self.counters.add("link.bulk_failed")
                _log.debug("! %s: no bulk lane: %s", link.name, error)
                await asyncio.sleep(backoff.delay())
                continue
            self._open(sock, Role.DIALLER, link.remote_endpoint, link.guid, Lane.BULK)
            return

    def _bulk_opened(self, bulk: MeshLink) -> None:
        express = self._express_of(bulk)
        if express is None:
            bulk.close("its express lane is gone")
            return
        self._bulk_backoffs.pop(express.id, None)
        tune_bulk(bulk.sock, self._lanes, self.counters)  # an accepted one only now says what it is for
        express.attach(bulk)
        _log.debug("= %s: bulk lane (%s)", bulk.name, "dialled" if bulk.dialled else "accepted")

    def _bulk_ended(self, bulk: MeshLink, reason: str) -> None:
        """A bulk lane's connection is over, or was refused; its link goes on, and gets another."""
        expected = self._dialled.pop(bulk.id, None)
        _log.debug("= %s: bulk lane ended: %s", bulk.name, reason)
        for link in list(self._links.values()):
            ours = link.detach(bulk)
            if ours or (link.used and expected is not None and link.guid == expected):
                if link.used:
                    self.counters.add("link.bulk_lost")
                    _log.info("= %s: the bulk lane is gone (%s); small messages go on", link.name, reason)
                backoff = self._bulk_backoffs.setdefault(
                    link.id, Backoff(limits.BACKOFF_FIRST, limits.BACKOFF_MAX, self._rng)
                )
                self._bulk_wanted(link, backoff.delay())
        self._act(bulk)

    # --- connections ----------------------------------------------------------------------------------------

    async def _redial(self, link: MeshLink) -> None:
        """Replace a link whose bytes nobody acknowledges, as soon as the peer can be reached again, on any way."""
        while link.used and not self._alive(link.id):
            ways = dict.fromkeys([link.remote_endpoint, *self._peering.endpoints(link.guid)])
            try:
                sock, endpoint = await self._race(ways, self._knock)
            except OSError as error:
                _log.debug("! %s: silent, and not to be reached: %s", link.name, str(error) or "no answer")
                await asyncio.sleep(limits.REDIAL_PAUSE)
                continue
            if self._alive(link.id) or not unacknowledged(link.sock):
                _log.debug("= %s: silent, but not for want of a way to it", link.name)
                sock.close()
                return
            _log.debug("= %s: silent, but it can be reached at %s:%d: a new link", link.name, *endpoint)
            self._open(sock, Role.DIALLER, endpoint, link.guid)
            return

    async def _knock(self, endpoint: Endpoint) -> socket.socket:
        return await self._connect(endpoint, Lane.EXPRESS, limits.REDIAL_TIMEOUT)

    async def _reach(self, endpoint: Endpoint) -> socket.socket:
        """Connect; a lost SYN is repeated by new attempts, for TCP would take a second."""
        *hasty, patient = limits.DIAL_ATTEMPTS
        for within in hasty:
            with contextlib.suppress(TimeoutError):
                return await self._connect(endpoint, Lane.EXPRESS, within)
        return await self._connect(endpoint, Lane.EXPRESS, patient)

    async def _race(
        self, endpoints: Iterable[Endpoint], attempt: Callable[[Endpoint], Coroutine[object, object, socket.socket]]
    ) -> tuple[socket.socket, Endpoint]:
        """Connect where somebody answers first (RFC 8305).

        The next endpoint has its turn when the one before it failed, or has been silent for ``limits.DIAL_STAGGER``.

        Raises:
            OSError: Nobody answers anywhere; the error is the first endpoint's.
        """
        left = list(endpoints)
        if len(left) == 1:
            return await attempt(left[0]), left[0]
        running: dict[asyncio.Task[socket.socket], Endpoint] = {}
        first: OSError | None = None
        try:
            while left or running:
                if left:
                    endpoint = left.pop(0)
                    task = asyncio.get_running_loop().create_task(attempt(endpoint))
                    running[task] = endpoint
                    self._attempts.add(task)
                    task.add_done_callback(self._attempts.discard)
                pause = limits.DIAL_STAGGER if left else None
                done, _ = await asyncio.wait(running, timeout=pause, return_when=asyncio.FIRST_COMPLETED)
                for task in [task for task in running if task in done]:
                    endpoint = running.pop(task)
                    try:
                        return task.result(), endpoint
                    except OSError as error:  # TimeoutError is one, no file descriptor for the socket another
                        first = first if first is not None else error
        finally:
            for task in running:  # not awaited: who is linked has better to do
                task.add_done_callback(_close_late)
                task.cancel()
        raise first if first is not None else OSError(errno.EHOSTUNREACH, os.strerror(errno.EHOSTUNREACH))

    async def _connect(
        self, endpoint: tuple[str, int], lane: Lane, within: float = limits.DIAL_TIMEOUT
    ) -> socket.socket:
        sock = socket.socket(socket.AF_INET, socket.SOCK_STREAM | socket.SOCK_NONBLOCK)
        try:
            (tune_bulk if lane is Lane.BULK else tune_express)(sock, self._lanes, self.counters)
            async with asyncio.timeout(within):
                await asyncio.get_running_loop().sock_connect(sock, endpoint)
        except BaseException:
            sock.close()
            raise
        return sock

    async def _dial(self, dial: Dial) -> None:
        places = ", ".join(f"{host}:{port}" for host, port in dial.endpoints)
        _log.debug("> dialling %s at %s", dial.guid, places)
        try:
            sock, endpoint = await self._race(dial.endpoints, self._reach)
        except OSError as error:
            self.counters.add("link.dial_failed")
            problem = os.strerror(error.errno) if error.errno else f"no answer within {limits.DIAL_TIMEOUT:g} s"
            self._peering.dial_failed(dial.guid, f"{places}: {problem}", self._clock.now())
            self._act()
        else:
            self._open(sock, Role.DIALLER, endpoint, dial.guid)

    def _open(
        self,
        sock: socket.socket,
        role: Role,
        endpoint: tuple[str, int],
        expected: Guid | None = None,
        lane: Lane = Lane.EXPRESS,
    ) -> None:
        link_id = next(self._ids)
        if expected is not None:
            self._dialled[link_id] = expected
        if role is Role.ACCEPTOR:
            self._pending.add(link_id)
        self._links[link_id] = MeshLink(
            link_id,
            sock,
            role,
            self.identity,
            owner=self,
            clock=self._clock,
            endpoint=endpoint,
            expected=expected,
            lane=lane,
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
            tune_express(sock, self._lanes, self.counters)
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


def _close_late(task: asyncio.Task[socket.socket]) -> None:
    """Somebody else was faster: close what came of an attempt all the same."""
    if not task.cancelled() and task.exception() is None:
        task.result().close()


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
        link.dropped,
        link.lane == Lane.BULK,
    )
