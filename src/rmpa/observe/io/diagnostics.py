"""Publishes the agent's health on ``/diagnostics`` once a second (REP 107).

The agent's own node publishes it, so it does not cross to other modules. Without a subscriber nothing is built.
"""

from __future__ import annotations

import logging
from typing import TYPE_CHECKING, Final

from rmpa.observe import limits
from rmpa.observe.health import Health, diagnostic_status
from rmpa.ros.node.publication import Publication, PublicationEvents
from rmpa.ros.types.definitions import ARRAY_DEFINITION, ARRAY_MD5, ARRAY_TYPE, frame_array
from rmpa.ros.wire.tcpros import TopicDescription
from rmpa.runtime.loop import SystemClock, call_at_tick, yield_to_data

if TYPE_CHECKING:
    import asyncio

    from rmpa.bridge.bridge import Bridge
    from rmpa.observe.io.peer_clocks import PeerClocks
    from rmpa.observe.io.snapshot_builder import SnapshotBuilder
    from rmpa.ros.core.api import Core

_log = logging.getLogger(__name__)

TOPIC: Final = "/diagnostics"
"""The topic of REP 107."""


class Diagnostics(PublicationEvents):
    """Publishes judged snapshots; follows the peers' clocks as often, and seldom while no link is in use.

    Args:
        core: The local core.
        bridge: Has the node that publishes; started before.
        snapshots: Builds what is judged.
        clocks: The clocks of the peers.
    """

    def __init__(self, core: Core, bridge: Bridge, snapshots: SnapshotBuilder, clocks: PeerClocks) -> None:
        self._core = core
        self._bridge = bridge
        self._snapshots = snapshots
        self._clocks = clocks
        self._clock = SystemClock()
        self._health = Health()
        self._sequence = 0
        self._publication = Publication(
            TOPIC,
            bridge.node.name,
            TopicDescription(ARRAY_TYPE, ARRAY_MD5, ARRAY_DEFINITION),
            queue_messages=limits.DIAGNOSTICS_QUEUE,
            events=self,
        )
        self._timer: asyncio.TimerHandle | None = None

    def start(self) -> None:
        """Advertise, and publish once a second."""
        node = self._bridge.node
        node.add_publication(self._publication)
        code, text, _ = self._core.call("registerPublisher", node.name, TOPIC, ARRAY_TYPE, node.uri)
        if code != 1:
            _log.error("! the local core does not take %s: %s", TOPIC, text)
        self._again()

    def close(self) -> None:
        """Unadvertise."""
        if self._timer is not None:
            self._timer.cancel()
        node = self._bridge.node
        self._core.call("unregisterPublisher", node.name, TOPIC, node.uri)
        node.remove_publication(TOPIC)

    def _again(self) -> None:
        used = self._publication.subscribers or any(not s.link.rests for s in self._bridge.sessions.linked())
        self._timer = call_at_tick(limits.DIAGNOSTICS_INTERVAL if used else limits.CLOCKS_IDLE_INTERVAL, self._look)

    def first_subscriber(self) -> None:
        """Of ``PublicationEvents``."""
        if self._timer is not None:
            self._timer.cancel()
            self._again()

    def _look(self) -> None:
        self._again()
        self._clocks.follow(self._clock.now())
        if self._publication.subscribers:
            self._publish()

    def _publish(self) -> None:
        self._sequence += 1
        snapshot, parts = self._snapshots.build(most=limits.DIAGNOSTICS_TOPICS), []
        for check in self._health.judge(snapshot, self._clock.now()):
            parts.append(diagnostic_status(check, snapshot.agent.name).serialize())
            yield_to_data()
        self._publication.publish_framed(frame_array(self._sequence, self._clock.wall_ns(), parts))
