"""The beacons that an agent sends: their numbers, their gossip, and the rate of its answers. Sans-I/O."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from rmpa.core.identity import serial_add
from rmpa.discovery import limits
from rmpa.discovery.beacon import Beacon, BeaconKind
from rmpa.discovery.events import SendMulticast, SendUnicast
from rmpa.discovery.gossip import GossipSelector
from rmpa.discovery.pacing import is_many
from rmpa.discovery.unicast import AnswerLimit

if TYPE_CHECKING:
    from rmpa.core.counters import Counters
    from rmpa.core.identity import Guid, Identity
    from rmpa.discovery.beacon import Address
    from rmpa.discovery.endpoint import PeerInstance
    from rmpa.discovery.endpoint_table import EndpointTable
    from rmpa.discovery.events import Output

_NEVER: Final = float("-inf")


class BeaconSender:
    """Numbers the beacons of one agent and puts gossip into them. It decides nothing about when one is sent.

    Args:
        identity: This agent's own.
        endpoints: The peers.
        lease: Seconds of silence after which peers may count this agent as gone.
        counters: Where answers that were held back are counted.
        multicast: Whether to send to the group at all.
    """

    def __init__(
        self, identity: Identity, endpoints: EndpointTable, lease: float, counters: Counters, *, multicast: bool
    ) -> None:
        self.identity = identity
        """This agent's own, as the next beacon will carry it."""
        self.multicast = multicast
        """Whether it sends to the group at all."""
        self.closed = False
        """Whether nothing is sent any more: a goodbye was the last beacon."""
        self._endpoints = endpoints
        self._lease_ms = round(lease * 1000)
        self._counters = counters
        self._sequence = 0
        self._gossip_selector = GossipSelector()
        self._answers = AnswerLimit()
        self._outputs: list[Output] = []

    def take(self) -> list[Output]:
        """The beacons to send, in order; each is returned once."""
        taken, self._outputs = self._outputs, []
        return taken

    def send(self, kind: BeaconKind, address: Address, gossip: tuple[Guid, ...] = (), *, key: int = 0) -> None:
        """Send a unicast; ``key`` as for ``SendUnicast``."""
        if not self.closed:
            self._outputs.append(SendUnicast(self._beacon(kind, gossip), address, key))

    def send_multicast(self, kind: BeaconKind, now: float) -> None:
        """Send to the group, with gossip about the peers that multicast does not reach."""
        if self.multicast:
            gossip = self.gossip(self.unheard_by_multicast(now), None, now)
            self._outputs.append(SendMulticast(self._beacon(kind, gossip)))

    def send_answer(self, peer: PeerInstance, now: float, gossip: tuple[Guid, ...] | None = None) -> None:
        """Answer a peer at each of its addresses, within the limits of answers; ``gossip``: default: of all peers."""
        for address in peer.addresses:
            if self._answers.allows(address, now):
                gossip = self.gossip(self._endpoints.present(), peer, now) if gossip is None else gossip
                self.send(BeaconKind.ANSWER, address, gossip)
            else:
                self._counters.add("beacon.answer_limited")

    def send_goodbye(self, peers: list[PeerInstance]) -> None:
        """Send a goodbye to the group, and to these peers by unicast; afterwards nothing is sent."""
        if self.multicast:
            self._outputs.append(SendMulticast(self._beacon(BeaconKind.GOODBYE)))
        for peer in peers:
            for address in peer.addresses:
                self.send(BeaconKind.GOODBYE, address)
        self.closed = True

    def gossip(self, peers: list[PeerInstance], to: PeerInstance | None, now: float) -> tuple[Guid, ...]:
        """What the next beacon says about peers; ``to``: its receiver, or ``None`` if it goes to the group."""
        identity = to.identity if to is not None else self.identity
        return self._gossip_selector.choose(peers, to, now, loopback=identity.guid.is_loopback)

    def unheard_by_multicast(self, now: float) -> list[PeerInstance]:
        """Members that get their heartbeats by unicast, because no multicast of theirs was heard lately."""
        members = self._endpoints.present()
        if not self.multicast:
            return list(members)
        many = is_many(len(members))  # then a peer that a link brought has some time to be heard
        since = now - limits.MULTICAST_SILENCE
        return [v for v in members if max(v.multicast_at, v.since if many else _NEVER) < since]

    def _beacon(self, kind: BeaconKind, gossip: tuple[Guid, ...] = ()) -> Beacon:
        self._sequence = serial_add(self._sequence, 1)
        observed = self._endpoints.observed_addresses(gossip)
        return Beacon(kind, self.identity, self._lease_ms, self._sequence, gossip, observed)
