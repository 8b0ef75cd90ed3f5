"""Free ports for one demo, so that it meets no real robot, no ROS core and no second demo on the machine."""

from __future__ import annotations

import random
import socket
from pathlib import Path

LOWEST = 20_000
EPHEMERAL = 32_768
"""Linux's default; from here on the kernel itself gives ports away, even between our look and our use."""
ATTEMPTS = 200


def free_port(kind: socket.SocketKind, taken: set[int]) -> int:
    """A free port, which is added to ``taken``.

    Args:
        kind: ``SOCK_STREAM`` on loopback, or ``SOCK_DGRAM`` on all addresses.
        taken: Ports that are promised to others.

    Raises:
        OSError: None was found.
    """
    host = "127.0.0.1" if kind == socket.SOCK_STREAM else ""
    for _ in range(ATTEMPTS):
        port = random.randrange(LOWEST, _first_ephemeral())
        with socket.socket(socket.AF_INET, kind) as probe:
            try:
                probe.bind((host, port))
            except OSError:
                continue
        if port not in taken:
            taken.add(port)
            return port
    raise OSError(f"no free port between {LOWEST} and {_first_ephemeral()} in {ATTEMPTS} attempts")


def port_or_another(port: int, taken: set[int]) -> int:
    """A TCP port if a server can listen at it on loopback now, else a free one, which is added to ``taken``.

    Raises:
        OSError: None was found.
    """
    with socket.socket(socket.AF_INET, socket.SOCK_STREAM) as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)  # old connections do not matter, as to a server
        try:
            probe.bind(("127.0.0.1", port))
        except OSError:
            return free_port(socket.SOCK_STREAM, taken)
    return port


def _first_ephemeral() -> int:
    try:
        first = int(Path("/proc/sys/net/ipv4/ip_local_port_range").read_text(encoding="ascii").split()[0])
    except (OSError, ValueError, IndexError):
        first = EPHEMERAL
    return first if first > LOWEST + ATTEMPTS else EPHEMERAL
