"""Every peer's session: begun by its first link, kept while parts wait for the next one, ended for good."""

from __future__ import annotations

import asyncio
import itertools
from typing import TYPE_CHECKING

from rmpa.bridge.session.peer_proxies import PeerProxies
from rmpa.bridge.session.peer_session import PeerSession, PeerState
from rmpa.bridge.session.proxy_namespaces import ProxyNamespaces
from rmpa.mesh import limits as mesh_limits
from rmpa.runtime.event_loop import yield_to_data
from rmpa.runtime.machine_timer import MachineTimer

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable, Iterator, Sequence

    from rmpa.bridge.data.io.receiver import DataReceiver
    from rmpa.bridge.messages import Origin
    from rmpa.bridge.session.part import Part
    from rmpa.bridge.session.proxy_nodes import ProxyNodes
    from rmpa.mesh.io.link import PeerLink
    from rmpa.ros.wire.xmlrpc import RosReply


class PeerSessions:
    """The sessions of all peers; tells the parts of the bridge when one begins, loses its link, has one again, ends.

    Args:
        parts: Those that are told, in this order; more may be added until the first link is up.
        nodes: Makes the proxies.
        receiver: Hands on the data that comes on links.
        on_kill: ``(session, node, caller id, reason) -> reply``: the proxy of a peer's node was asked to end.
    """

    def __init__(
        self,
        parts: Sequence[Part],
        nodes: ProxyNodes,
        receiver: DataReceiver,
        on_kill: Callable[[PeerSession, str, str, str], Awaitable[RosReply]],
    ) -> None:
        self._parts = parts
        self._nodes = nodes
        self._receiver = receiver
        self._on_kill = on_kill
        self._numbers = itertools.count(1)
        self._by_number: dict[int, PeerSession] = {}
        self._by_link: dict[PeerLink, PeerSession] = {}
        self._namespaces = ProxyNamespaces()
        self._closing: set[asyncio.Task[None]] = set()
        self._timer = MachineTimer(self._next_timer, self._handle_timer)

    def __iter__(self) -> Iterator[PeerSession]:
        """Every session, with a link or waiting for one."""
        return iter(list(self._by_number.values()))

    def linked(self) -> Iterator[PeerSession]:
        """The sessions that have a link."""
        return (session for session in self if session.linked)

    def get(self, peer: int) -> PeerSession | None:
        """A session by its number."""
        return self._by_number.get(peer)

    def of(self, link: PeerLink) -> PeerSession | None:
        """The session that a link belongs to; ``None`` once the link is gone."""
        return self._by_link.get(link)

    def proxy_name(self, session: PeerSession, node: str, origin: Origin | None) -> str:
        """The name of the proxy of a peer's node, or of the node of another module that the peer relays."""
        if origin is not None:
            session.proxies.names[node] = self._namespaces.relayed_name(origin)
        return session.proxies.name(node)

    # --- links ---------------------------------------------------------------------------------------------------

    def link_up(self, link: PeerLink) -> None:
        """A link is up: of a new peer, or of one whose session waits for it."""
        session = self._waiting_for(link)
        if session is not None:
            session.link, session.state, session.wait = link, PeerState.LINKED, None
            self._timer.arm()
        else:
            session = self._begin(link)
        session.time.resumed_at = lambda: link.resumed_at
        self._by_link[link] = session
        self._receiver.link_up(link, session.peer, session.handlers)
        for part in self._parts:
            part.link_up(session)

    def _begin(self, link: PeerLink) -> PeerSession:
        remembered = (part.remembered(link.identity) for part in self._parts)
        peer = next((number for number in remembered if number is not None), None)
        if peer is None:
            peer = next(self._numbers)
        prefix = self._namespaces.add(peer, link.identity)
        proxies = PeerProxies(
            prefix, self._nodes, lambda node, caller, reason: self._on_kill(session, node, caller, reason)
        )
        session = self._by_number[peer] = PeerSession(peer, link, proxies)
        return session

    def _waiting_for(self, link: PeerLink) -> PeerSession | None:
        """The session of this run of the peer, if it waits. One of an earlier run ends, for that will not be back."""
        for session in self:
            if session.linked:
                continue
            if session.link.identity.instance == link.identity.instance:
                return session
            if session.link.guid.place == link.guid.place or session.link.name == link.name:
                self._end(session)
        return None

    def link_down(self, link: PeerLink) -> None:
        """A link is gone; its peer may come back."""
        session = self._by_link.pop(link, None)
        if session is None:
            return
        self._receiver.link_down(link)
        session.away_since = asyncio.get_running_loop().time()
        session.state = PeerState.SILENT
        for part in self._parts:
            part.link_down(session)
        session.handlers.clear()
        if link.silent:
            session.wait = mesh_limits.AWAY_GRACE
            self._timer.arm()
        else:
            self._grace_over(session)

    def _grace_over(self, session: PeerSession) -> None:
        """The peer does not come back at once: what does not wait for it leaves the local graph."""
        session.state, session.wait = PeerState.AWAY, 0.0
        waits = [part.grace_over(session) for part in self._parts]
        if any(waits):
            self._outlasted(session, asyncio.get_running_loop().time())
        else:
            self._end(session)

    def _outlasted(self, session: PeerSession, now: float) -> None:
        """The peer has been away for a while: what does not wait for longer leaves, and all when nothing does."""
        seconds = max(now - session.away_since, session.wait or 0.0)
        waits = [part.outlasted(session, seconds) for part in self._parts]
        session.wait = min((wait for wait in waits if wait is not None), default=None)
        if session.wait is None:
            self._end(session)
        else:
            self._timer.arm()

    def _next_timer(self) -> float | None:
        return min((due for session in self._by_number.values() if (due := session.due) is not None), default=None)

    def _handle_timer(self, now: float) -> None:
        for session in self:
            due = session.due
            if due is not None and due <= now:
                if session.state is PeerState.SILENT:
                    self._grace_over(session)
                else:
                    self._outlasted(session, now)

    # --- the end -------------------------------------------------------------------------------------------------

    def _end(self, session: PeerSession) -> None:
        """The peer will not come back: all that is left of it leaves the local graph."""
        session.wait = None
        self._timer.arm()
        self._by_number.pop(session.peer, None)
        if self._by_link.pop(session.link, None) is not None:
            self._receiver.link_down(session.link)
            for part in self._parts:
                part.link_down(session)
        for part in self._parts:
            part.gone(session)
        self._namespaces.remove(session.peer)
        task = asyncio.create_task(session.proxies.close(), name=f"retract {session.proxies.prefix}")
        self._closing.add(task)
        task.add_done_callback(self._closing.discard)

    async def close(self) -> None:
        """End every session, and wait until nothing of them is left in the local graph."""
        self._timer.close()
        for session in self:
            self._end(session)
        if self._closing:
            await asyncio.gather(*self._closing)

    # --- the rest ------------------------------------------------------------------------------------------------

    def lane_lost(self, link: PeerLink) -> None:
        """A link has lost its bulk lane's connection, and perhaps half a message in either direction."""
        session = self._by_link.get(link)
        if session is not None:
            for part in self._parts:
                part.lane_lost(session)

    def clock(self, link: PeerLink) -> None:
        """A link knows its peer's clock better."""
        session = self._by_link.get(link)
        if session is not None:
            session.time.set(link.clock_offset, link.clock_error)

    def reconcile(self) -> None:
        """Try again to make the proxies that could not be made."""
        for session in self:
            yield_to_data()
            session.proxies.reconcile()
        self._namespaces.forget_unused({name for session in self for name in session.proxies.names.values()})
