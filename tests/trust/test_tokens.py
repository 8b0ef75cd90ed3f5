"""Tokens, and the messages of a join."""

from __future__ import annotations

import base64
import contextlib
import hashlib
from ipaddress import IPv4Address

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rmpa.core.errors import LimitExceeded, RemoteProtocolError
from rmpa.trust.tokens import (
    PREFIX,
    CertificateGrant,
    Invitation,
    Join,
    JoinMessage,
    JoinRefused,
    Renew,
    Token,
    TokenError,
    decode_message,
    encode_message,
    fingerprint_of,
    message_length,
    proof_of,
)

SECRET = bytes(range(100, 116))
TOKEN = Token(1_790_000_000, IPv4Address("10.0.0.1"), 40001, bytes(range(16)), SECRET)
BODY = bytes.fromhex("01 6ab13b80 0a000001 9c41 000102030405060708090a0b0c0d0e0f 6465666768696a6b6c6d6e6f70717273")
TEXT = PREFIX + base64.b32encode(BODY + hashlib.sha256(BODY).digest()[:10]).decode().rstrip("=").lower()
WALL = 1_789_999_999.0


def test_golden_text_both_ways() -> None:
    assert TOKEN.serialize() == TEXT
    assert len(TEXT) == 91
    assert Token.parse(TEXT) == TOKEN


def test_id_and_key_are_golden() -> None:
    assert TOKEN.token_id == hashlib.sha256(b"rmpa token id 1" + SECRET).digest()[:8]
    assert len(TOKEN.key) == 32
    assert TOKEN.token_id not in TOKEN.key


def test_typing_does_not_matter() -> None:
    typed = f"  {TEXT[:40].upper()} \n {TEXT[40:]}\r\n"
    assert Token.parse(typed) == TOKEN


def test_the_secret_is_never_shown() -> None:
    for shown in (repr(TOKEN), str(TOKEN), repr(Invitation(TOKEN.token_id, TOKEN.key, 1))):
        assert SECRET.hex() not in shown
        assert str(SECRET) not in shown
        assert repr(TOKEN.key) not in shown
    assert str(TOKEN).endswith("of 10.0.0.1:40001")


@pytest.mark.parametrize("length", range(len(TEXT)))
def test_every_shorter_text_is_no_token(length: int) -> None:
    with pytest.raises(TokenError):
        Token.parse(TEXT[:length])


def test_every_changed_character_is_noticed() -> None:
    for offset in range(len(TEXT)):
        for other in "a3-ß":
            changed = TEXT[:offset] + other + TEXT[offset + 1 :]
            if changed == TEXT:
                continue
            with pytest.raises(TokenError):
                Token.parse(changed)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "does not begin with rmpa1-"),
        ("hello", "does not begin with rmpa1-"),
        ("rmpa2-" + "a" * 85, "is of another release; install the same"),
        (TEXT[:-1], "has 84 characters behind rmpa1-, not 85: it is not whole; copy it whole"),
        (TEXT + "a", "not 85"),
        (PREFIX + "a" * 84 + "1", "has characters that no token has"),
        (PREFIX + "a" * 85, "is mistyped"),
        ("x" * 1000, "has 1000 characters"),
    ],
)
def test_mistakes_are_named_without_the_text(text: str, words: str) -> None:
    with pytest.raises(TokenError) as caught:
        Token.parse(text)
    assert words in str(caught.value)
    assert len(str(caught.value)) < 200


def _text(body: bytes) -> str:
    return PREFIX + base64.b32encode(body + hashlib.sha256(body).digest()[:10]).decode().rstrip("=").lower()


def test_well_typed_nonsense_is_refused() -> None:
    with pytest.raises(TokenError, match="another release"):
        Token.parse(_text(b"\x02" + BODY[1:]))
    with pytest.raises(TokenError, match="no authority can be reached at 224"):
        Token.parse(_text(BODY[:5] + b"\xe0" + BODY[6:]))
    with pytest.raises(TokenError, match="no authority can be reached"):
        Token.parse(_text(BODY[:9] + b"\x00\x00" + BODY[11:]))


@pytest.mark.parametrize(
    ("expires", "address", "port", "fingerprint", "secret"),
    [
        (-1, "10.0.0.1", 1, bytes(16), bytes(16)),
        (1 << 32, "10.0.0.1", 1, bytes(16), bytes(16)),
        (1, "0.0.0.0", 1, bytes(16), bytes(16)),
        (1, "10.0.0.1", 0, bytes(16), bytes(16)),
        (1, "10.0.0.1", 1 << 16, bytes(16), bytes(16)),
        (1, "10.0.0.1", 1, bytes(15), bytes(16)),
        (1, "10.0.0.1", 1, bytes(16), bytes(17)),
    ],
)
def test_what_cannot_be_is_no_token(expires: int, address: str, port: int, fingerprint: bytes, secret: bytes) -> None:
    with pytest.raises(ValueError, match=r"token|authority|length"):
        Token(expires, IPv4Address(address), port, fingerprint, secret)


def test_a_fingerprint_is_half_a_hash() -> None:
    assert fingerprint_of(b"der") == hashlib.sha256(b"der").digest()[:16]


@pytest.mark.parametrize(
    ("named", "used_by", "name", "wall", "problem"),
    [
        ("", "", "arm", WALL, ""),
        ("arm", "", "arm", WALL, ""),
        ("", "arm", "arm", WALL, "used"),
        ("arm", "", "base", WALL, "name"),
        ("", "", "arm", TOKEN.expires, "late"),
    ],
)
def test_what_is_wrong_with_a_token_is_told_apart(
    named: str, used_by: str, name: str, wall: float, problem: str
) -> None:
    assert Invitation(TOKEN.token_id, TOKEN.key, TOKEN.expires, named, used_by).problem(name, wall) == problem


@given(
    st.integers(0, (1 << 32) - 1),
    st.integers(0x01000000, 0xDFFFFFFF),
    st.integers(1, 65535),
    st.binary(min_size=16, max_size=16),
    st.binary(min_size=16, max_size=16),
)
def test_tokens_survive_their_round_trip(expires: int, address: int, port: int, mark: bytes, secret: bytes) -> None:
    token = Token(expires, IPv4Address(address), port, mark, secret)
    assert Token.parse(token.serialize()) == token


@given(st.text())
def test_anything_at_all_is_refused(text: str) -> None:
    for each in (text, PREFIX + text):
        with pytest.raises(TokenError):
            Token.parse(each)


GOLDEN: dict[JoinMessage, bytes] = {
    Join(b"id", b"csr", b"mac"): b'\0\0\0\x3c{"op":"join","token":"aWQ=","request":"Y3Ny","proof":"bWFj"}',
    Renew(b"csr"): b'\0\0\0\x1f{"op":"renew","request":"Y3Ny"}',
    CertificateGrant(
        b"crt", b"ca", b"keys"
    ): b'\0\0\0\x4b{"op":"grant","certificate":"Y3J0","ca":"Y2E=","keys":"a2V5cw==","deny":""}',
    JoinRefused("expired", "too old"): b'\0\0\0\x33{"op":"refuse","reason":"expired","text":"too old"}',
}


@pytest.mark.parametrize("message", GOLDEN)
def test_messages_have_their_bytes_and_survive(message: JoinMessage) -> None:
    data = encode_message(message)
    assert data == GOLDEN[message]
    assert message_length(data[:4], 100) == len(data) - 4
    assert decode_message(data[4:]) == message
    assert "a2V5" not in repr(message)
    assert "keys" not in repr(message)


def test_a_long_or_malformed_message_is_refused() -> None:
    with pytest.raises(LimitExceeded):
        message_length(b"\0\0\0\x65", 100)
    deep = b'{"op":"renew","x":' + b"[" * 2000
    for text in (b"[]", b"{}", b'{"op":"grant"}', b'{"op":"renew","request":"%"}', b"\xff\xfe", deep):
        with pytest.raises(RemoteProtocolError):
            decode_message(text)


@given(st.binary(max_size=200))
def test_any_bytes_are_a_message_or_an_error(data: bytes) -> None:
    with contextlib.suppress(RemoteProtocolError):
        decode_message(data)


def test_the_proof_is_of_one_token_one_request_and_one_connection() -> None:
    proof = proof_of(b"k" * 32, b"request", b"server")
    assert proof.hex() == "c6883baacff1b2839a1b5f433afc2fdac1c16203bbb4f338ff4a993a47f65200"
    for other in ((b"x" * 32, b"request", b"server"), (b"k" * 32, b"r", b"server"), (b"k" * 32, b"request", b"s")):
        assert proof_of(*other) != proof
