"""Finds path-MTU black holes, which are paths that drop large packets silently (RFC 2923), and remembers them.

If a tunnel or a firewall drops packets that are too large for it, and the ICMP message that should report this is
lost, a TCP connection stalls at its first large segment, while small ones still get through. The remedy of Linux
(``net.ipv4.tcp_mtu_probing``, RFC 4821) is off by default, and a socket cannot switch it on for itself. Therefore
both lanes of a link are watched. If the data of one lane stalls while a small packet on the other lane is answered,
there is a black hole: from then on messages to that address are sent in smaller segments.

Pure: samples of TCP_INFO and ``now`` go in, judgements come out.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum, auto
from typing import Final

from rmpa.mesh import limits

_REMEDY: Final = (
    "give the interface or tunnel on the way its true MTU (`ip link set dev NAME mtu N`), or let ICMP 'fragmentation "
    "needed' through"
)


@dataclass(frozen=True, slots=True)
class TcpSample:
    """What the kernel reports of one connection, by ``TCP_INFO`` and ``SIOCOUTQ``.

    Args:
        queued: Bytes written and not acknowledged, those that have not been sent yet included.
        retransmits: Consecutive retransmission time-outs of the oldest segment.
        acked: Bytes acknowledged since the connection began.
        delivered: Segments that arrived since then.
        rtt: Round-trip time as the kernel estimates it, seconds.
    """

    queued: int
    retransmits: int
    acked: int
    delivered: int
    rtt: float


class Progress(Enum):
    """Whether the data of a connection gets through."""

    FLOWING = auto()
    """No data waits, or the waiting data is being acknowledged."""
    WAITING = auto()
    """Retransmitted data has not been acknowledged yet: sample again soon."""
    STALLED = auto()
    """Large segments are retransmitted in vain; a small packet by another connection shows whether size matters."""
    BLACK_HOLE = auto()
    """A small packet was answered, but the large segments retransmitted after the answer were lost again."""


class StallWatch:
    """Judges one connection by the samples of it.

    Args:
        segment: Bytes of the largest segment, or ``None`` for as many as the kernel chooses.
        now: Monotonic seconds.
        before: The former watch of the same connection, from before its segment size changed.
    """

    def __init__(self, segment: int | None, now: float, before: StallWatch | None = None) -> None:
        self.segment = segment
        self._least = smaller(segment) or segment or 0
        """Bytes of the next smaller segment size; for the smallest size that size itself."""
        self._since = now
        self._acked, self._delivered = before.counted if before is not None else (0, 0)
        self._begun = self._acked
        self._passed = False
        self._retransmits = 0
        self._proof: int | None = None
        """The number of time-outs in the present stall when the small packet was answered."""
        self._repeated: float | None = None
        """When data was first seen to be retransmitted after that answer."""

    @property
    def counted(self) -> tuple[int, int]:
        """Bytes acknowledged, and segments that arrived, since the connection began."""
        return self._acked, self._delivered

    @property
    def acked(self) -> int:
        """Bytes acknowledged so far, with segments of this size."""
        return self._acked - self._begun

    @property
    def waiting(self) -> bool:
        """Whether retransmitted data has not been acknowledged."""
        return self._retransmits > 0

    def idle(self, now: float) -> None:
        """Record that no data waits to be acknowledged."""
        self._since = now
        self._retransmits = 0
        self._proof = self._repeated = None

    def look(self, sample: TcpSample, now: float) -> Progress:
        """Judge the next sample.

        If segments larger than the next smaller size were acknowledged before, the path's MTU is not the cause of the
        stall. Such a connection ends by its time-out, and the next connection is judged anew.

        After a cable is plugged in again, a small packet gets through before TCP retransmits the large segments,
        because its retransmissions become rarer. Therefore only those after the small packet's answer count.
        """
        acked, delivered = sample.acked - self._acked, sample.delivered - self._delivered
        self._acked, self._delivered = sample.acked, sample.delivered
        if acked > 0 or not sample.queued:
            self._passed = self._passed or acked > self._least * max(delivered, 1)
            self.idle(now)
            return Progress.FLOWING
        self._retransmits = sample.retransmits
        if not sample.retransmits:
            return Progress.FLOWING
        if self._passed or sample.queued < self._least:
            return Progress.WAITING
        if self._proof is None:
            return Progress.STALLED if now - self._since >= limits.STALL_SUSPECTED else Progress.WAITING
        if self._repeated is None:
            self._repeated = now if sample.retransmits > self._proof else None
            return Progress.WAITING
        late = now - self._repeated >= max(limits.STALL_ANSWER, 1.5 * sample.rtt)
        return Progress.BLACK_HOLE if late else Progress.WAITING

    def small_passed(self) -> None:
        """Record that the peer answered a small packet that was sent during the stall."""
        if self.waiting and self._proof is None:
            self._proof = self._retransmits

    @property
    def suspected(self) -> bool:
        """Whether a connection that ends now probably met a black hole, although the evidence is incomplete.

        With a long round trip the lease is over before TCP has retransmitted a segment often enough.
        """
        return self._repeated is not None


def smaller(segment: int | None) -> int | None:
    """The next smaller size of segments, in bytes; ``None`` if there is none."""
    return next((size for size in limits.SEGMENT_BYTES if segment is None or size < segment), None)


@dataclass(frozen=True, slots=True)
class PathProblem:
    """What is wrong with a path, ready to read.

    Args:
        text: What was seen.
        remedy: What to do.
    """

    text: str
    remedy: str

    def __str__(self) -> str:
        """Both, for the log."""
        return f"{self.text}; {self.remedy}"


class PathState(Enum):
    """What is known of the path to an address."""

    TRYING = auto()
    """Large packets seem to be lost; smaller ones are tried."""
    BLACK_HOLE = auto()
    """Large packets are lost, and smaller ones arrive."""
    NO_HELP = auto()
    """Smaller packets did not arrive either: the packet size is not the cause."""


@dataclass(slots=True)
class _Path:
    segment: int | None
    state: PathState
    until: float


class PathTable:
    """The addresses to which large packets do not get through; forgotten after a while, and then tried again."""

    def __init__(self) -> None:
        self._paths: dict[str, _Path] = {}

    def segment(self, address: str, now: float) -> int | None:
        """Bytes that a segment to an address may have; ``None``: the kernel decides."""
        path = self._paths.get(address)
        if path is not None and now >= path.until:
            del self._paths[address]
            path = None
        return path.segment if path is not None else None

    def black_hole(self, address: str, segment: int | None, now: float) -> PathState | None:
        """Record that a connection with segments of at most ``segment`` bytes has met a black hole.

        Returns:
            ``TRYING`` if the next connection uses smaller segments, ``NO_HELP`` if there are none, and ``None`` if
            that was known.
        """
        known = self.segment(address, now)
        path = self._paths.get(address)
        if path is not None and path.state is PathState.NO_HELP:
            return None
        if known is not None and (segment is None or known < segment):
            return PathState.TRYING  # another connection to the same address has met it before
        size = smaller(segment)
        state = PathState.NO_HELP if size is None else PathState.TRYING
        self._paths.pop(address, None)
        while len(self._paths) >= limits.PATHS_MAX:
            del self._paths[next(iter(self._paths))]
        kept = limits.PATH_NO_HELP if size is None else limits.PATH_REMEMBERED
        self._paths[address] = _Path(size, state, now + kept)
        return state

    def flowed(self, address: str, segment: int | None, acked: int) -> bool:
        """Record that ``acked`` bytes of a connection with segments of at most ``segment`` bytes were acknowledged.

        Returns:
            Whether this shows for the first time that the smaller segments solved the problem.
        """
        path = self._paths.get(address)
        if path is None or path.state is not PathState.TRYING or segment is None or path.segment != segment:
            return False
        if acked < segment * limits.PATH_PROVEN_SEGMENTS:
            return False
        path.state = PathState.BLACK_HOLE
        return True

    def problem(self, address: str, segment: int | None, now: float) -> PathProblem | None:
        """What is wrong with the path to an address; ``None`` if nothing is known.

        Args:
            address: Numeric.
            segment: The segment size of the present connection, which may last longer than this table remembers.
            now: Monotonic seconds.
        """
        self.segment(address, now)
        path = self._paths.get(address)
        if path is not None and path.state is PathState.NO_HELP:
            text = f"large messages to {address} are not acknowledged, small ones are, and small packets do not help"
            return PathProblem(
                text, f"`ping -M do -s 1372 {address}` tries a large packet; see the firewalls between"
            )
        size = path.segment if path is not None and path.segment is not None else segment
        if size is None:
            return None
        if path is not None and path.state is PathState.TRYING:
            return PathProblem(f"large packets to {address} are not acknowledged, small ones are", _REMEDY)
        return PathProblem(
            f"large packets do not get through to {address} (a path-MTU black hole): messages go in packets of at "
            f"most {size + limits.TCP_HEADERS} bytes",
            _REMEDY,
        )
