"""An agent's place in the network: its GUID and mesh port, discovery and mesh, wired to the bridge.

When the machine loses the address in the GUID (an agent that started before the network did has 127.0.0.1), the agent
leaves with a goodbye and joins under a new GUID. Its core and the local graph do not notice.
"""

from __future__ import annotations

import asyncio
import logging
import os
from contextlib import suppress
from typing import TYPE_CHECKING, Final

from rmpa.core import limits
from rmpa.core.errors import RmpaError
from rmpa.core.identity import Guid, Identity
from rmpa.discovery.discovery import Discovery
from rmpa.discovery.network import choose, further_addresses, list_interfaces, pick_address
from rmpa.mesh import limits as mesh_limits
from rmpa.mesh.io.link import LinkHandlers
from rmpa.mesh.io.mesh import Mesh
from rmpa.mesh.peering import REPLACED
from rmpa.runtime.accept import open_mesh_port
from rmpa.runtime.loop import SystemClock

if TYPE_CHECKING:
    from ipaddress import IPv4Address

    from rmpa.agent.trust import AgentTrust
    from rmpa.bridge.bridge import Bridge
    from rmpa.config.settings import Settings
    from rmpa.discovery.membership import PeerEvent
    from rmpa.discovery.network import Interface
    from rmpa.mesh.io.link import PeerLink

_log = logging.getLogger(__name__)

_INCARNATIONS: Final = 1 << 16


class NetworkEndpoint:
    """Discovery and mesh under one identity, feeding the bridge.

    Args:
        network: Has the settings, the bridge, which gets links, and this module's part in a secured mesh.
        port: The mesh port; 0 lets the system choose.

    Raises:
        StartError: The port cannot be bound.
    """

    def __init__(self, network: Network, port: int) -> None:
        settings, bridge, trust, clock = network.settings, network.bridge, network.trust, SystemClock()
        self._network = network
        self._bridge = bridge
        tcp, udp = open_mesh_port(port)
        self.port: int = tcp.getsockname()[1]
        usable = choose(list_interfaces(), settings.interfaces)
        address = pick_address(usable)
        # Seconds modulo 18 hours, so that a restart gets a higher number; the random instance id decides in doubt.
        incarnation = clock.wall_ns() // 1_000_000_000 % _INCARNATIONS
        self.identity = Identity(
            Guid.of(address, self.port, incarnation),
            os.urandom(limits.INSTANCE_ID_BYTES),
            settings.name,
            settings.domain,
            further_addresses(usable, address),
        )
        bridge.place(self.identity)
        if trust is not None:
            trust.identity = self.identity
        self._members: set[Guid] = set()
        self.mesh = Mesh(
            self.identity,
            tcp,
            LinkHandlers(
                self._link_up,
                self._link_down,
                bridge.control,
                bridge.mark,
                bridge.sessions.clock,
                bridge.sessions.lane_lost,
            ),
            lanes=settings.lanes,
            clock=clock,
            security=trust.membership if trust is not None else None,
            on_join=trust.joins.serve if trust is not None and trust.joins is not None else None,
        )
        self.discovery = Discovery(
            self.identity,
            settings,
            udp,
            on_event=self._event,
            on_interfaces=self._interfaces,
            trust=trust.membership.packets if trust is not None else None,
        )
        self._udp = udp

    async def start(self) -> None:
        """Accept links, then send beacons."""
        await self.mesh.start()
        await self.discovery.start()
        _log.info("= %s, domain %d, is on the air", self.identity, self.identity.domain)

    async def close(self) -> None:
        """Send the goodbye, and close the links in order."""
        await self.discovery.close()
        self._udp.close()
        await self.mesh.close()

    def _event(self, event: PeerEvent) -> None:
        identity = event.identity
        match event.change:
            case "found":
                _log.info("+ %s found", identity)
                self._members.add(identity.guid)
                self.mesh.peer_found(identity, event.source[0] if event.source else None)
            case "changed":
                self.mesh.peer_found(identity)
            case "lost":
                _log.info("- %s %s", identity, event.reason)
                self._members.discard(identity.guid)
                self.mesh.peer_gone(identity.guid)
            case "doubted":
                # A link at rest would notice after many seconds that its peer is gone.
                if (link := self.mesh.link(identity.guid)) is not None:
                    link.touch()
            case "conflict":
                pass  # discovery has logged the error, at a bounded rate
        self.mesh.count_peers(len(self._members))

    def _link_up(self, link: PeerLink) -> None:
        # Its beacons come from its mesh port; an accepted connection may come from any port.
        self.discovery.link_up(link.identity, (link.remote_endpoint[0], link.identity.guid.port))
        self._bridge.sessions.link_up(link)

    def _link_down(self, link: PeerLink, reason: str) -> None:
        self._bridge.sessions.link_down(link)
        if reason != REPLACED:  # else its peer stays linked, and keeps its endpoint
            self.discovery.link_down(link.identity.guid, link.identity.instance)

    def _interfaces(self, everything: tuple[Interface, ...]) -> bool:
        """Handle a change of the machine's interfaces; return whether the GUID's address is still valid."""
        displaced = is_displaced(self.identity.guid.address, everything, self._network.settings.interfaces)
        if displaced:
            self._network.move()
        return not displaced


class Network:
    """Keeps an agent in the network, and moves it to a new endpoint when it has lost its address.

    Args:
        settings: The agent's settings.
        bridge: Its bridge.
        trust: This module's part in a secured mesh; ``None``: trust is off.

    Attributes:
        endpoint: The place now; ``None`` before the start, and while the agent moves.
    """

    def __init__(self, settings: Settings, bridge: Bridge, trust: AgentTrust | None = None) -> None:
        self.settings = settings
        self.bridge = bridge
        self.trust = trust
        self._moving: asyncio.Task[None] | None = None
        self._over = asyncio.Event()
        self.endpoint: NetworkEndpoint | None = None

    async def start(self) -> None:
        """Join the network.

        Raises:
            StartError: The mesh's port is taken.
        """
        await self._join(self.settings.port)
        if self.trust is None and self.endpoint is not None:
            text = "! trust is off: every program that reaches port %d may join this mesh; rmpa trust init"
            _log.warning(text, self.endpoint.port)

    async def close(self) -> None:
        """Leave the network."""
        self._over.set()
        if self._moving is not None:
            await asyncio.wait([self._moving])  # not cancelled: the place that it leaves would stay half closed
        await self._leave()

    async def _join(self, port: int) -> None:
        self.endpoint = NetworkEndpoint(self, port)
        try:
            await self.endpoint.start()
        except BaseException:
            await self._leave()
            raise

    async def _leave(self) -> None:
        if self.endpoint is not None:
            endpoint, self.endpoint = self.endpoint, None
            if self.trust is not None:
                self.trust.identity = None
            await endpoint.close()

    def move(self) -> None:
        """Take a new GUID, with an address that the machine has."""
        if self._moving is None:
            self._moving = asyncio.create_task(self._move(), name="move to the new address")

    async def _move(self) -> None:
        try:
            port = self.endpoint.port if self.endpoint is not None else self.settings.port
            _log.info("= the machine's addresses have changed: taking a new GUID")
            await self._leave()
            while self.endpoint is None and not self._over.is_set():
                try:
                    await self._join(port)
                except RmpaError as error:
                    _log.warning("! cannot join with the new address yet: %s", error)
                    with suppress(TimeoutError):
                        await asyncio.wait_for(self._over.wait(), mesh_limits.JOIN_RETRY)
        finally:
            self._moving = None


def is_displaced(ours: IPv4Address, everything: tuple[Interface, ...], wanted: tuple[str, ...]) -> bool:
    """Whether the agent needs a GUID with another address.

    An interface without its cable keeps its address, and links over other interfaces go on meanwhile. A lost address
    may return (a DHCP lease is renewed), so the GUID stays until the machine has another usable address.

    Args:
        ours: The address in the GUID.
        everything: All interfaces, up or not.
        wanted: The names of the interfaces that the settings give; empty for all.
    """
    if pick_address(choose(everything, wanted)).is_loopback:
        return False
    kept = {address for i in everything if not wanted or i.name in wanted for address in i.addresses}
    return ours.is_loopback or ours not in kept
