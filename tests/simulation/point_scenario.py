"""One message in fragments and a failure at one byte of it: no half message is delivered, and the next one is."""

from __future__ import annotations

from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Final
from unittest import mock

from rmpa.core import limits as core_limits
from rmpa.core.contract import Contract, Priority, Reliability
from rmpa.core.outbox import Outbox
from rmpa.mesh import limits as mesh_limits
from tests.simulation.lanes_scenario import LanesScenario
from tests.simulation.mesh_scenario import socket_of

if TYPE_CHECKING:
    from collections.abc import Iterator

    from rmpa.mesh.io.link import Connection
    from tests.simulation.traffic import TrafficPeer

TROUBLES: Final = ("break", "swallow", "part", "kill receiver", "kill sender", "abort")
_FRAGMENT: Final = 64
_SIZE: Final = 300
_LINKED: Final = 2.0
"""Seconds until two agents that start are linked, for sure."""
_NOTICED: Final = 5.0
"""Seconds after which both sides have noticed a failure: the bulk lane's lease is the longest."""
_HEALED: Final = 8.0
"""Seconds after which they are linked again."""


@dataclass(frozen=True)
class Course:
    """How the message is sent.

    Args:
        reliability: Of its contract.
        priority: Of its contract, and thereby its lane.
        in_parts: Whether it comes from its publisher in parts.
    """

    reliability: Reliability
    priority: Priority
    in_parts: bool


class PointScenario(LanesScenario):
    """Two agents, a message from the first to the second, and what happens when its lane has carried ``point`` bytes.

    Args:
        course: How it goes.
        trouble: One of ``TROUBLES``; empty: none.
        point: Bytes that the lane delivers from the message's publication on until then.
    """

    kind = "point"

    def __init__(self, course: Course, trouble: str, point: int) -> None:
        self.course = course
        self.trouble = trouble
        self.point = point
        self.happened = False
        self.carried = 0
        super().__init__(1, 2, calm=True)
        for peer in self.peers:
            peer.fixed = Contract(reliability=course.reliability, priority=course.priority, depth=1000)
            peer.stopped = True
            peer.seeds = ()
            self.network.segments[peer.host] = 1
            peer.multicast = True

    @contextmanager
    def simulated(self) -> Iterator[None]:
        """As ``LanesScenario``, with fragments short enough to be read in a trace."""
        with (
            super().simulated(),
            mock.patch("rmpa.mesh.io.lane.Outbox", partial(Outbox, fragment=_FRAGMENT)),
            mock.patch.object(core_limits, "FRAGMENT_BYTES", _FRAGMENT),
            mock.patch.object(mesh_limits, "EXPRESS_MESSAGE_MAX", 50),
        ):
            yield

    def run(self) -> None:
        """Link, publish, fail, heal, check."""
        world = self.world
        sender, receiver = self.peers
        with self.simulated():
            for peer in self.peers:
                peer.start()
            world.run(world.now + _LINKED)
            self._publish_one(sender, receiver)
            if self.trouble:
                assert self.happened, f"byte {self.point} was never carried"
            world.run(world.now + _NOTICED)
            self.heal_all()
            world.run(world.now + _HEALED)
            self._publish(sender, 20)
            self._publish(sender, _SIZE)
            world.run(world.now + 2.0)
            self.check_all(sender, receiver)

    def heal_all(self) -> None:
        """Make the network whole and start the killed agents again."""
        self.network.sides = {}
        for peer in self.peers:
            if not peer.alive:
                peer.start()

    def check_all(self, sender: TrafficPeer, receiver: TrafficPeer) -> None:
        """Check that the two last messages came, and the first one as its contract says."""
        inbox = receiver.inboxes[sender.identity.instance]
        *earlier, one, other = inbox.numbers
        assert [one, other] == sender.published[-2:]
        reliable = self.course.reliability is Reliability.RELIABLE
        if not self.trouble or (reliable and self.trouble in ("break", "swallow", "part")):
            assert earlier == sender.published[:1], "it was lost, or came twice"
            assert inbox.flow is not None
            assert not inbox.flow.counts["lost"]
        else:
            assert earlier in ([], sender.published[:1])
        for peer in self.peers:
            assert not peer.mesh.counters["link.malformed"]
            assert not any(process.failures for process in peer.processes)

    def _publish_one(self, sender: TrafficPeer, receiver: TrafficPeer) -> None:
        link = sender.mesh.link(receiver.identity.guid)
        assert link is not None
        lane = link.connection if self.course.priority is Priority.HIGH else link.bulk_connection
        assert lane is not None
        sock = socket_of(lane)
        sock.trap = (self.point, partial(self._happen, sender, receiver, lane))
        before = link.bytes_out
        if self.course.in_parts:
            sender.process.run(sender.publish_in_parts, _SIZE, 70)
        else:
            self._publish(sender, _SIZE)
        self.world.run(self.world.now + 1.0)
        self.carried = link.bytes_out - before
        sock.trap = None

    def _happen(self, sender: TrafficPeer, receiver: TrafficPeer, lane: Connection) -> None:
        self.happened = True
        match self.trouble:
            case "break":
                socket_of(lane).kill_both()
            case "swallow":
                socket_of(lane).swallow()
            case "part":
                self.network.sides = {sender.host: 1}
            case "kill receiver":
                receiver.kill()
            case "kill sender":
                sender.kill()
            case "abort":
                sender.process.run(sender.abort)
