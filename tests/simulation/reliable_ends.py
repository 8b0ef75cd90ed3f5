"""The two ends of one reliable route over simulated byte streams: frames, fragments, acknowledgements, resuming."""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Final

from rmpa.core import limits as core_limits
from rmpa.core.outbox import FIRST, LAST
from rmpa.mesh import frames
from rmpa.mesh import limits as mesh_limits
from rmpa.mesh.frames import Frame, FrameKind
from rmpa.mesh.reliable import ReliableReceiver, ReliableSender, ResumeTable
from tests.mesh.reliable_pair import taken

if TYPE_CHECKING:
    from collections.abc import Callable

    from tests.simulation.network import Address, End, Network

FRAGMENT: Final = 16
"""Bytes of payload that one frame carries here, so that small messages have several."""
ROUTE: Final = 5
EXPORTER: Final[Address] = ("10.0.0.1", 40001)
IMPORTER: Final = "10.0.0.2"
FIRSTS: Final = (1, 1, 0xFFFFFFF0, (1 << 31) - 8)
_REDIAL: Final = 0.01


@dataclass(frozen=True)
class Bounds:
    """The bounds of a sender: depth and bytes of what it keeps, and of its window."""

    depth: int = 100_000
    max_bytes: int = 1 << 30
    window_messages: int = 256
    window_bytes: int = 1 << 20


class Wire:
    """One end of one link: bytes to frames and back.

    Args:
        end: The byte stream's end.
        on_frame: Called with each whole frame.
        on_lost: Called when the stream is gone.
        allow: Called with a number of bytes that came; how many of these are read before ``on_spent`` is called.
        on_spent: What happens then; it may close the link.
    """

    def __init__(
        self,
        end: End,
        on_frame: Callable[[Wire, Frame], None],
        on_lost: Callable[[Wire], None],
        allow: Callable[[int], int],
        on_spent: Callable[[], None],
    ) -> None:
        self.end = end
        self.epoch: int | None = None
        self.pieces: list[bytes] | None = None
        """Fragments of the message whose last one has not come yet; ``None`` where it is skipped."""
        self.on_lost = on_lost
        self._on_frame = on_frame
        self._allow = allow
        self._on_spent = on_spent
        self._buffer = b""
        end.on_bytes = self._bytes
        end.on_close = lambda _: on_lost(self)

    def control(self, **fields: Any) -> None:
        """Send a control message."""
        self.end.send(Frame(FrameKind.CONTROL, json.dumps(fields).encode()).serialize())

    def data(self, sequence: int, stamp_ns: int, payload: bytes) -> None:
        """Send one message in its fragments."""
        for start in range(0, len(payload), FRAGMENT):
            flags = FIRST * (start == 0) | LAST * (start + FRAGMENT >= len(payload))
            piece = payload[start : start + FRAGMENT]
            self.end.send(Frame(FrameKind.DATA, piece, ROUTE, sequence, stamp_ns, flags).serialize())

    def cut(self) -> None:
        """Break the stream: noticed here now, by the other end a little later; what is in flight is lost."""
        self.end.close(reset=True)
        self.on_lost(self)

    def _bytes(self, data: bytes) -> None:
        allowed = self._allow(len(data))
        self._read(data[:allowed])
        if allowed < len(data):
            self._on_spent()
            self._read(data[allowed:])

    def _read(self, data: bytes) -> None:
        self._buffer += data
        header = mesh_limits.FRAME_HEADER_BYTES
        while len(self._buffer) >= header and not self.end.closed:
            length, kind, flags, _, route, sequence, stamp_ns = frames.unpack_header(self._buffer, 0)
            if len(self._buffer) < header + length:
                break
            payload = self._buffer[header : header + length]
            self._buffer = self._buffer[header + length :]
            self._on_frame(self, Frame(FrameKind(kind), payload, route, sequence, stamp_ns, flags))


class Exporter:
    """Publishes numbered messages to the peer that opens the route; parks its sender while there is none."""

    def __init__(
        self, network: Network, bounds: Bounds, allow: Callable[[int], int], on_spent: Callable[[], None]
    ) -> None:
        self.network = network
        self.world = network.world
        self.published = 0
        self.gave_up = False
        """Whether it ever dropped what waited for too long."""
        self.starts: dict[int, int] = {}
        """Epoch to the number of its first message."""
        self.senders: dict[int, ReliableSender] = {}
        self._bounds = bounds
        self._budget = (allow, on_spent)
        self._wires: list[Wire] = []
        network.listeners[EXPORTER] = self._accept
        self._start()

    def _start(self) -> None:
        self.table: ResumeTable[str] = ResumeTable()
        self.sender: ReliableSender | None = None
        self.wire: Wire | None = None
        self._newest = 0

    def restart(self) -> None:
        """Die and start again at once, without state."""
        self.world.note("exporter", "restarts")
        for wire in self._wires:
            wire.end.close(reset=True)
        self._wires.clear()
        self._start()

    def publish(self, size: int) -> None:
        """One more message: its number, its size and filling."""
        payload = self.published.to_bytes(4, "big") + size.to_bytes(4, "big") + bytes(size)
        self.published += 1
        self._expire()
        if self.wire is None:
            gone = self.table.offer(IMPORTER, payload, self.published)
            assert not gone
        elif self.sender is not None:
            self.sender.offer(payload, self.published)
            self._pump()
        if self.sender is not None:
            assert self.sender.pending <= self._bounds.depth
            assert self.sender.in_flight <= self._bounds.window_messages
            assert self.sender.pending_bytes <= max(self._bounds.max_bytes, len(payload))

    def _accept(self, end: End) -> None:
        self._wires.append(Wire(end, self._frame, self._lost, *self._budget))
        end.begin()

    def _frame(self, wire: Wire, frame: Frame) -> None:
        message = json.loads(frame.payload)
        if message["op"] == "open":
            if message["number"] < self._newest:  # overtaken by its successor: the mesh keeps the one link
                wire.end.close()
                return
            self._newest = message["number"]
            self._open(wire, message["epoch"], message["after"])
        elif wire is self.wire and self.sender is not None:
            self.sender.acknowledged(message["sequence"])
            self._pump()

    def _open(self, wire: Wire, epoch: int | None, after: int | None) -> None:
        if self.wire is not None:
            old = self.wire
            self._park()
            old.end.close()
        self.wire = wire
        sender = self.table.claim(IMPORTER)
        self.sender = sender if sender is not None and sender.epoch == epoch else None
        if self.sender is None:
            number = self.world.rng.getrandbits(32)
            first = self.world.rng.choice(FIRSTS)
            self.starts[number] = self.published
            bounds = self._bounds
            self.sender = self.senders[number] = ReliableSender(
                bounds.depth, bounds.max_bytes, bounds.window_messages, bounds.window_bytes, number, first=first
            )
        else:
            assert after is not None
            self.sender.resume(after)
        self.world.note("exporter", f"opens epoch {self.sender.epoch} after {after}, keeps {self.sender.pending}")
        wire.control(op="opened", epoch=self.sender.epoch, first=self.sender.first, following=self.sender.following)
        self._pump()

    def _pump(self) -> None:
        if self.sender is not None and self.wire is not None:
            for message in taken(self.sender):
                self.wire.data(message.sequence, message.stamp_ns, message.payload)

    def _lost(self, wire: Wire) -> None:
        if wire in self._wires:
            self._wires.remove(wire)
        if wire is self.wire:
            self.world.note("exporter", "lost the link")
            self._park()

    def _park(self) -> None:
        assert self.sender is not None
        assert self.table.park(IMPORTER, self.sender, self.world.now + core_limits.RESUME_WINDOW) == []
        self.wire = self.sender = None

    def _expire(self) -> None:
        for key in self.table.expire(self.world.now):
            self.world.note("exporter", f"gives {key} up")
            self.gave_up = True


@dataclass(frozen=True)
class Received:
    """A message as the importer's subscriber got it."""

    epoch: int
    number: int
    gap: int


@dataclass
class Life:
    """One run of the importer."""

    receiver: ReliableReceiver = field(default_factory=ReliableReceiver)
    received: list[Received] = field(default_factory=list)
    epochs: list[int] = field(default_factory=list)
    gaps: int = 0
    """Messages that are said to be lost."""
    duplicates: int = 0
    """Messages that came again or too late."""
    unseen: dict[int, int] = field(default_factory=dict)
    """By epoch: messages that are said to be lost behind the last one that came."""


class Importer:
    """Dials until it has a link, asks for the route behind what it has, and acknowledges."""

    def __init__(self, network: Network, allow: Callable[[int], int], on_spent: Callable[[], None]) -> None:
        self.network = network
        self.world = network.world
        self.lives = [Life()]
        self.wire: Wire | None = None
        self.wires: list[Wire] = []
        self.wants = True
        """Whether it dials; not so during an outage."""
        self._budget = (allow, on_spent)
        self._dials = 0
        self.dial()

    @property
    def receiver(self) -> ReliableReceiver:
        """Of the present life."""
        return self.lives[-1].receiver

    def restart(self) -> None:
        """Die and start again at once, without state."""
        self.world.note("importer", "restarts")
        for wire in self.wires:
            wire.end.close(reset=True)
        self.wires.clear()
        self.wire = None
        self.lives.append(Life())
        self.dial()

    def dial(self) -> None:
        """Try for a link; a present one stays until its successor stands, and is read for as long as it lasts."""
        self._dials += 1
        number = self._dials

        def connected(end: End | None) -> None:
            assert end is not None
            if number != self._dials or not self.wants:
                end.close(reset=True)
                return
            self.wire = Wire(end, self._frame, self._lost, *self._budget)
            self.wires.append(self.wire)
            epoch, after = self.receiver.position() or (None, None)
            self.world.note("importer", f"opens after {after}")
            self.wire.control(op="open", number=number, epoch=epoch, after=after)
            end.begin()

        if self.wants:
            self.network.dial(IMPORTER, EXPORTER, connected)

    def _frame(self, wire: Wire, frame: Frame) -> None:
        life = self.lives[-1]
        if frame.kind is FrameKind.CONTROL:
            message = json.loads(frame.payload)
            if wire is self.wire:  # a late word of an old link must not bring an old epoch back
                wire.epoch = message["epoch"]
                if not life.epochs or life.epochs[-1] != wire.epoch:
                    life.epochs.append(message["epoch"])
                life.receiver.begin(message["epoch"], message["first"])
                skipped = life.receiver.skip(message["following"])
                life.gaps += skipped
                life.unseen[message["epoch"]] = life.unseen.get(message["epoch"], 0) + skipped
                if skipped:
                    self.world.note("importer", f"< {skipped} are lost")
        elif wire.epoch is not None:
            self._data(wire, wire.epoch, frame, life)
        self._acknowledge()

    def _data(self, wire: Wire, epoch: int, frame: Frame, life: Life) -> None:
        if frame.flags & FIRST:
            wire.pieces = [] if life.receiver.gap(frame.sequence, epoch) is not None else None
        if wire.pieces is not None:
            wire.pieces.append(frame.payload)
        if not frame.flags & LAST:
            return
        # A message that only its last fragment shows to be a duplicate came over two links at once.
        missing = life.receiver.accept(frame.sequence, epoch, self.world.now, len(frame.payload))
        life.duplicates += missing is None
        if missing is not None:
            life.gaps += missing
            assert wire.pieces is not None
            whole = b"".join(wire.pieces)
            number, size = int.from_bytes(whole[:4], "big"), int.from_bytes(whole[4:8], "big")
            assert len(whole) == 8 + size, "a half message was delivered"
            assert frame.stamp_ns == number + 1
            gap = missing + life.unseen.pop(epoch, 0)
            life.received.append(Received(epoch, number, gap))
            self.world.note("importer", f"< {number} gap {gap}")

    def _acknowledge(self) -> None:
        """What is due; only on a link whose sender has said which epoch it sends."""
        position = self.receiver.position()
        if self.wire is None or position is None or self.wire.epoch != position[0]:
            return
        sequence = self.receiver.due_ack(self.world.now)
        if sequence is not None:
            self.wire.control(op="ack", sequence=sequence)
        elif (due := self.receiver.next_timer()) is not None:
            self.world.at(due, self._acknowledge)

    def _lost(self, wire: Wire) -> None:
        if wire in self.wires:
            self.wires.remove(wire)
        if wire is self.wire:
            self.world.note("importer", "lost the link")
            self.wire = None
            self.world.after(_REDIAL * self.world.rng.random(), self._redial)

    def _redial(self) -> None:
        if self.wire is None:
            self.dial()
