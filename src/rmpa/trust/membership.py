"""What a module has as a member of a secured mesh: certificate, keys, deny list.

What a module has as a member of a secured mesh: certificate, group keys, deny list, contexts of TLS.
"""

from __future__ import annotations

import contextlib
import logging
import ssl
from dataclasses import replace
from typing import TYPE_CHECKING, Any, Final

from cryptography.hazmat.primitives import serialization
from cryptography.hazmat.primitives.asymmetric import ec

from rmpa.core.errors import RemoteProtocolError, StartError
from rmpa.trust import certificates, limits
from rmpa.trust import store as files_of
from rmpa.trust.certificates import CURVE, DenyList, KeyList, ModuleCertificate, read_document
from rmpa.trust.packets import KeyRing, PacketTrust
from rmpa.trust.permissions import Document, TrustError, TrustReason
from rmpa.trust.store import ALPN_JOIN, ALPN_LINK, member_context

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Mapping

    from rmpa.runtime.loop import SystemClock
    from rmpa.trust.store import MemberFiles, TrustStore
    from rmpa.trust.tokens import CertificateGrant


# Private keys of modules and of the CA, as PEM.


def new_key() -> bytes:
    """A private key (PKCS #8, PEM) for a module or a CA."""
    return ec.generate_private_key(CURVE).private_bytes(
        serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption()
    )


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


_log = logging.getLogger(__name__)
_REMEDY: Final = "join again: rmpa trust invite at the authority, rmpa trust join TOKEN here"


class Membership:
    """This module's part in a secured mesh. Its parts are replaced at a renewal and by newer documents.

    The machine's clock counts as *set* while it shows a time after the beginning of the module's own certificate.
    While it is not, no times are checked: neither of packets nor of certificates.

    Args:
        store: The files, which newer documents are written to.
        files: What is in them.
        clock: Monotonic seconds.
        wall: Seconds since 1970, by the machine's clock, set or not.

    Raises:
        StartError: A file is broken, or they do not belong together.
    """

    def __init__(self, store: TrustStore, files: MemberFiles, clock: SystemClock, wall: Callable[[], float]) -> None:
        self.store = store
        self.files = files
        self._clock = clock
        self._machine_wall = wall
        with _named(store, files_of.CERTIFICATE):
            self._ca_key = certificates.ca_public_key(files.ca)
            self.certificate = certificates.verify(files.certificate, files.ca, None)
        with _named(store, files_of.KEYS):
            # The list of group keys that holds.
            self.keys = read_document(files.keys, self._ca_key, KeyList)
        with _named(store, files_of.DENY):
            # The deny list that holds.
            self.deny = read_document(files.deny, self._ca_key, DenyList) if files.deny else DenyList()
        proves_from, age = self.keys.proves_from, self._age(self.keys, limits.KEY_SPREAD)
        self.ring = KeyRing(self.keys.keys, clock.now(), proves_from=proves_from, age=age)
        self.packets = PacketTrust(self.ring, self.wall)
        # Called after a newer deny list holds: links that match end at once.
        self.on_denied: list[Callable[[], None]] = []
        # Writes one file of the store.
        self.save: Callable[[str, bytes], None] = store.write
        self._make_contexts()

    @classmethod
    def load(cls, store: TrustStore, clock: SystemClock, wall: Callable[[], float]) -> Membership:
        """Read the files of a member; arguments and errors as for the class."""
        return cls(store, store.load(), clock, wall)

    def __repr__(self) -> str:
        """Name and numbers alone: secrets never come into a log."""
        return f"Membership({self.name!r}, deny={self.deny.number}, keys={self.keys.number})"

    @property
    def name(self) -> str:
        """The module's name, as its certificate proves it."""
        return self.certificate.name

    def number(self, kind: Document) -> int:
        """The number of the document that holds."""
        return self.deny.number if kind is Document.DENY else self.keys.number

    def document(self, kind: Document) -> bytes:
        """A document that holds, signed; empty: there is none yet."""
        return self.files.deny if kind is Document.DENY else self.files.keys

    # --- clock ------------------------------------------------------------------------------------------------

    def wall(self) -> float | None:
        """Seconds since 1970; ``None`` while the machine's clock is not set."""
        wall = self._machine_wall()
        return wall if wall > self.certificate.issued - limits.CERTIFICATE_BACKDATE else None

    # --- connections ------------------------------------------------------------------------------------------

    def judge_member(self, certificate: Mapping[str, Any] | bytes, claimed: str | None) -> None:
        """Check the other end's certificate behind a TLS handshake, which has checked the chain.

        Args:
            certificate: As ``SSLObject.getpeercert()`` returns it, or in DER; its chain is then verified here.
            claimed: The name in its hello; ``None``: not known yet.

        Raises:
            TrustError: It is malformed (``foreign``), not valid yet (``clock``), ``expired``, of another module
                (``name``), or ``revoked``.
        """
        if isinstance(certificate, bytes | bytearray):
            certificates.verify(bytes(certificate), self.files.ca, self.wall(), name=claimed or "", deny=self.deny)
            return
        name, begin, expires = member_name(certificate), *_times(certificate)
        found = ModuleCertificate(name, 0, begin + limits.CERTIFICATE_BACKDATE, expires, b"")
        found.judge(self.wall(), claimed or "", self.deny)

    def request(self, hosts: Iterable[str] = ()) -> bytes:
        """A request (DER) for a newer certificate of this module and its key, with these hosts of its page."""
        key = private_key(self.files.key, str(self.store.path(files_of.KEY)))
        return certificates.make_request(key, self.name, hosts)

    # --- what is newer ----------------------------------------------------------------------------------------

    def accept_document(self, kind: Document, data: bytes) -> bool:
        """Take a signed document if it is newer than the one that holds; return whether it is.

        A new group key signs ``limits.KEY_SPREAD`` after it was made, or at once if a revocation made it. A document
        that cannot be written holds all the same, until the agent ends.

        Raises:
            LimitExceeded: It is too long.
            RemoteProtocolError: It is malformed, or not signed by this mesh's authority.
        """
        if kind is Document.DENY:
            deny = read_document(data, self._ca_key, DenyList)
            if deny.number <= self.deny.number:
                return False
            self.deny, self.files = deny, replace(self.files, deny=data)
            for call in tuple(self.on_denied):  # before a slow disk is written
                call()
        else:
            keys = read_document(data, self._ca_key, KeyList)
            if keys.number <= self.keys.number:
                return False
            self.keys, self.files = keys, replace(self.files, keys=data)
            self.ring.take(keys.keys, self._clock.now(), proves_from=keys.proves_from, age=self._age(keys, 0.0))
        try:
            self.save(files_of.DENY if kind is Document.DENY else files_of.KEYS, data)
        except StartError as error:
            _log.error("! %s", error)
        return True

    def take_grant(self, grant: CertificateGrant) -> None:
        """Take a newer certificate and the documents beside it; raises as ``renewed`` and ``accept_document``."""
        self.renewed(grant.certificate)
        for kind, data in ((Document.DENY, grant.deny), (Document.KEYS, grant.keys)):
            if data:
                self.accept_document(kind, data)

    def renewed(self, certificate: bytes) -> None:
        """Take a newer certificate (DER) of this module and its key: links that come up from now on have it.

        Raises:
            TrustError: It is of another CA, another module, another key, or not valid now.
            StartError: It cannot be written; the one before goes on.
        """
        found = certificates.verify(certificate, self.files.ca, self.wall(), name=self.name)
        if found.public_key != self.certificate.public_key:
            raise TrustError(TrustReason.FOREIGN, "the certificate is of another key")
        self.store.write(files_of.CERTIFICATE, ssl.DER_cert_to_PEM_cert(certificate).encode())
        self.certificate, self.files = found, replace(self.files, certificate=certificate)
        self._make_contexts()

    def _age(self, keys: KeyList, unknown: float) -> float:
        """Seconds since the newest group key was made; ``unknown`` where a clock is not set."""
        wall = self.wall()
        return unknown if wall is None or not keys.made else max(0.0, wall - keys.made)

    def _make_contexts(self) -> None:
        """Make the contexts for connections that are accepted, joins at the authority too, and for dialled ones."""
        files, ca = (self.store.path(files_of.CERTIFICATE), self.store.path(files_of.KEY)), self.files.ca
        joins = [ALPN_JOIN] if self.store.is_authority else []
        self.server_context = member_context(*files, ca, ALPN_LINK, *joins, server_side=True)
        self.client_context = member_context(*files, ca, ALPN_LINK, server_side=False)


def member_name(certificate: Mapping[str, Any]) -> str:
    """The module that a certificate is of.

    Args:
        certificate: As ``SSLObject.getpeercert()`` returns it.

    Raises:
        TrustError: It is not one of a module.
    """
    if not certificate:
        raise TrustError(TrustReason.FOREIGN, "it has no certificate")
    uris = [value for kind, value in certificate.get("subjectAltName", ()) if kind == "URI"]
    if len(uris) != 1 or not uris[0].startswith(certificates.URN):
        raise TrustError(TrustReason.FOREIGN, "the certificate is not one of a module")
    return str(uris[0].removeprefix(certificates.URN))


def _times(certificate: Mapping[str, Any]) -> tuple[float, float]:
    """Begin and end of a certificate, seconds since 1970."""
    try:
        begin, end = (ssl.cert_time_to_seconds(certificate[key]) for key in ("notBefore", "notAfter"))
    except (KeyError, ValueError):
        raise TrustError(TrustReason.FOREIGN, "the certificate has no validity") from None
    return float(begin), float(end)


@contextlib.contextmanager
def _named(store: TrustStore, name: str) -> Iterator[None]:
    """Turns an error about what is in a file into one that names the file."""
    try:
        yield
    except RemoteProtocolError as error:
        raise StartError(str(store.path(name)), f"is broken: {error}", _REMEDY) from None
