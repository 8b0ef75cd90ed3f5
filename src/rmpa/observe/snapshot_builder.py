"""Builds the snapshot from its sections; the section of services.

Builds the snapshot that the control socket and ``/diagnostics`` show.
"""

from __future__ import annotations

import asyncio
import contextlib
import os
import secrets
import time
from collections import Counter
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import psutil

import rmpa
from rmpa.core.counters import SampleSummary
from rmpa.core.errors import ConfigError
from rmpa.observe import limits
from rmpa.observe.control import GraphHistory, GraphRevision
from rmpa.observe.peer_info import FOREIGN, PeerAgent
from rmpa.observe.peers_section import PeersSection, own_bounds
from rmpa.observe.snapshot import AgentInfo, FilesInfo, SampleSpread, ServiceInfo, Snapshot
from rmpa.observe.topics_section import DirectSection, TopicsSection, unreachable_infos
from rmpa.runtime import limits as runtime_limits
from rmpa.runtime.accept import DESCRIPTORS
from rmpa.runtime.loop import sorted_yielding, yield_to_data, yielding_to_data

if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Iterable, Iterator

    from rmpa.bridge.bridge import Bridge, TwinWatch
    from rmpa.bridge.services.bodies import LocalService
    from rmpa.bridge.services.calls import CallStats
    from rmpa.bridge.services.imports import RemoteService
    from rmpa.bridge.services.part import Services
    from rmpa.config.settings import Settings
    from rmpa.core.counters import Counters
    from rmpa.observe.peer_info import ContractTerm
    from rmpa.observe.peers_section import EndpointView
    from rmpa.observe.topics_section import PeerClocks
    from rmpa.ros.core.external import Core
    from rmpa.ros.master.parameters import GraphChange
    from rmpa.trust.permissions import TrustStatus


# The services in the snapshot: those of this module and of its peers, with the figures of their calls.


class ServicesSection:
    """Reads what the bridge knows of services; changes nothing.

    Args:
        bridge: The agent's.
        services: Its part for services.
    """

    def __init__(self, bridge: Bridge, services: Services) -> None:
        self._bridge = bridge
        self._services = services

    def used(self, most: int) -> tuple[Collection[str] | None, int]:
        """The names to show where at most so many services can be shown, and the number of the other services.

        First the services of this module and those that are or were called, all of them; then the others that are
        shown, then the hidden ones. A name stands for all services of that name.

        Returns:
            The names, ``None`` for all, and how many services are left out.
        """
        first, shown, hidden = set(self._services.exports.seen), Counter[str](), Counter[str]()
        for _, remote in yielding_to_data(list(self._services.imports)):
            known = self._services.shown(remote)
            if remote.route or remote.problem or (known is not None and (known.stats.calls or known.mismatch)):
                first.add(remote.name)
            (shown if remote.shown else hidden)[remote.name] += 1
        counts = shown + hidden
        room = most - sum(counts[name] or 1 for name in first)
        left = 0
        for name in (*sorted_yielding(shown), *sorted_yielding(hidden.keys() - shown.keys())):
            if name in first:
                continue
            if room >= counts[name] and not left:
                first.add(name)
                room -= counts[name]
            else:
                left += counts[name]
        return (first, left) if left else (None, 0)

    def infos(self, wanted: Collection[str] | None = None) -> tuple[ServiceInfo, ...]:
        """The services of the local graph, without the agent's own, and of the peers: all, or those of some names."""
        if wanted is not None and not wanted:
            return ()
        found = [*self._local(wanted), *self._remote(wanted)]
        return tuple(sorted(found, key=lambda info: (info.name, info.direction == "in", info.peer)))

    def _local(self, wanted: Collection[str] | None) -> Iterator[ServiceInfo]:
        for service, server in list(self._services.exports.seen.items()):
            if wanted is not None and service not in wanted:
                continue
            yield_to_data()
            yield self._export(service, server)

    def _export(self, service: str, server: LocalService) -> ServiceInfo:
        exports = self._services.exports
        about = exports.about.get(service)
        decision = exports.judge(service, server)
        callers = tuple(sorted(self._services.imports.peer_name(peer) for peer in exports.callers(service)))
        return ServiceInfo(
            name=service,
            node=server.node,
            direction="out",
            state="home" if service not in exports.offered else "open" if callers else "idle",
            type=about.type if about else "",
            md5=about.md5sum if about else "",
            callers=callers,
            wanted=self._bridge.context.services.transport(service).value,
            direct_callers=tuple(
                sorted(
                    self._services.imports.peer_name(peer)
                    for peer, _, _ in self._services.direct_exports.of(service, server.node)
                )
            ),
            crosses=decision.allowed,
            policy=decision.rule,
            **_figures(self._services.serving.stats.get(service)),
        )

    def _remote(self, wanted: Collection[str] | None) -> Iterator[ServiceInfo]:
        for peer, remote in yielding_to_data(list(self._services.imports)):
            if wanted is not None and remote.name not in wanted:
                continue
            yield_to_data()
            yield self._import(peer, remote)

    def _import(self, peer: int, remote: RemoteService) -> ServiceInfo:
        shown = self._services.shown(remote)
        decision = self._bridge.context.services.judge(remote.name, remote.node)
        figures = _figures(shown.stats if shown else None)
        figures["problem"] = (shown.mismatch if shown else "") or figures.get("problem") or remote.problem
        return ServiceInfo(
            name=remote.name,
            node=remote.node,
            direction="in",
            peer=self._services.imports.peer_name(peer),
            state=remote.state if remote.shown else "hidden",
            wire=remote.wire if remote.wire != remote.name else "",
            type=remote.about.type if remote.about else "",
            md5=remote.about.md5sum if remote.about else "",
            crosses=decision.allowed,
            policy=decision.rule,
            hidden=self._services.imports.why_hidden(remote)[0],
            **self._transport(peer, remote),
            **figures,
        )

    def _transport(self, peer: int, remote: RemoteService) -> dict[str, Any]:
        """The fields of a peer's service that say by which transport it is called."""
        wanted = self._bridge.context.services.transport(remote.name).value
        if not remote.shown:
            return {"wanted": wanted}
        direct = self._services.direct_imports
        if address := direct.address(peer, remote.name):
            lookups = direct.lookups[remote.name]
            return {"wanted": wanted, "transport": "direct", "address": address, "lookups": lookups}
        found = {"wanted": wanted, "transport": "relay"}
        unmet = direct.unmet(remote)
        return found if unmet is None else found | {"condition": unmet.condition.value, "relayed_because": unmet.text}


def _figures(stats: CallStats | None) -> dict[str, Any]:
    """The fields of a service that its calls give."""
    if stats is None:
        return {}
    return {
        "calls": stats.calls,
        "failed": stats.failed,
        "active": stats.active,
        "latency": SampleSpread.of(SampleSummary.of(stats.latencies)) if stats.latencies else None,
        "problem": stats.problem,
    }


# Lets clients of the control socket wait for the next change of the local graph, and tells them what has changed.


_REVISION_BITS = 52
"""Each revision is an integer that all programs read exactly from JSON, and no two agents begin near each other."""


class GraphRevisions:
    """The revision of a core's graph: a number that every change of the graph replaces.

    Args:
        core: Tells the changes.
        rows: Whether clients get the changes themselves. Those of a core that is another program are known here later
            than there.
    """

    def __init__(self, core: Core, *, rows: bool) -> None:
        self._core = core
        self._rows = rows
        # Begins anywhere, so that a client takes the graph of an agent that was started anew for another one.
        self._history = GraphHistory(secrets.randbits(_REVISION_BITS))
        self._changed = asyncio.Event()
        self._waiting = 0
        core.on_change(self._add)

    def _add(self, change: GraphChange) -> None:
        self._history.add(change)
        if self._waiting:
            self._changed.set()
            self._changed = asyncio.Event()

    async def after(self, args: dict[str, object]) -> GraphRevision:
        """The revision, as soon as it differs from the one that the client knows.

        Args:
            args: ``after``: the known revision; ``wait``: the most seconds to wait for another one, 0 by default;
                ``rows``: true for what has changed since ``after``.

        Raises:
            ConfigError: An argument is out of range.
        """
        known, wait = args.get("after"), args.get("wait", 0)
        if not isinstance(wait, int | float) or not 0 <= wait <= limits.CONTROL_WAIT_MAX:
            raise ConfigError("wait", f"{wait!r} is not between 0 and {limits.CONTROL_WAIT_MAX:g} s")
        if known == self._history.revision:
            self._waiting += 1
            try:
                with contextlib.suppress(TimeoutError):
                    async with asyncio.timeout(wait):
                        await self._changed.wait()
            finally:
                self._waiting -= 1
        if not self._rows or args.get("rows") is not True:
            return GraphRevision(revision=self._history.revision)
        rows = self._history.rows_since(known, self._core.state())
        return GraphRevision(revision=self._history.revision, core_uri=self._core.uri, rows=rows)


@dataclass(frozen=True, slots=True)
class SnapshotSources:
    """What the snapshot is built from.

    Args:
        core: The agent's ROS core.
        bridge: Its bridge.
        clocks: The clocks of its peers.
        services: The bridge's part for services.
        twins: The bridge's part for peers of this module's kind.
        endpoint: Its place in the network now; ``None`` while it has none.
        counters: The counters of parts that are not named here.
        notes: What else the user should know, each ready to read.
        started: When the agent started, seconds since the epoch.
        realtime: The outcomes of ``--realtime``, ready to read; those that were refused begin with ``no``.
        trust: The state of trust; ``None``: it is off.
    """

    core: Core
    bridge: Bridge
    clocks: PeerClocks
    services: Services
    twins: TwinWatch
    endpoint: Callable[[], EndpointView | None]
    counters: tuple[Counters, ...]
    notes: Callable[[], Iterable[str]]
    started: float
    realtime: tuple[str, ...] = ()
    trust: Callable[[], TrustStatus | None] = lambda: None


class SnapshotBuilder:
    """Builds snapshots of an agent; changes nothing.

    Args:
        settings: The agent's settings.
        sources: The parts of the agent.
    """

    def __init__(self, settings: Settings, sources: SnapshotSources) -> None:
        self._settings = settings
        self._sources = sources
        self._process = psutil.Process()
        self._process.cpu_percent()  # the first call only begins to count
        self._cpu: float | None = None
        self._cpu_known = self._began = time.monotonic()
        self._peers = PeersSection(sources.bridge, sources.services, sources.twins)
        self.direct = DirectSection(sources.bridge)
        """What is known of direct transport."""
        self._topics = TopicsSection(sources.core, sources.bridge, sources.clocks, self.direct)
        self._services = ServicesSection(sources.bridge, sources.services)

    @property
    def endpoint(self) -> EndpointView | None:
        """The agent's place in the network now."""
        return self._sources.endpoint()

    def reload(self, settings: Settings) -> None:
        """Use other settings from now on."""
        self._settings = settings

    def contract(self, topic: str, type_name: str) -> dict[str, ContractTerm]:
        """The terms of a topic's contract by the settings, by key; ``type_name`` may be empty."""
        return self._topics.contract(topic, type_name)

    def peer_agent(self) -> PeerAgent:
        """What this agent tells its peers of itself."""
        agent = self._agent(self.endpoint)
        return PeerAgent(
            version=agent.version,
            uptime=agent.uptime,
            core_uri=agent.core_uri,
            cpu=agent.cpu,
            rss=agent.rss,
            files_open=agent.files.open if agent.files is not None else None,
            files_limit=agent.files.limit if agent.files is not None else None,
            proxies=agent.proxies,
        )

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
        endpoint = self.endpoint
        counters: Counter[str] = Counter()
        for each in self._counters(endpoint):  # counters of one name add up: core and proxies have the same servers
            counters.update(each.as_dict())
        yield_to_data()
        topics_left = services_left = 0
        if services is None or isinstance(services, bool):
            services = None if services or (services is None and topics is None) else ()
        if most is not None and topics is None:
            topics, topics_left = self._topics.used(most)
        if most is not None and services is None:
            services, services_left = self._services.used(most)
        known = self._peers.infos(endpoint) if endpoint is not None and peers else ()
        return Snapshot(
            agent=self._agent(endpoint),
            taken=time.time(),
            peers=tuple(info for info in known if info.state != FOREIGN),
            strangers=tuple(info for info in known if info.state == FOREIGN),
            topics=self._topics.infos(topics),
            services=self._services.infos(services),
            topics_left=topics_left,
            services_left=services_left,
            counters=dict(sorted(counters.items())),
            notes=self._notes(endpoint),
            unreachable=unreachable_infos(self._sources.core, time.monotonic()),
            trust=self._sources.trust(),
        )

    def _counters(self, endpoint: EndpointView | None) -> Iterator[Counters]:
        yield from (
            self._sources.bridge.counters,
            self._sources.core.counters,
            DESCRIPTORS.counters,
            *self._sources.counters,
        )
        if endpoint is not None:
            yield from (endpoint.mesh.counters, endpoint.discovery.counters)

    def _notes(self, endpoint: EndpointView | None) -> tuple[str, ...]:
        notes = [] if endpoint is None else [*endpoint.discovery.notes(), *endpoint.mesh.notes()]
        notes += self._sources.core.notes()
        if DESCRIPTORS.problem:
            notes.append(DESCRIPTORS.problem)
        notes += self._sources.notes()
        notes += own_bounds(self._sources.bridge, self._sources.services)
        refused = (outcome for outcome in self._sources.realtime if outcome.startswith("no "))
        notes += (f"realtime: {outcome}; the agent's log says what would grant it" for outcome in refused)
        return tuple(notes)

    def _agent(self, endpoint: EndpointView | None) -> AgentInfo:
        identity = endpoint.identity if endpoint is not None else None
        bridge, core = self._sources.bridge, self._sources.core
        proxies = sum(len(session.proxies) for session in bridge.sessions)
        return AgentInfo(
            name=self._settings.name,
            guid=str(identity.guid) if identity else "",
            instance=identity.instance.hex() if identity else "",
            domain=self._settings.domain,
            core_uri=core.uri,
            version=rmpa.__version__,
            pid=os.getpid(),
            started=self._sources.started,
            uptime=time.monotonic() - self._began,
            cpu=self._cpu_share(),
            rss=self._memory(),
            addresses=tuple(str(a) for a in (identity.guid.address, *identity.addresses)) if identity else (),
            interfaces=tuple(i.name for i in endpoint.discovery.interfaces) if endpoint is not None else (),
            config_file=str(self._settings.config_file.absolute()) if self._settings.config_file else "",
            realtime=self._sources.realtime,
            files=_files(),
            proxies=proxies,
            proxy_sockets=bridge.proxy_nodes.sockets(proxies),
            proxy_listening=bridge.proxy_nodes.listening,
            core_memory=core.restored(),
        )

    def _cpu_share(self) -> float | None:
        """Percent of one core, measured over ``limits.CPU_INTERVAL`` or longer."""
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
        problem=DESCRIPTORS.problem,
    )
