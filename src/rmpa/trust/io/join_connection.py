"""TLS 1.3 over one socket, for joins and renewals: rare, short, and in asyncio's own way."""

from __future__ import annotations

import asyncio
import contextlib
import ssl
from typing import TYPE_CHECKING, Final

from rmpa.core.errors import UnreachableError
from rmpa.trust.io.contexts import ALPN_JOIN

if TYPE_CHECKING:
    import socket
    from pathlib import Path

_READ: Final = 65536
_TLS_RECORDS: Final = (0x15, 0x16)
"""The first byte of an alert, and of a handshake (RFC 8446, section 5.1)."""
_NO_CHECK_TIME: Final = 0x200000
"""X509_V_FLAG_NO_CHECK_TIME of OpenSSL, which Python has no name for."""


class NotTlsError(Exception):
    """The other side answers without TLS; that may be a refusal, which nothing proves.

    Args:
        answer: Its bytes.
    """

    def __init__(self, answer: bytes) -> None:
        super().__init__(f"{len(answer)} bytes that are not TLS")
        self.answer = answer


def join_server_context(certificate: Path, key: Path) -> ssl.SSLContext:
    """For the authority in a join: the other side has no certificate yet."""
    context = _context(ssl.PROTOCOL_TLS_SERVER)
    context.load_cert_chain(certificate, key)
    return context


def join_client_context() -> ssl.SSLContext:
    """For the joining module: the token's fingerprint decides on the server (``join.JoiningSide``)."""
    return _context(ssl.PROTOCOL_TLS_CLIENT)


def renewal_context(certificate: Path, key: Path, ca: bytes, *, server_side: bool) -> ssl.SSLContext:
    """For both ends of a renewal with a certificate that may have ended: its time is judged afterwards.

    Args:
        certificate: The file of this module's certificate (PEM).
        key: The file of its key (PEM).
        ca: The CA's certificate (DER).
        server_side: Whether it is for accepted connections.
    """
    context = _context(ssl.PROTOCOL_TLS_SERVER if server_side else ssl.PROTOCOL_TLS_CLIENT)
    context.verify_mode = ssl.CERT_REQUIRED
    context.verify_flags = ssl.VerifyFlags(context.verify_flags | _NO_CHECK_TIME)
    context.load_cert_chain(certificate, key)
    context.load_verify_locations(cadata=ca)
    return context


def _context(protocol: ssl._SSLMethod) -> ssl.SSLContext:
    context = ssl.SSLContext(protocol)
    context.minimum_version = context.maximum_version = ssl.TLSVersion.TLSv1_3
    context.check_hostname = False
    context.verify_mode = ssl.CERT_NONE
    if protocol is ssl.PROTOCOL_TLS_SERVER:
        context.num_tickets = 0
    context.set_alpn_protocols([ALPN_JOIN])
    return context


class JoinConnection:
    """One TLS connection.

    Args:
        sock: Connected, non-blocking; owned from here on.
        context: This side's.
        server_side: Whether this side accepted the connection.
    """

    def __init__(self, sock: socket.socket, context: ssl.SSLContext, *, server_side: bool) -> None:
        self._sock = sock
        self._incoming, self._outgoing = ssl.MemoryBIO(), ssl.MemoryBIO()
        self._tls = context.wrap_bio(self._incoming, self._outgoing, server_side=server_side)

    async def handshake(self) -> None:
        """Do the TLS handshake.

        Raises:
            NotTlsError: The other side answers without TLS.
            ssl.SSLError: The handshake failed.
            OSError: The connection is gone.
            UnreachableError: The other side closed it.
        """
        first = True
        while True:
            try:
                self._tls.do_handshake()
            except ssl.SSLWantReadError:
                await self._flush()
            except ssl.SSLError:
                with contextlib.suppress(OSError):
                    await self._flush()  # the alert
                raise
            else:
                break
            data = await self._receive()
            if not data:
                raise UnreachableError("authority", self._where(), "it closed the connection; its log may say why")
            if first and data[0] not in _TLS_RECORDS:
                raise NotTlsError(data)
            first = False
            self._incoming.write(data)
        await self._flush()
        if self._tls.selected_alpn_protocol() != ALPN_JOIN:
            raise ssl.SSLError(f"the other side does not speak {ALPN_JOIN}")

    def certificate(self) -> bytes:
        """The other side's certificate (DER); empty if it has none."""
        return self._tls.getpeercert(binary_form=True) or b""

    async def receive(self) -> bytes:
        """The next bytes; empty at the end of the connection."""
        while True:
            try:
                return self._tls.read(_READ)
            except ssl.SSLWantReadError:
                pass
            except ssl.SSLError:
                return b""
            try:
                data = await self._receive()
            except OSError:
                return b""
            if not data:
                return b""
            self._incoming.write(data)

    async def send(self, data: bytes) -> None:
        """Send all of it.

        Raises:
            OSError: The connection is gone.
        """
        if data:
            self._tls.write(data)
            await self._flush()

    def close(self) -> None:
        """Close the socket."""
        self._sock.close()

    async def _receive(self) -> bytes:
        return await asyncio.get_running_loop().sock_recv(self._sock, _READ)

    async def _flush(self) -> None:
        if data := self._outgoing.read():
            await asyncio.get_running_loop().sock_sendall(self._sock, data)

    def _where(self) -> str:
        try:
            host, port = self._sock.getpeername()[:2]
        except OSError:
            return "its address"
        return f"{host}:{port}"
