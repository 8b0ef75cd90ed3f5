"""GUIDs: they identify a peer, and decide which of two peers dials (paper, section 4.2)."""

from __future__ import annotations

import re
from dataclasses import dataclass
from ipaddress import IPv4Address
from typing import Final

_TEXT: Final = re.compile(r"(?P<ip>[0-9.]+):(?P<port>[0-9]+)(?:#(?P<incarnation>[0-9]+))?")

_LOOPBACK: Final = 127
_MULTICAST: Final = 224


@dataclass(frozen=True, slots=True, order=True)
class Guid:
    """A 64-bit global unique identifier, ordered as an unsigned integer.

    The high 32 bits are the IPv4 address, the next 16 the mesh port, as in the paper; the low 16, which the
    paper leaves free, count incarnations, which distinguishes a restarted peer from its former run.

    Args:
        value: The 64 bits.

    Raises:
        ValueError: ``value`` does not fit in 64 bits.
    """

    value: int

    def __post_init__(self) -> None:
        if not 0 <= self.value < 1 << 64:
            raise ValueError(f"a GUID has 64 bits, not {self.value:#x}")

    @classmethod
    def of(cls, address: IPv4Address | str, port: int, incarnation: int = 0) -> Guid:
        """Join the three parts; ``port`` and ``incarnation`` are 16-bit numbers.

        Raises:
            ValueError: A part is out of its range.
        """
        if not 0 <= port < 1 << 16:
            raise ValueError(f"a port has 16 bits, not {port}")
        if not 0 <= incarnation < 1 << 16:
            raise ValueError(f"an incarnation has 16 bits, not {incarnation}")
        return cls(int(IPv4Address(address)) << 32 | port << 16 | incarnation)

    @classmethod
    def parse(cls, text: str) -> Guid:
        """Read the form that ``str`` writes, ``10.0.0.1:40001#7``; without ``#7`` the incarnation is 0.

        Raises:
            ValueError: The text is not a GUID.
        """
        match = _TEXT.fullmatch(text)
        if match is None:
            raise ValueError(f"{text!r} is not a GUID; one looks like 10.0.0.1:40001#7")
        return cls.of(match["ip"], int(match["port"]), int(match["incarnation"] or 0))

    @property
    def address(self) -> IPv4Address:
        """The IPv4 address in the high 32 bits."""
        return IPv4Address(self.value >> 32)

    @property
    def port(self) -> int:
        """The mesh port: TCP for links, UDP for unicast beacons."""
        return self.value >> 16 & 0xFFFF

    @property
    def incarnation(self) -> int:
        """The low 16 bits."""
        return self.value & 0xFFFF

    @property
    def endpoint(self) -> tuple[str, int]:
        """``(address, port)`` as sockets want it; shared by all incarnations of one peer."""
        high = self.value >> 32
        return f"{high >> 24}.{high >> 16 & 255}.{high >> 8 & 255}.{high & 255}", self.port

    @property
    def place(self) -> int:
        """Address and port as one number, in GUID order: all incarnations of one peer share it."""
        return self.value >> 16

    @property
    def dialable(self) -> bool:
        """Whether a single peer can be reached at its address; see the function ``dialable``."""
        return _is_unicast(self.value >> 56) and self.port != 0

    @property
    def is_loopback(self) -> bool:
        """Whether its address is a loopback address (127.x.x.x)."""
        return self.value >> 56 == _LOOPBACK

    def __str__(self) -> str:
        """``10.0.0.1:40001#7``."""
        return f"{self.address}:{self.port}#{self.incarnation}"


def dialable(address: IPv4Address, port: int) -> bool:
    """Whether a single peer can be reached there: no multicast, broadcast or "any" address, no port 0.

    A forged beacon with such an address could make its receivers send to a whole network.
    """
    return _is_unicast(int(address) >> 24) and port != 0


def _is_unicast(first: int) -> bool:
    """Whether an address with this first byte is a unicast address."""
    return 0 < first < _MULTICAST
