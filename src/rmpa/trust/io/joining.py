"""A join, and a renewal with a certificate that has ended: the side of the module that asks."""

from __future__ import annotations

import asyncio
import contextlib
import ssl
from typing import TYPE_CHECKING, Final

from rmpa.core.errors import PeerRefused, RemoteProtocolError, UnreachableError
from rmpa.trust import certificates, limits
from rmpa.trust.documents import read_deny_list, read_key_list
from rmpa.trust.io import store as files_of
from rmpa.trust.io.contexts import ALPN_JOIN, join_context, member_context
from rmpa.trust.io.private_keys import new_key, private_key
from rmpa.trust.io.store import MemberFiles
from rmpa.trust.join import (
    LENGTH,
    CertificateGrant,
    Join,
    JoinMessage,
    JoinRefused,
    Renew,
    decode_message,
    encode_message,
    message_length,
    proof_of,
)
from rmpa.trust.reasons import TrustReason

if TYPE_CHECKING:
    from collections.abc import Callable

    from rmpa.trust.io.membership import Membership
    from rmpa.trust.tokens import Token

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
    address: str, port: int, context: ssl.SSLContext, question: Callable[[bytes], JoinMessage]
) -> tuple[CertificateGrant, bytes]:
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
    except (OSError, TimeoutError):
        remedy = "does rmpa up run there, and does its TCP port get through the firewall?"
        raise UnreachableError("authority", where, remedy) from None
    try:
        tls: ssl.SSLObject = writer.get_extra_info("ssl_object")
        if tls.selected_alpn_protocol() != ALPN_JOIN:
            raise RemoteProtocolError(f"the module at {where} is not the authority of its mesh")
        server = tls.getpeercert(binary_form=True) or b""
        async with asyncio.timeout(limits.JOIN_STEP_TIMEOUT):
            writer.write(encode_message(question(server)))
            size = message_length(await reader.readexactly(LENGTH.size), limits.JOIN_ANSWER_MAX)
            answer = decode_message(await reader.readexactly(size))
    except (OSError, TimeoutError, asyncio.IncompleteReadError):
        raise UnreachableError("authority", where, "it did not answer; its log may say why") from None
    finally:
        writer.close()
        with contextlib.suppress(OSError):
            await writer.wait_closed()
    if isinstance(answer, JoinRefused):
        raise _refused(answer.reason, answer.text)
    if not isinstance(answer, CertificateGrant):
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
    request = certificates.make_request(private_key(pem, files_of.KEY), name)

    def question(server: bytes) -> Join:
        return Join(token.token_id, request, proof_of(token.key, request, server))

    grant, server = await _ask(str(token.address), token.port, join_context(), question)
    try:
        certificates.check_ca(grant.ca, token.fingerprint)
        certificates.verify(server, grant.ca, None)
        check_grant(grant, name, request)
    except certificates.CertificateError as error:
        raise _refused(error.reason.label, str(error)) from None
    return MemberFiles(pem, grant.certificate, grant.ca, grant.keys, grant.deny)


def check_grant(grant: CertificateGrant, name: str, request: bytes) -> None:
    """Check that a grant, whose CA is the right one, is for this module and its request (DER).

    Raises:
        CertificateError: The certificate is of another CA, module or key.
        DocumentError: A document is malformed, or not signed by the CA.
    """
    found = certificates.verify(grant.certificate, grant.ca, None, name=name)
    if found.public_key != certificates.read_request(request).public_key:
        raise certificates.CertificateError(TrustReason.FOREIGN, "the certificate is of another key")
    key = certificates.ca_public_key(grant.ca)
    read_key_list(grant.keys, key)
    if grant.deny:
        read_deny_list(grant.deny, key)


async def renew_at_authority(membership: Membership, address: str, port: int) -> CertificateGrant:
    """Ask for a certificate over a connection of its own, with one that may have ended; raises as ``join_mesh``."""
    store = membership.store
    files = store.path(files_of.CERTIFICATE), store.path(files_of.KEY)

    def question(server: bytes) -> Renew:
        name = certificates.verify(server, membership.files.ca, None).name
        if name != membership.authority:
            raise RemoteProtocolError(f"the module at {address}:{port} is {name}, not the authority")
        return Renew(membership.request())

    context = member_context(*files, membership.files.ca, ALPN_JOIN, server_side=False)
    return (await _ask(address, port, context, question))[0]
