"""Frames, the units of a connection's byte stream, and the handshake at its start (docs/design/protocol.md).

``Frame`` is the readable form, for all frames that are rare. The data path packs headers by ``pack_data_header`` and
``pack_fragment_header``, reads them by ``unpack_header``, and makes no objects.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from enum import IntEnum
from typing import Final

import rmpa
from rmpa.core import limits as core_limits
from rmpa.core.errors import LimitExceeded, LocalProtocolError, RemoteProtocolError
from rmpa.core.identity import SERIAL_MASK, Guid, Identity, peer_name_problem
from rmpa.core.outbox import ABORT, FIRST, LAST, QueuedMessage
from rmpa.mesh import limits
from rmpa.trust.permissions import TrustReason

Buffer = bytes | bytearray | memoryview

_HEADER: Final = struct.Struct(">IBBHIIQ")
_STAMPS: Final = struct.Struct(">QQ")

# ``(view, offset)`` to ``(length, kind, flags, reserved, route, sequence, stamp_ns)``, unchecked.
unpack_header: Final = _HEADER.unpack_from

_pack: Final = _HEADER.pack

# The flags of a message in one piece.
WHOLE: Final = FIRST | LAST


class FrameKind(IntEnum):
    """Kinds of frames."""

    HELLO = 1
    WELCOME = 2
    REFUSE = 3
    PING = 4
    PONG = 5
    CONTROL = 6
    DATA = 7
    BYE = 8
    ACK = 9
    FENCE = 10
    FENCED = 11
    PACE = 12
    LANE = 13


# Bit of a pace frame's route field: something at the sender depends on the connection, so neither side may rest. Bits
# that are not known are ignored.
PACE_NEEDED: Final = 1
_SHORT: Final = (FrameKind.HELLO, FrameKind.WELCOME, FrameKind.REFUSE, FrameKind.BYE)
# The most bytes of payload that a frame of each kind may claim.
PAYLOAD_MAX: Final[dict[int, int]] = {
    **dict.fromkeys(FrameKind, 0),
    **dict.fromkeys(_SHORT, limits.HELLO_PAYLOAD_MAX),
    FrameKind.PONG: _STAMPS.size,
    FrameKind.CONTROL: limits.CONTROL_PAYLOAD_MAX,
    FrameKind.DATA: limits.DATA_PAYLOAD_MAX,
}


def pack_data_header(length: int, route: int, sequence: int, stamp_ns: int) -> bytes:
    """The 24 bytes in front of a whole message of ``length`` bytes.

    Raises:
        LocalProtocolError: The message is longer than a frame carries, or a number does not fit its field.
    """
    if length > limits.DATA_PAYLOAD_MAX:
        raise LocalProtocolError(f"a message of {length} bytes exceeds a frame's {limits.DATA_PAYLOAD_MAX}")
    try:
        return _pack(length, 7, 3, 0, route, sequence & SERIAL_MASK, stamp_ns)
    except struct.error as error:
        raise LocalProtocolError(f"route {route} or stamp {stamp_ns} does not fit its field: {error}") from None


def pack_fragment_header(parcel: QueuedMessage, length: int, flags: int) -> bytes:
    """The 24 bytes in front of a fragment of ``length`` bytes; the parcel's key is the route."""
    return _pack(length, 7, flags, 0, parcel.key, parcel.sequence & SERIAL_MASK, parcel.stamp_ns)


def check_header(length: int, kind: int, flags: int) -> None:
    """Check what a header claims, before anything of its payload is stored.

    Raises:
        LimitExceeded: The length is beyond what this kind may have.
        RemoteProtocolError: The kind is unknown, or the flags are not possible.
    """
    limit = PAYLOAD_MAX.get(kind)
    if limit is None:
        raise RemoteProtocolError(f"frame of unknown kind {kind}")
    if length > limit:
        raise LimitExceeded(f"{FrameKind(kind).name.lower()} frame", length, limit)
    if kind != FrameKind.DATA:
        if flags & WHOLE != WHOLE:
            name = FrameKind(kind).name.lower()
            raise RemoteProtocolError(f"{name} frame is a fragment; only data comes in fragments")
    elif flags & ABORT:
        if length or flags & WHOLE != LAST:
            raise RemoteProtocolError(f"data frame that aborts its message has {length} bytes, flags {flags:#x}")
    elif not length:
        raise RemoteProtocolError("data frame without data")


@dataclass(frozen=True, slots=True)
class Frame:
    """One whole frame.

    Args:
        kind: Its kind.
        payload: Its bytes; what they mean depends on the kind.
        route: Of data: the route's id, 32 bits; other kinds say what it is there.
        sequence: Of data: counts the messages of the route, 32 bits; likewise.
        stamp_ns: The sender's wall clock, or for data the time of publication; 64 bits.
        flags: ``FIRST`` and ``LAST``; both on a whole message.
    """

    kind: FrameKind
    payload: bytes = b""
    route: int = 0
    sequence: int = 0
    stamp_ns: int = 0
    flags: int = WHOLE

    @classmethod
    def parse(cls, data: Buffer) -> tuple[Frame, int] | None:
        """Read the frame at the start of ``data``.

        Returns:
            The frame and how many bytes it took; ``None`` while it is not complete.

        Raises:
            RemoteProtocolError: Its header claims what is not allowed; raised as soon as the header is complete.
        """
        if len(data) < limits.FRAME_HEADER_BYTES:
            return None
        length, kind, flags, _, route, sequence, stamp_ns = unpack_header(data, 0)
        check_header(length, kind, flags)
        end = limits.FRAME_HEADER_BYTES + length
        if len(data) < end:
            return None
        payload = bytes(data[limits.FRAME_HEADER_BYTES : end])
        return cls(FrameKind(kind), payload, route, sequence, stamp_ns, flags), end

    def serialize(self) -> bytes:
        """The bytes on the wire.

        Raises:
            LocalProtocolError: The payload is longer than this kind allows.
        """
        if len(self.payload) > (limit := PAYLOAD_MAX[self.kind]):
            raise LocalProtocolError(f"{self.kind.name} payload of {len(self.payload)} bytes exceeds {limit}")
        header = _pack(len(self.payload), self.kind, self.flags, 0, self.route, self.sequence, self.stamp_ns)
        return header + self.payload

    def __str__(self) -> str:
        """``DATA route=7 #12 1048580 bytes``; never the payload."""
        where = f" route={self.route} #{self.sequence}" if self.kind is FrameKind.DATA else ""
        flags = f" flags={self.flags}" if self.flags & WHOLE != WHOLE else ""
        size = f" {len(self.payload)} bytes" if self.payload else ""
        return f"{self.kind.name}{where}{flags}{size}"


def pong(ping_stamp_ns: int, came_ns: int, stamp_ns: int) -> Frame:
    """The answer to a ping: its stamp (t1), when it came (t2), and now (t3)."""
    return Frame(FrameKind.PONG, _STAMPS.pack(ping_stamp_ns, came_ns), stamp_ns=stamp_ns)


def parse_pong(payload: Buffer) -> tuple[int, int]:
    """Read t1 and t2, in ns, from a pong's payload.

    Raises:
        RemoteProtocolError: It does not have 16 bytes.
    """
    if len(payload) != _STAMPS.size:
        raise RemoteProtocolError(f"pong of {len(payload)} bytes; it has {_STAMPS.size}")
    t1, t2 = _STAMPS.unpack(payload)
    return t1, t2


# The route field of a bye whose sender is back at once, at another address.
MOVES: Final = 1


def bye(reason: str, *, stamp_ns: int = 0, moves: bool = False) -> Frame:
    """The last frame of a connection."""
    return Frame(FrameKind.BYE, text_payload(reason), route=MOVES if moves else 0, stamp_ns=stamp_ns)


def text_payload(text: str) -> bytes:
    """Text for a refuse or bye frame, cut at what such a frame may carry."""
    return text.encode("utf-8", "replace")[: limits.HELLO_PAYLOAD_MAX - 2]


def parse_text(payload: Buffer) -> str:
    """The text of a refuse or bye frame, safe for a log: one line, nothing unprintable."""
    text = bytes(payload).decode("utf-8", "replace")
    return "".join(c if c.isprintable() else " " for c in text)[:512]


# The handshake. Each side sends its identity, and accepts or refuses (docs/design/protocol.md, "Handshake").
# ``judge`` decides on a hello, ``judge_welcome`` on the answer.


MAGIC: Final = b"RMPA"
VERSION: Final = 3

_PREFIX: Final = struct.Struct(">4sBBH")
_HELLO: Final = struct.Struct(">4sBBHQ16sIQB")
_CODE: Final = struct.Struct(">H")


class Lane(IntEnum):
    """What a connection is for."""

    EXPRESS = 1
    BULK = 2


class Refusal(IntEnum):
    """Why a connection was refused; the numbers are those on the wire, which ``TrustReason`` continues."""

    VERSION = 1
    DOMAIN = 2
    MYSELF = 3
    ALREADY_LINKED = 4
    DUPLICATE = 5
    WRONG_PEER = 6
    MALFORMED = 7
    BUSY = 8
    LANE = 9
    NO_EXPRESS = 10
    FULL = 21


@dataclass(frozen=True, slots=True)
class Refuse:
    """A refusal with its reason: the payload of a refuse frame.

    Args:
        code: One of ``Refusal`` or ``TrustReason``, or a number of a later version.
        text: For people: what is wrong and what to do.
    """

    code: int
    text: str

    @classmethod
    def parse(cls, payload: Buffer) -> Refuse:
        """Read a refuse frame's payload.

        Raises:
            RemoteProtocolError: It has no code.
        """
        if len(payload) < _CODE.size:
            raise RemoteProtocolError(f"refusal of {len(payload)} bytes has no code")
        (code,) = _CODE.unpack_from(payload)
        return cls(code, parse_text(payload[_CODE.size :]))

    def serialize(self) -> bytes:
        """The bytes on the wire."""
        return _CODE.pack(self.code) + text_payload(self.text)

    @property
    def label(self) -> str:
        """The code for the names of counters: ``version``, ``already_linked``, ``code 27``."""
        return _LABELS.get(self.code, f"code {self.code}")

    def __str__(self) -> str:
        """``domain: …``."""
        return f"{self.label}: {self.text}"


_LABELS: Final = {code.value: code.name.lower() for kind in (Refusal, TrustReason) for code in kind}


def _malformed(text: str) -> Refuse:
    return Refuse(Refusal.MALFORMED, f"the handshake is malformed: {text}")


@dataclass(frozen=True, slots=True)
class Hello:
    """The identity and the terms of one side: the payload of hello and welcome frames.

    Args:
        guid: The sender's.
        instance: The sender's, 16 bytes.
        name: The sender's.
        domain: The sender's.
        lease_ms: The sender is dead when it was silent for this long, in milliseconds.
        expected: Hello: the GUID that the sender dialled, ``None`` if it knows only an address; welcome: the
            hello's GUID.
        lane: What the connection is for; an ``int``, because a later version may know more lanes.
    """

    guid: Guid
    instance: bytes
    name: str
    domain: int
    lease_ms: int
    expected: Guid | None = None
    lane: int = Lane.EXPRESS

    @classmethod
    def of(cls, identity: Identity, *, lease: float, expected: Guid | None, lane: int = Lane.EXPRESS) -> Hello:
        """The hello of this identity; ``lease`` in seconds."""
        milliseconds = round(lease * 1000)
        return cls(identity.guid, identity.instance, identity.name, identity.domain, milliseconds, expected, lane)

    @classmethod
    def parse(cls, payload: Buffer) -> Hello | Refuse:
        """Read a hello or welcome; bytes after what is known are for later versions and ignored.

        Returns:
            The hello; the answer to its sender if it is of another version or malformed.
        """
        if len(payload) < _PREFIX.size:
            return _malformed(f"{len(payload)} bytes")
        magic, version, _, _ = _PREFIX.unpack_from(payload)
        if magic != MAGIC:
            return _malformed("it does not begin with RMPA; is this port meant for something else?")
        if version != VERSION:
            text = (
                f"link protocol {version} meets {VERSION} of rmpa {rmpa.__version__}: "
                "install the same release of rmpa on both"
            )
            return Refuse(Refusal.VERSION, text)
        if len(payload) < _HELLO.size:
            return _malformed(f"{len(payload)} bytes, at least {_HELLO.size} are needed")
        _, _, lane, domain, guid, instance, lease_ms, expected, size = _HELLO.unpack_from(payload)
        raw = bytes(payload[_HELLO.size : _HELLO.size + size])
        if len(raw) != size:
            return _malformed("it is shorter than its name")
        name = raw.decode("utf-8", "replace")
        if problem := peer_name_problem(name):
            return _malformed(problem)
        if domain > core_limits.DOMAIN_MAX:
            return _malformed(f"there is no domain {domain}")
        if lease_ms == 0:
            return _malformed("a lease of 0")
        if not Guid(guid).dialable:
            # Discovery would gossip about this GUID, and no beacon may carry such a one.
            return _malformed(f"no peer can be reached at {Guid(guid)}")
        dialled = Guid(expected) if expected else None
        return cls(Guid(guid), instance, name, domain, lease_ms, dialled, lane)

    def serialize(self) -> bytes:
        """The bytes on the wire."""
        name = self.name.encode()
        expected = self.expected.value if self.expected is not None else 0
        numbers = (self.lane, self.domain, self.guid.value, self.instance, self.lease_ms, expected)
        return _HELLO.pack(MAGIC, VERSION, *numbers, len(name)) + name

    @property
    def lease(self) -> float:
        """The lease in seconds, held within ``limits.LINK_LEASE_MIN`` and ``LINK_LEASE_MAX``."""
        return min(max(self.lease_ms / 1000, limits.LINK_LEASE_MIN), limits.LINK_LEASE_MAX)

    @property
    def identity(self) -> Identity:
        """The sender's identity."""
        return Identity(self.guid, self.instance, self.name, self.domain)


class Link:
    """A link with a peer, as the machines of this room know it; the driver's is a subclass.

    Args:
        identity: The peer's, from the handshake; discovery need not have found it.
        remote_endpoint: Address and port of the other end.
        dialled: Whether this side dialled.
    """

    def __init__(self, identity: Identity, remote_endpoint: tuple[str, int], *, dialled: bool) -> None:
        self.identity: Final = identity
        self.remote_endpoint: Final = remote_endpoint
        self.dialled: Final = dialled

    @property
    def alive(self) -> bool:
        """Whether bytes were received lately, at the pace of the link; else the peer may be dead."""
        raise NotImplementedError

    @property
    def stuck(self) -> bool:
        """Whether it is silent although bytes are under way to the peer, so that a new connection may do better."""
        raise NotImplementedError


# The answer to a module for which a mesh has no place; it may join when one becomes free.
FULL: Final = Refuse(
    Refusal.FULL,
    f"this mesh has {limits.MODULES_MAX} modules and no place for one more: make further ones a site of their own "
    "(`rmpa gateway`, docs/guides/sites.md)",
)


def judge(hello: Hello, ours: Identity, link: Link | None = None, *, full: bool = False) -> Refuse | None:
    """Decide on a hello: ``None`` accepts the connection.

    Args:
        hello: The dialler's hello.
        ours: The identity of this agent.
        link: The link that is up with the hello's address and port; ``None``: there is none.
        full: Whether there is no place for one more peer.
    """
    if refuse := _judge_identity(hello, ours):
        return refuse
    if hello.lane not in (Lane.EXPRESS, Lane.BULK):
        return Refuse(Refusal.LANE, f"lane {hello.lane} is not supported here: install the same release on both")
    if hello.expected is not None and hello.expected.place != ours.guid.place:
        text = f"you called {hello.expected}, but this is {ours}: the address changed hands, or two have it"
        return Refuse(Refusal.WRONG_PEER, text)
    same_run = link is not None and link.identity.instance == hello.instance
    if hello.lane == Lane.BULK:
        text = "a bulk lane belongs to an express one, and there is none yet"
        return None if same_run else Refuse(Refusal.NO_EXPRESS, text)
    if link is None:
        return FULL if full else None
    if same_run:
        text = "we are linked already; the link that the lower GUID dialled stays"
        return Refuse(Refusal.ALREADY_LINKED, text) if link.dialled and ours.guid < hello.guid else None
    return _duplicate(hello.guid) if link.alive else None


def judge_welcome(welcome: Hello, ours: Identity, expected: Guid | None) -> Refuse | None:
    """Decide on the answer to a hello of this side: ``None`` accepts the connection.

    Args:
        welcome: The acceptor's welcome.
        ours: The identity of this agent.
        expected: The GUID that was dialled; ``None`` if only the address is known.
    """
    if refuse := _judge_identity(welcome, ours):
        return refuse
    if expected is not None and expected.place != welcome.guid.place:
        who = f"{welcome.name} ({welcome.guid})"
        text = f"we called {expected}, but {who} answers: the address changed hands, or two have it"
        return Refuse(Refusal.WRONG_PEER, text)
    if welcome.expected != ours.guid:
        return Refuse(Refusal.MALFORMED, f"the welcome is for {welcome.expected}, but we are {ours.guid}")
    return None


def _judge_identity(hello: Hello, ours: Identity) -> Refuse | None:
    if hello.instance == ours.instance:
        return Refuse(Refusal.MYSELF, f"{ours.name} reached its own port: one of its addresses leads back to it")
    if hello.domain != ours.domain:
        text = f"domain {hello.domain} meets domain {ours.domain}: start both with the same --domain (ROS_DOMAIN_ID)"
        return Refuse(Refusal.DOMAIN, text)
    if hello.guid.place == ours.guid.place:
        return _duplicate(hello.guid)
    return None


def _duplicate(guid: Guid) -> Refuse:
    address, port = guid.endpoint
    text = f"two live agents are {address}:{port}: give one of them another --port or address (are both behind NAT?)"
    return Refuse(Refusal.DUPLICATE, text)
