"""HTTPS: the server's certificate, from the user's files."""

from __future__ import annotations

import ssl

from rmpa.core.errors import ConfigError, StartError


def tls_context(cert: str, key: str) -> ssl.SSLContext | None:
    """The context of a server; ``None`` without a certificate.

    Args:
        cert: A PEM file: the certificate, and the intermediate ones behind it.
        key: A PEM file with the private key, not encrypted; empty: it is in ``cert``.

    Raises:
        ConfigError: There is a key without a certificate.
        StartError: The files cannot be read, or do not belong together.
    """
    if not cert:
        if key:
            raise ConfigError("web.key", "there is a key without a certificate", "name the certificate with --cert")
        return None
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    context.minimum_version = ssl.TLSVersion.TLSv1_2
    try:
        context.load_cert_chain(cert, key or None, password=_no_password)
    except FileNotFoundError as error:
        raise StartError(error.filename or cert, "there is no such file", "see cert and key of [web]") from None
    except (OSError, ValueError) as error:  # an SSLError is an OSError
        text = getattr(error, "reason", None) or getattr(error, "strerror", None) or str(error)
        remedy = "the certificate and its unencrypted private key are wanted, as PEM"
        raise StartError(cert, f"cannot be used with its key: {text}", remedy) from None
    return context


def _no_password() -> str:
    """OpenSSL would ask for one at the terminal."""
    raise ValueError("the key is encrypted")
