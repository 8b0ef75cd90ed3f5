"""Options and kernel statistics of the connections' sockets."""

from __future__ import annotations

import contextlib
import fcntl
import socket
import struct
import sys
import termios
from typing import TYPE_CHECKING, Final

from rmpa.mesh import limits
from rmpa.mesh.path_mtu import TcpSample

if TYPE_CHECKING:
    from rmpa.config.settings import LaneSettings
    from rmpa.core.counters import Counters


_INFO_BYTES: Final = 256
_RETRANSMITS: Final = struct.Struct("=2xB")  # tcpi_retransmits of struct tcp_info, linux/tcp.h
_SND_MSS: Final = struct.Struct("=16xI")
_PMTU: Final = struct.Struct("=60xI")
_RTT: Final = struct.Struct("=68xI")  # microseconds
_BYTES_ACKED: Final = struct.Struct("=120xQ")
_DELIVERED: Final = struct.Struct("=192xI")  # since Linux 4.18
_TIME_STAMPS: Final = 12
_QUICK_REPETITION: Final = (
    (16, 1),  # TCP_THIN_LINEAR_TIMEOUTS, Linux 2.6.34
    (44, limits.EXPRESS_RTO_MAX_MS),  # TCP_RTO_MAX_MS, 6.15
    (45, limits.EXPRESS_RTO_MIN_US),  # TCP_RTO_MIN_US, 6.18
)
"""Numbers of linux/tcp.h, which Python's ``socket`` lacks."""
_BULK_CONGESTION: Final = b"bbr"


def tune_express(sock: socket.socket, lanes: LaneSettings, counters: Counters) -> None:
    """Set up the express lane: no Nagle, a time-out for dead peers, a short kernel queue, a high priority.

    Lost packets are repeated sooner where the kernel has options for it: TCP waits 0.2 s before the first repetition,
    and each time twice as long as before.
    """
    _tune(sock, limits.EXPRESS_UNSENT_BYTES, lanes.express_dscp, lanes.express_priority, counters)
    for name, value in _QUICK_REPETITION:
        with contextlib.suppress(OSError):
            sock.setsockopt(socket.IPPROTO_TCP, name, value)


def tune_bulk(sock: socket.socket, lanes: LaneSettings, counters: Counters) -> None:
    """Set up the bulk lane: the shortest kernel queue, a low priority, congestion control by BBR if it is permitted.

    BBR keeps the queues short that are behind this host, as in a radio or router; *cubic* fills them until packets are
    lost, and commands wait there too. A route's own ``congctl`` replaces what is set before a connection is made, so
    this is called again then.
    """
    _tune(sock, limits.BULK_UNSENT_BYTES, lanes.bulk_dscp, lanes.bulk_priority, counters)
    with contextlib.suppress(OSError):
        sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_CONGESTION, _BULK_CONGESTION)


def unacknowledged(sock: socket.socket) -> int:
    """Bytes written to a socket that the remote kernel has not acknowledged, unsent ones included; 0 if closed."""
    if sock.fileno() < 0:
        return 0
    try:
        return int.from_bytes(fcntl.ioctl(sock, termios.TIOCOUTQ, bytes(4)), sys.byteorder)
    except OSError:
        return 0


def sample(sock: socket.socket) -> TcpSample | None:
    """The kernel's statistics of a connection; ``None`` where it has none, or the socket is closed."""
    try:
        info = sock.getsockopt(socket.IPPROTO_TCP, socket.TCP_INFO, _INFO_BYTES)
        return TcpSample(
            unacknowledged(sock),
            _RETRANSMITS.unpack_from(info)[0],
            _BYTES_ACKED.unpack_from(info)[0],
            _DELIVERED.unpack_from(info)[0],
            _RTT.unpack_from(info)[0] * 1e-6,
        )
    except (OSError, struct.error):
        return None


def packet_bytes(sock: socket.socket) -> int | None:
    """Bytes of the largest packet that the kernel sends on a connection, headers included; ``None`` if unknown."""
    try:
        info = sock.getsockopt(socket.IPPROTO_TCP, socket.TCP_INFO, _INFO_BYTES)
        mss: int = _SND_MSS.unpack_from(info)[0]
        mtu: int = _PMTU.unpack_from(info)[0]
    except (OSError, struct.error):
        return None
    return min(mtu, mss + limits.TCP_HEADERS)


def limit_segments(sock: socket.socket, segment: int, counters: Counters) -> None:
    """Before connecting: let both sides send segments of at most ``segment`` bytes (TCP_MAXSEG)."""
    try:
        sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_MAXSEG, segment + _TIME_STAMPS)
    except OSError:
        counters.add("link.option_refused")


def reset_at_close(sock: socket.socket) -> None:
    """Make ``close`` drop unsent data and reset the connection: an orderly end would have to wait for lost data."""
    with contextlib.suppress(OSError):
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))


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
