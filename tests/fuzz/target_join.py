"""Fuzz target: the messages of joins and renewals."""

from __future__ import annotations

from rmpa.core.errors import RemoteProtocolError
from rmpa.trust.tokens import CertificateGrant, Join, JoinRefused, Renew, decode_message, encode_message

SEEDS: list[bytes] = [
    b"",
    b"{}",
    b'{"op":"renew","x":' + b"[" * 2000,
    *(
        encode_message(each)[4:]
        for each in (
            Join(b"token", b"request", b"proof"),
            Renew(b"request"),
            CertificateGrant(b"certificate", b"ca", b"keys", b"deny"),
            JoinRefused("revoked", "it was revoked"),
        )
    ),
]


def fuzz(data: bytes) -> None:
    """A message that survives its round trip, or a documented error."""
    try:
        message = decode_message(data)
    except RemoteProtocolError as error:
        str(error)
        return
    if decode_message(encode_message(message)[4:]) != message:
        raise AssertionError(f"{message!r} does not survive its round trip")
