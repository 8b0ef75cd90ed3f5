"""What a link's socket is asked for, and what the system does not grant."""

from __future__ import annotations

import socket
from typing import TYPE_CHECKING, Final

from rmpa.core import limits

if TYPE_CHECKING:
    from rmpa.core.counters import Counters

_TOS_CS6: Final = 0xC0
_PRIORITY: Final = 6


def tune_express(sock: socket.socket, counters: Counters) -> None:
    """Set up the express lane: no Nagle, dead peers noticed, little waiting in the kernel, the first place in queues.

    IP_TOS comes before SO_PRIORITY because setting it sets the priority too. An option that the system refuses
    only costs quality of service: it is counted as ``link.option_refused`` and the link runs on.
    """
    options = (
        (socket.IPPROTO_TCP, socket.TCP_NODELAY, 1),
        (socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT, round(limits.LINK_UNACKED * 1000)),
        (socket.IPPROTO_TCP, socket.TCP_NOTSENT_LOWAT, limits.LINK_UNSENT_BYTES),
        (socket.IPPROTO_IP, socket.IP_TOS, _TOS_CS6),
        (socket.SOL_SOCKET, socket.SO_PRIORITY, _PRIORITY),
    )
    for level, name, value in options:
        try:
            sock.setsockopt(level, name, value)
        except OSError:
            counters.add("link.option_refused")
