"""Fuzz target: the messages of a join, at both sides."""

from __future__ import annotations

from ipaddress import IPv4Address

try:
    from rmpa.trust.certificates import make_request
    from rmpa.trust.documents import KeyList, sign
    from rmpa.trust.join import InvitingSide, Joined, JoiningSide, MeshSecrets
    from rmpa.trust.keyring import GroupKey
    from rmpa.trust.tokens import Token, TokenBook, fingerprint_of
    from tests.trust.authority import WALL, Authority, new_key
except ImportError:  # the extra "trust" is not installed
    SEEDS: list[bytes] = [b""]

    def fuzz(data: bytes) -> None:
        """Nothing can join without the library."""

else:
    _LAB = Authority()
    _SERVER = _LAB.module("base")
    _TOKEN = Token(int(WALL) + 9, IPv4Address("10.0.0.1"), 1, fingerprint_of(_LAB.certificate), bytes(16))
    _REQUEST = make_request(new_key(), "arm")
    _SECRETS = MeshSecrets(_LAB.certificate, _LAB.key, sign(KeyList.of(1, [GroupKey(1, bytes(32))]), _LAB.key))

    def _sides() -> tuple[JoiningSide, InvitingSide]:
        book = TokenBook()
        book.invite(_TOKEN)
        joining = JoiningSide("arm", _REQUEST, _TOKEN, _SERVER, b"j" * 32, 0.0)
        return joining, InvitingSide(_TOKEN.token_id, book, _SECRETS, _SERVER, 7, b"i" * 32, 0.0)

    def _recorded() -> list[bytes]:
        joining, inviting = _sides()
        deep = b'{"op":"agree","x":' + b"[" * 2000
        seeds = [b"", b"\x00\x00\x00\x02{}", b"\xff\xff\xff\xff", len(deep).to_bytes(4, "big") + deep]
        for _ in range(3):
            seeds.append(inviting.take_output())
            joining.receive(seeds[-1], WALL)
            seeds.append(joining.take_output())
            inviting.receive(seeds[-1], WALL)
        return seeds

    SEEDS = _recorded()

    def fuzz(data: bytes) -> None:
        """Whatever comes in: neither side ends with a certificate, for no user has agreed."""
        for side in _sides():
            side.receive(data, WALL)
            for event in side.events():
                if isinstance(event, Joined):
                    raise TypeError(f"{data!r} gives a certificate")
                str(event)
