"""The operations of the control socket: ``REPLIES`` has them all. A new operation is a row there and a handler."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING, Any, Final

import msgspec

from rmpa.bridge import limits as bridge_limits
from rmpa.bridge import nodes as node_requests
from rmpa.bridge.params.rules import QUESTIONS as PARAM_REQUESTS
from rmpa.bridge.policy import OWN_NODE
from rmpa.config.values import did_you_mean
from rmpa.core.errors import ConfigError, PeerRefused, RmpaError, UnreachableError
from rmpa.core.identity import is_global_name
from rmpa.observe import limits
from rmpa.observe.contract_term import ContractTerm
from rmpa.observe.graph_changes import GraphRevision
from rmpa.observe.io.site_requests import PARAM as SITE_PARAM
from rmpa.observe.peer_agent import INFO as AGENT_INFO
from rmpa.observe.peer_agent import PeerAgent
from rmpa.observe.reload_reply import ReloadReply
from rmpa.observe.sites import read_site_module
from rmpa.observe.snapshot import FollowedInfo, PingReply, Snapshot
from rmpa.observe.why.diagnosis import Diagnosis
from rmpa.ros.environment import NodeLine, PeerNodes

if TYPE_CHECKING:
    from collections.abc import Collection

    from rmpa.bridge.bridge import Bridge
    from rmpa.bridge.nodes import NodeRequests
    from rmpa.bridge.params.follower import Params
    from rmpa.bridge.sessions import PeerSession
    from rmpa.observe.io.control_server import Handler
    from rmpa.observe.io.site_requests import SiteRequests
    from rmpa.observe.io.snapshot_builder import SnapshotBuilder

Args = dict[str, object]


class ControlOperations:
    """The operations of one agent.

    Args:
        name: The agent's name.
        bridge: Its bridge.
        params: The bridge's part for parameters.
        snapshots: Builds its snapshots.
        nodes: Knows the nodes of this module.
        sites: Answers questions about other sites.
    """

    def __init__(
        self,
        name: str,
        bridge: Bridge,
        params: Params,
        snapshots: SnapshotBuilder,
        nodes: NodeRequests,
        sites: SiteRequests,
    ) -> None:
        self._name = name
        self._bridge = bridge
        self._params = params
        self._snapshots = snapshots
        self._nodes = nodes
        self._sites = sites

    def handlers(self) -> dict[str, Handler]:
        """The handlers of the operations of this class, for ``ControlServer``."""
        return {
            "snapshot": self.snapshot,
            "ping": self.ping,
            "param": self.param,
            "followed": self.followed,
            "agent": self.agent,
            "contract": self.contract,
            "site": self._sites.answer,
            "node": self.node,
        }

    def snapshot(self, args: Args) -> Snapshot:
        """A snapshot, or a part of it.

        ``topics``: the only ones that are wanted, or ``None`` for all. ``services``: likewise, or ``true`` for all;
        without it there are services in a snapshot of all topics. ``peers``: false leaves them out. ``most``: of
        topics, and of services, those that nothing here uses are left out beyond so many.
        """
        topics, services, most = _topics(args), args.get("services"), args.get("most")
        if most is not None and (not isinstance(most, int) or most < 0):
            raise ConfigError("most", f"{most!r} is not a number of topics")
        wanted = frozenset(map(str, services)) if isinstance(services, list) else services is True or None
        return self._snapshots.build(topics, services=wanted, peers=args.get("peers") is not False, most=most)

    async def ping(self, args: Args) -> PingReply:
        """``peer``: its name or GUID; ``count``: the number of pings."""
        session = self._session(args.get("peer", ""))
        count = args.get("count", 1)
        if not isinstance(count, int) or not 1 <= count <= limits.CONTROL_PINGS_MAX:
            raise ConfigError("count", f"{count!r} is not between 1 and {limits.CONTROL_PINGS_MAX}")
        link = session.link
        link.touch()
        times = [await link.ping() for _ in range(count)]
        host, port = link.remote_endpoint
        return PingReply(times=tuple(times), remote=f"{host}:{port}")

    async def param(self, args: Args) -> Any:
        """Pass a request about parameters on to a peer: ``peer``, ``what``, and ``key`` and ``text`` of that request.

        A peer ``site/module`` is a module of another site, which a gateway asks.
        """
        what = _request(args, PARAM_REQUESTS)
        inner: Args = {name: args[name] for name in ("key", "text") if name in args}
        if "/" in (peer := str(args.get("peer", ""))):
            site, module = read_site_module(peer)
            return await self._sites.one(SITE_PARAM, {"site": site, "module": module, "what": what, **inner})
        session = self._session(args.get("peer", ""))
        return await self._bridge.rpc.request(session, what, inner, bridge_limits.PARAM_ASK_TIMEOUT)

    def followed(self, _args: Args) -> tuple[FollowedInfo, ...]:
        """The parameters of other modules that this one follows."""
        return tuple(
            FollowedInfo(
                key=entry.rule.to,
                owner=entry.rule.owner,
                owner_key=entry.rule.key,
                state=entry.state,
                size=len(entry.text) if entry.text is not None else None,
                problem=entry.problem,
            )
            for entry in self._params.followed
        )

    async def node(self, args: Args) -> Any:
        """Pass a request about a node on to a peer: ``peer``, ``what``, ``node``.

        Without a peer: the facts about a node of this module, or a list of the nodes of all peers.
        """
        what, peer = _request(args, node_requests.REPLIES), args.get("peer")
        if peer is None and what == node_requests.INFO:
            return await self._nodes.info(args)
        if peer is None:
            return await asyncio.gather(*map(self._nodes_of, self._bridge.sessions.linked()))
        session = self._session(peer)
        if what == node_requests.LIST:
            return [await self._nodes_of(session)]
        request = {"node": str(args.get("node", "")), "by": OWN_NODE, "reason": "user request"}
        return await self._bridge.rpc.request(session, what, request, bridge_limits.NODE_KILL_TIMEOUT)

    async def _nodes_of(self, session: PeerSession) -> PeerNodes:
        """The nodes of a peer; where it does not answer, those of which this module has proxies."""
        peer = session.link.name
        try:
            value = await self._bridge.rpc.request(session, node_requests.LIST, {})
            return PeerNodes(peer=peer, nodes=msgspec.convert(value, tuple[NodeLine, ...]))
        except (RmpaError, msgspec.ValidationError) as error:
            nodes = tuple(NodeLine(name=node) for node, _ in session.proxies)
            return PeerNodes(peer=peer, nodes=nodes, problem=str(error))

    async def agent(self, args: Args) -> Any:
        """What the agent of a peer tells of itself: ``peer``, its name or GUID."""
        return await self._bridge.rpc.request(self._session(args.get("peer", "")), AGENT_INFO, {})

    def contract(self, args: Args) -> dict[str, ContractTerm]:
        """The terms that this module's settings give a ``topic`` of a ``type_name``, by key; it need not exist."""
        topic, type_name = str(args.get("topic", "")), str(args.get("type_name", ""))
        if not is_global_name(topic):
            raise ConfigError("topic", f"{topic!r} is not a topic", "write /name")
        return self._snapshots.contract(topic, type_name)

    def _session(self, name: object) -> PeerSession:
        """The linked peer of a name or GUID.

        Raises:
            PeerRefused: Several peers have that name.
            UnreachableError: No such peer has it.
        """
        peer = str(name)
        sessions = list(self._bridge.sessions.linked())
        fitting = [s for s in sessions if peer in {s.link.name, str(s.link.guid), str(s.link.guid).partition("#")[0]}]
        if len(fitting) == 1:
            return fitting[0]
        if fitting:
            raise PeerRefused(self._name, f"{len(fitting)} peers are named {peer}", "name one by its GUID")
        similar = did_you_mean(peer, [session.link.name for session in sessions])
        remedy = "`rmpa peer list` shows who is there, and why one is not linked"
        raise UnreachableError("linked peer", repr(peer), f"did you mean {similar}?" if similar else remedy)


def _topics(args: Args) -> frozenset[str] | None:
    """The argument ``topics``.

    Raises:
        ConfigError: It is no list.
    """
    topics = args.get("topics")
    if topics is not None and not isinstance(topics, list):
        raise ConfigError("topics", f"{topics!r} is not a list of topics")
    return frozenset(map(str, topics)) if topics is not None else None


def _request(args: Args, known: Collection[str]) -> str:
    """The argument ``what``: the name of a request to a peer.

    Raises:
        ConfigError: There is no such request.
    """
    what = str(args.get("what", ""))
    if what not in known:
        similar = did_you_mean(what, known)
        raise ConfigError("what", f"{what!r} is no question", f"did you mean {similar}?" if similar else "")
    return what


REPLIES: Final[dict[str, object]] = {
    "snapshot": Snapshot,
    "ping": PingReply,
    "why": tuple[Diagnosis, ...],
    "reload": ReloadReply,
    "param": object,  # the value that the peer replies
    "graph": GraphRevision,
    "followed": tuple[FollowedInfo, ...],
    "trust": object,  # TrustStatus, or as the command says (trust.status)
    "agent": PeerAgent,
    "contract": dict[str, ContractTerm],
    "site": object,  # as the questions of observe.io.site_requests say
    "node": object,  # tuple[PeerNodes, ...] for lists, else as node_requests.REPLIES says
}
"""All operations of the control socket, with the type of the value; ``object``: it depends on the arguments."""
