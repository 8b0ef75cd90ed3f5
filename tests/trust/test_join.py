"""The messages of joins and renewals: golden bytes, malformed, any bytes."""

from __future__ import annotations

import contextlib

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rmpa.core.errors import LimitExceeded, RemoteProtocolError
from rmpa.trust.tokens import (
    CertificateGrant,
    Join,
    JoinMessage,
    JoinRefused,
    Renew,
    decode_message,
    encode_message,
    message_length,
    proof_of,
)

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
