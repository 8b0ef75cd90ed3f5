"""Joining: two machines in a pair, and everything that must not lead to a certificate."""

from __future__ import annotations

import struct
from dataclasses import dataclass, field, replace
from ipaddress import IPv4Address
from typing import TYPE_CHECKING

import msgspec
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

pytest.importorskip("cryptography")

from rmpa.core.errors import LocalProtocolError
from rmpa.trust import limits
from rmpa.trust.certificates import make_request, verify
from rmpa.trust.documents import DenyList, KeyList, read_deny_list, read_key_list, sign
from rmpa.trust.join import CodeShown, InvitingSide, Joined, JoiningSide, JoinRefused, MeshSecrets, proof_of
from rmpa.trust.keyring import GroupKey
from rmpa.trust.tokens import Token, TokenBook, fingerprint_of
from tests.fuzz import target_join
from tests.trust.authority import WALL, Authority, new_key

if TYPE_CHECKING:
    from rmpa.trust.join import JoinEvent

LAB, OTHER = Authority(), Authority()
SERVER = LAB.module("base")
KEYS = sign(KeyList.of(1, [GroupKey(1, b"k" * 32)]), LAB.key)
DENY = sign(DenyList().with_name("lost", WALL), LAB.key)
ARM_KEY = new_key()
REQUEST = make_request(ARM_KEY, "arm")


def _token(authority: Authority = LAB, expires: int = int(WALL) + 900) -> Token:
    return Token(expires, IPv4Address("10.0.0.1"), 40001, fingerprint_of(authority.certificate), b"s" * 16)


@dataclass
class Pair:
    """A joining module and an authority, with the bytes between them."""

    token: Token = field(default_factory=_token)
    name: str = ""
    server: bytes = SERVER
    request: bytes = REQUEST
    taken: str = ""
    secret: bytes = b""
    """Of the token that the joining side signs with, if it is another one."""
    session: bytes = b""
    """The certificate of the authority, if the joining side sees another one."""

    def __post_init__(self) -> None:
        self.book = TokenBook()
        self.book.invite(self.token, self.name)
        token = replace(self.token, secret=self.secret or self.token.secret)
        self.joining = JoiningSide("arm", self.request, token, self.server, b"j" * 32, 0.0)
        secrets = MeshSecrets(LAB.certificate, LAB.key, KEYS, DENY)
        self.inviting = InvitingSide(
            self.token.token_id,
            self.book,
            secrets,
            self.session or self.server,
            77,
            b"i" * 32,
            0.0,
            lambda name: name == self.taken,
        )
        self.seen: list[tuple[str, JoinEvent]] = []

    def run(self, step: int = 1 << 20) -> None:
        """Exchange bytes, ``step`` at a time, until no side has any."""
        while True:
            to_joining, to_inviting = self.inviting.take_output(), self.joining.take_output()
            if not to_joining and not to_inviting:
                break
            for side, data in ((self.joining, to_joining), (self.inviting, to_inviting)):
                for begin in range(0, len(data), step):
                    side.receive(data[begin : begin + step], WALL)
        self.seen += [("joining", event) for event in self.joining.events()]
        self.seen += [("inviting", event) for event in self.inviting.events()]

    def end(self, who: str) -> JoinEvent:
        """The last event of a side."""
        return [event for side, event in self.seen if side == who][-1]

    def reasons(self) -> tuple[str, str]:
        """Why the join was refused, at both sides."""
        ends = [self.end("joining"), self.end("inviting")]
        assert all(isinstance(end, JoinRefused) and end.text for end in ends), ends
        assert {end.by_us for end in ends if isinstance(end, JoinRefused)} == {True, False}
        return tuple(end.reason for end in ends if isinstance(end, JoinRefused))  # type: ignore[return-value] # two


@pytest.mark.parametrize("step", [1 << 20, 1])
@pytest.mark.parametrize("joining_first", [True, False])
def test_a_module_joins(step: int, joining_first: bool) -> None:
    pair = Pair()
    pair.run(step)
    codes = [event for _, event in pair.seen if isinstance(event, CodeShown)]
    assert len(codes) == 2
    assert codes[0] == codes[1]
    assert codes[0].module == "arm"
    if joining_first:
        pair.joining.agree()
        pair.run(step)
        assert not pair.inviting.over
        pair.inviting.agree(WALL)
    else:
        pair.inviting.agree(WALL)
        pair.run(step)
        assert not pair.joining.over
        pair.joining.agree()
    pair.run(step)
    joined = pair.end("joining")
    assert joined == pair.end("inviting")
    assert isinstance(joined, Joined)
    assert verify(joined.certificate, LAB.certificate, WALL, name="arm").serial == 77
    assert read_key_list(joined.keys, LAB.key.public_key()).number == 1
    assert read_deny_list(joined.deny, LAB.key.public_key()).denies("lost", WALL)
    assert pair.joining.next_timer() is None
    assert pair.book.invitations[0].used_by == "arm"
    assert "kkkk" not in repr(joined)


def test_nothing_is_granted_before_both_users_agree() -> None:
    for agree in ("joining", "inviting", ""):
        pair = Pair()
        pair.run()
        if agree == "joining":
            pair.joining.agree()
        elif agree == "inviting":
            pair.inviting.agree(WALL)
        pair.run()
        assert not any(isinstance(event, Joined) for _, event in pair.seen)


@pytest.mark.parametrize("who", ["joining", "inviting"])
def test_a_user_who_sees_another_code_ends_the_join(who: str) -> None:
    pair = Pair()
    pair.run()
    (pair.joining if who == "joining" else pair.inviting).reject()
    pair.run()
    assert pair.reasons() == ("code", "code")
    with pytest.raises(LocalProtocolError):
        pair.inviting.agree(WALL)
    with pytest.raises(LocalProtocolError):
        pair.joining.agree()


def test_a_token_is_good_for_one_attempt() -> None:
    first = Pair()
    first.run()
    first.joining.reject()
    second = Pair()
    second.book = first.book
    second.inviting._book = first.book
    second.run()
    assert second.reasons() == ("used", "used")


@pytest.mark.parametrize(
    ("pair", "reason"),
    [
        (Pair(token=_token(expires=int(WALL) - 1)), "late"),
        (Pair(name="base"), "name"),
        (Pair(taken="arm"), "taken"),
        (Pair(token=_token(OTHER)), "foreign"),
        (Pair(server=OTHER.module("base")), "foreign"),
        (Pair(server=b"nonsense"), "foreign"),
        (Pair(secret=b"x" * 16), "token"),  # it has the preface alone
        (Pair(session=LAB.module("arm2")), "token"),  # a member is in the middle
    ],
)
def test_each_refusal_has_its_reason_at_both_sides(pair: Pair, reason: str) -> None:
    pair.run()
    assert pair.reasons() == (reason, reason)


@pytest.mark.parametrize("part", ["request", "commitment", "proof"])
def test_no_part_of_a_hello_can_be_exchanged(part: str) -> None:
    pair = Pair()
    pair.joining.receive(pair.inviting.take_output(), WALL)
    hello = msgspec.json.decode(pair.joining.take_output()[4:])
    other = {"request": make_request(new_key(), "arm"), "commitment": b"x" * 32, "proof": b"x" * 32}
    pair.inviting.receive(_message(hello | {part: msgspec.to_builtins(other[part])}), WALL)
    end = pair.inviting.events()[-1]
    assert isinstance(end, JoinRefused)
    assert end.reason == "token"
    assert not pair.book.invitations[0].used_by  # the right module can still join with it


def test_the_proof_is_golden() -> None:
    proof = proof_of(b"k" * 32, b"request", b"c" * 32, b"server")
    assert proof.hex() == "b46242e61c03ed5eb3efb00c34dbebb4f0b3b6cc9b1d437b1f611460cb383f26"


def test_an_unknown_token_is_refused() -> None:
    pair = Pair()
    pair.book.withdraw(pair.token.token_id)
    pair.run()
    assert pair.reasons() == ("token", "token")


def test_a_clock_that_is_not_set_does_not_prevent_joining() -> None:
    pair = Pair()
    pair.joining.receive(pair.inviting.take_output(), None)
    pair.inviting.receive(pair.joining.take_output(), WALL)
    pair.joining.receive(pair.inviting.take_output(), None)
    pair.inviting.receive(pair.joining.take_output(), WALL)
    pair.joining.agree()
    pair.inviting.agree(WALL)
    pair.inviting.receive(pair.joining.take_output(), WALL)
    pair.joining.receive(pair.inviting.take_output(), None)
    assert isinstance(pair.joining.events()[-1], Joined)


def test_a_certificate_that_was_exchanged_is_refused() -> None:
    pair = Pair()
    pair.run()
    pair.joining.agree()
    pair.inviting.agree(WALL)
    pair.inviting.receive(pair.joining.take_output(), WALL)
    grant = msgspec.json.decode(pair.inviting.take_output()[4:])
    foreign = {**grant, "certificate": msgspec.to_builtins(LAB.module("arm"))}
    pair.joining.receive(_message(foreign), WALL)
    end = pair.joining.events()[-1]
    assert isinstance(end, JoinRefused)
    assert "another key" in end.text


def _message(value: object) -> bytes:
    data = msgspec.json.encode(value)
    return struct.pack(">I", len(data)) + data


@pytest.mark.parametrize(
    "data",
    [
        _message({"op": "agree"}),
        _message({"op": "reveal", "nonce": "AAAA"}),
        _message({"op": "hello", "request": "AAAA", "commitment": "AAAA"}),
        _message({"op": "hello", "request": "AAAA", "commitment": "AAAA", "proof": "AAAA"}),
        _message({"op": "grant", "certificate": "", "keys": ""}),
        _message({"op": "unknown"}),
        _message([]),
        b"\x00\x00\x00\x01{",
        b"\xff\xff\xff\xff",
    ],
)
def test_messages_that_cannot_be_end_the_join(data: bytes) -> None:
    pair = Pair()
    for side in (pair.joining, pair.inviting):
        side.take_output()
        side.receive(data, WALL)
        assert side.over
        end = side.events()[-1]
        assert isinstance(end, JoinRefused)
        assert end.by_us
        side.receive(data, WALL)
        assert side.events() == []


def test_the_text_of_the_other_side_is_safe_to_show() -> None:
    pair = Pair()
    pair.joining.receive(_message({"op": "refuse", "reason": "a b\x1b", "text": "\x1b[2J" + "x" * 1000}), WALL)
    end = pair.joining.events()[-1]
    assert isinstance(end, JoinRefused)
    assert end.reason == "other"
    assert end.text.isprintable()
    assert len(end.text) < 400


def test_time_and_connection_end_a_join() -> None:
    pair = Pair()
    pair.run()
    pair.joining.handle_timer(limits.CODE_TIMEOUT - 1)
    assert not pair.joining.over
    pair.joining.handle_timer(limits.CODE_TIMEOUT)
    pair.inviting.lost()
    pair.run()
    ends = [pair.end("joining"), pair.end("inviting")]
    assert [end.reason for end in ends if isinstance(end, JoinRefused)] == ["code", "lost"]


@settings(max_examples=50)
@given(st.lists(st.binary(max_size=60), max_size=5))
def test_anything_at_all_gives_no_certificate(chunks: list[bytes]) -> None:
    pair = Pair()
    for side in (pair.joining, pair.inviting):
        for chunk in chunks:
            side.receive(chunk, WALL)
        assert not any(isinstance(event, Joined) for event in side.events())


def test_the_fuzz_target_takes_its_seeds() -> None:
    for seed in target_join.SEEDS:
        target_join.fuzz(seed)
