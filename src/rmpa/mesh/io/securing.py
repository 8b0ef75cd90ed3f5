"""Secures TCP connections: preface and TLS handshake, before there is a ``Connection`` (docs/design/trust.md).

An accepted connection first sends its preface, which is read without a task and judged in microseconds; only what has
the group key goes on to TLS. A connection that ends without a byte is another agent's test whether this one can be
reached. What is refused here is answered by a plain refuse frame, which the other side shows and does not rely on.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import socket
import ssl
from collections import Counter
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from functools import partial
from typing import TYPE_CHECKING, Any, Final, Protocol

from rmpa.core.errors import RemoteProtocolError
from rmpa.core.token_bucket import TokenBucket
from rmpa.mesh import limits
from rmpa.mesh.frames import Frame, FrameKind
from rmpa.mesh.handshake import Refusal, Refuse
from rmpa.runtime.record_layer import SecureSocket, TlsHandshake
from rmpa.trust.io.contexts import ALPN_LINK
from rmpa.trust.preface import PREFACE_BYTES, PrefaceError, Purpose, is_preface
from rmpa.trust.reasons import TrustError, TrustReason

if TYPE_CHECKING:
    from rmpa.core.clock import Clock
    from rmpa.core.counters import RefusalLog
    from rmpa.core.identity import Identity
    from rmpa.mesh.handshake import Hello
    from rmpa.mesh.peering_events import SocketAddress
    from rmpa.trust.preface import Preface, PrefaceGuard

_log = logging.getLogger(__name__)

Certificate = Mapping[str, Any]
"""A verified certificate as ``SSLObject.getpeercert`` returns it."""
OnJoin = Callable[[socket.socket, "Preface"], None]

_READ: Final = 16 * 1024
_TLS_RECORDS: Final = frozenset({20, 21, 22, 23})
"""First bytes of TLS records; a plain frame begins with 0, as it is shorter than 16 MiB."""
_VERIFY: Final = {9: TrustReason.CLOCK, 10: TrustReason.EXPIRED}
"""OpenSSL's codes of a refused certificate; all others mean that our CA has not issued it for a module."""
_ALERTS: Final = {
    "BAD_CERTIFICATE": (
        TrustReason.CLOCK,
        "it does not take our certificate, perhaps because it begins in the future",
    ),
    "CERTIFICATE_EXPIRED": (TrustReason.EXPIRED, "for it, the time of our certificate is over"),
    "UNKNOWN_CA": (TrustReason.FOREIGN, "our certificate is of another CA than its own"),
    "PROTOCOL_VERSION": (TrustReason.DOWNGRADE, "it does not use TLS 1.3"),
    "NO_APPLICATION_PROTOCOL": (TrustReason.DOWNGRADE, f"it does not speak {ALPN_LINK}"),
}
"""TLS alerts, by the ends of their names."""
_IN_FRONT_OF_TLS: Final = frozenset(
    {
        TrustReason.PLAIN,
        TrustReason.UNSECURED,
        TrustReason.KEY,
        TrustReason.CLOCK,
        TrustReason.DOWNGRADE,
        TrustReason.FLOOD,
    }
)
"""What an acceptor says in plain, before there is a certificate on which anything else could be said."""
_FOUND: Final = {
    TrustReason.CLOCK: "its certificate begins in the future",
    TrustReason.EXPIRED: "the time of its certificate is over",
    TrustReason.FOREIGN: "its certificate is of another CA",
}


class MeshSecurity(Protocol):
    """What a secured mesh needs of this module's membership; ``trust.io.membership.Membership`` is one."""

    on_denied: list[Callable[[], None]]
    """Called after a newer deny list holds."""

    @property
    def guard(self) -> PrefaceGuard:
        """Judges the prefaces of accepted connections."""
        ...

    @property
    def server_context(self) -> ssl.SSLContext:
        """For connections that are accepted."""
        ...

    @property
    def client_context(self) -> ssl.SSLContext:
        """For connections that are dialled."""
        ...

    def wall(self) -> float | None:
        """Seconds since 1970; ``None`` while the machine's clock is not set."""
        ...

    def preface(self, purpose: Purpose) -> bytes:
        """The first bytes of a connection that is dialled."""
        ...

    def judge_member(self, certificate: Certificate | bytes, claimed: str | None) -> None:
        """Raise ``TrustError`` if a verified certificate is revoked, or not of the module that its owner claims."""
        ...


@dataclass(frozen=True, slots=True)
class SecuredSocket:
    """A connection behind its TLS handshake.

    Args:
        socket: Encrypts and decrypts.
        certificate: The remote side's, verified but for its name and the deny list.
    """

    socket: SecureSocket
    certificate: Certificate


class SecuringError(ConnectionError):
    """A connection was refused before its handshake of the mesh.

    Args:
        refuse: Why.
        by_us: Whether this side refused. To a dialler, a refusal by the other side has no proof: TLS was not done.
    """

    def __init__(self, refuse: Refuse, *, by_us: bool) -> None:
        super().__init__(refuse.text)
        self.refuse = refuse
        self.by_us = by_us

    def __str__(self) -> str:
        """``expired: …``."""
        return str(self.refuse)


def refusal(reason: TrustReason, problem: str) -> Refuse:
    """A refusal with what is wrong and what to do; it is read at both ends."""
    return Refuse(reason, f"{problem}; {reason.remedy}")


def prove(
    hello: Hello,
    certificate: Certificate,
    security: MeshSecurity,
    linked: Iterable[tuple[Identity, bool]],
    others: int = 0,
) -> Refuse | None:
    """Judge whether a hello is of the module that its certificate is of, and has not too many already; ``None``: yes.

    Args:
        hello: The remote side's hello or welcome.
        certificate: Its certificate.
        security: This module's membership.
        linked: The peers with links, each with whether its link is alive. No other module may claim the run of one of
            them. Another module may have the address of one whose link is silent: it may have come after it.
        others: The other connections that are up with this name.
    """
    try:
        security.judge_member(certificate, hello.name)
    except TrustError as error:
        return refusal(error.reason, str(error))
    for peer, alive in linked:
        same_place = alive and peer.guid.place == hello.guid.place
        if peer.name != hello.name and (same_place or peer.instance == hello.instance):
            return refusal(TrustReason.NAME, f"{hello.name} says that it is the run of {peer}, which is linked")
    if others >= limits.CONNECTIONS_PER_NAME:
        text = f"{hello.name} has {others} connections here, a module needs two: is its certificate used elsewhere?"
        return Refuse(Refusal.BUSY, f"{text} Then: rmpa trust revoke {hello.name}")
    return None


def tls_failure(error: ssl.SSLError) -> SecuringError:
    """What an error of TLS means: a certificate that this side refuses, or an alert of the other side."""
    name = error.reason or ""
    if isinstance(error, ssl.SSLCertVerificationError):
        reason = _VERIFY.get(error.verify_code, TrustReason.FOREIGN)
        return SecuringError(refusal(reason, f"{_FOUND[reason]} ({error.verify_message})"), by_us=True)
    if "ALERT" in name:
        known = next((found for end, found in _ALERTS.items() if name.endswith(end)), None)
        reason, text = known if known is not None else (TrustReason.FOREIGN, f"it ended TLS by {name}")
        return SecuringError(refusal(reason, text), by_us=False)
    reason = TrustReason.FOREIGN if name == "PEER_DID_NOT_RETURN_A_CERTIFICATE" else TrustReason.DOWNGRADE
    text = "it has no certificate" if reason is TrustReason.FOREIGN else f"it does not speak TLS 1.3 ({name})"
    return SecuringError(refusal(reason, text), by_us=True)


# --- dialled connections ----------------------------------------------------------------------------------------


async def secure_dialled(sock: socket.socket, security: MeshSecurity) -> SecuredSocket:
    """Send the preface, and do the TLS handshake of a connection that this side dialled; the caller closes it.

    Raises:
        SecuringError: One side refuses the other.
        OSError: The connection ended, or the handshake took longer than ``limits.SECURING_TIMEOUT``.
    """
    handshake = TlsHandshake(security.client_context, server_side=False)
    handshake.receive(b"")
    loop = asyncio.get_running_loop()
    try:
        async with asyncio.timeout(limits.SECURING_TIMEOUT):
            await loop.sock_sendall(sock, security.preface(Purpose.LINK) + handshake.take_output())
            first = await _received(sock)
            if first[0] not in _TLS_RECORDS:
                raise await _plain_refusal(sock, first)
            await _shake(sock, handshake, first)
    except TimeoutError:
        raise TimeoutError(f"no end of the TLS handshake within {limits.SECURING_TIMEOUT:g} s") from None
    return _secured(sock, handshake)


async def _received(sock: socket.socket) -> bytes:
    """The next bytes.

    Raises:
        ConnectionError: There are none: the remote side closed the connection.
    """
    data = await asyncio.get_running_loop().sock_recv(sock, _READ)
    if not data:
        raise ConnectionError("closed the connection before TLS was there: is it busy, or an older release?")
    return data


async def _plain_refusal(sock: socket.socket, data: bytes) -> SecuringError:
    """The refusal that something sent instead of TLS; one that an acceptor does not send there is a downgrade."""
    try:
        while (parsed := Frame.parse(data)) is None and len(data) <= limits.HELLO_PAYLOAD_MAX:
            data += await _received(sock)
        if parsed is not None and parsed[0].kind is FrameKind.REFUSE:
            refuse = Refuse.parse(parsed[0].payload)
            if refuse.code not in _IN_FRONT_OF_TLS:
                refuse = refusal(TrustReason.DOWNGRADE, f"it refuses without TLS ({refuse})")
            return SecuringError(refuse, by_us=False)
    except RemoteProtocolError:
        pass
    return SecuringError(refusal(TrustReason.DOWNGRADE, "it answers by something else than TLS"), by_us=False)


# --- both -------------------------------------------------------------------------------------------------------


async def _shake(sock: socket.socket, handshake: TlsHandshake, data: bytes = b"") -> None:
    """Pass bytes between socket and handshake until it is done; an alert is sent before the error is raised."""
    loop = asyncio.get_running_loop()
    while True:
        try:
            if data:
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


def _secured(sock: socket.socket, handshake: TlsHandshake) -> SecuredSocket:
    tls = handshake.tls
    if tls.version() != "TLSv1.3" or tls.selected_alpn_protocol() != ALPN_LINK:
        text = f"it speaks {tls.version()} with {tls.selected_alpn_protocol()}, not TLSv1.3 with {ALPN_LINK}"
        raise SecuringError(refusal(TrustReason.DOWNGRADE, text), by_us=True)
    return SecuredSocket(handshake.secure(sock), tls.getpeercert() or {})


# --- accepted connections ---------------------------------------------------------------------------------------


@dataclass(slots=True)
class _Unproven:
    """An accepted connection without a whole preface."""

    sock: socket.socket
    address: SocketAddress
    deadline: float
    ended: bool = False
    data: bytearray = field(default_factory=bytearray)


class Securing:
    """Secures the accepted connections.

    Args:
        security: This module's membership.
        clock: The time.
        refusals: Counts and logs what is refused, as ``link.refused.<reason>``.
        on_secured: A connection is a member's; the callee owns the socket.
        on_refused: ``(address, refusal)``: the TLS handshake with a holder of the group key failed.
        on_join: Takes connections that are no link: joins and renewals; ``None``: they are closed.
        pause: Stops accepting for some seconds, because too many connections show no group key.
    """

    def __init__(
        self,
        security: MeshSecurity,
        *,
        clock: Clock,
        refusals: RefusalLog,
        on_secured: Callable[[socket.socket, SocketAddress, SecuredSocket], None],
        on_refused: Callable[[str, Refuse], None],
        on_join: OnJoin | None,
        pause: Callable[[float], None],
    ) -> None:
        self._security = security
        self._clock = clock
        self._refusals = refusals
        self._on_secured = on_secured
        self._on_refused = on_refused
        self._on_join = on_join
        self._pause = pause
        self._bad = TokenBucket(limits.UNPROVEN_RATE, limits.UNPROVEN_BURST)
        self._unproven: dict[int, _Unproven] = {}
        """By file descriptor, the oldest first."""
        self._unproven_there: Counter[str] = Counter()
        self._handshakes: dict[asyncio.Task[None], str] = {}
        self._recognised: dict[asyncio.Task[None], str] = {}
        """Those of modules with an older group key, among which a module that was revoked may be."""
        self._answers = TokenBucket(limits.PLAIN_ANSWERS_RATE, limits.PLAIN_ANSWERS_RATE)
        self._timer: asyncio.TimerHandle | None = None

    def accept(self, sock: socket.socket, address: SocketAddress) -> None:
        """Read the preface of a connection, and go on as it says; the socket belongs to this object from here on."""
        host = address[0]
        one = _Unproven(sock, address, self._clock.now() + limits.PREFACE_TIMEOUT)
        if self._fill(one):
            self._proceed(one)
            return
        self._make_room(host)
        self._unproven[sock.fileno()] = one
        self._unproven_there[host] += 1
        asyncio.get_running_loop().add_reader(sock.fileno(), self._readable, one)
        if self._timer is None:
            self._arm()

    def close(self) -> list[asyncio.Task[None]]:
        """Close what is not secured yet; return the tasks, to be awaited."""
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None
        for one in list(self._unproven.values()):
            self._forget(one)
            one.sock.close()
        tasks = [*self._handshakes, *self._recognised]
        for task in tasks:
            task.cancel()
        return tasks

    # --- the preface ------------------------------------------------------------------------------------------

    def _make_room(self, host: str) -> None:
        """Close the oldest connection of this address, or of that with the most, if there is no place for one more.

        A member sends its preface at once, so the oldest one is the least likely to be a member's.
        """
        if self._unproven_there[host] < limits.PENDING_PER_ADDRESS:
            if len(self._unproven) < limits.PENDING_CONNECTIONS_MAX:
                return
            host = max(self._unproven_there, key=self._unproven_there.__getitem__)
        oldest = next(one for one in self._unproven.values() if one.address[0] == host)
        self._forget(oldest)
        oldest.sock.close()
        text = f"closed a connection from {host}: too many have not shown that they are of this mesh"
        self._refusals.refuse(self._clock.now(), "link.pending_full", host, text)
        self._note_bad()

    def _readable(self, one: _Unproven) -> None:
        if self._fill(one):
            self._forget(one)
            self._proceed(one)

    def _forget(self, one: _Unproven) -> None:
        number = one.sock.fileno()
        asyncio.get_running_loop().remove_reader(number)
        del self._unproven[number]
        host = one.address[0]
        self._unproven_there[host] -= 1
        if not self._unproven_there[host]:
            del self._unproven_there[host]

    def _fill(self, one: _Unproven) -> bool:
        """Read what is there, of the preface alone; return whether it can be judged."""
        try:
            data = one.sock.recv(PREFACE_BYTES - len(one.data))
        except (BlockingIOError, InterruptedError):
            return False
        except OSError:
            data = b""
        one.data += data
        one.ended = not data
        return one.ended or len(one.data) == PREFACE_BYTES or is_preface(one.data) is False

    def _proceed(self, one: _Unproven) -> None:
        if one.ended:
            one.sock.close()
            self._note_bad()
            _log.debug("! %s: closed after %d bytes", one.address[0], len(one.data))
        elif is_preface(one.data) is False:
            text = "the dialler is not secured, but this mesh is"
            self._refuse(one.sock, one.address[0], refusal(TrustReason.PLAIN, text))
        else:
            self._judge(one)

    def _judge(self, one: _Unproven) -> None:
        host = one.address[0]
        try:
            preface, old = self._security.guard.admit(one.data, self._clock.now(), self._security.wall(), host)
        except PrefaceError as error:
            self._refuse(one.sock, host, refusal(error.reason, str(error)))
            return
        if preface.purpose is not Purpose.LINK:
            if self._on_join is None:
                one.sock.close()
            else:
                self._on_join(one.sock, preface)
            return
        handshakes = self._recognised if old else self._handshakes
        there = sum(address == host for address in handshakes.values())
        if len(handshakes) >= limits.PENDING_CONNECTIONS_MAX or there >= limits.HANDSHAKES_PER_ADDRESS:
            self._refuse(one.sock, host, refusal(TrustReason.FLOOD, "too many TLS handshakes at present"))
            return
        task = asyncio.get_running_loop().create_task(self._secure(one), name=f"secure {host}")
        handshakes[task] = host
        task.add_done_callback(partial(_handshake_ended, handshakes))
        # A task that is cancelled before it begins runs no ``finally``.
        task.add_done_callback(lambda done: one.sock.close() if done.cancelled() else None)

    def _refuse(self, sock: socket.socket, host: str, refuse: Refuse) -> None:
        """Count, answer unless there are many, and close."""
        self._note_bad()
        now = self._clock.now()
        text = f"refused a connection from {host}: {refuse.text}"
        self._refusals.refuse(now, f"link.refused.{refuse.label}", host, text)
        if self._answers.take(now):
            with contextlib.suppress(OSError):
                sock.send(Frame(FrameKind.REFUSE, refuse.serialize()).serialize())
                sock.shutdown(socket.SHUT_WR)
                sock.recv(_READ)  # unread bytes would make the end a reset, which overtakes the answer
        sock.close()

    def _note_bad(self) -> None:
        """Leave a flood of connections that show no group key to the kernel for a moment."""
        if not self._bad.take(self._clock.now()):
            self._refusals.count("link.paused")
            self._pause(limits.UNPROVEN_PAUSE)

    def _arm(self) -> None:
        self._timer = None
        now = self._clock.now()
        for one in list(self._unproven.values()):
            if one.deadline > now:
                self._timer = asyncio.get_running_loop().call_later(one.deadline - now, self._arm)
                return
            self._forget(one)
            one.sock.close()
            self._refusals.count("link.unfinished")

    # --- TLS --------------------------------------------------------------------------------------------------

    async def _secure(self, one: _Unproven) -> None:
        sock, host = one.sock, one.address[0]
        secured: SecuredSocket | None = None
        handshake = TlsHandshake(self._security.server_context, server_side=True)
        try:
            async with asyncio.timeout(limits.SECURING_TIMEOUT):
                await _shake(sock, handshake)
            proved = _secured(sock, handshake)
            self._judge_certificate(proved)
            secured = proved
        except SecuringError as error:
            text = f"{'refused a link with' if error.by_us else 'no link with'} {host}: {error}"
            self._refusals.refuse(self._clock.now(), f"link.refused.{error.refuse.label}", host, text)
            self._on_refused(host, error.refuse)
            await _linger(sock)
        except OSError as error:  # TimeoutError too
            self._refusals.count("link.unfinished")
            _log.debug("! %s: no TLS handshake: %s", host, str(error) or "no answer in time")
        finally:
            if secured is None:
                sock.close()
        if secured is not None:
            self._on_secured(sock, one.address, secured)

    def _judge_certificate(self, proved: SecuredSocket) -> None:
        """Refuse a revoked module before its hello, which it could hold back: none waits in a place of a member."""
        try:
            self._security.judge_member(proved.certificate, None)
        except TrustError as error:
            refuse = refusal(error.reason, str(error))
            with contextlib.suppress(OSError):
                proved.socket.sendmsg([Frame(FrameKind.REFUSE, refuse.serialize()).serialize()])
            raise SecuringError(refuse, by_us=True) from None


def _handshake_ended(handshakes: dict[asyncio.Task[None], str], task: asyncio.Task[None]) -> None:
    del handshakes[task]
    if not task.cancelled() and (error := task.exception()) is not None:
        _log.error("! %s failed", task.get_name(), exc_info=error)


async def _linger(sock: socket.socket) -> None:
    """Let the other side read the alert: closing with unread bytes is a reset, which overtakes it."""
    with contextlib.suppress(OSError):
        sock.shutdown(socket.SHUT_WR)
        async with asyncio.timeout(limits.REFUSAL_LINGER):
            while await asyncio.get_running_loop().sock_recv(sock, _READ):
                pass
