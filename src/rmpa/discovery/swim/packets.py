"""The packets of the failure detector (docs/design/protocol.md, "Failure detection").

They share sockets, magic, version and the first 32 bytes with beacons; their kinds are beyond those of beacons.
``SwimPacket.parse`` raises the errors of ``Beacon.parse`` for the beginning, and ``SwimMalformed`` for the rest.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from enum import IntEnum
from typing import Final

from rmpa.core.errors import RemoteProtocolError
from rmpa.core.guid import Guid
from rmpa.core.sizes import UINT32_MAX
from rmpa.discovery import limits
from rmpa.discovery.beacon import MAGIC, VERSION, sender_of

RUN_BYTES: Final = 8
"""Bytes of an instance id by which news names a run: 64 random bits."""
KIND_AT: Final = 5
"""Where the kind stands in every packet."""
_ACTIVE: Final = 1
_HEAD: Final = struct.Struct(">4sBBHQ16sIQIIB")
_SUBJECT: Final = struct.Struct(">Q8s")
_NEWS: Final = struct.Struct(">Q8sBII")
_BUCKETS: Final = struct.Struct(f">{limits.SYNC_BUCKETS}I")
_WANTED: Final = struct.Struct(">Q")
_UINT64_MAX: Final = (1 << 64) - 1


class SwimKind(IntEnum):
    """What a packet is for; 1 to 15 are left to beacons."""

    PROBE = 16
    """It asks the subject for an ack."""
    ACK = 17
    """The answer to a probe."""
    PROBE_REQUEST = 18
    """It asks the receiver to probe the subject."""
    FORWARDED_ACK = 19
    """The subject has answered the receiver of the request."""
    NACK = 20
    """The subject has not answered the receiver of the request, which itself is well."""
    NEWS = 21
    """News alone; not answered."""
    SYNC = 22
    """It asks for a comparison of the tables of members, of which it has the hashes."""
    TABLE = 23
    """A piece of the table of members, as news; the first one of an answer names the parts that are wanted in
    return."""


_FIRST: Final = min(SwimKind)
_LAST: Final = max(SwimKind)
_WITH_SUBJECT: Final = frozenset(
    {SwimKind.PROBE, SwimKind.ACK, SwimKind.PROBE_REQUEST, SwimKind.FORWARDED_ACK, SwimKind.NACK}
)


class MemberState(IntEnum):
    """What is held of a member; of one incarnation the higher state counts."""

    ALIVE = 0
    SUSPECT = 1
    """It did not answer a probe, and may refute that it has failed."""
    FAILED = 2
    LEFT = 3
    """It said that it leaves."""


@dataclass
class SwimMalformed(RemoteProtocolError):  # noqa: N818 - the name says what happened, as in core.errors
    """Bytes that are no packet of the failure detector."""

    problem: str

    def __str__(self) -> str:
        """Say what is wrong with it."""
        return f"malformed packet of the failure detector: {self.problem}"


@dataclass(frozen=True, slots=True)
class News:
    """What one agent says of a member.

    Args:
        guid: The member's GUID.
        run: The first ``RUN_BYTES`` of its instance id.
        state: Its state.
        incarnation: Only the member itself raises it, to refute a suspicion; 32 bits.
        version: The version of what it offers; 32 bits.
        accuser: Of a suspicion: the run of the agent that had no answer; else empty.

    Raises:
        ValueError: A part is out of its range.
    """

    guid: Guid
    run: bytes
    state: MemberState
    incarnation: int
    version: int
    accuser: bytes = b""

    def __post_init__(self) -> None:
        if not self.guid.dialable:
            raise ValueError(f"no member can be reached at {self.guid}")
        if len(self.run) != RUN_BYTES or len(self.accuser) != (RUN_BYTES if self.state is MemberState.SUSPECT else 0):
            raise ValueError(f"a run is named by {RUN_BYTES} bytes")
        if not (0 <= self.incarnation <= UINT32_MAX and 0 <= self.version <= UINT32_MAX):
            raise ValueError("incarnation and version have 32 bits")

    @property
    def size(self) -> int:
        """Bytes on the wire."""
        return _NEWS.size + len(self.accuser)

    def serialize(self) -> bytes:
        """The bytes on the wire."""
        head = _NEWS.pack(self.guid.value, self.run, self.state, self.incarnation, self.version)
        return head + self.accuser

    def __str__(self) -> str:
        """``suspect 10.0.0.1:40001#7 incarnation 2 version 5``."""
        return f"{self.state.name.lower()} {self.guid} incarnation {self.incarnation} version {self.version}"


@dataclass(frozen=True, slots=True)
class SwimPacket:
    """One packet of the failure detector.

    Args:
        kind: What it is for.
        guid: The sender's GUID.
        instance: The sender's instance id, 16 bytes.
        domain: The sender's domain id.
        sequence: Of a probe or a request: a number of its sender; of an answer: that of what it answers; 32 bits.
        digest: Hash of the sender's table of members; 64 bits.
        incarnation: The sender's own; 32 bits.
        version: The version of what the sender offers; 32 bits.
        active: Whether the sender probes, so that its digest counts.
        subject: GUID and run of the member that a probe, a request or an answer is about; else ``None``.
        news: News of members.
        buckets: Of a ``SYNC``: the hash of each part of the table, 32 bits each; else empty.
        wanted: Of a ``TABLE``: a bit for each part of the table that is wanted in return.

    Raises:
        ValueError: A part is out of its range.
    """

    kind: SwimKind
    guid: Guid
    instance: bytes
    domain: int
    sequence: int
    digest: int = 0
    incarnation: int = 0
    version: int = 0
    active: bool = False
    subject: tuple[Guid, bytes] | None = None
    news: tuple[News, ...] = ()
    buckets: tuple[int, ...] = ()
    wanted: int = 0

    def __post_init__(self) -> None:
        if not self.guid.dialable:
            raise ValueError(f"no member can be reached at {self.guid}")
        if (self.subject is not None) != (self.kind in _WITH_SUBJECT):
            raise ValueError("probes, requests and their answers have a subject, other packets have none")
        if len(self.buckets) != (limits.SYNC_BUCKETS if self.kind is SwimKind.SYNC else 0):
            raise ValueError("a packet for comparison has all hashes, another packet has none")
        if not (0 <= self.digest <= _UINT64_MAX and 0 <= self.wanted <= _UINT64_MAX):
            raise ValueError("digest and wanted parts have 64 bits")

    @classmethod
    def parse(cls, data: bytes, domain: int) -> SwimPacket:
        """Read one packet.

        Args:
            data: The whole packet; bytes after the news are for later versions and ignored.
            domain: The reader's domain id.

        Raises:
            RemoteProtocolError: As for ``Beacon.parse``; ``SwimMalformed`` for what a beacon does not have.
        """
        sender, instance = sender_of(data, domain)
        if len(data) < _HEAD.size:
            raise SwimMalformed(f"only {len(data)} bytes")
        _, _, kind, _, _, _, sequence, digest, incarnation, version, flags = _HEAD.unpack_from(data)
        offset = _HEAD.size
        subject: tuple[Guid, bytes] | None = None
        buckets: tuple[int, ...] = ()
        wanted = 0
        try:
            what = SwimKind(kind)
            if what in _WITH_SUBJECT:
                value, run = _SUBJECT.unpack_from(data, offset)
                subject = Guid(value), run
                offset += _SUBJECT.size
            elif what is SwimKind.SYNC:
                buckets = _BUCKETS.unpack_from(data, offset)
                offset += _BUCKETS.size
            elif what is SwimKind.TABLE:
                (wanted,) = _WANTED.unpack_from(data, offset)
                offset += _WANTED.size
            news = _parse_news(data, offset)
            active = bool(flags & _ACTIVE)
            return cls(
                what,
                sender,
                instance,
                domain,
                sequence,
                digest,
                incarnation,
                version,
                active,
                subject,
                news,
                buckets,
                wanted,
            )
        except (struct.error, IndexError) as error:
            raise SwimMalformed(f"ends after {len(data)} bytes") from error
        except ValueError as error:
            raise SwimMalformed(str(error)) from error

    def serialize(self) -> bytes:
        """The packet; never longer than ``limits.SWIM_PACKET_MAX`` if the news keep to ``room_for_news``."""
        head = _HEAD.pack(
            MAGIC,
            VERSION,
            self.kind,
            self.domain,
            self.guid.value,
            self.instance,
            self.sequence,
            self.digest,
            self.incarnation,
            self.version,
            _ACTIVE if self.active else 0,
        )
        if self.subject is not None:
            head += _SUBJECT.pack(self.subject[0].value, self.subject[1])
        elif self.buckets:
            head += _BUCKETS.pack(*self.buckets)
        elif self.kind is SwimKind.TABLE:
            head += _WANTED.pack(self.wanted)
        return head + bytes((len(self.news),)) + b"".join([news.serialize() for news in self.news])

    @property
    def run(self) -> bytes:
        """The sender's run, as news names it."""
        return self.instance[:RUN_BYTES]

    def __str__(self) -> str:
        """``probe 7 of 10.0.0.1:40001#7 about 10.0.0.2:40001#1, 2 news``."""
        about = f" about {self.subject[0]}" if self.subject is not None else ""
        news = f", {len(self.news)} news" if self.news else ""
        return f"{self.kind.name.lower()} {self.sequence} of {self.guid}{about}{news}"


def is_swim(data: bytes) -> bool:
    """Whether a packet is one of the failure detector, if it is one of this protocol at all."""
    return len(data) > KIND_AT and _FIRST <= data[KIND_AT] <= _LAST


def room_for_news(kind: SwimKind) -> int:
    """Bytes of news that one packet of a kind has room for; there may be at most 255 of them."""
    if kind in _WITH_SUBJECT:
        rest = _SUBJECT.size
    elif kind is SwimKind.SYNC:
        rest = _BUCKETS.size
    else:
        rest = _WANTED.size if kind is SwimKind.TABLE else 0
    return limits.SWIM_PACKET_MAX - _HEAD.size - rest - 1


def _parse_news(data: bytes, offset: int) -> tuple[News, ...]:
    count = data[offset]
    offset += 1
    found = []
    for _ in range(count):
        value, run, number, incarnation, version = _NEWS.unpack_from(data, offset)
        offset += _NEWS.size
        state = MemberState(number)
        accuser = b""
        if state is MemberState.SUSPECT:
            accuser = data[offset : offset + RUN_BYTES]
            offset += RUN_BYTES
        found.append(News(Guid(value), run, state, incarnation, version, accuser))
    return tuple(found)
