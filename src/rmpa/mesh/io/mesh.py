"""The mesh: accepts, dials and drives the connections to all peers, and joins them to one link a peer."""

from __future__ import annotations

import asyncio
import logging
import os
import random
from typing import TYPE_CHECKING, Final

from rmpa.config.settings import LaneSettings
from rmpa.core import codes
from rmpa.core.log import RefusalLog
from rmpa.core.statistics import Counters
from rmpa.mesh import limits
from rmpa.mesh.frames import FULL, Hello, Lane, Refusal, Refuse
from rmpa.mesh.io.lane import Dialler
from rmpa.mesh.io.link import Connection, LinkHandlers, PeerLink
from rmpa.mesh.io.securing import OnJoin, SecuredSocket, Securing, SecuringError, tls_failure
from rmpa.mesh.keepalive import Pace
from rmpa.mesh.peering import REPLACED, Peering, PeeringOutput, SocketAddress
from rmpa.runtime import limits as runtime_limits
from rmpa.runtime.accept import Acceptor, Use
from rmpa.runtime.loop import MachineTimer, SystemClock
from rmpa.runtime.tasks import OwnedTasks
from rmpa.trust.permissions import TrustReason

if TYPE_CHECKING:
    import socket
    import ssl
    from collections.abc import Callable

    from rmpa.core.identity import Guid, Identity
    from rmpa.trust.membership import Membership

_log = logging.getLogger(__name__)

# Refusals that are part of the normal course, and are not logged as warnings.
_ORDINARY: Final = frozenset({Refusal.ALREADY_LINKED, Refusal.MYSELF, Refusal.NO_EXPRESS})

_TRUST: Final = frozenset(TrustReason)

# Seconds that the byes of an agent with a new address are waited for; its links are made anew at once.
MOVE_TIMEOUT: Final = 0.1


def _log_refusal(peer: object, refuse: Refuse) -> None:
    """One line of a peer that refuses a link, with the code of the reason."""
    kind = f"link.refused.{refuse.label}"
    _log.warning("! %s refuses a link: %s [%s]", peer, refuse.text, codes.of_counter(kind))


class Mesh:
    """The links to all peers; of several links with one peer, one is used.

    Args:
        identity: The identity of this agent; the listening socket's port is in its GUID.
        listen_socket: Bound and listening, non-blocking; owned by the mesh from here on.
        handlers: What is called when something happens to a link.
        lanes: The options of the lanes' sockets.
        rng: Uniform numbers in [0, 1), for jitter.
        dialler: Opens the connections; by default real ones.
        security: This module's membership of a secured mesh: all links use TLS then; ``None``: none does.
        on_join: Serves accepted connections for a join or a renewal; ``None``: this module is not the authority.

    Attributes:
        counters: Where refusals and failures are counted.
        pace: What the keepalives of all links have in common.
        peering: All known peers: linked, or why not and when the next attempt is due.
    """

    def __init__(
        self,
        identity: Identity,
        listen_socket: socket.socket,
        handlers: LinkHandlers,
        *,
        lanes: LaneSettings | None = None,
        rng: Callable[[], float] = random.random,
        dialler: Dialler | None = None,
        security: Membership | None = None,
        on_join: OnJoin | None = None,
    ) -> None:
        self.identity, self.handlers, self.rng = identity, handlers, rng
        self.clock, self.counters, self.pace = SystemClock(), Counters(), Pace.of(identity)
        self.acceptor = Acceptor(listen_socket, self._accepted, name="links to peers", use=Use.LINK)
        self.refusals = RefusalLog(_log, self.counters)
        self.dialler: Final = dialler or Dialler(lanes or LaneSettings(), self.counters)
        self.peering: Peering[PeerLink] = Peering(identity, rng=rng)
        self._timer = MachineTimer(self.peering.next_timer, self._due)
        self._connections: list[Connection] = []
        # The dials that are under way.
        self._tasks = OwnedTasks()
        self._securing = None if security is None else Securing(self, security, on_join)
        self._acting = False
        self._running = False

    async def start(self) -> None:
        """Begin to accept and to dial; peers may have been found before."""
        self._running = True
        self.acceptor.start()
        self._act()

    async def close(self, *, moves: bool = False) -> None:
        """Send a bye on every connection, wait at most ``limits.DRAIN_TIMEOUT``, and close all sockets.

        Args:
            moves: Whether this agent is back at once, at another address: the address of some connections may be gone
                already, so that their byes have no answer, and are not waited for.
        """
        self.acceptor.close()
        if not self._running:
            return
        self._running = False
        self._timer.close()
        if self._securing is not None:
            await self._securing.close()
        await self._tasks.close()
        for connection in self.connections():
            connection.end(f"{self.identity.name} {'has another address' if moves else 'ends'}", moves=moves)
        if ends := [connection.over for connection in self.connections()]:
            await asyncio.wait(ends, timeout=MOVE_TIMEOUT if moves else runtime_limits.DRAIN_TIMEOUT)
            for connection in self.connections():
                connection.lost("the bye was not answered in time")
            await asyncio.wait(ends)

    def peer_found(self, identity: Identity, source: str | None = None) -> None:
        """Take in a peer that discovery found, or news of it.

        Args:
            identity: The peer; its addresses are dialled in turn.
            source: The source address of the peer's own beacon, which is dialled first.
        """
        self.peering.peer_found(identity, self.clock.now(), source)
        self._act()

    def peer_gone(self, guid: Guid) -> None:
        """Stop dialling a peer that discovery has given up; a link that is up stays."""
        self.peering.peer_gone(guid)
        self._act()

    def notes(self) -> tuple[str, ...]:
        """Problems of this module in the mesh, as texts for the user."""
        return (FULL.text,) if self.peering.left_out else ()

    def connections(self) -> list[Connection]:
        """All connections, those without a handshake too."""
        return list(self._connections)

    def links(self) -> list[PeerLink]:
        """The links that are used, one a peer."""
        links = ((each, each.link) for each in self._connections)
        return [link for each, link in links if link is not None and link.used and link.connection is each]

    def link(self, guid: Guid) -> PeerLink | None:
        """The link that is used with this peer."""
        return next((link for link in self.links() if link.guid == guid), None)

    def judge(self, connection: Connection, hello: Hello) -> Refuse | None:
        """Decide on the hello or welcome of the remote side; the peering machine knows the links that are up."""
        refuse = None if self._securing is None else self._securing.prove(connection, hello)
        if refuse is not None or connection.dialled:
            return refuse
        refuse = self.peering.judge(hello, self.clock.now())
        if refuse is not None and refuse.code == Refusal.DUPLICATE:
            for link in self.links():
                if link.guid.place == hello.guid.place and link.rests:
                    # The peer may have restarted without an end of its connections: a link at rest notices it late.
                    link.touch()
                    return Refuse(Refusal.ALREADY_LINKED, "the link of your former run is being checked; dial again")
        return refuse

    def opened(self, connection: Connection) -> None:
        """Make a link of a connection whose handshake succeeded, or the bulk lane of one."""
        connection.expected = None
        if connection.lane != Lane.BULK:
            self.peering.link_up(PeerLink(connection, self), self.clock.now())
            self._act()
            return
        there = (link for link in self.links() if link.guid.place == connection.identity.guid.place)
        of = next((link for link in there if link.identity.is_same_run(connection.identity)), None)
        if of is None:
            connection.end("its express lane is gone")
            return
        self.dialler.tune(connection.sock, Lane.BULK)  # the lane of an accepted one is only known now
        of.attach(connection)
        _log.debug("= %s: bulk lane (%s)", connection.name, "dialled" if connection.dialled else "accepted")

    def refused(self, connection: Connection, refuse: Refuse, *, by_us: bool) -> None:
        """Count, log and note a refusal, and tell the peering machine if it ends a dial."""
        now, address = self.clock.now(), connection.remote_endpoint[0]
        ordinary, kind = refuse.code in _ORDINARY, f"link.refused.{refuse.label}"
        if by_us and not ordinary:
            text = f"refused a link with {connection.name} at {address}: {refuse.text}"
            self.refusals.refuse(now, kind, address, text)
        elif ordinary or refuse.code in _TRUST:
            self.counters.add(kind)
            _log.debug("! %s: %s", connection.name, refuse)
        if refuse.code in _TRUST and not (connection.dialled and connection.since is None):
            self._distrusted(connection, refuse, by_us=by_us)
        if connection.lane != Lane.BULK and connection.expected is not None:
            guid, connection.expected = connection.expected, None
            self.peering.dial_refused(guid, refuse, now, connection.remote_endpoint)
            self._act()

    def tls_failed(self, connection: Connection, error: ssl.SSLError) -> None:
        """Take in an error of TLS behind its handshake, as one of the two sides saw it."""
        failure = tls_failure(error)
        self.refused(connection, failure.refuse, by_us=failure.by_us)

    def _distrusted(self, connection: Connection, refuse: Refuse, *, by_us: bool) -> None:
        """Show a refusal for trust that concerns a connection which the peer dialled, or which was up."""
        if not by_us:
            _log_refusal(connection.name, refuse)
        link = connection.link
        if link is not None and link.used and link.connection is connection:
            # Not when its socket is closed: a revoked peer need not answer the refusal.
            self.peering.link_down(link, str(refuse), self.clock.now())
            self._act()
        if connection.remote is not None:
            self.peering.link_refused(connection.remote.guid, refuse)

    def ended(self, connection: Connection, reason: str) -> None:
        """Handle the end of a connection: of a dial, of a link, or of a bulk lane, without which the link goes on."""
        now = self.clock.now()
        self._connections.remove(connection)
        if connection.malformed:
            self.refusals.refuse(now, "link.malformed", connection.remote_endpoint[0], reason)
        elif connection.since is None and not connection.dialled:
            self.counters.add("link.unfinished")
            _log.debug("! %s: %s", connection.name, reason)
        if connection.lane == Lane.BULK:
            self._bulk_ended(connection, reason)
            return
        if connection.expected is not None:
            self.peering.dial_failed(connection.expected, reason, now, connection.remote_endpoint)
        if (link := connection.link) is not None:
            if discarded := link.discard():
                self.counters.add("link.discarded", discarded)
            needed = connection.keepalive.remote_lease <= limits.EXPRESS_LEASE  # that of a link at rest is longer
            self.peering.link_down(link, reason, now, silent=connection.silent, needed=needed)
        self._act()

    def _bulk_ended(self, bulk: Connection, reason: str) -> None:
        _log.debug("= %s: bulk lane ended: %s", bulk.name, reason)
        link = bulk.link
        if link is not None:
            link.detach(bulk)
        elif bulk.expected is not None:
            link = self.link(bulk.expected)
        if link is not None and link.used:
            self.counters.add("link.bulk_lost")
            _log.info("= %s: the bulk lane is gone (%s); small messages go on", link.name, reason)
            self.dial_bulk(link, link.backoff.delay() if link.dialled else 0.0)

    def _act(self) -> None:
        """Carry out what the peering machine asks for; a call from within a callback leaves it to the outer call."""
        if self._acting:
            return
        self._acting = True
        try:
            while outputs := self.peering.take():
                for output in outputs:
                    self._do(output)
        finally:
            self._acting = False
        if self._running:
            self._timer.arm()

    def _do(self, output: PeeringOutput[PeerLink]) -> None:
        match output:
            case ("dial", guid, endpoints, briefly):
                if self._running:
                    self._tasks.start(self._dial(guid, endpoints, briefly=briefly), f"dial {guid}")
            case ("close", link, reason):
                link.close(reason)
            case ("up", link):
                link.use(used=True)
                _log.info("= %s: linked (%s)", link.identity, "dialled" if link.dialled else "accepted")
                self.handlers.up(link)
                self.dial_bulk(link)  # the peer may have asked for it before
            case ("down", link, reason):
                self.counters.add("link.replaced" if reason == REPLACED else "link.down")
                _log.info("= %s: link down: %s", link.identity, reason)
                link.over = reason
                link.use(used=False)
                self.handlers.down(link, reason)
            case ("refused", identity, refuse):
                _log_refusal(identity, refuse)

    def _due(self, now: float) -> None:
        self.peering.handle_timer(now)
        self._act()

    async def _dial(self, guid: Guid, endpoints: tuple[SocketAddress, ...], *, briefly: bool) -> None:
        places = ", ".join(f"{host}:{port}" for host, port in endpoints)
        _log.debug("> dialling %s at %s", guid, places)
        endpoint: SocketAddress | None = None
        try:
            sock, endpoint = await self.dialler.dial(endpoints, briefly=briefly)
            secured = await self._secure(sock)
        except SecuringError as error:
            self.counters.add(f"link.refused.{error.refuse.label}")
            self.peering.dial_refused(guid, error.refuse, self.clock.now(), endpoint, proved=error.by_us)
        except OSError as error:
            self.counters.add("link.dial_failed")
            within = limits.REDIAL_TIMEOUT if briefly else limits.DIAL_TIMEOUT
            problem = os.strerror(error.errno) if error.errno else f"no answer within {within:g} s"
            text = f"{places}: {problem}" if endpoint is None else f"{endpoint[0]}:{endpoint[1]}: {error}"
            self.peering.dial_failed(guid, text, self.clock.now(), endpoint)
        else:
            if self.peering.dial_opened(guid, self.clock.now()):
                self._open(sock, endpoint, expected=guid, secured=secured)
            else:
                sock.close()
        self._act()

    def link_silent(self, link: PeerLink) -> None:
        """Take in that nothing comes over a link that this side dialled."""
        self.peering.link_silent(link)
        self._act()

    def dial_bulk(self, link: PeerLink, delay: float = 0.0) -> None:
        """Dial the bulk lane of a link in ``delay`` seconds, if it is wanted and missing, and this side has to."""
        missing = link.bulk_connection is None and (link.bulk_dial is None or link.bulk_dial.done())
        if self._running and link.used and link.dialled and link.bulk_wanted and missing:
            link.bulk_dial = self._tasks.start(self._dial_bulk(link, delay), f"bulk {link.name}")

    async def _dial_bulk(self, link: PeerLink, delay: float) -> None:
        """Connect the bulk lane of a link, at the endpoint of the express lane."""
        await asyncio.sleep(delay)
        while link.used:
            try:
                sock = await self.dialler.connect(link.remote_endpoint, Lane.BULK)
                secured = await self._secure(sock)
            except OSError as error:
                self.counters.add("link.bulk_failed")
                _log.debug("! %s: no bulk lane: %s", link.name, error)
                await asyncio.sleep(link.backoff.delay())
            else:
                if self.link(link.guid) is link:
                    self._open(sock, link.remote_endpoint, expected=link.guid, lane=Lane.BULK, secured=secured)
                else:
                    sock.close()  # the link ended meanwhile
                return

    async def _secure(self, sock: socket.socket) -> SecuredSocket | None:
        """Do the TLS handshake of a dialled connection in a secured mesh; closes the socket if it fails."""
        if self._securing is None:
            return None
        try:
            return await self._securing.dialled(sock)
        except BaseException:
            sock.close()
            raise

    def _open(
        self,
        sock: socket.socket,
        endpoint: SocketAddress,
        *,
        expected: Guid | None = None,
        lane: Lane = Lane.EXPRESS,
        secured: SecuredSocket | None = None,
    ) -> None:
        """Begin the handshake of a connection that was accepted, or dialled to ``expected``."""
        self._connections.append(Connection(self, sock, endpoint, expected=expected, lane=lane, secured=secured))

    def _accepted(self, sock: socket.socket, address: SocketAddress) -> None:
        if self._securing is not None:
            self._securing.accept(sock, address)
        else:
            self.secured(sock, address, None)

    def secured(self, sock: socket.socket, address: SocketAddress, secured: SecuredSocket | None) -> None:
        """Begin the handshake of an accepted connection, which is secured where the mesh is."""
        host = address[0]
        pending = [c.remote_endpoint[0] for c in self.connections() if c.since is None and not c.dialled]
        there = pending.count(host)
        if len(pending) < limits.PENDING_CONNECTIONS_MAX and there < limits.PENDING_PER_ADDRESS:
            self.dialler.tune(sock, Lane.EXPRESS)
            self._open(sock, address, secured=secured)
        else:
            sock.close()
            text = f"closed a connection from {host}: too many have not said who they are ({there} from there)"
            self.refusals.refuse(self.clock.now(), "link.pending_full", host, text)
