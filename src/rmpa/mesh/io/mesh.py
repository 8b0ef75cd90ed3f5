"""The mesh: accepts, dials and drives the links to all peers."""

from __future__ import annotations

import asyncio
import contextlib
import errno
import logging
import os
import random
from collections.abc import Callable
from itertools import count
from typing import TYPE_CHECKING, Final

from rmpa.config.settings import LaneSettings
from rmpa.core.backoff import Backoff
from rmpa.core.counters import Counters, RefusalLog
from rmpa.mesh import limits
from rmpa.mesh.handshake import Lane, Refusal
from rmpa.mesh.io.link import LinkHandlers, MeshLink
from rmpa.mesh.io.path_monitor import PathMonitor
from rmpa.mesh.io.sockets import limit_segments, tune_bulk, tune_express, unacknowledged
from rmpa.mesh.io.status import LinkStatus, link_status
from rmpa.mesh.link import LinkRole
from rmpa.mesh.peering import REPLACED, CloseLink, Dial, LinkDown, LinkRefused, LinkUp, Output, Peering, PeerStatus
from rmpa.runtime import limits as runtime_limits
from rmpa.runtime.acceptor import Acceptor
from rmpa.runtime.descriptors import DESCRIPTORS, Use
from rmpa.runtime.system_clock import SystemClock

if TYPE_CHECKING:
    import socket
    from collections.abc import Coroutine, Iterable

    from rmpa.core.clock import Clock
    from rmpa.core.guid import Guid
    from rmpa.core.identity import Identity
    from rmpa.mesh.handshake import Hello, Refuse, Verdict
    from rmpa.mesh.peering import Endpoint

_log = logging.getLogger(__name__)

_ORDINARY: Final = frozenset({Refusal.ALREADY_LINKED, Refusal.MYSELF, Refusal.NO_EXPRESS})

OnLinkUp = Callable[[MeshLink], None]
OnLinkDown = Callable[[MeshLink, str], None]
OnControl = Callable[[MeshLink, bytes], None]


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
        takers: LinkHandlers,
        lanes: LaneSettings | None = None,
        clock: Clock | None = None,
        counters: Counters | None = None,
        rng: Callable[[], float] = random.random,
    ) -> None:
        self.identity = identity
        self.counters = counters if counters is not None else Counters()
        self._acceptor = Acceptor(listen_socket, self._accepted, name="links to peers", use=Use.LINK)
        self._on_link_up = on_link_up
        self._on_link_down = on_link_down
        self._on_control = on_control
        self._takers = takers
        self._lanes = lanes if lanes is not None else LaneSettings()
        self._clock = clock if clock is not None else SystemClock()
        self._refusals = RefusalLog(_log, self.counters)
        self.paths = PathMonitor(self._clock, self.counters, self._answers)
        """What packets get through to the peers."""
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
        self._acting = False
        self._running = False

    async def start(self) -> None:
        """Begin to accept and to dial; peers may have been found before."""
        self._running = True
        self._acceptor.start()
        self._act()

    async def close(self) -> None:
        """Say bye on every link, wait at most ``limits.DRAIN_TIMEOUT``, and close all sockets."""
        self._acceptor.close()
        if not self._running:
            return
        self._running = False
        if self._timer is not None:
            self._timer.cancel()
        dials = [
            *self.paths.close(),
            *self._dials,
            *self._attempts,
            *self._bulk_dials.values(),
            *self._redials.values(),
        ]
        for task in dials:
            task.cancel()
        await asyncio.gather(*dials, return_exceptions=True)
        links = list(self._links.values())
        for link in links:
            link.close(f"{self.identity.name} ends")
        ends = [asyncio.ensure_future(link.ended()) for link in links]
        if ends:
            _, late = await asyncio.wait(ends, timeout=runtime_limits.DRAIN_TIMEOUT)
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
        return [link_status(link) for link in self._links.values()]

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
            task.add_done_callback(_report)

    def link_tick(self, link: MeshLink) -> None:
        """See whether what a link sends gets through."""
        if self._running:
            self.paths.look(link)

    def link_ended(self, link: MeshLink, reason: str, *, malformed: bool, was_up: bool) -> None:
        """A socket is closed."""
        now = self._clock.now()
        self.paths.ended(link)
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
                task.add_done_callback(_report)
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
            task.add_done_callback(_report)

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
            if _is_over(link):
                sock.close()  # the link ended meanwhile
                return
            self._open(sock, LinkRole.DIALLER, link.remote_endpoint, link.guid, Lane.BULK)
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
            try:
                sock, endpoint = await self._race(self._ways(link), self._knock)
            except OSError as error:
                _log.debug("! %s: silent, and not to be reached: %s", link.name, str(error) or "no answer")
                await asyncio.sleep(limits.REDIAL_PAUSE)
                continue
            if _is_over(link):
                # It ended meanwhile, and its socket with it: who is dialled next is decided by the peers' machine.
                sock.close()
                return
            if self._alive(link.id) or not unacknowledged(link.sock):
                _log.debug("= %s: silent, but not for want of a way to it", link.name)
                sock.close()
                return
            _log.debug("= %s: silent, but it can be reached at %s:%d: a new link", link.name, *endpoint)
            self._open(sock, LinkRole.DIALLER, endpoint, link.guid)
            return

    async def _answers(self, link: MeshLink) -> bool:
        """Whether the peer of a link takes a new connection, on the path of this one."""
        host = link.remote_endpoint[0]
        ways = [link.remote_endpoint] if link.dialled else [e for e in self._ways(link) if e[0] == host]
        try:
            sock, _ = await self._race(ways, self._knock)
        except OSError:
            return False
        sock.close()
        return True

    def _ways(self, link: MeshLink) -> list[Endpoint]:
        """Where the peer of a link may be reached."""
        return list(dict.fromkeys([link.remote_endpoint, *self._peering.endpoints(link.guid)]))

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
        sock = DESCRIPTORS.open_socket(Use.LINK, what=f"a link to {endpoint[0]}:{endpoint[1]}")
        try:
            (tune_bulk if lane is Lane.BULK else tune_express)(sock, self._lanes, self.counters)
            if lane is Lane.EXPRESS and not endpoint[0].startswith("127."):
                # Both ways. Not the bulk lane's: several such segments may still leave as one packet.
                limit_segments(sock, limits.EXPRESS_SEGMENT, self.counters)
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
            self._open(sock, LinkRole.DIALLER, endpoint, dial.guid)

    def _open(
        self,
        sock: socket.socket,
        role: LinkRole,
        endpoint: tuple[str, int],
        expected: Guid | None = None,
        lane: Lane = Lane.EXPRESS,
    ) -> None:
        link_id = next(self._ids)
        if expected is not None:
            self._dialled[link_id] = expected
        if role is LinkRole.ACCEPTOR:
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
            segment=self.paths.segment(endpoint[0]),
        )

    def _accepted(self, sock: socket.socket, address: tuple[str, int]) -> None:
        if not self._has_room(address[0]):
            sock.close()
            return
        tune_express(sock, self._lanes, self.counters)
        self._open(sock, LinkRole.ACCEPTOR, address)

    def _has_room(self, address: str) -> bool:
        there = sum(self._links[k].remote_endpoint[0] == address for k in self._pending)
        if len(self._pending) < limits.PENDING_LINKS_MAX and there < limits.PENDING_PER_ADDRESS:
            return True
        text = f"closed a connection from {address}: too many have not said who they are ({there} from there)"
        self._refusals.refuse(self._clock.now(), "link.pending_full", address, text)
        return False


def _is_over(link: MeshLink) -> bool:
    """Whether a link was left or has ended; for behind an ``await``."""
    return not link.used


def _report(task: asyncio.Task[None]) -> None:
    """Log what a dial failed of beyond what it expects: a bug, and no one awaits the task."""
    if not task.cancelled() and (error := task.exception()) is not None:
        _log.error("! %s failed", task.get_name(), exc_info=error)


def _close_late(task: asyncio.Task[socket.socket]) -> None:
    """Somebody else was faster: close what came of an attempt all the same."""
    if not task.cancelled() and task.exception() is None:
        task.result().close()
