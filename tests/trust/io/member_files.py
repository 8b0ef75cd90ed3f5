"""Whole sets of files of members of one mesh, and a clock that is set by hand."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from cryptography.hazmat.primitives import serialization

from rmpa.runtime.loop import SystemClock
from rmpa.trust.certificates import DenyList, KeyList, sign
from rmpa.trust.membership import Membership
from rmpa.trust.packets import GroupKey
from rmpa.trust.store import MemberFiles, TrustStore
from tests.trust.authority import WALL, Authority, new_key

if TYPE_CHECKING:
    from pathlib import Path

    from cryptography.hazmat.primitives.asymmetric import ec

KEYS = KeyList(1, (GroupKey(1, b"k" * 32),))


@dataclass
class HandClock(SystemClock):
    """Monotonic seconds and wall clock, both set by a test."""

    seconds: float = 100.0
    wall_seconds: float = WALL

    def now(self) -> float:
        return self.seconds

    def wall_ns(self) -> int:
        return int(self.wall_seconds * 1e9)


def pem_of(key: ec.EllipticCurvePrivateKey) -> bytes:
    return key.private_bytes(
        serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption()
    )


@dataclass
class SecuredMesh:
    """Makes members of one mesh.

    Args:
        folder: Their state directory.
    """

    folder: Path
    authority: Authority = field(default_factory=Authority)
    clock: HandClock = field(default_factory=HandClock)
    keys: KeyList = KEYS
    deny: DenyList = field(default_factory=DenyList)

    def save(self, name: str, wall: float = WALL) -> TrustStore:
        key = new_key()
        deny = sign(self.deny, self.authority.key) if self.deny.number else b""
        certificate = self.authority.module(name, wall, key)
        files = MemberFiles(
            pem_of(key), certificate, self.authority.certificate, sign(self.keys, self.authority.key), deny
        )
        store = TrustStore(self.folder, name)
        store.save(files)
        return store

    def member(self, name: str, wall: float = WALL) -> Membership:
        return Membership.load(self.save(name, wall), self.clock)
