"""The mesh scenario with messages: what arrives is whole and in order, and after healing all of it arrives."""

from __future__ import annotations

from contextlib import contextmanager
from functools import partial
from typing import TYPE_CHECKING, Final
from unittest import mock

from rmpa.core.contract import Reliability
from rmpa.mesh import limits
from tests.simulation.mesh_scenario import MeshScenario
from tests.simulation.scenario import CALM
from tests.simulation.traffic import TrafficPeer

if TYPE_CHECKING:
    from collections.abc import Iterator


_LAST_SERIES: Final = (300, 40_000, 20, 20, 20, 20, 20, 150_000, 300, 9000, 300, 300, 300, 300, 300, 9000, 20)
"""Sizes: small, large, back to small, a large one in parts, and again."""
_PAUSE: Final = 0.15


class LanesScenario(MeshScenario):
    """Agents that send each other messages; see ``MeshScenario``."""

    kind = "lanes"

    def __init__(self, seed: int, count: int, *, keep: bool = False, calm: bool = False) -> None:
        self.before: dict[bytes, int] = {}
        self.breaks = 0
        """Reliable routes that began a new numbering though both sides were alive, because their links crossed."""
        super().__init__(seed, count, keep=keep, calm=calm, make_peer=TrafficPeer)

    @contextmanager
    def simulated(self) -> Iterator[None]:
        """As ``MeshScenario``, and topics change their lanes after a few messages."""
        with (
            super().simulated(),
            mock.patch("rmpa.bridge.data.export.time", self.world),
            mock.patch("rmpa.bridge.data.reception.time", self.world),
            mock.patch.multiple(limits, EXPRESS_AGAIN_MESSAGES=3, EXPRESS_AGAIN_AFTER=0.1),
        ):
            yield

    def heal(self) -> None:
        """Heal; when all are linked, each publishes a series of messages that changes lanes several times."""
        super().heal()
        begin = self.world.now + CALM - len(_LAST_SERIES) * _PAUSE - 3
        for peer in self.peers:
            self.world.at(begin - 1, partial(self._stop, peer))
            self.world.at(begin - 0.01, partial(self._note_last, peer))
            for number, size in enumerate(_LAST_SERIES):
                self.world.at(begin + number * _PAUSE, partial(self._publish, peer, size))

    def _stop(self, peer: TrafficPeer) -> None:
        peer.stopped = True

    def _note_last(self, peer: TrafficPeer) -> None:
        if peer.alive:
            self.before[peer.identity.instance] = peer.published[-1] if peer.published else 0

    def _publish(self, peer: TrafficPeer, size: int) -> None:
        if peer.alive:
            peer.process.run(peer.publish, size)

    def check(self) -> None:
        """Check links and rosters, and that each has what the others published."""
        super().check()
        living = [peer for peer in self.peers if peer.alive]
        for peer in living:
            assert not peer.mesh.counters["link.malformed"], f"{peer.name} heard what the protocol does not know"
            for other in living:
                if other is not peer:
                    self._check_messages(other, peer)
            for link in peer.mesh.links():
                assert not link.queue_bytes, f"{peer.name} has not sent all"

    def _check_messages(self, source: TrafficPeer, peer: TrafficPeer) -> None:
        inbox = peer.inboxes[source.identity.instance]
        who = f"{peer.name} from {source.name} ({source.contract.reliability}, {source.contract.priority})"
        published = source.published
        assert set(inbox.numbers) <= set(published), f"{who}: what was never published whole"
        last = [n for n in published if n > self.before[source.identity.instance]]
        assert len(last) == len(_LAST_SERIES)
        assert inbox.numbers[-len(last) :] == last, (
            f"{who}: of the last series {inbox.numbers[-len(last) :]}, not {last}"
        )
        wanted = [n for n in published if n >= source.first[peer.identity.instance]]
        missing = sorted(set(wanted) - set(inbox.numbers))
        assert inbox.flow is not None
        if source.contract.reliability is Reliability.RELIABLE:
            self.breaks += inbox.breaks
            assert not (self.calm and inbox.breaks), who
            assert not inbox.flow.counts["lost"], f"{who}: {inbox.flow.counts['lost']} lost"
            assert not missing, f"{who}: {len(missing)} of {len(wanted)} are missing: {missing[:5]}"
        elif self.calm:
            link = source.mesh.link(peer.identity.guid)
            assert link is not None
            left_out = link.express.outbox.expired.total() + link.bulk.outbox.expired.total() + link.info().dropped
            lost, stale = inbox.flow.counts["lost"], inbox.flow.counts["stale"]
            assert left_out <= lost <= left_out + source.aborted, f"{who}: {lost} lost, {left_out} left out"
            assert len(missing) == left_out + stale, f"{who}: {len(missing)} are missing: {missing[:5]}"
