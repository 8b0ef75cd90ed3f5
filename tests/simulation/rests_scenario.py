"""The mesh scenario with links that rest and wake at random; at last one is needed whose peer is gone."""

from __future__ import annotations

from functools import partial

from rmpa.mesh import limits
from tests.simulation.mesh_peer import MeshPeer
from tests.simulation.mesh_scenario import MeshScenario


class RestsScenario(MeshScenario):
    """Agents whose links are needed now and then; see ``MeshScenario``."""

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
