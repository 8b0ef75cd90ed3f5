"""Certificates of a mesh (RFC 5280), and the signed documents of its authority.

Certificates: the CA of a mesh, requests, and certificates that prove a module's name (RFC 5280).

Keys are P-256. A module's certificate has its name as CN and as SAN ``urn:rmpa:<name>``; the SAN decides. This module
needs the library ``cryptography`` (extra ``rmpa[trust]``); links do without it, as OpenSSL checks the chain there.
For browsers, which ``rmpa web`` serves with it, it has names and addresses of its host too (``page_names``).
"""

from __future__ import annotations

import hashlib
import inspect
import ipaddress
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from typing import TYPE_CHECKING, Annotated, Final, TypeVar

import msgspec
from cryptography import x509
from cryptography.exceptions import InvalidSignature, UnsupportedAlgorithm
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

from rmpa.core.errors import LimitExceeded, RemoteProtocolError
from rmpa.core.identity import BASE_NAME, peer_name_problem
from rmpa.core.limits import PEER_NAME_MAX, UINT32_MAX
from rmpa.trust import limits
from rmpa.trust.packets import GroupKey  # noqa: TC001 - msgspec reads the annotation
from rmpa.trust.permissions import Document, TrustError, TrustReason, page_hosts, server_names

if TYPE_CHECKING:
    from collections.abc import Iterable


# Signed, numbered documents of the authority. The deny list and the list of group keys (docs/design/trust.md).
#
# A document is the JSON object ``{"signed": TEXT, "signature": BASE64}``: TEXT is a JSON object too, and the
# signature (ECDSA P-256, SHA-256, DER) is over the kind's label, a zero byte and TEXT. So it can be checked before
# TEXT is parsed, and no document can stand for one of the other kind. Of two documents the one with the higher number
# holds.


_ALGORITHM: Final = ec.ECDSA(hashes.SHA256())
_Number = Annotated[int, msgspec.Meta(ge=0, le=UINT32_MAX)]
_ModuleName = Annotated[str, msgspec.Meta(pattern=rf"\A{BASE_NAME}\Z", max_length=PEER_NAME_MAX)]
_NameOrNone = Annotated[str, msgspec.Meta(pattern=rf"\A({BASE_NAME})?\Z", max_length=PEER_NAME_MAX)]


class _Signed(msgspec.Struct, frozen=True):
    signed: str
    signature: bytes


class DenyEntry(msgspec.Struct, frozen=True):
    """One revoked module.

    Attributes:
        name: The module's.
        before: Certificates of that name that were issued up to this time are refused; seconds since 1970.
    """

    name: _ModuleName
    before: int


class DenyList(msgspec.Struct, frozen=True, omit_defaults=True):
    """The names that were revoked.

    Attributes:
        number: Grows with each change; 0: nothing was ever revoked.
        entries: One for each name.
        members: The modules with certificates: a table of access of Zenoh keeps out only what it does not name.
    """

    number: _Number = 0
    entries: Annotated[tuple[DenyEntry, ...], msgspec.Meta(max_length=limits.DENY_MAX)] = ()
    members: Annotated[tuple[_ModuleName, ...], msgspec.Meta(max_length=limits.ISSUED_MAX)] = ()

    def in_force(self, wall: float) -> tuple[str, ...]:
        """The names whose certificates from before the revocation may still be valid at ``wall``."""
        ended = wall - limits.CERTIFICATE_LIFETIME
        return tuple(sorted(entry.name for entry in self.entries if entry.before > ended))

    def denies(self, name: str, issued: float) -> bool:
        """Whether a certificate is refused.

        Args:
            name: The module that it is of.
            issued: When it was issued, seconds since 1970.
        """
        return any(entry.name == name and issued <= entry.before for entry in self.entries)

    def with_name(self, name: str, wall: float) -> DenyList:
        """The list after a revocation.

        Args:
            name: The module, whose present certificates are all refused.
            wall: When the last of them was issued, or later; seconds since 1970. The time of an entry never goes
                back.

        Raises:
            ValueError: No module can have that name, or the list is full.
        """
        if problem := peer_name_problem(name):
            raise ValueError(problem)
        before = max([int(wall), *(entry.before for entry in self.entries if entry.name == name)])
        entries = (*(entry for entry in self.entries if entry.name != name), DenyEntry(name, before))
        if len(entries) > limits.DENY_MAX:
            raise ValueError(f"a deny list has at most {limits.DENY_MAX} names; make a new mesh (rmpa trust init)")
        return DenyList(self.number + 1, entries, tuple(each for each in self.members if each != name))


class KeyList(msgspec.Struct, frozen=True):
    """The group keys of a mesh. It is secret: only members get it, over their links.

    Attributes:
        number: Grows with each change.
        keys: By number.
        authority: The name of the authority, so that no other member can pass for it; empty: not known.
        proves_from: The number of the key that the last revocation made: a revoked module has those before.
        made: When the newest key was made, by the authority's clock in seconds since 1970; 0: it was not set.
    """

    number: _Number
    keys: Annotated[tuple[GroupKey, ...], msgspec.Meta(min_length=1, max_length=limits.KEYS_MAX)]
    authority: _NameOrNone = ""
    proves_from: int = 0
    made: int = 0

    def __post_init__(self) -> None:
        if len({key.number for key in self.keys}) != len(self.keys):
            raise ValueError("two group keys of one number")


_T = TypeVar("_T", bound=DenyList | KeyList)
_KINDS: Final[dict[type[msgspec.Struct], Document]] = {DenyList: Document.DENY, KeyList: Document.KEYS}


def sign(document: DenyList | KeyList, key: ec.EllipticCurvePrivateKey) -> bytes:
    """A document with the CA's signature, as it is sent and stored."""
    text = msgspec.json.encode(document).decode()
    return msgspec.json.encode(_Signed(text, key.sign(_under_signature(type(document), text), _ALGORITHM)))


def read_document(data: bytes, key: ec.EllipticCurvePublicKey, form: type[_T]) -> _T:
    """Read a signed document.

    Args:
        data: As ``sign`` made it.
        key: The CA's key.
        form: Which of the two it must be.

    Raises:
        LimitExceeded: It is too long.
        RemoteProtocolError: It is malformed, or not signed with that key.
    """
    if len(data) > limits.DOCUMENT_MAX:
        raise LimitExceeded("a signed document", len(data), limits.DOCUMENT_MAX)
    try:
        envelope = msgspec.json.decode(data, type=_Signed)
        key.verify(envelope.signature, _under_signature(form, envelope.signed), _ALGORITHM)
        return msgspec.json.decode(envelope.signed, type=form)
    except InvalidSignature:
        raise RemoteProtocolError("the document is not signed by our authority") from None
    except (msgspec.MsgspecError, UnicodeError, RecursionError) as error:
        raise RemoteProtocolError(f"the document cannot be read: {error!s:.200}") from None


def _under_signature(form: type[msgspec.Struct], text: str) -> bytes:
    return f"rmpa {_KINDS[form]} 1\0{text}".encode()


# What a module's name follows in the SAN.
URN: Final = "urn:rmpa:"
# The curve of all keys; browsers, which ``rmpa web`` serves, know it.
CURVE: Final = ec.SECP256R1()
_PURPOSES: Final = (ExtendedKeyUsageOID.CLIENT_AUTH, ExtendedKeyUsageOID.SERVER_AUTH)
_USAGES: Final = tuple(inspect.signature(x509.KeyUsage).parameters)
# What ``cryptography`` raises about malformed input.
_UNREADABLE: Final = (
    ValueError,
    TypeError,
    UnsupportedAlgorithm,
    x509.DuplicateExtension,
    x509.InvalidVersion,
    x509.UnsupportedGeneralNameType,
)


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
    """What a module's certificate says, which the CA has signed.

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

    def judge(self, wall: float | None, name: str = "", deny: DenyList | None = None, grace: float = 0.0) -> None:
        """Check times, name and revocation.

        Args:
            wall: Seconds since 1970; ``None`` checks no times, for a module whose clock is not set.
            name: The module that it must be of; empty for any.
            deny: The names that were revoked.
            grace: Seconds for which an expired certificate is still accepted, to be renewed.

        Raises:
            TrustError: It is not valid yet, expired, of another module, or revoked; the first of these.
        """
        begin = self.issued - limits.CERTIFICATE_BACKDATE
        if wall is not None and wall < begin:
            text = f"the certificate of {self.name} begins in {begin - wall:.0f} s: one of the clocks is off"
            raise TrustError(TrustReason.CLOCK, text)
        if wall is not None and wall > self.expires + grace:
            text = f"the certificate of {self.name} ended {wall - self.expires:.0f} s ago"
            raise TrustError(TrustReason.EXPIRED, text)
        if name and self.name != name:
            raise TrustError(TrustReason.NAME, f"the certificate is of {self.name}, not of {name}")
        if deny is not None and deny.denies(self.name, self.issued):
            raise TrustError(TrustReason.REVOKED, f"{self.name} was revoked (deny list {deny.number})")

    def __str__(self) -> str:
        """``arm (certificate 1f0a…)``."""
        return f"{self.name} (certificate {self.serial:x})"


def make_ca(key: ec.EllipticCurvePrivateKey, label: str, serial: int, wall: float) -> bytes:
    """A CA's certificate (DER), signed by itself.

    Args:
        key: The CA's key.
        label: What users call the mesh; part of the CN.
        serial: A random positive number of at most 159 bits.
        wall: Seconds since 1970.
    """
    name, begin = _name(f"RMPA {label}"[:64]), _time(wall - limits.CERTIFICATE_BACKDATE)
    end = _time(wall) + timedelta(seconds=limits.CA_LIFETIME)
    certificate = _builder(name, name, key.public_key(), serial, begin, end, ca=True).sign(key, hashes.SHA256())
    return certificate.public_bytes(serialization.Encoding.DER)


def _builder(
    subject: x509.Name,
    issuer: x509.Name,
    key: ec.EllipticCurvePublicKey,
    serial: int,
    begin: datetime,
    end: datetime,
    *,
    ca: bool,
) -> x509.CertificateBuilder:
    """What the certificates of CA and modules have alike."""
    usage = dict.fromkeys(_USAGES, False) | {"digital_signature": True, "key_cert_sign": ca, "crl_sign": ca}
    return (
        x509.CertificateBuilder()
        .subject_name(subject)
        .issuer_name(issuer)
        .public_key(key)
        .serial_number(serial)
        .not_valid_before(begin)
        .not_valid_after(end)
        .add_extension(x509.BasicConstraints(ca=ca, path_length=0 if ca else None), critical=True)
        .add_extension(x509.KeyUsage(**usage), critical=True)
        .add_extension(x509.SubjectKeyIdentifier.from_public_key(key), critical=False)
    )


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
    hosts: Iterable[str] = (),
) -> bytes:
    """A certificate (DER) for a request. Nothing of the request but its name and key is taken over.

    Args:
        request: As ``read_request`` returned it.
        ca: The CA's certificate (DER).
        ca_key: Its key.
        serial: A random positive number of at most 159 bits.
        wall: Seconds since 1970.
        hosts: Names and addresses of its page, as the authority grants them.
    """
    authority = x509.load_der_x509_certificate(ca)
    issuer = _elliptic(authority.public_key())
    key = _elliptic(serialization.load_der_public_key(request.public_key))
    names = (*server_names(request.name), "127.0.0.1", *hosts)
    begin, end = _time(wall - limits.CERTIFICATE_BACKDATE), _time(wall + limits.CERTIFICATE_LIFETIME)
    certificate = (
        _builder(_name(request.name), authority.subject, key, serial, begin, end, ca=False)
        .add_extension(x509.ExtendedKeyUsage(_PURPOSES), critical=False)
        .add_extension(_subject_alternative(request.name, names), critical=False)
        .add_extension(x509.AuthorityKeyIdentifier.from_issuer_public_key(issuer), critical=False)
        .sign(ca_key, hashes.SHA256())
    )
    return certificate.public_bytes(serialization.Encoding.DER)


def read_request(data: bytes) -> CertificateRequest:
    """Read a request (DER), and check that its sender has the key.

    Raises:
        TrustError: It is too long, malformed, or wrongly signed; or key or name are not allowed.
    """
    if len(data) > limits.CSR_MAX:
        raise TrustError(TrustReason.FOREIGN, f"a request of {len(data)} bytes")
    try:
        request = x509.load_der_x509_csr(data)
        key = request.public_key()
        valid = isinstance(key, ec.EllipticCurvePublicKey) and request.is_signature_valid
        name, hosts = _names_in(request)
    except _UNREADABLE as error:
        raise TrustError(TrustReason.FOREIGN, f"the request cannot be read: {error!s:.200}") from None
    if not isinstance(key, ec.EllipticCurvePublicKey) or key.curve.name != CURVE.name:
        raise TrustError(TrustReason.FOREIGN, f"the request's key is not of {CURVE.name}")
    if not valid:
        raise TrustError(TrustReason.FOREIGN, "the request is not signed with its own key")
    return CertificateRequest(name, _public_bytes(key), page_hosts(sorted(hosts)))


def read_certificate(data: bytes, ca: bytes) -> ModuleCertificate:
    """Read a module's certificate; whether it holds now, its ``judge`` says.

    Args:
        data: The certificate (DER).
        ca: The CA's (DER), which this module trusts.

    Raises:
        TrustError: It is too long, malformed, of another CA, or not one of a module.
    """
    if len(data) > limits.CERTIFICATE_MAX:
        raise TrustError(TrustReason.FOREIGN, f"a certificate of {len(data)} bytes")
    authority = x509.load_der_x509_certificate(ca)
    try:
        certificate = x509.load_der_x509_certificate(data)
        certificate.verify_directly_issued_by(authority)
        name, hosts = _names_in(certificate)
        constraints = certificate.extensions.get_extension_for_class(x509.BasicConstraints).value
        key = certificate.public_key()
    except InvalidSignature:
        raise TrustError(TrustReason.FOREIGN, "the certificate is of another CA") from None
    except (*_UNREADABLE, x509.ExtensionNotFound) as error:
        text = f"the certificate is of another CA, or cannot be read: {error!s:.200}"
        raise TrustError(TrustReason.FOREIGN, text) from None
    if constraints.ca or not isinstance(key, ec.EllipticCurvePublicKey):
        raise TrustError(TrustReason.FOREIGN, "the certificate is not one of a module")
    issued = certificate.not_valid_before_utc.timestamp() + limits.CERTIFICATE_BACKDATE
    expires = certificate.not_valid_after_utc.timestamp()
    return ModuleCertificate(name, certificate.serial_number, issued, expires, _public_bytes(key), hosts)


def check_ca(data: bytes, fingerprint: bytes) -> None:
    """Check that a CA's certificate (DER) has a fingerprint, and that it is signed by itself.

    Raises:
        TrustError: It has another fingerprint, or is not a CA.
    """
    if len(data) > limits.CERTIFICATE_MAX or hashlib.sha256(data).digest()[: len(fingerprint)] != fingerprint:
        raise TrustError(TrustReason.FOREIGN, "the CA does not have the fingerprint of the token")
    try:
        certificate = x509.load_der_x509_certificate(data)
        certificate.verify_directly_issued_by(certificate)
        constraints = certificate.extensions.get_extension_for_class(x509.BasicConstraints).value
    except (*_UNREADABLE, InvalidSignature, x509.ExtensionNotFound) as error:
        raise TrustError(TrustReason.FOREIGN, f"the CA's certificate cannot be used: {error!s:.200}") from None
    if not constraints.ca:
        raise TrustError(TrustReason.FOREIGN, "the certificate is not one of a CA")


def ca_public_key(ca: bytes) -> ec.EllipticCurvePublicKey:
    """The key of a CA's certificate (DER), which documents are verified with.

    Raises:
        TrustError: It cannot be read, or has no such key.
    """
    try:
        return _elliptic(x509.load_der_x509_certificate(ca).public_key())
    except _UNREADABLE as error:
        raise TrustError(TrustReason.FOREIGN, f"the CA's certificate cannot be read: {error!s:.200}") from None


def _names_in(holder: x509.Certificate | x509.CertificateSigningRequest) -> tuple[str, frozenset[str]]:
    """The module that a certificate or a request is of, and the names and addresses of its page.

    Raises:
        ValueError: SAN and CN do not have one and the same valid name.
    """
    common = [attribute.value for attribute in holder.subject.get_attributes_for_oid(NameOID.COMMON_NAME)]
    try:
        alternative = holder.extensions.get_extension_for_class(x509.SubjectAlternativeName).value
    except x509.ExtensionNotFound:
        raise ValueError("it has no subject alternative name") from None
    uris = alternative.get_values_for_type(x509.UniformResourceIdentifier)
    if len(uris) != 1 or not uris[0].startswith(URN) or common != [uris[0].removeprefix(URN)]:
        raise ValueError(f"it does not have one name, as CN and as {URN}NAME")
    name = uris[0].removeprefix(URN)
    if problem := peer_name_problem(name):
        raise ValueError(problem)
    addresses = map(str, alternative.get_values_for_type(x509.IPAddress))
    return name, frozenset((*alternative.get_values_for_type(x509.DNSName), *addresses))


def _elliptic(key: object) -> ec.EllipticCurvePublicKey:
    if not isinstance(key, ec.EllipticCurvePublicKey):
        raise TypeError("its key is not of an elliptic curve")
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


def _time(wall: float) -> datetime:
    return datetime.fromtimestamp(int(wall), UTC)
