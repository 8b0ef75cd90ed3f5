"""Members of secured meshes, with certificates of a CA made for the test."""

from __future__ import annotations

import asyncio
import socket
import ssl
import tempfile
import time
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path

from rmpa.runtime.loop import SystemClock
from rmpa.trust.certificates import sign
from rmpa.trust.membership import Membership
from rmpa.trust.permissions import Document
from rmpa.trust.store import CERTIFICATE, KEY, MemberFiles, TrustStore
from tests.mesh.io.meshes import Peer, introduce
from tests.trust.authority import Authority, new_key
from tests.trust.io.member_files import KEYS, pem_of

_FOLDERS = tempfile.TemporaryDirectory(prefix="rmpa-test-")
"""Removed when the process ends: the garbage collector may run in an event loop, which may not block."""


class _Store(TrustStore):
    """Two files for OpenSSL; nothing else is read or written, as tests of this room may not block."""

    is_authority = False

    def write(self, name: str, data: bytes) -> None:
        """Keep nothing."""


class Member(Membership):
    """A membership with files of its own.

    Args:
        ca: Whose certificate it has, and whose it accepts.
        name: The module.
        issued: When its certificate was issued, seconds before now.
    """

    def __init__(self, ca: Authority, name: str, issued: float = 0.0) -> None:
        folder = tempfile.mkdtemp(dir=_FOLDERS.name)
        self._ca = ca
        key = new_key()
        certificate = ca.module(name, time.time() - issued, key)
        store = _Store(Path(folder), name)
        files = MemberFiles(pem_of(key), certificate, ca.certificate, sign(KEYS, ca.key))
        store.folder.mkdir(parents=True)
        store.path(CERTIFICATE).write_text(ssl.DER_cert_to_PEM_cert(certificate))
        store.path(KEY).write_bytes(files.key)
        super().__init__(store, files, SystemClock())

    def revoke(self, name: str) -> None:
        """Let a newer deny list hold here."""
        deny = sign(self.deny.with_name(name, time.time()), self._ca.key)
        assert self.accept_document(Document.DENY, deny)


@asynccontextmanager
async def meshes(
    *securities: Member | None, names: tuple[str, ...] = (), found: bool = True
) -> AsyncIterator[list[Peer]]:
    """Peers in the order of their GUIDs, each with its security; the lower one of two dials first."""
    made: list[Peer] = []
    try:
        ports = _ascending_ports(len(securities))
        for number, (security, port) in enumerate(zip(securities, ports, strict=True)):
            name = names[number] if names else security.name if security is not None else None
            made.append(Peer(number, port=port, name=name, security=security))
        for peer in made:
            await peer.mesh.start()
        if found:
            introduce(made)
        yield made
    finally:
        for peer in made:
            for sock in peer.hand_made:
                sock.close()
        await asyncio.gather(*(peer.mesh.close() for peer in made))


def _ascending_ports(count: int) -> list[int]:
    """Free ports, so that the order of the peers is that of their GUIDs."""
    socks = [socket.create_server(("127.0.0.1", 0)) for _ in range(count)]
    ports = sorted(sock.getsockname()[1] for sock in socks)
    for sock in socks:
        sock.close()
    return ports
