"""TLS between two ends of a test: contexts, finished handshakes, and a socket that takes little."""

from __future__ import annotations

import socket
import ssl
import tempfile
from datetime import UTC, datetime
from functools import cache
from typing import cast

from cryptography.hazmat.primitives import serialization

from rmpa.runtime.tls import Buffer, SecureSocket, TlsHandshake
from tests.trust.authority import Authority, new_key

# Of the client and of the server.
Contexts = tuple[ssl.SSLContext, ssl.SSLContext]
NOW = datetime.now(UTC).timestamp()


def make_context(ca: Authority, *, server_side: bool) -> ssl.SSLContext:
    key = new_key()
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER if server_side else ssl.PROTOCOL_TLS_CLIENT)
    context.minimum_version = ssl.TLSVersion.TLSv1_3
    context.check_hostname = False
    context.verify_mode = ssl.CERT_REQUIRED
    context.load_verify_locations(cadata=ca.certificate)
    if server_side:
        context.num_tickets = 0
    pem = key.private_bytes(
        serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption()
    )
    with tempfile.NamedTemporaryFile() as file:
        file.write(pem + ssl.DER_cert_to_PEM_cert(ca.module("arm", NOW, key)).encode())
        file.flush()
        context.load_cert_chain(file.name)
    return context


def shake(contexts: Contexts) -> tuple[TlsHandshake, TlsHandshake]:
    client, server = TlsHandshake(contexts[0], server_side=False), TlsHandshake(contexts[1], server_side=True)
    client.receive(b"")
    while not (client.done and server.done):
        server.receive(client.take_output())
        client.receive(server.take_output())
    return client, server


class Slow:
    """A socket that takes and gives only a few bytes a call."""

    def __init__(self, sock: socket.socket, most: int) -> None:
        self._sock, self._most = sock, most

    def send(self, data: Buffer, /) -> int:
        return self._sock.send(data[: self._most])

    def recv_into(self, buffer: memoryview, /) -> int:
        return self._sock.recv_into(buffer[: self._most])

    def shutdown(self, how: int, /) -> None:
        self._sock.shutdown(how)

    def close(self) -> None:
        self._sock.close()


@cache
def make_contexts() -> Contexts:
    lab = Authority()
    return make_context(lab, server_side=False), make_context(lab, server_side=True)


class SecurePairs:
    """Two connected sockets, and TLS on them."""

    def __init__(self, sockets: tuple[socket.socket, socket.socket]) -> None:
        self.contexts, self.sockets = make_contexts(), sockets
        for sock in sockets:
            sock.setblocking(False)

    def secured(self, most: int = 1 << 30, there: int = 1 << 30) -> tuple[SecureSocket, SecureSocket]:
        """Both ends, which take and give so many bytes a call."""
        client, server = shake(self.contexts)
        one, other = (Slow(sock, few) for sock, few in zip(self.sockets, (most, there), strict=True))
        return client.secure(cast("socket.socket", one)), server.secure(cast("socket.socket", other))
