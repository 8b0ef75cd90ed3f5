"""A join, and a renewal with a certificate that has ended, over sockets: the side of the module that asks."""

from __future__ import annotations

import asyncio
import contextlib
import os
import socket
import ssl
from collections.abc import Callable
from typing import TYPE_CHECKING, Final

from rmpa.core.errors import PeerRefused, RemoteProtocolError, UnreachableError
from rmpa.trust import certificates, limits
from rmpa.trust.io import store as files_of
from rmpa.trust.io.join_connection import (
    JoinConnection,
    NotTlsError,
    join_client_context,
    renewal_context,
)
from rmpa.trust.io.private_keys import new_key, private_key
from rmpa.trust.io.store import MemberFiles
from rmpa.trust.join import CodeShown, Joined, JoiningSide
from rmpa.trust.preface import Preface, Purpose
from rmpa.trust.reasons import TrustReason
from rmpa.trust.renewal import Renew, RenewalGrant, RenewalRefused, decode_renewal, encode_renewal

if TYPE_CHECKING:
    from collections.abc import Awaitable

    from rmpa.core.clock import Clock
    from rmpa.trust.io.membership import Membership
    from rmpa.trust.renewal import RenewalMessage
    from rmpa.trust.tokens import Token

ReadRefusal = Callable[[bytes], tuple[str, str] | None]
"""Reads what a mesh answers without TLS: the word and the text of a refusal, or ``None`` if it is none."""
_REMEDIES: Final = {
    "token": "ask for a new one: rmpa trust invite at the authority",
    "key": "is it still the same mesh? else join again: rmpa trust invite at the authority",
    "used": "each token lets one module join; ask for a new one: rmpa trust invite at the authority",
    "late": "ask for a new one: rmpa trust invite at the authority",
    "name": "join with the --name that it is for",
    "taken": "choose another --name; or at the authority: rmpa trust invite --module NAME, or rmpa trust revoke NAME",
    "code": "begin again with a new token; if the codes differ once more, something is between the machines",
    "foreign": "is the token of this mesh? ask for a new one",
    "clock": "set the clock of both machines",
    "unsecured": "start the authority's agent again: it has joined no mesh, or runs since before rmpa trust init",
    "revoked": "join again with a new token: rmpa trust invite at the authority",
    "expired": "join again with a new token: rmpa trust invite at the authority",
}


def refused(reason: str, text: str) -> PeerRefused:
    """The error for the user of a refusal."""
    return PeerRefused("the authority", f"{text} ({reason})", _REMEDIES.get(reason, ""))


async def _open(address: str, port: int, preface: bytes) -> socket.socket:
    """Connect, and send the preface.

    Raises:
        UnreachableError: Nothing answers there.
    """
    sock = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
    sock.setblocking(False)
    loop = asyncio.get_running_loop()
    try:
        async with asyncio.timeout(limits.JOIN_STEP_TIMEOUT):
            await loop.sock_connect(sock, (address, port))
            await loop.sock_sendall(sock, preface)
    except (OSError, TimeoutError):
        sock.close()
        remedy = "does rmpa up run there, and does its TCP port get through the firewall?"
        raise UnreachableError("authority", f"{address}:{port}", remedy) from None
    except BaseException:
        sock.close()
        raise
    return sock


async def _secure(connection: JoinConnection, read_refusal: ReadRefusal, unproven: tuple[str, str]) -> None:
    """Do the handshake of the dialling side; errors are texts for the user.

    Args:
        connection: The connection.
        read_refusal: Reads a refusal without TLS.
        unproven: The word and the text of one that is due to the preface's key.
    """
    try:
        async with asyncio.timeout(limits.JOIN_STEP_TIMEOUT):
            await connection.handshake()
    except NotTlsError as error:
        found = read_refusal(error.answer)
        if found is None:
            raise RemoteProtocolError(
                "the program at the token's address is not an agent of a secured mesh"
            ) from None
        if found[0] == TrustReason.KEY.label:  # its own remedy is for links
            found = unproven
        raise refused(*found) from None
    except (ssl.SSLError, OSError) as error:
        reason = getattr(error, "reason", None) or str(error) or "no answer"
        raise RemoteProtocolError(f"no TLS connection with the authority: {reason}") from None


# --- the module that joins ------------------------------------------------------------------------------------------


async def join_mesh(
    token: Token,
    name: str,
    clock: Clock,
    compare: Callable[[str], Awaitable[bool]],
    read_refusal: ReadRefusal = lambda _: None,
) -> MemberFiles:
    """Join with a token; return the files of the new member.

    Args:
        token: The invitation.
        name: The module's.
        clock: The time.
        compare: Shows the code to the user, and returns whether it is the same at the authority.
        read_refusal: Reads a refusal of the mesh without TLS: its word and its text.

    Raises:
        UnreachableError: The authority cannot be reached, or the connection ended.
        PeerRefused: The authority refuses, or a user says that the codes differ.
        RemoteProtocolError: The other side is not the authority.
    """
    key_pem = new_key()
    request = certificates.make_request(private_key(key_pem, files_of.KEY), name)
    # Without the time: this clock may not be set. A token is used once, and by its holder (``join.proof_of``).
    preface = Preface(Purpose.JOIN, 0, 0, os.urandom(limits.PREFACE_NONCE_BYTES), token.token_id)
    sock = await _open(str(token.address), token.port, preface.serialize(token.key))
    connection = JoinConnection(sock, join_client_context(), server_side=False)
    try:
        await _secure(connection, read_refusal, ("token", "the token is unknown there, was used, or has ended"))
        nonce = os.urandom(limits.NONCE_BYTES)
        side = JoiningSide(name, request, token, connection.certificate(), nonce, clock.now())
        joined = await _joining(connection, side, clock, compare)
    finally:
        connection.close()
    return MemberFiles(key_pem, joined.certificate, joined.ca, joined.keys, joined.deny)


async def _joining(
    connection: JoinConnection, side: JoiningSide, clock: Clock, compare: Callable[[str], Awaitable[bool]]
) -> Joined:
    """Drive the joining side to its end."""
    asking: asyncio.Task[bool] | None = None
    reading = asyncio.ensure_future(connection.receive())
    try:
        while True:
            with contextlib.suppress(OSError):
                await connection.send(side.take_output())
            for event in side.events():
                if isinstance(event, CodeShown):
                    asking = asyncio.ensure_future(compare(event.code))
                elif isinstance(event, Joined):
                    return event
                else:
                    raise refused(event.reason, event.text)
            waiting = {reading, asking} if asking is not None else {reading}
            due = side.next_timer()
            timeout = max(0.0, due - clock.now()) if due is not None else None
            done, _ = await asyncio.wait(waiting, timeout=timeout, return_when=asyncio.FIRST_COMPLETED)
            side.handle_timer(clock.now())
            if asking is not None and asking in done and not side.over:
                side.agree() if asking.result() else side.reject()
                asking = None
            if reading in done and not side.over:
                if data := reading.result():
                    # The times of certificates do not matter here: this clock may not be set yet.
                    side.receive(data, None)
                else:
                    side.lost()
                reading = asyncio.ensure_future(connection.receive())
    finally:
        for task in (reading, asking):
            if task is not None:
                task.cancel()
        await asyncio.gather(reading, *([asking] if asking is not None else []), return_exceptions=True)


# --- the module whose certificate has ended ------------------------------------------------------------------------


async def renew_at_authority(
    membership: Membership,
    address: str,
    port: int,
    read_refusal: ReadRefusal = lambda _: None,
) -> RenewalGrant:
    """Ask for a certificate over a connection of its own, with one that may have ended.

    Raises:
        UnreachableError: The authority cannot be reached.
        PeerRefused: It refuses.
        RemoteProtocolError: The other side is not the authority.
    """
    store = membership.store
    request = membership.request()
    context = renewal_context(
        store.path(files_of.CERTIFICATE), store.path(files_of.KEY), membership.files.ca, server_side=False
    )
    sock = await _open(address, port, membership.preface(Purpose.RENEWAL))
    connection = JoinConnection(sock, context, server_side=False)
    try:
        await _secure(connection, read_refusal, ("key", "our group keys are unknown there, or too old"))
        name = certificates.verify(connection.certificate(), membership.files.ca, None).name
        if name != membership.authority:
            raise RemoteProtocolError(f"the module at {address}:{port} is {name}, not the authority")
        try:
            async with asyncio.timeout(limits.JOIN_STEP_TIMEOUT):
                await connection.send(encode_renewal(Renew(request)))
                answer = await one_message(connection)
        except (OSError, TimeoutError):
            raise UnreachableError("authority", f"{address}:{port}", "it did not answer in time") from None
    finally:
        connection.close()
    if isinstance(answer, RenewalRefused):
        raise refused(_safe(answer.reason[:32]), _safe(answer.text[:300]))
    if not isinstance(answer, RenewalGrant):
        raise RemoteProtocolError("the authority answers a renewal with something else")
    return answer


def _safe(text: str) -> str:
    """A text of the other side, fit for a terminal and a log: one line, nothing unprintable."""
    return "".join(c if c.isprintable() else " " for c in text)


async def one_message(connection: JoinConnection) -> RenewalMessage:
    """The next message of a renewal.

    Raises:
        RemoteProtocolError: It is malformed, or the connection ended before it was whole.
    """
    data = bytearray()
    while (message := decode_renewal(data)) is None:
        more = await connection.receive()
        if not more:
            raise RemoteProtocolError("the connection ended before the answer")
        data += more
    return message
