"""Builds the snapshot that the control socket shows from what the rooms tell."""

from __future__ import annotations

import os
import time
from collections import Counter
from typing import TYPE_CHECKING

import psutil

import rmpa
from rmpa.bridge.imports import RouteState
from rmpa.bridge.policy import Policy, is_own
from rmpa.core.aio.clock import SystemClock
from rmpa.core.aio.realtime import refused
from rmpa.monitor.snapshot import AgentInfo, LinkInfo, PeerInfo, RouteInfo, Snapshot, TopicInfo

if TYPE_CHECKING:
    from rmpa.agent.station import Station
    from rmpa.bridge.aio.bridge import Attached, Bridge
    from rmpa.core.aio.realtime import Wish
    from rmpa.core.config import Settings
    from rmpa.core.counters import Counters
    from rmpa.discovery.events import PeerView
    from rmpa.mesh.aio.link import MeshLink
    from rmpa.mesh.peering import PeerStatus
    from rmpa.ros.aio.core import RosCore


class View:
    """Reads the rooms; changes nothing.

    Args:
        settings: The agent's settings.
        core: Its ROS core.
        bridge: Its bridge.
        counters: Those of its other parts.
        started: Seconds since the epoch.
        wishes: What came of ``--realtime``.
    """

    def __init__(
        self,
        settings: Settings,
        core: RosCore,
        bridge: Bridge,
        *counters: Counters,
        started: float,
        wishes: tuple[Wish, ...] = (),
    ) -> None:
        self._settings = settings
        self._core = core
        self._bridge = bridge
        self._counters = counters
        self._started = started
        self._wishes = wishes
        self._process = psutil.Process()
        self._clock = SystemClock()
        self._policy = Policy(settings.policy)
        self.station: Station | None = None

    def snapshot(self) -> Snapshot:
        """Everything at this moment."""
        rooms = [self._bridge.counters, self._core.counters, *self._counters]
        if self.station is not None:
            rooms += [self.station.mesh.counters, self.station.discovery.counters]
        counters: Counter[str] = Counter()
        for room in rooms:  # the core and the proxies have the same servers: their counts add up
            counters.update(room.as_dict())
        return Snapshot(
            agent=self._agent(),
            taken=time.time(),
            peers=self._peers(),
            topics=self._topics(),
            counters=dict(sorted(counters.items())),
            notes=self._notes(),
        )

    def _notes(self) -> tuple[str, ...]:
        notes = tuple(self.station.discovery.notes()) if self.station is not None else ()
        missing = refused(self._wishes)
        return (*notes, missing) if missing else notes

    def _agent(self) -> AgentInfo:
        identity = self.station.identity if self.station is not None else None
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
            cpu=self._process.cpu_percent(),
            rss=self._process.memory_info().rss,
            addresses=tuple(str(a) for a in (identity.guid.address, *identity.addresses)) if identity else (),
            interfaces=tuple(i.name for i in self.station.discovery.interfaces) if self.station else (),
            config_file=str(self._settings.config_file or ""),
            realtime=tuple(map(str, self._wishes)),
        )

    def _peers(self) -> tuple[PeerInfo, ...]:
        if self.station is None:
            return ()
        now = self._clock.now()
        links = {attached.link.guid: attached for attached in self._bridge.attached()}
        roster = {view.identity.guid: view for view in self.station.discovery.peers()}
        statuses = {status.identity.guid: status for status in self.station.mesh.peers()}
        infos = [
            self._peer(roster.get(guid), statuses.get(guid), links.get(guid), now)
            for guid in {*roster, *statuses, *links}
        ]
        return tuple(sorted(infos, key=lambda info: (info.name, info.guid)))

    def _peer(
        self, view: PeerView | None, status: PeerStatus | None, attached: Attached | None, now: float
    ) -> PeerInfo:
        identity = (view or status or attached.link).identity  # type: ignore[union-attr] # one of the three is there
        conflicts = view.conflicts if view is not None else ()
        unlinked = status.since if status is not None and status.since is not None else view.since if view else now
        if attached is not None:
            state, since = "linked", attached.link.since or now
        elif view is not None and not view.present:
            state, since = "conflict", view.since
        elif status is not None and status.state == "refused":
            state, since = "refused", unlinked
        else:
            state, since = "linking", unlinked
        next_attempt = status.next_attempt if status is not None else None
        return PeerInfo(
            name=identity.name,
            guid=str(identity.guid),
            instance=identity.instance.hex(),
            state=state,
            since_ago=max(0.0, now - since),
            addresses=tuple(f"{host}:{port}" for host, port in identity.endpoints),
            found_ago=now - view.since if view else None,
            beacon_ago=now - view.heard if view else None,
            source=view.found_by.value if view else "link",
            link=self._link(attached.link, now) if attached is not None else None,
            last_error=status.last_error if status is not None else "",
            next_attempt=max(0.0, next_attempt - now) if next_attempt is not None else None,
            conflicts=conflicts,
            topics_in=self._offered_by(attached.peer) if attached is not None else 0,
            topics_out=len({s.topic for s in self._bridge.exports.offered}) if attached is not None else 0,
        )

    def _offered_by(self, peer: int) -> int:
        return len({source.topic for number, source, _ in self._bridge.imports if number == peer})

    @staticmethod
    def _link(link: MeshLink, now: float) -> LinkInfo:
        host, port = link.remote_endpoint
        return LinkInfo(
            remote=f"{host}:{port}",
            dialled=link.dialled,
            up_ago=now - (link.since or now),
            rtt=link.rtt,
            clock_offset=link.clock_offset,
            clock_error=link.clock_error,
            bytes_in=link.bytes_in,
            bytes_out=link.bytes_out,
            queued=link.queue_bytes,
            dropped=link.dropped,
            heard_ago=now - link.heard_at,
        )

    # --- topics ------------------------------------------------------------------------------------------------

    def _topics(self) -> tuple[TopicInfo, ...]:
        state = self._core.state()
        routes: dict[str, list[RouteInfo]] = {}
        mismatches: dict[str, list[str]] = {}
        for route in (*self._inbound(mismatches), *self._outbound(mismatches)):
            routes.setdefault(route[0], []).append(route[1])
        names = sorted({*state.publishers, *state.subscribers, *routes})
        return tuple(
            self._topic(
                name,
                state.types.get(name, ""),
                tuple(node for node in state.publishers.get(name, {}) if not is_own(node)),
                tuple(node for node in state.subscribers.get(name, {}) if not is_own(node)),
                tuple(routes.get(name, ())),
                tuple(mismatches.get(name, ())),
            )
            for name in names
        )

    def _topic(
        self,
        name: str,
        type_name: str,
        publishers: tuple[str, ...],
        subscribers: tuple[str, ...],
        routes: tuple[RouteInfo, ...],
        mismatches: tuple[str, ...],
    ) -> TopicInfo:
        decision = self._policy.judge(name, type_name, publishers[0] if publishers else "/")
        return TopicInfo(
            name=name,
            type=type_name or next((route.type for route in routes), ""),
            md5=next((route.md5 for route in routes if route.md5), ""),
            publishers=publishers,
            subscribers=subscribers,
            routes=routes,
            crosses=decision.allowed,
            policy=decision.rule,
            mismatches=mismatches,
        )

    def _inbound(self, mismatches: dict[str, list[str]]) -> list[tuple[str, RouteInfo]]:
        found = []
        attached = {a.peer: a for a in self._bridge.attached()}
        for peer, source, entry in self._bridge.imports:
            at = attached[peer]
            flow = at.inbound.flows.get(entry.route)
            publication = at.inbound.publication(source)
            if entry.conflict:
                mismatches.setdefault(source.topic, []).append(f"{at.link.name}: {entry.hidden}")
            for text in self._bridge.mismatches(source):
                mismatches.setdefault(source.topic, []).append(text)
            info = RouteInfo(
                peer=at.link.name,
                node=source.node,
                direction="in",
                state="hidden" if not entry.shown else entry.state.name.lower(),
                type=entry.type,
                md5=entry.description.md5 if entry.description else "",
                messages=flow.messages if flow else 0,
                bytes=flow.bytes if flow else 0,
                dropped=(flow.lost if flow else 0) + (publication.dropped if publication else 0),
                last_ago=(time.time_ns() - flow.last_wall_ns) / 1e9 if flow and flow.messages else None,
                latched=entry.description.latching if entry.description else False,
                problem=entry.hidden or (entry.problem if entry.state is not RouteState.OPEN else ""),
            )
            found.append((source.topic, info))
        return found

    def _outbound(self, mismatches: dict[str, list[str]]) -> list[tuple[str, RouteInfo]]:
        found = []
        names = {attached.peer: attached.link.name for attached in self._bridge.attached()}
        for source, local in self._bridge.exports.offered.items():
            mismatches.setdefault(source.topic, []).extend(self._bridge.mismatches(source))
            about = self._bridge.exports.description(source)
            flow = self._bridge.outbound.flows.get(source)
            for peer in self._bridge.exports.flowing(source):
                info = RouteInfo(
                    peer=names.get(peer, ""),
                    node=source.node,
                    direction="out",
                    state="open",
                    type=local.type,
                    md5=about.md5 if about else "",
                    messages=flow.messages if flow else 0,
                    bytes=flow.bytes if flow else 0,
                    dropped=flow.dropped if flow else 0,
                    latched=about.latching if about else False,
                )
                found.append((source.topic, info))
        return found
