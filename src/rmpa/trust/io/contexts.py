"""The two ``ssl.SSLContext`` of a member: for connections that it accepts, and for those that it dials."""

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


def link_context(
    certificate: Path, key: Path, ca: bytes, *, server_side: bool, check_times: bool = True
) -> ssl.SSLContext:
    """A context for links: TLS 1.3 alone, both certificates required, no resumption.

    Args:
        certificate: The file of this module's certificate (PEM).
        key: The file of its key (PEM).
        ca: The CA's certificate (DER), the only one that is trusted.
        server_side: Whether it is for accepted connections.
        check_times: ``False`` while this machine's clock is not set: times of certificates cannot be judged.

    Raises:
        StartError: The key is not the certificate's, or a file cannot be used.
    """
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER if server_side else ssl.PROTOCOL_TLS_CLIENT)
    context.minimum_version = context.maximum_version = ssl.TLSVersion.TLSv1_3
    context.check_hostname = False  # the module's name is its identity, and is compared with the hello's
    context.verify_mode = ssl.CERT_REQUIRED
    if server_side:
        context.num_tickets = 0  # a resumed session would outlive a revocation
    if not check_times:
        context.verify_flags = ssl.VerifyFlags(context.verify_flags | _NO_CHECK_TIME)
    context.set_alpn_protocols([ALPN_LINK])
    try:
        context.load_cert_chain(certificate, key)
        context.load_verify_locations(cadata=ca)
    except (ssl.SSLError, OSError) as error:
        remedy = "join again: rmpa trust invite at the authority, rmpa trust join TOKEN here"
        raise StartError(str(certificate), f"does not fit {key.name}, or is broken: {error!s:.100}", remedy) from None
    return context
