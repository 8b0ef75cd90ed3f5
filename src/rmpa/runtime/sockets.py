"""The mesh port: TCP for links and UDP for unicast beacons under one number."""

from __future__ import annotations

import errno
import socket

from rmpa.core.errors import StartError
from rmpa.runtime import limits


def open_mesh_port(port: int = 0) -> tuple[socket.socket, socket.socket]:
    """Bind a listening TCP socket and a UDP socket to the same port on all addresses.

    Args:
        port: The port, or 0 for one that the system chooses.

    Returns:
        The listening TCP socket and the UDP socket, both non-blocking.

    Raises:
        StartError: The port is taken, or this user may not bind it.
    """
    for attempt in range(limits.MESH_PORT_ATTEMPTS):
        tcp = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
        udp = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        try:
            # A restarted agent gets its port back although old connections are in TIME_WAIT. Never set it on the UDP
            # socket: two agents could then bind one port without an error, and each would miss half of its beacons.
            tcp.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            tcp.bind(("", port))
            udp.bind(("", tcp.getsockname()[1]))
            tcp.listen(limits.MESH_BACKLOG)
        except OSError as error:
            tcp.close()
            udp.close()
            if port == 0 and error.errno == errno.EADDRINUSE and attempt + 1 < limits.MESH_PORT_ATTEMPTS:
                continue  # the number was free for TCP but not for UDP
            raise _refused(port, error) from error
        tcp.setblocking(False)
        udp.setblocking(False)
        return tcp, udp
    raise AssertionError("unreachable")


def _refused(port: int, error: OSError) -> StartError:
    if error.errno == errno.EADDRINUSE:
        problem = "is in use, perhaps by another agent"
        remedy = "choose another with --port, or leave the choice to the system (--port 0)"
    elif error.errno == errno.EACCES:
        problem, remedy = "is not for this user", "choose one above 1023 with --port"
    else:
        problem, remedy = f"cannot be opened ({error.strerror})", ""
    return StartError(f"mesh port {port}", problem, remedy)
