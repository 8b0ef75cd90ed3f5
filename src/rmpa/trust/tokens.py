"""Tokens that invite, and what a join asks and gets.

One-time tokens: an invitation to join a mesh, as a text that a user carries from one machine to the other.

The text is ``rmpa1-`` and 85 characters of base32 (RFC 4648, lower case, no padding) of 53 bytes::

     0 format       1 byte    1
     1 expires      4 bytes   seconds since 1970
     5 address      4 bytes   of the authority, IPv4
     9 port         2 bytes   its mesh port
    11 fingerprint 16 bytes   of the CA's certificate: the first half of the SHA-256 of its DER
    27 secret      16 bytes   random
    43 checksum    10 bytes   the begin of the SHA-256 of all before it

The authority keeps the id and the key of a token, and not its text. Spaces, line ends and upper case in a text that
was typed or copied do not matter.
"""

from __future__ import annotations

import base64
import binascii
import hashlib
import hmac
import re
import struct
from dataclasses import dataclass, field
from ipaddress import IPv4Address
from typing import Final

import msgspec

from rmpa.core.errors import LimitExceeded, RemoteProtocolError, RmpaError
from rmpa.core.identity import dialable
from rmpa.core.limits import UINT32_MAX
from rmpa.trust import limits

PREFIX: Final = "rmpa1-"
FORMAT: Final = 1
_BODY: Final = struct.Struct(">BI4sH16s16s")
_CHECKSUM: Final = 10
_CHARACTERS: Final = 85
_ID: Final = 8
_TEXT: Final = re.compile(r"[a-z2-7]+")
_REMEDY: Final = "copy it whole from the output of rmpa trust invite"


# Why a token is not taken: the word for the wire, ``--json`` and counters, and what is wrong with the token.
TOKEN_PROBLEMS: Final = {
    "token": "is unknown here",  # or was withdrawn
    "used": "was used",
    "late": "has ended",
    "name": "is for another module",
}


@dataclass(eq=False)
class TokenError(RmpaError):
    """A text that is not a token.

    Args:
        problem: What is wrong with it; never has a part of the text, which may be a secret.
        remedy: What to do.
    """

    problem: str
    remedy: str = _REMEDY
    code = "token-refused"

    def __str__(self) -> str:
        """``the token …; …``."""
        return f"the token {self.problem}; {self.remedy}"


@dataclass(frozen=True, slots=True)
class Token:
    """One invitation.

    Args:
        expires: Seconds since 1970; 32 bits.
        address: Where the authority is reached.
        port: Its mesh port.
        fingerprint: Of the CA, ``limits.FINGERPRINT_BYTES``; see ``fingerprint_of``.
        secret: ``limits.TOKEN_SECRET_BYTES`` random bytes; not in ``repr``.

    Raises:
        ValueError: A part is out of its range.
    """

    expires: int
    address: IPv4Address
    port: int
    fingerprint: bytes
    secret: bytes = field(repr=False)

    def __post_init__(self) -> None:
        if not 0 <= self.expires <= UINT32_MAX:
            raise ValueError("the end of a token has 32 bits")
        if not 0 <= self.port < 1 << 16 or not dialable(self.address, self.port):
            raise ValueError(f"no authority can be reached at {self.address}:{self.port}")
        if len(self.fingerprint) != limits.FINGERPRINT_BYTES or len(self.secret) != limits.TOKEN_SECRET_BYTES:
            raise ValueError("the fingerprint or the secret has a wrong length")

    @classmethod
    def parse(cls, text: str) -> Token:
        """Read a token as a user gives it.

        Raises:
            TokenError: It is not one; the text says whether it is cut off, mistyped or of a later release.
        """
        if len(text) > limits.TOKEN_TEXT_MAX:
            raise TokenError(f"has {len(text)} characters, a token has {len(PREFIX) + _CHARACTERS}")
        packed = "".join(text.split()).lower()
        if not packed.startswith(PREFIX):
            if re.match(r"rmpa[0-9]+-", packed):
                raise TokenError("is of another release", "install the same release of rmpa on both machines")
            raise TokenError(f"does not begin with {PREFIX}")
        body = packed[len(PREFIX) :]
        if len(body) != _CHARACTERS:
            raise TokenError(f"has {len(body)} characters behind {PREFIX}, not {_CHARACTERS}: it is not whole")
        if not _TEXT.fullmatch(body):
            raise TokenError("has characters that no token has")
        try:
            data = base64.b32decode(body.upper() + "=" * (-len(body) % 8))
        except binascii.Error:
            raise TokenError("is mistyped") from None
        # The last character has one bit that belongs to no byte: a token has one text.
        if _checksum(data[: _BODY.size]) != data[_BODY.size :] or _base32(data) != body:
            raise TokenError("is mistyped")
        form, expires, address, port, fingerprint, secret = _BODY.unpack_from(data)
        if form != FORMAT:
            raise TokenError("is of another release", "install the same release of rmpa on both machines")
        try:
            return cls(expires, IPv4Address(address), port, fingerprint, secret)
        except ValueError as error:
            raise TokenError(f"cannot be used: {error}") from None

    def serialize(self) -> str:
        """The text that ``parse`` reads."""
        body = _BODY.pack(FORMAT, self.expires, self.address.packed, self.port, self.fingerprint, self.secret)
        return PREFIX + _base32(body + _checksum(body))

    @property
    def token_id(self) -> bytes:
        """The id of 8 bytes by which the authority knows it."""
        return hashlib.sha256(b"rmpa token id 1" + self.secret).digest()[:_ID]

    @property
    def key(self) -> bytes:
        """The key that proves a join (``trust.tokens.proof_of``)."""
        return hmac.digest(self.secret, b"rmpa token key 1", hashlib.sha256)

    def __str__(self) -> str:
        """``token 1f0a… of 10.0.0.1:40001``: fit for a log."""
        return f"token {self.token_id.hex()[:8]} of {self.address}:{self.port}"


def fingerprint_of(certificate: bytes) -> bytes:
    """The fingerprint of a certificate (DER) as tokens have it."""
    return hashlib.sha256(certificate).digest()[: limits.FINGERPRINT_BYTES]


def _base32(data: bytes) -> str:
    return base64.b32encode(data).decode().rstrip("=").lower()


def _checksum(body: bytes) -> bytes:
    return hashlib.sha256(body).digest()[:_CHECKSUM]


class Invitation(msgspec.Struct):
    """One token as the authority keeps it.

    Attributes:
        token_id: Its id.
        key: Its key; empty once it is used. Not in ``repr``.
        expires: Seconds since 1970.
        name: The module that it is for; empty for any.
        used_by: The module that joined with it.
    """

    token_id: bytes
    key: bytes
    expires: int
    name: str = ""
    used_by: str = ""

    def problem(self, name: str, wall: float) -> str:
        """Why a module may not join with it, a word of ``TOKEN_PROBLEMS``; empty: it may.

        Args:
            name: The module's.
            wall: Seconds since 1970.
        """
        if self.used_by:
            return "used"
        if wall >= self.expires:
            return "late"
        return "name" if self.name not in ("", name) else ""

    def __repr__(self) -> str:
        """Without the key."""
        return f"Invitation({self.token_id.hex()})"


# The messages of joins and renewals. One question and one answer, inside TLS with the ALPN ``rmpa-join/1``.
#
# ::
#
#     module                                            authority
#     join {token, request, proof} ───────────────────► the token is used, and the certificate issued
#     renew {request} ────────────────────────────────► the certificate of the connection may be renewed
#                 ◄── grant {certificate, ca, keys, deny}, or refuse {reason, text}
#
# The proof is made with the token's key over the request and the server's certificate (``proof_of``): only a holder
# of the token's secret can have made it, and only for this TLS connection. The joining module has no certificate, and
# takes no answer whose CA does not have the token's fingerprint, or has not issued the server's certificate.
#
# A message is a JSON object with its length in front (4 bytes, big-endian); bytes in it are base64.


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
        reason: One word: of ``TOKEN_PROBLEMS`` or ``TrustReason``, ``taken`` (a member has the name), or of a later
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
