"""The nodes of peers: those of which nothing crosses, questions about them, and ``rosnode kill`` of proxies."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import socket
from typing import TYPE_CHECKING, Any, Final

import msgspec

from rmpa.bridge import limits
from rmpa.bridge.messages import is_crossing_name
from rmpa.bridge.policy import Needs
from rmpa.bridge.rpc import gate_for
from rmpa.bridge.sessions import Part, PeerSession
from rmpa.bridge.topics.direct import MEASURING
from rmpa.config import limits as config_limits
from rmpa.config.peer_rules import Access
from rmpa.config.values import did_you_mean
from rmpa.core.errors import RemoteProtocolError, RmpaError
from rmpa.core.identity import OWN_NODE, is_global_name, is_own, matches_any, proxied_node
from rmpa.ros import limits as ros_limits
from rmpa.ros.core.liveness import MASTER_ID
from rmpa.ros.environment import (
    NodeCost,
    NodeFacts,
    NodeLine,
    NodePing,
    describe_node,
    host_of,
    is_loopback,
    list_nodes,
)
from rmpa.ros.node.ask import end_node, node_connections, ping_node
from rmpa.ros.node.listeners import local_addresses
from rmpa.ros.node.loggers import GET
from rmpa.ros.node.service_server import ServiceCall, ServiceEndpoint
from rmpa.ros.wire.tcpros import LENGTH
from rmpa.ros.wire.xmlrpc import RosReply
from rmpa.runtime.loop import yielding_to_data
from rmpa.runtime.programs import figures

if TYPE_CHECKING:
    from collections.abc import Collection, Mapping

    from rmpa.bridge.bridge import Bridge
    from rmpa.bridge.services.part import Services
    from rmpa.bridge.topics.part import Topics
    from rmpa.ros.master.parameters import GraphChange
    from rmpa.ros.node.slave_node import SlaveNode

    _Table = Mapping[str, Collection[str]]

_log = logging.getLogger(__name__)

# The notification of the sender's nodes of which nothing crosses: ``nodes``, their names.
NODES: Final = "nodes"
# The request for a module's own nodes.
LIST: Final = "node.list"
# The request for the facts about a ``node``: ``NodeFacts``.
NODE_INFO: Final = "node.info"
# The request to ping a ``node``.
PING: Final = "node.ping"
# The request to a node's agent to end the node, with ``node``, ``by`` (the caller's node) and ``reason``. The
# response has ``gone``: whether nothing listens at the node's slave API any more.
KILL: Final = "node.kill"
# The request for what the processes of a module's nodes cost: a list of ``NodeCost``.
TOP: Final = "node.top"
# The type of each response; ``KILL`` ends a ``node``, where ``nodes.kill`` allows it.
REPLIES: Final[dict[str, object]] = {
    LIST: tuple[NodeLine, ...],
    NODE_INFO: NodeFacts,
    PING: NodePing,
    KILL: dict[str, bool],
}
_VISIBLE: Final = Needs(
    (Access.SUBSCRIBE, Access.PUBLISH, Access.CALL),
    "what the node publishes, subscribes to and provides; nodes without any are left out",
)
_HELD: Final = "node"
_REFUSED: Final = 0


class Nodes(Part):
    """The part of the bridge that tells peers of this module's nodes, and shows theirs.

    Topics and services bring the proxies of their nodes. A node that only subscribes, or whose services stay home,
    would not be known to ``rosnode`` in the other modules. Its proxy is registered with one service of its own,
    ``~get_loggers``, as every ROS node has it: no publisher, relay or subscriber takes notice of that.

    Args:
        bridge: The core, the peers and the rules. ``limits.nodes`` bounds how many nodes a peer shows, and is told.
        topics: The part with the topics that cross.
        services: The part with the services that cross.

    Attributes:
        _told: What each linked peer was told, by the number of its session.
        _shown: The nodes that each peer has told of.
    """

    def __init__(self, bridge: Bridge, topics: Topics, services: Services) -> None:
        self._bridge = bridge
        self._core = bridge.core
        self._topics = topics
        self._services = services
        self._told: dict[int, tuple[str, ...]] = {}
        self._shown: dict[int, set[str]] = {}
        self._soon: asyncio.TimerHandle | None = None
        rpc = bridge.rpc
        rpc.on_notification(NODES, self._told_by_peer, Needs((), "names of the peer's own nodes"))
        rpc.on_request(LIST, self._list, _VISIBLE)
        rpc.on_request(NODE_INFO, self.info, _VISIBLE)
        rpc.on_request(PING, self._ping, _VISIBLE)
        rpc.on_request(TOP, self.top, _VISIBLE)
        rpc.on_request(KILL, self._kill, Needs((Access.KILL,), "the node"))

    async def close(self) -> None:
        """Tell nothing any more."""
        if self._soon is not None:
            self._soon.cancel()

    def reload(self) -> None:
        """Tell the peers by the new rules."""
        self._later()

    def graph_changed(self, change: GraphChange) -> None:
        """Tell the peers soon, unless it was a proxy that came or went."""
        if not is_own(change.node):
            self._later()

    def reconcile(self) -> None:
        """Register missing proxies again: the core has been restarted."""
        services = self._core.state().services
        for peer, nodes in self._shown.items():
            session = self._bridge.sessions.get(peer)
            for node in nodes:
                proxy = session.proxies.get(node) if session is not None else None
                if proxy is not None and _service(proxy) not in services:
                    self._register(proxy)

    def link_up(self, session: PeerSession) -> None:
        """Tell a peer with a new link."""
        self._told.pop(session.peer, None)
        self._later()

    def _later(self) -> None:
        """In a moment: a node that starts registers its loggers first, and then perhaps a topic that crosses."""
        if self._soon is None:
            self._soon = asyncio.get_running_loop().call_later(limits.NODES_PAUSE, self._tell)

    def _tell(self) -> None:
        self._soon = None
        crossing = {source.node for source in self._topics.exports.offered}
        crossing |= {server.node for server in self._services.exports.offered.values()}
        nodes = [
            node
            for node in self._core.state().nodes
            if node not in crossing
            and node != "/rosout"  # every module has it
            and not is_own(node)
            and not node.startswith(MEASURING)
            and is_crossing_name(node)
        ]
        most = self._bridge.context.settings.limits.nodes
        for session in self._bridge.sessions.linked():
            peer, visible = session.link.name, self._visible(session)
            names = tuple(sorted(one for one in nodes if one in visible and self._passes(peer, one))[:most])
            if names != self._told.get(session.peer):  # over a new link also that there are none any more
                self._told[session.peer] = names
                self._bridge.rpc.notify(session, NODES, {"nodes": list(names)})

    def _passes(self, peer: str, node: str) -> bool:
        """Whether the rules for a peer let a node's name cross, as they do its topics and services."""
        return self._bridge.context.policy.judge_for(peer, node, wire=node).allowed

    def _told_by_peer(self, session: PeerSession, args: dict[str, Any]) -> None:
        told = args.get("nodes")
        names: list[Any] = told[: self._bridge.context.settings.limits.nodes] if isinstance(told, list) else [None]
        if not all(isinstance(name, str) and is_crossing_name(name) for name in names):
            raise RemoteProtocolError(f"{NODES} has no list of nodes' names")
        wanted = {name for name in names if self._passes(session.link.name, name)}
        shown = self._shown.get(session.peer, set())
        for node in sorted(shown - wanted):
            session.proxies.release(node, _HELD)
        for node in sorted(wanted - shown):
            session.proxies.hold(node, _HELD, self._show, self._hide)
        self._shown[session.peer] = wanted

    def gone(self, session: PeerSession) -> None:
        """Forget a peer."""
        self._told.pop(session.peer, None)
        for node in self._shown.pop(session.peer, ()):
            session.proxies.release(node, _HELD)

    def _show(self, proxy: SlaveNode) -> None:
        proxy.add_service(ServiceEndpoint(_service(proxy), proxy.name, _answer, description=GET))
        self._register(proxy)

    def _register(self, proxy: SlaveNode) -> None:
        self._core.call("registerService", proxy.name, _service(proxy), proxy.service_uri, proxy.uri)

    def _hide(self, proxy: SlaveNode) -> None:
        self._core.call("unregisterService", proxy.name, _service(proxy), proxy.service_uri)
        proxy.remove_service(_service(proxy))

    def _list(self, asker: PeerSession, _args: dict[str, Any]) -> tuple[NodeLine, ...]:
        problems = {node: found.problem for node, found in self._core.unreachable().items()}
        found = list_nodes(*self._tables(asker), self._core.state().nodes, problems, yielding_to_data)
        return tuple(line for line in found if not is_own(line.name))

    def _tables(self, asker: PeerSession | None) -> tuple[_Table, _Table, _Table]:
        """The nodes by published topic, by subscribed topic and by service: by those that the asker may have."""
        state, (gate, peer) = self._core.state(), gate_for(self._bridge, asker)

        def permitted(access: Access, table: _Table) -> _Table:
            if not gate.on:
                return table
            rows = yielding_to_data(list(table.items()))
            return {name: nodes for name, nodes in rows if gate.judge(access, peer, name).allowed}

        return (
            permitted(Access.SUBSCRIBE, state.publishers),
            permitted(Access.PUBLISH, state.subscribers),
            permitted(Access.CALL, state.services),
        )

    def _visible(self, asker: PeerSession | None) -> Collection[str]:
        """The nodes that the asker is told of: those of which it may have something."""
        if not gate_for(self._bridge, asker)[0].on:
            return self._core.state().nodes
        return {node for table in self._tables(asker) for nodes in yielding_to_data(table.values()) for node in nodes}

    async def info(self, asker: PeerSession | None, args: Mapping[str, object]) -> NodeFacts:
        """The facts about the ``node`` of this module that a request names, as far as its asker may know them.

        Raises:
            RmpaError: There is no such node.
        """
        node, uri = own_node(self._bridge, args, self._visible(asker))
        state, (gate, peer) = self._core.state(), gate_for(self._bridge, asker)
        facts = describe_node(node, uri, *self._tables(asker), state.types)
        try:
            answer = await ping_node(node, uri, OWN_NODE)
        except RmpaError as error:
            return msgspec.structs.replace(facts, problem=str(error))
        names = {address: name for name, address in state.nodes.items()}
        connections = await node_connections(uri, OWN_NODE, names)
        if connections is not None:
            connections = tuple(
                one
                for one in connections
                if gate.judge(Access.PUBLISH if one.inbound else Access.SUBSCRIBE, peer, one.topic).allowed
            )
        return msgspec.structs.replace(facts, pid=answer.pid, connections=connections)

    async def top(self, asker: PeerSession | None, _args: Mapping[str, object]) -> tuple[NodeCost, ...]:
        """What the processes of this module's nodes cost, of those that the asker may know of and that run here."""
        state, launch = self._core.state(), self._bridge.launch
        asked = [name for name in sorted(self._visible(asker)) if name in state.nodes and not is_own(name)]
        turns, starters = asyncio.Semaphore(limits.TOP_AT_ONCE), await launch.starters()
        here = {
            *local_addresses(),
            socket.gethostname(),
        }  # the names under which nodes of this machine are registered

        async def process(name: str) -> int | None:
            uri = state.nodes[name]
            if not is_loopback(host_of(uri)) and host_of(uri) not in here:
                return None
            async with turns:
                with contextlib.suppress(RmpaError, TimeoutError):
                    async with asyncio.timeout(limits.TOP_ANSWER):
                        return (await ping_node(name, uri, OWN_NODE)).pid
            return None

        pids = dict(zip(asked, await asyncio.gather(*map(process, asked)), strict=True))
        running = {pid for pid in pids.values() if pid is not None}
        launch.shares.keep(running)
        if not all(map(launch.shares.known, running)):
            for pid in running:
                if (about := figures(pid)) is not None:
                    launch.shares.of(pid, about)
            await asyncio.sleep(limits.TOP_FIRST)
        return tuple(self._cost(name, pid, starters.get(name, "")) for name, pid in pids.items())

    def _cost(self, node: str, pid: int | None, started_by: str) -> NodeCost:
        about = figures(pid) if pid is not None else None
        if pid is None or about is None:
            return NodeCost(node=node, started_by=started_by)
        cpu, since = self._bridge.launch.shares.of(pid, about), about.since
        return NodeCost(
            node=node, pid=pid, cpu=cpu, rss=about.rss, threads=about.threads, since=since, started_by=started_by
        )

    async def _ping(self, asker: PeerSession, args: dict[str, Any]) -> NodePing:
        node, uri = own_node(self._bridge, args, self._visible(asker))
        return await ping_node(node, uri, OWN_NODE)

    async def _kill(self, asker: PeerSession, args: dict[str, Any]) -> dict[str, bool]:
        peer = asker.link.name
        node, uri = own_node(self._bridge, args, permitted_nodes(self._bridge, Access.KILL, asker, args))
        who = f"{peer}'s {str(args.get('by', ''))[: limits.ASK_NAME_MAX]}"
        if not matches_any(self._bridge.context.settings.nodes.kill, node):
            _log.warning("! %s may not end %s: no glob of nodes.kill fits [not-permitted]", who, node)
            here = self._bridge.context.settings.name
            raise RmpaError(
                f"no glob of nodes.kill in the rmpa.toml of {here} fits {node}; allow it there", code="not-permitted"
            )
        _log.warning("= %s ends %s [node-killed]", who, node)
        gone = await end_node(node, uri, OWN_NODE, f"killed by {who}")
        self._core.suspect(node)  # roscpp does not unregister when it ends in a hurry
        return {"gone": gone}


def permitted_nodes(
    bridge: Bridge, access: Access, asker: PeerSession | None, args: Mapping[str, object]
) -> list[str]:
    """The nodes of this module with which an asker may do something.

    Raises:
        RmpaError: It may not with the ``node`` of its request, whether there is one or not.
    """
    (gate, peer), named = gate_for(bridge, asker), str(args.get("node"))[: config_limits.CROSSING_NAME_MAX]
    if why := gate.why_not(access, peer, named):
        raise RmpaError(why, code="not-permitted")
    return [node for node in bridge.core.state().nodes if gate.judge(access, peer, node).allowed]


def own_node(
    bridge: Bridge, args: Mapping[str, object], told: Collection[str], *, agents: bool = False
) -> tuple[str, str]:
    """The node of this module that a request names, and its slave API.

    Args:
        bridge: Its core.
        args: The request's.
        told: The nodes that may be told of.
        agents: Whether the agent's own node counts.

    Raises:
        RmpaError: There is no such node.
    """
    here, node, nodes = bridge.context.settings.name, args.get("node"), bridge.core.state().nodes
    if not isinstance(node, str) or len(node) > config_limits.CROSSING_NAME_MAX or not is_global_name(node):
        raise RmpaError("the question names no node")
    if is_own(node) and not (agents and node == OWN_NODE):
        origin = proxied_node(node)
        whose = f"it is {origin[0]}'s {origin[1]}: ask there" if origin is not None else "it is its agent"
        raise RmpaError(f"{node} is no node of {here}: {whose}", code="unknown-name")
    if node not in told or node not in nodes:
        near = did_you_mean(node, [name for name in told if not is_own(name)])
        hint = f"; did you mean {near}?" if near else ""
        raise RmpaError(f"{here} has no node {node}{hint}", code="unknown-name")
    return node, nodes[node]


def _service(proxy: SlaveNode) -> str:
    return f"{proxy.name}/get_loggers"


def _answer(call: ServiceCall) -> None:
    """No logger of a node of another module is set from here."""
    call.reply(True, LENGTH.pack(0))


class ProxyKills:
    """Answers the ``shutdown`` calls (``rosnode kill``) to proxies and to the agent's own node.

    ``rosnode kill -a`` calls every node of the graph in the order of their names, so the agent's own node comes
    before the proxies. It ends only the nodes of this module; nodes of other modules live on.

    Args:
        bridge: The peers.

    Attributes:
        _all: By caller of ``kill -a``: until when its further calls are taken for a part of that.
    """

    def __init__(self, bridge: Bridge) -> None:
        self._bridge = bridge
        self._all: dict[str, float] = {}
        self._under_way = 0

    async def own(self, caller: str, reason: str) -> RosReply:
        """Refuse to end the agent's own node, and remember the caller for ``limits.NODE_KILL_ALL`` seconds."""
        now = asyncio.get_running_loop().time()
        self._all = {other: until for other, until in self._all.items() if until > now}
        if len(self._all) < limits.NODE_KILLS_AT_ONCE:
            self._all[caller] = now + limits.NODE_KILL_ALL
        _log.info("= %s asks the agent's own node to end (%s): it stays, end the agent instead", caller, reason)
        return RosReply(_REFUSED, "this node is the agent; it ends with `rmpa up`", 0)

    async def proxy(self, proxy: str, caller: str, reason: str) -> RosReply:
        """End the node that a proxy stands for, because the proxy was asked to end.

        Args:
            proxy: The proxy's name.
            caller: The caller's node.
            reason: The caller's reason, as text.
        """
        linked = self._bridge.sessions.linked()
        session = next((one for one in linked if proxy.startswith(f"{one.proxies.prefix}/")), None)
        if session is None:
            module, node = proxied_node(proxy) or ("", proxy)
            return RosReply(_REFUSED, f"{node} is a node of {module}, which is no linked peer: end it there", 0)
        node = proxy.removeprefix(session.proxies.prefix)
        whose = f"{session.link.name}:{node}"
        if caller == MASTER_ID:
            # Another local node took the proxy's name. That does not concern the node at the peer.
            _log.warning("! another node has the name of the proxy of %s [name-taken]", whose)
            return RosReply(1, "shutdown", 0)
        problem = await self._ask(session, node, caller, reason)
        if problem:
            _log.warning("! %s did not end, although %s asked it to: %s [node-killed]", whose, caller, problem)
            return RosReply(_REFUSED, problem, 0)
        _log.info("= %s was ended for %s (%s)", whose, caller, reason)
        return RosReply(1, "shutdown", 0)

    async def _ask(self, session: PeerSession, node: str, caller: str, reason: str) -> str:
        """Asks the peer to end the node; returns why it is not ended, or empty."""
        now = asyncio.get_running_loop().time()
        if self._all.get(caller, 0.0) > now:
            self._all[caller] = now + limits.NODE_KILL_ALL
            return "kill -a ends the nodes of this module only; name a node of another module to end it"
        if self._under_way >= limits.NODE_KILLS_AT_ONCE:
            return f"{self._under_way} other nodes are being ended; try again"
        self._under_way += 1
        try:
            args = {"node": node, "by": caller, "reason": reason[: limits.ASK_NAME_MAX]}
            answer = await self._bridge.rpc.request(session, KILL, args, limits.NODE_KILL_TIMEOUT)
        except RmpaError as error:
            return str(error)
        finally:
            self._under_way -= 1
        gone = isinstance(answer, dict) and answer.get("gone")
        return "" if gone else f"it was asked, and is still there after {ros_limits.NODE_KILL_WAIT:g} s"
