"""A secured mesh for measurements: a CA, and the files of each member, as joining leaves them."""

from __future__ import annotations

import os
import time
from typing import TYPE_CHECKING, Final

from cryptography.hazmat.primitives import serialization
from cryptography.hazmat.primitives.asymmetric import ec

from rmpa.trust import limits
from rmpa.trust.certificates import CURVE, KeyList, issue, make_ca, make_request, read_request, sign
from rmpa.trust.packets import GroupKey
from rmpa.trust.store import MemberFiles, TrustStore

if TYPE_CHECKING:
    from pathlib import Path

ALLOWED: Final = '[trust]\ndefault = "allow"\n'
"""Configuration of a member: every member may do everything."""


class MeasuredMesh:
    """The CA of one secured mesh."""

    def __init__(self) -> None:
        self._key = ec.generate_private_key(CURVE)
        self._ca = make_ca(self._key, "lab", _serial(), time.time())
        self._keys = sign(KeyList(1, (GroupKey(1, os.urandom(limits.GROUP_KEY_BYTES)),)), self._key)

    def admit(self, home: Path, host: str, name: str) -> TrustStore:
        """Write the files of a module, where an agent on this host of a bed looks for them."""
        key = ec.generate_private_key(CURVE)
        certificate = issue(read_request(make_request(key, name)), self._ca, self._key, _serial(), time.time())
        pem = key.private_bytes(
            serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption()
        )
        store = TrustStore(home / "state" / host, name)
        store.save(MemberFiles(pem, certificate, self._ca, self._keys))
        return store


def _serial() -> int:
    return int.from_bytes(os.urandom(16), "big")
