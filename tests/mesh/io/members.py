"""Members of secured meshes, with certificates of a CA made for the test."""

from __future__ import annotations

import asyncio
import os
import socket
import ssl
import tempfile
import time
from contextlib import asynccontextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

from cryptography.hazmat.primitives import serialization

from rmpa.trust import limits
from rmpa.trust.io.contexts import link_context
from rmpa.trust.keyring import GroupKey, KeyPurpose, KeyRing
from rmpa.trust.preface import Preface, PrefaceGuard, Purpose
from rmpa.trust.reasons import TrustError, TrustReason
from tests.mesh.io.meshes import Peer, introduce
from tests.trust.authority import Authority, new_key

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Callable, Mapping
    from typing import Any

GROUP_KEY = GroupKey(1, b"k" * limits.GROUP_KEY_BYTES)


@dataclass
class Member:
    """A ``MeshSecurity``.

    Args:
        ca: Whose certificate it has, and whose it accepts.
        name: The module.
        issued: When its certificate was issued, seconds before now.
        group_key: Of its mesh.
        ahead: Seconds that its clock is ahead.
    """

    ca: Authority
    name: str
    issued: float = 0.0
    group_key: GroupKey = GROUP_KEY
    ahead: float = 0.0
    denied: set[str] = field(default_factory=set)
    on_denied: list[Callable[[], None]] = field(default_factory=list)

    def __post_init__(self) -> None:
        self._ring = KeyRing([self.group_key], 0.0)
        self.guard = PrefaceGuard(self._ring)
        key = new_key()
        pem = key.private_bytes(
            serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption()
        )
        certificate = ssl.DER_cert_to_PEM_cert(self.ca.module(self.name, time.time() - self.issued, key)).encode()
        with tempfile.TemporaryDirectory() as folder:
            paths = Path(folder, "crt"), Path(folder, "key")
            for path, data in zip(paths, (certificate, pem), strict=True):
                path.write_bytes(data)
            self.server_context = link_context(*paths, self.ca.certificate, server_side=True)
            self.client_context = link_context(*paths, self.ca.certificate, server_side=False)

    def wall(self) -> float | None:
        return time.time() + self.ahead

    def preface(self, purpose: Purpose) -> bytes:
        preface = Preface(purpose, self.group_key.short, int((time.time() + self.ahead) * 1000), os.urandom(16))
        return preface.serialize(self.group_key.key_for(KeyPurpose.PREFACE))

    def judge_member(self, certificate: Mapping[str, Any] | bytes, claimed: str | None) -> None:
        assert not isinstance(certificate, bytes)
        (name,) = [value.removeprefix("urn:rmpa:") for kind, value in certificate["subjectAltName"] if kind == "URI"]
        if claimed is not None and claimed != name:
            raise TrustError(TrustReason.NAME, f"the certificate is of {name}, not of {claimed}")
        if name in self.denied:
            raise TrustError(TrustReason.REVOKED, f"{name} was revoked")

    def deny(self, *names: str) -> None:
        self.denied.update(names)
        for call in self.on_denied:
            call()


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
