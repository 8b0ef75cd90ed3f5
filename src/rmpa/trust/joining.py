"""Joins and renewals at the authority and at a module, and the status of trust.

Joins and renewals at the authority, on connections of the mesh's port with the ALPN ``rmpa-join/1``.
"""

from __future__ import annotations

import asyncio
import contextlib
import hmac
import logging
import ssl
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from rmpa.core.errors import PeerRefused, RemoteProtocolError, StartError, UnreachableError
from rmpa.core.log import RefusalLog
from rmpa.trust import certificates, limits, tokens
from rmpa.trust.certificates import DenyList, KeyList, read_certificate, read_document
from rmpa.trust.membership import Membership, MeshAuthority, new_key, private_key
from rmpa.trust.permissions import JoinStep, MemberInfo, TokenInfo, TrustError, TrustReason, TrustStatus
from rmpa.trust.store import ALPN_JOIN, CERTIFICATE, KEY, MemberFiles, join_context, member_context

if TYPE_CHECKING:
    import socket
    from collections.abc import Callable, Collection

    from rmpa.core.statistics import Counters
    from rmpa.runtime.loop import SystemClock
    from rmpa.runtime.tls import TlsHandshake
    from rmpa.trust.tokens import Token

_log = logging.getLogger(__name__)
_READ = 16 * 1024


@dataclass(eq=False)
class JoinServer:
    """The authority's end of joins and renewals.

    Args:
        authority: Issues the certificates.
        clock: Monotonic seconds.
        counters: Counts what is refused: ``trust.join_refused``, ``trust.renewal_refused``.
    """

    authority: MeshAuthority
    clock: SystemClock
    counters: Counters

    def __post_init__(self) -> None:
        self._refusals = RefusalLog(_log, self.counters)
        # What came of each token, by its id.
        self._steps: dict[bytes, JoinStep] = {}
        # Set, and replaced, at each step.
        self.changed = asyncio.Event()

    async def serve(self, sock: socket.socket, handshake: TlsHandshake, host: str) -> None:
        """Read one question behind the TLS handshake, and answer it; the caller closes the socket.

        Raises:
            OSError: The connection ended, or the question did not come within ``limits.JOIN_STEP_TIMEOUT``.
            RemoteProtocolError: The question is malformed.
        """
        loop, tls, data = asyncio.get_running_loop(), handshake.tls, b""
        async with asyncio.timeout(limits.JOIN_STEP_TIMEOUT):
            size = tokens.LENGTH.size
            while len(data) < size:
                try:
                    data += tls.read(_READ)
                except ssl.SSLWantReadError:
                    raw = await loop.sock_recv(sock, _READ)
                    if not raw:
                        raise ConnectionError("closed the connection before its question was whole") from None
                    handshake.receive(raw)
                if len(data) >= tokens.LENGTH.size:
                    size = tokens.LENGTH.size + tokens.message_length(data, limits.JOIN_REQUEST_MAX)
            answer = self.answer(
                tokens.decode_message(data[tokens.LENGTH.size : size]), tls.getpeercert(binary_form=True), host
            )
            tls.write(tokens.encode_message(answer))
            await loop.sock_sendall(sock, handshake.take_output())

    def answer(
        self, asked: tokens.JoinMessage, presented: bytes | None, host: str
    ) -> tokens.CertificateGrant | tokens.JoinRefused:
        """Answer a question; what it changes is written to files before.

        Args:
            asked: The question.
            presented: The certificate (DER) of the other end, of this mesh's CA; ``None``: it has none.
            host: The address of the other end.

        Raises:
            RemoteProtocolError: It is no question.
        """
        what = "renewal" if isinstance(asked, tokens.Renew) else "join"
        try:
            if isinstance(asked, tokens.Join):
                return self._join(asked, host)
            if not isinstance(asked, tokens.Renew) or presented is None:
                raise RemoteProtocolError("a join or renewal that begins with something else than its question")
            before = self.authority.judge_renewal(presented)
            grant = self.authority.grant(asked.request, before.name)
            _log.info("= %s at %s has a new certificate; it was away", before.name, host)
        except TrustError as error:
            refused = tokens.JoinRefused(error.reason.label, str(error))
        except StartError as error:
            refused = tokens.JoinRefused(
                "clock" if self.authority.membership.wall() is None else "authority", str(error)
            )
        else:
            return grant
        return self._refuse(what, host, refused)

    def _refuse(self, what: str, host: str, refused: tokens.JoinRefused) -> tokens.JoinRefused:
        """Log what each connection can repeat, within limits."""
        text = f"refused a {what} by {host} ({refused.reason}): {refused.text}"
        self._refusals.refuse(self.clock.now(), f"trust.{what}_refused", host, text)
        return refused

    def _join(self, asked: tokens.Join, host: str) -> tokens.CertificateGrant | tokens.JoinRefused:
        """Let a module join: its token is used, also after a crash, before a certificate is issued."""
        authority, name = self.authority, certificates.read_request(asked.request).name
        invitation = authority.invitations.get(asked.token)
        problem = "token" if invitation is None else invitation.problem(name, authority.wall())
        if invitation is None or problem:
            # The refusal of a token that is used or has ended is no secret: its id is known to its holder alone.
            refused = tokens.JoinRefused(problem, f"{name} cannot join: the token {tokens.TOKEN_PROBLEMS[problem]}")
        elif not hmac.compare_digest(
            tokens.proof_of(invitation.key, asked.request, authority.membership.files.certificate), asked.proof
        ):
            refused = tokens.JoinRefused("token", "the request is not signed with the token's key")
        elif authority.is_member(name, invitation.name):
            refused = tokens.JoinRefused(
                "taken", f"a module named {name} is a member: choose another --name, or revoke it"
            )
        else:
            invitation.used_by, invitation.key = name, b""
            authority.save_tokens()
            grant = authority.grant(asked.request)
            self._step(asked.token, "joined", name)
            _log.info("+ %s at %s has joined", name, host)
            return grant
        if invitation is not None:
            self._step(asked.token, "refused", name, refused)
        return self._refuse("join", host, refused)

    def step(self, token_id: bytes) -> JoinStep:
        """What came of a token so far, as ``rmpa trust invite`` shows it."""
        return self._steps.get(token_id, JoinStep(step=0, state="waiting"))

    def _step(self, token_id: bytes, state: str, module: str, refused: tokens.JoinRefused | None = None) -> None:
        while len(self._steps) >= limits.TOKENS_MAX:
            del self._steps[next(iter(self._steps))]
        reason, text = (refused.reason, refused.text) if refused is not None else ("", "")
        number = self.step(token_id).step + 1
        self._steps[token_id] = JoinStep(step=number, state=state, module=module, reason=reason, text=text)
        changed, self.changed = self.changed, asyncio.Event()
        changed.set()


# A join, and a renewal with a certificate that has ended. The side of the module that asks.


_REMEDIES: Final = {
    "token": "ask for a new one: rmpa trust invite at the authority",
    "used": "each token lets one module join; ask for a new one: rmpa trust invite at the authority",
    "late": "ask for a new one: rmpa trust invite at the authority",
    "name": "join with the --name that it is for",
    "taken": "choose another --name; or at the authority: rmpa trust invite --module NAME, or rmpa trust revoke NAME",
    "foreign": "is the token of this mesh? ask for a new one",
    "clock": "set the clock of both machines",
    "revoked": "join again with a new token: rmpa trust invite at the authority",
    "expired": "join again with a new token: rmpa trust invite at the authority",
}


def _refused(reason: str, text: str) -> PeerRefused:
    """The error for the user of a refusal: one line, nothing unprintable."""
    text, reason = ("".join(c if c.isprintable() else " " for c in each) for each in (text[:300], reason[:32]))
    return PeerRefused("the authority", f"{text} ({reason})", _REMEDIES.get(reason, ""))


async def _ask(
    address: str, port: int, context: ssl.SSLContext, question: Callable[[bytes], tokens.JoinMessage]
) -> tuple[tokens.CertificateGrant, bytes]:
    """Ask the authority; return its answer and its certificate (DER).

    Args:
        address: Where it is reached.
        port: Its mesh port.
        context: Of this side.
        question: What to ask, by the server's certificate (DER); it may refuse the server.

    Raises:
        UnreachableError: It cannot be reached, or does not answer.
        PeerRefused: It refuses.
        RemoteProtocolError: The other side is not the authority.
    """
    where = f"{address}:{port}"
    try:
        async with asyncio.timeout(limits.JOIN_STEP_TIMEOUT):
            reader, writer = await asyncio.open_connection(address, port, ssl=context)
    except ssl.SSLError as error:
        if error.reason in ("WRONG_VERSION_NUMBER", "RECORD_LAYER_FAILURE"):
            text = f"the program at {where} is not an agent of a secured mesh"
            raise RemoteProtocolError(f"{text}; if it is the authority's agent, start it again there") from None
        raise RemoteProtocolError(f"no TLS connection with the authority: {error.reason or error}") from None
    except OSError:
        remedy = "does rmpa up run there, and does its TCP port get through the firewall?"
        raise UnreachableError("authority", where, remedy) from None
    try:
        tls: ssl.SSLObject = writer.get_extra_info("ssl_object")
        if tls.selected_alpn_protocol() != ALPN_JOIN:
            raise RemoteProtocolError(f"the module at {where} is not the authority of its mesh")
        server = tls.getpeercert(binary_form=True) or b""
        async with asyncio.timeout(limits.JOIN_STEP_TIMEOUT):
            writer.write(tokens.encode_message(question(server)))
            size = tokens.message_length(await reader.readexactly(tokens.LENGTH.size), limits.JOIN_ANSWER_MAX)
            answer = tokens.decode_message(await reader.readexactly(size))
    except (OSError, asyncio.IncompleteReadError):
        raise UnreachableError("authority", where, "it did not answer; its log may say why") from None
    finally:
        writer.close()
        with contextlib.suppress(OSError):
            await writer.wait_closed()
    if isinstance(answer, tokens.JoinRefused):
        raise _refused(answer.reason, answer.text)
    if not isinstance(answer, tokens.CertificateGrant):
        raise RemoteProtocolError("the authority answers by something else than a certificate")
    return answer, server


async def join_mesh(token: Token, name: str) -> MemberFiles:
    """Join with a token as the module ``name``; return the files of the new member.

    The times of certificates do not matter: this clock may not be set yet.

    Raises:
        UnreachableError: The authority cannot be reached, or the connection ended.
        PeerRefused: The authority refuses.
        RemoteProtocolError: The other side is not the authority.
    """
    pem = new_key()
    request = certificates.make_request(private_key(pem, KEY), name)

    def question(server: bytes) -> tokens.Join:
        return tokens.Join(token.token_id, request, tokens.proof_of(token.key, request, server))

    grant, server = await _ask(str(token.address), token.port, join_context(), question)
    try:
        certificates.check_ca(grant.ca, token.fingerprint)
        read_certificate(server, grant.ca)
        check_grant(grant, name, request)
    except TrustError as error:
        raise _refused(error.reason.label, str(error)) from None
    return MemberFiles(pem, grant.certificate, grant.ca, grant.keys, grant.deny)


def check_grant(grant: tokens.CertificateGrant, name: str, request: bytes) -> None:
    """Check that a grant, whose CA is the right one, is for this module and its request (DER).

    Raises:
        TrustError: The certificate is of another CA, module or key.
        RemoteProtocolError: A document is malformed, or not signed by the CA.
    """
    found = read_certificate(grant.certificate, grant.ca)
    found.judge(None, name)
    if found.public_key != certificates.read_request(request).public_key:
        raise TrustError(TrustReason.FOREIGN, "the certificate is of another key")
    key = certificates.ca_public_key(grant.ca)
    read_document(grant.keys, key, KeyList)
    if grant.deny:
        read_document(grant.deny, key, DenyList)


async def renew_at_authority(membership: Membership, address: str, port: int) -> None:
    """Renew a certificate, which may have ended, over a connection of its own; raises as ``join_mesh``."""
    store = membership.store
    files = store.path(CERTIFICATE), store.path(KEY)

    def question(server: bytes) -> tokens.Renew:
        name = membership.read_member(server).name
        if name != membership.keys.authority:
            raise RemoteProtocolError(f"the module at {address}:{port} is {name}, not the authority")
        return tokens.Renew(membership.request())

    context = member_context(*files, membership.files.ca, ALPN_JOIN, server_side=False)
    grant, _ = await _ask(address, port, context, question)
    membership.take_grant(grant)


def status_of(
    membership: Membership,
    authority: MeshAuthority | None = None,
    *,
    agent: str = "off",
    linked: Collection[str] | None = None,
    authority_name: str = "",
) -> TrustStatus:
    """The state of a member.

    Args:
        membership: The member.
        authority: What it has as the authority; ``None``: it is not.
        agent: As in the result.
        linked: The names of the linked modules; ``None``: the agent does not run.
        authority_name: The authority's name; empty: as the files say.
    """
    certificate, deny = membership.certificate, membership.deny
    place = None if authority is not None else membership.store.load_authority()
    name = membership.name if authority is not None else authority_name or (place.name if place is not None else "")
    wall = membership.wall()
    return TrustStatus(
        on=True,
        module=membership.name,
        folder=str(membership.store.folder),
        agent=agent,
        is_authority=authority is not None,
        authority=name,
        fingerprint=tokens.fingerprint_of(membership.files.ca).hex(),
        issued=int(certificate.issued),
        expires=int(certificate.expires),
        renew_at=int(certificate.renew_at),
        clock_set=wall is not None,
        key=membership.ring.newest.number,
        deny_number=deny.number,
        revoked=tuple(sorted(entry.name for entry in deny.entries)),
        members=tuple(
            MemberInfo(
                name=each.name,
                issued=each.issued,
                expires=each.expires,
                linked=None if linked is None else each.name in {*linked, membership.name},
            )
            for each in (authority.issued if authority is not None else ())
        ),
        tokens=tuple(
            TokenInfo(
                id=each.token_id.hex(),
                state="used" if each.used_by else "ended" if wall is not None and wall >= each.expires else "open",
                expires=each.expires,
                name=each.name,
                used_by=each.used_by,
            )
            for each in (authority.invitations.values() if authority is not None else ())
        ),
        problems=problems_of(membership, name),
    )


def problems_of(membership: Membership, authority_name: str = "") -> tuple[str, ...]:
    """What the user should do something about."""
    wall, certificate = membership.wall(), membership.certificate
    if wall is None:
        text = "this machine's clock is not set: it shows a time before the certificate was issued"
        return (f"{text}, so times of certificates and packets are not checked; set it (timedatectl)",)
    if membership.deny.denies(membership.name, certificate.issued):
        remedy = "if it is to come back: rmpa trust invite at the authority, rmpa trust join here"
        return (f"this module was revoked (deny list {membership.deny.number}); {remedy}",)
    left = certificate.expires - wall
    where = f"the authority {authority_name}" if authority_name else "the authority"
    if left <= 0:
        return (f"the certificate of {membership.name} has ended: no link comes up until {where} renews it",)
    if left <= limits.EXPIRY_NEAR:
        text = f"the certificate of {membership.name} ends in {left / 3600:.0f} h, and could not be renewed"
        return (f"{text}: is {where} running and reachable?",)
    return ()
