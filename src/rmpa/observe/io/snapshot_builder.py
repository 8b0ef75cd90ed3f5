"""Builds the snapshot that the control socket and ``/diagnostics`` show from what the rooms tell."""

from __future__ import annotations

import contextlib
import os
import time
from collections import Counter
from typing import TYPE_CHECKING

import psutil

import rmpa
from rmpa.observe import limits
from rmpa.observe.io.bounds_section import own_text
from rmpa.observe.io.peers_section import PeersSection
from rmpa.observe.io.topics_section import TopicsSection, unreachable_infos
from rmpa.observe.snapshot import AgentInfo, FilesInfo, Snapshot
from rmpa.runtime import limits as runtime_limits
from rmpa.runtime.descriptors import DESCRIPTORS
from rmpa.runtime.event_loop import yield_to_data
from rmpa.runtime.realtime import refused

if TYPE_CHECKING:
    from collections.abc import Callable, Collection

    from rmpa.bridge.io.bounds import Bounds
    from rmpa.bridge.io.bridge import Bridge
    from rmpa.bridge.io.network_endpoint import NetworkEndpoint
    from rmpa.config.settings import Settings
    from rmpa.core.counters import Counters
    from rmpa.observe.io.peer_clocks import PeerClocks
    from rmpa.observe.io.services_section import ServicesSection
    from rmpa.ros.core.api import Core
    from rmpa.runtime.realtime import SchedulingRequest


class SnapshotBuilder:
    """Reads the rooms; changes nothing.

    Args:
        settings: The agent's settings.
        core: Its ROS core.
        bridge: Its bridge.
        clocks: Those of its peers.
        counters: Those of its other parts.
        started: Seconds since the epoch.
        wishes: What came of ``--realtime``.
    """

    def __init__(
        self,
        settings: Settings,
        core: Core,
        bridge: Bridge,
        clocks: PeerClocks,
        *counters: Counters,
        started: float,
        wishes: tuple[SchedulingRequest, ...] = (),
    ) -> None:
        self._settings = settings
        self._core = core
        self._bridge = bridge
        self._counters = counters
        self._started = started
        self._wishes = wishes
        self._process = psutil.Process()
        self._process.cpu_percent()  # from here on it counts
        self._cpu: float | None = None
        self._cpu_known = time.monotonic()
        self._peers = PeersSection(bridge)
        self._bounds: Bounds | None = None
        self._topics = TopicsSection(settings, core, bridge, clocks)
        self.station: NetworkEndpoint | None = None
        self.services: ServicesSection | None = None
        self.waiting: Callable[[], tuple[str, ...]] = tuple
        """What the settings say and only a restart brings."""
        self.parameters: Callable[[], tuple[str, ...]] = tuple
        """What there is to know of followed parameters."""

    def watch(self, bounds: Bounds) -> None:
        """Show what is beyond the limits, from now on."""
        self._bounds = self._peers.bounds = bounds

    def reload(self, settings: Settings) -> None:
        """Other settings hold from now on."""
        self._settings = settings
        self._topics.reload(settings)

    def snapshot(self, topics: Collection[str] | None = None) -> Snapshot:
        """Everything at this moment; data goes on in between.

        Args:
            topics: The only topics that are wanted, without services, or ``None`` for all.
        """
        rooms = [self._bridge.counters, self._core.counters, DESCRIPTORS.counters, *self._counters]
        if self.station is not None:
            rooms += [self.station.mesh.counters, self.station.discovery.counters]
        counters: Counter[str] = Counter()
        for room in rooms:  # the core and the proxies have the same servers: their counts add up
            counters.update(room.as_dict())
        yield_to_data()
        return Snapshot(
            agent=self._agent(),
            taken=time.time(),
            peers=self._peers.infos(self.station) if self.station is not None else (),
            topics=self._topics.infos(topics),
            services=self.services.infos() if self.services is not None and topics is None else (),
            counters=dict(sorted(counters.items())),
            notes=self._notes(),
            unreachable=unreachable_infos(self._core, time.monotonic()),
        )

    def _notes(self) -> tuple[str, ...]:
        notes = tuple(self.station.discovery.notes()) if self.station is not None else ()
        notes += self._core.notes()
        if DESCRIPTORS.shortage is not None:
            notes += (DESCRIPTORS.shortage.problem,)
        notes += tuple(f"{key} waits for a restart" for key in self.waiting())
        notes += self.parameters()
        notes += tuple(map(own_text, self._bounds.own())) if self._bounds is not None else ()
        missing = refused(self._wishes)
        return (*notes, missing) if missing else notes

    def _agent(self) -> AgentInfo:
        identity = self.station.identity if self.station is not None else None
        proxies = sum(attached.inbound.count for attached in self._bridge.everyone())
        return AgentInfo(
            name=self._settings.name,
            guid=str(identity.guid) if identity else "",
            instance=identity.instance.hex() if identity else "",
            domain=self._settings.domain,
            core_uri=self._core.uri,
            version=rmpa.__version__,
            pid=os.getpid(),
            started=self._started,
            uptime=time.time() - self._started,
            cpu=self._cpu_share(),
            rss=self._memory(),
            addresses=tuple(str(a) for a in (identity.guid.address, *identity.addresses)) if identity else (),
            interfaces=tuple(i.name for i in self.station.discovery.interfaces) if self.station else (),
            config_file=str(self._settings.config_file or ""),
            realtime=tuple(map(str, self._wishes)),
            files=_files(),
            proxies=proxies,
            proxy_sockets=self._bridge.proxy_nodes.sockets(proxies),
            proxy_listening=self._bridge.proxy_nodes.listening,
            core_memory=self._core.restored(),
        )

    def _cpu_share(self) -> float | None:
        """Looked at now and then: between two snapshots that follow each other there is nothing to see."""
        now = time.monotonic()
        if now - self._cpu_known >= limits.CPU_INTERVAL:
            with contextlib.suppress(OSError):  # no file descriptor is left to read /proc
                self._cpu, self._cpu_known = self._process.cpu_percent(), now
        return self._cpu

    def _memory(self) -> int | None:
        try:
            rss: int = self._process.memory_info().rss
        except OSError:
            return None
        return rss


def _files() -> FilesInfo:
    used, limit, reserved = DESCRIPTORS.open, DESCRIPTORS.limit, DESCRIPTORS.reserve
    counts = DESCRIPTORS.counters.as_dict()
    return FilesInfo(
        open=used,
        limit=limit,
        hard=DESCRIPTORS.hard_limit,
        reserved=reserved,
        near=used >= runtime_limits.DESCRIPTORS_NEAR * (limit - reserved),
        refused=sum(count for name, count in counts.items() if name.startswith("descriptors.refused.")),
        problem=DESCRIPTORS.shortage.problem if DESCRIPTORS.shortage is not None else "",
    )
