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
    LocalProtocolError,
    PeerRefused,
    RemoteProtocolError,
    StartError,
    UnreachableError,
)
from rmpa.trust import certificates, limits
from rmpa.trust.certificates import CertificateError, make_request
from rmpa.trust.documents import DocumentKind
from rmpa.trust.io import store as files_of
from rmpa.trust.io.authority import MeshAuthority, found_mesh, request_der, request_pem
from rmpa.trust.io.join_connection import JoinConnection, join_client_context, renewal_context
from rmpa.trust.io.join_server import JoinServer, JoinState
from rmpa.trust.io.joining import join_mesh, renew_at_authority
from rmpa.trust.io.membership import Membership
from rmpa.trust.io.private_keys import new_key, private_key
from rmpa.trust.io.store import MemberFiles, TrustStore
from rmpa.trust.join import JoiningSide, JoinRefused
from rmpa.trust.preface import PREFACE_BYTES, Preface, PrefaceError, Purpose
from rmpa.trust.renewal import RenewalRefused
from tests.trust.authority import WALL
from tests.trust.io.member_files import HandClock

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Awaitable, Callable
    from pathlib import Path

    from rmpa.trust.tokens import Token

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
        self.base = Membership.load(self.store, self.clock, self.clock.wall)
        self.authority = MeshAuthority.load(self.store, self.base)
        self.server = JoinServer(self.authority, self.base, self.clock, self.taken.__contains__)

    def invite(self, name: str = "", *, unattended: bool = False, lifetime: float = 900.0) -> Token:
        address = IPv4Address("127.0.0.1")
        return self.authority.invite(address, self.port, lifetime, name, unattended=unattended)

    async def join(
        self,
        token: Token,
        name: str = "arm",
        *,
        agree: bool = True,
        compare: Callable[[str], Awaitable[bool]] | None = None,
    ) -> MemberFiles:
        async def say(_code: str) -> bool:
            return agree

        def read_refusal(answer: bytes) -> tuple[str, str] | None:
            return ("key", answer[6:].decode()) if answer.startswith(b"plain ") else None

        return await join_mesh(token, name, self.clock, compare or say, read_refusal)

    def member(self, files: MemberFiles, name: str = "arm") -> Membership:
        store = TrustStore(self.folder, name)
        store.save(files)
        return Membership.load(store, self.clock, self.clock.wall)

    async def accept(self, sock: socket.socket) -> None:
        """As the mesh does: read the preface, judge it, and hand the socket on."""
        preface = b""
        while len(preface) < PREFACE_BYTES:
            preface += await asyncio.get_running_loop().sock_recv(sock, PREFACE_BYTES - len(preface))
        try:
            found, _ = self.base.guard.admit(preface, self.clock.now(), self.base.wall())
        except PrefaceError as error:
            sock.sendall(b"plain " + str(error).encode())
            sock.close()
            return
        self.server.accept(sock, found)

    async def serve(self, listener: socket.socket) -> None:
        while True:
            sock, _ = await asyncio.get_running_loop().sock_accept(listener)
            await self.accept(sock)


@asynccontextmanager
async def running(lab: Lab) -> AsyncIterator[Lab]:
    with socket.create_server(("127.0.0.1", 0)) as listener:
        lab.port = listener.getsockname()[1]
        listener.setblocking(False)
        serving = asyncio.ensure_future(lab.serve(listener))
        try:
            async with asyncio.timeout(DEADLINE):
                yield lab
        finally:
            serving.cancel()
            await asyncio.gather(serving, return_exceptions=True)
            await lab.server.close()


@pytest.fixture
def lab(tmp_path: Path) -> Lab:
    return Lab(tmp_path)


async def code_shown(lab: Lab, token: Token) -> str:
    progress = lab.server.progress(token.token_id)
    while progress.state is JoinState.WAITING:
        await progress.changed.wait()
    return progress.code


async def test_a_module_joins_when_both_users_see_one_code(lab: Lab) -> None:
    async with running(lab):
        token = lab.invite()
        shown: asyncio.Future[str] = asyncio.get_running_loop().create_future()

        async def compare(code: str) -> bool:
            shown.set_result(code)
            return True

        joining = asyncio.ensure_future(lab.join(token, compare=compare))
        there, here = await shown, await code_shown(lab, token)
        assert there == here
        assert len(here) == 6
        assert not joining.done()
        lab.server.answer(token.token_id, agree=True)
        arm = lab.member(await joining)
    assert arm.name == "arm"
    lab.base.judge_member(arm.files.certificate, "arm")
    arm.judge_member(lab.base.files.certificate, "base")
    assert lab.server.progress(token.token_id).state is JoinState.JOINED
    assert [each.name for each in lab.authority.issued] == ["arm", "base"]
    assert arm.ring.newest == lab.base.ring.newest


async def test_a_token_lets_one_module_join_also_after_a_restart(lab: Lab) -> None:
    async with running(lab):
        token = lab.invite(unattended=True)
        await lab.join(token)
        with pytest.raises(PeerRefused, match=r"was used, or has ended \(token\); ask for a new one"):
            await lab.join(token, "gripper")
    assert lab.store.load_tokens().key_of(token.token_id) is None


async def test_a_used_token_stays_used_if_the_join_fails_afterwards(lab: Lab) -> None:
    async with running(lab):
        token = lab.invite(unattended=True)
        with pytest.raises(PeerRefused, match="a user says that the codes differ"):
            await lab.join(token, agree=False)
        assert [each.name for each in lab.authority.issued] == ["base"]
        with pytest.raises(PeerRefused):
            await lab.join(token)


async def test_a_preface_that_was_held_back_lets_nothing_else_join(lab: Lab) -> None:
    async with running(lab):
        token = lab.invite(unattended=True)
        stolen = Preface(Purpose.JOIN, 0, lab.clock.wall_ns() // 1_000_000, b"n" * 16, token.token_id)
        with socket.create_connection(("127.0.0.1", lab.port)) as sock:
            sock.setblocking(False)
            await asyncio.get_running_loop().sock_sendall(sock, stolen.serialize(token.key))
            connection = JoinConnection(sock, join_client_context(), server_side=False)
            await connection.handshake()
            request = make_request(private_key(new_key(), files_of.KEY), "thief")
            guessed = replace(token, secret=b"x" * 16)
            side = JoiningSide("thief", request, guessed, connection.certificate(), b"j" * 32, lab.clock.now())
            while not side.over:
                side.receive(await connection.receive(), None)
                await connection.send(side.take_output())
        end = side.events()[-1]
        assert isinstance(end, JoinRefused)
        assert end.reason == "token"
        assert [each.name for each in lab.authority.issued] == ["base"]
        await lab.join(token)  # its holder still can


async def test_a_preface_that_was_recorded_does_not_keep_the_tokens_holder_out(lab: Lab) -> None:
    """It has no time, so it can be sent again once its nonce is forgotten; a join that has begun goes on."""
    async with running(lab):
        token = lab.invite()
        recorded = Preface(Purpose.JOIN, 0, 0, b"n" * 16, token.token_id).serialize(token.key)
        loop = asyncio.get_running_loop()
        with socket.create_connection(("127.0.0.1", lab.port)) as sock:
            sock.setblocking(False)
            await loop.sock_sendall(sock, recorded)
            connection = JoinConnection(sock, join_client_context(), server_side=False)
            await connection.handshake()  # and nothing behind it
            joining = asyncio.ensure_future(lab.join(token))
            await code_shown(lab, token)
        lab.clock.seconds += limits.NONCE_KEPT + 1
        with socket.create_connection(("127.0.0.1", lab.port)) as sock:
            sock.setblocking(False)
            await loop.sock_sendall(sock, recorded)
            assert not (await loop.sock_recv(sock, 100)).startswith(b"\x16"), "no TLS: the join goes on"
        ours, theirs = socket.socketpair()
        lab.server.accept(ours, Preface(Purpose.RENEWAL, 1, 0, b"m" * 16, token.token_id))  # a member's
        theirs.close()
        lab.server.answer(token.token_id, agree=True)
        assert lab.member(await joining).name == "arm"


async def test_the_authoritys_user_may_refuse(lab: Lab) -> None:
    async with running(lab):
        token = lab.invite()
        joining = asyncio.ensure_future(lab.join(token))
        await code_shown(lab, token)
        lab.server.answer(token.token_id, agree=False)
        with pytest.raises(PeerRefused, match=r"codes differ.* \(code\); begin again with a new token"):
            await joining
        with pytest.raises(LocalProtocolError, match="no module is joining"):
            lab.server.answer(token.token_id, agree=True)


async def test_who_cannot_join_is_told_why(lab: Lab) -> None:
    async with running(lab):
        lab.taken.add("gripper")
        with pytest.raises(PeerRefused, match="a module named gripper is a member"):
            await lab.join(lab.invite(unattended=True), "gripper")
        with pytest.raises(PeerRefused, match=r"\(name\); join with the --name that it is for"):
            await lab.join(lab.invite("wrist", unattended=True))
        late = lab.invite(unattended=True, lifetime=60.0)
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
        token = lab.invite(unattended=True)
        # It has the token's key, as something in the middle that has stolen the token would.
        stolen = other.invite(unattended=True)
        other.authority.book.find(stolen.token_id)
        forged = replace(token, port=other.port)
        other.authority.book.invite(forged, unattended=True)
        with pytest.raises(PeerRefused, match="does not have the fingerprint of the token"):
            await lab.join(forged)


async def test_what_is_no_authority_is_named(lab: Lab) -> None:
    async with running(lab):
        token = lab.invite(unattended=True)
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
        arm = lab.member(await lab.join(lab.invite(unattended=True)))
        lab.clock.wall_seconds += 30 * DAY
        lab.authority.renew_own()
        lab.authority.rotate()
        grant = await renew_at_authority(arm, "127.0.0.1", lab.port)
        arm.renewed(grant.certificate)
        assert arm.accept_document(DocumentKind.KEYS, grant.keys)
        lab.base.judge_member(arm.files.certificate, "arm")
        assert arm.ring.newest == lab.base.ring.newest


async def test_a_member_cannot_renew_in_the_authoritys_place(lab: Lab) -> None:
    async with running(lab):
        arm = lab.member(await lab.join(lab.invite(unattended=True)))
        thief = lab.member(await lab.join(lab.invite(unattended=True), "thief"), "thief")
    received: list[bytes] = []

    async def pretend(listener: socket.socket) -> None:
        loop = asyncio.get_running_loop()
        sock, _ = await loop.sock_accept(listener)
        await loop.sock_recv(sock, PREFACE_BYTES)
        files = thief.store.path(files_of.CERTIFICATE), thief.store.path(files_of.KEY)
        connection = JoinConnection(sock, renewal_context(*files, thief.files.ca, server_side=True), server_side=True)
        await connection.handshake()
        received.append(await connection.receive())
        connection.close()

    with socket.create_server(("127.0.0.1", 0)) as listener:
        listener.setblocking(False)
        pretending = asyncio.ensure_future(pretend(listener))
        async with asyncio.timeout(DEADLINE):
            with pytest.raises(RemoteProtocolError, match="is thief, not the authority"):
                await renew_at_authority(arm, "127.0.0.1", listener.getsockname()[1])
            await pretending
    assert received == [b""]  # it was not even asked


async def test_a_revoked_module_and_one_away_too_long_get_nothing(lab: Lab) -> None:
    async with running(lab):
        arm = lab.member(await lab.join(lab.invite(unattended=True)))
        lab.clock.wall_seconds += 400 * DAY
        with pytest.raises(PeerRefused, match=r"ended .* \(expired\); join again with a new token"):
            await renew_at_authority(arm, "127.0.0.1", lab.port)
        lab.clock.wall_seconds -= 399 * DAY
        lab.authority.revoke("arm")
        with pytest.raises(PeerRefused, match=r"\(revoked\)"):
            await renew_at_authority(arm, "127.0.0.1", lab.port)


async def test_a_revoked_name_can_be_invited_again_at_once(lab: Lab) -> None:
    async with running(lab):
        before = lab.member(await lab.join(lab.invite(unattended=True)))
        lab.authority.revoke("arm")
        with pytest.raises(CertificateError, match="arm was revoked"):
            lab.base.judge_member(before.files.certificate, "arm")
        again = lab.member(await lab.join(lab.invite(unattended=True)))
        lab.base.judge_member(again.files.certificate, "arm")


@pytest.mark.parametrize("again", [False, True])
async def test_a_revocation_holds_also_if_the_clock_went_back(lab: Lab, again: bool) -> None:
    async with running(lab):
        lab.clock.wall_seconds += DAY
        if again:
            await lab.join(lab.invite(unattended=True))
            lab.authority.revoke("arm")
        arm = lab.member(await lab.join(lab.invite(unattended=True)))
        lab.clock.wall_seconds -= DAY / 2
        lab.authority.revoke("arm")
        lab.clock.wall_seconds += DAY / 2
        with pytest.raises(CertificateError, match="arm was revoked"):
            lab.base.judge_member(arm.files.certificate, "arm")


async def test_revoking_ends_invitations_and_joins_of_that_name(lab: Lab) -> None:
    async with running(lab):
        named, other, used = lab.invite("arm"), lab.invite("leg"), lab.invite()
        joining = asyncio.ensure_future(lab.join(used))
        await code_shown(lab, used)
        lab.authority.revoke("arm")
        with pytest.raises(PeerRefused, match=r"\(revoked\)"):
            await joining
        with pytest.raises(PeerRefused, match=r"\(token\)"):
            await lab.join(named)
        assert lab.authority.book.find(other.token_id) is not None
        assert lab.store.load_tokens().find(named.token_id) is None
        assert [each.name for each in lab.authority.issued] == ["base"]


def test_a_full_disk_does_not_stop_a_revocation_half_way(lab: Lab, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(name: str, _data: bytes) -> None:
        raise StartError(name, "cannot be written: No space left on device", "is the disk full?")

    monkeypatch.setattr(lab.store, "write", full)
    lab.base.save = full
    assert lab.authority.revoke("arm").number == 1
    assert lab.base.numbers == {DocumentKind.DENY: 1, DocumentKind.KEYS: 2}


async def test_the_name_of_an_absent_member_is_not_given_to_another(lab: Lab) -> None:
    async with running(lab):
        await lab.join(lab.invite(unattended=True))
        for token, name in ((lab.invite(), "arm"), (lab.invite(), "ARM"), (lab.invite("ARM"), "ARM")):
            with pytest.raises(PeerRefused, match=r"is a member.*\(taken\); .*rmpa trust invite --module NAME"):
                await lab.join(token, name)
        await lab.join(lab.invite("arm", unattended=True))  # the user means this one
        lab.clock.wall_seconds += 8 * DAY
        await lab.join(lab.invite(unattended=True))  # its certificate has ended


@pytest.mark.parametrize("away", [0, 8 * DAY])
async def test_a_module_whose_name_another_one_has_by_now_renews_no_certificate(
    lab: Lab, away: float, caplog: pytest.LogCaptureFixture
) -> None:
    """Else two modules would have one name: its successor, and one that was in a drawer, or stolen."""
    async with running(lab):
        old = lab.member(await lab.join(lab.invite(unattended=True)))
        lab.clock.wall_seconds += away
        lab.authority.renew_own()
        new = lab.member(await lab.join(lab.invite("arm", unattended=True)), "successor")
        for _ in range(4):
            with pytest.raises(PeerRefused, match=r"another module has joined as arm.*\(revoked\); join again"):
                await renew_at_authority(old, "127.0.0.1", lab.port)
        assert sum("a renewal by" in text for text in caplog.messages) == 1, "it does not fill the log"
        again = MeshAuthority.load(lab.store, lab.base)
        with pytest.raises(CertificateError, match="another module has joined as arm"):
            again.issue(old.request(), "arm")
        new.renewed((await renew_at_authority(new, "127.0.0.1", lab.port)).certificate)


async def test_of_two_modules_that_join_under_one_name_at_a_time_one_becomes_a_member(lab: Lab) -> None:
    async with running(lab):
        first, second = lab.invite(), lab.invite("arm")
        joining = asyncio.ensure_future(lab.join(first))
        await code_shown(lab, first)
        with pytest.raises(PeerRefused, match=r"joins just now.*\(taken\)"):
            await lab.join(second, "arm")
        key = private_key(lab.base.files.key, "module.key")
        for name in ("arm", "ARM"):
            with pytest.raises(ConfigError, match="joins just now"):
                lab.authority.join_file(make_request(key, name), "arm", lab.server.is_in_use)
        lab.server.answer(first.token_id, agree=True)
        await joining
        await lab.join(lab.invite("arm", unattended=True))  # away, and invited by its name


async def test_a_name_that_was_taken_while_the_code_was_compared_is_not_granted(lab: Lab) -> None:
    async with running(lab):
        token = lab.invite("arm")
        joining = asyncio.ensure_future(lab.join(token))
        await code_shown(lab, token)
        lab.taken.add("arm")  # the member of that name is back
        lab.server.answer(token.token_id, agree=True)
        with pytest.raises(PeerRefused, match=r"a module named arm is a member.*\(taken\)"):
            await joining
        assert [each.name for each in lab.authority.issued] == ["base"]


@pytest.mark.parametrize("wall", [0.0, WALL - 3 * DAY, WALL + 3 * DAY])
async def test_a_module_joins_whatever_its_clock_shows(lab: Lab, wall: float) -> None:
    """A robot without a battery for its clock has the time of its last shutdown, or 1970."""
    async with running(lab):
        clock = HandClock(wall_seconds=wall)
        files = await join_mesh(lab.invite(unattended=True), "arm", clock, lambda _code: asyncio.sleep(0, True))
    store = TrustStore(lab.folder, "arm")
    store.save(files)
    arm = Membership.load(store, clock, clock.wall)
    assert (arm.wall() is None) == (wall < WALL)
    if arm.wall() is None:
        arm.judge_member(lab.base.files.certificate, "base")
        assert Preface.parse(arm.preface(Purpose.LINK)).time_ms == 0


async def test_two_connections_with_one_token_at_once_are_one_join(
    lab: Lab, caplog: pytest.LogCaptureFixture
) -> None:
    lab.port = 1
    token = lab.invite()
    preface = Preface(Purpose.JOIN, 0, 0, b"n" * 16, token.token_id)
    pairs = [socket.socketpair() for _ in range(2)]
    for ours, _ in pairs:
        lab.server.accept(ours, preface)
    await lab.server.close()
    await asyncio.sleep(0)
    assert [ours.fileno() for ours, _ in pairs] == [-1, -1]
    for _, theirs in pairs:
        theirs.close()
    assert "KeyError" not in caplog.text


async def test_the_text_of_a_refused_renewal_is_safe_to_show(lab: Lab, monkeypatch: pytest.MonkeyPatch) -> None:
    async with running(lab):
        arm = lab.member(await lab.join(lab.invite(unattended=True)))
        refusal = RenewalRefused("a\nb", "\x1b[2Jgone\nnext")
        monkeypatch.setattr(lab.server, "_renewed", lambda *_: refusal)
        with pytest.raises(PeerRefused) as caught:
            await renew_at_authority(arm, "127.0.0.1", lab.port)
        assert str(caught.value).isprintable()


async def test_a_flood_of_joins_is_bounded_and_ends_with_the_server(lab: Lab) -> None:
    async with running(lab):
        token = lab.invite()
        first = asyncio.ensure_future(lab.join(token))
        await code_shown(lab, token)
        await lab.server.close()
        with pytest.raises(PeerRefused, match="the connection ended"):
            await first


async def test_idle_renewals_leave_places_to_joins_and_to_other_addresses(lab: Lab) -> None:
    """A member opens connections for a renewal, and sends nothing behind the prefaces."""
    async with running(lab):
        arm = lab.member(await lab.join(lab.invite(unattended=True)))
        lab.clock.wall_seconds += 30 * DAY
        lab.authority.renew_own()
        loop = asyncio.get_running_loop()
        idle = []
        for _ in range(limits.JOINS_AT_ONCE + 4):
            idle.append(sock := socket.socket())
            sock.setblocking(False)
            sock.bind(("127.0.0.2", 0))
            await loop.sock_connect(sock, ("127.0.0.1", lab.port))
            await loop.sock_sendall(sock, arm.preface(Purpose.RENEWAL))
        assert await loop.sock_recv(idle[-1], 1) == b"", "it is closed"
        await lab.join(lab.invite(unattended=True), "gripper")
        await renew_at_authority(arm, "127.0.0.1", lab.port)
        for sock in idle:
            sock.close()


def test_a_join_by_files(lab: Lab) -> None:
    key = private_key(lab.base.files.key, "module.key")
    request = make_request(key, "arm")
    assert request_der(request_pem(request)) == request
    asked, answer = lab.authority.join_file(request)
    assert asked.name == "arm"
    assert certificates.verify(answer.certificate, answer.ca, WALL).name == "arm"
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
        MeshAuthority.load(lab.store, lab.base)
