"""The messages of a renewal: golden bytes, byte by byte, malformed."""

from __future__ import annotations

import contextlib

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rmpa.core.errors import LimitExceeded, RemoteProtocolError
from rmpa.trust.renewal import Renew, RenewalGrant, RenewalRefused, decode_renewal, encode_renewal

GOLDEN = {
    Renew(b"csr"): b'\0\0\0\x21{"op":"renew","request":"Y3Ny"}',
    RenewalGrant(b"crt", b"keys"): b'\0\0\0\x3b{"op":"grant","certificate":"Y3J0","keys":"a2V5cw==","deny":""}',
    RenewalRefused("expired", "too old"): b'\0\0\0\x37{"op":"refuse","reason":"expired","text":"too old"}',
}


@pytest.mark.parametrize("message", GOLDEN)
def test_messages_survive_and_are_read_byte_by_byte(message: Renew | RenewalGrant | RenewalRefused) -> None:
    data = encode_renewal(message)
    assert data[4:] == GOLDEN[message][4:]
    assert int.from_bytes(data[:4], "big") == len(data) - 4
    for size in range(len(data)):
        assert decode_renewal(data[:size]) is None
    assert decode_renewal(data + b"more") == message
    assert "a2V5" not in repr(message)


def test_a_long_or_malformed_message_is_refused() -> None:
    with pytest.raises(LimitExceeded):
        decode_renewal(b"\xff\xff\xff\xff")
    for text in (b"[]", b"{}", b'{"op":"grant"}', b'{"op":"renew","request":"%"}', b"\xff\xfe"):
        with pytest.raises(RemoteProtocolError):
            decode_renewal(len(text).to_bytes(4, "big") + text)


@given(st.binary(max_size=200))
def test_any_bytes_are_a_message_or_an_error(data: bytes) -> None:
    with contextlib.suppress(RemoteProtocolError):
        decode_renewal(len(data).to_bytes(4, "big") + data)
