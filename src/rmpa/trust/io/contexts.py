"""The ``ssl.SSLContext`` of members, and of modules that join: TLS 1.3 alone, no resumption."""

from __future__ import annotations

import ssl
from typing import TYPE_CHECKING, Final

from rmpa.core.errors import StartError

if TYPE_CHECKING:
    from pathlib import Path

ALPN_LINK: Final = "rmpa/1"
"""Protocol of a link inside TLS (RFC 7301)."""
ALPN_JOIN: Final = "rmpa-join/1"
"""Protocol of a join, and of a renewal with a certificate that has ended."""
_NO_CHECK_TIME: Final = 0x200000
"""X509_V_FLAG_NO_CHECK_TIME of OpenSSL, which Python has no name for."""


def member_context(certificate: Path, key: Path, ca: bytes, *alpn: str, server_side: bool) -> ssl.SSLContext:
    """The context of a member.

    The chain of the other side is verified; its name, times and revocation are judged behind the handshake, where
    the reason can be told.

    Args:
        certificate: The file of this module's certificate (PEM).
        key: The file of its key (PEM).
        ca: The CA's certificate (DER), the only one that is trusted.
        alpn: The protocols.
        server_side: Whether it is for accepted connections. A module that joins has no certificate yet.

    Raises:
        StartError: The key is not the certificate's, or a file cannot be used.
    """
    context = _context(server_side=server_side)
    context.verify_mode = ssl.CERT_OPTIONAL if server_side else ssl.CERT_REQUIRED
    context.verify_flags = ssl.VerifyFlags(context.verify_flags | _NO_CHECK_TIME)
    context.set_alpn_protocols(list(alpn))
    try:
        context.load_cert_chain(certificate, key)
        context.load_verify_locations(cadata=ca)
    except (ssl.SSLError, OSError) as error:
        remedy = "join again: rmpa trust invite at the authority, rmpa trust join TOKEN here"
        raise StartError(str(certificate), f"does not fit {key.name}, or is broken: {error!s:.100}", remedy) from None
    return context


def join_context() -> ssl.SSLContext:
    """For a module that joins: the token's fingerprint decides on the server."""
    context = _context(server_side=False)
    context.verify_mode = ssl.CERT_NONE
    context.set_alpn_protocols([ALPN_JOIN])
    return context


def _context(*, server_side: bool) -> ssl.SSLContext:
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER if server_side else ssl.PROTOCOL_TLS_CLIENT)
    context.minimum_version = context.maximum_version = ssl.TLSVersion.TLSv1_3
    context.check_hostname = False  # the module's name is its identity, and is compared with the hello's
    if server_side:
        context.num_tickets = 0  # a resumed session would outlive a revocation
    return context
