"""Private keys of modules and of the CA, as PEM."""

from __future__ import annotations

from cryptography.hazmat.primitives import serialization
from cryptography.hazmat.primitives.asymmetric import ec

from rmpa.core.errors import StartError
from rmpa.trust.certificates import CURVE


def new_key() -> bytes:
    """A private key (PKCS #8, PEM) for a module or a CA."""
    return _key_pem(ec.generate_private_key(CURVE))


def private_key(data: bytes, where: str) -> ec.EllipticCurvePrivateKey:
    """Read a private key (PEM).

    Args:
        data: The PEM.
        where: The file, for the error.

    Raises:
        StartError: It is none.
    """
    try:
        key = serialization.load_pem_private_key(data, None)
    except (ValueError, TypeError):
        key = None
    if not isinstance(key, ec.EllipticCurvePrivateKey):
        raise StartError(where, "is broken: not a private key in PEM", "join again, or take it from a copy")
    return key


def _key_pem(key: ec.EllipticCurvePrivateKey) -> bytes:
    return key.private_bytes(
        serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption()
    )
