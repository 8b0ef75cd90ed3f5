"""The messages of a renewal with a certificate that has ended, inside TLS with both certificates.

One message each way, with its length in front as in a join (``trust.join``)::

    module                                            authority
    renew {request} ────────────────────────────────► the certificate of the connection may be renewed
                ◄── grant {certificate, keys, deny}, or refuse {reason, text}
"""

from __future__ import annotations

import struct
from typing import Final

import msgspec

from rmpa.core.errors import LimitExceeded, RemoteProtocolError
from rmpa.trust import limits

_LENGTH: Final = struct.Struct(">I")


class Renew(msgspec.Struct, frozen=True, tag="renew", tag_field="op"):
    """Asks for a certificate.

    Args:
        request: PKCS #10 (DER) with the module's name.
    """

    request: bytes


class RenewalGrant(msgspec.Struct, frozen=True, tag="grant", tag_field="op"):
    """The new certificate, and what is new since the module was away.

    Args:
        certificate: DER.
        keys: The signed list of group keys.
        deny: The signed deny list; empty if nothing was revoked.
    """

    certificate: bytes
    keys: bytes
    deny: bytes = b""

    def __repr__(self) -> str:
        """Without the keys."""
        return f"RenewalGrant({len(self.certificate)} bytes of a certificate)"


class RenewalRefused(msgspec.Struct, frozen=True, tag="refuse", tag_field="op"):
    """There is no new certificate.

    Args:
        reason: One word.
        text: What is wrong.
    """

    reason: str
    text: str


RenewalMessage = Renew | RenewalGrant | RenewalRefused
_decoder: Final = msgspec.json.Decoder(RenewalMessage)


def encode_renewal(message: RenewalMessage) -> bytes:
    """The bytes of a message."""
    data = msgspec.json.encode(message)
    return _LENGTH.pack(len(data)) + data


def decode_renewal(data: bytes | bytearray) -> RenewalMessage | None:
    """The message at the start of ``data``; ``None``: it is not whole yet.

    Raises:
        LimitExceeded: It is too long.
        RemoteProtocolError: It is malformed.
    """
    if len(data) < _LENGTH.size:
        return None
    (length,) = _LENGTH.unpack_from(data)
    if length > limits.JOIN_ANSWER_MAX:
        raise LimitExceeded("a message of a renewal", length, limits.JOIN_ANSWER_MAX)
    if len(data) < _LENGTH.size + length:
        return None
    try:
        message: RenewalMessage = _decoder.decode(bytes(data[_LENGTH.size : _LENGTH.size + length]))
    except (msgspec.MsgspecError, UnicodeError, RecursionError) as error:
        raise RemoteProtocolError(f"not a message of a renewal: {error!s:.200}") from None
    return message
