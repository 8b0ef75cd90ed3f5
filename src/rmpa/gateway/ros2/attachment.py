"""The attachment of each message, request and reply of ROS 2 over Zenoh.

33 bytes, little-endian; rmw_zenoh_cpp writes it with zenoh's serializer::

     0 sequence   8 bytes   counts the messages of a publisher, or the requests of a client, from 1; signed
     8 stamp      8 bytes   the source's wall clock, nanoseconds since 1970; signed
    16 length     1 byte    of the GID: 16 since ROS 2 Jazzy
    17 gid       16 bytes   which publisher or client it is

A reply repeats sequence and GID of its request, and has a stamp of its own.

Up to rmw_zenoh_cpp 0.2.3 of Jazzy each of the three has its name in front, with a length of one byte:
``sequence_number``, ``source_timestamp``, ``source_gid`` (ros2/rmw_zenoh#605). That is read too, and not written.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from rmpa.core.errors import RemoteProtocolError
from rmpa.gateway import limits

if TYPE_CHECKING:
    from rmpa.ros.wire.tcpros import Buffer

GID_BYTES: Final = 16
"""Bytes of a GID since ROS 2 Jazzy."""
_HEAD: Final = struct.Struct("<qqB")
_LABELS: Final = (b"\x0fsequence_number", b"\x10source_timestamp", b"\x0asource_gid")
_NUMBER: Final = 8


@dataclass(frozen=True, slots=True)
class Ros2Attachment:
    """What goes with a message of ROS 2.

    Args:
        sequence: The number of the message or request at its source, from 1.
        stamp: When it was published, in nanoseconds since 1970.
        gid: The source's GID, 16 bytes.
    """

    sequence: int
    stamp: int
    gid: bytes

    def serialize(self) -> bytes:
        """The bytes of the attachment."""
        return _HEAD.pack(self.sequence, self.stamp, len(self.gid)) + self.gid

    @classmethod
    def parse(cls, data: Buffer) -> Ros2Attachment:
        """Read an attachment; bytes behind the GID are ignored, so that later versions may add to it.

        Raises:
            RemoteProtocolError: It is shorter than it says.
        """
        raw = memoryview(data)
        if bytes(raw[: len(_LABELS[0])]) == _LABELS[0]:
            raw = _without_labels(raw)
        if len(raw) < _HEAD.size:
            raise RemoteProtocolError(f"an attachment of ROS 2 has {len(raw)} bytes; the least are {_HEAD.size}")
        sequence, stamp, length = _HEAD.unpack_from(raw)
        gid = bytes(raw[_HEAD.size : _HEAD.size + length])
        if len(gid) < length or length > limits.GID_MAX:
            raise RemoteProtocolError(f"an attachment of ROS 2 has {len(gid)} bytes of a GID of {length}")
        return cls(sequence, stamp, gid)


def _without_labels(raw: memoryview) -> memoryview:
    """The older form without the names."""
    made = b""
    for label in _LABELS:
        if bytes(raw[: len(label)]) != label:
            raise RemoteProtocolError(f"an attachment of ROS 2 has no {label[1:].decode()} where it should be")
        raw = raw[len(label) :]
        if label is not _LABELS[-1]:
            made += bytes(raw[:_NUMBER])
            raw = raw[_NUMBER:]
    return memoryview(made + bytes(raw))
