"""The scenario with links: after healing each pair has one with both lanes, the same at both ends."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from types import SimpleNamespace
from unittest import mock

from rmpa.mesh import limits
from rmpa.mesh.frames import Lane
from rmpa.mesh.io.link import Connection, PeerLink
from tests.simulation.mesh_peer import MeshPeer
from tests.simulation.scenario import Outcome, Scenario
from tests.simulation.sockets import SimSocket

_MANY = 10
_SLOWER = 5
"""With many peers the keepalives of a second's lease would be most of the work."""


def socket_of(connection: Connection) -> SimSocket:
    """The simulated socket of a connection."""
    return connection.sock  # type: ignore[return-value]


class MeshScenario(Scenario):
    """Rosters and links; in some networks one host is behind a firewall.

    Args:
        calm: Nothing bad happens: both ends of each link could have dialled all the time.
    """

    kind = "mesh"

    def __init__(self, seed: int, count: int, *, keep: bool = False, calm: bool = False) -> None:
        self.calm = calm
        super().__init__(seed, count, MeshPeer, keep=keep)

    def prepare(self) -> None:
        """A firewall in one of four networks."""
        if not self.calm and self.world.rng.random() < 0.25:
            self.network.walled.add(self.world.rng.choice(self.peers).host)

    def play(self) -> Outcome:
        """See ``Scenario.play``."""
        with self.simulated():
            return super().play()

    @contextmanager
    def simulated(self) -> Iterator[None]:
        """Replace what the code would ask of the operating system."""
        slower = _SLOWER if self.count > _MANY else 1
        clocks = SimpleNamespace(monotonic=lambda: self.world.now, time_ns=self.world.time_ns)
        with (
            mock.patch("rmpa.runtime.loop.time", clocks),
            mock.patch("rmpa.runtime.stream.Stream.unacknowledged", property(lambda stream: stream._sock.in_flight)),
            mock.patch("rmpa.runtime.accept.Descriptors.has_room", return_value=True),
            mock.patch.multiple(
                limits,
                EXPRESS_LEASE=slower * limits.EXPRESS_LEASE,
                KEEPALIVE_INTERVAL=slower * limits.KEEPALIVE_INTERVAL,
                CLOCK_INTERVAL=slower * limits.CLOCK_INTERVAL,
                BULK_LEASE=slower * limits.BULK_LEASE,
                GHOST_QUIET=slower * limits.GHOST_QUIET,
            ),
        ):
            yield

    def _worsen(self) -> None:
        if not self.calm:
            super()._worsen()

    def _mischief(self) -> None:
        if self.calm:
            return
        if self.world.rng.random() < 0.3:
            self._hit_connection()
        else:
            super()._mischief()

    def _hit_connection(self) -> None:
        """Break one connection, or let a router on its way forget it."""
        there = list(self.network.connections.values())
        if not there:
            return
        sock = self.world.rng.choice(there)
        if self.world.rng.random() < 0.5:
            self.world.note("network", f"swallows a connection of {sock.host} with {sock.other.host}")
            sock.swallow()
        else:
            self.world.note("network", f"breaks a connection of {sock.host} with {sock.other.host}")
            sock.kill_both()

    def check(self) -> None:
        """Equal views, and one live link with two lanes for each pair."""
        super().check()
        living = {peer.identity.instance: peer for peer in self.peers if peer.alive}
        for peer in living.values():
            assert not any(process.failures for process in peer.processes), [p.failures for p in peer.processes]
            others = sorted(living.keys() - {peer.identity.instance})
            self._check_connections(peer, others)
            for other in (living[instance] for instance in others):
                self._check_pair(peer, other)
            assert all(view.run.linked for view in peer.roster.endpoints.views()), (
                f"{peer.name} does not know its links"
            )

    def _check_connections(self, peer: MeshPeer, others: list[bytes]) -> None:
        for bulk in (False, True):
            up = [c for c in peer.mesh.connections() if c.up and (c.lane == Lane.BULK) == bulk]
            found = sorted(connection.identity.instance for connection in up)
            assert found == others, f"{peer.name}, bulk {bulk}: {self._names(found)}"
        assert len(peer.mesh.connections()) == 2 * len(others), f"{peer.name} has connections that are not up"

    def _check_pair(self, peer: MeshPeer, other: MeshPeer) -> None:
        link, twin = peer.mesh.link(other.identity.guid), other.mesh.link(peer.identity.guid)
        assert link is not None, f"{peer.name} does not use its link to {other.name}"
        assert twin is not None, f"{other.name} does not use its link to {peer.name}"
        assert socket_of(link.connection).other is socket_of(twin.connection), (
            f"{peer.name} and {other.name} mean different links"
        )
        self._check_bulk(peer, other, link, twin)

    def _check_bulk(self, peer: MeshPeer, other: MeshPeer, link: PeerLink, twin: PeerLink) -> None:
        bulk, bulk_twin = link.bulk_connection, twin.bulk_connection
        assert bulk is not None, f"{peer.name} has no bulk lane to {other.name}"
        assert bulk_twin is not None, f"{other.name} has no bulk lane to {peer.name}"
        assert socket_of(bulk).other is socket_of(bulk_twin), f"{peer.name} and {other.name} mean different lanes"
        assert link.bulk._stream is bulk.stream
        if self.calm:
            assert link.dialled is not twin.dialled
            assert bulk.dialled is link.dialled, f"the side that dialled {link.guid} did not dial the bulk lane"

    def _names(self, instances: list[bytes]) -> list[str]:
        return [peer.name for peer in self.peers for i in instances if peer.identity.instance == i]


class RestsScenario(MeshScenario):
    """Links that rest and wake at random; at last one is needed whose peer is gone."""

    kind = "rests"
    healed = checked = False

    def prepare(self) -> None:
        """Each agent changes its mind every second or so."""
        super().prepare()
        for peer in self.peers:
            self.world.after(self.world.rng.random(), partial(self._change, peer))

    def heal(self) -> None:
        """Heal; from now on nothing needs the links."""
        super().heal()
        self.healed = True

    def check(self) -> None:
        """Check links and rosters; all links rest, and a cut shows within seconds to the side that needs one."""
        super().check()
        self.checked = True
        living = [peer for peer in self.peers if peer.alive]
        for peer in living:
            assert all(link.rests for link in peer.mesh.links()), f"{peer.name} has a link that does not rest"
        if len(living) < 2:
            return
        peer = living[0]
        links = peer.mesh.links()
        self.network.sides = {each.host: int(each is peer) for each in self.peers}
        for link in links:
            peer.process.run(partial(link.need, needed=True))
        self.world.run(self.world.now + limits.WAKE_TIMEOUT + limits.EXPRESS_LEASE)
        assert not any(link.connection.up for link in links), f"{peer.name} has not noticed that its peers are gone"

    def _change(self, peer: MeshPeer) -> None:
        if peer.alive and not self.checked:
            for link in peer.mesh.links():
                needed = not self.healed and self.world.rng.random() < 0.4
                peer.process.run(partial(link.need, needed=needed))
        self.world.after(1.0, partial(self._change, peer))
