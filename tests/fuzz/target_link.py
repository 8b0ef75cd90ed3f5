"""Fuzz target: a link's machine, in both roles, before and after its handshake."""

from __future__ import annotations

from rmpa.core.errors import RemoteProtocolError
from rmpa.core.identity import Guid, Identity
from rmpa.core.outbox import ABORT, FIRST, LAST
from rmpa.mesh.connection import ConnectionState
from rmpa.mesh.frames import Frame, FrameKind, Hello, Refuse, pack_data_header, pong
from tests.mesh.worlds import ACCEPTOR, DIALLER, AnyRoute, Side, Time

_OURS = Identity(Guid.of("10.0.0.2", 40002, 1), b"O" * 16, "ours")
_THEIRS = Identity(Guid.of("10.0.0.1", 40001, 7), bytes(range(16)), "base")
_HELLO = Frame(FrameKind.HELLO, Hello.of(_THEIRS, lease=1.0, expected=_OURS.guid).serialize()).serialize()
_WELCOME = Frame(FrameKind.WELCOME, Hello.of(_THEIRS, lease=1.0, expected=_OURS.guid).serialize()).serialize()
_TALK = (
    Frame(FrameKind.PING, stamp_ns=5).serialize()
    + pong(1, 2, 3).serialize()
    + Frame(FrameKind.CONTROL, b"{}").serialize()
)
_DATA = pack_data_header(4, 1, 1, 9) + b"\0\0\0\0"

_PARTS = b"".join(
    Frame(FrameKind.DATA, part, route, 1, 9, flags).serialize()
    for part, route, flags in (
        (b"\x08\0\0\0ab", 1, FIRST),
        (b"\x04\0\0\0", 2, FIRST),
        (b"cd", 1, 0),
        (b"", 2, LAST | ABORT),
        (b"efgh", 1, LAST),
    )
)
_MARKS = b"".join(
    Frame(kind, route=1, sequence=7).serialize() for kind in (FrameKind.ACK, FrameKind.FENCE, FrameKind.FENCED)
)
# The beginning of a frame that is handed on as it comes.
_LONG = pack_data_header(200_000, 1, 1, 9) + bytes(50)

SEEDS: list[bytes] = [
    b"",
    _HELLO,
    _WELCOME,
    Frame(FrameKind.REFUSE, Refuse(8, "busy").serialize()).serialize(),
    _HELLO + _TALK + _DATA,
    _TALK + _DATA + Frame(FrameKind.BYE, b"ends").serialize(),
    _PARTS + _MARKS,
    _MARKS + _DATA + _LONG,
    _PARTS[:60] + _LONG,
]


def fuzz(data: bytes) -> None:
    """The same bytes whole and in two pieces, to a fresh link of either role and to one that is up."""
    for role in (DIALLER, ACCEPTOR):
        for prefix in (b"", _HELLO if role == ACCEPTOR else _WELCOME):
            whole = _feed(role, [prefix + data])
            parts = _feed(role, [prefix, data[: len(data) // 2], data[len(data) // 2 :]])
            if whole != parts:
                raise AssertionError(f"{whole} whole, but {parts} in pieces")


def _feed(role: str, pieces: list[bytes]) -> tuple[str, int, int, list[list[object]]]:
    """What the link says and how it ends; of parts, what they are put together."""
    parts: list[list[object]] = []
    data = 0

    def on_data(_route: int, _sequence: int, _stamp_ns: int, payload: memoryview) -> None:
        nonlocal data
        data += len(payload)

    def on_part(route: int, sequence: int, stamp_ns: int, flags: int, part: memoryview) -> None:
        whose = (route, sequence, stamp_ns)
        if flags & FIRST or not parts or parts[-1][0] != whose or parts[-1][2]:
            parts.append([whose, flags & FIRST, flags & (LAST | ABORT), bytes(part)])
        else:
            parts[-1][2:] = [flags & (LAST | ABORT), bytes(parts[-1][3]) + bytes(part)]  # type: ignore[call-overload]

    time = Time()
    link = Side(role, _OURS, time)
    link.routes = AnyRoute(on_data, on_part)

    def closed() -> bool:
        return link.state is ConnectionState.CLOSED

    kept = b""
    for piece in pieces:
        if closed():
            break
        kept += piece
        try:
            consumed, wanted = link.receive(memoryview(kept), time.now)
        except RemoteProtocolError as error:
            str(error)
            if not closed():
                raise AssertionError("a broken protocol left the link open") from None
            break
        if not 0 <= consumed <= len(kept) or wanted < 0:
            raise AssertionError(f"consumed {consumed} of {len(kept)}, wants {wanted}")
        kept = kept[consumed:]
    return repr(link.events), data, link.state.value, parts
