"""Fuzz target: one-time tokens."""

from __future__ import annotations

from ipaddress import IPv4Address

from rmpa.trust.tokens import Token, TokenError

_TOKEN = Token(1_790_000_000, IPv4Address("10.0.0.1"), 40001, bytes(range(16)), bytes(range(16)))

SEEDS: list[bytes] = [
    b"",
    b"rmpa1-",
    b"rmpa2-" + b"a" * 85,
    _TOKEN.serialize().encode(),
    _TOKEN.serialize().upper().encode() + b"\r\n",
]


def fuzz(data: bytes) -> None:
    """Whatever comes in: a token that survives its round trip, or an error without the text."""
    text = data.decode("utf-8", "replace")
    try:
        token = Token.parse(text)
    except TokenError as error:
        if len(str(error)) > 300:
            raise AssertionError("the error has the text in it") from None
        return
    if Token.parse(token.serialize()) != token:
        raise AssertionError(f"{token} does not survive its round trip")
