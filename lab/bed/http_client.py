"""An HTTP and WebSocket client on any host of a lab."""

from __future__ import annotations

from typing import TYPE_CHECKING

import aiohttp

from lab.bed.namespaces import MACHINE, Host

if TYPE_CHECKING:
    import socket


def http_client(host: Host = MACHINE) -> aiohttp.ClientSession:
    """A client that runs in this process, with its connections in a host's network."""

    def make(address: aiohttp.AddrInfoType) -> socket.socket:
        return host.open_socket(address[0], address[1])

    return aiohttp.ClientSession(connector=aiohttp.TCPConnector(socket_factory=make))
