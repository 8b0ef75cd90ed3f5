"""Opens the listening socket of an XML-RPC server; errors have a remedy."""

from __future__ import annotations

import asyncio
import contextlib
import errno
import ipaddress
import socket
from typing import TYPE_CHECKING

from rmpa.core.counters import remedy
from rmpa.core.errors import StartError
from rmpa.ros import limits
from rmpa.runtime.accept import DESCRIPTORS
from rmpa.runtime.tcp_connections import program_at

if TYPE_CHECKING:
    from rmpa.runtime.accept import Use


async def listen(name: str, host: str, port: int, use: Use) -> socket.socket:
    """Open a listening socket.

    Args:
        name: The server, for the text of errors.
        host: Numeric address or name; empty: all addresses.
        port: 0 lets the system choose.
        use: The purpose of its connections.

    Raises:
        StartError: The address is in use, not of this machine, or not allowed.
    """
    try:
        address = await _resolve(host, port)
        sock = DESCRIPTORS.open_socket(use, what=name)
        try:
            sock.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            sock.bind(address)
            sock.listen(limits.HTTP_BACKLOG)
        except BaseException:
            sock.close()
            raise
    except OSError as error:
        owner = await asyncio.to_thread(program_at, port) if error.errno == errno.EADDRINUSE else ""
        raise _start_error(error, f"{name} at {host}:{port}", port, owner) from error
    return sock


async def _resolve(host: str, port: int) -> tuple[str, int]:
    with contextlib.suppress(ValueError):
        return str(ipaddress.IPv4Address(host)), port
    if not host:
        return "", port
    loop = asyncio.get_running_loop()
    found = await loop.getaddrinfo(host, port, family=socket.AF_INET, type=socket.SOCK_STREAM)
    return str(found[0][4][0]), port


def _start_error(error: OSError, where: str, port: int, owner: str) -> StartError:
    match error.errno:
        case errno.EADDRINUSE:
            return StartError(
                where,
                f"port {port} is already in use" + (f" by {owner}" if owner else ""),
                "end that program (another core?) or choose another port",
            )
        case errno.EACCES | errno.EPERM:
            return StartError(where, "this user may not use that port", "choose a port above 1023")
        case errno.EADDRNOTAVAIL:
            return StartError(where, "this machine does not have that address", "choose one that `ip addr` shows")
        case errno.EMFILE:
            return StartError(where, "no file descriptors left", remedy())
    return StartError(where, error.strerror or str(error))
