"""What a link's socket is asked for, and what the system does not grant."""

from __future__ import annotations

import fcntl
import socket
import sys
import termios
from typing import TYPE_CHECKING

from rmpa.core import limits

if TYPE_CHECKING:
    from rmpa.core.config import LaneSettings
    from rmpa.core.counters import Counters


def tune_express(sock: socket.socket, lanes: LaneSettings, counters: Counters) -> None:
    """Set up the express lane: no Nagle, dead peers noticed, little waits in the kernel, first in every queue."""
    _tune(sock, limits.LINK_UNSENT_BYTES, lanes.express_dscp, lanes.express_priority, counters)


def tune_bulk(sock: socket.socket, lanes: LaneSettings, counters: Counters) -> None:
    """Set up the bulk lane: as little as possible waits in the kernel, behind everything else."""
    _tune(sock, limits.BULK_UNSENT_BYTES, lanes.bulk_dscp, lanes.bulk_priority, counters)


def unacknowledged(sock: socket.socket) -> int:
    """Bytes that were sent and that the other side's kernel has not acknowledged, those not sent yet included."""
    try:
        return int.from_bytes(fcntl.ioctl(sock, termios.TIOCOUTQ, bytes(4)), sys.byteorder)
    except OSError:
        return 0


def _tune(sock: socket.socket, unsent: int, dscp: int, priority: int, counters: Counters) -> None:
    """Set the options of a lane's socket.

    IP_TOS comes before SO_PRIORITY because setting it sets the priority too. An option that the system refuses
    only costs quality of service: it is counted as ``link.option_refused`` and the link runs on.
    """
    options = (
        (socket.IPPROTO_TCP, socket.TCP_NODELAY, 1),
        (socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT, round(limits.LINK_UNACKED * 1000)),
        (socket.IPPROTO_TCP, socket.TCP_NOTSENT_LOWAT, unsent),
        (socket.IPPROTO_IP, socket.IP_TOS, dscp << 2),
        (socket.SOL_SOCKET, socket.SO_PRIORITY, priority),
    )
    for level, name, value in options:
        try:
            sock.setsockopt(level, name, value)
        except OSError:
            counters.add("link.option_refused")
