"""The messages of joins and renewals: one question and one answer, inside TLS with the ALPN ``rmpa-join/1``.

::

    module                                            authority
    join {token, request, proof} ───────────────────► the token is used, and the certificate issued
    renew {request} ────────────────────────────────► the certificate of the connection may be renewed
                ◄── grant {certificate, ca, keys, deny}, or refuse {reason, text}

The proof is made with the token's key over the request and the server's certificate (``proof_of``): only a holder of
the token's secret can have made it, and only for this TLS connection. The joining module has no certificate, and
takes no answer whose CA does not have the token's fingerprint, or has not issued the server's certificate.

A message is a JSON object with its length in front (4 bytes, big-endian); bytes in it are base64.
"""

from __future__ import annotations

import hashlib
import hmac
import struct
from typing import Final

import msgspec

from rmpa.core.errors import LimitExceeded, RemoteProtocolError

LENGTH: Final = struct.Struct(">I")
_PROOF: Final = b"rmpa join 2"


class Join(msgspec.Struct, frozen=True, tag="join", tag_field="op"):
    """Asks for the first certificate of a module.

    Args:
        token: The token's id.
        request: PKCS #10 (DER) with the module's name.
        proof: As ``proof_of``.
    """

    token: bytes
    request: bytes
    proof: bytes


class Renew(msgspec.Struct, frozen=True, tag="renew", tag_field="op"):
    """Asks for a certificate in place of that of the connection, which may have ended.

    Args:
        request: PKCS #10 (DER) with the module's name.
    """

    request: bytes


class CertificateGrant(msgspec.Struct, frozen=True, tag="grant", tag_field="op"):
    """A certificate, and what else a member has; the answer of a join by files is one too. It is secret.

    Args:
        certificate: The module's (DER).
        ca: The CA's (DER).
        keys: The signed list of group keys.
        deny: The signed deny list; empty if nothing was revoked.
    """

    certificate: bytes
    ca: bytes
    keys: bytes
    deny: bytes = b""

    def __repr__(self) -> str:
        """Without the keys."""
        return f"CertificateGrant({len(self.certificate)} bytes of a certificate)"


class JoinRefused(msgspec.Struct, frozen=True, tag="refuse", tag_field="op"):
    """There is no certificate.

    Args:
        reason: One word: of ``TokenProblem`` or ``TrustReason``, ``taken`` (a member has the name), or of a later
            release.
        text: What is wrong.
    """

    reason: str
    text: str


JoinMessage = Join | Renew | CertificateGrant | JoinRefused
_decoder: Final = msgspec.json.Decoder(JoinMessage)


def encode_message(message: JoinMessage) -> bytes:
    """The bytes of a message, with its length in front."""
    data = msgspec.json.encode(message)
    return LENGTH.pack(len(data)) + data


def message_length(head: bytes, most: int) -> int:
    """The length of a message by its first 4 bytes.

    Raises:
        LimitExceeded: It is longer than ``most`` bytes.
    """
    (length,) = LENGTH.unpack_from(head)
    if length > most:
        raise LimitExceeded("a message of a join", length, most)
    return int(length)


def decode_message(data: bytes) -> JoinMessage:
    """The message behind its length.

    Raises:
        RemoteProtocolError: It is malformed.
    """
    try:
        message: JoinMessage = _decoder.decode(data)
    except (msgspec.MsgspecError, UnicodeError, RecursionError) as error:
        raise RemoteProtocolError(f"not a message of a join: {error!s:.200}") from None
    return message


def proof_of(key: bytes, request: bytes, server: bytes) -> bytes:
    """The proof that the holder of a token makes this request in this TLS connection.

    Args:
        key: The token's.
        request: The request for a certificate (DER).
        server: The server's certificate of the TLS connection (DER).
    """
    hashes = hashlib.sha256(request).digest() + hashlib.sha256(server).digest()
    return hmac.digest(key, _PROOF + hashes, hashlib.sha256)
