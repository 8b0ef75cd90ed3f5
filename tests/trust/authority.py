"""A CA and its modules, for the tests of certificates and documents."""

from __future__ import annotations

from dataclasses import dataclass, field
from itertools import count
from typing import TYPE_CHECKING

from cryptography.hazmat.primitives.asymmetric import ec

from rmpa.trust.certificates import CURVE, issue, make_ca, make_request, read_request

if TYPE_CHECKING:
    from collections.abc import Iterator

WALL = 1_790_000_000.0


def new_key() -> ec.EllipticCurvePrivateKey:
    return ec.generate_private_key(CURVE)


@dataclass
class Authority:
    """One mesh's CA."""

    key: ec.EllipticCurvePrivateKey = field(default_factory=new_key)
    certificate: bytes = b""
    _serials: Iterator[int] = field(default_factory=lambda: count(1000))

    def __post_init__(self) -> None:
        self.certificate = make_ca(self.key, "lab", 999, WALL)

    def module(self, name: str, wall: float = WALL, key: ec.EllipticCurvePrivateKey | None = None) -> bytes:
        """A certificate of a module, issued at ``wall``."""
        request = read_request(make_request(key or new_key(), name))
        return issue(request, self.certificate, self.key, next(self._serials), wall)
