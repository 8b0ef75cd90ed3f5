"""The operations of the control socket, and what programs do by several of them.

``ControlOperations.handlers`` lists them; ``why``, ``reload``, ``graph`` and ``trust`` are the agent's own
(``agent/agent.py``). Each docstring says what the arguments and the value are.
"""

from __future__ import annotations

import asyncio
import json
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import msgspec

from rmpa.bridge import limits as bridge_limits
from rmpa.bridge import nodes as node_requests
from rmpa.bridge.kept import Kept
from rmpa.bridge.log import LEVEL
from rmpa.bridge.params import owner as param_requests
from rmpa.bridge.recordings import ModuleRecordings
from rmpa.bridge.topics.rates import RATES, Rates
from rmpa.config.rules import ROS2
from rmpa.config.values import suggestion
from rmpa.core.errors import ConfigError, LocalProtocolError, PeerRefused, RmpaError, UnreachableError
from rmpa.core.facts import ContractTerm, FollowedInfo
from rmpa.core.identity import OWN_NODE, is_global_name, is_meant
from rmpa.observe import limits
from rmpa.observe.sites import PARAM, SiteRequests
from rmpa.observe.snapshot import INFO, PingReply, Snapshot
from rmpa.ros.environment import NodeLine, PeerNodes
from rmpa.ros.master.parameters import leaves
from rmpa.ros.wire.xmlrpc import XmlRpcValue, parse_response, serialize_response

if TYPE_CHECKING:
    from collections.abc import Collection

    from rmpa.bridge.facts import BridgeFacts
    from rmpa.bridge.nodes import Nodes
    from rmpa.bridge.params.follower import Params
    from rmpa.bridge.sessions import PeerSession
    from rmpa.observe.control_client import ControlClient
    from rmpa.observe.control_server import Handler
    from rmpa.observe.snapshot_builder import SnapshotBuilder

Args = dict[str, Any]


@dataclass(frozen=True, slots=True)
class ControlOperations:
    """The operations of one agent.

    Args:
        name: The agent's name.
        facts: What its bridge tells.
        params: The bridge's part for parameters.
        snapshots: Builds its snapshots.
        nodes: Knows the nodes of this module.
        sites: Answers questions about other sites.
        rates: Measures the rates of this module's topics.
    """

    name: str
    facts: BridgeFacts
    params: Params
    snapshots: SnapshotBuilder
    nodes: Nodes
    sites: SiteRequests
    rates: Rates

    def handlers(self) -> dict[str, Handler]:
        """The handler of each operation that is not the agent's own, for ``ControlServer``."""
        bridge = self.facts.bridge
        return {
            "snapshot": self.snapshot,
            "ping": self.ping,
            "param": self.param,
            "followed": self.followed,
            "agent": self.agent,
            "contract": self.contract,
            "rates": self.topic_rates,
            "site": self.sites.answer,
            "log": bridge.log.read,
            "log_level": self.log_level,
            "launch": bridge.launch.answer,
            "top": self.top,
            "record": bridge.recordings.answer,
            "node": self.node,
        }

    def snapshot(self, args: Args) -> Snapshot:
        """A snapshot, or a part of it.

        ``topics``: the only ones that are wanted, or ``None`` for all. ``services``: likewise, or ``true`` for all;
        without it there are services in a snapshot of all topics. ``peers``: false leaves them out. ``most``: of
        topics, and of services, those that nothing here uses are left out beyond so many.
        """
        topics, services, most = args.get("topics"), args.get("services"), args.get("most")
        if topics is not None and not isinstance(topics, list):
            raise ConfigError("topics", f"{topics!r} is not a list of topics")
        if most is not None and (not isinstance(most, int) or most < 0):
            raise ConfigError("most", f"{most!r} is not a number of topics")
        names = frozenset(map(str, topics)) if topics is not None else None
        wanted = frozenset(map(str, services)) if isinstance(services, list) else services is True or None
        return self.snapshots.build(names, services=wanted, peers=args.get("peers") is not False, most=most)

    async def ping(self, args: Args) -> PingReply:
        """``peer``: its name or GUID; ``count``: the number of pings."""
        link, count = self._session(args.get("peer", "")).link, args.get("count", 1)
        if not isinstance(count, int) or not 1 <= count <= limits.CONTROL_PINGS_MAX:
            raise ConfigError("count", f"{count!r} is not between 1 and {limits.CONTROL_PINGS_MAX}")
        link.touch()
        times = [await link.ping() for _ in range(count)]
        host, port = link.remote_endpoint
        return PingReply(times=tuple(times), remote=f"{host}:{port}")

    async def param(self, args: Args) -> Any:
        """Pass a request about parameters on to a peer: ``peer``, ``what``, and its ``key`` and ``text``."""
        what, session = _request(args, param_requests.QUESTIONS), self._session(args.get("peer", ""))
        inner: Args = {name: args[name] for name in ("key", "text") if name in args}
        return await self.facts.bridge.rpc.request(session, what, inner, bridge_limits.PARAM_ASK_TIMEOUT)

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
            for entry in self.params.followed
        )

    async def node(self, args: Args) -> Any:
        """Pass a request about a node on to a peer: ``peer``, ``what``, ``node``.

        Without a peer: the facts about a node of this module, or a list of the nodes of all peers.
        """
        what, peer = _request(args, node_requests.REPLIES), args.get("peer")
        if peer is None and what == node_requests.NODE_INFO:
            return await self.nodes.info(None, args)
        if peer is None:
            return await asyncio.gather(*map(self._nodes_of, self.facts.bridge.sessions.linked()))
        session = self._session(peer)
        if what == node_requests.LIST:
            return [await self._nodes_of(session)]
        request = {"node": str(args.get("node", "")), "by": OWN_NODE, "reason": "user request"}
        return await self.facts.bridge.rpc.request(session, what, request, bridge_limits.NODE_KILL_TIMEOUT)

    async def _nodes_of(self, session: PeerSession) -> PeerNodes:
        """The nodes of a peer; where it does not answer, those of which this module has proxies."""
        peer = session.link.name
        try:
            value = await self.facts.bridge.rpc.request(session, node_requests.LIST, {})
            return PeerNodes(peer=peer, nodes=msgspec.convert(value, tuple[NodeLine, ...]))
        except (RmpaError, msgspec.ValidationError) as error:
            nodes = tuple(NodeLine(name=node) for node, _ in session.proxies)
            return PeerNodes(peer=peer, nodes=nodes, problem=str(error))

    async def agent(self, args: Args) -> Any:
        """The facts of a peer's module: ``peer``, its name or GUID."""
        return await self.facts.bridge.rpc.request(self._session(args.get("peer", "")), INFO, {})

    async def top(self, args: Args) -> dict[str, Any]:
        """What the nodes of each module cost, by its name; a text where a peer does not tell it.

        ``modules``: the only ones that are wanted.
        """
        wanted = args.get("modules")
        names = [str(name) for name in wanted] if isinstance(wanted, list) and wanted else None
        peers = [
            session
            for session in self.facts.bridge.sessions.linked()
            if names is None or any(is_meant(name, session.link.name, str(session.link.guid)) for name in names)
        ]
        told = await self._of_peers(peers, node_requests.TOP)
        return ({self.name: await self.nodes.top(None, {})} if names is None or self.name in names else {}) | told

    async def _of_peers(self, peers: list[PeerSession], what: str) -> dict[str, Any]:
        """The answers of peers to a request, by name; a text where one does not give any."""
        asked = (self.facts.bridge.rpc.request(session, what, {}) for session in peers)
        told = await asyncio.gather(*asked, return_exceptions=True)
        found: dict[str, Any] = {}
        for session, answer in zip(peers, told, strict=True):
            if isinstance(answer, BaseException) and not isinstance(answer, RmpaError):
                raise answer
            found[session.link.name] = str(answer) if isinstance(answer, RmpaError) else answer
        return found

    async def log_level(self, args: Args) -> Any:
        """The levels of a ``node``'s loggers; ``level``: sets that of a ``logger``. ``peer``: the node's module."""
        request = {name: str(args[name]) for name in ("node", "logger", "level") if args.get(name)}
        if not (peer := args.get("peer")):
            return await self.facts.bridge.log.level(None, request)
        return await self.facts.bridge.rpc.request(self._session(peer), LEVEL, request)

    async def topic_rates(self, _args: Args) -> dict[str, Any]:
        """The rates of the topics that each module publishes, by its name; a text where a peer does not tell them."""
        told = await self._of_peers([*self.facts.bridge.sessions.linked()], RATES)
        return {self.name: self.rates.now()} | told

    def contract(self, args: Args) -> dict[str, ContractTerm]:
        """The terms that this module's settings give a ``topic`` of a ``type_name``, by key; it need not exist."""
        topic, type_name = str(args.get("topic", "")), str(args.get("type_name", ""))
        if not is_global_name(topic):
            raise ConfigError("topic", f"{topic!r} is not a topic", "write /name")
        return self.facts.topics.contract(topic, type_name)

    def _session(self, name: object) -> PeerSession:
        """The linked peer of a name or GUID.

        Raises:
            PeerRefused: Several peers have that name.
            UnreachableError: No such peer has it.
        """
        peer = str(name)
        sessions = list(self.facts.bridge.sessions.linked())
        fitting = [session for session in sessions if is_meant(peer, session.link.name, str(session.link.guid))]
        if len(fitting) == 1:
            return fitting[0]
        if fitting:
            problem = f"{len(fitting)} peers are named {peer}"
            raise PeerRefused(self.name, problem, "name one by its GUID", code="several-fit")
        remedy = "`rmpa peer list` shows which modules are there, and why one is not linked"
        names = [session.link.name for session in sessions]
        raise UnreachableError("linked peer", repr(peer), suggestion(peer, names, remedy))


def _request(args: Args, known: Collection[str]) -> str:
    """The argument ``what``: the name of a request to a peer.

    Raises:
        ConfigError: There is no such request.
    """
    what = str(args.get("what", ""))
    if what not in known:
        raise ConfigError("what", f"{what!r} is no question", suggestion(what, known, ""))
    return what


def parameters_in(key: str, value: XmlRpcValue) -> list[tuple[str, XmlRpcValue]]:
    """The parameters in a value, each with its name.

    Raises:
        RmpaError: A name in it is not a parameter's.
    """
    found = list(leaves(key, value))
    for name, one in found:
        if name == "/":
            raise RmpaError(f"the root can only be set to a dictionary, not to {one!r}")
        if problem := param_requests.key_problem(name):
            raise RmpaError(problem)
    return found


@dataclass(frozen=True, slots=True)
class PeerParams:
    """The parameters of a peer's module, through both agents; each call blocks.

    Args:
        client: Asks this machine's agent.
        peer: The peer's name or GUID.
    """

    client: ControlClient
    peer: str

    def get(self, key: str) -> XmlRpcValue:
        """A value, or a namespace.

        Raises:
            RmpaError: There is none, or the peer does not answer or refuses.
        """
        return self._value(param_requests.GET, key=key)

    def names(self) -> list[str]:
        """The names of all parameters that may be read, in order; errors as for ``get``."""
        value = self._value(param_requests.NAMES)
        return sorted(str(name) for name in value) if isinstance(value, list) else []

    def set(self, key: str, value: XmlRpcValue) -> int:
        """Set a parameter, or each member of a namespace; return the number. Errors as for ``get``."""
        parameters_in(key, value)
        try:
            text = serialize_response(value)
        except LocalProtocolError as error:
            raise RmpaError(f"{key}: {error}") from None
        if len(text) > bridge_limits.PARAM_TEXT_MAX:
            raise RmpaError(param_requests.too_large(key, len(text)), code="limit-reached")
        return param_requests.count_of(self._ask(param_requests.SET, key=key, text=text.decode()))

    def delete(self, key: str) -> None:
        """Delete a parameter or namespace; errors as for ``get``."""
        self._ask(param_requests.DELETE, key=key)

    def _value(self, what: str, **args: str) -> XmlRpcValue:
        return parse_response(param_requests.text_of(self._ask(what, **args)).encode())

    def _ask(self, what: str, **args: str) -> object:
        return self.client.pass_on("param", dict[str, Any], peer=self.peer, what=what, **args)


@dataclass(frozen=True, slots=True)
class Ros2Params:
    """The parameters of a node of ROS 2, through a gateway; as ``PeerParams``. ``/a.b`` is ROS 2's ``a.b``.

    Args:
        client: Asks this machine's agent.
        node: The node, ``/like/this``.
    """

    client: ControlClient
    node: str

    def get(self, key: str) -> XmlRpcValue:
        """A value, or those of a namespace by name; errors as for ``PeerParams``."""
        value: XmlRpcValue = self._ask(key=key[1:])
        return value

    def names(self) -> list[str]:
        """The names of all parameters, in order."""
        return [f"/{name}" for name in self._ask() or ()]

    def set(self, key: str, value: XmlRpcValue) -> int:
        """Set a parameter, or each member of a dictionary: all or none; return the number."""
        self._ask(key=key[1:], text=json.dumps(value, default=str))
        return len(list(leaves(key, value)))

    def delete(self, key: str) -> None:
        """Delete a parameter, which few nodes allow."""
        self._ask(key=key[1:], text="null")

    def _ask(self, **args: str) -> Any:
        asked = {"site": ROS2, "node": self.node, **args}
        text = self.client.pass_on("site", str, what=PARAM, args=asked)
        return json.loads(text) if text else None


def remove_recording(client: ControlClient, recording: str, module: str = "") -> tuple[list[str], dict[str, str]]:
    """Remove a recording at all linked modules that have it, or at one; return where, and by module why it is not."""
    removed, problems = list[str](), dict[str, str]()
    found = client.call("record", tuple[ModuleRecordings, ...], what="list")
    holders = [each.module for each in found if any(kept.id == recording for kept in each.kept)]
    for name in holders if not module else [module]:
        try:
            client.call("record", Kept, what="remove", module=name, id=recording)
            removed.append(name)
        except RmpaError as error:
            problems[name] = str(error)
    return removed, problems
