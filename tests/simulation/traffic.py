"""Messages between simulated agents: the real flows and route senders of the bridge over the real lanes of the mesh.

Each agent has one source, and opens a route to those of all others. The control messages of the bridge are replaced
by two, ``open`` and ``opened``; everything that touches a message is the agent's own code.
"""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Any, Final, cast

from rmpa.bridge.data.export import ExportFlow, ExportRoute
from rmpa.bridge.data.reception import ImportFlow, LinkTime
from rmpa.bridge.data.route import RouteBegin
from rmpa.bridge.data.route_sender import ReliableRouteSender
from rmpa.bridge.messages import Source
from rmpa.bridge.peer import PeerRun
from rmpa.core.contract import Contract, Priority, Reliability
from rmpa.core.identity import serial_add
from rmpa.core.statistics import Counters
from rmpa.mesh.frames import FrameKind
from tests.bridge.io.doubles import Outlet
from tests.simulation.mesh_peer import MeshPeer

if TYPE_CHECKING:
    import random

    from rmpa.bridge.data.route_sender import RouteSender
    from rmpa.mesh.io.link import PeerLink

_RING: Final = bytes(range(256))
_SIZES: Final = (20, 300, 300, 5000, 9000, 40_000, 150_000, 400_000)
_SOURCE: Final = Source("/t", "/n")
_CUT_THROUGH: Final = 131_072
_HEAD: Final = 12
"""Bytes in front: the length, as in TCPROS, and the message's number."""


def framed(number: int, size: int) -> bytes:
    """A message with its length in front; each byte depends on its place and on the message's number."""
    start = number * 31 & 0xFF
    body = number.to_bytes(8, "big") + (_RING * (size // 256 + 2))[start : start + size]
    return len(body).to_bytes(4, "little") + body


def number_of(message: bytes) -> int:
    """The number of a message, which must be whole and unchanged."""
    number = int.from_bytes(message[4:_HEAD], "big")
    assert message == framed(number, len(message) - _HEAD), f"message {number} is not what was published"
    return number


class Inbox(Outlet):
    """The messages that one agent received from one run of another one, by their numbers.

    Args:
        contract: What holds for it.
    """

    def __init__(self, contract: Contract) -> None:
        super().__init__()
        self.contract = contract
        self.flow: ImportFlow | None = None
        self.numbers: list[int] = []
        self.breaks = 0

    def take(self, message: bytes) -> None:
        """A whole message is there."""
        number = number_of(message)
        assert not self.numbers or number > self.numbers[-1], f"message {number} came behind {self.numbers[-1]}"
        self.numbers.append(number)


class TrafficPeer(MeshPeer):
    """An agent with a source; each run has a contract of its own."""

    stopped = False
    """Whether it only publishes on request."""
    fixed: Contract | None = None
    """The contract, where it is not random."""

    def prepare(self, rng: random.Random) -> None:
        """Begin with nothing published or received."""
        self.contract = self.fixed or Contract(
            reliability=rng.choice(list(Reliability)),
            priority=rng.choice([Priority.NORMAL, Priority.NORMAL, *Priority]),
            depth=1000,
        )
        self.published: list[int] = []
        """Numbers of the messages that this run published whole, in order; later runs use other numbers."""
        self.first: dict[bytes, int] = {}
        """By instance: the number of the first message that a reliable receiver must get."""
        self.inboxes: dict[bytes, Inbox] = {}
        self.senders: dict[tuple[PeerLink, int], RouteSender] = {}
        self.flows: dict[tuple[PeerLink, int], ImportFlow] = {}
        self.times: dict[PeerLink, LinkTime] = {}
        self._peers: dict[bytes, int] = {}
        self._place: dict[bytes, int] = {}
        self._epoch = 0
        self._next = self.run * 1_000_000
        self._streaming = False
        self._rng = rng
        self.aborted = 0
        super().prepare(rng)
        self.exports = ExportFlow()
        self.process.run(self._publish_later)

    # --- the publisher --------------------------------------------------------------------------------------

    def _publish_later(self) -> None:
        self.process.call_later(self._rng.uniform(0.2, 4.0), self._burst)

    def _burst(self) -> None:
        if self.stopped:
            return
        for _ in range(self._rng.choice([1, 1, 3, 6])):
            self.publish(self._rng.choice(_SIZES))
        self._publish_later()

    def publish(self, size: int) -> None:
        """Publish a message; a large one perhaps in parts, and perhaps not to its end."""
        if self._streaming:
            return  # its publisher's connection carries one at a time
        if size >= _CUT_THROUGH and self._rng.random() < 0.7:
            self.publish_in_parts(size)
            return
        self._next += 1
        self.published.append(self._next)
        self.exports.message(memoryview(framed(self._next, size)))

    def publish_in_parts(self, size: int, part: int | None = None) -> None:
        """Publish a message in parts of ``part`` bytes each."""
        self._next += 1
        self._streaming = True
        message = framed(self._next, size)
        self.exports.begin(len(message))
        self._stream(message, 0, self._next, part)

    def abort(self) -> None:
        """The publisher dies, perhaps in the middle of a message."""
        if self._streaming:
            self._streaming = False
            self.aborted += 1
            self.exports.abort()

    def _stream(self, message: bytes, at: int, number: int, part: int | None) -> None:
        if not self._streaming or self._next != number:
            return
        if not self.stopped and self._rng.random() < 0.05:
            self.abort()
            return
        size = part or self._rng.choice([100_000, 300_000] if self.stopped else [1000, 30_000, 130_000, 300_000])
        if at + size >= len(message):
            self._streaming = False
            self.published.append(number)
        self.exports.part(memoryview(message)[at : at + size])
        if self._streaming:
            self.process.call_later(self._rng.uniform(0, 0.02), self._stream, message, at + size, number, part)

    # --- links ----------------------------------------------------------------------------------------------

    def link_up(self, link: PeerLink) -> None:
        """Open a route to the peer's source; stop waiting for its earlier run."""
        super().link_up(link)
        instance = link.identity.instance
        for other in [i for i in self.inboxes if i != instance and self._place[i] == link.guid.place]:
            self._remove(self._peers.pop(other))
            if (flow := self.inboxes.pop(other).flow) is not None:
                flow.close()
        self._peers.setdefault(instance, len(self._place) + 1)
        self._place[instance] = link.guid.place
        inbox = self.inboxes.setdefault(instance, Inbox(self.contract))
        self.times[link] = LinkTime()
        position = inbox.flow.position if inbox.flow is not None else None
        epoch, after = position or (0, 0)
        self._send_message(link, op="open", epoch=epoch, after=after)

    def link_down(self, link: PeerLink, reason: str) -> None:
        """Drop half messages; suspend reliable routes."""
        super().link_down(link, reason)
        self.times.pop(link, None)
        for key in [key for key in self.flows if key[0] is link]:
            link.routes.pop(key[1])
            self.flows.pop(key).torn()
            inbox = self.inboxes[link.identity.instance]
            if inbox.contract.reliability is not Reliability.RELIABLE and inbox.flow is not None:
                inbox.flow.close()
                inbox.flow = None
        for key in [key for key in self.senders if key[0] is link]:
            sender = self.senders.pop(key)
            peer = self._peers[link.identity.instance]
            if isinstance(sender, ReliableRouteSender):
                sender.suspend()
            else:
                self._remove(peer)

    def lane_lost(self, link: PeerLink) -> None:
        """Do what the bridge does."""
        self.note(f"= link {link.id} lost its bulk lane")
        for (of, _), flow in self.flows.items():
            if of is link and flow.contract.priority is not Priority.HIGH:
                flow.torn()
        for (of, _), sender in list(self.senders.items()):
            if of is link:
                sender.lane_lost()

    def clock_known(self, link: PeerLink) -> None:
        """Do what the bridge does."""
        if link in self.times:
            self.times[link].set(link.clock_offset, link.clock_error)

    # --- what comes -----------------------------------------------------------------------------------------

    def control(self, link: PeerLink, payload: bytes) -> None:
        """Take the two control messages."""
        said: dict[str, Any] = json.loads(payload)
        if said["op"] == "open":
            self._opened(link, said["epoch"], said["after"])
        else:
            self._begin(link, said)

    def mark(self, link: PeerLink, kind: FrameKind, route: int, sequence: int) -> None:
        """An acknowledgement, or a fence's answer."""
        sender = self.senders.get((link, route))
        if sender is not None and kind is FrameKind.ACK:
            sender.acknowledged(sequence)
        elif sender is not None and kind is FrameKind.FENCED:
            sender.fenced(sequence)

    # --- inside ---------------------------------------------------------------------------------------------

    def _send_message(self, link: PeerLink, **what: object) -> None:
        self.note(f"> link {link.id} {what}")
        link.send_control(json.dumps(what).encode())

    def _opened(self, link: PeerLink, epoch: int, after: int) -> None:
        """A peer opens the only route of this link."""
        peer = self._peers[link.identity.instance]
        route = self.exports.routes.get(peer)
        sender = route.sender if route is not None else None
        contract = {"reliability": self.contract.reliability, "priority": self.contract.priority}
        if epoch and isinstance(sender, ReliableRouteSender) and sender.sender.epoch == epoch:
            self._send_message(link, op="opened", epoch=epoch, first=sender.sender.first, **contract)
            sender.resume(link, 1, after)
        else:
            self._epoch += 1
            self.first[link.identity.instance] = self._next + 1
            begin = RouteBegin(self._epoch, serial_add(self.exports.number, 1))
            self._send_message(link, op="opened", epoch=begin.epoch, first=begin.first, **contract)
            self._remove(peer)
            route = self.exports.routes[peer] = ExportRoute(PeerRun(peer=peer), _SOURCE, 1, self.contract)
            sender = self.exports.add(route, link, begin)
        self.senders[link, 1] = sender

    def _remove(self, peer: int) -> None:
        if (route := self.exports.routes.pop(peer, None)) is not None:
            self.exports.remove(route)

    def _begin(self, link: PeerLink, said: dict[str, Any]) -> None:
        inbox = self.inboxes[link.identity.instance]
        inbox.contract = Contract(
            reliability=Reliability(said["reliability"]), priority=Priority(said["priority"]), depth=1000
        )
        if inbox.flow is None:
            nothing = (lambda _: None, lambda: None)
            inbox.flow = ImportFlow(cast("Any", inbox), inbox.contract, self.times[link], Counters(), *nothing)
        known = inbox.flow.position is not None
        inbox.breaks += not inbox.flow.bind(link, 1, said["epoch"], said["first"]) and known
        self.flows[link, 1] = link.routes[1] = inbox.flow
