"""Certificates: the CA of a mesh, requests, and certificates that prove a module's name (RFC 5280).

Keys are P-256. A module's certificate has its name as CN and as SAN ``urn:rmpa:<name>``; the SAN decides. This module
needs the library ``cryptography`` (extra ``rmpa[trust]``); links do without it, as OpenSSL checks the chain there.
For browsers, which ``rmpa web`` serves with it, it has names and addresses of its host too (``page_names``).

Errors::

    TrustError
    └── CertificateError    a certificate or a request is refused; ``reason`` is the word for it
"""

from __future__ import annotations

import hashlib
import ipaddress
import re
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from enum import IntEnum
from typing import TYPE_CHECKING, Final

from cryptography import x509
from cryptography.exceptions import InvalidSignature, UnsupportedAlgorithm
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

from rmpa.core.errors import RemoteProtocolError, StartError
from rmpa.core.identity import peer_name_problem
from rmpa.trust import limits

if TYPE_CHECKING:
    from collections.abc import Iterable

    from rmpa.trust.documents import DenyList


# The names and addresses by which a module's page is opened: which of them its certificate may have (RFC 9525).
#
# Those that follow from the module's name are never another module's. Further ones are asked for. A browser that
# trusts
# the mesh's CA is to believe it about no host of the Internet, so these are private addresses, and names of the
# local
# network.


_LABEL: Final = r"[a-z0-9](?:[a-z0-9-]{0,61}[a-z0-9])?"
_LOCAL: Final = re.compile(rf"{_LABEL}|(?:{_LABEL}\.)+(?:local|lan|internal|home\.arpa)")
"""A name without a dot, or below a domain that is no one's in the Internet (RFC 6762, RFC 8375, ICANN's internal)."""
_SHARED: Final = ipaddress.IPv4Network("100.64.0.0/10")
"""Of carriers, and of VPNs such as Tailscale's (RFC 6598)."""


def server_names(name: str) -> tuple[str, ...]:
    """The names that every module's certificate has, besides 127.0.0.1.

    They follow from the module's name and are not asked for, so that no module gets those of another. A host's name
    has ``-`` where the module's name, which is made of it, has ``_``.
    """
    host = name.replace("_", "-").lower()
    return (host, f"{host}.local", "localhost")


def page_hosts(wanted: Iterable[str]) -> tuple[str, ...]:
    """Of names and addresses those that a certificate may have, in their normal form, at most so many."""
    found = dict.fromkeys(host for text in wanted if (host := _page_host(text)))
    return tuple(found)[: limits.PAGE_HOSTS_MAX]


def host_names(host_name: str) -> tuple[str, ...]:
    """The names of a machine in its network: its host's name, whole and short, and that of mDNS."""
    name = host_name.lower().removesuffix(".")
    short = name.partition(".")[0]
    return (name, short, f"{short}.local")


def _page_host(text: str) -> str:
    """The normal form; empty: a certificate may not have it, or has it anyway."""
    try:
        address = ipaddress.ip_address(text)
    except ValueError:
        name = text.lower().removesuffix(".")
        return name if name != "localhost" and _LOCAL.fullmatch(name) else ""
    special = address.is_loopback or address.is_unspecified or address.is_multicast
    shared = isinstance(address, ipaddress.IPv4Address) and address in _SHARED
    return str(address) if (address.is_private or shared) and not special else ""


# The reasons for which a secured mesh refuses a connection: one word each, for wire, counters, commands and logs.


class TrustReason(IntEnum):
    """Why a connection is refused; the numbers continue those of ``mesh.handshake.Refusal`` on the wire."""

    PLAIN = 11
    """The dialler does not use TLS, and this mesh does."""
    UNSECURED = 12
    """The acceptor has not joined a secured mesh, and the dialler has."""
    KEY = 13
    """The group key of its packets is unknown."""
    CLOCK = 14
    """A certificate begins in the future."""
    FOREIGN = 15
    """The certificate is of another CA."""
    EXPIRED = 16
    """The certificate's time is over."""
    REVOKED = 17
    """The certificate is on the deny list."""
    NAME = 18
    """The certificate is of another module than the hello says."""
    DOWNGRADE = 19
    """The connection does not use TLS 1.3 with this protocol."""

    @property
    def label(self) -> str:
        """The word for people and counters: ``expired``."""
        return self.name.lower()

    @property
    def remedy(self) -> str:
        """What to do, as a sentence part."""
        return _REMEDIES[self]


_REMEDIES: Final = {
    TrustReason.PLAIN: "it joins by rmpa trust join TOKEN, with a token of rmpa trust invite at the authority",
    TrustReason.UNSECURED: "it joins by rmpa trust join TOKEN, with a token of rmpa trust invite at the authority",
    TrustReason.KEY: "are both of one mesh? the one that was away for long: rmpa trust renew there",
    TrustReason.CLOCK: "set both clocks: date, timedatectl",
    TrustReason.FOREIGN: "they have joined different meshes: rmpa trust join on one, with a token of the other's",
    TrustReason.EXPIRED: "rmpa trust renew on the module whose certificate it is, while the authority is reachable",
    TrustReason.REVOKED: "it can come back by rmpa trust invite at the authority, and rmpa trust join there",
    TrustReason.NAME: "start the module with the name that it joined with, or let it join again",
    TrustReason.DOWNGRADE: "install the same release of rmpa on both",
}


NOT_OF_THIS_MESH: Final = {
    TrustReason.PLAIN: "it has joined a secured mesh and this module has not; join it by rmpa trust join TOKEN here, "
    "with a token of rmpa trust invite at the authority of that mesh",
    TrustReason.UNSECURED: "it has not joined this secured mesh; let it join by rmpa trust invite at the authority "
    "and rmpa trust join TOKEN there",
    TrustReason.FOREIGN: "it has joined another secured mesh; to have both in one, rmpa trust leave and rmpa trust "
    "join TOKEN there, with a token of the authority here",
    TrustReason.KEY: "its group key is unknown here; if it has joined another mesh, rmpa trust leave and rmpa trust "
    "join TOKEN there; if it is of this one, rmpa trust renew here",
}
"""Why a module is not of this mesh, and what to do; behind a semicolon, as for ``Check.from_message``."""


def not_of_this_mesh(reason: TrustReason) -> str:
    """``not of this mesh: it has not joined this secured mesh; let it join by …``."""
    return f"not of this mesh: {NOT_OF_THIS_MESH[reason]}"


class TrustError(RemoteProtocolError):
    """A secured mesh refuses a connection, a certificate or a request.

    Args:
        reason: The word for it.
        text: What is wrong.
    """

    def __init__(self, reason: TrustReason, text: str) -> None:
        super().__init__(text)
        self.reason = reason


URN: Final = "urn:rmpa:"
"""What a module's name follows in the SAN."""
CURVE: Final = ec.SECP256R1()
"""The curve of all keys; browsers, which ``rmpa web`` serves, know it."""
_PURPOSES: Final = (ExtendedKeyUsageOID.CLIENT_AUTH, ExtendedKeyUsageOID.SERVER_AUTH)
_UNREADABLE: Final = (
    ValueError,
    TypeError,
    UnsupportedAlgorithm,
    x509.DuplicateExtension,
    x509.InvalidVersion,
    x509.UnsupportedGeneralNameType,
)
"""What ``cryptography`` raises about malformed input."""


class CertificateError(TrustError):
    """A certificate or a request is refused; a request that is malformed is ``foreign``."""


@dataclass(frozen=True, slots=True)
class CertificateRequest:
    """A request for a certificate (PKCS #10, RFC 2986) whose signature is valid.

    Args:
        name: The module's.
        public_key: Its public key (SubjectPublicKeyInfo, DER).
        hosts: The names and addresses that it asks for, of those that a certificate may have.
    """

    name: str
    public_key: bytes
    hosts: tuple[str, ...] = ()

    @property
    def key_hash(self) -> bytes:
        """SHA-256 of the key, which users compare in a join by files."""
        return hashlib.sha256(self.public_key).digest()


@dataclass(frozen=True, slots=True)
class ModuleCertificate:
    """What a module's certificate says, once it was verified.

    Args:
        name: The module's.
        serial: The certificate's number.
        issued: When it was issued, seconds since 1970.
        expires: When it ends.
        public_key: The key (SubjectPublicKeyInfo, DER).
        hosts: The names and addresses of its page.
    """

    name: str
    serial: int
    issued: float
    expires: float
    public_key: bytes
    hosts: frozenset[str] = frozenset()

    @property
    def renew_at(self) -> float:
        """When it should be renewed, seconds since 1970."""
        return self.issued + (self.expires - self.issued) * limits.RENEWAL_SHARE

    def __str__(self) -> str:
        """``arm (certificate 1f0a…)``."""
        return f"{self.name} (certificate {self.serial:x})"


# --- making ---------------------------------------------------------------------------------------------------------


def make_ca(key: ec.EllipticCurvePrivateKey, label: str, serial: int, wall: float) -> bytes:
    """A CA's certificate (DER), signed by itself.

    Args:
        key: The CA's key.
        label: What users call the mesh; part of the CN.
        serial: A random positive number of at most 159 bits.
        wall: Seconds since 1970.
    """
    name = _name(f"RMPA {label}"[:64])
    begin = _time(wall - limits.CERTIFICATE_BACKDATE)
    usage = _key_usage(signs_certificates=True)
    certificate = (
        x509.CertificateBuilder()
        .subject_name(name)
        .issuer_name(name)
        .public_key(key.public_key())
        .serial_number(serial)
        .not_valid_before(begin)
        .not_valid_after(_time(wall) + timedelta(seconds=limits.CA_LIFETIME))
        .add_extension(x509.BasicConstraints(ca=True, path_length=0), critical=True)
        .add_extension(usage, critical=True)
        .add_extension(x509.SubjectKeyIdentifier.from_public_key(key.public_key()), critical=False)
        .sign(key, hashes.SHA256())
    )
    return certificate.public_bytes(serialization.Encoding.DER)


def make_request(key: ec.EllipticCurvePrivateKey, name: str, hosts: Iterable[str] = ()) -> bytes:
    """A request (DER) for a certificate of a module with this name.

    Args:
        key: The module's.
        name: Its name.
        hosts: Names and addresses of its page, besides those that follow from its name.

    Raises:
        ValueError: No module can have that name.
    """
    if problem := peer_name_problem(name):
        raise ValueError(problem)
    request = (
        x509.CertificateSigningRequestBuilder()
        .subject_name(_name(name))
        .add_extension(_subject_alternative(name, page_hosts(hosts)), critical=False)
        .sign(key, hashes.SHA256())
    )
    return request.public_bytes(serialization.Encoding.DER)


def issue(
    request: CertificateRequest,
    ca: bytes,
    ca_key: ec.EllipticCurvePrivateKey,
    serial: int,
    wall: float,
    lifetime: float = limits.CERTIFICATE_LIFETIME,
    hosts: Iterable[str] = (),
) -> bytes:
    """A certificate (DER) for a request. Nothing of the request but its name and key is taken over.

    Args:
        request: As ``read_request`` returned it.
        ca: The CA's certificate (DER).
        ca_key: Its key.
        serial: A random positive number of at most 159 bits.
        wall: Seconds since 1970.
        lifetime: Seconds of its validity from now on.
        hosts: Names and addresses of its page, as the authority grants them.
    """
    authority = x509.load_der_x509_certificate(ca)
    key = _load_key(request.public_key)
    names = (*server_names(request.name), "127.0.0.1", *hosts)
    certificate = (
        x509.CertificateBuilder()
        .subject_name(_name(request.name))
        .issuer_name(authority.subject)
        .public_key(key)
        .serial_number(serial)
        .not_valid_before(_time(wall - limits.CERTIFICATE_BACKDATE))
        .not_valid_after(_time(wall + lifetime))
        .add_extension(x509.BasicConstraints(ca=False, path_length=None), critical=True)
        .add_extension(_key_usage(signs_certificates=False), critical=True)
        .add_extension(x509.ExtendedKeyUsage(_PURPOSES), critical=False)
        .add_extension(_subject_alternative(request.name, names), critical=False)
        .add_extension(x509.SubjectKeyIdentifier.from_public_key(key), critical=False)
        .add_extension(x509.AuthorityKeyIdentifier.from_issuer_public_key(_authority_key(authority)), critical=False)
        .sign(ca_key, hashes.SHA256())
    )
    return certificate.public_bytes(serialization.Encoding.DER)


# --- checking -------------------------------------------------------------------------------------------------------


def read_request(data: bytes) -> CertificateRequest:
    """Read a request (DER), and check that its sender has the key.

    Raises:
        CertificateError: It is too long, malformed, or wrongly signed; or key or name are not allowed.
    """
    if len(data) > limits.CSR_MAX:
        raise CertificateError(TrustReason.FOREIGN, f"a request of {len(data)} bytes")
    try:
        request = x509.load_der_x509_csr(data)
        key = request.public_key()
        valid = isinstance(key, ec.EllipticCurvePublicKey) and request.is_signature_valid
        name, hosts = _module_name(request), page_hosts(sorted(_hosts_in(request)))
    except _UNREADABLE as error:
        raise CertificateError(TrustReason.FOREIGN, f"the request cannot be read: {error!s:.200}") from None
    if not isinstance(key, ec.EllipticCurvePublicKey) or key.curve.name != CURVE.name:
        raise CertificateError(TrustReason.FOREIGN, f"the request's key is not of {CURVE.name}")
    if not valid:
        raise CertificateError(TrustReason.FOREIGN, "the request is not signed with its own key")
    return CertificateRequest(name, _public_bytes(key), hosts)


def verify(
    data: bytes, ca: bytes, wall: float | None, *, name: str = "", deny: DenyList | None = None, grace: float = 0.0
) -> ModuleCertificate:
    """Verify a module's certificate.

    Args:
        data: The certificate (DER).
        ca: The CA's (DER), which this module trusts.
        wall: Seconds since 1970; ``None`` checks no times, for a new module whose clock is not set.
        name: The module that it must be of; empty for any.
        deny: The names that were revoked.
        grace: Seconds for which an expired certificate is still accepted, to be renewed.

    Raises:
        CertificateError: It is of another CA, not valid yet, expired, of another module, or revoked; the first of
            these.
    """
    found = _read(data, ca)
    if wall is not None:
        _check_times(found, wall, grace)
    if name and found.name != name:
        raise CertificateError(TrustReason.NAME, f"the certificate is of {found.name}, not of {name}")
    if deny is not None and deny.denies(found.name, found.issued):
        raise CertificateError(TrustReason.REVOKED, f"{found.name} was revoked (deny list {deny.number})")
    return found


def _check_times(found: ModuleCertificate, wall: float, grace: float) -> None:
    begin = found.issued - limits.CERTIFICATE_BACKDATE
    if wall < begin:
        text = f"the certificate of {found.name} begins in {begin - wall:.0f} s: one of the clocks is off"
        raise CertificateError(TrustReason.CLOCK, text)
    if wall > found.expires + grace:
        text = f"the certificate of {found.name} ended {wall - found.expires:.0f} s ago"
        raise CertificateError(TrustReason.EXPIRED, text)


def _read(data: bytes, ca: bytes) -> ModuleCertificate:
    """What a certificate says, if the CA has signed it for a module."""
    if len(data) > limits.CERTIFICATE_MAX:
        raise CertificateError(TrustReason.FOREIGN, f"a certificate of {len(data)} bytes")
    authority = x509.load_der_x509_certificate(ca)
    try:
        certificate = x509.load_der_x509_certificate(data)
        certificate.verify_directly_issued_by(authority)
        name, hosts = _module_name(certificate), _hosts_in(certificate)
        constraints = certificate.extensions.get_extension_for_class(x509.BasicConstraints).value
        key = certificate.public_key()
    except InvalidSignature:
        raise CertificateError(TrustReason.FOREIGN, "the certificate is of another CA") from None
    except (*_UNREADABLE, x509.ExtensionNotFound) as error:
        text = f"the certificate is of another CA, or cannot be read: {error!s:.200}"
        raise CertificateError(TrustReason.FOREIGN, text) from None
    if constraints.ca or not isinstance(key, ec.EllipticCurvePublicKey):
        raise CertificateError(TrustReason.FOREIGN, "the certificate is not one of a module")
    issued = certificate.not_valid_before_utc.timestamp() + limits.CERTIFICATE_BACKDATE
    expires = certificate.not_valid_after_utc.timestamp()
    return ModuleCertificate(name, certificate.serial_number, issued, expires, _public_bytes(key), hosts)


def check_ca(data: bytes, fingerprint: bytes) -> None:
    """Check that a CA's certificate (DER) has a fingerprint, and that it is signed by itself.

    Raises:
        CertificateError: It has another fingerprint, or is not a CA.
    """
    if len(data) > limits.CERTIFICATE_MAX or hashlib.sha256(data).digest()[: len(fingerprint)] != fingerprint:
        raise CertificateError(TrustReason.FOREIGN, "the CA does not have the fingerprint of the token")
    try:
        certificate = x509.load_der_x509_certificate(data)
        certificate.verify_directly_issued_by(certificate)
        constraints = certificate.extensions.get_extension_for_class(x509.BasicConstraints).value
    except (*_UNREADABLE, InvalidSignature, x509.ExtensionNotFound) as error:
        raise CertificateError(TrustReason.FOREIGN, f"the CA's certificate cannot be used: {error!s:.200}") from None
    if not constraints.ca:
        raise CertificateError(TrustReason.FOREIGN, "the certificate is not one of a CA")


def ca_public_key(ca: bytes) -> ec.EllipticCurvePublicKey:
    """The key of a CA's certificate (DER), which documents are verified with.

    Raises:
        CertificateError: It cannot be read, or has no such key.
    """
    try:
        return _authority_key(x509.load_der_x509_certificate(ca))
    except _UNREADABLE as error:
        raise CertificateError(TrustReason.FOREIGN, f"the CA's certificate cannot be read: {error!s:.200}") from None


def _authority_key(authority: x509.Certificate) -> ec.EllipticCurvePublicKey:
    key = authority.public_key()
    if not isinstance(key, ec.EllipticCurvePublicKey):
        raise TypeError("its key is not of an elliptic curve")
    return key


def _module_name(holder: x509.Certificate | x509.CertificateSigningRequest) -> str:
    """The module that a certificate or a request is of.

    Raises:
        ValueError: SAN and CN do not have one and the same valid name.
    """
    names = [attribute.value for attribute in holder.subject.get_attributes_for_oid(NameOID.COMMON_NAME)]
    try:
        alternative = holder.extensions.get_extension_for_class(x509.SubjectAlternativeName).value
    except x509.ExtensionNotFound:
        raise ValueError("it has no subject alternative name") from None
    uris = alternative.get_values_for_type(x509.UniformResourceIdentifier)
    if len(uris) != 1 or not uris[0].startswith(URN) or names != [uris[0].removeprefix(URN)]:
        raise ValueError(f"it does not have one name, as CN and as {URN}NAME")
    name = uris[0].removeprefix(URN)
    if problem := peer_name_problem(name):
        raise ValueError(problem)
    return name


def _hosts_in(holder: x509.Certificate | x509.CertificateSigningRequest) -> frozenset[str]:
    """The names and addresses in a SAN that ``_module_name`` has read."""
    alternative = holder.extensions.get_extension_for_class(x509.SubjectAlternativeName).value
    addresses = map(str, alternative.get_values_for_type(x509.IPAddress))
    return frozenset((*alternative.get_values_for_type(x509.DNSName), *addresses))


def _load_key(data: bytes) -> ec.EllipticCurvePublicKey:
    key = serialization.load_der_public_key(data)
    if not isinstance(key, ec.EllipticCurvePublicKey):
        raise TypeError("the key is not of an elliptic curve")
    return key


def _public_bytes(key: ec.EllipticCurvePublicKey) -> bytes:
    return key.public_bytes(serialization.Encoding.DER, serialization.PublicFormat.SubjectPublicKeyInfo)


def _name(common: str) -> x509.Name:
    return x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, common)])


def _subject_alternative(name: str, hosts: Iterable[str]) -> x509.SubjectAlternativeName:
    names: list[x509.GeneralName] = [x509.UniformResourceIdentifier(URN + name)]
    for host in dict.fromkeys(hosts):
        try:
            names.append(x509.IPAddress(ipaddress.ip_address(host)))
        except ValueError:
            names.append(x509.DNSName(host))
    return x509.SubjectAlternativeName(names)


def _key_usage(*, signs_certificates: bool) -> x509.KeyUsage:
    return x509.KeyUsage(
        digital_signature=True,
        content_commitment=False,
        key_encipherment=False,
        data_encipherment=False,
        key_agreement=False,
        key_cert_sign=signs_certificates,
        crl_sign=signs_certificates,
        encipher_only=False,
        decipher_only=False,
    )


def _time(wall: float) -> datetime:
    return datetime.fromtimestamp(int(wall), UTC)


# Private keys of modules and of the CA, as PEM.


def new_key() -> bytes:
    """A private key (PKCS #8, PEM) for a module or a CA."""
    return _key_pem(ec.generate_private_key(CURVE))


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


def _key_pem(key: ec.EllipticCurvePrivateKey) -> bytes:
    return key.private_bytes(
        serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption()
    )
