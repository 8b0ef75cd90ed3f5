"""Fuzz target: the frame parser."""

from __future__ import annotations

from rmpa.core.errors import RemoteProtocolError
from rmpa.core.outbox import ABORT, FIRST, LAST
from rmpa.mesh.frames import Frame, FrameKind, parse_pong, parse_text, pong

SEEDS: list[bytes] = [
    b"",
    Frame(FrameKind.PING, stamp_ns=1).serialize(),
    pong(1, 2, 3).serialize(),
    Frame(FrameKind.CONTROL, b'{"op":"x"}').serialize(),
    Frame(FrameKind.DATA, b"\x04\x00\x00\x00abcd", 7, 1, 99).serialize(),
    Frame(FrameKind.BYE, b"ends").serialize() + Frame(FrameKind.DATA, flags=1).serialize(),
    Frame(FrameKind.DATA, b"\x08\x00\x00\x00abcd", 7, 1, 99, FIRST).serialize(),
    Frame(FrameKind.DATA, b"efgh", 7, 1, 99, LAST).serialize(),
    Frame(FrameKind.DATA, b"", 7, 1, 99, LAST | ABORT).serialize(),
    *(
        Frame(kind, route=7, sequence=0xFFFFFFFF).serialize()
        for kind in (FrameKind.ACK, FrameKind.FENCE, FrameKind.FENCED)
    ),
]


def fuzz(data: bytes) -> None:
    """Whatever comes in: a frame that survives its round trip, nothing yet, or a documented error."""
    try:
        parsed = Frame.parse(data)
        if parsed is None:
            return
        frame, taken = parsed
        if frame.kind is FrameKind.PONG:
            parse_pong(frame.payload)
    except RemoteProtocolError as error:
        str(error)
        return
    if Frame.parse(frame.serialize()) != (frame, taken):
        raise AssertionError(f"{frame} does not survive its round trip")
    if not parse_text(frame.payload).isprintable() or not str(frame).isprintable():
        raise AssertionError("a frame's text is not safe to log")
