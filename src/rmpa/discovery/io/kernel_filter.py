"""Packet filters that the kernel runs before a packet reaches a socket (socket(7), SO_ATTACH_FILTER).

Two sockets of one group share its packets: one gets the heartbeats, which may wait, the other one all the rest. So
an idle agent is not woken for each heartbeat.
"""

from __future__ import annotations

import ctypes
import socket
import struct
from enum import Enum
from typing import Final

from rmpa.discovery.beacon import KIND_AT, MAGIC, BeaconKind

_SO_ATTACH_FILTER: Final = 26  # asm-generic/socket.h; not in Python's socket module
_UDP_HEADER: Final = 8
"""The filter of a UDP socket sees the UDP header in front of the payload."""
_INSTRUCTION: Final = struct.Struct("@HBBI")
_PROGRAM: Final = struct.Struct("@HP")
# linux/filter.h and linux/bpf_common.h: class, size and mode of an instruction, in one number.
_LOAD_LENGTH: Final = 0x80
_LOAD_WORD: Final = 0x20
_LOAD_BYTE: Final = 0x30
_IF_AT_LEAST: Final = 0x35
_IF_EQUAL: Final = 0x15
_RETURN: Final = 0x06
_WHOLE: Final = 0xFFFF
_DROP: Final = 0


class PacketSelection(Enum):
    """The packets that a socket receives."""

    HEARTBEATS = "heartbeats"
    """Beacons of the kind ``HEARTBEAT`` alone."""
    OTHERS = "others"
    """All others, malformed ones included."""


def select(sock: socket.socket, selection: PacketSelection) -> None:
    """Let the kernel drop what the selection does not contain; to be called before ``bind``.

    Raises:
        OSError: The kernel takes no filters.
    """
    heartbeat, other = (_WHOLE, _DROP) if selection is PacketSelection.HEARTBEATS else (_DROP, _WHOLE)
    kind = _UDP_HEADER + KIND_AT
    program = b"".join(
        _INSTRUCTION.pack(*instruction)
        for instruction in (  # code, instructions to skip if true, if false, operand
            (_LOAD_LENGTH, 0, 0, 0),
            (_IF_AT_LEAST, 0, 5, kind + 1),  # a load behind the end would drop the packet, and nothing would count it
            (_LOAD_WORD, 0, 0, _UDP_HEADER),
            (_IF_EQUAL, 0, 3, int.from_bytes(MAGIC, "big")),
            (_LOAD_BYTE, 0, 0, kind),
            (_IF_EQUAL, 0, 1, BeaconKind.HEARTBEAT),
            (_RETURN, 0, 0, heartbeat),
            (_RETURN, 0, 0, other),
        )
    )
    memory = ctypes.create_string_buffer(program, len(program))  # the kernel copies it within the call
    reference = _PROGRAM.pack(len(program) // _INSTRUCTION.size, ctypes.addressof(memory))
    sock.setsockopt(socket.SOL_SOCKET, _SO_ATTACH_FILTER, reference)
