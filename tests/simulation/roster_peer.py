"""One simulated agent that has only a roster."""

from __future__ import annotations

import random
from dataclasses import replace
from ipaddress import IPv4Address

from rmpa.core.errors import RemoteProtocolError
from rmpa.core.identity import Guid, Identity
from rmpa.discovery.beacon import Beacon
from rmpa.discovery.membership import MembershipProtocol, PeerEvent
from tests.simulation.network import Address, Network


class RosterPeer:
    """An agent on a host of its own that can be started, killed, ended and started again.

    Args:
        network: Where it lives.
        number: From 1; gives its address and name.
        seeds: Whom it greets by unicast.
        multicast: Whether it uses multicast at all.
    """

    def __init__(
        self, network: Network, number: int, seeds: tuple[Address, ...] = (), *, multicast: bool = True
    ) -> None:
        self.network = network
        self.world = network.world
        self.name = f"peer{number}"
        self.address: Address = (str(IPv4Address(0x0A000000 + number)), 40000)
        self.host = self.address[0]
        self.seeds = seeds
        self.multicast = multicast
        self.run = 0
        self.alive = False
        self.refused = 0
        self.roster: MembershipProtocol
        self.identity: Identity

    def start(self) -> None:
        """Start a new run: new instance, next incarnation."""
        self.run += 1
        self.alive = True
        rng = random.Random(self.world.rng.getrandbits(64))
        self.identity = Identity(Guid.of(*self.address, self.run & 0xFFFF), rng.randbytes(16), self.name)
        self.roster = MembershipProtocol(self.identity, rng=rng.random, multicast=self.multicast)
        self.prepare(rng)
        self.network.sockets[self.address] = self._datagram
        self.world.note(self.name, f"starts run {self.run}")
        self.roster.start(self.world.now)
        self.roster.set_seeds(self.seeds)
        self.flush()

    def prepare(self, rng: random.Random) -> None:
        """Set up more for the new run; nothing here."""

    def kill(self) -> None:
        """Die without a goodbye."""
        self.world.note(self.name, "is killed")
        self._gone()

    def end(self) -> None:
        """Leave with a goodbye."""
        self.world.note(self.name, "ends")
        self.roster.goodbye(self.world.now)
        self.flush()
        self._gone()

    def _gone(self) -> None:
        self.alive = False
        self.network.sockets.pop(self.address, None)

    def view(self) -> tuple[Identity, ...]:
        """The identities in the roster."""
        return tuple(v.run.identity for v in self.roster.endpoints.views() if v.present)

    def troubles(self) -> list[str]:
        """Conflicts that the roster reports."""
        return [text for v in self.roster.endpoints.views() for text in v.conflicts]

    def on_event(self, event: PeerEvent) -> None:
        """Write an event of the roster into the trace."""
        self.world.note(self.name, f"= {event.change} {event.identity}")

    def _datagram(self, data: bytes, source: Address, multicast: bool) -> None:
        try:
            beacon = Beacon.parse(data, 0)
        except RemoteProtocolError as error:
            self.refused += 1
            self.world.note(self.name, f"! {source[0]} {type(error).__name__}")
            return
        self.world.note(self.name, f"< {source[0]} {beacon}")
        self.roster.receive(beacon, source, self.world.now, multicast=multicast)
        self.flush()

    def flush(self) -> None:
        """Send the roster's datagrams, report its events, set its timer."""
        for output in self.roster.outputs():
            data = output.beacon.serialize()
            if output.address is None:
                self.world.note(self.name, f"> group {output.beacon}")
                self.network.multicast(self.address, data)
            else:
                self.world.note(self.name, f"> {output.address[0]} {output.beacon}")
                self.network.unicast(self.address, output.address, data)
        for event in self.roster.events():
            self.on_event(event)
        self._arm()

    _armed: float | None = None

    def _arm(self) -> None:
        when = self.roster.next_timer()
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
        self.roster.handle_timer(self.world.now)
        self.flush()


def stranger(identity: Identity, number: int) -> Identity:
    """An identity of no peer, for forged packets."""
    return replace(identity, guid=Guid.of("10.66.0.1", 1 + number), instance=bytes([number]) * 16, name=f"x{number}")
