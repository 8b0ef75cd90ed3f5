"""Bounds what the kernel holds unsent of Zenoh's connections, so that priorities hold on a slow line too.

Zenoh sends by priority, but what it has handed to the kernel goes first in, first out: on 1 Mbit/s that is seconds.
Zenoh has an option for the whole send buffer alone, which would have to fit each line. TCP_NOTSENT_LOWAT bounds the
part that is not on the line yet, whatever the line carries; Zenoh has no option for it, so its sockets are looked for
in this process.
"""

from __future__ import annotations

import logging
import os
import socket
import stat
from pathlib import Path
from typing import TYPE_CHECKING, Final

from rmpa.gateway.zenoh import limits

if TYPE_CHECKING:
    from collections.abc import Collection, Iterator

_log = logging.getLogger(__name__)
_FILES: Final = Path("/proc/self/fd")
_STREAMS: Final = frozenset({"tcp", "tls", "ws"})


class SocketTuning:
    """Tunes the sockets of Zenoh's connections, each once.

    Args:
        unsent: Bytes that the kernel may hold unsent of one connection.
    """

    def __init__(self, unsent: int = limits.UNSENT_BYTES) -> None:
        self._unsent = unsent
        self._tuned: frozenset[str] = frozenset()

    def look(self, endpoints: Collection[str]) -> int:
        """Tune the connections to these endpoints, if some are new.

        Args:
            endpoints: Those of the other side of each connection that is up, such as ``tcp/192.0.2.1:7447``.

        Returns:
            The number of sockets that were tuned.
        """
        there = frozenset(endpoints)
        if there == self._tuned:
            return 0
        wanted = {found for each in there - self._tuned if (found := _address(each)) is not None}
        self._tuned = there
        count = sum(self._tune(number, wanted) for number in _sockets()) if wanted else 0
        _log.debug("= %d of Zenoh's sockets hold at most %d bytes unsent", count, self._unsent)
        return count

    def _tune(self, number: int, wanted: Collection[tuple[str, int]]) -> bool:
        try:
            found = socket.socket(fileno=os.dup(number))
        except OSError:
            return False  # closed meanwhile
        with found:
            try:
                if found.family not in (socket.AF_INET, socket.AF_INET6) or found.type != socket.SOCK_STREAM:
                    return False
                address, port = found.getpeername()[:2]
                if (address.removeprefix("::ffff:"), port) not in wanted:
                    return False
                found.setsockopt(socket.IPPROTO_TCP, socket.TCP_NOTSENT_LOWAT, self._unsent)
            except OSError:
                return False  # not connected, or no TCP
        return True


def _sockets() -> Iterator[int]:
    """The numbers of this process's open sockets."""
    try:
        names = [entry.name for entry in _FILES.iterdir()]
    except OSError:
        return  # no /proc, or no file descriptor is left
    for name in names:
        try:
            if stat.S_ISSOCK(os.fstat(int(name)).st_mode):
                yield int(name)
        except OSError:
            continue


def _address(endpoint: str) -> tuple[str, int] | None:
    """Address and port of an endpoint; ``None`` if it is no TCP connection."""
    protocol, _, place = endpoint.partition("/")
    host, _, port = place.partition("?")[0].partition("#")[0].rpartition(":")
    if protocol not in _STREAMS or not port.isdigit():
        return None
    return host.strip("[]").removeprefix("::ffff:"), int(port)
