"""Fuzz target: hello, welcome and refuse payloads, and the judgement on them."""

from __future__ import annotations

from rmpa.core.errors import RemoteProtocolError
from rmpa.core.identity import Guid, Identity
from rmpa.mesh.frames import Hello, Refuse, judge, judge_welcome

_OURS = Identity(Guid.of("10.0.0.2", 40002, 1), b"O" * 16, "ours")
_THEIRS = Identity(Guid.of("10.0.0.1", 40001, 7), bytes(range(16)), "base")

SEEDS: list[bytes] = [
    b"",
    b"RMPA\x03\x01\x00\x00",
    Hello.of(_THEIRS, lease=1.0, expected=_OURS.guid).serialize(),
    Hello.of(_THEIRS, lease=1.0, expected=None).serialize() + b"later versions",
    Hello.of(_OURS, lease=60.0, expected=None, lane=2).serialize(),
    Refuse(2, "another domain").serialize(),
]


def fuzz(data: bytes) -> None:
    """Whatever comes in: a hello that survives and is judged, or a documented error."""
    try:
        str(Refuse.parse(data))
        hello = Hello.parse(data)
    except RemoteProtocolError as error:
        str(error)
        return
    if isinstance(hello, Refuse):
        str(hello)
        return
    if Hello.parse(hello.serialize()) != hello:
        raise AssertionError(f"{hello} does not survive its round trip")
    verdict = judge(hello, _OURS, _THEIRS)
    judge_welcome(hello, _OURS, _THEIRS.guid)
    if verdict is None and hello.identity.guid != hello.guid:
        raise AssertionError("a welcome peer has no identity")
    if not hello.name.isprintable() or hello.lease <= 0:
        raise AssertionError("a hello's text is not safe to log, or its lease is none")
