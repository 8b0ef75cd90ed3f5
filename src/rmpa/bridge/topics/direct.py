"""The subscriber's side of direct transport for topics: answers, moves and watches the subscribers of this module.

TCPROS has no way to redirect a connection. A subscriber is made to leave: roscpp by a list of publishers without the
proxy, rospy by ending its connection. Then it is called back by a list with the proxy, and gets the other answer.
"""

from __future__ import annotations

import asyncio
import math
from collections import Counter
from typing import TYPE_CHECKING, Final

from rmpa.bridge import limits
from rmpa.bridge.direct.grants import end_all
from rmpa.bridge.direct.paths import (
    AGENTS,
    LOST,
    Condition,
    Grant,
    Interruptions,
    Path,
    Paths,
    Unmet,
    Want,
    interrupted,
    unmet_by_rules,
)
from rmpa.bridge.policy import Needs
from rmpa.bridge.topics.reports import compares_names
from rmpa.core.contract import Contract, Transport
from rmpa.core.errors import RmpaError
from rmpa.core.identity import OWN_NODE, is_own
from rmpa.ros.environment import host_of, is_loopback
from rmpa.ros.http.rpc import call, call_api, is_own_name
from rmpa.ros.master.parameters import GraphChange, RegistrationKind
from rmpa.ros.node.ask import probe
from rmpa.ros.node.listeners import local_addresses
from rmpa.ros.wire.slave_api import TCPROS, BusConnection, read_bus_info
from rmpa.ros.wire.xmlrpc import RosFault, RosReply
from rmpa.runtime.kernel_tcp import connections
from rmpa.runtime.loop import yielding_to_data

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable, Sequence

    from rmpa.bridge.bridge import Bridge
    from rmpa.bridge.messages import Source
    from rmpa.bridge.sessions import PeerSession
    from rmpa.bridge.topics.import_route import RemoteTopic
    from rmpa.bridge.topics.imports import Imports

    TopicPath = Path[RemoteTopic]

# The caller id of ``publisherUpdate``, as rosmaster has it.
MASTER: Final = "/master"
_STANDING: Final = frozenset({"ESTABLISHED", "SYN_SENT", "CLOSE_WAIT"})
# Names of nodes of ``rmpa topic hz|bw|delay|echo`` begin so; they are relayed, so that the agents measure.
MEASURING: Final = "/rmpa_topic_"
_TWICE: Final = Unmet(
    Condition.LATCHED, "it latches, and a move would deliver its last message twice: subscribe again"
)


async def publisher_update(uri: str, topic: str, publishers: Sequence[str]) -> bool:
    """Tell one node the publishers of a topic, as its master does; return whether it took them.

    roscpp hangs up on publishers that are not in the list. Both libraries connect to new ones.

    Args:
        uri: The node's slave API.
        topic: The topic.
        publishers: The slave APIs of the publishers.
    """
    params = (MASTER, topic, list(publishers))
    try:
        reply = await call_api(uri, "publisherUpdate", *params, timeout=limits.DIRECT_NODE_TIMEOUT)
    except (RmpaError, RosFault):
        return False
    return reply.code == 1


async def bus_links(uri: str, topic: str) -> list[BusConnection] | None:
    """The connections of a subscriber for one topic; ``None`` if it does not answer."""
    try:
        value = await call(uri, "getBusInfo", OWN_NODE, timeout=limits.DIRECT_NODE_TIMEOUT)
    except (RmpaError, RosFault):
        return None
    return [one for one in read_bus_info(value) if one.inbound and one.topic == topic]


async def forgotten(uri: str, topic: str, publisher: str) -> None:
    """Wait until a subscriber has no connection to a publisher any more, by its own word.

    rospy ignores a publisher in a list while the connection that has just ended is not removed yet, which takes a
    moment, and longer on a busy machine. At most ``limits.DIRECT_MOVE_WAIT``.

    Args:
        uri: The subscriber's slave API.
        topic: The topic.
        publisher: The publisher's slave API.
    """
    deadline = asyncio.get_running_loop().time() + limits.DIRECT_MOVE_WAIT
    while links := await bus_links(uri, topic):
        if all(one.other != publisher for one in links) or asyncio.get_running_loop().time() >= deadline:
            return
        await asyncio.sleep(limits.DIRECT_LOOK)


def kernel_tells() -> bool:
    """Whether the kernel lists the connections of this machine; without that, two paths cannot be ruled out."""
    return connections(remote=("127.0.0.1", 1)) is not None


def standing(address: str) -> dict[int, set[int]]:
    """The connections from this machine to one address: their local ports, by the remote port.

    One question to the kernel, whatever the number of connections.
    """
    found: dict[int, set[int]] = {}
    for one in connections(remote=(address, None)) or ():
        if one.state in _STANDING:
            found.setdefault(one.remote[1], set()).add(one.local[1])
    return found


async def end_link(link: BusConnection) -> str:
    """End a connection of a subscriber to a publisher, if it still stands; wait until it is gone.

    Args:
        link: The connection, as the subscriber tells it; other programs may be connected to the publisher too.

    Returns:
        Empty if it is gone, else why it could not be ended.
    """
    loop, deadline, problem = asyncio.get_running_loop(), 0.0, ""
    while found := [one for one in connections(remote=link.remote) or () if one.local[1] == link.local_port]:
        if not any(one.state in _STANDING for one in found):
            break
        if not deadline:
            deadline, problem = loop.time() + limits.DIRECT_MOVE_WAIT, end_all(found)
        elif loop.time() >= deadline:
            return problem or "the kernel does not end it"
        else:
            await asyncio.sleep(limits.DIRECT_LOOK)
    return ""


class TopicPaths(Paths["RemoteTopic"]):
    """Direct connections of local subscribers to nodes of peers.

    Args:
        bridge: As of ``Paths``.
        on_warning: As of ``Paths``.
        imports: The remote sources.

    Attributes:
        interruptions: When subscribers were without their path.
        _left: The names of modules to which direct connections were left when their agents crashed.
        _started: Subscribers may have direct connections from before this moment, of an earlier run of this agent.
    """

    kind = "topic"

    def __init__(self, bridge: Bridge, on_warning: Callable[[str, str, str], None], imports: Imports) -> None:
        super().__init__(bridge, on_warning)
        own = Needs((), "the peer's own topics that come directly")
        bridge.rpc.on_notification("direct.topic_again", self._asked_again, own)
        self._imports = imports
        self.interruptions: Interruptions = {}
        self._checking: asyncio.TimerHandle | None = None
        self._kernel_tells = kernel_tells()
        self._left: set[str] = set()
        self._started = self._now()

    def reload(self) -> None:
        """Judge every subscriber by the new contracts."""
        for entry in yielding_to_data(list(self._imports)):
            self.shown(entry)

    def graph_changed(self, change: GraphChange) -> None:
        """Judge a local subscriber that came, or forget one that went."""
        if change.kind is not RegistrationKind.SUBSCRIBER or is_own(change.node):
            return
        for entry in self._imports.at(change.name):
            if change.added:
                self._consider(entry, change.node, change.api)
            path = self.get(entry.peer, Want(entry.wire.topic, entry.node, change.node))
            if not change.added and path is not None:
                self.forget(path)  # it ends its connections itself

    def shown(self, entry: RemoteTopic) -> None:
        """Judge the subscribers of a source that appears in the local graph, or to which other rules apply."""
        for node, uri in self._bridge.core.subscribers(entry.name).items():
            self._consider(entry, node, uri)

    def hidden(self, entry: RemoteTopic) -> None:
        """Forget the subscribers of a source that leaves the local graph, and end their direct connections."""
        for path in self.of(entry.peer, entry.wire.topic, entry.node):
            self.forget(path)
            self._hang_up(path)

    def _consider(self, entry: RemoteTopic, node: str, uri: str) -> None:
        session = self._bridge.sessions.get(entry.peer)
        if session is None or not entry.shown or is_own(node):
            return
        want = Want(entry.wire.topic, entry.node, node)
        contract = self._bridge.context.contracts.of(entry.name, entry.type)
        is_known = self.get(entry.peer, want) is not None
        if contract.transport is Transport.RELAY and not is_known:
            return  # nothing is kept of topics that are relayed by rule
        unmet = self._unmet_here(session, want, entry, contract, uri)
        path = self.judge(session, want, entry, contract, unmet)
        if not is_known and self._is_relayed(path):
            path.place = AGENTS  # until now it was relayed by rule

    def _unmet_here(
        self, session: PeerSession, want: Want, entry: RemoteTopic, contract: Contract, uri: str
    ) -> Unmet | None:
        node, owner, other = want.user, "the publisher's module", want.name if want.name != entry.name else ""
        unmet = unmet_by_rules(contract, self._bridge, session, "this module", owner, other, entry.origin)
        if unmet is not None:
            return unmet
        if compares_names(entry.type):
            return Unmet(Condition.ACTION, f"actions compare the names of the nodes at {entry.type}")
        if node.startswith(MEASURING):
            return Unmet(Condition.MEASURES, "rmpa's own tools measure by the agents")
        host = host_of(uri)
        if not is_loopback(self._bridge.core.node_host) and not (is_own_name(host) or host in local_addresses()):
            return Unmet(Condition.SUBSCRIBER, f"{node} runs at {host}, not on its agent's machine")
        if not self._kernel_tells:
            return Unmet(Condition.SUBSCRIBER, "the kernel does not list the connections of this machine (sock_diag)")
        if is_loopback(host) and not session.same_machine:
            text = f"{node} connects within its machine only (ROS_IP or ROS_HOSTNAME is {host})"
            return Unmet(Condition.SUBSCRIBER, text)
        return None

    def _unmet(self, path: TopicPath) -> Unmet | None:
        """As of ``Paths``. A latched source that is relayed to a subscriber stays so until it subscribes again."""
        unmet = super()._unmet(path)
        if unmet is not None or not self._is_relayed(path):
            return unmet
        description = path.entry.description
        return _TWICE if description is not None and description.latching else None

    def _is_relayed(self, path: TopicPath) -> bool:
        publication = path.entry.publication
        return publication is not None and path.want.user in publication.callers

    def _uri(self, path: TopicPath) -> str:
        """The slave API of a path's subscriber; empty if it is not registered."""
        return self._bridge.core.subscribers(path.want.name).get(path.want.user, "")

    def request(self, peer: int, source: Source, subscriber: str) -> Awaitable[RosReply | None] | None:
        """Answer a subscriber's ``requestTopic`` at the proxy of a source; see ``PublicationEvents``."""
        want = Want(source.topic, source.node, subscriber)
        path, session = self.get(peer, want), self._bridge.sessions.get(peer)
        recent = self._now() < self._started + limits.DIRECT_ADOPT
        entry = self._imports.get(peer, source)
        if path is None and session is not None and entry and (recent or session.link.name in self._left):
            path = Path(session, want, entry, Contract())
        return self._answer(path) if path is not None else None

    async def _answer(self, path: TopicPath) -> RosReply | None:
        await self.decision(path)
        direct = path.target if path.task is None else None
        stays = await self._end_direct(path, keep=direct)
        if stays is not None:
            self._put(path, stays)
            return RosReply(0, "connected to the publisher already", [])
        if direct is None or path.target != direct:
            direct = None  # it is moved if it is direct by now
        self._put(path, direct or AGENTS)
        return RosReply(1, f"ready on {direct[0]}:{direct[1]}", [TCPROS, *direct]) if direct is not None else None

    def _put(self, path: TopicPath, place: tuple[str, int], at: float | None = None) -> None:
        """Note where a subscriber is now; one that is lost is interrupted until it is somewhere again."""
        path.place, path.placed_at = place, self._now() if at is None else at
        interrupted(self.interruptions, path.session, path.want, lasts=place is LOST)
        self._place(path)
        self._watch()

    def listeners_changed(self, peer: int, source: Source) -> None:
        """Note which subscribers have left the proxy of a source, or have come back to it by themselves."""
        for path in self.of(peer, source.topic, source.node):
            if self._is_relayed(path):
                if path.place in {None, LOST}:
                    self._put(path, AGENTS)
            elif path.place == AGENTS:
                path.place = None
                if path.unmet is _TWICE:
                    self.update(path)

    def link_up(self, session: PeerSession) -> None:
        """As of ``Paths``."""
        for path in self._of_peer(session):
            path.entry.direct = False
        super().link_up(session)

    def link_down(self, session: PeerSession) -> None:
        """As of ``Paths``; sources with direct subscribers stay in the graph if only the peer's agent has died."""
        for path in self._of_peer(session):
            if path.endpoint is not None and session.link.crashed:
                path.entry.direct = True
            elif path.endpoint is not None:
                interrupted(self.interruptions, session, path.want, lasts=True)
        super().link_down(session)

    def gone(self, session: PeerSession) -> None:
        """As of ``Paths``; what is direct goes on if only the peer's agent has died."""
        direct = [path for path in self._of_peer(session) if path.endpoint is not None]
        if direct and session.link.crashed:
            self._left.add(session.link.name)
        super().gone(session)
        for path in direct if not session.link.crashed else ():
            self._hang_up(path)

    def _hang_up(self, path: TopicPath) -> None:
        """Make a subscriber leave its direct connection; it is not called back."""
        if path.endpoint is not None and not self._closed:
            self._bridge.counters.add("direct.hung_up")
            self._tasks.start(self._leave(path), f"hang up {path.want.user}")
            # The source may be shown again at once: the list of its end must not be the last one that arrives.
            asyncio.get_running_loop().call_later(limits.DIRECT_LIST_AGAIN, self._list_again, path)

    async def _leave(self, path: TopicPath) -> tuple[str, int] | None:
        """Make a subscriber leave all of its connections to a node; return a direct one that stays."""
        proxy, publication = path.session.proxies.get(path.want.node), path.entry.publication
        await self._list(path, without=proxy.uri if proxy is not None else "")
        if publication is not None:
            publication.hang_up(path.want.user)
        return await self._end_direct(path)

    async def _probe(self, path: TopicPath, grant: Grant) -> str:
        address, timeout = path.session.address, limits.DIRECT_PROBE_TIMEOUT
        problem = await probe(address, grant.port, grant.probe, node=grant.node, timeout=timeout)
        return f"no connection to {address}:{grant.port}: {problem}" if problem else ""

    def _subject(self, path: TopicPath) -> str:
        return f"{path.entry.wire} to {path.want.user}"

    def _decided(self, path: TopicPath) -> None:
        if path.endpoint == path.target is not None:
            interrupted(self.interruptions, path.session, path.want, lasts=False)
        self._place(path)
        self._watch()

    def _is_misplaced(self, path: TopicPath) -> bool:
        """Whether a subscriber has another connection than was decided, or waits for being called back."""
        if path.task is not None or path.place is None or self.get(path.session.peer, path.want) is not path:
            return False
        if path.place is LOST:
            return self._now() - path.placed_at > limits.DIRECT_SETTLE
        return path.endpoint != path.target

    def _place(self, path: TopicPath) -> None:
        if path.mover is None and not self._closed and self._is_misplaced(path):
            path.mover = self._tasks.start(self._move(path), f"move {path.want.user}")

    async def _move(self, path: TopicPath) -> None:
        """Make a subscriber leave its connection, and call it back to get the answer that was decided."""
        try:
            while self._is_misplaced(path) and await self._renew(path):
                self._bridge.counters.add("direct.moved")
        finally:
            path.mover = None

    async def _renew(self, path: TopicPath) -> bool:
        """List without the proxy, end the connection, list with it; return whether that was done."""
        uri, proxy = self._uri(path), path.session.proxies.get(path.want.node)
        if not uri or proxy is None or path.entry.publication is None:
            return False
        if (stays := await self._leave(path)) is not None:
            self._put(path, stays)
            return False
        await forgotten(uri, path.want.name, proxy.uri)
        self._put(path, LOST)
        await self._list(path)
        asyncio.get_running_loop().call_later(limits.DIRECT_LIST_AGAIN, self._list_again, path)
        return True

    async def _end_direct(self, path: TopicPath, *, keep: tuple[str, int] | None = None) -> tuple[str, int] | None:
        """End connections of a subscriber to a peer's nodes: of an earlier answer, or an earlier run of an agent.

        A second connection would double messages.

        Returns:
            The other end of one that stays: it is ``keep``, its node is stopped, or it cannot be ended.
        """
        uri, topic, proxy = self._uri(path), path.want.name, path.session.proxies.get(path.want.node)
        address = (path.endpoint or (path.session.address,))[0]  # the peer may have another one by now
        stand = standing(address) if uri else {}
        if not stand:
            return None
        links = await bus_links(uri, topic)
        if links is None:
            return path.endpoint  # ``_check`` tries again
        own = proxy.address_of(topic) if proxy is not None else None
        others = {one for one in self._bridge.core.publishers(topic).values() if proxy is None or one != proxy.uri}
        known = {one.place for one in self if one is not path and one.want.user == path.want.user}
        for link in links:
            end = link.remote
            if not link.connected or end is None or end[0] != address or end in known:
                continue
            if link.other in others and end != path.endpoint:
                continue
            if link.local_port not in stand.get(end[1], ()) or (own is not None and own[1] == end[1]):
                continue  # it has ended already, or leads to the proxy, on this machine
            if end == keep:
                return end
            if problem := await end_link(link):
                if end != path.target:  # it may be allowed again meanwhile
                    self._warn(path, end, problem)
                return end
        return None

    async def _list(self, path: TopicPath, *, without: str = "") -> None:
        """Tell a subscriber the publishers of its topic, as its master does."""
        uri, topic = self._uri(path), path.want.name
        if uri:
            await publisher_update(
                uri, topic, [one for one in self._bridge.core.publishers(topic).values() if one != without]
            )

    def _list_again(self, path: TopicPath) -> None:
        """Repeat the list of publishers: a roscore's graph is known here with a delay, and calls may be lost."""
        if not self._closed and path.mover is None:
            self._tasks.start(self._list(path), f"call back {path.want.user}")

    def _warn(self, path: TopicPath, endpoint: tuple[str, int], problem: str) -> None:
        source, user = path.entry.wire, path.want.user
        text = (
            f"{source}: {user} stays connected to {endpoint[0]}:{endpoint[1]}: a rospy subscriber leaves only when "
            f"its connection is ended, and this agent may not do that ({problem}); see rmpa doctor"
        )
        self._on_warning("direct.stuck", f"{path.session.peer} {source} {user}", text)

    def _watch(self) -> None:
        """Begin to watch direct connections."""
        if self._checking is None and not self._closed and any(path.place not in {None, AGENTS} for path in self):
            self._checking = asyncio.get_running_loop().call_later(limits.DIRECT_CHECK, self._check)

    def _check(self) -> None:
        """Compare the direct connections with the kernel's table; ask the nodes only where some are missing."""
        self._checking = None
        self._watch()
        settled: list[tuple[TopicPath, tuple[str, int]]] = []
        for path in self:
            if self._now() - path.placed_at <= limits.DIRECT_SETTLE:
                continue
            self._place(path)
            if path.endpoint is not None and path.mover is None:
                settled.append((path, path.endpoint))
        wanted = Counter(endpoint for _, endpoint in settled)
        there = {address: standing(address) for address in {endpoint[0] for endpoint in wanted}}
        for path, endpoint in settled:
            if len(there[endpoint[0]].get(endpoint[1], ())) < wanted[endpoint]:
                self._tasks.start(self._check_one(path, endpoint), f"check {path.want.user}")

    async def _check_one(self, path: TopicPath, endpoint: tuple[str, int]) -> None:
        uri = self._uri(path)
        links = await bus_links(uri, path.want.name) if uri else None
        stands = any(one.connected and one.remote == endpoint for one in links or ())
        if not uri or stands or path.endpoint != endpoint or self.get(path.session.peer, path.want) is not path:
            return
        if links is None:
            self._bridge.core.suspect(path.want.user)
        self._bridge.counters.add("direct.broken")
        self._put(path, LOST, -math.inf)
        self.broke(path)

    async def close(self) -> None:
        """As of ``Paths``."""
        if self._checking is not None:
            self._checking.cancel()
        await super().close()
