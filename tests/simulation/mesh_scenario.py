"""The scenario with links: after healing every pair has one, and both ends mean the same one."""

from __future__ import annotations

from tests.simulation.mesh_peer import MeshPeer
from tests.simulation.scenario import Scenario

_MANY = 10
_SLOW_LEASE = 5.0
"""Seconds; with many peers the keepalives of a second's lease would be most of the work."""


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
        if self.count > _MANY:
            for peer in self.peers:
                peer.link_lease = _SLOW_LEASE
        if not self.calm and self.world.rng.random() < 0.25:
            self.network.walled.add(self.world.rng.choice(self.peers).host)

    def _worsen(self) -> None:
        if not self.calm:
            super()._worsen()

    def _mischief(self) -> None:
        if not self.calm:
            super()._mischief()

    def check(self) -> None:
        """Equal views, and one live link for each pair."""
        super().check()
        living = {peer.identity.instance: peer for peer in self.peers if peer.alive}
        for peer in living.values():
            remotes = []
            for link in peer.links.values():
                assert link.up, f"{peer.name} has a link that is {link.machine.state}"
                remote = link.machine.remote
                assert remote is not None
                remotes.append(remote.instance)
                other = living[remote.instance]
                twins = [twin for twin in other.links.values() if twin.up and twin.end is link.end.other]
                assert len(twins) == 1, f"{peer.name} and {other.name} mean different links"
                if self.calm and peer.identity.guid < other.identity.guid:
                    assert link.expected is not None, f"{peer.name} did not dial {other.name}"
            assert sorted(remotes) == sorted(living.keys() - {peer.identity.instance}), (
                f"{peer.name} has links to {sorted(living[i].name for i in remotes if i in living)}"
            )
            assert all(view.linked for view in peer.roster.peers()), f"{peer.name}'s roster does not know its links"
