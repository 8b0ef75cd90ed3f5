"""Joins and renewals over real sockets, with the authority behind an acceptor as small as can be."""

from __future__ import annotations

import asyncio
import socket
from contextlib import asynccontextmanager
from dataclasses import dataclass, field, replace
from ipaddress import IPv4Address
from typing import TYPE_CHECKING

import pytest

pytest.importorskip("cryptography")

from rmpa.core.errors import (
    ConfigError,
    PeerRefused,
    RemoteProtocolError,
    StartError,
    UnreachableError,
)
from rmpa.core.identity import Guid, Identity
from rmpa.core.statistics import Counters
from rmpa.mesh import limits as mesh_limits
from rmpa.mesh.io.link import LinkHandlers
from rmpa.mesh.io.mesh import Mesh
from rmpa.trust import limits
from rmpa.trust import store as files_of
from rmpa.trust.certificates import DenyList, make_request, read_certificate
from rmpa.trust.joining import JoinServer, join_mesh, renew_at_authority
from rmpa.trust.membership import (
    Membership,
    MeshAuthority,
    found_mesh,
    new_key,
    private_key,
    request_der,
    request_pem,
)
from rmpa.trust.permissions import TrustError
from rmpa.trust.store import ALPN_JOIN, MemberFiles, TrustStore, join_context, member_context
from rmpa.trust.tokens import CertificateGrant, Invitation, Join, JoinRefused, Renew, Token, encode_message, proof_of
from tests.trust.authority import WALL
from tests.trust.io.member_files import HandClock

if TYPE_CHECKING:
    from collections.abc import AsyncIterator
    from pathlib import Path


DEADLINE = 30.0
DAY = 86_400.0


@dataclass
class Lab:
    """A mesh that was founded by ``base``, and its port."""

    folder: Path
    clock: HandClock = field(default_factory=HandClock)
    port: int = 0
    taken: set[str] = field(default_factory=set)

    def __post_init__(self) -> None:
        self.store = TrustStore(self.folder, "base")
        found_mesh(self.store, "base", "lab", WALL)
        self.base = Membership.load(self.store, self.clock)
        self.authority = MeshAuthority(self.base, self.taken.__contains__)
        self.server = JoinServer(self.authority, self.clock, Counters())

    def invite(self, name: str = "", *, lifetime: float = 900.0) -> Token:
        return self.authority.invite(IPv4Address("127.0.0.1"), self.port, lifetime, name)

    async def join(self, token: Token, name: str = "arm") -> MemberFiles:
        return await join_mesh(token, name)

    def member(self, files: MemberFiles, name: str = "arm") -> Membership:
        store = TrustStore(self.folder, name)
        store.save(files)
        return Membership.load(store, self.clock)


@asynccontextmanager
async def running(lab: Lab) -> AsyncIterator[Lab]:
    """The authority's port, as its mesh has it."""
    listener = socket.create_server(("127.0.0.1", 0))
    lab.port = listener.getsockname()[1]
    identity = Identity(Guid.of("127.0.0.1", lab.port, 1), b"b" * 16, "base")
    nothing = LinkHandlers(*[lambda *_: None] * 6)
    mesh = Mesh(identity, listener, nothing, security=lab.base, on_join=lab.server.serve)
    await mesh.start()
    try:
        async with asyncio.timeout(DEADLINE):
            yield lab
    finally:
        await mesh.close()


@pytest.fixture
def lab(tmp_path: Path) -> Lab:
    return Lab(tmp_path)


async def test_a_module_joins_with_its_token(lab: Lab) -> None:
    async with running(lab):
        token = lab.invite()
        assert lab.server.step(token.token_id).state == "waiting"
        arm = lab.member(await lab.join(token))
    assert arm.name == "arm"
    lab.base.judge_member(lab.base.read_member(arm.files.certificate), "arm")
    arm.judge_member(arm.read_member(lab.base.files.certificate), "base")
    step = lab.server.step(token.token_id)
    assert (step.step, step.state, step.module) == (1, "joined", "arm")
    assert [each.name for each in lab.authority.issued] == ["arm", "base"]
    assert arm.ring.newest == lab.base.ring.newest


async def test_a_token_lets_one_module_join_also_after_a_restart(lab: Lab) -> None:
    async with running(lab):
        token = lab.invite()
        await lab.join(token)
        with pytest.raises(PeerRefused, match=r"\(used\); each token lets one module join; ask for a new one"):
            await lab.join(token, "gripper")
    [kept] = lab.store.load_tokens()
    assert (kept.used_by, kept.key) == ("arm", b"")


async def test_a_token_is_used_before_a_certificate_is_issued(lab: Lab, monkeypatch: pytest.MonkeyPatch) -> None:
    """Also if the certificate cannot be written: a crash in between lets none join twice."""

    def full(_: object) -> None:
        raise StartError("issued.json", "cannot be written: No space left on device")

    monkeypatch.setattr(lab.store, "save_issued", full)
    async with running(lab):
        token = lab.invite()
        with pytest.raises(PeerRefused, match=r"No space left on device \(authority\)"):
            await lab.join(token)
        with pytest.raises(PeerRefused, match=r"\(used\)"):
            await lab.join(token)
    assert lab.store.load_tokens()[0].used_by == "arm"


async def test_a_request_that_is_not_of_the_tokens_holder_lets_nothing_join(lab: Lab) -> None:
    """It knows the token's id, or has overheard a whole question, which is for the server's certificate alone."""
    thief = make_request(private_key(new_key(), files_of.KEY), "thief")
    async with running(lab):
        token = lab.invite()
        for key, server in ((b"x" * 32, lab.base.files.certificate), (token.key, b"another")):
            answer = lab.server.answer(Join(token.token_id, thief, proof_of(key, thief, server)), None, "10.0.0.9")
            assert answer == JoinRefused("token", "the request is not signed with the token's key")
        assert lab.server.step(token.token_id).state == "refused"
        assert [each.name for each in lab.authority.issued] == ["base"]
        await lab.join(token)  # its holder still can


async def test_of_two_modules_with_one_token_or_one_name_one_becomes_a_member(lab: Lab) -> None:
    async with running(lab):
        token = lab.invite()
        found = await asyncio.gather(*(lab.join(token, name) for name in ("arm", "leg")), return_exceptions=True)
        assert sum(isinstance(each, MemberFiles) for each in found) == 1
        found = await asyncio.gather(
            *(lab.join(lab.invite(), name) for name in ("crane", "Crane")), return_exceptions=True
        )
        assert sum(isinstance(each, MemberFiles) for each in found) == 1
        assert len(lab.authority.issued) == 3


async def test_who_cannot_join_is_told_why(lab: Lab) -> None:
    async with running(lab):
        lab.taken.add("gripper")
        with pytest.raises(PeerRefused, match="a module named gripper is a member"):
            await lab.join(lab.invite(), "gripper")
        with pytest.raises(PeerRefused, match=r"\(name\); join with the --name that it is for"):
            await lab.join(lab.invite("wrist"))
        late = lab.invite(lifetime=60.0)
        lab.clock.wall_seconds += 61
        with pytest.raises(PeerRefused, match=r"\(late\)"):
            await lab.join(late)
        lab.clock.wall_seconds -= 61
        withdrawn = lab.invite()
        assert lab.authority.withdraw(withdrawn.token_id)
        with pytest.raises(PeerRefused, match=r"\(token\)"):
            await lab.join(withdrawn)


async def test_another_authority_at_the_address_is_not_joined(lab: Lab, tmp_path: Path) -> None:
    other = Lab(tmp_path / "other")
    async with running(lab), running(other):
        token = lab.invite()
        forged = replace(token, port=other.port)  # as something in the middle that has stolen the token has it
        other.authority.invitations[forged.token_id] = Invitation(forged.token_id, forged.key, forged.expires)
        with pytest.raises(PeerRefused, match="does not have the fingerprint of the token"):
            await lab.join(forged)


async def test_what_is_no_authority_is_named(lab: Lab) -> None:
    async with running(lab):
        token = lab.invite()
    with pytest.raises(UnreachableError, match=r"no authority answers at 127\.0\.0\.1"):
        await lab.join(token)

    async def answer(_: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        writer.write(b"SSH-2.0\r\n")
        writer.close()

    server = await asyncio.start_server(answer, "127.0.0.1", 0)
    async with server:
        with pytest.raises(RemoteProtocolError, match="not an agent of a secured mesh"):
            await lab.join(replace(token, port=server.sockets[0].getsockname()[1]))


async def test_a_module_that_was_in_a_drawer_asks_again_with_its_key(lab: Lab) -> None:
    async with running(lab):
        arm = lab.member(await lab.join(lab.invite()))
        lab.clock.wall_seconds += 30 * DAY
        lab.authority.renew_own()
        lab.authority.rotate()
        await renew_at_authority(arm, "127.0.0.1", lab.port)
        lab.base.judge_member(lab.base.read_member(arm.files.certificate), "arm")
        assert arm.ring.newest == lab.base.ring.newest


async def test_a_member_cannot_renew_in_the_authoritys_place(lab: Lab) -> None:
    async with running(lab):
        arm = lab.member(await lab.join(lab.invite()))
        thief = lab.member(await lab.join(lab.invite(), "thief"), "thief")
    received: list[bytes] = []

    async def pretend(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        received.append(await reader.read())
        writer.close()

    files = thief.store.path(files_of.CERTIFICATE), thief.store.path(files_of.KEY)
    context = member_context(*files, thief.files.ca, ALPN_JOIN, server_side=True)
    async with asyncio.timeout(DEADLINE), await asyncio.start_server(pretend, "127.0.0.1", 0, ssl=context) as server:
        with pytest.raises(RemoteProtocolError, match="is thief, not the authority"):
            await renew_at_authority(arm, "127.0.0.1", server.sockets[0].getsockname()[1])
        while not received:
            await asyncio.sleep(0)
    assert received == [b""]  # it was not even asked


async def test_a_member_that_is_not_the_authority_says_so(lab: Lab) -> None:
    async with running(lab):
        arm = lab.member(await lab.join(lab.invite()))
    lab.base = arm
    async with running(lab):
        with pytest.raises(RemoteProtocolError, match="is not the authority of its mesh"):
            await lab.join(lab.invite(), "leg")


async def test_a_revoked_module_and_one_away_too_long_get_nothing(lab: Lab) -> None:
    async with running(lab):
        arm = lab.member(await lab.join(lab.invite()))
        lab.clock.wall_seconds += 400 * DAY
        with pytest.raises(PeerRefused, match=r"ended .* \(expired\); join again with a new token"):
            await renew_at_authority(arm, "127.0.0.1", lab.port)
        lab.clock.wall_seconds -= 399 * DAY
        lab.authority.revoke("arm")
        with pytest.raises(PeerRefused, match=r"\(revoked\)"):
            await renew_at_authority(arm, "127.0.0.1", lab.port)


@pytest.mark.parametrize("again", [False, True])
async def test_a_revocation_holds_also_if_the_clock_went_back(lab: Lab, again: bool) -> None:
    async with running(lab):
        lab.clock.wall_seconds += DAY
        if again:
            await lab.join(lab.invite())
            lab.authority.revoke("arm")
        arm = lab.member(await lab.join(lab.invite()))
        lab.clock.wall_seconds -= DAY / 2
        lab.authority.revoke("arm")
        lab.clock.wall_seconds += DAY / 2
        with pytest.raises(TrustError, match="arm was revoked"):
            lab.base.judge_member(lab.base.read_member(arm.files.certificate), "arm")


async def test_the_deny_list_names_the_members_while_a_revoked_certificate_may_be_valid(lab: Lab) -> None:
    async with running(lab):
        await lab.join(lab.invite())
        await lab.join(lab.invite(), "leg")
        assert lab.base.deny == DenyList(), "nothing was revoked"
        assert lab.authority.revoke("leg").members == ("arm", "base")
        joined = lab.member(await lab.join(lab.invite(), "hand"), "hand")
        assert joined.deny == lab.base.deny, "the newcomer has the list with its own name"
        assert (joined.deny.number, joined.deny.members) == (2, ("arm", "base", "hand"))
        await renew_at_authority(joined, "127.0.0.1", lab.port)
        assert lab.base.deny.number == 2, "a renewal changes no name"
        lab.clock.wall_seconds += 8 * DAY
        await lab.join(lab.invite(), "foot")
        assert lab.base.deny.number == 2, "what was revoked has ended"


def test_a_new_token_for_a_name_replaces_the_open_one(lab: Lab) -> None:
    lab.port = 1
    _, second, other = lab.invite("arm"), lab.invite("arm"), lab.invite()
    assert list(lab.authority.invitations) == [second.token_id, other.token_id]
    with pytest.raises(ValueError, match="not a ROS base name"):
        lab.invite("my arm")


def test_tokens_are_bounded_and_used_ones_go_first(lab: Lab, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(limits, "TOKENS_MAX", 3)
    lab.port = 1
    first, used, last = (lab.invite(lifetime=seconds) for seconds in (1.0, 2.0, 3.0))
    lab.authority.invitations[used.token_id].used_by = "arm"
    fourth = lab.invite()
    assert list(lab.authority.invitations) == [first.token_id, last.token_id, fourth.token_id]
    fifth = lab.invite()
    assert list(lab.authority.invitations) == [last.token_id, fourth.token_id, fifth.token_id]


async def test_revoking_ends_invitations_of_that_name(lab: Lab) -> None:
    async with running(lab):
        named, other = lab.invite("arm"), lab.invite("leg")
        lab.authority.revoke("arm")
        with pytest.raises(PeerRefused, match=r"\(token\)"):
            await lab.join(named)
        assert [each.token_id for each in lab.store.load_tokens()] == [other.token_id]
        assert [each.name for each in lab.authority.issued] == ["base"]


def test_a_full_disk_does_not_stop_a_revocation_half_way(lab: Lab, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(name: str, _data: bytes) -> None:
        raise StartError(name, "cannot be written: No space left on device", "is the disk full?")

    monkeypatch.setattr(lab.store, "write", full)
    assert lab.authority.revoke("arm").number == 1
    assert (lab.base.deny.number, lab.base.keys.number) == (1, 2)


async def test_the_name_of_an_absent_member_is_not_given_to_another(lab: Lab) -> None:
    async with running(lab):
        await lab.join(lab.invite())
        for token, name in ((lab.invite(), "arm"), (lab.invite(), "ARM"), (lab.invite("ARM"), "ARM")):
            with pytest.raises(PeerRefused, match=r"is a member.*\(taken\); .*rmpa trust invite --module NAME"):
                await lab.join(token, name)
        await lab.join(lab.invite("arm"))  # the user means this one
        lab.clock.wall_seconds += 8 * DAY
        await lab.join(lab.invite())  # its certificate has ended


@pytest.mark.parametrize("away", [0, 8 * DAY])
async def test_a_module_whose_name_another_one_has_by_now_renews_no_certificate(
    lab: Lab, away: float, caplog: pytest.LogCaptureFixture
) -> None:
    """Else two modules would have one name: its successor, and one that was in a drawer, or stolen."""
    async with running(lab):
        old = lab.member(await lab.join(lab.invite()))
        lab.clock.wall_seconds += away
        lab.authority.renew_own()
        new = lab.member(await lab.join(lab.invite("arm")), "successor")
        for _ in range(4):
            with pytest.raises(PeerRefused, match=r"another module has joined as arm.*\(revoked\); join again"):
                await renew_at_authority(old, "127.0.0.1", lab.port)
        assert sum("refused a renewal by" in text for text in caplog.messages) == 1, "it does not fill the log"
        again = MeshAuthority(lab.base)
        with pytest.raises(TrustError, match="another module has joined as arm"):
            again.issue(old.request(), "arm")
        await renew_at_authority(new, "127.0.0.1", lab.port)


@pytest.mark.parametrize("wall", [0.0, WALL - 3 * DAY, WALL + 3 * DAY])
async def test_a_module_joins_whatever_its_clock_shows(lab: Lab, wall: float) -> None:
    """A robot without a battery for its clock has the time of its last shutdown, or 1970."""
    async with running(lab):
        clock = HandClock(wall_seconds=wall)
        files = await lab.join(lab.invite())
    store = TrustStore(lab.folder, "arm")
    store.save(files)
    arm = Membership.load(store, clock)
    assert (arm.wall() is None) == (wall < WALL)
    if arm.wall() is None:
        arm.judge_member(arm.read_member(lab.base.files.certificate), "base")


async def test_the_text_of_a_refused_renewal_is_safe_to_show(lab: Lab, monkeypatch: pytest.MonkeyPatch) -> None:
    async with running(lab):
        arm = lab.member(await lab.join(lab.invite()))
        refusal = JoinRefused("a\nb", "\x1b[2Jgone\nnext")
        monkeypatch.setattr(lab.server, "answer", lambda *_: refusal)
        with pytest.raises(PeerRefused) as caught:
            await renew_at_authority(arm, "127.0.0.1", lab.port)
        assert str(caught.value).isprintable()


async def test_idle_connections_leave_room_for_joins(lab: Lab) -> None:
    """They do the handshake of a join, and ask nothing."""
    async with running(lab):
        idle = [
            await asyncio.open_connection("127.0.0.1", lab.port, ssl=join_context())
            for _ in range(mesh_limits.PENDING_PER_ADDRESS + 4)
        ]
        assert await idle[0][0].read() == b"", "the oldest one is closed"
        arm = lab.member(await lab.join(lab.invite()))
        await renew_at_authority(arm, "127.0.0.1", lab.port)
        for _, writer in idle:
            writer.close()


@pytest.mark.parametrize(
    "question",
    [
        b"\xff\xff\xff\xff",
        b"\0\0\0\x02{}",
        encode_message(Renew(b"csr")),
        encode_message(CertificateGrant(b"", b"", b"")),
    ],
)
async def test_what_is_no_question_is_closed_without_an_answer(lab: Lab, question: bytes) -> None:
    async with running(lab):
        reader, writer = await asyncio.open_connection("127.0.0.1", lab.port, ssl=join_context())
        writer.write(question)
        assert await reader.read() == b""
        writer.close()


def test_a_join_by_files(lab: Lab) -> None:
    key = private_key(lab.base.files.key, "module.key")
    request = make_request(key, "arm")
    assert request_der(request_pem(request)) == request
    asked, answer = lab.authority.join_file(request)
    assert asked.name == "arm"
    assert read_certificate(answer.certificate, answer.ca).name == "arm"
    assert "kkkk" not in repr(answer)
    with pytest.raises(ConfigError, match=r"a module named arm is a member.*: --module arm; else rmpa trust revoke"):
        lab.authority.join_file(request)
    assert lab.authority.join_file(request, "arm")[0].name == "arm"
    with pytest.raises(ValueError, match="BEGIN CERTIFICATE REQUEST"):
        request_der(b"hello")


def test_a_mesh_is_not_founded_by_a_clock_that_is_not_set(tmp_path: Path) -> None:
    with pytest.raises(StartError, match="clock of this machine: is not set"):
        found_mesh(TrustStore(tmp_path, "base"), "base", "lab", 0.0)
    assert not TrustStore(tmp_path, "base").exists


def test_the_key_of_another_ca_is_an_error_of_the_start(lab: Lab, tmp_path: Path) -> None:
    other = Lab(tmp_path / "other")
    lab.store.write(files_of.CA_KEY, other.store.load_ca_key())
    with pytest.raises(StartError, match=r"ca\.key: is not the key of ca\.crt"):
        MeshAuthority(lab.base)
