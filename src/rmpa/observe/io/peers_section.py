"""The peers' part of the snapshot: what discovery, mesh and bridge know of each."""

from __future__ import annotations

from typing import TYPE_CHECKING

import msgspec

from rmpa.observe.io.bounds_section import bound_here, bound_there
from rmpa.observe.shared_address import mark_shared_addresses
from rmpa.observe.snapshot import LinkInfo, PeerInfo
from rmpa.runtime.event_loop import yield_to_data
from rmpa.runtime.system_clock import SystemClock

if TYPE_CHECKING:
    from collections.abc import Mapping

    from rmpa.bridge.io.bounds import Bounds
    from rmpa.bridge.io.bridge import Bridge
    from rmpa.bridge.io.network_endpoint import NetworkEndpoint
    from rmpa.bridge.session.peer_session import PeerSession
    from rmpa.discovery.events import PeerView
    from rmpa.mesh.io.link import PeerLink
    from rmpa.mesh.io.path_monitor import PathMonitor
    from rmpa.mesh.peering import PeerStatus
    from rmpa.observe.snapshot import BoundInfo


class PeersSection:
    """Reads what is known of peers; changes nothing.

    Args:
        bridge: The agent's.
    """

    def __init__(self, bridge: Bridge) -> None:
        self._bridge = bridge
        self.bounds: Bounds | None = None
        """What is beyond the limits; told once it is known."""
        self._clock = SystemClock()

    def infos(self, station: NetworkEndpoint) -> tuple[PeerInfo, ...]:
        """Every peer that is known, by name."""
        now = self._clock.now()
        links = {attached.link.guid: attached for attached in self._bridge.attached()}
        yield_to_data()  # a millisecond each with a full roster
        roster = {view.identity.guid: view for view in station.discovery.peers()}
        yield_to_data()
        statuses = {status.identity.guid: status for status in station.mesh.peers()}
        infos = []
        for guid in {*roster, *statuses, *links}:
            yield_to_data()
            attached = links.get(guid)
            info = self._peer(roster.get(guid), statuses.get(guid), attached, now)
            if attached is not None:
                info = msgspec.structs.replace(info, link=self._link(attached.link, station.mesh.paths, now))
                theirs = len(self._bridge.imports.offered_by(attached.peer))
                ours = self._bridge.exports.topics_for(attached.peer)
                yield_to_data()
                beyond = self._beyond(attached)
                info = msgspec.structs.replace(info, topics_in=theirs, topics_out=ours, beyond=beyond)
            infos.append(info)
        relayed = self._relayed({info.instance: info for info in infos})
        infos = [info for info in infos if info.instance not in {one.instance for one in relayed}]
        own = {str(address) for address in (station.identity.guid.address, *station.identity.addresses)}
        return mark_shared_addresses(sorted((*infos, *relayed), key=lambda info: (info.name, info.guid)), own)

    def _beyond(self, attached: PeerSession) -> tuple[BoundInfo, ...]:
        if self.bounds is None:
            return ()
        name, peer = attached.link.name, attached.peer
        here = [bound_here(name, one) for one in self.bounds.here(peer)]
        return (*here, *(bound_there(name, one) for one in self.bounds.there(peer)))

    def _relayed(self, known: Mapping[str, PeerInfo]) -> list[PeerInfo]:
        """Modules without a link whose topics a relay passes on; their beacons may be heard all the same."""
        infos = []
        for origin, via in self._bridge.imports.ways:
            blank = PeerInfo(name=origin.name, guid=origin.guid, instance=origin.instance, state="", since_ago=0.0)
            info = known.get(origin.instance, blank)
            topics = self._bridge.imports.relayed_topics(origin.instance)
            infos.append(msgspec.structs.replace(info, state="relayed", via=via, topics_in=len(topics)))
        return infos

    def _peer(
        self, view: PeerView | None, status: PeerStatus | None, attached: PeerSession | None, now: float
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
            last_error=status.last_error if status is not None else "",
            next_attempt=max(0.0, next_attempt - now) if next_attempt is not None else None,
            conflicts=conflicts,
        )

    @staticmethod
    def _link(link: PeerLink, paths: PathMonitor, now: float) -> LinkInfo:
        host, port = link.remote_endpoint
        problem = paths.problem(link)
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
            packet=paths.packet_bytes(link),
            path_problem=problem.text if problem is not None else "",
            path_remedy=problem.remedy if problem is not None else "",
        )
