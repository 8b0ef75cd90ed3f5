"""Builds the snapshot that control socket and ``/diagnostics`` show: gathers what each part tells of itself."""

from __future__ import annotations

import contextlib
import os
import time
from collections import Counter
from dataclasses import dataclass
from typing import TYPE_CHECKING

import psutil

import rmpa
from rmpa.observe.peers import Peers
from rmpa.observe.snapshot import AgentInfo, Snapshot, read_facts
from rmpa.runtime.accept import DESCRIPTORS
from rmpa.runtime.loop import yield_to_data

if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Iterable, Iterator

    from rmpa.bridge.facts import BridgeFacts
    from rmpa.config.settings import Settings
    from rmpa.core.identity import Identity
    from rmpa.core.statistics import Counters
    from rmpa.discovery.discovery import Discovery
    from rmpa.mesh.io.mesh import Mesh
    from rmpa.ros.core.external import Core
    from rmpa.trust.permissions import TrustStatus


@dataclass(frozen=True, slots=True)
class AgentParts:
    """What an agent is observed by.

    Args:
        core: The agent's ROS core.
        facts: What its bridge tells.
        endpoint: Its identity, mesh and discovery now; ``None`` while it has no place in the network.
        counters: The counters of parts that are not named here.
        notes: What else the user should know, each ready to read.
        realtime: The outcomes of ``--realtime``, ready to read; those that were refused begin with ``no``.
        trust: The state of trust; ``None``: it is off.
        restart: How to restart the agent, if its module has joined a secured mesh since it started; else empty.
    """

    core: Core
    facts: BridgeFacts
    endpoint: Callable[[], tuple[Identity, Mesh, Discovery] | None]
    counters: Counters
    notes: Callable[[], Iterable[str]]
    realtime: tuple[str, ...]
    trust: Callable[[], TrustStatus | None]
    restart: Callable[[], str]


class SnapshotBuilder:
    """Builds snapshots of an agent; changes nothing.

    Args:
        settings: The agent's settings.
        parts: The parts of the agent.
    """

    def __init__(self, settings: Settings, parts: AgentParts) -> None:
        self._settings = settings
        self._parts = parts
        self._process = psutil.Process()
        self._process.cpu_percent()  # the first call only begins to count
        self._cpu: float | None = None
        self._cpu_known = self._began = time.monotonic()
        self._started = time.time()
        self._peers = Peers(settings.name, parts.endpoint, parts.facts, parts.restart)

    def reload(self, settings: Settings) -> None:
        """Use other settings from now on."""
        self._settings = settings

    def build(
        self,
        topics: Collection[str] | None = None,
        *,
        services: Collection[str] | bool | None = None,
        peers: bool = True,
        most: int | None = None,
    ) -> Snapshot:
        """A snapshot of this moment. It yields to data between its parts.

        Args:
            topics: The only topics that are wanted, or ``None`` for all.
            services: The only services that are wanted; ``True``: all; ``None``: all if all topics are wanted.
            peers: Whether peers are wanted.
            most: Topics, and services, beyond which those are left out that nothing here uses; ``None``: all are in
                it. The snapshot says how many are left out.
        """
        parts, endpoint = self._parts, self._parts.endpoint()
        counters: Counter[str] = Counter()
        several = [parts.facts.bridge.counters, parts.core.counters, DESCRIPTORS.counters, parts.counters]
        notes: list[str] = []
        if endpoint is not None:
            _, mesh, discovery = endpoint
            several += [mesh.counters, discovery.counters]
            notes += [*discovery.notes(), *mesh.notes()]
        for each in several:  # counters of one name add up: core and proxies have the same servers
            counters.update(each.as_dict())
        yield_to_data()
        topics_left = services_left = 0
        if services is None or isinstance(services, bool):
            services = None if services or (services is None and topics is None) else ()
        if most is not None and topics is None:
            topics, topics_left = parts.facts.topics.used(most)
        if most is not None and services is None:
            services, services_left = parts.facts.services.used(most)
        trust = parts.trust()
        known, strangers = self._peers.infos(trust) if peers else ((), ())
        return Snapshot(
            agent=self.agent(),
            taken=time.time(),
            peers=known,
            strangers=strangers,
            lost=parts.facts.lost(),
            topics=parts.facts.topics.infos(topics),
            services=parts.facts.services.infos(services),
            topics_left=topics_left,
            services_left=services_left,
            counters=dict(sorted(counters.items())),
            notes=(*notes, *self._notes()),
            unreachable=parts.core.unreachable_infos(),
            died=tuple(parts.core.liveness.died),
            trust=trust,
        )

    def _notes(self) -> Iterator[str]:
        yield from self._parts.core.notes()
        if DESCRIPTORS.problem:
            yield DESCRIPTORS.problem
        yield from self._parts.notes()
        yield from self._parts.facts.notes()
        for outcome in self._parts.realtime:
            if outcome.startswith("no "):
                yield f"realtime: {outcome}; the agent's log says what would grant it"

    def agent(self) -> AgentInfo:
        """The agent itself."""
        parts, endpoint = self._parts, self._parts.endpoint()
        identity, _, discovery = endpoint or (None, None, None)
        now, rss = time.monotonic(), None
        with contextlib.suppress(OSError):  # no file descriptor is left to read /proc
            if now - self._cpu_known >= 1.0:  # the kernel counts in ticks of 10 ms
                self._cpu, self._cpu_known = self._process.cpu_percent(), now
            rss = self._process.memory_info().rss
        return AgentInfo(
            name=self._settings.name,
            guid=str(identity.guid) if identity else "",
            instance=identity.instance.hex() if identity else "",
            domain=self._settings.domain,
            version=rmpa.__version__,
            core_uri=parts.core.uri,
            pid=os.getpid(),
            started=self._started,
            uptime=now - self._began,
            cpu=self._cpu,
            rss=rss,
            addresses=tuple(str(a) for a in (identity.guid.address, *identity.addresses)) if identity else (),
            interfaces=tuple(i.name for i in discovery.interfaces) if discovery else (),
            config_file=str(self._settings.config_file.absolute()) if self._settings.config_file else "",
            realtime=parts.realtime,
            files=DESCRIPTORS.info(),
            core_memory=parts.core.restored(),
            **parts.facts.proxies(),
            **read_facts(AgentInfo),
        )
