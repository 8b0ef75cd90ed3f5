"""A member: what it shows, which other members it takes, and how newer documents reach it."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

from rmpa.runtime.tls import TlsHandshake

pytest.importorskip("cryptography")

from rmpa.core.errors import RemoteProtocolError, StartError
from rmpa.trust import limits
from rmpa.trust import store as files_of
from rmpa.trust.certificates import DenyList, KeyList, sign
from rmpa.trust.membership import Membership
from rmpa.trust.packets import GroupKey, Verdict
from rmpa.trust.permissions import Document, TrustError, TrustReason
from tests.trust.authority import WALL
from tests.trust.io.member_files import KEYS, SecuredMesh

if TYPE_CHECKING:
    import ssl
    from pathlib import Path

DAY = 86_400.0
PACKET = bytes(range(60))


@pytest.fixture
def mesh(tmp_path: Path) -> SecuredMesh:
    return SecuredMesh(tmp_path)


def judge(member: Membership, certificate: bytes | None, claimed: str | None) -> None:
    member.judge_member(member.read_member(certificate), claimed)


def reason_of(member: Membership, certificate: bytes | None, claimed: str | None) -> TrustReason:
    with pytest.raises(TrustError) as caught:
        judge(member, certificate, claimed)
    return caught.value.reason


def test_certificates_of_others_are_judged(mesh: SecuredMesh, tmp_path: Path) -> None:
    base = mesh.member("base")
    certificate = mesh.authority.module("arm")
    judge(base, certificate, "arm")
    judge(base, certificate, None)
    assert reason_of(base, certificate, "joystick") is TrustReason.NAME
    assert reason_of(base, SecuredMesh(tmp_path).authority.module("arm"), "arm") is TrustReason.FOREIGN
    assert reason_of(base, b"nonsense", None) is reason_of(base, None, None) is TrustReason.FOREIGN
    mesh.clock.wall_seconds = WALL + 8 * DAY
    assert reason_of(base, certificate, "arm") is TrustReason.EXPIRED
    late = mesh.authority.module("arm", WALL + 9 * DAY)
    assert reason_of(base, late, "arm") is TrustReason.CLOCK


def test_a_clock_is_set_if_it_is_behind_the_begin_of_the_own_certificate(mesh: SecuredMesh) -> None:
    base = mesh.member("base")
    begin = WALL - limits.CERTIFICATE_BACKDATE
    mesh.clock.wall_seconds = begin - 1
    assert base.wall() is None
    judge(base, mesh.authority.module("arm", WALL - 30 * DAY), "arm")  # its time cannot be judged
    mesh.clock.wall_seconds = begin + 1
    assert base.wall() == begin + 1
    assert reason_of(base, mesh.authority.module("arm", WALL - 30 * DAY), "arm") is TrustReason.EXPIRED


def test_a_newer_deny_list_holds_at_once_and_after_a_restart(mesh: SecuredMesh) -> None:
    base = mesh.member("base")
    called: list[int] = []
    base.on_denied.append(lambda: called.append(base.deny.number))
    certificate = mesh.authority.module("arm")
    newer = sign(DenyList().with_name("arm", WALL + 1), mesh.authority.key)
    assert base.accept_document(Document.DENY, newer)
    assert not base.accept_document(Document.DENY, newer)
    assert called == [1]
    assert base.document(Document.DENY) == newer
    assert reason_of(base, certificate, "arm") is TrustReason.REVOKED
    judge(base, mesh.authority.module("arm", WALL + 60), "arm")  # it was invited again
    again = Membership.load(base.store, mesh.clock)
    assert reason_of(again, certificate, "arm") is TrustReason.REVOKED
    mesh.clock.wall_seconds = 0.0
    assert reason_of(again, certificate, "arm") is TrustReason.REVOKED, "a clock that is set back lets none in again"


def test_a_document_of_another_authority_changes_nothing(mesh: SecuredMesh, tmp_path: Path) -> None:
    base, other = mesh.member("base"), SecuredMesh(tmp_path).authority
    with pytest.raises(RemoteProtocolError):
        base.accept_document(Document.DENY, sign(DenyList().with_name("arm", WALL), other.key))
    with pytest.raises(RemoteProtocolError):
        base.accept_document(Document.KEYS, sign(KEYS, other.key))
    assert (base.deny.number, base.keys.number) == (0, 1)


def test_a_new_group_key_is_taken_without_a_pause(mesh: SecuredMesh) -> None:
    base, arm = mesh.member("base"), mesh.member("arm")
    data = sign(KeyList(2, (*KEYS.keys, GroupKey(2, b"n" * 32))), mesh.authority.key)
    assert base.accept_document(Document.KEYS, data)

    def heard_by_arm() -> Verdict:
        now = mesh.clock.now()
        packet = base.packets.sign(PACKET, now)
        return arm.packets.verify(packet, (0, 8), now).verdict

    assert heard_by_arm() is Verdict.ACCEPTED  # the new key does not sign yet
    mesh.clock.seconds += limits.KEY_SPREAD
    assert heard_by_arm() is Verdict.UNKNOWN_KEY
    assert arm.accept_document(Document.KEYS, data)
    assert heard_by_arm() is Verdict.ACCEPTED
    assert Membership.load(arm.store, mesh.clock).ring.newest.number == 2


def test_a_member_that_restarts_during_a_rotation_goes_on_as_the_others(mesh: SecuredMesh) -> None:
    """The others sign with the key before for half a minute, and some have not heard of the new one."""
    base, arm = mesh.member("base"), mesh.member("arm")
    rotated = KeyList(2, (*KEYS.keys, GroupKey(2, b"n" * 32)), made=int(WALL))
    assert base.accept_document(Document.KEYS, sign(rotated, mesh.authority.key))
    mesh.clock.seconds += 10
    mesh.clock.wall_seconds = WALL + 10
    again = Membership.load(base.store, mesh.clock)

    def heard(sender: Membership, receiver: Membership) -> Verdict:
        now = mesh.clock.now()
        packet = sender.packets.sign(PACKET, now)
        return receiver.packets.verify(packet, (0, 8), now).verdict

    assert heard(again, arm) is heard(arm, again) is Verdict.ACCEPTED
    mesh.clock.seconds += 21
    assert again.ring.signing(mesh.clock.now()).number == 2
    assert heard(arm, again) is Verdict.ACCEPTED


def test_after_a_revocation_the_key_before_recognises_alone_also_after_a_restart(mesh: SecuredMesh) -> None:
    base, revoked = mesh.member("base"), mesh.member("eve")
    keys = [*KEYS.keys, GroupKey(2, b"n" * 32)]
    for number, made in enumerate((keys, [*keys, GroupKey(3, b"o" * 32)]), 2):  # a rotation of the usual kind follows
        listed = KeyList(number, tuple(made), proves_from=2, made=int(WALL))
        assert base.accept_document(Document.KEYS, sign(listed, mesh.authority.key))
        for member in (base, Membership.load(base.store, mesh.clock)):
            now = mesh.clock.now()
            packet = revoked.packets.sign(PACKET, now)
            heard = member.packets.verify(packet, (0, 8), now)
            assert heard.verdict is Verdict.OLD_KEY
            assert member.ring.signing(now).number == 2, "a key of a revocation signs at once"


def test_a_renewed_certificate_is_used_and_kept(mesh: SecuredMesh) -> None:
    from rmpa.trust.certificates import CertificateRequest, issue

    base = mesh.member("base")
    before = base.server_context
    request = CertificateRequest("base", base.certificate.public_key)
    mesh.clock.wall_seconds = WALL + 4 * DAY
    newer = issue(request, mesh.authority.certificate, mesh.authority.key, 77, WALL + 4 * DAY)
    base.renewed(newer)
    assert base.certificate.expires == WALL + 11 * DAY
    assert base.server_context is not before
    assert Membership.load(base.store, mesh.clock).certificate.serial == 77
    with pytest.raises(TrustError, match="of another key"):
        base.renewed(mesh.authority.module("base", WALL + 4 * DAY))
    with pytest.raises(TrustError, match="of arm, not of base"):
        base.renewed(mesh.authority.module("arm", WALL + 4 * DAY))


@pytest.mark.parametrize(
    ("name", "content", "words"),
    [
        (files_of.KEYS, b"{}", "keys.json: is broken"),
        (files_of.DENY, b"{}", "deny.json: is broken"),
        (files_of.KEY, b"no key", "module.crt: does not fit module.key"),
    ],
)
def test_broken_files_are_named(mesh: SecuredMesh, name: str, content: bytes, words: str) -> None:
    store = mesh.save("base")
    store.write(name, content)
    with pytest.raises(StartError, match=words):
        Membership.load(store, mesh.clock)


def test_files_of_two_meshes_do_not_fit(mesh: SecuredMesh, tmp_path: Path) -> None:
    store, other = mesh.save("base"), SecuredMesh(tmp_path / "other").save("base")
    store.write(files_of.CA, other.path(files_of.CA).read_bytes())
    with pytest.raises(StartError, match=r"module\.crt: is broken: the certificate is of another CA"):
        Membership.load(store, mesh.clock)


def test_no_secret_is_in_a_repr(mesh: SecuredMesh) -> None:
    base = mesh.member("base")
    assert repr(base) == "Membership('base', deny=0, keys=1)"
    assert "PRIVATE" not in repr(base.files) + repr(base.ring)
    assert "kkkk" not in repr(base.ring) + repr(base.files)


def shake(dialler: Membership, acceptor: Membership) -> tuple[ssl.SSLObject, ssl.SSLObject]:
    """Both ends of a TLS connection; an error of either end is raised."""
    ends = (
        TlsHandshake(dialler.client_context, server_side=False),
        TlsHandshake(acceptor.server_context, server_side=True),
    )
    client, server = ends
    client.receive(b"")
    while not (client.done and server.done):
        server.receive(client.take_output())
        client.receive(server.take_output())
    return client.tls, server.tls


def test_two_members_link_and_know_each_other_by_name(mesh: SecuredMesh) -> None:
    arm, base = mesh.member("arm"), mesh.member("base")
    # OpenSSL judges times by this machine's clock; the test's certificates are of another year.
    mesh.clock.wall_seconds = 0.0
    at_arm, at_base = shake(arm, base)
    mesh.clock.wall_seconds = WALL
    assert at_arm.version() == "TLSv1.3"
    assert at_arm.selected_alpn_protocol() == at_base.selected_alpn_protocol() == "rmpa/1"
    judge(arm, at_arm.getpeercert(binary_form=True), "base")
    judge(base, at_base.getpeercert(binary_form=True), "arm")
    assert reason_of(base, at_base.getpeercert(binary_form=True), "joystick") is TrustReason.NAME
