"""HTTPS: the server's certificate, from the user's files or the module's own, and its renewal at run time."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import ssl
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from rmpa.core.errors import ConfigError, StartError
from rmpa.trust.store import CERTIFICATE, KEY
from rmpa.web import limits

if TYPE_CHECKING:
    from collections.abc import Sequence

    from rmpa.trust.store import TrustStore

_log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class CertificateFiles:
    """Where a server's certificate is.

    Args:
        cert: A PEM file: the certificate, and the intermediate ones behind it; empty for none: plain HTTP.
        key: A PEM file with the private key, not encrypted; empty: it is in ``cert``.
    """

    cert: str = ""
    key: str = ""


def certificate_files(cert: str, key: str, store: TrustStore | None) -> CertificateFiles:
    """The files of a server: those of the user, else the module's own if it is in a secured mesh, else none.

    Args:
        cert: As ``[web]`` names it.
        key: Likewise.
        store: The module's files of trust; ``None``: it is in no secured mesh.

    Raises:
        ConfigError: There is a key without a certificate.
        StartError: The module is in a secured mesh, and its files cannot be used: they are missing, broken, or of
            another user.
    """
    if cert:
        return CertificateFiles(cert, key)
    if key:
        raise ConfigError("web.key", "there is a key without a certificate", "name the certificate with --cert")
    if store is None:
        return CertificateFiles()
    try:
        store.load()
    except StartError as error:
        _log.warning("! rmpa web serves HTTPS in a secured mesh: run it as the agent's user, or name a --cert")
        raise error from None
    return CertificateFiles(str(store.path(CERTIFICATE)), str(store.path(KEY)))


def tls_context(cert: str, key: str) -> ssl.SSLContext | None:
    """The context of a server; ``None`` without a certificate.

    Args:
        cert: As in ``CertificateFiles``.
        key: Likewise.

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


class ServerCertificate:
    """The context of a server, into which a renewed certificate is loaded as soon as its files have changed.

    New connections get the new certificate; those that are open keep theirs. Files that do not belong together (one
    is written already, the other is not) are tried again.

    Args:
        files: The files; with none the server speaks HTTP, and nothing is watched.

    Raises:
        StartError: They cannot be used.
    """

    def __init__(self, files: CertificateFiles) -> None:
        self._files = files
        self._stamps = self._look()
        self.context = tls_context(files.cert, files.key)
        self._task: asyncio.Task[None] | None = None

    def start(self) -> None:
        """Begin to look at the files, in a task."""
        if self.context is not None:
            self._task = asyncio.get_running_loop().create_task(self._watch(), name="watch the certificate")

    async def close(self) -> None:
        """End."""
        if self._task is not None:
            self._task.cancel()
            with contextlib.suppress(asyncio.CancelledError):
                await self._task
            self._task = None

    def renew(self) -> bool:
        """Load the files if they have changed; return whether new connections get another certificate. It blocks."""
        stamps = self._look()
        if stamps == self._stamps or self.context is None:
            return False
        try:
            tls_context(self._files.cert, self._files.key)  # a context that fails half-way has the new one in part
            self.context.load_cert_chain(self._files.cert, self._files.key or None, password=_no_password)
        except (StartError, OSError, ValueError) as error:
            _log.warning("! the changed certificate is not used yet: %s", error)
            return False
        self._stamps = stamps
        _log.info("= HTTPS has the renewed certificate of %s", self._files.cert)
        return True

    async def _watch(self) -> None:
        while True:
            await asyncio.sleep(limits.CERTIFICATE_LOOK_PERIOD)
            await asyncio.to_thread(self.renew)

    def _look(self) -> Sequence[tuple[int, int] | None]:
        """What changes when the files do."""
        return [_stamp(Path(name)) for name in (self._files.cert, self._files.key) if name]


def _stamp(path: Path) -> tuple[int, int] | None:
    try:
        info = path.stat()
    except OSError:
        return None
    return info.st_ino, info.st_mtime_ns


def _no_password() -> str:
    """OpenSSL would ask for one at the terminal."""
    raise ValueError("the key is encrypted")
