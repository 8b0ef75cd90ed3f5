"""Secures TCP connections: the TLS handshake, before there is a ``Connection`` (docs/design/trust.md).

The ALPN of an accepted connection says whether it is a lane of a link or a join. A connection that ends without a
byte is another agent's test whether this one can be reached. What does not begin with a TLS record is answered by a
plain refuse frame, which the other side shows and does not rely on; all other refusals are told inside TLS.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import socket
import ssl
from collections import Counter
from collections.abc import Awaitable, Callable
from typing import TYPE_CHECKING, Final

from rmpa.core.errors import RemoteProtocolError, RmpaError
from rmpa.core.timers import TokenBucket
from rmpa.mesh import limits
from rmpa.mesh.frames import Frame, FrameKind, Hello, Refusal, Refuse
from rmpa.runtime.tasks import end_tasks, start_task
from rmpa.runtime.tls import SecureSocket, TlsHandshake
from rmpa.trust.permissions import TrustError, TrustReason
from rmpa.trust.store import ALPN_JOIN, ALPN_LINK

if TYPE_CHECKING:
    from rmpa.mesh.io.link import Connection
    from rmpa.mesh.io.mesh import Mesh
    from rmpa.mesh.peering import SocketAddress
    from rmpa.trust.certificates import ModuleCertificate
    from rmpa.trust.membership import Membership

_log = logging.getLogger(__name__)

# The longest time from an accepted connection to the end of its TLS handshake in a secured mesh: two round trips and
# 3 ms of work.
SECURING_TIMEOUT: Final = 3.0
# Connections that are no member's and may come at once: the tests of reachability of a large network.
UNPROVEN_BURST: Final = 200

# Connections a second, over all addresses, that are told that they do not speak TLS; the others are closed without an
# answer, which takes half the time.
_PLAIN_ANSWERS_RATE: Final = 20.0
# Pause of accepting above ``limits.UNPROVEN_RATE``; a member's dial is repeated after 0.3 s.
_UNPROVEN_PAUSE: Final = 0.05
# How long a connection whose certificate was refused may still send, so that it reads the alert.
_REFUSAL_LINGER: Final = 0.5

# What encrypts a connection behind its TLS handshake, and the remote side's certificate, whose times, name and
# revocation are judged again whenever they may have changed.
SecuredSocket = tuple[SecureSocket, "ModuleCertificate"]
OnJoin = Callable[[socket.socket, TlsHandshake, str], Awaitable[None]]

_READ: Final = 16 * 1024
# First bytes of TLS records (RFC 8446, section 5.1); a plain frame begins with 0, as it is shorter than 16 MiB.
_TLS_HANDSHAKE, _TLS_ALERT = 0x16, 0x15
# TLS alerts, by the ends of their names.
_ALERTS: Final = {
    "UNKNOWN_CA": (TrustReason.FOREIGN, "our certificate is of another CA than its own"),
    "PROTOCOL_VERSION": (TrustReason.DOWNGRADE, "it does not use TLS 1.3"),
}


class SecuringError(ConnectionError):
    """A connection was refused before its handshake of the mesh.

    Args:
        refuse: Why.
        by_us: Whether this side refused. To a dialler, a refusal by the other side has no proof: TLS was not done.
    """

    def __init__(self, refuse: Refuse, *, by_us: bool) -> None:
        super().__init__(str(refuse))
        self.refuse = refuse
        self.by_us = by_us


def refusal(reason: TrustReason, problem: str) -> Refuse:
    """A refusal with what is wrong and what to do; it is read at both ends."""
    return Refuse(reason, f"{problem}; {reason.remedy}")


def tls_failure(error: ssl.SSLError) -> SecuringError:
    """What an error of TLS means: a certificate that this side refuses, or an alert of the other side."""
    name = error.reason or ""
    if isinstance(error, ssl.SSLCertVerificationError):
        text = f"its certificate is of another CA ({error.verify_message})"
        return SecuringError(refusal(TrustReason.FOREIGN, text), by_us=True)
    if "ALERT" in name:
        known = next((found for end, found in _ALERTS.items() if name.endswith(end)), None)
        reason, text = known if known is not None else (TrustReason.FOREIGN, f"it ended TLS by {name}")
        return SecuringError(refusal(reason, text), by_us=False)
    return SecuringError(refusal(TrustReason.DOWNGRADE, f"it does not speak TLS 1.3 ({name})"), by_us=True)


async def _received(sock: socket.socket) -> bytes:
    """The next bytes.

    Raises:
        ConnectionError: There are none: the remote side closed the connection.
    """
    data = await asyncio.get_running_loop().sock_recv(sock, _READ)
    if not data:
        raise ConnectionError("closed the connection before TLS was there: is it busy?")
    return data


async def _plain_refusal(sock: socket.socket, data: bytes) -> SecuringError:
    """The refusal that something sent instead of TLS; one that an acceptor does not send there is a downgrade."""
    try:
        while (parsed := Frame.parse(data)) is None and len(data) <= limits.HELLO_PAYLOAD_MAX:
            data += await _received(sock)
        if parsed is not None and parsed[0].kind is FrameKind.REFUSE:
            refuse = Refuse.parse(parsed[0].payload)
            if refuse.code != TrustReason.UNSECURED:
                refuse = refusal(TrustReason.DOWNGRADE, f"it refuses without TLS ({refuse})")
            return SecuringError(refuse, by_us=False)
    except RemoteProtocolError:
        pass
    return SecuringError(refusal(TrustReason.DOWNGRADE, "it answers by something else than TLS"), by_us=False)


async def _shake(sock: socket.socket, handshake: TlsHandshake, data: bytes) -> None:
    """Pass bytes between socket and handshake until it is done; an alert is sent before the error is raised."""
    loop = asyncio.get_running_loop()
    while True:
        try:
            handshake.receive(data)
        except ssl.SSLError as error:
            with contextlib.suppress(OSError):
                await loop.sock_sendall(sock, handshake.take_output())
            raise tls_failure(error) from None
        if output := handshake.take_output():
            await loop.sock_sendall(sock, output)
        if handshake.done:
            return
        data = await _received(sock)


class Securing:
    """What secures the connections of a mesh.

    Args:
        mesh: Its connections.
        security: This module's membership.
        on_join: Serves a join or renewal; ``None``: this module is not the authority.
    """

    def __init__(self, mesh: Mesh, security: Membership, on_join: OnJoin | None) -> None:
        self._mesh = mesh
        self._security = security
        self._on_join = on_join
        self._bad = TokenBucket(limits.UNPROVEN_RATE, UNPROVEN_BURST)
        # Connections without a finished handshake, each with its address; the oldest first.
        self._unproven: dict[asyncio.Task[None], str] = {}
        self._answers = TokenBucket(_PLAIN_ANSWERS_RATE, _PLAIN_ANSWERS_RATE)
        security.on_denied.append(self._denied)

    def prove(self, connection: Connection, hello: Hello) -> Refuse | None:
        """Judge whether a hello is of the module that its connection's certificate is of; ``None``: it is.

        No other module may claim the run of one that is linked. It may have the address of one whose link is silent:
        it may have come after it. A module has only so many connections.
        """
        assert connection.certificate is not None  # noqa: S101 - each connection of a secured mesh has one
        try:
            self._security.judge_member(connection.certificate, hello.name)
        except TrustError as error:
            return refusal(error.reason, str(error))
        for link in self._mesh.links():
            peer, same_place = link.identity, link.alive and link.guid.place == hello.guid.place
            if peer.name != hello.name and (same_place or peer.instance == hello.instance):
                return refusal(TrustReason.NAME, f"{hello.name} says that it is the run of {peer}, which is linked")
        others = (each.remote for each in self._mesh.connections() if each.up and each is not connection)
        named = sum(other is not None and other.name == hello.name for other in others)
        if named < limits.CONNECTIONS_PER_NAME:
            return None
        text = f"{hello.name} has {named} connections here, a module needs two: is its certificate used elsewhere?"
        return Refuse(Refusal.BUSY, f"{text} Then: rmpa trust revoke {hello.name}")

    def _denied(self) -> None:
        """End the links whose peers are on the new deny list."""
        for connection in self._mesh.connections():
            remote = connection.remote
            if connection.up and remote is not None and (refuse := self.prove(connection, remote)):
                connection.refuse(refuse, self._mesh.clock.now())
                connection.flush()

    async def dialled(self, sock: socket.socket) -> SecuredSocket:
        """Do the TLS handshake of a connection that this side dialled; the caller closes it.

        Raises:
            SecuringError: One side refuses the other.
            OSError: The connection ended, or the handshake took longer than ``SECURING_TIMEOUT``.
        """
        handshake = TlsHandshake(self._security.client_context, server_side=False)
        handshake.receive(b"")
        loop = asyncio.get_running_loop()
        try:
            async with asyncio.timeout(SECURING_TIMEOUT):
                await loop.sock_sendall(sock, handshake.take_output())
                first = await _received(sock)
                if first[0] not in (_TLS_HANDSHAKE, _TLS_ALERT):
                    raise await _plain_refusal(sock, first)
                await _shake(sock, handshake, first)
        except TimeoutError:
            raise TimeoutError(f"no end of the TLS handshake within {SECURING_TIMEOUT:g} s") from None
        return self._secured(sock, handshake)

    def _secured(self, sock: socket.socket, handshake: TlsHandshake) -> SecuredSocket:
        """The connection of a member behind its handshake; an acceptor tells its refusal inside TLS.

        Raises:
            SecuringError: It has no certificate of this mesh, or is for something else than a link.
        """
        tls = handshake.tls
        if tls.version() != "TLSv1.3" or tls.selected_alpn_protocol() != ALPN_LINK:
            text = f"it speaks {tls.version()} with {tls.selected_alpn_protocol()}, not TLSv1.3 with {ALPN_LINK}"
            raise SecuringError(refusal(TrustReason.DOWNGRADE, text), by_us=True)
        secured = handshake.secure(sock)
        try:
            certificate = self._security.read_member(tls.getpeercert(binary_form=True))
            if tls.server_side:
                # Before its hello, which a module without a certificate that holds could hold back.
                self._security.judge_member(certificate, None)
        except TrustError as error:
            refuse = refusal(error.reason, str(error))
            if tls.server_side:
                with contextlib.suppress(OSError):
                    secured.sendmsg([Frame(FrameKind.REFUSE, refuse.serialize()).serialize()])
            raise SecuringError(refuse, by_us=True) from None
        return secured, certificate

    def accept(self, sock: socket.socket, address: SocketAddress) -> None:
        """Do the handshake of a connection; the socket belongs to this object from here on."""
        host = address[0]
        self._make_room(host)
        task = start_task(self._secure(sock, address), f"secure {host}")
        self._unproven[task] = host
        task.add_done_callback(lambda task: self._ended(task, sock))

    async def close(self) -> None:
        """Close what is not secured yet."""
        self._security.on_denied.remove(self._denied)
        await end_tasks(*self._unproven)

    def _ended(self, task: asyncio.Task[None], sock: socket.socket) -> None:
        self._unproven.pop(task, None)
        if task.cancelled():
            sock.close()  # a task that is cancelled before it begins runs no ``finally``

    def _make_room(self, host: str) -> None:
        """Close the oldest connection of this address, or of that with the most, if there is no place for one more.

        A member needs some milliseconds for its handshake, so the oldest one is the least likely to be a member's.
        """
        there = Counter(self._unproven.values())
        if there[host] < limits.PENDING_PER_ADDRESS:
            if len(self._unproven) < limits.PENDING_CONNECTIONS_MAX:
                return
            host = max(there, key=there.__getitem__)
        oldest = next(task for task, address in self._unproven.items() if address == host)
        del self._unproven[oldest]
        oldest.cancel()
        text = f"closed a connection from {host}: too many have not shown that they are of this mesh"
        self._mesh.refusals.refuse(self._mesh.clock.now(), "link.pending_full", host, text)
        self._note_bad()

    def _note_bad(self) -> None:
        """Leave a flood of connections that are no member's to the kernel for a moment."""
        if not self._bad.take(self._mesh.clock.now()):
            self._mesh.refusals.count("link.paused")
            self._mesh.acceptor.pause(_UNPROVEN_PAUSE)

    async def _secure(self, sock: socket.socket, address: SocketAddress) -> None:
        host = address[0]
        secured: SecuredSocket | None = None
        try:
            secured = await self._proved(sock, host)
        except SecuringError as error:
            self._note_bad()
            text = f"{'refused a link with' if error.by_us else 'no link with'} {host}: {error}"
            self._mesh.refusals.refuse(self._mesh.clock.now(), f"link.refused.{error.refuse.label}", host, text)
            self._mesh.peering.refused_from(host, error.refuse)
            await _linger(sock)
        except (OSError, RmpaError) as error:  # TimeoutError too
            self._note_bad()
            self._mesh.refusals.count("link.unfinished")
            _log.debug("! %s: no TLS handshake: %s", host, str(error) or "no answer in time")
        finally:
            if secured is None:
                sock.close()
        if secured is not None:
            self._mesh.secured(sock, address, secured)

    async def _proved(self, sock: socket.socket, host: str) -> SecuredSocket | None:
        """The connection of a member; ``None``: it is none, and nothing is to be told of it.

        Raises:
            SecuringError: One side refuses the other.
            OSError: The connection ended, or the handshake took longer than ``SECURING_TIMEOUT``.
            RmpaError: The question of a join is malformed.
        """
        async with asyncio.timeout(SECURING_TIMEOUT):
            first = await asyncio.get_running_loop().sock_recv(sock, _READ)
            if not first:
                self._note_bad()
                return None
            if first[0] != _TLS_HANDSHAKE:
                self._refuse_plain(sock, host)
                return None
            handshake = TlsHandshake(self._security.server_context, server_side=True)
            await _shake(sock, handshake, first)
        if self._on_join is not None and handshake.tls.selected_alpn_protocol() == ALPN_JOIN:
            await self._on_join(sock, handshake, host)
            await _linger(sock)
            return None
        return self._secured(sock, handshake)

    def _refuse_plain(self, sock: socket.socket, host: str) -> None:
        """Count, and answer unless there are many."""
        self._note_bad()
        now = self._mesh.clock.now()
        refuse = refusal(TrustReason.PLAIN, "the dialler is not secured, but this mesh is")
        text = f"refused a connection from {host}: {refuse.text}"
        self._mesh.refusals.refuse(now, f"link.refused.{refuse.label}", host, text)
        if self._answers.take(now):
            with contextlib.suppress(OSError):
                sock.send(Frame(FrameKind.REFUSE, refuse.serialize()).serialize())
                sock.shutdown(socket.SHUT_WR)
                sock.recv(_READ)  # unread bytes would make the end a reset, which overtakes the answer


async def _linger(sock: socket.socket) -> None:
    """Let the other side read the alert: closing with unread bytes is a reset, which overtakes it."""
    with contextlib.suppress(OSError):
        sock.shutdown(socket.SHUT_WR)
        async with asyncio.timeout(_REFUSAL_LINGER):
            while await asyncio.get_running_loop().sock_recv(sock, _READ):
                pass
