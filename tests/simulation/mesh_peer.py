"""One simulated agent with a roster and a mesh: the same machines as the real one, other sockets."""

from __future__ import annotations

from typing import TYPE_CHECKING

from rmpa.core import limits
from rmpa.core.errors import RemoteProtocolError
from rmpa.discovery.events import Event as RosterEvent
from rmpa.discovery.events import PeerChanged, PeerFound, PeerLost, PeerRestarted
from rmpa.mesh.link import Closed, HelloReceived, Link, Refused, Role, State, Up
from rmpa.mesh.link import Event as LinkEvent
from rmpa.mesh.peering import CloseLink, Dial, LinkDown, LinkRefused, LinkUp, Peering
from tests.simulation.roster_peer import RosterPeer

if TYPE_CHECKING:
    import random

    from rmpa.core.guid import Guid
    from rmpa.mesh.handshake import Refuse
    from tests.simulation.network import Address, End, World


class SimLink:
    """Drives one link machine over one end of a simulated stream."""

    def __init__(
        self, peer: MeshPeer, number: int, end: End, role: Role, expected: Guid | None, endpoint: Address | None
    ) -> None:
        self.peer = peer
        self.number = number
        self.end = end
        self.expected = expected
        self.endpoint = endpoint
        self.was_up = False
        self.answered = False
        self._world: World = peer.world
        self._buffer = b""
        self._armed: float | None = None
        self._draining = False
        self.machine = Link(
            role,
            peer.identity,
            self._world.now,
            wall_ns=lambda: round(self._world.now * 1e9),
            on_event=self._event,
            on_data=lambda *_: None,
            expected=expected,
            lease=peer.link_lease,
        )
        end.on_bytes = self._bytes
        end.on_close = lambda reset: self._lost("reset" if reset else "closed")
        end.begin()
        self.after()

    @property
    def up(self) -> bool:
        """Whether it is used."""
        return self.machine.state is State.UP

    def after(self) -> None:
        """Send what the machine has to say; set its timer."""
        if self.machine.has_output:
            self.end.send(self.machine.take_output())
        if self.machine.state is State.CLOSING and not self._draining:
            self._draining = True
            self._world.after(0.0005, self._drained)
        due = self.machine.next_timer()
        if due is not None and (self._armed is None or due < self._armed):
            self._armed = due
            self._world.at(due, lambda: self._due(due))

    def _drained(self) -> None:
        if self.peer.owns(self):
            self.machine.drained()
            self.peer.settle()

    def _due(self, when: float) -> None:
        if self._armed == when:
            self._armed = None
        if self.peer.owns(self):
            self.machine.handle_timer(self._world.now)
            self.after()
            self.peer.settle()

    def _bytes(self, data: bytes) -> None:
        if not self.peer.owns(self):
            return
        self._buffer += data
        try:
            taken, _ = self.machine.receive(memoryview(self._buffer), self._world.now)
        except RemoteProtocolError as error:
            self.peer.note(f"! link {self.number}: {error}")
        else:
            self._buffer = self._buffer[taken:]
        self.after()
        self.peer.settle()

    def _lost(self, reason: str) -> None:
        if self.peer.owns(self):
            self.machine.lost(reason)
            self.peer.settle()

    def _event(self, event: LinkEvent) -> None:
        peer, now = self.peer, self._world.now
        if isinstance(event, HelloReceived):
            verdict = peer.peering.judge(event.hello)
            if verdict is None:
                self.machine.accept(now)
            else:
                self.machine.refuse(verdict, now)
        elif isinstance(event, Up):
            self.was_up = self.answered = True
            dialled = self.machine.role is Role.DIALLER
            peer.peering.link_up(self.number, event.hello.identity, now, dialled=dialled, endpoint=self.endpoint)
        elif isinstance(event, Refused):
            self._refused(event.refuse)
        elif isinstance(event, Closed):
            self._world.after(0.0, lambda: peer.ended(self, event.reason))

    def _refused(self, refuse: Refuse) -> None:
        self.peer.note(f"! link {self.number}: {refuse.label}")
        if self.expected is not None and not self.answered:
            self.answered = True
            self.peer.peering.dial_refused(self.expected, refuse, self._world.now)


class MeshPeer(RosterPeer):
    """A roster, and links to all in it."""

    link_lease = limits.LINK_LEASE

    def prepare(self, rng: random.Random) -> None:
        """A mesh for the new run."""
        self.links: dict[int, SimLink] = {}
        self._numbers = 0
        self._mesh_armed: float | None = None
        self._settling = False
        self.peering = Peering(self.identity, rng=rng.random, alive=self._alive)
        self.network.listeners[self.address] = self._accept

    def kill(self) -> None:
        """Gone without a word; the kernel resets its streams."""
        self._stop_listening()
        super().kill()
        self.network.kill(self.host)
        self.links = {}

    def end(self) -> None:
        """Says bye on each link, then goodbye."""
        self._stop_listening()
        for link in list(self.links.values()):
            link.machine.close("the agent ends", self.world.now)
            link.after()
            link.end.close()
        super().end()
        self.links = {}

    def note(self, text: str) -> None:
        """Into the trace."""
        self.world.note(self.name, text)

    def owns(self, link: SimLink) -> bool:
        """Whether this link is of the present run and not over."""
        return self.links.get(link.number) is link

    def up_links(self) -> list[SimLink]:
        """Links that are up, in the order of their peers' GUIDs."""
        links = [link for link in self.links.values() if link.up and link.machine.remote is not None]
        return sorted(links, key=lambda link: link.machine.remote.guid if link.machine.remote else self.identity.guid)

    def on_event(self, event: RosterEvent) -> None:
        """What discovery tells the mesh."""
        super().on_event(event)
        now = self.world.now
        if isinstance(event, PeerFound | PeerRestarted):
            self.peering.peer_found(event.identity, now, event.source[0] if event.source else None)
        elif isinstance(event, PeerChanged):
            self.peering.peer_found(event.identity, now)
        elif isinstance(event, PeerLost):
            self.peering.peer_gone(event.guid, now)

    def flush(self) -> None:
        """The roster's wishes, then the mesh's."""
        super().flush()
        self.settle()

    def settle(self) -> None:
        """Carry out what the mesh decided, until nothing is left; set its timer."""
        if self._settling or not self.alive:
            return
        self._settling = True
        try:
            while outputs := self.peering.take():
                for output in outputs:
                    self._act(output)
                super().flush()
        finally:
            self._settling = False
        due = self.peering.next_timer()
        if due is not None and (self._mesh_armed is None or due < self._mesh_armed):
            self._mesh_armed = due
            run = self.run
            self.world.at(due, lambda: self._mesh_due(due, run))

    def ended(self, link: SimLink, reason: str) -> None:
        """A link's machine is over."""
        if not self.owns(link):
            return
        del self.links[link.number]
        link.end.close()
        if link.was_up:
            self.peering.link_down(link.number, reason, self.world.now)
        elif link.expected is not None and not link.answered:
            self.peering.dial_failed(link.expected, reason, self.world.now)
        self.settle()

    def _act(self, output: Dial | CloseLink | LinkUp | LinkDown | LinkRefused) -> None:
        now = self.world.now
        if isinstance(output, Dial):
            self.note(f"> dials {output.guid}")
            self._dial(output.guid, output.endpoint)
        elif isinstance(output, CloseLink):
            link = self.links.get(output.link_id)
            if link is not None:
                link.machine.close(output.reason, now)
                link.after()
        elif isinstance(output, LinkUp):
            self.note(f"= link {output.link_id} up {output.identity}")
            self.roster.link_up(output.identity, now)
        elif isinstance(output, LinkDown):
            self.note(f"= link {output.link_id} down {output.identity}: {output.reason}")
            self.roster.link_down(output.identity.guid, now, output.identity.instance)
        else:
            self.note(f"! refused by {output.identity}: {output.refuse.label}")

    def _dial(self, guid: Guid, endpoint: Address) -> None:
        run, done = self.run, False

        def connected(end: End | None) -> None:
            nonlocal done
            if done or not self.alive or run != self.run:
                if end is not None:
                    end.close(reset=True)
                return
            done = True
            if end is None:
                self.peering.dial_failed(guid, "refused", self.world.now)
            else:
                self._link(end, Role.DIALLER, guid, endpoint)
            self.settle()

        def too_late() -> None:
            nonlocal done
            if not done and self.alive and run == self.run:
                done = True
                self.peering.dial_failed(guid, "timed out", self.world.now)
                self.settle()

        self.network.dial(self.host, endpoint, connected)
        self.world.after(limits.DIAL_TIMEOUT, too_late)

    def _accept(self, end: End) -> None:
        self._link(end, Role.ACCEPTOR, None, None)
        self.settle()

    def _link(self, end: End, role: Role, expected: Guid | None, endpoint: Address | None) -> None:
        self._numbers += 1
        link = SimLink(self, self._numbers, end, role, expected, endpoint)
        self.links[self._numbers] = link
        link.after()

    def _alive(self, number: int) -> bool:
        link = self.links.get(number)
        return link is not None and self.world.now - link.machine.heard_at <= limits.GHOST_QUIET

    def _mesh_due(self, when: float, run: int) -> None:
        if not self.alive or run != self.run:
            return
        if self._mesh_armed == when:
            self._mesh_armed = None
        self.peering.handle_timer(self.world.now)
        self.settle()

    def _stop_listening(self) -> None:
        self.network.listeners.pop(self.address, None)
