"""Links on demand in a simulated network: links park and come back at every moment, and both ends agree afterwards.

``RMPA_SIMULATION_SEEDS=20`` runs twenty times as many.
"""

from __future__ import annotations

import os
from typing import TYPE_CHECKING, cast

import pytest

from rmpa.mesh import limits
from tests.simulation.mesh_peer import MeshPeer
from tests.simulation.mesh_scenario import MeshScenario

if TYPE_CHECKING:
    from rmpa.mesh.io.link import PeerLink
    from rmpa.mesh.peering_events import LinkDown

FACTOR = int(os.environ.get("RMPA_SIMULATION_SEEDS", "1"))
SETTLES = 3 * limits.PARK_AFTER
"""Seconds in which links that nothing needs are parked, and links that were crossed are made."""


class ParkingPeer(MeshPeer):
    """Would do without its links, but for those that it uses now."""

    def __init__(self, *args: object, **more: object) -> None:
        super().__init__(*args, **more)  # type: ignore[arg-type]
        self.heard: list[bytes] = []

    def link_up(self, link: PeerLink) -> None:
        """A peer is linked; nothing needs the link."""
        super().link_up(link)
        link.need(needed=False, parks=True)

    def control(self, link: PeerLink, payload: bytes) -> None:
        """Keep what came, and need the link no more."""
        self.heard.append(payload)
        link.need(needed=False, parks=True)

    def send(self, other: ParkingPeer, payload: bytes) -> bool:
        """Send over the link, or have it made; return whether the payload is on its way."""
        link = self.mesh.link(other.identity.guid)
        if link is None:
            self.process.run(self.mesh.want, other.identity.guid)
            return False
        self.process.run(link.send_control, payload)
        self.process.run(lambda: link.need(needed=False, parks=True))
        return not link.held


class RepeatingPeer(ParkingPeer):
    """Sends what a parked link held back over the next one."""

    def __init__(self, *args: object, **more: object) -> None:
        super().__init__(*args, **more)
        self.unsent: list[bytes] = []

    @property
    def holds(self) -> bool:
        """Whether this side has agreed to part, and waits for the bye."""
        return any(link.connection.holding for link in self.mesh.links())

    def send_soon(self, payload: bytes, after: float) -> None:
        """Send to the other peer after some seconds."""
        self.world.after(after, lambda: self.process.run(self._send, payload))

    def _send(self, payload: bytes) -> None:
        if links := self.mesh.links():
            links[0].send_control(payload)
            links[0].need(needed=False, parks=True)
        else:
            self.unsent.append(payload)
            self._want()

    def _want(self) -> None:
        for status in self.mesh.peers():
            self.mesh.want(status.identity.guid)

    def link_up(self, link: PeerLink) -> None:
        """Send what waits."""
        super().link_up(link)
        unsent, self.unsent = self.unsent, []
        for payload in unsent:
            link.send_control(payload)
        link.need(needed=False, parks=True)

    def link_down(self, link: PeerLink, down: LinkDown) -> None:
        """Have the link made again for what it held back."""
        super().link_down(link, down)
        if link.parked and link.held:
            self.unsent += link.held
            self.world.after(0, lambda: self.process.run(self._want))


def states(scenario: MeshScenario) -> set[str]:
    return {status.state for peer in scenario.peers for status in peer.mesh.peers()}


@pytest.mark.parametrize("seed", range(4 * FACTOR))
def test_links_park_come_back_and_park_again(seed: int) -> None:
    scenario = MeshScenario(seed, 4, keep=True, calm=True, make_peer=ParkingPeer)
    world = scenario.world
    with scenario.simulated():
        for peer in scenario.peers:
            world.after(0, peer.start)
        world.run(world.now + SETTLES)
        assert states(scenario) == {"parked"}
        assert not any(peer.mesh.connections() for peer in scenario.peers), "no connection is left"
        assert all(len(peer.mesh.peers()) == 3 for peer in scenario.peers)
        for _ in range(40):
            one, other = world.rng.sample(scenario.peers, 2)
            assert isinstance(one, ParkingPeer)
            assert isinstance(other, ParkingPeer)
            one.process.run(one.mesh.want, other.identity.guid)
            if world.rng.random() < 0.5:
                other.process.run(other.mesh.want, one.identity.guid)
            world.run(world.now + world.rng.uniform(0.0, 1.5 * limits.PARK_AFTER))
        world.run(world.now + SETTLES)
        assert states(scenario) == {"parked"}
        assert not any(peer.mesh.counters["link.replaced"] for peer in scenario.peers), "what it carried is lost"
        assert not any(process.failures for peer in scenario.peers for process in peer.processes)


@pytest.mark.parametrize("seed", range(4 * FACTOR))
def test_what_both_sides_send_while_the_link_is_parked_arrives_once_over_one_link(seed: int) -> None:
    scenario = MeshScenario(seed, 2, keep=True, calm=True, make_peer=RepeatingPeer)
    world = scenario.world
    peers = [cast("RepeatingPeer", peer) for peer in scenario.peers]
    with scenario.simulated():
        for peer in peers:
            world.after(0, peer.start)
        world.run(world.now + SETTLES)
        for number in range(16):
            payload = b'{"n":%d}' % number
            for peer in peers:
                peer.send_soon(payload, world.rng.choice((0.0, world.rng.uniform(0.0, 0.01))))
            world.run(world.now + limits.PARK_AFTER)
            end = world.now + SETTLES
            # Every second time the next payloads are sent while both sides agree to part.
            while states(scenario) != {"parked"} and not (number % 2 and any(peer.holds for peer in peers)):
                world.run(world.now + 0.001)
                assert world.now < end, "the link is never parked"
            if not number % 2:
                world.run(world.now + 1.0)
        world.run(world.now + SETTLES)
        assert [peer.heard for peer in peers] == [[b'{"n":%d}' % number for number in range(16)]] * 2
        assert not any(peer.mesh.counters["link.replaced"] for peer in peers), "what it carried is lost"
        assert not any(process.failures for peer in peers for process in peer.processes)


@pytest.mark.parametrize("seed", range(4 * FACTOR))
def test_a_wanted_peer_is_linked_soon_and_hears_what_was_meant_for_it(seed: int) -> None:
    scenario = MeshScenario(seed, 3, keep=True, calm=True, make_peer=ParkingPeer)
    world = scenario.world
    with scenario.simulated():
        for peer in scenario.peers:
            world.after(0, peer.start)
        world.run(world.now + SETTLES)
        for number in range(20):
            one, other = world.rng.sample(scenario.peers, 2)
            assert isinstance(one, ParkingPeer)
            assert isinstance(other, ParkingPeer)
            payload = b'{"n":%d}' % number
            before, sent = world.now, False
            while payload not in other.heard:
                if not sent:
                    sent = one.send(other, payload)
                world.run(world.now + 0.05)
                assert world.now - before < limits.WANT_GRACE, "the peer was not reached"
            assert other.heard.count(payload) == 1
            world.run(world.now + world.rng.uniform(0.0, 2 * limits.PARK_AFTER))
