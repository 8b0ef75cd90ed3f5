"""The machines of a join, which run inside TLS; its server certificate is checked by the first message.

::

    JoiningSide                                        InvitingSide
                ◄─────────────────────── welcome {ca}
    hello {request, commitment, proof} ─────────────►
                ◄───────────────────── challenge {nonce}
    reveal {nonce} ─────────────────────────────────►  the token is used
            both show the code; each user says whether it is the same
    agree {} ───────────────────────────────────────►
                ◄── grant {certificate, keys, deny}
    either side at any time: refuse {reason, text}

The proof is made with the token's key over the request, the commitment and the server's certificate (``proof_of``):
only a holder of the token's secret can have sent the hello, in this TLS session.

A message is a JSON object with its length in front (4 bytes, big-endian); bytes in it are base64. Times are
arguments, and so are random bytes. A machine that is over ignores what comes, and its driver closes the connection.
"""

from __future__ import annotations

import hashlib
import hmac
import struct
from abc import ABC, abstractmethod
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Final

import msgspec

from rmpa.core.errors import LimitExceeded, LocalProtocolError, RemoteProtocolError
from rmpa.trust import certificates, limits
from rmpa.trust.codes import CodeContext, CodeState, InvitingCode, JoiningCode
from rmpa.trust.documents import read_deny_list, read_key_list

if TYPE_CHECKING:
    from collections.abc import Callable

    from cryptography.hazmat.primitives.asymmetric import ec

    from rmpa.trust.tokens import Token, TokenBook

_LENGTH: Final = struct.Struct(">I")
_PROOF: Final = b"rmpa join hello 1"
_TEXT_MAX: Final = 300
"""Characters of the other side's text that are kept."""


class _Welcome(msgspec.Struct, frozen=True, tag="welcome", tag_field="op"):
    ca: bytes


class _Hello(msgspec.Struct, frozen=True, tag="hello", tag_field="op"):
    request: bytes
    commitment: bytes
    proof: bytes


class _Challenge(msgspec.Struct, frozen=True, tag="challenge", tag_field="op"):
    nonce: bytes


class _Reveal(msgspec.Struct, frozen=True, tag="reveal", tag_field="op"):
    nonce: bytes


class _Agree(msgspec.Struct, frozen=True, tag="agree", tag_field="op"):
    pass


class _Grant(msgspec.Struct, frozen=True, tag="grant", tag_field="op"):
    certificate: bytes
    keys: bytes
    deny: bytes = b""


class _Refuse(msgspec.Struct, frozen=True, tag="refuse", tag_field="op"):
    reason: str
    text: str


_Message = _Welcome | _Hello | _Challenge | _Reveal | _Agree | _Grant | _Refuse


@dataclass(frozen=True, slots=True)
class CodeShown:
    """The users compare this code; ``agree`` or ``reject`` follows.

    Args:
        code: Six digits.
        module: The module that joins, by its own word.
    """

    code: str
    module: str


@dataclass(frozen=True, slots=True)
class Joined:
    """The module is a member.

    Args:
        module: Its name.
        certificate: Its certificate (DER).
        ca: The CA's (DER).
        keys: The signed list of group keys.
        deny: The signed deny list; empty if nothing was revoked.
    """

    module: str
    certificate: bytes
    ca: bytes
    keys: bytes = field(repr=False)
    deny: bytes = b""


@dataclass(frozen=True, slots=True)
class JoinRefused:
    """The join is over without success.

    Args:
        reason: One word: of ``TokenProblem`` or ``TrustReason``, ``code`` (the codes differ, or the time was over),
            ``taken`` (a member has the name), or of a later release.
        text: What happened.
        by_us: Whether this side refused.
    """

    reason: str
    text: str
    by_us: bool


JoinEvent = CodeShown | Joined | JoinRefused


class _Refused(Exception):  # noqa: N818 - a way out of a handler, never seen outside
    def __init__(self, reason: str, text: str) -> None:
        super().__init__(text)
        self.reason = reason
        self.text = text


class _Side(ABC):
    """What both sides have in common: messages, events, the end.

    Args:
        code: The machine of the code; ``None`` until it can be made.
        message_max: Bytes of one message that are read.
        now: Monotonic seconds.
    """

    def __init__(self, code: JoiningCode | InvitingCode | None, message_max: int, now: float) -> None:
        self._machine = code
        self._message_max = message_max
        self._deadline = now + limits.CODE_TIMEOUT
        self._input = bytearray()
        self._output = bytearray()
        self._events: list[JoinEvent] = []
        self._over = False

    @property
    def over(self) -> bool:
        """Whether the join has ended; the output is still to be sent."""
        return self._over

    def take_output(self) -> bytes:
        """The bytes to send now."""
        output = bytes(self._output)
        self._output.clear()
        return output

    def events(self) -> list[JoinEvent]:
        """What happened since the last call."""
        events, self._events = self._events, []
        return events

    def receive(self, data: bytes, wall: float | None) -> None:
        """Take bytes of the other side.

        Args:
            data: What came.
            wall: Seconds since 1970; ``None`` if this machine's clock is not set.
        """
        self._input += data
        while not self._over and len(self._input) >= _LENGTH.size:
            (length,) = _LENGTH.unpack_from(self._input)
            if length > self._message_max:
                self._refuse("malformed", str(LimitExceeded("a message", length, self._message_max)))
            elif len(self._input) < _LENGTH.size + length:
                return
            else:
                message = bytes(self._input[_LENGTH.size : _LENGTH.size + length])
                del self._input[: _LENGTH.size + length]
                self._take(message, wall)
        if self._over:
            self._input.clear()

    def reject(self) -> None:
        """The user says that the codes differ; without effect once it is over."""
        if not self._over:
            self._refuse("code", "a user says that the codes differ: is something between the two machines?")

    def revoked(self) -> None:
        """The module that joins was revoked meanwhile; without effect once it is over."""
        if not self._over:
            self._refuse("revoked", "the module was revoked while it joined")

    def lost(self) -> None:
        """The connection ended."""
        if not self._over:
            self._end(JoinRefused("lost", "the connection ended before the join was complete", by_us=False))

    def next_timer(self) -> float | None:
        """When ``handle_timer`` is due, in monotonic seconds."""
        return None if self._over else self._deadline

    def handle_timer(self, now: float) -> None:
        """End a join that takes too long."""
        due = self.next_timer()
        if due is not None and now >= due:
            self._refuse("code", f"the codes were not compared within {limits.CODE_TIMEOUT:g} s")

    def _take(self, data: bytes, wall: float | None) -> None:
        try:
            message = msgspec.json.decode(data, type=_Message)
            if isinstance(message, _Refuse):
                text = message.text[:_TEXT_MAX]
                self._end(JoinRefused(_word(message.reason), ascii(text)[1:-1], by_us=False))
            else:
                self._handle(message, wall)
        except _Refused as error:
            self._refuse(error.reason, error.text)
        except certificates.CertificateError as error:
            self._refuse(error.reason.label, str(error))
        except (msgspec.MsgspecError, UnicodeError, RecursionError, RemoteProtocolError) as error:
            self._refuse("malformed", f"{error!s:.200}")

    @abstractmethod
    def _handle(self, message: _Message, wall: float | None) -> None:
        """Take one message that is no refusal."""

    def _send(self, message: _Message) -> None:
        data = msgspec.json.encode(message)
        self._output += _LENGTH.pack(len(data)) + data

    def _refuse(self, reason: str, text: str) -> None:
        self._send(_Refuse(reason, text))
        self._end(JoinRefused(reason, text, by_us=True))

    def _end(self, event: JoinEvent) -> None:
        self._over = True
        if self._machine is not None:
            self._machine.reject()
        self._events.append(event)


class JoiningSide(_Side):
    """The module that joins.

    Args:
        name: Its name.
        request: Its request for a certificate (DER).
        token: The invitation.
        server: The server's certificate of the TLS connection (DER).
        nonce: ``limits.NONCE_BYTES`` random bytes.
        now: Monotonic seconds.
    """

    def __init__(self, name: str, request: bytes, token: Token, server: bytes, nonce: bytes, now: float) -> None:
        super().__init__(None, limits.JOIN_ANSWER_MAX, now)
        self._name = name
        self._request = request
        self._token = token
        self._server = server
        self._nonce = nonce
        self._now = now
        self._ca = b""
        self._key = b""
        self._code: JoiningCode | None = None

    def agree(self) -> None:
        """The user says that the codes are equal.

        Raises:
            LocalProtocolError: No code is shown.
        """
        if self._code is None or self._over:
            raise LocalProtocolError("there is no code to agree to")
        self._code.agree()
        self._send(_Agree())

    def _handle(self, message: _Message, wall: float | None) -> None:
        code = self._code
        if isinstance(message, _Welcome) and code is None:
            self._welcomed(message)
        elif isinstance(message, _Challenge) and code is not None:
            self._send(_Reveal(code.receive_nonce(message.nonce)))
            self._events.append(CodeShown(code.code, self._name))
        elif isinstance(message, _Grant) and code is not None and code.state is CodeState.AGREED:
            self._granted(message, wall)
        else:
            raise RemoteProtocolError("a message of the authority comes out of turn")

    def _welcomed(self, welcome: _Welcome) -> None:
        """Check that the server is of the token's mesh. Its times do not matter: this clock may not be set yet."""
        certificates.check_ca(welcome.ca, self._token.fingerprint)
        certificates.verify(self._server, welcome.ca, None)
        own = certificates.read_request(self._request)
        self._ca, self._key = welcome.ca, own.public_key
        context = CodeContext(self._name, own.key_hash, _hash(welcome.ca), self._token.token_id)
        self._machine = self._code = JoiningCode(context, self._nonce, self._now)
        proof = proof_of(self._token.key, self._request, self._code.commitment, self._server)
        self._send(_Hello(self._request, self._code.commitment, proof))

    def _granted(self, grant: _Grant, wall: float | None) -> None:
        found = certificates.verify(grant.certificate, self._ca, wall, name=self._name)
        if found.public_key != self._key:
            raise RemoteProtocolError("the certificate is of another key")
        key = certificates.ca_public_key(self._ca)
        read_key_list(grant.keys, key)
        if grant.deny:
            read_deny_list(grant.deny, key)
        self._end(Joined(self._name, grant.certificate, self._ca, grant.keys, grant.deny))


@dataclass(frozen=True, slots=True)
class MeshSecrets:
    """What the authority gives and needs for it.

    Args:
        ca: The CA's certificate (DER).
        ca_key: Its key.
        keys: The signed list of group keys.
        deny: The signed deny list; empty if nothing was revoked.
    """

    ca: bytes
    ca_key: ec.EllipticCurvePrivateKey = field(repr=False)
    keys: bytes = field(repr=False)
    deny: bytes = b""


class InvitingSide(_Side):
    """The authority.

    Args:
        token_id: The token of the preface, whose tag was right.
        book: The tokens.
        secrets: What a member gets.
        server: The server's certificate of the TLS connection (DER).
        serial: A random number for the certificate.
        nonce: ``limits.NONCE_BYTES`` random bytes.
        now: Monotonic seconds.
        is_taken: Whether a member, or another module that joins, has a name; asked when one asks for it, and again
            before the certificate is issued.
    """

    def __init__(
        self,
        token_id: bytes,
        book: TokenBook,
        secrets: MeshSecrets,
        server: bytes,
        serial: int,
        nonce: bytes,
        now: float,
        is_taken: Callable[[str], bool] = lambda _: False,
    ) -> None:
        self._code = InvitingCode(nonce, now)
        super().__init__(self._code, limits.JOIN_REQUEST_MAX, now)
        self._token_id = token_id
        self._book = book
        self._secrets = secrets
        self._server = server
        self._serial = serial
        self._is_taken = is_taken
        self._request: certificates.CertificateRequest | None = None
        self._agreed_there = False
        self._send(_Welcome(secrets.ca))

    @property
    def module(self) -> str:
        """The name that the joining module has asked for; empty: it has not yet."""
        return self._request.name if self._request is not None else ""

    def agree(self, wall: float) -> None:
        """The user says that the codes are equal.

        Args:
            wall: Seconds since 1970.

        Raises:
            LocalProtocolError: No code is shown.
        """
        if self._over:
            raise LocalProtocolError("the join is over")
        self._code.agree()
        try:
            self._grant(wall)
        except _Refused as error:
            self._refuse(error.reason, error.text)

    def _handle(self, message: _Message, wall: float | None) -> None:
        if wall is None:
            raise _Refused("clock", "the authority's clock is not set")
        if isinstance(message, _Hello):
            self._greeted(message, wall)
        elif isinstance(message, _Reveal):
            self._code.receive_nonce(message.nonce)
            assert self._request is not None  # noqa: S101 - a nonce is only accepted behind a hello
            if problem := self._book.use(self._token_id, self._request.name, wall):
                raise _Refused(problem.value, f"the token cannot be used: {problem.value}")
            self._events.append(CodeShown(self._code.code, self._request.name))
        elif isinstance(message, _Agree) and self._code.state in (CodeState.SHOWN, CodeState.AGREED):
            self._agreed_there = True
            self._grant(wall)
        else:
            raise RemoteProtocolError("a message of the joining module comes out of turn")

    def _greeted(self, hello: _Hello, wall: float) -> None:
        request = certificates.read_request(hello.request)
        if problem := self._book.judge(self._token_id, request.name, wall):
            raise _Refused(problem.value, f"the token cannot be used by {request.name}: {problem.value}")
        # The preface proves nothing here: what is between the two machines may have held it back and sent it itself.
        proof = proof_of(self._book.key_of(self._token_id) or b"", hello.request, hello.commitment, self._server)
        if not hmac.compare_digest(proof, hello.proof):
            raise _Refused("token", "the hello is not signed with the token's key")
        self._check_free(request.name)
        context = CodeContext(request.name, request.key_hash, _hash(self._secrets.ca), self._token_id)
        self._send(_Challenge(self._code.receive_commitment(hello.commitment, context)))
        self._request = request

    def _grant(self, wall: float) -> None:
        """Issue the certificate once both users agree."""
        if not self._agreed_there or self._code.state is not CodeState.AGREED:
            return
        assert self._request is not None  # noqa: S101 - there is no code without it
        self._check_free(self._request.name)  # minutes have passed
        secrets = self._secrets
        certificate = certificates.issue(self._request, secrets.ca, secrets.ca_key, self._serial, wall)
        self._send(_Grant(certificate, secrets.keys, secrets.deny))
        self._end(Joined(self._request.name, certificate, secrets.ca, secrets.keys, secrets.deny))

    def _check_free(self, name: str) -> None:
        if self._is_taken(name):
            text = f"a module named {name} is a member, or joins just now: choose another --name, or revoke it"
            raise _Refused("taken", text)


def proof_of(key: bytes, request: bytes, commitment: bytes, server: bytes) -> bytes:
    """The proof in a hello: that the holder of the token makes this request in this TLS session.

    Args:
        key: The token's.
        request: The request for a certificate (DER).
        commitment: Of the joining side, 32 bytes.
        server: The server's certificate of the TLS connection (DER).
    """
    return hmac.digest(key, _PROOF + request + commitment + _hash(server), hashlib.sha256)


def _hash(data: bytes) -> bytes:
    return hashlib.sha256(data).digest()


def _word(reason: str) -> str:
    """A reason of the other side, if it is one word."""
    return reason if reason.isascii() and reason.isidentifier() and len(reason) <= 32 else "other"
