"""Serializes ``diagnostic_msgs/DiagnosticArray`` (REP 107), which an agent publishes on /diagnostics.

The code is written by hand, because the agent needs few messages, and rosbags with numpy would double its memory.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from enum import IntEnum
from typing import TYPE_CHECKING, Final

from rmpa.core.limits import UINT32_MAX
from rmpa.ros.types.std_header import HEADER_PART

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

ARRAY_TYPE: Final = "diagnostic_msgs/DiagnosticArray"
ARRAY_MD5: Final = "60810da900de1dd6ddd437c3503511da"
ARRAY_DEFINITION: Final = (
    "# This message is used to send diagnostic information about the state of the robot\n"
    "Header header #for timestamp\n"
    "DiagnosticStatus[] status # an array of components being reported on\n"
    f"{HEADER_PART}"
    "\n"
    "================================================================================\n"
    "MSG: diagnostic_msgs/DiagnosticStatus\n"
    "# This message holds the status of an individual component of the robot.\n"
    "# \n"
    "\n"
    "# Possible levels of operations\n"
    "byte OK=0\n"
    "byte WARN=1\n"
    "byte ERROR=2\n"
    "byte STALE=3\n"
    "\n"
    "byte level # level of operation enumerated above \n"
    "string name # a description of the test/component reporting\n"
    "string message # a description of the status\n"
    "string hardware_id # a hardware unique string\n"
    "KeyValue[] values # an array of values associated with the status\n"
    "\n"
    "\n"
    "================================================================================\n"
    "MSG: diagnostic_msgs/KeyValue\n"
    "string key # what to label this value when viewing\n"
    "string value # a value to track over time\n"
)
"""The text that ROS's own publishers send: rosbag and others compute the md5 sum from it."""
_LENGTH: Final = struct.Struct("<I")
_HEADER: Final = struct.Struct("<III")
_SECOND: Final = 1_000_000_000


class DiagnosticLevel(IntEnum):
    """``level`` of a ``DiagnosticStatus``."""

    OK = 0
    WARN = 1
    ERROR = 2
    STALE = 3


@dataclass(frozen=True, slots=True)
class DiagnosticStatus:
    """One ``diagnostic_msgs/DiagnosticStatus``.

    Args:
        level: The worst level of the component.
        name: The component; unique in an array.
        message: The status in a few words.
        hardware_id: The reporting module.
        values: Figures and facts, for people.
    """

    level: DiagnosticLevel
    name: str
    message: str
    hardware_id: str
    values: Mapping[str, str]

    def serialize(self) -> bytes:
        """Serialize the status as one element of the array."""
        parts = [bytes((self.level,)), *map(_text, (self.name, self.message, self.hardware_id))]
        parts.append(_LENGTH.pack(len(self.values)))
        for key, value in self.values.items():
            parts += (_text(key), _text(value))
        return b"".join(parts)


def frame_array(sequence: int, stamp_ns: int, statuses: Iterable[bytes]) -> bytes:
    """Assemble a whole message with its length in front, as TCPROS sends it.

    Args:
        sequence: ``header.seq``, modulo 2^32.
        stamp_ns: ``header.stamp``, nanoseconds of the wall clock.
        statuses: Results of ``DiagnosticStatus.serialize``.
    """
    elements = tuple(statuses)
    seconds, nanoseconds = divmod(stamp_ns, _SECOND)
    header = _HEADER.pack(sequence & UINT32_MAX, seconds & UINT32_MAX, nanoseconds) + _text("")
    body = b"".join((header, _LENGTH.pack(len(elements)), *elements))
    return _LENGTH.pack(len(body)) + body


def _text(text: str) -> bytes:
    data = text.encode(errors="replace")
    return _LENGTH.pack(len(data)) + data
