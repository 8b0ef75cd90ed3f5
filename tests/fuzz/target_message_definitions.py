"""Fuzz target: message definitions that publishers send."""

from __future__ import annotations

from rmpa.core.errors import LimitExceeded
from rmpa.ros.types.definitions import DefinitionError, full_text, md5sum, parse_definition
from rmpa.ros.types.messages import MessageType

SEEDS: list[bytes] = [
    b"",
    b"string data\n",
    b"int32 A=1\nstring S= x # y\nuint8[] data # note\nfloat64[36] c\n",
    MessageType("sensor_msgs/Joy").definition.encode(),
    MessageType("nav_msgs/Odometry").definition.encode(),
    b"T t\n" + b"=" * 80 + b"\nMSG: p/T\nint32 a\n",
]


def fuzz(data: bytes) -> None:
    """A definition whose parts and sum survive being written again, or a documented error."""
    text = data.decode(errors="surrogateescape")
    try:
        known = parse_definition("p/T", text)
        digest = md5sum("p/T", known)
    except (DefinitionError, LimitExceeded) as error:
        str(error)
        return
    if md5sum("p/T", parse_definition("p/T", full_text("p/T", known))) != digest:
        raise AssertionError("a definition does not survive being written again")
