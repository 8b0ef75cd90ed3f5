"""The owner's side of direct transport: grants the nodes of peers a connection to a local publisher or server.

A change here is one notification, "ask again": the answer then says whether a grant ended, and why.

A rospy publisher keeps one connection for each caller id: a second subscriber of that name closes the first one's
connection without a word (docs/design/ros-traps.md, trap 12). Therefore a name is granted once for each source, and
not at all while a local node of that name subscribes to the topic.
"""

from __future__ import annotations

import asyncio
import logging
from abc import ABC, abstractmethod
from typing import TYPE_CHECKING, Any, Final

from rmpa.bridge import limits
from rmpa.bridge.direct.paths import (
    Condition,
    DirectAsk,
    Grant,
    Interruptions,
    Unmet,
    Want,
    interrupted,
    read_ask,
    reply_of,
    unmet_by_rules,
)
from rmpa.bridge.messages import Source
from rmpa.bridge.policy import Needs
from rmpa.bridge.topics.reports import compares_names
from rmpa.config.peer_rules import Access
from rmpa.core.contract import Contract, Transport, combine
from rmpa.core.errors import RemoteProtocolError, RmpaError
from rmpa.core.identity import OWN_NODE, is_own
from rmpa.ros.environment import is_loopback
from rmpa.ros.http.rpc import call_api
from rmpa.ros.master.parameters import GraphChange, RegistrationKind
from rmpa.ros.wire.slave_api import TCPROS
from rmpa.ros.wire.tcpros import parse_service_uri
from rmpa.ros.wire.xmlrpc import RosFault
from rmpa.runtime.kernel_tcp import TcpSocket, connections, end_connections, listening_addresses
from rmpa.runtime.tasks import end_tasks, start_task

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from rmpa.bridge.bridge import Bridge
    from rmpa.bridge.services.books import ServiceExports
    from rmpa.bridge.sessions import PeerSession
    from rmpa.bridge.topics.exports import Exports

_log = logging.getLogger(__name__)
_EVERY_ADDRESS: Final = frozenset({"0.0.0.0", "::"})  # noqa: S104 - recognised, not bound
_REMEDY: Final = "start it without ROS_IP and ROS_HOSTNAME, or with an address of the network"
_Entry = tuple["PeerSession", DirectAsk, Grant | Unmet | None]
_RELEASED: Final = Needs((), "what was granted to the peer itself")


class Grants(ABC):
    """What peers asked for, and what they were answered. Subclasses know the conditions, and where nodes listen.

    Args:
        bridge: The core, the peers and the rules.

    Attributes:
        kind: The middle of the names of the messages.
        interruptions: When peers' subscribers were without a grant because their link was lost.
        _asked: By peer and what it wants: its session, its question, and the answer; ``None`` while that is looked
            for. A peer may ask for thousands, so nothing here passes over those of all peers for one of them.
        _by_node: What ``of`` returns; ``None``: grants have changed since it was made.
    """

    kind = ""

    def __init__(self, bridge: Bridge) -> None:
        self._bridge = bridge
        self._asked: dict[int, dict[Want, _Entry]] = {}
        self._by_node: dict[tuple[str, str], list[tuple[int, str, Grant]]] | None = None
        self.interruptions: Interruptions = {}

    def __iter__(self) -> Iterator[tuple[int, Want, Grant]]:
        """Every grant: peer, what is granted, and where; changes during the iteration are allowed."""
        for session, asked, found in self._entries():
            if isinstance(found, Grant):
                yield session.peer, asked.want, found

    def _entries(self) -> list[_Entry]:
        return [entry for entries in self._asked.values() for entry in entries.values()]

    def _granted(self, want: Want) -> bool:
        """Whether any peer has a grant for a user."""
        return any(want in entries and isinstance(entries[want][2], Grant) for entries in self._asked.values())

    def of(self, name: str, node: str) -> list[tuple[int, str, Grant]]:
        """The grants for one node's topic or service: peer, user, and where."""
        if self._by_node is None:
            self._by_node = {}
            for peer, want, grant in self:
                self._by_node.setdefault((want.name, want.node), []).append((peer, want.user, grant))
        return sorted(self._by_node.get((name, node), ()))

    @abstractmethod
    def _unmet(self, session: PeerSession, asked: DirectAsk) -> Unmet | None:
        """The condition that does not hold for a peer by the rules and the graph."""

    @abstractmethod
    async def _find(self, session: PeerSession, want: Want) -> Grant | Unmet:
        """Where the node listens, if the peer may reach it."""

    def _broke(self, want: Want) -> None:  # noqa: B027 - of topics alone
        """A peer's user says that its connection ended by itself."""

    async def _ask(self, session: PeerSession, args: dict[str, Any]) -> dict[str, object]:
        asked = read_ask(args)
        before = self._answer(session, asked.want)
        found: Grant | Unmet | None = self._judge(session, asked)
        if asked.broken and isinstance(before, Grant):
            self._broke(asked.want)
        if found is None:
            self._asked.setdefault(session.peer, {})[asked.want] = session, asked, before
            found = await self._find(session, asked.want)
            found = self._judge(session, asked) or found  # the graph may have changed meanwhile
            entry = self._asked.get(session.peer, {}).get(asked.want)
            if entry is None or entry[1] is not asked:
                return reply_of(Unmet(Condition.AGENT, "it was given up meanwhile"))  # released, or asked again
        self._set(session, asked, found)
        if isinstance(found, Grant):
            self._bridge.counters.add("direct.granted")
        _log.debug("< %s: %s: %s", session.link.name, asked.want, found)
        return reply_of(found)

    def _answer(self, session: PeerSession, want: Want) -> Grant | Unmet | None:
        entry = self._asked.get(session.peer, {}).get(want)
        return entry[2] if entry is not None else None

    def _judge(self, session: PeerSession, asked: DirectAsk) -> Unmet | None:
        """The condition that does not hold for a peer; the name of a user is granted once for each node."""
        unmet = self._unmet(session, asked)
        if unmet is not None or isinstance(self._answer(session, asked.want), Grant):
            return unmet
        if asked.user and self._granted(asked.want):
            return Unmet(Condition.CALLER_ID, f"a node {asked.user} of another module is connected already")
        own = self._asked.get(session.peer, {}).values()
        if sum(isinstance(found, Grant) for _, _, found in own) >= limits.DIRECT_MAX:
            return Unmet(Condition.LIMIT, f"more than {limits.DIRECT_MAX} direct connections to this module")
        return None

    def _is_hidden(self, found: Grant | Unmet) -> bool:
        """Whether a peer must not learn of changes: it may not have this topic or service."""
        return self._bridge.context.gate.on and isinstance(found, Unmet) and found.condition is Condition.OFFERED

    def _set(self, session: PeerSession, asked: DirectAsk, found: Grant | Unmet | None) -> None:
        """Note what a peer is answered; ``None``: it does not ask any more."""
        want, before, self._by_node = asked.want, self._answer(session, asked.want), None
        own = self._asked.setdefault(session.peer, {})
        own.pop(want, None)
        if found is not None and not self._is_hidden(found):
            own[want] = session, asked, found
        if isinstance(found, Unmet):
            refused = [one for one, (_, _, answer) in own.items() if isinstance(answer, Unmet)]
            if len(refused) > limits.DIRECT_MAX:
                del own[refused[0]]
        if not own:
            del self._asked[session.peer]
        if isinstance(before, Grant) == isinstance(found, Grant):
            return
        if isinstance(found, Grant):
            interrupted(self.interruptions, session, want, lasts=False)
        for peer, entries in list(self._asked.items()) if isinstance(before, Grant) else ():
            if peer != session.peer and want in entries and isinstance(entries[want][2], Unmet):
                self._tell(entries[want][0], want)  # perhaps it was refused because of the user's name

    def _again(self, which: Callable[[Want], bool]) -> None:
        """Let peers ask again: something has changed."""
        for session, asked, found in self._entries():
            if found is not None and which(asked.want):
                self._tell(session, asked.want)

    def _tell(self, session: PeerSession, want: Want) -> None:
        if session.linked:
            self._bridge.rpc.notify(session, f"direct.{self.kind}_again", want._asdict())

    def _released(self, session: PeerSession, args: dict[str, Any]) -> None:
        self._set(session, read_ask(args), None)

    def judge_again(self, *, refused: bool = True) -> None:
        """Compare the answers with other rules: connections that are not allowed any more end, others ask again.

        In a secured mesh ending them is not left to the peer's agent.

        Args:
            refused: Have the peers ask again for what they were refused, too.
        """
        for session, asked, before in self._entries():
            granted = isinstance(before, Grant)
            if before is None or not (refused or granted):
                continue
            unmet = self._judge(session, asked)
            if unmet is not None:
                if self._bridge.context.gate.on and isinstance(before, Grant):
                    self._end(session, before.port)
                if granted or self._is_hidden(unmet):
                    self._set(session, asked, unmet)
            if granted is (unmet is not None) and not (unmet is not None and self._is_hidden(unmet)):
                self._tell(session, asked.want)

    def link_up(self, session: PeerSession) -> None:
        """Have a peer ask again for what it asked for over an earlier link, or release it."""
        for want in self._asked.get(session.peer, ()):
            self._tell(session, want)

    def link_down(self, session: PeerSession) -> None:
        """Forget what a peer asked for, and end its connections if it is silent; unless only its agent has died.

        The nodes of a peer that left in order go on. So do those of another module on its host.
        On this machine no connection outlives its process, and the nodes of all modules have the same address.
        """
        if session.link.crashed:
            return
        shared = any(
            other.address == session.address for other in self._bridge.sessions.linked() if other is not session
        )
        if session.silent and not shared:
            for port in {grant.port for peer, _, grant in self if peer == session.peer}:
                self._end(session, port)
        self.gone(session)

    def gone(self, session: PeerSession) -> None:
        """Forget what a peer asked for."""
        for _, asked, _ in list(self._asked.get(session.peer, {}).values()):
            self._set(session, asked, None)

    def _end(self, session: PeerSession, port: int) -> None:
        if session.same_machine:
            return
        self._bridge.counters.add("direct.ended")
        if problem := end_all(connections(local_port=port, remote=(session.address, None))):
            text = "! %s: connections of local nodes to it may hang: they cannot be ended (%s)"
            _log.info(text, session.link.name, problem)


class NodePorts:
    """The TCPROS ports of local publishers, by their slave API: asked once at a time, and known for a while."""

    def __init__(self) -> None:
        self._ports: dict[str, asyncio.Task[int | Unmet]] = {}

    async def find(self, node: str, uri: str, topic: str) -> int | Unmet:
        """The port at which a publisher serves a topic, or why there is none.

        Args:
            node: The publishing node.
            uri: Its slave API.
            topic: The topic.
        """
        task = self._ports.get(uri)
        if task is None:
            if len(self._ports) >= limits.DIRECT_MAX:
                del self._ports[next(iter(self._ports))]
            task = self._ports[uri] = start_task(_ask_port(node, uri, topic), f"port of {node}")
            asyncio.get_running_loop().call_later(limits.DIRECT_PORT_KNOWN, self.forget, uri)
        found = await asyncio.shield(task)
        if isinstance(found, Unmet):
            self.forget(uri)
        return found

    def forget(self, uri: str) -> None:
        """Forget a node's port: the node has ended or broken a connection, or time has passed."""
        self._ports.pop(uri, None)

    async def close(self) -> None:
        """Cancel the questions to nodes."""
        await end_tasks(*self._ports.values())


async def _ask_port(node: str, uri: str, topic: str) -> int | Unmet:
    try:
        params = (OWN_NODE, topic, [[TCPROS]])
        code, status, value = await call_api(uri, "requestTopic", *params, timeout=limits.DIRECT_NODE_TIMEOUT)
    except (RmpaError, RosFault) as error:
        return Unmet(Condition.NODE, f"{node} does not answer its agent: {error}")
    port = value[2] if isinstance(value, list) and len(value) == 3 and value[0] == TCPROS else None
    if code != 1 or not isinstance(port, int) or isinstance(port, bool) or not 0 < port < 1 << 16:
        return Unmet(Condition.NODE, f"{node} offers no TCPROS for {topic}: {str(status)[:200]}")
    return port


def grant_at(session: PeerSession, node: str, port: int, probe: str) -> Grant | Unmet:
    """Grant a peer a node's port, if by the kernel's table its listening socket can be reached from the peer."""
    addresses = listening_addresses(port)
    if addresses is None:
        return Unmet(Condition.LISTENING, "the kernel does not say where its node listens")
    if not addresses:
        return Unmet(Condition.LISTENING, f"{node} does not listen on this module's machine (port {port})")
    if addresses & _EVERY_ADDRESS or session.own_address in addresses:
        return Grant(port, node, probe)
    if all(is_loopback(address) for address in addresses):
        return Unmet(Condition.LISTENING, f"{node} listens on loopback only: {_REMEDY}")
    text = f"{node} listens at {', '.join(sorted(addresses))}, not at {session.own_address}"
    return Unmet(Condition.LISTENING, text)


def end_all(found: list[TcpSocket] | None) -> str:
    """End connections; return why it failed, or empty. ``None``: the kernel did not list them."""
    if found is None:
        return "the kernel does not say which connections there are"
    try:
        end_connections(found)
    except OSError as error:
        return error.strerror or str(error)
    return ""


class TopicGrants(Grants):
    """The direct connections of peers' subscribers to local publishers.

    Args:
        bridge: As of ``Grants``.
        exports: Knows what is offered to each peer.
    """

    kind = "topic"

    def __init__(self, bridge: Bridge, exports: Exports) -> None:
        super().__init__(bridge)
        rpc = bridge.rpc
        rpc.on_request("direct.topic", self._ask, Needs((Access.SUBSCRIBE,), "the topic: only what is offered"))
        rpc.on_notification("direct.topic_release", self._released, _RELEASED)
        self._exports = exports
        self.ports = NodePorts()

    def graph_changed(self, change: GraphChange) -> None:
        """Have peers ask again for what a registration that came or went touches."""
        if change.kind is RegistrationKind.SUBSCRIBER and not is_own(change.node):
            self._again(lambda want: (want.name, want.user) == (change.name, change.node))
        elif change.kind is RegistrationKind.PUBLISHER:
            self.ports.forget(change.api)
            self._again(lambda want: (want.name, want.node) == (change.name, change.node))

    def link_down(self, session: PeerSession) -> None:
        """As of ``Grants``."""
        for peer, want, _ in self if not session.link.crashed else ():
            if peer == session.peer:
                interrupted(self.interruptions, session, want, lasts=True)
        super().link_down(session)

    def _uri(self, want: Want) -> str:
        """The slave API of a publisher now; the exports learn a new one a little later."""
        return self._bridge.core.publishers(want.name).get(want.node, "")

    async def _find(self, session: PeerSession, want: Want) -> Grant | Unmet:
        uri = self._uri(want)
        port = await self.ports.find(want.node, uri, want.name)
        if self._uri(want) not in {uri, ""}:
            return Unmet(Condition.NODE, f"{want.node} has restarted just now")
        if isinstance(port, Unmet):
            return port
        service = f"{want.node}/get_loggers"  # rospy and roscpp nodes have it
        known = want.node in self._bridge.core.state().services.get(service, ())
        return grant_at(session, want.node, port, service if known else "")

    def _broke(self, want: Want) -> None:
        self.ports.forget(self._uri(want))
        self._bridge.core.suspect(want.node)

    def _unmet(self, session: PeerSession, asked: DirectAsk) -> Unmet | None:
        if asked.contract is None or not asked.user:
            raise RemoteProtocolError("direct transport: a topic is asked for without a subscriber or its contract")
        source = Source(asked.name, asked.node)
        local, where = self._exports.local(session.peer, source), "the publisher's module"
        if local is None:
            return Unmet(Condition.OFFERED, f"{source} is not offered")
        offered, other = self._exports.offered[local], local.topic if local != source else ""
        contract = combine(self._bridge.context.contracts.of(local.topic, offered.type), asked.contract)
        unmet = unmet_by_rules(contract, self._bridge, session, where, where, other, offered.origin)
        if unmet is not None:
            return unmet
        if compares_names(offered.type):
            return Unmet(Condition.ACTION, f"actions compare the names of the nodes at {offered.type}")
        if not self._uri(asked.want):
            return Unmet(Condition.NODE, f"{source.node} has just left")
        if asked.user in self._bridge.core.subscribers(source.topic):
            return Unmet(Condition.CALLER_ID, f"a node {asked.user} of the publisher's module subscribes too")
        return None


class ServiceGrants(Grants):
    """The direct calls of peers' nodes to local servers.

    Args:
        bridge: As of ``Grants``.
        exports: Knows what is offered to each peer.
        on_warning: ``(kind, subject, text)``: logs and counts a warning.
    """

    kind = "service"

    def __init__(self, bridge: Bridge, exports: ServiceExports, on_warning: Callable[[str, str, str], None]) -> None:
        super().__init__(bridge)
        rpc = bridge.rpc
        offered = Needs((Access.CALL,), "the service: only what is offered to the peer")
        rpc.on_request("direct.service", self._ask, offered)
        rpc.on_notification("direct.service_release", self._released, _RELEASED)
        self._exports = exports
        self._on_warning = on_warning

    def server_gone(self, service: str) -> None:
        """Have peers ask again for a service whose server has left, or is another one now."""
        self._again(lambda want: want.name == service)

    async def _ask(self, session: PeerSession, args: dict[str, Any]) -> dict[str, object]:
        reply = await super()._ask(session, args)
        if "why" in reply and self._bridge.context.services.transport(args["name"]) is Transport.DIRECT:
            name, service = session.link.name, args["name"]
            text = f'{service}: calls from {name} are relayed although transport is "direct": {reply["text"]}'
            self._on_warning("direct.relayed", f"{name} {service} {reply['why']}", text)
        return reply

    async def _find(self, session: PeerSession, want: Want) -> Grant | Unmet:
        uri = self._exports.offered[want.name].uri
        try:
            _, port = parse_service_uri(uri)
        except RmpaError:
            return Unmet(Condition.NODE, f"{want.node} registered {uri[:100]!r} for {want.name}")
        return grant_at(session, want.node, port, want.name)

    def _unmet(self, session: PeerSession, asked: DirectAsk) -> Unmet | None:
        service = asked.name
        local, server = self._exports.local(session.peer, service), self._exports.offered.get(service)
        if local is None or server is None:
            return Unmet(Condition.OFFERED, f"{service} is not offered")
        if server.node != asked.node:
            return Unmet(Condition.OFFERED, f"{server.node} provides {service} now")
        where, other = "the server's module", local if local != service else ""
        contract = Contract(transport=self._bridge.context.services.transport(service))
        return unmet_by_rules(contract, self._bridge, session, where, where, other, server.origin)
