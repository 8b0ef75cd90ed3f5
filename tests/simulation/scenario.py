"""One simulated network: random failures, then it heals, then all rosters must agree.

``python -m tests.simulation --seed N --peers M`` replays one with its whole trace.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Final

from rmpa.core import limits as core_limits
from rmpa.core.identity import Guid, Identity
from rmpa.discovery.beacon import Beacon, BeaconKind
from rmpa.discovery.endpoints import LEASE_MAX
from rmpa.discovery.membership import HEARTBEAT_INTERVAL
from tests.simulation.network import Network, Weather, World
from tests.simulation.roster_peer import RosterPeer, stranger

FACTOR: Final = int(os.environ.get("RMPA_SIMULATION_SEEDS", "1"))
"""How many times the usual number of seeds is played."""
CALM: Final = core_limits.PEER_LEASE + 2 * HEARTBEAT_INTERVAL + 2.0
"""Seconds after healing within which all rosters agree: a lease for dead peers, two heartbeats for new ones."""
AFTER_FORGERY: Final = LEASE_MAX + CALM
"""The same where forged beacons asked for the longest lease."""

MakePeer = Callable[..., Any]


class Disagreement(AssertionError):  # noqa: N818 - it is no error of the code that raises it
    """The peers do not agree after the network healed; the text says how to see it again."""


@dataclass(frozen=True)
class Outcome:
    """The result of one run."""

    trace_hash: str
    lines: tuple[str, ...]
    datagrams: int


class Scenario:
    """One network through failures and healing.

    Args:
        seed: Everything follows from it.
        count: How many peers.
        make_peer: What a peer is: a roster alone, or more.
        keep: Keep the whole trace.
    """

    kind = "rosters"

    def __init__(self, seed: int, count: int, make_peer: MakePeer = RosterPeer, *, keep: bool = False) -> None:
        self.seed = seed
        self.count = count
        self.world = World(seed, keep=keep)
        self.network = Network(self.world)
        self.hostile = False
        self.peers = self._place(make_peer)
        self.prepare()

    def play(self) -> Outcome:
        """Play the failures, heal the network, and check.

        Raises:
            Disagreement: They do not agree.
        """
        rng = self.world.rng
        for peer in self.peers:
            self.world.after(rng.uniform(0, 3) if rng.random() < 0.5 else 0, peer.start)
        self._worsen()
        self.world.run(self.world.now + 3)
        for _ in range(rng.randint(1, 6)):
            self._mischief()
            self.world.run(self.world.now + rng.choice([0.05, 0.5, 2.0, 7.0, 20.0]) * rng.random())
        self.heal()
        self.world.run(self.world.now + (AFTER_FORGERY if self.hostile else CALM))
        try:
            self.check()
        except AssertionError as error:
            again = f"--kind {self.kind} --seed {self.seed} --peers {self.count}"
            raise Disagreement(self.world.report(error, again)) from error
        return Outcome(self.world.trace_hash, tuple(self.world.lines), self.network.datagrams)

    def prepare(self) -> None:
        """Set up more before the first peer starts; nothing here."""

    def heal(self) -> None:
        """Make the network whole and quiet; start the dead peers again that others need."""
        self.world.note("network", "heals")
        self.network.weather = Weather()
        self.network.sides = {}
        for peer in self.peers:
            if not peer.alive and (self.world.rng.random() < 0.7 or self._needed(peer)):
                peer.start()

    def check(self) -> None:
        """Check that each living peer sees exactly the other living ones, in their present run."""
        living = sorted((p.identity for p in self.peers if p.alive), key=lambda i: i.guid)
        for peer in self.peers:
            if peer.alive:
                expected = tuple(i for i in living if i != peer.identity)
                assert peer.view() == expected, f"{peer.name} sees {_names(peer.view())}, not {_names(expected)}"
                assert not peer.troubles(), f"{peer.name} reports {peer.troubles()}"

    def _place(self, make_peer: MakePeer) -> list[Any]:
        """One network, or two joined by a seed, or none with multicast and one seed for all."""
        shape = self.world.rng.choice(["one", "one", "one", "two", "none"])
        peers = [make_peer(self.network, n + 1, multicast=shape != "none") for n in range(self.count)]
        first = peers[0].address
        for n, peer in enumerate(peers):
            if shape != "none":
                self.network.segments[peer.host] = 2 if shape == "two" and n >= self.count // 2 else 1
        if shape == "two":
            peers[-1].seeds = (first,)
        elif shape == "none":
            for peer in peers[1:]:
                peer.seeds = (first,)
        return peers

    def _needed(self, peer: RosterPeer) -> bool:
        """Whether the others can only find each other through this peer."""
        return bool(peer.seeds) or any(peer.address in p.seeds for p in self.peers)

    def _worsen(self) -> None:
        rng = self.world.rng
        self.network.weather = Weather(
            loss=rng.choice([0.0, 0.05, 0.3, 0.6]) * rng.random(),
            double=rng.choice([0.0, 0.2]),
            delay=(0.0001, rng.choice([0.001, 0.02, 0.3, 1.5])),
        )
        self.world.note("network", f"{self.network.weather}")

    def _mischief(self) -> None:
        rng = self.world.rng
        peer = rng.choice(self.peers)
        match rng.choice(["part", "join", "kill", "end", "start", "restart", "weather", "noise", "forge"]):
            case "part":
                self.network.sides = {p.host: rng.randint(0, 1) for p in self.peers}
                self.world.note("network", f"parts {sorted(self.network.sides.values())}")
            case "join":
                self.network.sides = {}
            case "kill" if peer.alive:
                peer.kill()
            case "end" if peer.alive:
                peer.end()
            case "start" if not peer.alive and peer.run:
                peer.start()
            case "restart" if peer.alive:
                peer.kill()
                peer.start()
            case "weather":
                self._worsen()
            case "noise":
                self._noise(peer)
            case "forge" if peer.alive and rng.random() < 0.3:
                self._forge(peer)
            case _:
                pass

    def _noise(self, peer: RosterPeer) -> None:
        """Send bytes that are no beacon, from an unknown address."""
        rng = self.world.rng
        for _ in range(5):
            data = rng.choice([b"", b"RMPA", b"RMPA\x04\x01\x00\x00", b"RMPA\x03\x01\x00\x07"])
            self.network.unicast((peer.host, 6666), peer.address, data + rng.randbytes(rng.randint(0, 80)))

    def _forge(self, peer: RosterPeer) -> None:
        """Send forged beacons: peers that do not exist, damaged copies, an invented run of a real peer."""
        rng = self.world.rng
        self.hostile = True
        self.world.note("network", f"forges against {peer.name}")
        victim = rng.choice(self.peers).address
        forged = [
            Beacon(
                BeaconKind.HEARTBEAT,
                stranger(peer.identity, rng.randint(1, 9)),
                rng.getrandbits(32),
                rng.getrandbits(32),
                (Guid.of("10.77.0.1", 9), Guid.of(*victim)),
            ),
            Beacon(BeaconKind.ANNOUNCE, Identity(Guid.of(*victim), rng.randbytes(16), "ghost"), 0xFFFFFFFF, 1),
        ]
        for beacon in forged:
            wire = bytearray(beacon.serialize())
            self.network.unicast(("10.66.0.9", 6666), peer.address, bytes(wire))
            for _ in range(3):
                wire[rng.randrange(8, len(wire))] = rng.getrandbits(8)
            self.network.unicast(("10.66.0.9", 6666), peer.address, bytes(wire))


def _names(identities: tuple[Identity, ...]) -> str:
    return ", ".join(f"{i.name}#{i.guid.incarnation}" for i in identities) or "no client"
