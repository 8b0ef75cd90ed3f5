"""One simulated agent that has only a failure detector. What beacons would bring is brought by the scenario."""

from __future__ import annotations

import random
from collections import Counter, deque
from ipaddress import IPv4Address
from typing import TYPE_CHECKING

from rmpa.core.guid import Guid
from rmpa.core.identity import Identity
from rmpa.discovery.swim.events import MemberFailed, MemberHeardOf, MemberLeft, MemberOffers, MemberSuspected
from rmpa.discovery.swim.failure_detector import FailureDetector
from rmpa.discovery.swim.packets import SwimPacket

if TYPE_CHECKING:
    from tests.simulation.network import Address
    from tests.simulation.swim_scenario import SwimScenario

UDP_HEADERS = 28
"""Bytes of IP and UDP in front of each packet."""


class SwimMember:
    """An agent that can be started, killed, stopped (SIGSTOP) and cut off.

    Args:
        scenario: Where it lives.
        number: From 1; gives its address and name.
    """

    def __init__(self, scenario: SwimScenario, number: int) -> None:
        self.scenario = scenario
        self.world = scenario.world
        self.number = number
        self.name = f"m{number}"
        self.address: Address = (str(IPv4Address(0x0A000000 + number)), 40000)
        self.run = 0
        self.alive = False
        self.stopped_until = 0.0
        self.slow = 0.0
        """The longest pause of a process without CPU: each of its turns comes up to this many seconds late."""
        self.packets = self.bytes = 0
        self.events: Counter[str] = Counter()
        self.offers: dict[bytes, int] = {}
        self.members: dict[bytes, SwimMember] = {}
        """What the membership protocol holds, by instance."""
        self._runs: dict[int, bytes] = {}
        self._waiting: deque[tuple[bytes, Address]] = deque()
        self._armed: float | None = None

    def start(self) -> None:
        """Start a new run."""
        self.run += 1
        self.alive = True
        self.stopped_until = 0.0
        rng = random.Random(self.world.rng.getrandbits(64))
        self.identity = Identity(Guid.of(*self.address, self.run & 0xFFFF), rng.randbytes(16), self.name)
        self.detector = FailureDetector(self.identity, rng=rng.random)
        self.members = {}
        self._runs = {}
        self._waiting.clear()
        self.world.note(self.name, f"starts run {self.run}")
        self.detector.set_active(self.world.now, active=True)
        self.flush()

    def kill(self) -> None:
        """Die."""
        self.world.note(self.name, "is killed")
        self.alive = False

    def leave(self) -> None:
        """Leave in order."""
        self.world.note(self.name, "leaves")
        self.detector.leave()
        self.flush()
        self.alive = False

    def stop(self, seconds: float) -> None:
        """Do nothing for a while, as after SIGSTOP; packets wait in the kernel's buffer."""
        self.world.note(self.name, f"is stopped for {seconds:.2f} s")
        self.stopped_until = max(self.stopped_until, self.world.now + seconds)
        self.world.at(self.stopped_until, self._resume)

    def meet(self, other: SwimMember) -> None:
        """A beacon of another one, or a link with it, makes it a member."""
        if other.identity.instance not in self.members:
            if (former := self._runs.get(other.number)) is not None:
                self.members.pop(former, None)
            self._runs[other.number] = other.identity.instance
            self.members[other.identity.instance] = other
            self.detector.add(other.identity, self.world.now, other.address)

    def datagram(self, data: bytes, source: Address) -> None:
        """A packet has come to this host."""
        if not self.alive:
            return
        if self.world.now < self.stopped_until or self._waiting:
            if len(self._waiting) < 500:  # as many as the kernel's buffer holds
                self._waiting.append((data, source))
            return
        if self.slow and self.world.rng.random() < 0.5:
            self.stop(self.world.rng.random() * self.slow)
            self._waiting.append((data, source))
            return
        self._read(data, source)

    def _read(self, data: bytes, source: Address) -> None:
        self.detector.receive(SwimPacket.parse(data, 0), source, self.world.now)
        self.flush()

    def _resume(self) -> None:
        if not self.alive or self.world.now < self.stopped_until:
            return
        if self.world.rng.random() < 0.5:  # a timer and a socket that are due together: either may come first
            self._turn()
        while self._waiting:
            self._read(*self._waiting.popleft())
        self._turn()

    def flush(self) -> None:
        """Send the packets, take in the events, set the timer."""
        for output in self.detector.outputs():
            data = output.packet.serialize()
            self.packets += 1
            self.bytes += len(data) + UDP_HEADERS
            self.scenario.send(self, output.address, data)
        for event in self.detector.events():
            self.events[type(event).__name__] += 1
            if isinstance(event, MemberHeardOf):
                self.scenario.greet(self, event.guid)
            elif isinstance(event, MemberOffers):
                self.offers[event.instance] = event.version
            elif isinstance(event, MemberFailed | MemberLeft):
                self.members.pop(event.instance, None)
                self.scenario.lost(self, event)
            elif isinstance(event, MemberSuspected):
                self.scenario.suspected(self, event)
        self._arm()

    def _arm(self) -> None:
        when = self.detector.next_timer()
        if when is None or (self._armed is not None and self._armed <= when):
            return
        self._armed = when
        run = self.run
        self.world.at(when, lambda: self._wake(when, run))

    def _wake(self, when: float, run: int) -> None:
        if self._armed == when:
            self._armed = None
        if not self.alive or run != self.run:
            return
        if self.world.now < self.stopped_until:
            return  # the resumption comes to it
        if self.slow and self.world.rng.random() < 0.5:
            self.stop(self.world.rng.random() * self.slow)
            return
        self._turn()

    def _turn(self) -> None:
        self.detector.handle_timer(self.world.now)
        self.flush()
