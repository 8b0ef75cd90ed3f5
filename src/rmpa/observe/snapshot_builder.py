"""Builds the snapshot that the control socket and ``/diagnostics`` show: the agent, its peers and their services.

The topics are those of ``observe.topics``.
"""

from __future__ import annotations

import contextlib
import os
import time
from collections import Counter
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

import msgspec
import psutil

import rmpa
from rmpa.core.statistics import SampleSummary
from rmpa.discovery import limits as discovery_limits
from rmpa.observe.peer_info import (
    FOREIGN,
    PENDING,
    REVOKED,
    BoundInfo,
    LaneInfo,
    LinkInfo,
    PeerAgent,
    PeerInfo,
    judge_refusal,
    judge_stranger,
)
from rmpa.observe.snapshot import AgentInfo, FilesInfo, SampleSpread, ServiceInfo, Snapshot
from rmpa.observe.topics import TopicFacts, first_names
from rmpa.runtime import limits as runtime_limits
from rmpa.runtime.accept import DESCRIPTORS
from rmpa.runtime.loop import yield_to_data, yielding_to_data
from rmpa.trust.permissions import TrustReason

if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence

    from rmpa.bridge.bridge import Bridge
    from rmpa.bridge.services.bodies import LocalService
    from rmpa.bridge.services.books import RemoteService
    from rmpa.bridge.services.calls import CallStats
    from rmpa.bridge.services.part import Services
    from rmpa.bridge.sessions import PeerSession
    from rmpa.bridge.twins import TwinWatch
    from rmpa.config.settings import Settings
    from rmpa.core.identity import Identity
    from rmpa.core.statistics import Counters
    from rmpa.core.timers import Yielder
    from rmpa.discovery.discovery import Discovery
    from rmpa.discovery.endpoints import PeerView
    from rmpa.discovery.packet_filter import Stranger
    from rmpa.mesh.io.lane import LaneSender
    from rmpa.mesh.io.link import PeerLink
    from rmpa.mesh.io.mesh import Mesh
    from rmpa.mesh.peering import Peer
    from rmpa.ros.core.external import Core
    from rmpa.runtime.stream import Stream
    from rmpa.trust.permissions import TrustStatus

# Seconds after the end of a peer's link in which its beacon may still be one from before.
ADDRESS_SHARED_MARGIN: Final = 1.0


@dataclass(frozen=True, slots=True)
class AgentParts:
    """What an agent is observed by.

    Args:
        core: The agent's ROS core.
        bridge: Its bridge.
        services: The bridge's part for services.
        twins: The bridge's part for peers of this module's kind.
        endpoint: Its identity, mesh and discovery now; ``None`` while it has no place in the network.
        counters: The counters of parts that are not named here.
        notes: What else the user should know, each ready to read.
        realtime: The outcomes of ``--realtime``, ready to read; those that were refused begin with ``no``.
        trust: The state of trust; ``None``: it is off.
        restart: How to restart the agent, if its module has joined a secured mesh since it started; else empty.
    """

    core: Core
    bridge: Bridge
    services: Services
    twins: TwinWatch
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
        self.topics = TopicFacts(parts.core, parts.bridge)

    def reload(self, settings: Settings) -> None:
        """Use other settings from now on."""
        self._settings = settings

    def peer_agent(self) -> PeerAgent:
        """What this agent tells its peers of itself."""
        agent = self.agent()
        told = {name: getattr(agent, name) for name in ("version", "uptime", "core_uri", "cpu", "rss", "proxies")}
        assert agent.files is not None  # noqa: S101 - for mypy
        return PeerAgent(**told, files_open=agent.files.open, files_limit=agent.files.limit)

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
        several = [parts.bridge.counters, parts.core.counters, DESCRIPTORS.counters, parts.counters]
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
            topics, topics_left = self.topics.used(most)
        if most is not None and services is None:
            services, services_left = self._services_used(most)
        trust = parts.trust()
        known, strangers = self._peers(*endpoint, trust) if endpoint is not None and peers else ((), ())
        return Snapshot(
            agent=self.agent(),
            taken=time.time(),
            peers=known,
            strangers=strangers,
            lost=dict(self._parts.bridge.topics.imports.ways.lost),
            topics=self.topics.infos(topics),
            services=self._services(services),
            topics_left=topics_left,
            services_left=services_left,
            counters=dict(sorted(counters.items())),
            notes=(*notes, *self._notes()),
            unreachable=self.topics.unreachable(),
            trust=trust,
        )

    def _notes(self) -> Iterator[str]:
        yield from self._parts.core.notes()
        if DESCRIPTORS.problem:
            yield DESCRIPTORS.problem
        yield from self._parts.notes()
        most = self._settings.limits
        for beyond, kind, limit in (
            (self._parts.bridge.topics.exports.beyond, "topics", most.topics),
            (self._parts.services.exports.beyond, "services", most.services),
        ):
            if beyond:
                which = f"{_count(len(beyond), kind)} of this module are offered to no peer"
                yield f"{which}: more than limits.{kind} = {limit}; {_raise_limit(kind)}"
        for outcome in self._parts.realtime:
            if outcome.startswith("no "):
                yield f"realtime: {outcome}; the agent's log says what would grant it"

    def agent(self) -> AgentInfo:
        """The agent itself."""
        endpoint, bridge, core = self._parts.endpoint(), self._parts.bridge, self._parts.core
        identity, _, discovery = endpoint or (None, None, None)
        proxies = bridge.sessions.proxy_count
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
            core_uri=core.uri,
            version=rmpa.__version__,
            pid=os.getpid(),
            started=self._started,
            uptime=now - self._began,
            cpu=self._cpu,
            rss=rss,
            addresses=tuple(str(a) for a in (identity.guid.address, *identity.addresses)) if identity else (),
            interfaces=tuple(i.name for i in discovery.interfaces) if discovery else (),
            config_file=str(self._settings.config_file.absolute()) if self._settings.config_file else "",
            realtime=self._parts.realtime,
            files=_files(),
            proxies=proxies,
            proxy_sockets=bridge.proxy_nodes.sockets(proxies),
            proxy_listening=bridge.proxy_nodes.listening,
            core_memory=core.restored(),
        )

    # --- peers --------------------------------------------------------------------------------------------------

    def _peers(
        self, identity: Identity, mesh: Mesh, discovery: Discovery, trust: TrustStatus | None
    ) -> tuple[tuple[PeerInfo, ...], tuple[PeerInfo, ...]]:
        """Every peer that is known, and the modules that are not of this mesh; both by name."""
        now, imports = time.monotonic(), self._parts.bridge.topics.imports
        links = {session.link.guid: session for session in self._parts.bridge.sessions.linked()}
        roster = {view.run.identity.guid: view for view in discovery.peers(yielding_to_data)}
        yield_to_data()
        statuses = {status.identity.guid: status for status in mesh.peers()}
        known_guids = {*roster, *statuses, *links}
        infos = [
            self._peer(roster.get(guid), statuses.get(guid), links.get(guid), now)
            for guid in yielding_to_data(known_guids)
        ]
        shown = {
            (entry.origin.instance, entry.name)
            for entry in yielding_to_data(list(imports))
            if entry.origin is not None and entry.shown
        }
        counts, known = Counter(instance for instance, _ in shown), {info.instance: info for info in infos}
        relayed = {}  # modules without a link, of which the membership may know too
        for origin, via in imports.ways:
            blank = PeerInfo(name=origin.name, guid=origin.guid, instance=origin.instance, state="", since_ago=0.0)
            changes = {"state": "relayed", "via": via, "topics_in": counts[origin.instance]}
            relayed[origin.instance] = msgspec.structs.replace(known.get(origin.instance, blank), **changes)
        own = {str(address) for address in (identity.guid.address, *identity.addresses)}
        infos = [info for info in infos if info.instance not in relayed] + [*relayed.values()]
        infos.sort(key=lambda info: (info.name, info.guid))
        joined = {session.link.name: session.link.since or now for session in links.values()}
        knocking = judge_strangers(
            (one for one in discovery.strangers() if one.identity.guid not in known_guids),
            now,
            trust,
            joined=joined,
            others={self._settings.name, *(each.name for each in relayed.values())},
        )
        strange = [*(info for info in infos if info.state in (FOREIGN, PENDING)), *knocking]
        strange.sort(key=lambda info: (info.name, info.guid))
        peers = [info for info in infos if info.state not in (FOREIGN, PENDING)]
        return mark_shared_addresses(peers, own, yielding_to_data), tuple(strange)

    def _peer(self, view: PeerView | None, status: Peer | None, session: PeerSession | None, now: float) -> PeerInfo:
        run = view.run if view is not None else None
        identity = (run or status or session.link).identity  # type: ignore[union-attr] # one of the three is there
        since = status.since if status is not None and status.since is not None else run.since if run else now
        next_attempt = status.next_attempt if status is not None else None
        last_error, invite = status.last_error if status is not None else "", ""
        state = "linking"
        if session is not None:
            state, since = "linked", session.link.since or now
        elif status is not None and status.foreign is not None:
            next_attempt = None
            state, last_error, invite = judge_refusal(status.foreign, self._settings.name, self._parts.restart())
        elif run is not None and view is not None and not view.present:
            state, since = "conflict", run.since
        elif status is not None and status.refused is not None and status.state == "refused":
            state = REVOKED if status.refused.code == TrustReason.REVOKED else "refused"
        return PeerInfo(
            name=identity.name,
            guid=str(identity.guid),
            instance=identity.instance.hex(),
            state=state,
            since_ago=max(0.0, now - since),
            addresses=_endpoints(identity),
            found_ago=now - run.since if run else None,
            beacon_ago=now - run.heard if run else None,
            source=run.found_by if run else "link",
            last_error=last_error,
            invite=invite,
            next_attempt=max(0.0, next_attempt - now) if next_attempt is not None else None,
            **self._linked(session, view.conflicts if view is not None else (), now),
        )

    def _linked(self, session: PeerSession | None, conflicts: tuple[str, ...], now: float) -> dict[str, Any]:
        """The fields of a peer that its link gives, and its conflicts."""
        if session is None:
            return {"conflicts": conflicts}
        topics, peer = self._parts.bridge.topics, session.peer
        twins = self._parts.twins.problem(session)
        fields = {
            "link": _link(session.link, now),
            "topics_in": len(topics.imports.offered_by(peer)),
            "topics_out": topics.exports.topics_for(peer),
            "conflicts": (*conflicts, twins) if twins else conflicts,
        }
        yield_to_data()
        return fields | {
            "beyond": tuple(self._beyond(session)),
            "direct_in": sum(
                path.session.peer == peer and path.endpoint is not None for path in topics.direct_imports
            ),
            "direct_out": sum(owner == peer for owner, _, _ in topics.direct_exports),
        }

    def _beyond(self, session: PeerSession) -> Iterator[BoundInfo]:
        """What of a peer this module refuses because of its limits."""
        topics, services = self._parts.bridge.topics.imports, self._parts.services.imports
        most, peer, name = self._settings.limits, session.peer, session.link.name
        nodes = {"topics": topics.refused_nodes(peer), "services": services.refused_nodes(peer)}
        further = [f"{count} {kind}" for kind, of in nodes.items() if (count := sum(map(len, of.values())))]
        for hidden, kind, limit in (
            (len(nodes["topics"].keys() | nodes["services"].keys()), "nodes", most.nodes),
            (topics.refused(peer), "topics", most.topics),
            (services.refused(peer), "services", most.services),
        ):
            if hidden:
                what = _count(hidden, kind) + (f" with {' and '.join(further)}" if kind == "nodes" else "")
                text = f"{what} of {name} stay hidden here: it has more than limits.{kind} = {limit} of this module; "
                yield BoundInfo(kind=kind, limit=limit, hidden=hidden, text=text + _raise_limit(kind))

    # --- services -----------------------------------------------------------------------------------------------

    def _services_used(self, most: int) -> tuple[Collection[str] | None, int]:
        """The names to show where at most so many services can be shown, and the number of the other services.

        First the services of this module and those that are or were called, all of them; then the others that are
        shown, then the hidden ones. A name stands for all services of that name.
        """
        services = self._parts.services
        first, shown, hidden = set(services.exports.seen), Counter[str](), Counter[str]()
        for _, remote in yielding_to_data(list(services.imports)):
            known = services.shown(remote)
            if remote.route or remote.problem or (known is not None and (known.stats.calls or known.mismatch)):
                first.add(remote.name)
            (shown if remote.shown else hidden)[remote.name] += 1
        return first_names(most, first, shown + hidden, (shown.keys() - first, hidden.keys() - shown.keys() - first))

    def _services(self, wanted: Collection[str] | None) -> tuple[ServiceInfo, ...]:
        """The services of the local graph, without the agent's own, and of the peers: all, or those of some names."""
        if wanted is not None and not wanted:
            return ()
        found = []
        for service, server in list(self._parts.services.exports.seen.items()):
            if wanted is None or service in wanted:
                yield_to_data()
                found.append(self._own_service(service, server))
        for peer, remote in yielding_to_data(list(self._parts.services.imports)):
            if wanted is None or remote.name in wanted:
                yield_to_data()
                found.append(self.peers_service(peer, remote))
        return tuple(sorted(found, key=lambda info: (info.name, info.direction == "in", info.peer)))

    def _own_service(self, service: str, server: LocalService) -> ServiceInfo:
        services = self._parts.services
        exports, peer_name = services.exports, services.imports.peer_name
        about, decision = exports.about.get(service), exports.judge(service, server)
        callers = tuple(sorted(map(peer_name, exports.callers(service))))
        direct = services.direct_exports.of(service, server.node)
        return ServiceInfo(
            name=service,
            node=server.node,
            direction="out",
            state="home" if service not in exports.offered else "open" if callers else "idle",
            type=about.type if about else "",
            md5=about.md5sum if about else "",
            callers=callers,
            wanted=self._parts.bridge.context.services.transport(service).value,
            direct_callers=tuple(sorted(peer_name(peer) for peer, _, _ in direct)),
            crosses=decision.allowed,
            policy=decision.rule,
            **_figures(services.serving.stats.get(service)),
        )

    def peers_service(self, peer: int, remote: RemoteService) -> ServiceInfo:
        """A service of a peer, by the number of its session."""
        services, rules = self._parts.services, self._parts.bridge.context.services
        shown, decision = services.shown(remote), rules.judge(remote.name, remote.node)
        figures = _figures(shown.stats if shown else None)
        figures["problem"] = (shown.mismatch if shown else "") or figures.get("problem") or remote.problem
        direct = services.direct_imports
        transport: dict[str, Any] = {}
        if remote.shown and (address := direct.address(peer, remote.name)):
            transport = {"transport": "direct", "address": address, "lookups": direct.lookups[remote.name]}
        elif remote.shown:
            transport = {"transport": "relay"}
            if (unmet := direct.unmet(remote)) is not None:
                transport |= {"condition": unmet.condition.value, "relayed_because": unmet.text}
        return ServiceInfo(
            name=remote.name,
            node=remote.node,
            direction="in",
            peer=services.imports.peer_name(peer),
            state=remote.state if remote.shown else "hidden",
            wire=remote.wire if remote.wire != remote.name else "",
            type=remote.about.type if remote.about else "",
            md5=remote.about.md5sum if remote.about else "",
            wanted=rules.transport(remote.name).value,
            crosses=decision.allowed,
            policy=decision.rule,
            hidden=services.imports.why_hidden(remote)[0],
            **transport,
            **figures,
        )


def judge_strangers(
    heard: Iterable[Stranger],
    now: float,
    trust: TrustStatus | None,
    *,
    joined: Mapping[str, float],
    others: Collection[str],
) -> Iterator[PeerInfo]:
    """What is shown of the modules that are heard and are not of this mesh.

    Args:
        heard: These modules.
        now: Monotonic seconds.
        trust: The state of trust; ``None``: it is off.
        joined: The names of linked modules, each with the time of its link: it was heard without keys before.
        others: The names of this module and of relayed ones.
    """
    since = dict.fromkeys(map(str.casefold, others), 0.0) | {name.casefold(): at for name, at in joined.items()}
    for one in heard:
        if one.heard > since.get(one.identity.name.casefold(), 0.0):
            info = _stranger(one, now, trust, since.keys())
            if info is not None:
                yield info


def _stranger(one: Stranger, now: float, trust: TrustStatus | None, members: Collection[str]) -> PeerInfo | None:
    identity = one.identity
    shown = judge_stranger(identity.name, one.reason, one.problem, trust=trust, members=members)
    if shown is None:
        return None
    state, text, invite = shown
    guid = str(identity.guid)
    return PeerInfo(
        name=identity.name if identity.name.casefold() not in members else guid.partition("#")[0],
        guid=guid,
        instance=identity.instance.hex(),
        state=state,
        since_ago=now - one.since,
        addresses=_endpoints(identity),
        found_ago=now - one.since,
        beacon_ago=now - one.heard,
        last_error=text,
        invite=invite,
    )


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


def _figures(stats: CallStats | None) -> dict[str, Any]:
    """The fields of a service that its calls give."""
    if stats is None:
        return {}
    known = {name: getattr(stats, name) for name in ("calls", "failed", "active", "problem")}
    return known | {"latency": SampleSpread.of(SampleSummary.of(stats.latencies)) if stats.latencies else None}


def _endpoints(identity: Identity) -> tuple[str, ...]:
    return tuple(f"{host}:{port}" for host, port in identity.endpoints)


_LINK_FIELDS: Final = ("dialled", "clock_offset", "clock_error", "bytes_in", "bytes_out", "dropped", "rests")


def _link(link: PeerLink, now: float) -> LinkInfo:
    host, port = link.remote_endpoint
    bulk = link.bulk_connection.stream if link.bulk_connection is not None else None
    return LinkInfo(
        remote=f"{host}:{port}",
        up_ago=now - (link.since or now),
        rtt=link.connection.clock.rtt,
        queued=link.queue_bytes,
        heard_ago=now - link.heard_at,
        lease=link.connection.keepalive.remote_lease,
        lanes=(_lane(link.express, link.connection.stream), _lane(link.bulk, bulk, unneeded=not link.bulk_wanted)),
        **{name: getattr(link, name) for name in _LINK_FIELDS},
    )


def _lane(lane: LaneSender, stream: Stream | None, *, unneeded: bool = False) -> LaneInfo:
    """A lane of a link; ``stream`` is that of its connection, while it has one."""
    found = LaneInfo(
        name=lane.name, connected=stream is not None, unneeded=unneeded, dropped=lane.outbox.dropped.total()
    )
    if stream is None:
        return msgspec.structs.replace(found, queued=lane.outbox.pending_bytes)
    counts = {"bytes_in": stream.bytes_in, "bytes_out": stream.bytes_out, "queued": stream.pending_bytes}
    return msgspec.structs.replace(found, **counts)


def _count(hidden: int, kind: str) -> str:
    return f"{hidden} {kind if hidden > 1 else kind[:-1]}"


def _raise_limit(kind: str) -> str:
    setting = "services.deny" if kind == "services" else "bridge.deny"
    return f"raise it in rmpa.toml and `rmpa reload`, or deny some by {setting}"


# --- Finds peers that share an IP address with another machine ------------------------------------------------------
#
# Each agent has a mesh port of its own, so the GUIDs of two machines with one address differ, and the roster takes
# them for two agents of one machine. TCP shows the difference: the beacons of both arrive, because multicast needs no
# reply, but connections to the address reach only one machine, and it refuses the other machine's port.


def mark_shared_addresses(
    peers: Sequence[PeerInfo], own: Collection[str], yielder: Yielder = iter
) -> tuple[PeerInfo, ...]:
    """Set the state ``conflict`` for peers whose address seems to be another machine's too.

    Args:
        peers: All peers.
        own: This machine's addresses.
        yielder: Lets data pass.

    Returns:
        The same peers in the same order.
    """
    holders: dict[str, list[PeerInfo]] = {}
    for peer in yielder(peers):
        holders.setdefault(peer.guid.rpartition(":")[0], []).append(peer)
    texts = ((peer, _shared_address(peer, holders, own)) for peer in yielder(peers))
    return tuple(
        msgspec.structs.replace(peer, state="conflict", conflicts=(*peer.conflicts, text)) if text else peer
        for peer, text in texts
    )


def _shared_address(peer: PeerInfo, holders: Mapping[str, Sequence[PeerInfo]], own: Collection[str]) -> str:
    """Why a peer's beacons arrive though TCP has not reached it for ``limits.ADDRESS_SHARED_AFTER``, or empty."""
    address, _, port = peer.guid.partition("#")[0].rpartition(":")
    others = [f"peer {other.name}" for other in holders[address] if other is not peer]
    others += ["this machine"] if address in own else []
    waits = peer.state == "linking" and peer.since_ago >= discovery_limits.ADDRESS_SHARED_AFTER
    if not others or not waits or peer.beacon_ago is None or address.startswith("127."):
        return ""
    if peer.beacon_ago >= peer.since_ago - ADDRESS_SHARED_MARGIN:
        return ""  # an agent that was killed sends no beacons after its link has fallen
    return (
        f"its address {address} is also that of {' and '.join(others)}, and its port {port} does not answer there: "
        "two machines seem to have one address; give one of them another (was an image copied with its address?), "
        f"or, if both run on one machine, open port {port} in its firewall"
    )
