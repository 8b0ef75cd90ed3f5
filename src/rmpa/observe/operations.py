"""The operations of the control socket: ``REPLIES`` has them all. A new operation is a row there and a handler.

Questions about other sites are answered by a gateway; another agent asks the gateways that it is linked to. Clients
may wait for the next change of the local graph, and are told what has changed.
"""

from __future__ import annotations

import asyncio
import contextlib
import itertools
import secrets
from collections import deque
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any, Final, Protocol

import msgspec

from rmpa.bridge import limits as bridge_limits
from rmpa.bridge import nodes as node_requests
from rmpa.bridge.params import rules as transfer
from rmpa.bridge.policy import Needs
from rmpa.bridge.rpc import UNKNOWN_QUESTION
from rmpa.config.peer_rules import Access
from rmpa.config.values import did_you_mean
from rmpa.core.errors import ConfigError, LocalProtocolError, PeerRefused, RmpaError, UnreachableError
from rmpa.core.identity import OWN_NODE, is_global_name
from rmpa.observe import limits
from rmpa.observe.control import GraphRevision, GraphRows, ReloadReply, ServiceRow, TopicRow
from rmpa.observe.peer_info import INFO as AGENT_INFO
from rmpa.observe.peer_info import ContractTerm, PeerAgent
from rmpa.observe.snapshot import FollowedInfo, PingReply, Snapshot
from rmpa.observe.why.diagnosis import Diagnosis
from rmpa.ros.environment import NodeLine, PeerNodes
from rmpa.ros.master.parameters import RegistrationKind, leaves
from rmpa.ros.wire.xmlrpc import parse_response, serialize_response

if TYPE_CHECKING:
    from collections.abc import Awaitable, Collection, Iterable

    from rmpa.bridge.bridge import Bridge
    from rmpa.bridge.nodes import Nodes
    from rmpa.bridge.params.follower import Params
    from rmpa.bridge.sessions import PeerSession
    from rmpa.observe.control_client import ControlClient
    from rmpa.observe.control_server import Handler
    from rmpa.observe.snapshot_builder import SnapshotBuilder
    from rmpa.ros.core.external import Core
    from rmpa.ros.master.parameters import GraphChange, GraphState
    from rmpa.ros.wire.xmlrpc import XmlRpcValue

Args = dict[str, Any]

# --- other sites ----------------------------------------------------------------------------------------------------

# The request for a ``SitesReport`` without sources.
REPORT: Final = "site.report"
# The request for a ``SitesReport`` of one site with its sources: ``{site}``.
INFO: Final = "site.info"
# The request for the ways of a topic or a service through gateways: ``{name, site, module, service}``.
WHY: Final = "site.why"
_SOURCES: Final = Needs(
    (Access.SUBSCRIBE, Access.CALL),
    "each topic and service; of this site the asking module's own alone. Sites and modules are named to all",
)
_WAYS: Final = Needs(
    (Access.SUBSCRIBE, Access.CALL), "the topic or service, by its name here; what leaves is the asking module's own"
)
# The questions about other sites.
QUESTIONS: Final = (REPORT, INFO, WHY)


class SiteAnswerer(Protocol):
    """Answers questions about other sites: ``gateway.sites`` has it."""

    def answer(self, what: str, args: dict[str, Any], asker: str = "", /) -> Awaitable[Any]:
        """The reply to one of ``QUESTIONS``, which tells ``asker``, a linked module, only what it may have.

        Without ``asker`` the question is of this machine's user, to which everything is shown.

        Raises:
            RmpaError: It cannot be answered; the text says why.
        """
        ...


class SiteRequests:
    """The operation ``site`` of the control socket, and the peers' requests about sites.

    Args:
        bridge: Carries requests between the modules, and says which peers are believed about other sites.
    """

    def __init__(self, bridge: Bridge) -> None:
        self._bridge = bridge
        # What answers as a gateway; ``None``: this agent is none.
        self.answerer: SiteAnswerer | None = None
        # The gateway that answered for a site, by its GUID.
        self._liked: dict[str, str] = {}

    def serve(self, gateway: SiteAnswerer) -> None:
        """Answer as a gateway from now on."""
        self.answerer, rpc = gateway, self._bridge.rpc
        rpc.on_request(REPORT, partial(self._answer_peer, gateway, REPORT), _SOURCES)
        rpc.on_request(INFO, partial(self._answer_peer, gateway, INFO), _SOURCES)
        rpc.on_request(WHY, partial(self._answer_peer, gateway, WHY), _WAYS)

    async def answer(self, args: Args) -> Any:
        """The operation ``site``: ``what`` (one of ``QUESTIONS``) and its ``args``.

        ``site.report`` and ``site.why`` return a list with the answers of all gateways; the others one answer.
        """
        what, inner = args.get("what"), args.get("args")
        if what not in QUESTIONS or not isinstance(inner, dict):
            raise ConfigError("what", f"{what!r} is no question about sites")
        return await (self.all(what, inner) if what in {REPORT, WHY} else self.one(what, inner))

    async def all(self, what: str, args: Args) -> list[Any]:
        """The answers of all gateways; those that fail are left out."""
        if self.answerer is not None:
            return [await self.answerer.answer(what, args)]
        # Twice the time: the gateway itself asks the other site for so long.
        asks = [self._bridge.rpc.request(at, what, args, 2 * bridge_limits.ASK_TIMEOUT) for at in self._believed()]
        found = await asyncio.gather(*asks, return_exceptions=True)
        for error in found:
            if isinstance(error, BaseException) and not isinstance(error, RmpaError):
                raise error
        return [value for value in found if not isinstance(value, RmpaError)]

    async def one(self, what: str, args: Args) -> Any:
        """The answer of the first gateway that has one.

        Raises:
            UnreachableError: This module is linked to no gateway.
            RmpaError: No gateway has an answer; the text is that of the one that knew most.
        """
        if self.answerer is not None:
            return await self.answerer.answer(what, args)
        site = str(args.get("site", ""))
        problem: RmpaError | None = None
        for session in sorted(self._believed(), key=lambda each: str(each.link.guid) != self._liked.get(site)):
            try:
                value = await self._bridge.rpc.request(session, what, args, bridge_limits.PARAM_ASK_TIMEOUT)
            except RmpaError as error:
                if not (isinstance(error, PeerRefused) and UNKNOWN_QUESTION in error.reason):
                    problem = problem or error
            else:
                self._liked[site] = str(session.link.guid)
                return value
        self._liked.pop(site, None)
        raise problem or UnreachableError(
            "gateway",
            "any linked peer",
            "start one with `rmpa gateway`; `rmpa peer list` shows the links. In a secured mesh "
            "`relays` of [trust] names the gateways that are believed",
        )

    def _believed(self) -> list[PeerSession]:
        """The linked peers whose word about other sites counts: any member could answer as a gateway."""
        return [at for at in self._bridge.sessions.linked() if self._bridge.gate.may_relay(at.link.name)]

    @staticmethod
    def _answer_peer(gateway: SiteAnswerer, what: str, asker: PeerSession, args: Args) -> Awaitable[object]:
        return gateway.answer(what, args, asker.link.name)


# --- changes of the local graph -------------------------------------------------------------------------------------

# Each revision is an integer that all programs read exactly from JSON, and no two agents begin near each other.
_REVISION_BITS = 52


class GraphHistory:
    """Which topics and services have changed at the last ``limits.GRAPH_HISTORY`` revisions.

    A row is the present state of one topic or service, so it does not matter how often it changed meanwhile. The
    history has names alone, and is kept while clients ask for rows: without one, a change of the graph costs nothing.

    Args:
        revision: The first one.
    """

    def __init__(self, revision: int) -> None:
        # The present one: stands for the present local graph.
        self.revision = revision
        self._changes: deque[tuple[RegistrationKind, str]] | None = None
        self._asked = 0

    def add(self, change: GraphChange) -> None:
        """The graph has changed, which makes a new revision."""
        self.revision += 1
        if self._changes is None:
            return
        if self.revision - self._asked > limits.GRAPH_HISTORY:
            self._changes = None  # the client that asked last is too far behind by now, or has gone
        else:
            self._changes.append((change.kind, change.name))

    def rows_since(self, known: object, state: GraphState) -> GraphRows:
        """What has changed since a revision, or everything where the history does not reach back to it.

        Args:
            known: The revision that a client knows; ``None``, or anything that is not one of this agent: none.
            state: The present graph.
        """
        self._asked = self.revision
        if self._changes is None:
            self._changes = deque(maxlen=limits.GRAPH_HISTORY)
        behind = self.revision - known if type(known) is int else -1
        whole = not 0 <= behind <= len(self._changes)
        topics: Iterable[str] = sorted(state.publishers.keys() | state.subscribers.keys()) if whole else ()
        services: Iterable[str] = sorted(state.services) if whole else ()
        if not whole:
            recent = dict.fromkeys(itertools.islice(reversed(self._changes), behind))
            topics = dict.fromkeys(name for kind, name in recent if kind is not RegistrationKind.SERVICE)
            services = [name for kind, name in recent if kind is RegistrationKind.SERVICE]
        publishers, subscribers, types = state.publishers, state.subscribers, state.types
        return GraphRows(
            whole=whole,
            topics=tuple(
                TopicRow(name, types.get(name, ""), tuple(publishers.get(name, ())), tuple(subscribers.get(name, ())))
                for name in topics
            ),
            services=tuple(ServiceRow(name, tuple(state.services.get(name, ()))) for name in services),
        )


class GraphRevisions:
    """The revision of a core's graph: a number that every change of the graph replaces.

    Args:
        core: Tells the changes.
        rows: Whether clients get the changes themselves. Those of a core that is another program are known here later
            than there.
    """

    def __init__(self, core: Core, *, rows: bool) -> None:
        self._core = core
        self._rows = rows
        # Begins anywhere, so that a client takes the graph of an agent that was started again for another one.
        self._history = GraphHistory(secrets.randbits(_REVISION_BITS))
        self._changed = asyncio.Event()
        core.on_change(self._add)

    def _add(self, change: GraphChange) -> None:
        self._history.add(change)
        self._changed.set()

    async def after(self, args: Args) -> GraphRevision:
        """The revision, as soon as it differs from the one that the client knows.

        Args:
            args: ``after``: the known revision; ``wait``: the most seconds to wait for another one, 0 by default;
                ``rows``: true for what has changed since ``after``.

        Raises:
            ConfigError: An argument is out of range.
        """
        known, wait = args.get("after"), args.get("wait", 0)
        if not isinstance(wait, int | float) or not 0 <= wait <= limits.CONTROL_WAIT_MAX:
            raise ConfigError("wait", f"{wait!r} is not between 0 and {limits.CONTROL_WAIT_MAX:g} s")
        if known == self._history.revision:
            self._changed.clear()  # those who wait already were called when it was set
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(wait):
                    await self._changed.wait()
        if not self._rows or args.get("rows") is not True:
            return GraphRevision(revision=self._history.revision)
        rows = self._history.rows_since(known, self._core.state())
        return GraphRevision(revision=self._history.revision, core_uri=self._core.uri, rows=rows)


# --- the operations -------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
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

    name: str
    bridge: Bridge
    params: Params
    snapshots: SnapshotBuilder
    nodes: Nodes
    sites: SiteRequests

    def handlers(self) -> dict[str, Handler]:
        """The handlers of the operations of this class, for ``ControlServer``."""
        names = ("snapshot", "ping", "param", "followed", "agent", "contract", "node")
        return {"site": self.sites.answer, **{name: getattr(self, name) for name in names}}

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
        what, session = _request(args, transfer.QUESTIONS), self._session(args.get("peer", ""))
        inner: Args = {name: args[name] for name in ("key", "text") if name in args}
        return await self.bridge.rpc.request(session, what, inner, bridge_limits.PARAM_ASK_TIMEOUT)

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
        if peer is None and what == node_requests.INFO:
            return await self.nodes.info(args)
        if peer is None:
            return await asyncio.gather(*map(self._nodes_of, self.bridge.sessions.linked()))
        session = self._session(peer)
        if what == node_requests.LIST:
            return [await self._nodes_of(session)]
        request = {"node": str(args.get("node", "")), "by": OWN_NODE, "reason": "user request"}
        return await self.bridge.rpc.request(session, what, request, bridge_limits.NODE_KILL_TIMEOUT)

    async def _nodes_of(self, session: PeerSession) -> PeerNodes:
        """The nodes of a peer; where it does not answer, those of which this module has proxies."""
        peer = session.link.name
        try:
            value = await self.bridge.rpc.request(session, node_requests.LIST, {})
            return PeerNodes(peer=peer, nodes=msgspec.convert(value, tuple[NodeLine, ...]))
        except (RmpaError, msgspec.ValidationError) as error:
            nodes = tuple(NodeLine(name=node) for node, _ in session.proxies)
            return PeerNodes(peer=peer, nodes=nodes, problem=str(error))

    async def agent(self, args: Args) -> Any:
        """What the agent of a peer tells of itself: ``peer``, its name or GUID."""
        return await self.bridge.rpc.request(self._session(args.get("peer", "")), AGENT_INFO, {})

    def contract(self, args: Args) -> dict[str, ContractTerm]:
        """The terms that this module's settings give a ``topic`` of a ``type_name``, by key; it need not exist."""
        topic, type_name = str(args.get("topic", "")), str(args.get("type_name", ""))
        if not is_global_name(topic):
            raise ConfigError("topic", f"{topic!r} is not a topic", "write /name")
        return self.snapshots.topics.contract(topic, type_name)

    def _session(self, name: object) -> PeerSession:
        """The linked peer of a name or GUID.

        Raises:
            PeerRefused: Several peers have that name.
            UnreachableError: No such peer has it.
        """
        peer = str(name)
        sessions = list(self.bridge.sessions.linked())
        fitting = [s for s in sessions if peer in {s.link.name, str(s.link.guid), str(s.link.guid).partition("#")[0]}]
        if len(fitting) == 1:
            return fitting[0]
        if fitting:
            raise PeerRefused(
                self.name, f"{len(fitting)} peers are named {peer}", "name one by its GUID", code="several-fit"
            )
        similar = did_you_mean(peer, [session.link.name for session in sessions])
        remedy = "`rmpa peer list` shows which modules are there, and why one is not linked"
        raise UnreachableError("linked peer", repr(peer), f"did you mean {similar}?" if similar else remedy)


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


# All operations of the control socket, with the type of the value; ``object``: it depends on the arguments.
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
    "site": object,  # as ``QUESTIONS`` say
    "node": object,  # tuple[PeerNodes, ...] for lists, else as node_requests.REPLIES says
}


# --- the client's side of ``param`` -------------------------------------------------------------------------------


def parameters_in(key: str, value: XmlRpcValue) -> list[tuple[str, XmlRpcValue]]:
    """The parameters in a value, each with its name.

    Raises:
        RmpaError: A name in it is not a parameter's.
    """
    found = list(leaves(key, value))
    for name, one in found:
        if name == "/":
            raise RmpaError(f"the root can only be set to a dictionary, not to {one!r}")
        if problem := transfer.key_problem(name):
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

    @property
    def title(self) -> str:
        """The peer, for error texts."""
        return self.peer

    def get(self, key: str) -> XmlRpcValue:
        """A value, or a namespace.

        Raises:
            RmpaError: There is none, or the peer does not answer or refuses.
        """
        return self._value(transfer.GET, key=key)

    def names(self) -> list[str]:
        """The names of all parameters that may be read, in order; errors as for ``get``."""
        value = self._value(transfer.NAMES)
        return sorted(str(name) for name in value) if isinstance(value, list) else []

    def set(self, key: str, value: XmlRpcValue) -> int:
        """Set a parameter, or each member of a namespace; return the number. Errors as for ``get``."""
        parameters_in(key, value)
        try:
            text = serialize_response(value)
        except LocalProtocolError as error:
            raise RmpaError(f"{key}: {error}") from None
        if len(text) > bridge_limits.PARAM_TEXT_MAX:
            raise RmpaError(transfer.too_large(key, len(text)), code="limit-reached")
        return transfer.count_of(self._ask(transfer.SET, key=key, text=text.decode()))

    def delete(self, key: str) -> None:
        """Delete a parameter or namespace; errors as for ``get``."""
        self._ask(transfer.DELETE, key=key)

    def _value(self, what: str, **args: str) -> XmlRpcValue:
        return parse_response(transfer.text_of(self._ask(what, **args)).encode())

    def _ask(self, what: str, **args: str) -> object:
        try:
            return self.client.call("param", dict[str, Any], peer=self.peer, what=what, **args)
        except PeerRefused as error:
            raise RmpaError(
                error.reason, code=error.code
            ) from None  # this agent only passes on the answer of the peer's agent
