"""An agent's place in the network: one GUID, its port, its discovery and its links.

When the addresses of the machine change so that the GUID's own is no longer among them (an agent that started
before the network did has 127.0.0.1), the agent leaves with a goodbye and takes a new place; its core and the
local graph do not notice.
"""

from __future__ import annotations

import logging
import os
from typing import TYPE_CHECKING, Final

from rmpa.core import limits
from rmpa.core.guid import Guid
from rmpa.core.identity import Identity
from rmpa.discovery.events import PeerChanged, PeerConflict, PeerFound, PeerLost, PeerRestarted
from rmpa.discovery.io.discovery import Discovery
from rmpa.discovery.io.interfaces import choose, further_addresses, list_interfaces, pick_address
from rmpa.mesh.io.link import LinkHandlers
from rmpa.mesh.io.mesh import Mesh
from rmpa.mesh.peering import LinkDown, LinkDownCause
from rmpa.runtime.sockets import open_mesh_port
from rmpa.runtime.system_clock import SystemClock

if TYPE_CHECKING:
    from collections.abc import Callable
    from ipaddress import IPv4Address

    from rmpa.bridge.io.bridge import Bridge
    from rmpa.config.settings import Settings
    from rmpa.discovery.events import Event
    from rmpa.discovery.io.interfaces import Interface
    from rmpa.mesh.io.link import PeerLink

_log = logging.getLogger(__name__)

_INCARNATIONS: Final = 1 << 16


class NetworkEndpoint:
    """Discovery and mesh under one identity, feeding the bridge.

    Args:
        settings: The agent's settings.
        bridge: Told of links, their messages and their end.
        port: The mesh port to take; 0 lets the system choose.
        on_displaced: Called when the machine's addresses no longer fit the identity.

    Raises:
        StartError: The port cannot be had.
    """

    def __init__(self, settings: Settings, bridge: Bridge, *, port: int, on_displaced: Callable[[], None]) -> None:
        clock = SystemClock()
        self._settings = settings
        self._bridge = bridge
        sessions, receiver = bridge.sessions, bridge.receiver
        self._on_displaced = on_displaced
        tcp, udp = open_mesh_port(port)
        self.port: int = tcp.getsockname()[1]
        usable = choose(list_interfaces(), settings.interfaces)
        address = pick_address(usable)
        # Seconds modulo 18 hours: later for each restart. The random instance id is what decides.
        incarnation = clock.wall_ns() // 1_000_000_000 % _INCARNATIONS
        self.identity = Identity(
            Guid.of(address, self.port, incarnation),
            os.urandom(limits.INSTANCE_ID_BYTES),
            settings.name,
            settings.domain,
            further_addresses(usable, address),
        )
        bridge.place(self.identity)
        self.mesh = Mesh(
            self.identity,
            tcp,
            on_link_up=self._link_up,
            on_link_down=self._link_down,
            on_control=bridge.control,
            handlers=LinkHandlers(receiver.data, receiver.part, receiver.mark, sessions.clock, sessions.lane_lost),
            lanes=settings.lanes,
            clock=clock,
        )
        self.discovery = Discovery(
            self.identity, settings, udp, on_event=self._event, on_interfaces=self._interfaces, clock=clock
        )
        self._udp = udp

    async def start(self) -> None:
        """Accept links, then say that we are here."""
        await self.mesh.start()
        await self.discovery.start()
        _log.info("= %s, domain %d, is on the air", self.identity, self.identity.domain)

    async def close(self) -> None:
        """Say goodbye, end the links in order."""
        await self.discovery.close()
        self._udp.close()
        await self.mesh.close()

    def _event(self, event: Event) -> None:
        match event:
            case PeerFound(identity=identity, source=source):
                _log.info("+ %s found", identity)
                self.mesh.peer_found(identity, source[0] if source else None)
            case PeerChanged(identity=identity):
                self.mesh.peer_found(identity)
            case PeerRestarted(identity=identity, previous=previous, source=source):
                _log.info("+ %s restarted, it was %s", identity, previous.guid)
                self.mesh.peer_gone(previous.guid)
                self.mesh.peer_found(identity, source[0] if source else None)
            case PeerLost(identity=identity, reason=reason):
                _log.info("- %s %s", identity, reason.value)
                self.mesh.peer_gone(identity.guid)
            case PeerConflict():
                pass  # said by the discovery, no more often than a log can bear

    def _link_up(self, link: PeerLink) -> None:
        # Its beacons' port is its mesh port, whichever port an accepted connection came from.
        self.discovery.link_up(link.identity, (link.remote_endpoint[0], link.identity.guid.port))
        self._bridge.sessions.link_up(link)

    def _link_down(self, link: PeerLink, down: LinkDown) -> None:
        self._bridge.sessions.link_down(link)
        if down.cause is not LinkDownCause.REPLACED:  # the peer is still linked, and keeps its place in the roster
            self.discovery.link_down(link.identity.guid, link.identity.instance)

    def _interfaces(self, everything: tuple[Interface, ...]) -> bool:
        """Whether we stay where we are."""
        displaced = is_displaced(self.identity.guid.address, everything, self._settings.interfaces)
        if displaced:
            self._on_displaced()
        return not displaced


def is_displaced(ours: IPv4Address, everything: tuple[Interface, ...], wanted: tuple[str, ...]) -> bool:
    """Whether another address must stand for us.

    An interface without its cable keeps its address, which comes back with it; until then links by other interfaces
    go on. An address that is gone altogether may come back too (a lease renewed), but not one that was replaced.

    Args:
        ours: The address in our GUID.
        everything: All interfaces, up or not.
        wanted: The names of those that the user chose; empty means all.
    """
    if pick_address(choose(everything, wanted)).is_loopback:
        return False
    kept = {address for i in everything if not wanted or i.name in wanted for address in i.addresses}
    return ours.is_loopback or ours not in kept
