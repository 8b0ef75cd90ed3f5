"""The sessions of all peers: each begins with a link, and is kept while a part waits for the next one."""

from __future__ import annotations

import asyncio
import itertools
import logging
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Final

from rmpa.bridge.data.quality import PeerClockHistory
from rmpa.bridge.data.reception import LinkTime
from rmpa.bridge.offers import PeerRun, PeerState
from rmpa.bridge.policy import OPEN_GATE, PermissionGate
from rmpa.bridge.proxies import PeerProxies, ProxyNamespaces, ProxyNodes
from rmpa.core.log import logged_failure
from rmpa.mesh import limits as mesh_limits
from rmpa.runtime.loop import yield_to_data
from rmpa.runtime.tasks import OwnedTasks

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Sequence
    from contextlib import AbstractContextManager

    from rmpa.bridge.messages import Message, Origin
    from rmpa.mesh.io.link import PeerLink
    from rmpa.ros.master.parameters import GraphChange

_log = logging.getLogger(__name__)

# A peer whose agent died keeps its proxies in the local graph for this long: it may be started again at once.
AWAY_GRACE: Final = 0.5


@dataclass(slots=True, eq=False, kw_only=True)
class PeerSession(PeerRun):
    """What the bridge keeps for one run of a peer, across its links.

    Args:
        link: Its link, or the last one while it has none.
        proxies: The nodes that stand for its nodes in the local graph; those of the module, whichever peers bring it.
        time: The time base of its link: the offset between its clock and the local one.
        clocks: The estimates of that offset over the last minute.
        timer: Looks again at what is kept for the peer while it has no link.
    """

    link: PeerLink
    proxies: PeerProxies
    time: LinkTime = field(default_factory=LinkTime)
    clocks: PeerClockHistory = field(default_factory=PeerClockHistory)
    timer: asyncio.TimerHandle | None = None

    def instance_of(self, origin: Origin | None) -> str:
        """The run of a module that the link brings, 32 hexadecimal digits: the peer's own without an ``origin``."""
        return self.instance if origin is None else origin.instance

    @property
    def same_machine(self) -> bool:
        """Whether the peer's agent runs on this machine, so that both modules share its loopback device."""
        return self.link.local_address == self.link.remote_endpoint[0]

    @property
    def address(self) -> str:
        """The address at which the peer's nodes are reached: that of its link, or loopback on this machine."""
        return "127.0.0.1" if self.same_machine else self.link.remote_endpoint[0]

    @property
    def own_address(self) -> str:
        """The address at which the peer reaches the nodes of this module; see ``address``."""
        return "127.0.0.1" if self.same_machine else self.link.local_address


class Part:
    """A part of the bridge: topics, services, parameters and others. It overrides the events that it needs.

    All methods are called from the event loop.

    Attributes:
        advertisement: The ``op`` of the control messages that ``advertised`` gets unparsed; empty: none.
    """

    advertisement = ""

    def start(self) -> None:
        """The bridge has started: the local core answers."""

    async def close(self) -> None:
        """Release everything; all sessions have ended, and the local core still answers."""

    def link_up(self, session: PeerSession) -> None:
        """A link is up, of a new peer or of one whose session waited (after ``link_down``)."""

    def link_down(self, session: PeerSession) -> None:
        """A link is gone; the peer may come back."""

    def grace_over(self, session: PeerSession) -> bool:  # noqa: ARG002 - for those that override it
        """The peer is not back within ``mesh.limits.SILENT_GRACE``, or its link ended otherwise than by silence.

        Returns:
            Whether the part keeps something for the peer: then the session waits.
        """
        return False

    def outlasted(self, session: PeerSession, seconds: float) -> float | None:  # noqa: ARG002 - likewise
        """Drop everything that is kept for an absent peer for at most ``seconds``, the time that it has been away.

        Returns:
            The next shortest time in seconds, more than ``seconds``; ``None``: nothing is kept any more.
        """
        return None

    def gone(self, session: PeerSession) -> None:
        """The session ends for good: remove everything of the peer from the local graph."""

    def lane_lost(self, session: PeerSession) -> None:
        """A link lost its bulk lane, perhaps in the middle of a message in either direction."""

    def depends(self, session: PeerSession) -> bool:  # noqa: ARG002 - for those that override it
        """Whether something here needs to know within a second that this linked peer is gone.

        Open routes are known by the link's handlers; this is for what has no handler.
        """
        return False

    def message(self, session: PeerSession, message: Message) -> bool:  # noqa: ARG002 - for those that override it
        """Handle a control message from a peer.

        Returns:
            Whether the message belongs to this part.

        Raises:
            RemoteProtocolError: The message is not allowed now; the link is closed.
        """
        return False

    def advertised(self, session: PeerSession, payload: bytes) -> None:
        """Handle a control message of the kind ``advertisement``, not parsed yet.

        Raises:
            LimitExceeded: It is longer than ``limits.ADVERTISEMENT_MAX``; the link is closed.
        """

    def graph_changed(self, change: GraphChange) -> None:
        """Handle a registration in the local graph that was added, changed or removed."""

    def param_update(self, key: str) -> bool:  # noqa: ARG002 - for those that override it
        """Handle the change of a parameter that the agent's own node has subscribed to.

        Args:
            key: The changed key, without a slash at its end. The subscribed key may be this one, one below it or one
                above it.

        Returns:
            Whether this part has subscribed to the parameter.
        """
        return False

    def reload(self) -> None:
        """Judge again: the settings were read again, and ``Bridge.context`` is another one."""

    def reconcile(self) -> None:
        """Compare the actual state with the planned one, and mend it; called each ``limits.RECONCILE_INTERVAL``."""


def guarded(part: Part) -> AbstractContextManager[None]:
    """Log a failure of one part; the next parts are called all the same."""
    return logged_failure(_log, "%s failed; the other parts go on", type(part).__name__)


def call_each(parts: Iterable[Part], call: Callable[[Part], object]) -> None:
    """Call all parts, one after the other; see ``guarded``."""
    for part in parts:
        with guarded(part):
            call(part)


class PeerSessions:
    """The sessions of all peers; notifies the parts of the bridge when one begins, ends, or loses or gets a link.

    Args:
        parts: The parts, notified in this order; more may be added until the first link is up.
        nodes: Makes the proxies.
        gate: Whether the mesh is secured.
    """

    def __init__(
        self,
        parts: Sequence[Part],
        nodes: ProxyNodes,
        gate: PermissionGate = OPEN_GATE,
    ) -> None:
        self._gate = gate
        self._parts = parts
        self._nodes = nodes
        self._numbers = itertools.count(1)
        self._by_number: dict[int, PeerSession] = {}
        self._by_link: dict[PeerLink, PeerSession] = {}
        self._namespaces = ProxyNamespaces()
        # By run and name of the module: it may be a peer, or reached by relays, or both.
        self._modules: dict[tuple[str, str], PeerProxies] = {}

    def __iter__(self) -> Iterator[PeerSession]:
        """Every session, with a link or waiting for one."""
        return iter(list(self._by_number.values()))

    @property
    def proxy_count(self) -> int:
        """The number of proxies, of all modules."""
        return sum(map(len, self._modules.values()))

    def linked(self) -> Iterator[PeerSession]:
        """The sessions that have a link."""
        return (session for session in self if session.linked)

    def get(self, peer: int) -> PeerSession | None:
        """A session by its number."""
        return self._by_number.get(peer)

    def of(self, link: PeerLink) -> PeerSession | None:
        """The session that a link belongs to; ``None`` once the link is gone."""
        return self._by_link.get(link)

    def proxies(self, session: PeerSession, node: str, origin: Origin | None) -> tuple[PeerProxies, str]:
        """The proxies of the module that a peer's node belongs to, and the node's name in that module.

        Args:
            session: The peer.
            node: The node, in the peer's graph.
            origin: Its module and node, if the peer relays it.
        """
        if origin is None:
            return session.proxies, node
        prefix = self._namespaces.relayed_name(origin)[: -len(origin.node)]
        return self._proxies_of(origin.instance, origin.name, prefix), origin.node

    def proxy_name(self, session: PeerSession, node: str, origin: Origin | None) -> str:
        """The name of the proxy of a peer's node, or, with ``origin``, of a node that the peer relays."""
        return session.proxies.name(node) if origin is None else self._namespaces.relayed_name(origin)

    def reserved_name(self, origin: Origin) -> str:
        """The name of the proxy of a node that this module reaches outside the mesh; its namespace stays reserved."""
        return self._namespaces.relayed_name(origin, reserve=True)

    def _proxies_of(self, instance: str, name: str, prefix: str) -> PeerProxies:
        if (instance, name) not in self._modules:
            self._modules[instance, name] = PeerProxies(prefix, self._nodes)
        return self._modules[instance, name]

    def link_up(self, link: PeerLink) -> None:
        """Attach a link to the session that waits for it, or begin a session.

        A peer that has another address is linked anew before the end of its old link is noticed.
        """
        old = next((one.link for one in self.linked() if one.link.identity.is_same_run(link.identity)), None)
        if old is not None:
            self.link_down(old, silent=True)
            old.close(f"{link.name} has another address")
        session = self._waiting_for(link)
        if session is not None:
            session.link, session.rank = link, link.identity.guid.value
            session.state, session.silent = PeerState.LINKED, False
            if session.timer is not None:
                session.timer.cancel()
        else:
            session = self._begin(link)
        session.time.resumed_at = lambda: link.resumed_at
        self._by_link[link] = session
        call_each(self._parts, lambda part: part.link_up(session))

    def _begin(self, link: PeerLink) -> PeerSession:
        peer, identity = next(self._numbers), link.identity
        name, instance, rank = identity.name, identity.instance.hex(), identity.guid.value
        proxies = self._proxies_of(instance, name, self._namespaces.add(peer, identity))
        session = PeerSession(peer=peer, name=name, instance=instance, rank=rank, link=link, proxies=proxies)
        self._by_number[peer] = session
        return session

    def _waiting_for(self, link: PeerLink) -> PeerSession | None:
        """The waiting session of this run of the peer, if there is one; else ends that of an earlier run."""
        waiting = [session for session in self if not session.linked]
        for session in waiting:
            if session.link.identity.is_same_run(link.identity):
                return session
        for session in waiting:
            if session.link.identity.is_same_module(link.identity, secured=self._gate.on):
                self._end(session)
        return None

    def link_down(self, link: PeerLink, *, silent: bool = False) -> None:
        """Detach a link that is gone; after silence its session waits for ``mesh.limits.SILENT_GRACE``.

        Args:
            link: The link.
            silent: Whether its peer is there, although the link is not closed yet.
        """
        session = self._by_link.pop(link, None)
        if session is None:
            return
        session.away_since = asyncio.get_running_loop().time()
        session.state, session.silent = PeerState.SILENT, silent or link.silent
        call_each(self._parts, lambda part: part.link_down(session))
        session.link.routes.clear()
        if session.silent:
            self._wait(session, AWAY_GRACE if link.crashed else mesh_limits.SILENT_GRACE)
        else:
            self._grace_over(session)

    def _wait(self, session: PeerSession, seconds: float) -> None:
        """Look at the session of an absent peer again so many seconds after the end of its link."""
        loop = asyncio.get_running_loop()
        session.timer = loop.call_at(session.away_since + seconds, self._waited, session, seconds)

    def _waited(self, session: PeerSession, seconds: float) -> None:
        if session.state is PeerState.SILENT:
            self._grace_over(session)
        else:
            self._outlasted(session, seconds)

    def _grace_over(self, session: PeerSession) -> None:
        """Asks the parts what they keep for a peer that is not back; ends the session if they keep nothing."""
        session.state = PeerState.AWAY
        waits: list[bool] = []
        call_each(self._parts, lambda part: waits.append(part.grace_over(session)))
        if any(waits):
            self._outlasted(session, asyncio.get_running_loop().time() - session.away_since)
        else:
            self._end(session)

    def _outlasted(self, session: PeerSession, seconds: float) -> None:
        """Lets the parts drop what has expired for a peer that is away; ends the session if nothing is left."""
        waits: list[float | None] = []
        call_each(self._parts, lambda part: waits.append(part.outlasted(session, seconds)))
        if (wait := min((wait for wait in waits if wait is not None), default=None)) is None:
            self._end(session)
        else:
            self._wait(session, wait)

    def _end(self, session: PeerSession) -> None:
        """Ends a session for good: the rest of the peer is removed from the local graph."""
        session.state = PeerState.AWAY
        if session.timer is not None:
            session.timer.cancel()
        self._by_number.pop(session.peer, None)
        if self._by_link.pop(session.link, None) is not None:
            call_each(self._parts, lambda part: part.link_down(session))
            session.link.routes.clear()
        call_each(self._parts, lambda part: part.gone(session))
        self._namespaces.remove(session.peer)

    async def close(self) -> None:
        """End every session, and wait until all proxies are closed."""
        for session in self:
            self._end(session)
        closing = OwnedTasks()
        for proxies in self._modules.values():
            closing.start(proxies.close(), f"retract {proxies.prefix}")
        if closing:
            await asyncio.wait(closing)

    def lane_lost(self, link: PeerLink) -> None:
        """Notify the parts that a link lost its bulk lane, perhaps in the middle of a message."""
        session = self._by_link.get(link)
        if session is not None:
            call_each(self._parts, lambda part: part.lane_lost(session))

    def clock(self, link: PeerLink) -> None:
        """Take a link's new estimate of its peer's clock."""
        session = self._by_link.get(link)
        if session is not None:
            session.time.set(link.clock_offset, link.clock_error)

    def reconcile(self) -> None:
        """Try failed proxies again, let unused links rest, and forget unused namespaces of relayed modules."""
        now = asyncio.get_running_loop().time()
        for session in self.linked():
            yield_to_data()
            if session.linked and now - session.link.touched_at >= mesh_limits.REST_AFTER:
                needed = any(session.link.routes) or any(part.depends(session) for part in self._parts)
                session.link.need(needed=needed)
        linked = {id(session.proxies) for session in self}
        for module, proxies in list(self._modules.items()):
            yield_to_data()
            proxies.reconcile()
            if not proxies.used and id(proxies) not in linked:
                del self._modules[module]
        self._namespaces.forget_unused({proxies.prefix for proxies in self._modules.values()})
