"""One module of a large simulated mesh: the real machines of its agent, and what it knows of the others' offers."""

from __future__ import annotations

import functools
import random
import time
from dataclasses import dataclass
from ipaddress import IPv4Address
from typing import TYPE_CHECKING, Final

from rmpa.core.identity import Guid, Identity
from rmpa.core.timers import earliest
from rmpa.discovery.membership import RESTARTED, MembershipProtocol
from rmpa.mesh import limits as mesh_limits
from rmpa.mesh.frames import Hello
from rmpa.mesh.keepalive import rest_lease
from rmpa.mesh.peering import Peering
from tests.simulation.large_network import TCP_BYTES, Link

if TYPE_CHECKING:
    from rmpa.discovery.announcing import OutgoingBeacon
    from rmpa.discovery.beacon import Address, Beacon
    from rmpa.discovery.membership import PeerEvent
    from rmpa.mesh.peering import PeeringOutput
    from tests.simulation.large_network import LargeNetwork

TOPICS: Final = 20
"""Topics that each module offers."""
CATALOGUE_BYTES: Final = 2 * 24 + 80 * TOPICS + 2 * 52
"""Bytes of the catalogue over a link: two frames, some 80 bytes a topic, and their packets' headers."""
HANDSHAKE_BYTES: Final = 2 * (24 + 60 + 52)
_NEVER: Final = float("inf")


@dataclass(slots=True)
class Tally:
    """What all modules together saw; counted where it happens, because 256 of them know 65,280 peers."""

    members: int = 0
    """Pairs (module, member that it knows)."""
    lost_falsely: int = 0
    """Living and reachable members that a module lost."""
    links: int = 0
    links_made: int = 0


class Module:
    """An agent without sockets and without ROS.

    Args:
        network: Where it lives.
        number: From 1; gives its address and name.
        tally: Shared by all modules.
    """

    def __init__(self, network: LargeNetwork, number: int, tally: Tally) -> None:
        self.network = network
        self.tally = tally
        self.name = f"module{number}"
        self.address: Address = (str(IPv4Address(0x0A000000 + number)), 40000)
        self.run = 0
        self.alive = False
        self.reachable = True
        self.links: dict[int, Link] = {}
        self._used: dict[int, Identity] = {}
        """The peers of the links that are used."""
        self.offers = 1
        self.wants: set[int] = set()
        """The places of peers whose data is used here: their links stay."""
        self.known: dict[int, tuple[bytes, int]] = {}
        """The run and the version of the offers that are known, by the peer's place."""
        self.lost_at: dict[int, float] = {}
        """When the link to each peer was lost, by its place; only if ``watch`` is set."""
        self.watch = False
        self.metered = False
        self.cpu = 0.0
        """Processor time of this module's machines in seconds, if ``metered``."""
        self._armed = _NEVER
        """When the earliest wake-up comes that is planned; ``_NEVER``: none is."""
        self._flushing = False
        self._ids = 0

    @property
    def place(self) -> int:
        """The place of its GUID, the same in each run."""
        return Guid.of(*self.address, 1).place

    # --- life -------------------------------------------------------------------------------------------------

    def start(self) -> None:
        """Start a new run."""
        self.run += 1
        self.alive = True
        rng = random.Random(self.network.world.rng.getrandbits(64))
        now = self.network.now
        self.identity = Identity(Guid.of(*self.address, self.run), rng.randbytes(16), self.name)
        self.membership = MembershipProtocol(self.identity, rng=rng.random)
        self.peering = Peering(self.identity, rng=rng.random, alive=self._is_alive)
        self._armed = _NEVER
        self.network.join(self)
        self.membership.start(now)
        self.flush()

    def _is_alive(self, number: int) -> bool:
        """Whether the other end of a link sends; of one at rest the code asks it when it matters."""
        link = self.links.get(number)
        if link is None or not link.up:
            return False
        other = link.other(self)
        return other.alive and other.run == link.runs[link.ends.index(other)] and self._reaches(other)

    def kill(self) -> None:
        """The machine loses its power: no goodbye, and no reset of its connections."""
        self.alive = False
        self.network.leave(self)
        self.tally.members -= len(self._present())
        for link in self.links.values():
            self._find_dead(link)
        self.known, self.links = {}, {}

    def _find_dead(self, link: Link) -> None:
        """The other end notices by its lease; sooner where something depends on the link."""
        other = link.other(self)
        lease = self._lease(link)
        at = 0 if link.ends[0] is other else 1
        self.tally.links -= link.up
        link.up = False
        run = other.run
        self.network.world.after(lease, lambda: other.link_ended(link.ids[at], "silent", run, silent=True))

    def _lease(self, link: Link) -> float:
        """Seconds of silence after which the other end of a link counts it as lost."""
        if link.used:
            return mesh_limits.EXPRESS_LEASE
        return rest_lease(len(self.known))

    def part(self, link: Link) -> None:
        """The path of a link that leads across a partition is gone: both ends notice by their leases."""
        if self._reaches(link.other(self)) or not link.up:
            return
        lease = self._lease(link)
        self.network.world.after(lease, lambda: self._end(link, "silent", silent=True))

    def _present(self) -> set[int]:
        return {view.run.identity.guid.place for view in self.membership.peers() if view.present}

    def change_offers(self) -> None:
        """A node of this module advertises something new."""
        self.offers += 1
        for link in list(self.links.values()):
            self.network.later(functools.partial(link.other(self).learn, self))

    # --- packets ----------------------------------------------------------------------------------------------

    def hear_beacon(self, beacon: Beacon, source: Address, *, multicast: bool) -> None:
        """A beacon came: nine of ten packets of a large mesh, after which the other machines have nothing to do."""
        if not self.alive:
            return
        if self.metered:
            began = time.process_time()
            self._take_beacon(beacon, source, multicast)
            self.cpu += time.process_time() - began
        else:
            self._take_beacon(beacon, source, multicast)

    def _take_beacon(self, beacon: Beacon, source: Address, multicast: bool) -> None:
        """Take in a beacon. A heartbeat of a known peer changes nothing for the other machines: they are spared."""
        membership = self.membership
        membership.receive(beacon, source, self.network.now, multicast=multicast)
        outputs, events = membership.outputs(), membership.events()
        if outputs or events:
            self._deliver(outputs, events)
        else:
            self._arm(membership.next_timer())

    # --- outputs, events, time --------------------------------------------------------------------------------

    def flush(self) -> None:
        """Do what the machines ask for, until they are quiet; set the timer."""
        if not self._flushing:
            self._deliver(self.membership.outputs(), self.membership.events())

    def _deliver(self, outputs: list[OutgoingBeacon], events: list[PeerEvent]) -> None:
        """Begin with these of the membership protocol."""
        self._flushing = True
        busy = True
        while busy:
            busy = False
            for output in outputs:
                size = len(output.beacon.serialize())
                if output.address is None:
                    self.network.multicast(self, output.beacon, size)
                else:
                    self.network.unicast(self, output.address, output.beacon, size)
            for event in events:
                busy = True
                self._on_event(event)
            for order in self.peering.take():
                busy = True
                self._on_order(order)
            outputs, events = self.membership.outputs(), self.membership.events()
            busy = busy or bool(outputs or events)
        self._flushing = False
        self._arm(earliest(self.membership.next_timer(), self.peering.next_timer()))

    def _arm(self, when: float | None) -> None:
        """Plan a wake-up, unless an earlier one is planned. One that turns out to be too early does no harm."""
        if when is None or when >= self._armed:
            return
        self._armed = when
        run = self.run
        self.network.world.at(when, lambda: self._wake(when, run))

    def _wake(self, when: float, run: int) -> None:
        if self._armed == when:
            self._armed = _NEVER
        if not self.alive or run != self.run:
            return
        began = time.process_time() if self.metered else 0.0
        now = self.network.now
        self.membership.handle_timer(now)
        self.peering.handle_timer(now)
        self.flush()
        if self.metered:
            self.cpu += time.process_time() - began

    def _on_event(self, event: PeerEvent) -> None:
        now, identity = self.network.now, event.identity
        if event.change == "found":
            self.tally.members += 1
            self.peering.peer_found(identity, now, event.source[0] if event.source else None)
        elif event.change == "changed":
            self.peering.peer_found(identity, now)
        elif event.change == "lost":
            self.tally.members -= 1
            if event.reason != RESTARTED:
                self._judge_loss(identity, event.reason)
            self.peering.peer_gone(identity.guid)
            self._forget(identity)
        elif event.change == "doubted":
            self._check_link(identity.guid.place)

    def _check_link(self, place: int) -> None:
        """Wake a link whose other end may be gone: it ends if that end does not answer."""
        for number, link in list(self.links.items()):
            if link.other(self).place == place and not self._is_alive(number):
                ended = functools.partial(self.link_ended, number, "silent", self.run, silent=True)
                self.network.world.after(mesh_limits.WAKE_TIMEOUT, ended)

    def _judge_loss(self, identity: Identity, reason: str) -> None:
        module = self.network.modules.get(identity.guid.endpoint)
        if module is not None and module.identity.instance == identity.instance and self._reaches(module):
            self.tally.lost_falsely += 1
            self.network.world.note(self.name, f"lost {identity.name} falsely: {reason}")

    def _reaches(self, module: Module) -> bool:
        return self.network.reaches(self.address[0], module.address[0])

    def _forget(self, identity: Identity) -> None:
        place = identity.guid.place
        known = self.known.get(place)
        if known is not None and known[0] == identity.instance:
            del self.known[place]

    # --- links ------------------------------------------------------------------------------------------------

    def _on_order(self, order: PeeringOutput) -> None:
        match order:
            case ("dial", guid, endpoints, _):
                run = self.run
                self.network.later(lambda: self._dialled(guid, endpoints[0], run), times=3.0)
            case ("up", link_id):
                link = self.links[link_id]
                self._used[link_id] = identity = link.other(self).identity
                self._linked(link, identity)
            case ("down", link_id, _):
                identity = self._used.pop(link_id)
                if self.watch:
                    self.lost_at[identity.guid.place] = self.network.now
                self.membership.link_down(identity.guid, self.network.now, identity.instance)
            case ("close", link_id, reason) if link_id in self.links:
                self._end(self.links[link_id], reason)
            case _:
                pass

    def _dialled(self, guid: Guid, endpoint: Address, run: int) -> None:
        """A dial has got its answer, or will not get one."""
        if not self.alive or run != self.run:
            return
        now = self.network.now
        other = self.network.modules.get(endpoint)
        if other is None or not self._reaches(other):
            self.network.world.after(mesh_limits.DIAL_TIMEOUT, lambda: self._unanswered(guid, run))
            return
        if not self.peering.dial_opened(guid, now):
            return
        hello = Hello.of(self.identity, lease=mesh_limits.EXPRESS_LEASE, expected=guid)
        self.network.count("link", HANDSHAKE_BYTES + TCP_BYTES, 1)
        refuse = other.peering.judge(hello, now)
        if refuse is not None:
            self.peering.dial_refused(guid, refuse, now, endpoint)
            self.flush()
            return
        self.tally.links_made += 1
        self.tally.links += 1
        link = Link((self, other), (self.next_id(), other.next_id()), (self.run, other.run))
        self.links[link.ids[0]] = other.links[link.ids[1]] = link
        other.peering.link_up(link.ids[1], self.identity, now, dialled=False)
        other.flush()
        self.peering.link_up(link.ids[0], other.identity, now, dialled=True, endpoint=endpoint)
        self.flush()

    def _unanswered(self, guid: Guid, run: int) -> None:
        if self.alive and run == self.run:
            self.peering.dial_failed(guid, "no answer", self.network.now)
            self.flush()

    def next_id(self) -> int:
        """A number for a link."""
        self._ids += 1
        return self._ids

    def _linked(self, link: Link, identity: Identity) -> None:
        now = self.network.now
        self.membership.link_up(identity, now, identity.guid.endpoint)
        other = link.other(self)
        self.network.later(lambda: self.learn(other))
        link.used = link.used or other.identity.guid.place in self.wants

    def learn(self, other: Module) -> None:
        """A peer's catalogue came over the link."""
        if not (self.alive and other.alive):
            return
        offers = (other.identity.instance, other.offers)
        self.network.count("catalogue", CATALOGUE_BYTES, 1)
        self.known[other.identity.guid.place] = offers

    def _end(self, link: Link, reason: str, *, silent: bool = False) -> None:
        self.tally.links -= link.up
        link.up = False
        for end, number, run in zip(link.ends, link.ids, link.runs, strict=True):
            end.link_ended(number, reason, run, silent=silent)

    def link_ended(self, number: int, reason: str, run: int, *, silent: bool = False) -> None:
        """A link is over."""
        if self.alive and run == self.run and self.links.pop(number, None) is not None:
            self.peering.link_down(number, reason, self.network.now, silent=silent)
            self.flush()
