"""The mesh: accepts, dials and drives the connections to all peers, and joins them to one link a peer."""

from __future__ import annotations

import asyncio
import logging
import os
import random
from collections.abc import Callable
from itertools import count
from typing import TYPE_CHECKING, Final

from rmpa.config.settings import LaneSettings
from rmpa.core.counters import Counters, RefusalLog
from rmpa.mesh import limits
from rmpa.mesh.connection import ConnectionRole
from rmpa.mesh.frames import FULL, Lane, Refusal, Refuse
from rmpa.mesh.io.connection import Connection
from rmpa.mesh.io.dial import Dialler, Redials, bound_queue, is_over, tune_bulk, tune_express
from rmpa.mesh.io.link import BulkLanes, LinkHandlers, PeerLink
from rmpa.mesh.io.securing import Securing, SecuringError, prove, secure_dialled
from rmpa.mesh.keepalive import (
    CloseLink,
    Dial,
    LinkDown,
    LinkDownCause,
    LinkRefused,
    LinkUp,
    PeeringOutput,
    PeerStatus,
    RestPace,
)
from rmpa.mesh.peering import Peering
from rmpa.runtime import limits as runtime_limits
from rmpa.runtime.accept import Acceptor, Use
from rmpa.runtime.loop import MachineTimer, SystemClock
from rmpa.trust.permissions import TrustReason

if TYPE_CHECKING:
    import socket
    from collections.abc import Coroutine

    from rmpa.core.identity import Guid, Identity
    from rmpa.mesh.frames import Hello
    from rmpa.mesh.io.securing import OnJoin, SecuredSocket
    from rmpa.mesh.keepalive import SocketAddress
    from rmpa.trust.membership import Membership

_log = logging.getLogger(__name__)

_ORDINARY: Final = frozenset({Refusal.ALREADY_LINKED, Refusal.MYSELF, Refusal.NO_EXPRESS})
"""Refusals that are part of the normal course, and are not logged as warnings."""

_TRUST: Final = frozenset(TrustReason)

OnLinkUp = Callable[[PeerLink], None]
OnLinkDown = Callable[[PeerLink, LinkDown], None]
OnControl = Callable[[PeerLink, bytes], None]


class Mesh:
    """The links to all peers; of several links with one peer, one is used.

    Each ``on_link_up`` is followed by exactly one ``on_link_down`` of the same link; the link's data is delivered in
    between. All callbacks are called from the event loop; they may call any method.

    Args:
        identity: The identity of this agent; the listening socket's port is in its GUID.
        listen_socket: Bound and listening, non-blocking; owned by the mesh from here on.
        on_link_up: A peer is linked.
        on_link_down: A peer's link is no longer used, with the reason.
        on_control: ``(link, payload)``: a control frame was received.
        handlers: The handlers of received messages.
        lanes: The options of the lanes' sockets.
        clock: The time; its ``now`` must be the loop's own clock.
        counters: Where refusals and failures are counted.
        rng: Uniform numbers in [0, 1), for jitter.
        dialler: Opens the connections; by default real ones.
        security: This module's membership of a secured mesh: all links use TLS then; ``None``: none does.
        on_join: Serves accepted connections for a join or a renewal; ``None``: this module is not the authority.
    """

    def __init__(
        self,
        identity: Identity,
        listen_socket: socket.socket,
        *,
        on_link_up: OnLinkUp,
        on_link_down: OnLinkDown,
        on_control: OnControl,
        handlers: LinkHandlers,
        lanes: LaneSettings | None = None,
        clock: SystemClock | None = None,
        counters: Counters | None = None,
        rng: Callable[[], float] = random.random,
        dialler: Dialler | None = None,
        security: Membership | None = None,
        on_join: OnJoin | None = None,
    ) -> None:
        self.identity = identity
        self.counters = counters if counters is not None else Counters()
        self.handlers: Final = handlers
        self._acceptor = Acceptor(listen_socket, self._accepted, name="links to peers", use=Use.LINK)
        self._on_link_up = on_link_up
        self._on_link_down = on_link_down
        self._on_control = on_control
        self._lanes = lanes if lanes is not None else LaneSettings()
        self._clock = clock if clock is not None else SystemClock()
        self._refusals = RefusalLog(_log, self.counters)
        self.dialler: Final = dialler if dialler is not None else Dialler(self._lanes, self.counters)
        self._peering = Peering(identity, rng=rng, alive=self._alive)
        self._timer = MachineTimer(self._peering.next_timer, self._due, now=self._clock.now)
        self._connections: dict[int, Connection] = {}
        self._links: dict[int, PeerLink] = {}
        """The links, by the id of the express lane's connection."""
        self._pending: set[int] = set()
        """Accepted connections without a handshake."""
        self._dialled: dict[int, Guid] = {}
        """Dialled connections without a finished handshake, each with the peer or link that it was dialled for."""
        self._dials: set[asyncio.Task[None]] = set()
        self._redials = Redials(
            self.dialler,
            start=self._start,
            alive=self._alive,
            endpoints=self._endpoints,
            secure=self._secure_dialled,
            opened=self._redialled,
        )
        self._security = security
        self._securing: Securing | None = None
        if security is not None:
            self._securing = Securing(
                security,
                clock=self._clock,
                refusals=self._refusals,
                on_secured=self._secured,
                on_refused=self._peering.refused_from,
                on_join=on_join,
                pause=self._acceptor.pause,
            )
            security.on_denied.append(self._denied)
        self._bulk_lanes = BulkLanes(self._connect_bulk, self._start, rng=rng, counters=self.counters)
        self._rest_pace = RestPace()
        self._ids = count(1)
        self._acting = False
        self._running = False

    async def start(self) -> None:
        """Begin to accept and to dial; peers may have been found before."""
        self._running = True
        self._acceptor.start()
        self._act()

    async def close(self) -> None:
        """Send a bye on every connection, wait at most ``limits.DRAIN_TIMEOUT``, and close all sockets."""
        self._acceptor.close()
        if not self._running:
            return
        self._running = False
        self._timer.close()
        if self._security is not None:
            self._security.on_denied.remove(self._denied)
        securing = self._securing.close() if self._securing is not None else []
        tasks: list[asyncio.Task[None]] = [
            *securing,
            *self._dials,
            *self._bulk_lanes.close(),
            *self._redials.close(),
        ]
        for task in tasks:
            task.cancel()
        await asyncio.gather(*self.dialler.close(), *tasks, return_exceptions=True)
        connections = self.connections()
        for connection in connections:
            connection.close(f"{self.identity.name} ends")
        ends = [asyncio.ensure_future(connection.ended()) for connection in connections]
        if ends:
            _, late = await asyncio.wait(ends, timeout=runtime_limits.DRAIN_TIMEOUT)
            for connection in self.connections():
                connection.abort("the bye was not answered in time")
            if late:
                await asyncio.wait(late)

    def peer_found(self, identity: Identity, source: str | None = None) -> None:
        """Take in a peer that discovery found, or news of it.

        Args:
            identity: The peer; its addresses are dialled in turn.
            source: The source address of the peer's own beacon, which is dialled first.
        """
        self._peering.peer_found(identity, self._clock.now(), source)
        self._act()

    def peer_gone(self, guid: Guid) -> None:
        """Stop dialling a peer that discovery has given up; a link that is up stays."""
        self._peering.peer_gone(guid, self._clock.now())
        self._act()

    def notes(self) -> tuple[str, ...]:
        """Problems of this module in the mesh, as texts for the user."""
        return (FULL.text,) if self._peering.left_out else ()

    def count_peers(self, peers: int) -> None:
        """Take the number of peers that are present: it decides how rare the keepalives of links at rest are."""
        self._rest_pace.count(peers)

    def peers(self) -> list[PeerStatus]:
        """The status of all known peers: linked, or why not and when the next attempt is due."""
        return self._peering.peers()

    def connections(self) -> list[Connection]:
        """All connections, those without a handshake too."""
        return list(self._connections.values())

    def links(self) -> list[PeerLink]:
        """The links that are used, one a peer."""
        return [link for link in self._links.values() if link.used]

    def link(self, guid: Guid) -> PeerLink | None:
        """The link that is used with this peer."""
        return next((link for link in self._links.values() if link.used and link.guid == guid), None)

    # --- events of connections (ConnectionOwner) ------------------------------------------------------------

    def connection_judge(self, connection: Connection, hello: Hello) -> Refuse | None:  # noqa: ARG002 - the protocol's form
        """Decide on a hello; the peering machine knows the links that are up."""
        refuse = self._peering.judge(hello, self._clock.now())
        if refuse is None or refuse.code != Refusal.DUPLICATE:
            return refuse
        for link in self.links():
            if link.guid.place == hello.guid.place and link.rests:
                # The peer may have restarted without an end of its connections, which a link at rest notices late.
                link.touch()
                return Refuse(Refusal.ALREADY_LINKED, "the link of your former run is being checked; dial again")
        return refuse

    def connection_prove(self, connection: Connection, hello: Hello) -> Refuse | None:
        """Compare a hello with the certificate, and with the names of the links that it would replace or join."""
        if self._security is None or connection.certificate is None:
            return None
        linked = [(link.identity, self._alive(link.id)) for link in self.links()]
        others = (each.remote for each in self.connections() if each.up and each is not connection)
        named = sum(other is not None and other.name == hello.name for other in others)
        return prove(hello, connection.certificate, self._security, linked, named)

    def connection_opened(self, connection: Connection) -> None:
        """A handshake succeeded."""
        self._pending.discard(connection.id)
        self._dialled.pop(connection.id, None)
        if connection.lane == Lane.BULK:
            self._bulk_opened(connection)
            return
        link = self._links[connection.id] = PeerLink(connection, self._clock, self._bulk_lanes.want)
        self._peering.link_up(
            link.id, link.identity, self._clock.now(), dialled=link.dialled, endpoint=link.remote_endpoint
        )
        self._act()

    def connection_refused(self, connection: Connection, refuse: Refuse, *, by_us: bool) -> None:
        """A handshake was refused."""
        now = self._clock.now()
        address = connection.remote_endpoint[0]
        if refuse.code in _ORDINARY:
            self.counters.add(f"link.refused.{refuse.label}")
            _log.debug("! %s: %s", connection.name, refuse)
        elif by_us:
            text = f"refused a link with {connection.name} at {address}: {refuse.text}"
            self._refusals.refuse(now, f"link.refused.{refuse.label}", address, text)
        elif refuse.code in _TRUST:
            self.counters.add(f"link.refused.{refuse.label}")
        self._note_refusal(connection, refuse, by_us=by_us)
        if connection.lane == Lane.BULK:
            return  # connection_ended follows, and the lane is dialled again
        guid = self._dialled.pop(connection.id, None)
        if guid is not None:
            self._peering.dial_refused(guid, refuse, now, connection.remote_endpoint)
            self._act()

    def _note_refusal(self, connection: Connection, refuse: Refuse, *, by_us: bool) -> None:
        """Show a refusal for trust that concerns a connection which the peer dialled, or which was up."""
        if refuse.code not in _TRUST or (connection.dialled and connection.since is None):
            return
        if not by_us:
            _log.warning("! %s refuses a link: %s", connection.name, refuse.text)
        if (link := self._used(connection)) is not None:
            # Not when its socket is closed: a revoked peer need not answer the refusal.
            self._peering.link_down(link.id, str(refuse), self._clock.now())
            self._act()
        if connection.remote is not None:
            self._peering.link_refused(connection.remote.guid, refuse)

    def connection_control(self, connection: Connection, payload: bytes) -> None:
        """A control frame came."""
        if (link := self._used(connection)) is not None:
            link.touch()
            self._on_control(link, payload)

    def connection_lane(self, connection: Connection) -> None:
        """The peer wants the bulk lane."""
        if (link := self._links.get(connection.id)) is not None:
            self._bulk_lanes.want(link)

    def connection_ponged(self, connection: Connection) -> None:
        """The remote clock is known better."""
        if (link := self._used(connection)) is not None:
            link.clock_known()

    def connection_quiet(self, connection: Connection) -> None:
        """Try a new connection to the peer of a silent link, because TCP retransmits more and more rarely."""
        link = self._used(connection)
        if self._running and link is not None and link.dialled:
            self._redials.begin(link)

    def connection_tick(self, connection: Connection) -> None:
        """Check how much a bulk lane has on the way."""
        if connection.lane == Lane.BULK:
            bound_queue(connection.sock)

    def connection_closing(self, connection: Connection, reason: str) -> None:
        """A connection sends no more data; that of the express lane ends its link."""
        if (link := self._links.get(connection.id)) is not None:
            link.end_lanes(reason)

    def connection_ended(self, connection: Connection, reason: str) -> None:
        """A socket is closed."""
        now = self._clock.now()
        del self._connections[connection.id]
        self._pending.discard(connection.id)
        if connection.malformed:
            self._refusals.refuse(now, "link.malformed", connection.remote_endpoint[0], reason)
        elif connection.since is None and not connection.dialled:
            self.counters.add("link.unfinished")
            _log.debug("! %s: %s", connection.name, reason)
        if connection.lane == Lane.BULK:
            self._bulk_ended(connection, reason)
            return
        self._bulk_lanes.link_ended(connection.id)
        guid = self._dialled.pop(connection.id, None)
        if guid is not None:
            self._peering.dial_failed(guid, reason, now, connection.remote_endpoint)
        link = self._links.pop(connection.id, None)
        if link is not None:
            link.silent = link.silent or connection.silent
            link.crashed = link.crashed or connection.crashed
            if discarded := link.discard():
                self.counters.add("link.discarded", discarded)
            needed = link.lease <= limits.EXPRESS_LEASE  # that of a link at rest is longer
            self._peering.link_down(link.id, reason, now, silent=link.silent, needed=needed)
        self._act(link)

    def _used(self, connection: Connection) -> PeerLink | None:
        """The link whose express lane this connection is, if it is the one that is used with its peer."""
        link = self._links.get(connection.id)
        return link if link is not None and link.used else None

    # --- acting on the peering machine ----------------------------------------------------------------------

    def _act(self, ended: PeerLink | None = None) -> None:
        """Carry out the outputs of the peering machine; a call from within a callback leaves them to the outer call.

        Args:
            ended: The link whose end is being reported; it is no longer in the table.
        """
        if self._acting:
            return
        self._acting = True
        try:
            while outputs := self._peering.take():
                for output in outputs:
                    self._do(output, ended)
        finally:
            self._acting = False
        if self._running:
            self._timer.arm()

    def _do(self, output: PeeringOutput, ended: PeerLink | None) -> None:
        match output:
            case Dial():
                if self._running:
                    task = self._start(self._dial(output), f"dial {output.guid}")
                    self._dials.add(task)
                    task.add_done_callback(self._dials.discard)
            case CloseLink():
                if (link := self._links.get(output.link_id)) is not None:
                    link.close(output.reason)
            case LinkUp():
                link = self._links[output.link_id]
                link.use(self.handlers)
                _log.info("= %s: linked (%s)", output.identity, "dialled" if link.dialled else "accepted")
                self._on_link_up(link)
                self._bulk_lanes.link_up(link)
            case LinkDown():
                _log.info("= %s: link down: %s", output.identity, output.reason)
                replaced = output.cause is LinkDownCause.REPLACED
                down = self._links.get(output.link_id, ended)
                self.counters.add("link.replaced" if replaced else "link.down")
                if down is not None:
                    down.silent = down.silent or replaced
                    # The link of a peer that restarted within its lease: its agent died, the host is there.
                    down.crashed = down.crashed or replaced or output.cause is LinkDownCause.RESTARTED
                    down.use(None)
                    self._on_link_down(down, output)
            case LinkRefused():
                _log.warning("! %s refuses a link: %s", output.identity, output.refuse.text)

    def _due(self, now: float) -> None:
        self._peering.handle_timer(now)
        self._act()

    def _alive(self, link_id: int) -> bool:
        """Whether bytes were received on a link lately, at its pace."""
        link = self._links.get(link_id)
        return link is not None and self._clock.now() - link.heard_at < link.connection.quiet_after

    # --- bulk lanes -----------------------------------------------------------------------------------------

    async def _connect_bulk(self, link: PeerLink) -> None:
        """Connect the bulk lane of a link that this side dialled, at the endpoint of the express lane."""
        sock = await self.dialler.connect(link.remote_endpoint, Lane.BULK)
        secured = await self._secure_dialled(sock)
        if is_over(link):
            sock.close()  # the link ended meanwhile
            return
        self._open(sock, ConnectionRole.DIALLER, link.remote_endpoint, link.guid, Lane.BULK, secured=secured)

    def _bulk_opened(self, bulk: Connection) -> None:
        link = next((link for link in self.links() if link.identity.is_same_run(bulk.identity)), None)
        if link is None:
            bulk.close("its express lane is gone")
            return
        tune_bulk(bulk.sock, self._lanes, self.counters)  # the lane of an accepted one is only known now
        self._bulk_lanes.opened(link, bulk)

    def _bulk_ended(self, bulk: Connection, reason: str) -> None:
        """Handle the end or the refusal of a bulk lane's connection; the link goes on."""
        expected = self._dialled.pop(bulk.id, None)
        _log.debug("= %s: bulk lane ended: %s", bulk.name, reason)
        for link in list(self._links.values()):
            self._bulk_lanes.ended(link, bulk, reason, expected=expected is not None and link.guid == expected)
        self._act()

    # --- connections ----------------------------------------------------------------------------------------

    async def _dial(self, dial: Dial) -> None:
        places = ", ".join(f"{host}:{port}" for host, port in dial.endpoints)
        _log.debug("> dialling %s at %s", dial.guid, places)
        try:
            connect = self.dialler.redial if dial.briefly else self.dialler.dial
            sock, endpoint = await connect(dial.endpoints)
        except OSError as error:
            self.counters.add("link.dial_failed")
            within = limits.REDIAL_TIMEOUT if dial.briefly else limits.DIAL_TIMEOUT
            problem = os.strerror(error.errno) if error.errno else f"no answer within {within:g} s"
            self._peering.dial_failed(dial.guid, f"{places}: {problem}", self._clock.now())
            self._act()
            return
        try:
            secured = await self._secure_dialled(sock)
        except SecuringError as error:
            self.counters.add(f"link.refused.{error.refuse.label}")
            self._peering.dial_refused(dial.guid, error.refuse, self._clock.now(), endpoint, proved=error.by_us)
            self._act()
        except OSError as error:
            self.counters.add("link.dial_failed")
            self._peering.dial_failed(dial.guid, f"{endpoint[0]}:{endpoint[1]}: {error}", self._clock.now(), endpoint)
            self._act()
        else:
            if self._peering.dial_opened(dial.guid, self._clock.now()):
                self._open(sock, ConnectionRole.DIALLER, endpoint, dial.guid, secured=secured)
            else:
                sock.close()

    async def _secure_dialled(self, sock: socket.socket) -> SecuredSocket | None:
        """Do the TLS handshake of a dialled connection in a secured mesh; closes the socket if it fails."""
        if self._security is None:
            return None
        try:
            return await secure_dialled(sock, self._security)
        except BaseException:
            sock.close()
            raise

    def _redialled(
        self, link: PeerLink, sock: socket.socket, endpoint: SocketAddress, secured: SecuredSocket | None
    ) -> None:
        self._open(sock, ConnectionRole.DIALLER, endpoint, link.guid, secured=secured)

    def _endpoints(self, link: PeerLink) -> list[SocketAddress]:
        """Where the peer of a link may be reached."""
        return list(dict.fromkeys([link.remote_endpoint, *self._peering.endpoints(link.guid)]))

    def _open(
        self,
        sock: socket.socket,
        role: ConnectionRole,
        endpoint: SocketAddress,
        expected: Guid | None = None,
        lane: Lane = Lane.EXPRESS,
        *,
        secured: SecuredSocket | None = None,
    ) -> None:
        connection_id = next(self._ids)
        if expected is not None:
            self._dialled[connection_id] = expected
        if role is ConnectionRole.ACCEPTOR:
            self._pending.add(connection_id)
        self._connections[connection_id] = Connection(
            connection_id,
            sock,
            role,
            self.identity,
            owner=self,
            clock=self._clock,
            endpoint=endpoint,
            expected=expected,
            lane=lane,
            secured=secured,
            rest=self._rest_pace,
        )

    def _accepted(self, sock: socket.socket, address: SocketAddress) -> None:
        if self._securing is not None:
            self._securing.accept(sock, address)
        else:
            self._secured(sock, address, None)

    def _secured(self, sock: socket.socket, address: SocketAddress, secured: SecuredSocket | None) -> None:
        if not self._has_room(address[0]):
            sock.close()
            return
        tune_express(sock, self._lanes, self.counters)
        self._open(sock, ConnectionRole.ACCEPTOR, address, secured=secured)

    def _denied(self) -> None:
        """End the links whose peers are on the new deny list."""
        for connection in self.connections():
            remote = connection.remote
            if connection.up and remote is not None and (refuse := self.connection_prove(connection, remote)):
                connection.expel(refuse)

    def _has_room(self, address: str) -> bool:
        there = sum(self._connections[k].remote_endpoint[0] == address for k in self._pending)
        if len(self._pending) < limits.PENDING_CONNECTIONS_MAX and there < limits.PENDING_PER_ADDRESS:
            return True
        text = f"closed a connection from {address}: too many have not said who they are ({there} from there)"
        self._refusals.refuse(self._clock.now(), "link.pending_full", address, text)
        return False

    def _start(self, work: Coroutine[object, object, None], name: str) -> asyncio.Task[None]:
        """Begin a task that is not awaited; an error that it does not expect is logged."""
        task = asyncio.get_running_loop().create_task(work, name=name)
        task.add_done_callback(_report)
        return task


def _report(task: asyncio.Task[None]) -> None:
    """Log an unexpected error of a task: it is a bug, and no caller awaits the task."""
    if not task.cancelled() and (error := task.exception()) is not None:
        _log.error("! %s failed", task.get_name(), exc_info=error)
