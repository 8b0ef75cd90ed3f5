"""One simulated agent with a roster and the real mesh: its own code down to the sockets, which are simulated."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING, cast

from rmpa.config.settings import LaneSettings
from rmpa.core.statistics import Counters
from rmpa.mesh.io.lane import Dialler
from rmpa.mesh.io.link import LinkHandlers, PeerLink
from rmpa.mesh.io.mesh import Mesh
from tests.simulation.process import Process
from tests.simulation.roster_peer import RosterPeer
from tests.simulation.sockets import SimListener, SimSocket, connect

if TYPE_CHECKING:
    import random
    import socket
    from collections.abc import Callable

    from rmpa.discovery.membership import PeerEvent
    from rmpa.mesh.frames import Lane
    from tests.simulation.network import Address


class SimDialler(Dialler):
    """Connects through the simulated network."""

    def __init__(self, peer: MeshPeer) -> None:
        super().__init__(LaneSettings(), Counters())
        self._peer = peer

    async def connect(self, endpoint: Address, lane: Lane, within: float = 2.0) -> socket.socket:
        """Connect to the simulated listener at an address."""
        made = await asyncio.wait_for(self._peer.connect(endpoint), within)
        made.lane = lane
        return cast("socket.socket", made)


class MeshPeer(RosterPeer):
    """A roster, and links with two lanes to all in it."""

    def prepare(self, rng: random.Random) -> None:
        """Start a process with a mesh for the new run."""
        self.process = Process(self.world, f"{self.name}#{self.run}")  # type: ignore[abstract]
        self.processes = [*getattr(self, "processes", []), self.process]
        self.process.run(self._build, rng)

    def _build(self, rng: random.Random) -> None:
        run = self.run

        def ours(action: Callable[..., None]) -> Callable[..., None]:
            """Ignore callbacks of a run that is over."""
            return lambda *values: action(*values) if self.alive and self.run == run else None

        self.mesh = Mesh(
            self.identity,
            cast("socket.socket", SimListener(self.network, self.address, self.process)),
            LinkHandlers(
                ours(self.link_up),
                ours(self.link_down),
                *[lambda *_: None] * 4,  # nothing but links is looked at
            ),
            rng=rng.random,
            dialler=SimDialler(self),
        )
        self.process.create_task(self.mesh.start())

    async def connect(self, endpoint: Address) -> SimSocket:
        """Connect; raises where no process listens, and never returns where no answer comes."""
        self.note(f"> dials {endpoint[0]}")
        process = self.process
        done: asyncio.Future[SimSocket] = process.create_future()

        def connected(sock: SimSocket | None) -> None:
            if sock is None and not done.done():
                done.set_exception(ConnectionRefusedError())
            elif sock is not None and done.done():
                sock.close()
            elif sock is not None:
                done.set_result(sock)

        def arrived(sock: SimSocket | None) -> None:
            if process.dead and sock is not None:
                sock.kill()
            process.run(connected, sock)

        connect(self.network, process, self.host, endpoint, arrived)
        return await done

    def kill(self) -> None:
        """Die without a bye; the kernel resets the connections."""
        super().kill()
        self.network.tcp.pop(self.address, None)
        self.process.kill()
        self.network.kill(self.host)

    def end(self) -> None:
        """Say bye on each link, then send the goodbye beacon; the last bytes have a second to leave."""
        super().end()
        self.process.run(lambda: self.process.create_task(self._leave(self.mesh, self.process)))

    async def _leave(self, mesh: Mesh, process: Process) -> None:
        await mesh.close()
        process.kill()

    def note(self, text: str) -> None:
        """Write a line of the trace."""
        self.world.note(self.name, text)

    # --- events of the mesh ---------------------------------------------------------------------------------

    def link_up(self, link: PeerLink) -> None:
        """A peer is linked."""
        self.note(f"= link up {link.identity}")
        link.bulk._on_wanted()
        self.roster.link_up(link.identity, self.world.now)
        self.flush()

    def link_down(self, link: PeerLink, reason: str) -> None:
        """Its link is not used any more."""
        self.note(f"= link down {link.identity}: {reason}")
        self.roster.link_down(link.guid, self.world.now, link.identity.instance)
        self.flush()

    # --- events of discovery --------------------------------------------------------------------------------

    def on_event(self, event: PeerEvent) -> None:
        """Pass an event of discovery to the mesh."""
        super().on_event(event)
        if event.change == "found":
            source = event.source[0] if event.source else None
            self.process.run(self.mesh.peer_found, event.identity, source)
        elif event.change == "changed":
            self.process.run(self.mesh.peer_found, event.identity)
        elif event.change == "lost":
            self.process.run(self.mesh.peer_gone, event.identity.guid)
