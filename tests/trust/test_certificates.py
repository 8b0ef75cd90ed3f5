"""Certificates, and the names in them."""

from __future__ import annotations

from dataclasses import replace

import pytest
from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec, ed25519
from cryptography.x509.oid import NameOID
from hypothesis import given
from hypothesis import strategies as st

from rmpa.trust import limits
from rmpa.trust.certificates import (
    URN,
    DenyList,
    ModuleCertificate,
    ca_public_key,
    check_ca,
    issue,
    make_request,
    read_certificate,
    read_request,
)
from rmpa.trust.permissions import TrustError, TrustReason, host_names, page_hosts, server_names
from rmpa.trust.tokens import fingerprint_of
from tests.runtime.secure_pairs import make_context, shake
from tests.trust.authority import WALL, Authority, new_key

pytest.importorskip("cryptography")


LAB, OTHER = Authority(), Authority()
ARM_KEY = new_key()
ARM = LAB.module("arm", key=ARM_KEY)
DAY = 86_400.0


def verify(
    data: bytes,
    wall: float = WALL,
    *,
    ca: bytes = LAB.certificate,
    name: str = "",
    deny: DenyList | None = None,
    grace: float = 0.0,
) -> ModuleCertificate:
    """Read and judge."""
    found = read_certificate(data, ca)
    found.judge(wall, name, deny, grace)
    return found


def _refused(data: bytes, wall: float = WALL, **kwargs: object) -> TrustReason:
    with pytest.raises(TrustError) as caught:
        verify(data, wall, **kwargs)  # type: ignore[arg-type] # the test's own words
    assert str(caught.value)
    return caught.value.reason


def test_what_is_issued_is_verified() -> None:
    found = verify(ARM, name="arm", deny=DenyList())
    assert found.name == "arm"
    assert found.issued == WALL
    assert found.expires == WALL + limits.CERTIFICATE_LIFETIME
    assert found.renew_at == WALL + 3.5 * DAY
    spki = (serialization.Encoding.DER, serialization.PublicFormat.SubjectPublicKeyInfo)
    assert found.public_key == ARM_KEY.public_key().public_bytes(*spki)


def test_a_certificate_says_what_openssl_needs() -> None:
    certificate = x509.load_der_x509_certificate(ARM)
    assert certificate.version is x509.Version.v3
    assert certificate.subject.rfc4514_string() == "CN=arm"
    extensions = certificate.extensions
    assert not extensions.get_extension_for_class(x509.BasicConstraints).value.ca
    usages = extensions.get_extension_for_class(x509.ExtendedKeyUsage).value
    assert {usage.dotted_string for usage in usages} == {"1.3.6.1.5.5.7.3.1", "1.3.6.1.5.5.7.3.2"}
    names = extensions.get_extension_for_class(x509.SubjectAlternativeName).value
    assert names.get_values_for_type(x509.UniformResourceIdentifier) == ["urn:rmpa:arm"]


def test_browsers_find_the_hosts_that_follow_from_the_modules_name() -> None:
    certificate = x509.load_der_x509_certificate(LAB.module("left_Arm"))
    names = certificate.extensions.get_extension_for_class(x509.SubjectAlternativeName).value
    assert names.get_values_for_type(x509.DNSName) == ["left-arm", "left-arm.local", "localhost"]
    assert [str(each) for each in names.get_values_for_type(x509.IPAddress)] == ["127.0.0.1"]


def test_tls_accepts_members() -> None:
    """And no others: ``tests/runtime/test_tls.py``."""
    client, _ = shake((make_context(LAB, server_side=False), make_context(LAB, server_side=True)))
    assert client.tls.getpeercert()["subjectAltName"][0] == ("URI", "urn:rmpa:arm")  # type: ignore[index] # there is one


def test_each_other_certificate_has_its_reason() -> None:
    deny = DenyList().with_name("arm", WALL)
    assert _refused(ARM, ca=OTHER.certificate) is TrustReason.FOREIGN
    assert _refused(ARM, WALL + limits.CERTIFICATE_LIFETIME + 1) is TrustReason.EXPIRED
    assert _refused(ARM, WALL - limits.CERTIFICATE_BACKDATE - 1) is TrustReason.CLOCK
    assert _refused(ARM, name="base") is TrustReason.NAME
    assert _refused(ARM, deny=deny) is TrustReason.REVOKED
    assert _refused(LAB.certificate) is TrustReason.FOREIGN
    assert _refused(b"") is TrustReason.FOREIGN
    assert _refused(bytes(limits.CERTIFICATE_MAX + 1)) is TrustReason.FOREIGN


def test_a_revoked_name_can_be_invited_again() -> None:
    deny = DenyList().with_name("arm", WALL)
    again = LAB.module("arm", WALL + 1)
    assert verify(again, WALL + 1, deny=deny).name == "arm"
    assert verify(LAB.module("base"), deny=deny).name == "base"


def test_grace_is_for_renewal_alone() -> None:
    late = WALL + limits.CERTIFICATE_LIFETIME + 30 * DAY
    assert _refused(ARM, late) is TrustReason.EXPIRED
    assert verify(ARM, late, grace=limits.RENEWAL_GRACE).name == "arm"
    assert _refused(ARM, WALL + 400 * DAY, grace=limits.RENEWAL_GRACE) is TrustReason.EXPIRED
    deny = DenyList().with_name("arm", WALL)
    assert _refused(ARM, late, grace=limits.RENEWAL_GRACE, deny=deny) is TrustReason.REVOKED


def _outcome(data: bytes) -> object:
    """What a certificate says, or why it is refused."""
    try:
        return verify(data)
    except TrustError as error:
        return error.reason


def test_every_changed_byte_is_refused() -> None:
    original = _outcome(ARM)
    outcomes = []
    for offset in range(len(ARM)):
        changed = ARM[:offset] + bytes([ARM[offset] ^ 1]) + ARM[offset + 1 :]
        outcomes.append(_outcome(changed))
    assert set(outcomes) <= {TrustReason.FOREIGN, original}
    assert outcomes.count(original) <= 1  # a spare bit behind the signature


def test_a_member_cannot_issue() -> None:
    request = read_request(make_request(new_key(), "evil"))
    # Signed by the arm's key, in the CA's name.
    forged = issue(request, LAB.certificate, ARM_KEY, 5, WALL)
    assert _refused(forged) is TrustReason.FOREIGN
    # Signed by the arm's key, in its own name.
    assert _refused(issue(request, ARM, ARM_KEY, 5, WALL)) is TrustReason.FOREIGN


def test_a_request_proves_its_key() -> None:
    request = make_request(ARM_KEY, "arm")
    found = read_request(request)
    assert found.name == "arm"
    assert found.public_key == verify(ARM).public_key
    assert len(found.key_hash) == 32
    accepted = 0
    for offset in range(len(request)):
        changed = request[:offset] + bytes([request[offset] ^ 1]) + request[offset + 1 :]
        try:
            assert read_request(changed) == found, offset
        except TrustError:
            continue
        accepted += 1
    assert accepted <= 1  # a spare bit behind the signature


def test_the_key_of_another_module_is_refused_without_its_signature() -> None:
    own, stolen = make_request(new_key(), "arm"), x509.load_der_x509_csr(make_request(ARM_KEY, "arm"))
    body = x509.load_der_x509_csr(own)
    # What the arm's request says, signed by another key: both signatures have 70 to 72 bytes.
    forged = stolen.public_bytes(serialization.Encoding.DER).replace(stolen.signature, body.signature)
    with pytest.raises(TrustError):
        read_request(forged)


@pytest.mark.parametrize(
    ("common", "uris"),
    [
        ("arm", ["urn:rmpa:base"]),
        ("arm", []),
        ("arm", ["urn:rmpa:arm", "urn:rmpa:base"]),
        ("arm", ["urn:other:arm"]),
        ("my arm", ["urn:rmpa:my arm"]),
        ("a/../b", ["urn:rmpa:a/../b"]),
    ],
)
def test_a_request_has_one_valid_name(common: str, uris: list[str]) -> None:
    with pytest.raises(TrustError):
        read_request(_request(new_key(), common, uris))


def test_other_keys_are_refused() -> None:
    for key in (ec.generate_private_key(ec.SECP384R1()), ed25519.Ed25519PrivateKey.generate()):
        with pytest.raises(TrustError, match="key is not of secp256r1"):
            read_request(_request(key, "arm", [URN + "arm"]))


def _request(key: ec.EllipticCurvePrivateKey | ed25519.Ed25519PrivateKey, common: str, uris: list[str]) -> bytes:
    builder = x509.CertificateSigningRequestBuilder().subject_name(
        x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, common)])
    )
    if uris:
        names = [x509.UniformResourceIdentifier(uri) for uri in uris]
        builder = builder.add_extension(x509.SubjectAlternativeName(names), critical=False)
    algorithm = hashes.SHA256() if isinstance(key, ec.EllipticCurvePrivateKey) else None
    return builder.sign(key, algorithm).public_bytes(serialization.Encoding.DER)


def test_nothing_but_name_and_key_of_a_request_is_taken_over() -> None:
    asked = replace(read_request(make_request(ARM_KEY, "arm")))
    names = {extension.oid.dotted_string for extension in x509.load_der_x509_certificate(ARM).extensions}
    again = issue(asked, LAB.certificate, LAB.key, 7, WALL)
    assert {extension.oid.dotted_string for extension in x509.load_der_x509_certificate(again).extensions} == names


def test_a_module_needs_a_valid_name() -> None:
    with pytest.raises(ValueError, match="not a ROS base name"):
        make_request(ARM_KEY, "my arm")


def test_a_ca_is_pinned_by_its_fingerprint() -> None:
    check_ca(LAB.certificate, fingerprint_of(LAB.certificate))
    with pytest.raises(TrustError, match="does not have the fingerprint"):
        check_ca(LAB.certificate, fingerprint_of(OTHER.certificate))
    for other in (ARM, b"", b"nonsense"):
        with pytest.raises(TrustError):
            check_ca(other, fingerprint_of(other))
    assert ca_public_key(LAB.certificate) == LAB.key.public_key()
    with pytest.raises(TrustError):
        ca_public_key(b"nonsense")


@given(st.binary(max_size=200))
def test_anything_at_all_is_refused(data: bytes) -> None:
    _refused(data)
    with pytest.raises(TrustError):
        read_request(data)


@pytest.mark.parametrize(
    ("wanted", "given"),
    [
        ("Robot1", "robot1"),
        ("robot1.local", "robot1.local"),
        ("arm.hall.lan.", "arm.hall.lan"),
        ("nas.home.arpa", "nas.home.arpa"),
        ("10.0.0.7", "10.0.0.7"),
        ("192.168.1.7", "192.168.1.7"),
        ("169.254.3.4", "169.254.3.4"),
        ("100.64.0.3", "100.64.0.3"),
        ("fd00::1", "fd00::1"),
        ("example.com", ""),  # the CA is to vouch for no host of the Internet
        ("robots.example.com", ""),
        ("local", "local"),
        ("8.8.8.8", ""),
        ("2001:4860:4860::8888", ""),
        ("127.0.0.2", ""),  # each machine's own
        ("localhost", ""),
        ("0.0.0.0", ""),
        ("224.0.0.1", ""),
        ("*.local", ""),
        ("a b", ""),
        ("-a.local", ""),
        ("", ""),
    ],
)
def test_hosts_of_the_local_network_alone(wanted: str, given: str) -> None:
    assert page_hosts([wanted]) == ((given,) if given else ())


def test_hosts_are_bounded_and_without_repetition() -> None:
    many = [f"10.0.0.{number}" for number in range(100)]
    assert page_hosts(["a", "A", *many]) == ("a", *many)[: limits.PAGE_HOSTS_MAX]


def test_the_names_of_a_machine_and_of_a_module() -> None:
    assert host_names("Robot-1.lab.example") == ("robot-1.lab.example", "robot-1", "robot-1.local")
    assert server_names("robot_1") == ("robot-1", "robot-1.local", "localhost")
