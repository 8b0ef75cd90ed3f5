"""Options and kernel statistics of the connections' sockets."""

from __future__ import annotations

import fcntl
import socket
import struct
import sys
import termios
from typing import TYPE_CHECKING, Final

from rmpa.mesh import limits

if TYPE_CHECKING:
    from rmpa.config.settings import LaneSettings
    from rmpa.core.counters import Counters


_RTO_MIN_US: Final = 45
_REPETITION: Final = (
    (16, 1, 0),  # TCP_THIN_LINEAR_TIMEOUTS, Linux 2.6.34
    (44, limits.EXPRESS_RTO_MAX_MS, 120_000),  # TCP_RTO_MAX_MS, 6.15
    (_RTO_MIN_US, limits.EXPRESS_RTO_MIN_US, 200_000),  # TCP_RTO_MIN_US, 6.18
)
"""Options with their values on the express lane, and Linux's own; Python's ``socket`` lacks these numbers of
linux/tcp.h."""
_BBR: Final = b"bbr"
_INFO_BYTES: Final = 256
_MIN_RTT: Final = struct.Struct("=148xI")  # microseconds, in struct tcp_info of linux/tcp.h
_DELIVERY_RATE: Final = struct.Struct("=160xQ")  # bytes a second, since Linux 4.9


def tune_express(sock: socket.socket, lanes: LaneSettings, counters: Counters) -> None:
    """Set up the express lane: no Nagle, a time-out for dead peers, a short kernel queue, a high priority.

    Lost packets are repeated sooner where the kernel has options for it: TCP waits 0.2 s before the first repetition,
    and each time twice as long as before.
    """
    _tune(sock, limits.EXPRESS_UNSENT_BYTES, lanes.express_dscp, lanes.express_priority, counters)
    for name, quick, _ in _REPETITION:
        _try(sock, name, quick)


def tune_bulk(sock: socket.socket, lanes: LaneSettings, counters: Counters) -> None:
    """Set up the bulk lane: the shortest kernel queue, a low priority, congestion control by BBR if it is permitted.

    BBR keeps the queues short that are behind this host, as in a radio or router; *cubic* fills them until packets
    are lost, and commands wait there too. A route's own ``congctl`` replaces what is set before a connection is made,
    so this is called again then.
    """
    _tune(sock, limits.BULK_UNSENT_BYTES, lanes.bulk_dscp, lanes.bulk_priority, counters)
    for name, _, usual in _REPETITION:  # the lane of an accepted connection is known late
        _try(sock, name, usual)
    _try(sock, socket.TCP_CONGESTION, _BBR)


def bound_queue(sock: socket.socket) -> None:
    """Bound what a bulk lane without BBR has on the way: two round trips and ``limits.BULK_QUEUE`` at its rate.

    To be called from time to time while it sends: where the window itself was the bound, it grows.
    """
    try:
        if sock.getsockopt(socket.IPPROTO_TCP, socket.TCP_CONGESTION, 16).rstrip(b"\0") == _BBR:
            return
        info = sock.getsockopt(socket.IPPROTO_TCP, socket.TCP_INFO, _INFO_BYTES)
        rate: int = _DELIVERY_RATE.unpack_from(info)[0]
        window = round(rate * (2e-6 * _MIN_RTT.unpack_from(info)[0] + limits.BULK_QUEUE))
        if not rate:
            return
        window = max(limits.BULK_WINDOW_MIN, min(window, limits.BULK_WINDOW_MAX))
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, window // 2)  # the kernel doubles it
    except (OSError, struct.error):
        return


def repeats_quickly() -> bool:
    """Whether this kernel lets the express lane repeat lost packets within milliseconds."""
    with socket.socket() as sock:
        return _try(sock, _RTO_MIN_US, limits.EXPRESS_RTO_MIN_US)


def may_use_bbr() -> bool:
    """Whether this process may use BBR for the bulk lane."""
    with socket.socket() as sock:
        return _try(sock, socket.TCP_CONGESTION, _BBR)


def unacknowledged(sock: socket.socket) -> int:
    """Bytes written to a socket that the remote kernel has not acknowledged, unsent ones included; 0 if closed."""
    if sock.fileno() < 0:
        return 0
    try:
        return int.from_bytes(fcntl.ioctl(sock, termios.TIOCOUTQ, bytes(4)), sys.byteorder)
    except OSError:
        return 0


def limit_segments(sock: socket.socket, counters: Counters) -> None:
    """Before connecting: let both sides send packets that fit through usual tunnels, whatever the path's MTU is."""
    try:
        sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_MAXSEG, limits.SEGMENT_BYTES + limits.TIME_STAMP_BYTES)
    except OSError:
        counters.add("link.option_refused")


def _try(sock: socket.socket, name: int, value: int | bytes) -> bool:
    """Set an option of TCP that many kernels lack or do not permit."""
    try:
        sock.setsockopt(socket.IPPROTO_TCP, name, value)
    except OSError:
        return False
    return True


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
