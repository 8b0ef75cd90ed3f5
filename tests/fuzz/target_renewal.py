"""Fuzz target: the messages of a renewal, and the requests in files of a join by files."""

from __future__ import annotations

from rmpa.core.errors import RemoteProtocolError
from rmpa.trust.renewal import Renew, RenewalGrant, RenewalRefused, decode_renewal, encode_renewal

SEEDS: list[bytes] = [
    b"",
    b"\x00\x00\x00\x02{}",
    b"\xff\xff\xff\xff",
    b"\x00\x00\x07\xd0" + b'{"op":"renew","x":' + b"[" * 2000,
    encode_renewal(Renew(b"request")),
    encode_renewal(RenewalGrant(b"certificate", b"keys", b"deny")),
    encode_renewal(RenewalRefused("revoked", "it was revoked")),
]


def fuzz(data: bytes) -> None:
    """A message that survives its round trip, the wish for more bytes, or a documented error."""
    try:
        message = decode_renewal(data)
    except RemoteProtocolError as error:
        str(error)
        return
    if message is not None and decode_renewal(encode_renewal(message)) != message:
        raise AssertionError(f"{message!r} does not survive its round trip")
