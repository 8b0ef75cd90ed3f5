"""The addresses of this machine, from which a node chooses the one to register."""

from __future__ import annotations

import socket

import psutil


def local_addresses() -> list[str]:
    """IPv4 addresses of the interfaces that are up, in the system's order; those of loopback last."""
    up = {name for name, state in psutil.net_if_stats().items() if state.isup}
    found = [
        address.address
        for name, addresses in psutil.net_if_addrs().items()
        if name in up
        for address in addresses
        if address.family == socket.AF_INET
    ]
    return sorted(found, key=lambda address: address.startswith("127."))
