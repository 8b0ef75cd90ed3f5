"""The peers in the snapshot, the parameters of their modules, and questions about other sites.

The peers' part of the snapshot: what discovery, mesh and bridge know of each.
"""

from __future__ import annotations

import asyncio
from collections import Counter
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any, Final, Protocol

import msgspec

from rmpa.bridge import limits as bridge_limits
from rmpa.bridge.params import rules as transfer
from rmpa.bridge.params.rules import key_problem
from rmpa.bridge.policy import OPEN_GATE, Needs, PermissionGate
from rmpa.bridge.rpc import UNKNOWN_QUESTION
from rmpa.config.peer_rules import Access
from rmpa.core.errors import ConfigError, LocalProtocolError, PeerRefused, RmpaError, UnreachableError
from rmpa.discovery import limits as discovery_limits
from rmpa.observe.peer_info import FOREIGN, BoundInfo, LaneInfo, LinkInfo, PeerInfo
from rmpa.observe.topics_section import direct_counts
from rmpa.ros.master.parameters import leaves
from rmpa.ros.wire.xmlrpc import parse_response, serialize_response
from rmpa.runtime.loop import SystemClock, yield_to_data, yielding_to_data
from rmpa.trust.permissions import not_of_this_mesh

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable, Collection, Iterable, Iterator, Mapping, Sequence

    from rmpa.bridge.bridge import Bridge, TwinWatch
    from rmpa.bridge.rpc import PeerRpc
    from rmpa.bridge.services.part import Services
    from rmpa.bridge.sessions import PeerSession
    from rmpa.core.identity import Identity
    from rmpa.discovery.discovery import Discovery, Stranger
    from rmpa.discovery.endpoints import PeerView
    from rmpa.mesh.io.lane import LaneSender
    from rmpa.mesh.io.link import PeerLink
    from rmpa.mesh.io.mesh import Mesh
    from rmpa.mesh.peering import Peer
    from rmpa.observe.control_client import ControlClient
    from rmpa.ros.wire.xmlrpc import XmlRpcValue
    from rmpa.runtime.stream import Stream


# The parameters of a peer's module, read and written through this machine's agent.


def parameters_in(key: str, value: XmlRpcValue) -> list[tuple[str, XmlRpcValue]]:
    """The parameters in a value, each with its name.

    Raises:
        RmpaError: A name in it is not a parameter's.
    """
    found = list(leaves(key, value))
    for name, one in found:
        if name == "/":
            raise RmpaError(f"the root can only be set to a dictionary, not to {one!r}")
        if problem := key_problem(name):
            raise RmpaError(problem)
    return found


@dataclass
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
            raise RmpaError(transfer.too_large(key, len(text)))
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
            raise RmpaError(error.reason) from None  # this agent only passes on the answer of the peer's agent


# Finds peers that share an IP address with another machine.
#
# Each agent has a mesh port of its own, so the GUIDs of two machines with one address differ, and the roster takes
# them
# for two agents of one machine. TCP shows the difference: the beacons of both arrive, because multicast needs no
# reply,
# but connections to the address reach only one machine, and it refuses the other machine's port.


def mark_shared_addresses(peers: Sequence[PeerInfo], own: Collection[str]) -> tuple[PeerInfo, ...]:
    """Set the state ``conflict`` for peers whose address seems to be another machine's too.

    Args:
        peers: All peers.
        own: This machine's addresses.

    Returns:
        The same peers in the same order.
    """
    holders: dict[str, list[PeerInfo]] = {}
    for peer in peers:
        holders.setdefault(_address(peer), []).append(peer)
    return tuple(_marked(peer, holders[_address(peer)], own) if _unreachable_by_tcp(peer) else peer for peer in peers)


def _address(peer: PeerInfo) -> str:
    return peer.guid.rpartition(":")[0]


def _unreachable_by_tcp(peer: PeerInfo) -> bool:
    """Whether its beacons arrive though TCP has not reached it for ``limits.ADDRESS_SHARED_AFTER``."""
    return (
        peer.state == "linking"
        and peer.since_ago >= discovery_limits.ADDRESS_SHARED_AFTER
        and peer.beacon_ago is not None
        # An agent that was killed sends no beacons after its link has fallen.
        and peer.beacon_ago < peer.since_ago - discovery_limits.ADDRESS_SHARED_MARGIN
        and not _address(peer).startswith("127.")
    )


def _marked(peer: PeerInfo, holders: Sequence[PeerInfo], own: Collection[str]) -> PeerInfo:
    address = _address(peer)
    others = [f"peer {other.name}" for other in holders if other is not peer]
    if address in own:
        others.append("this machine")
    if not others:
        return peer
    port = peer.guid.partition("#")[0].rpartition(":")[2]
    text = (
        f"its address {address} is also that of {' and '.join(others)}, and its port {port} does not answer there: "
        "two machines seem to have one address; give one of them another (was an image copied with its address?), "
        f"or, if both run on one machine, open port {port} in its firewall"
    )
    return msgspec.structs.replace(peer, state="conflict", conflicts=(*peer.conflicts, text))


# Questions about other sites: a gateway answers them; another agent asks the gateways that it is linked to.


REPORT: Final = "site.report"
"""The request for a ``SitesReport`` without sources."""
INFO: Final = "site.info"
"""The request for a ``SitesReport`` of one site with its sources: ``{site}``."""
PARAM: Final = "site.param"
"""A request about parameters (``bridge.params.rules``) to a module: ``{site, module, what, key, text}``."""
WHY: Final = "site.why"
"""The request for the ways of a topic or a service through gateways: ``{name, site, module, service}``."""
_ALL: Final = (REPORT, WHY)
"""Those that every gateway answers for itself."""
QUESTIONS: Final = (REPORT, INFO, PARAM, WHY)
_SOURCES: Final = Needs(
    (Access.SUBSCRIBE, Access.CALL),
    "each topic and service; of this site the asking module's own alone. Sites and modules are named to all",
)
_PARAM: Final = Needs(
    (Access.PARAM,),
    "as `param.get` and its like, by this gateway, the other site's and the owner. None of this site",
)
_WAYS: Final = Needs(
    (Access.SUBSCRIBE, Access.CALL), "the topic or service, by its name here; what leaves is the asking module's own"
)


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
        rpc: Carries requests between the modules.
        linked: Returns the sessions of the peers that are linked now.
        gate: Decides which peers are believed about other sites.
    """

    def __init__(
        self, rpc: PeerRpc, linked: Callable[[], Iterable[PeerSession]], gate: PermissionGate = OPEN_GATE
    ) -> None:
        self._gate = gate
        self._rpc = rpc
        self._linked = linked
        self._gateway: SiteAnswerer | None = None
        self._liked: dict[str, str] = {}
        """The gateway that answered for a site, by its GUID."""

    @property
    def answerer(self) -> SiteAnswerer | None:
        """What answers as a gateway; ``None``: this agent is none."""
        return self._gateway

    def serve(self, gateway: SiteAnswerer) -> None:
        """Answer as a gateway from now on."""
        self._gateway = gateway
        rpc = self._rpc
        rpc.on_request(REPORT, partial(self._answer_peer, gateway, REPORT), _SOURCES)
        rpc.on_request(INFO, partial(self._answer_peer, gateway, INFO), _SOURCES)
        rpc.on_request(PARAM, partial(self._answer_peer, gateway, PARAM), _PARAM)
        rpc.on_request(WHY, partial(self._answer_peer, gateway, WHY), _WAYS)

    async def answer(self, args: dict[str, Any]) -> Any:
        """The operation ``site``: ``what`` (one of ``QUESTIONS``) and its ``args``.

        ``site.report`` and ``site.why`` return a list with the answers of all gateways; the others one answer.
        """
        what, inner = args.get("what"), args.get("args")
        if what not in QUESTIONS or not isinstance(inner, dict):
            raise ConfigError("what", f"{what!r} is no question about sites")
        return await (self.all(what, inner) if what in _ALL else self.one(what, inner))

    async def all(self, what: str, args: dict[str, Any]) -> list[Any]:
        """The answers of all gateways; those that fail are left out."""
        if self._gateway is not None:
            return [await self._gateway.answer(what, args)]
        sessions = self._believed()
        # Twice the time: the gateway itself asks the other site for so long.
        wait = 2 * bridge_limits.ASK_TIMEOUT
        found = await asyncio.gather(*(self._ask(session, what, args, wait) for session in sessions))
        return [value for value, error in found if error is None]

    async def one(self, what: str, args: dict[str, Any]) -> Any:
        """The answer of the first gateway that has one.

        Raises:
            UnreachableError: This module is linked to no gateway.
            RmpaError: No gateway has an answer; the text is that of the one that knew most.
        """
        if self._gateway is not None:
            return await self._gateway.answer(what, args)
        site = str(args.get("site", ""))
        sessions = sorted(self._believed(), key=lambda each: str(each.link.guid) != self._liked.get(site))
        problem: RmpaError | None = None
        for session in sessions:
            value, error = await self._ask(session, what, args, bridge_limits.PARAM_ASK_TIMEOUT)
            if error is None:
                self._liked[site] = str(session.link.guid)
                return value
            if not _is_no_gateway(error):
                problem = problem or error
        self._liked.pop(site, None)
        if isinstance(problem, PeerRefused):
            raise PeerRefused(problem.peer, problem.reason, problem.remedy)
        if problem is not None:
            raise problem
        raise UnreachableError(
            "gateway",
            "any linked peer",
            "start one with `rmpa gateway`; `rmpa peer list` shows the links. In a secured mesh "
            "`relays` of [trust] names the gateways that are believed",
        )

    def _believed(self) -> list[PeerSession]:
        """The linked peers whose word about other sites counts: any member could answer as a gateway."""
        return [session for session in self._linked() if self._gate.may_relay(session.link.name)]

    @staticmethod
    def _answer_peer(gateway: SiteAnswerer, what: str, asker: PeerSession, args: dict[str, Any]) -> Awaitable[object]:
        return gateway.answer(what, args, asker.link.name)

    async def _ask(
        self, session: PeerSession, what: str, args: dict[str, Any], wait: float
    ) -> tuple[Any, RmpaError | None]:
        try:
            return await self._rpc.request(session, what, args, wait), None
        except RmpaError as error:
            return None, error


def _is_no_gateway(error: RmpaError) -> bool:
    return isinstance(error, PeerRefused) and UNKNOWN_QUESTION in error.reason


_DENY: Final = {"services": "services.deny"}
"""The setting that denies things of a kind, where it is not ``bridge.deny``."""


class EndpointView(Protocol):
    """What the snapshot needs of the agent's place in the network (``agent.network.NetworkEndpoint``)."""

    identity: Identity
    mesh: Mesh
    discovery: Discovery


class PeersSection:
    """Reads what is known of peers; changes nothing.

    Args:
        bridge: The agent's bridge.
        services: Its part for services.
        twins: Its part for peers of this module's kind.
    """

    def __init__(self, bridge: Bridge, services: Services, twins: TwinWatch) -> None:
        self._bridge = bridge
        self._services = services
        self._twins = twins
        self._clock = SystemClock()

    def infos(self, endpoint: EndpointView) -> tuple[PeerInfo, ...]:
        """Every peer that is known, by name, and behind them the modules that are not of this mesh."""
        now = self._clock.now()
        links = {session.link.guid: session for session in self._bridge.sessions.linked()}
        yield_to_data()  # a millisecond each with a full roster
        roster = {view.run.identity.guid: view for view in endpoint.discovery.peers()}
        yield_to_data()
        statuses = {status.identity.guid: status for status in endpoint.mesh.peers()}
        infos = []
        for guid in {*roster, *statuses, *links}:
            yield_to_data()
            session = links.get(guid)
            info = self._peer(roster.get(guid), statuses.get(guid), session, now)
            if session is not None:
                info = msgspec.structs.replace(info, link=self._link(session.link, now))
                theirs = len(self._bridge.topics.imports.offered_by(session.peer))
                ours = self._bridge.topics.exports.topics_for(session.peer)
                yield_to_data()
                beyond = self._beyond(session)
                to_it, from_it = direct_counts(self._bridge, session.peer)
                info = msgspec.structs.replace(
                    info,
                    topics_in=theirs,
                    topics_out=ours,
                    conflicts=(*info.conflicts, *filter(None, (self._twins.problem(session),))),
                    beyond=beyond,
                    direct_in=to_it,
                    direct_out=from_it,
                )
            infos.append(info)
        relayed = self._relayed({info.instance: info for info in infos})
        infos = [info for info in infos if info.instance not in {one.instance for one in relayed}] + relayed
        own = {str(address) for address in (endpoint.identity.guid.address, *endpoint.identity.addresses)}
        strangers = endpoint.discovery.strangers()
        infos += [_stranger(one, now) for one in strangers if one.identity.guid not in {*roster, *statuses, *links}]
        infos.sort(key=lambda info: (info.state == FOREIGN, info.name, info.guid))
        return mark_shared_addresses(infos, own)

    def _beyond(self, session: PeerSession) -> tuple[BoundInfo, ...]:
        """What of a peer this module refuses because of its limits."""
        topics, services = self._bridge.topics.imports, self._services.imports
        most, peer, name = self._bridge.context.settings.limits, session.peer, session.link.name
        there, here = topics.refused_nodes(peer), services.refused_nodes(peer)
        counts = (
            (len(there.keys() | here.keys()), "nodes", most.nodes),
            (topics.refused(peer), "topics", most.topics),
            (services.refused(peer), "services", most.services),
        )
        further = [
            f"{count} {kind}"
            for kind, count in (("topics", sum(map(len, there.values()))), ("services", sum(map(len, here.values()))))
            if count
        ]
        found = []
        for hidden, kind, limit in counts:
            what = " with ".join((_count(hidden, kind), *([" and ".join(further)] if kind == "nodes" else ())))
            text = f"{what} of {name} stay hidden here: it has more than limits.{kind} = {limit} of this module; "
            found.append(BoundInfo(kind=kind, limit=limit, hidden=hidden, text=text + _remedy(kind)))
        return tuple(one for one in found if one.hidden)

    def _relayed(self, known: Mapping[str, PeerInfo]) -> list[PeerInfo]:
        """Modules without a link whose topics a relay passes on; the membership may know them too."""
        infos, shown = [], set()
        for _, _, entry in yielding_to_data(list(self._bridge.topics.imports)):
            if entry.origin is not None and entry.shown:
                shown.add((entry.origin.instance, entry.topic))
        counts = Counter(instance for instance, _ in shown)
        for origin, via in self._bridge.topics.imports.ways:
            blank = PeerInfo(name=origin.name, guid=origin.guid, instance=origin.instance, state="", since_ago=0.0)
            info = known.get(origin.instance, blank)
            topics = counts[origin.instance]
            infos.append(msgspec.structs.replace(info, state="relayed", via=via, topics_in=topics))
        return infos

    def _peer(self, view: PeerView | None, status: Peer | None, session: PeerSession | None, now: float) -> PeerInfo:
        run = view.run if view is not None else None
        identity = (run or status or session.link).identity  # type: ignore[union-attr] # one of the three is there
        conflicts = view.conflicts if view is not None else ()
        unlinked = status.since if status is not None and status.since is not None else run.since if run else now
        if session is not None:
            state, since = "linked", session.link.since or now
        elif status is not None and status.foreign is not None:
            state, since = FOREIGN, unlinked
        elif view is not None and not view.present:
            state, since = "conflict", view.run.since
        elif status is not None and status.state == "refused":
            state, since = "refused", unlinked
        else:
            state, since = "linking", unlinked
        next_attempt = status.next_attempt if status is not None else None
        last_error = status.last_error if status is not None else ""
        if status is not None and status.foreign is not None:
            last_error, next_attempt = not_of_this_mesh(status.foreign), None
        return PeerInfo(
            name=identity.name,
            guid=str(identity.guid),
            instance=identity.instance.hex(),
            state=state,
            since_ago=max(0.0, now - since),
            addresses=tuple(f"{host}:{port}" for host, port in identity.endpoints),
            found_ago=now - run.since if run else None,
            beacon_ago=now - run.heard if run else None,
            source=run.found_by if run else "link",
            last_error=last_error,
            next_attempt=max(0.0, next_attempt - now) if next_attempt is not None else None,
            conflicts=conflicts,
        )

    @staticmethod
    def _link(link: PeerLink, now: float) -> LinkInfo:
        host, port = link.remote_endpoint
        return LinkInfo(
            remote=f"{host}:{port}",
            dialled=link.dialled,
            up_ago=now - (link.since or now),
            rtt=link.connection.clock.rtt,
            clock_offset=link.clock_offset,
            clock_error=link.clock_error,
            bytes_in=link.bytes_in,
            bytes_out=link.bytes_out,
            queued=link.queue_bytes,
            dropped=link.dropped,
            heard_ago=now - link.heard_at,
            rests=link.rests,
            lease=link.connection.keepalive.remote_lease,
            lanes=(
                _lane(link.express, link.connection.stream),
                msgspec.structs.replace(
                    _lane(link.bulk, link.bulk_connection.stream if link.bulk_connection is not None else None),
                    unneeded=not link.bulk_wanted,
                ),
            ),
        )


def _stranger(one: Stranger, now: float) -> PeerInfo:
    identity = one.identity
    return PeerInfo(
        name=identity.name,
        guid=str(identity.guid),
        instance=identity.instance.hex(),
        state=FOREIGN,
        since_ago=now - one.since,
        addresses=tuple(f"{host}:{port}" for host, port in identity.endpoints),
        found_ago=now - one.since,
        beacon_ago=now - one.heard,
        last_error=one.problem,
    )


def _lane(lane: LaneSender, stream: Stream | None) -> LaneInfo:
    """A lane of a link; ``stream`` is that of its connection, while it has one."""
    return LaneInfo(
        name=lane.name,
        connected=stream is not None,
        bytes_in=stream.bytes_in if stream is not None else 0,
        bytes_out=stream.bytes_out if stream is not None else 0,
        queued=stream.pending_bytes if stream is not None else lane.outbox.pending_bytes,
        dropped=lane.outbox.dropped.total(),
    )


def own_bounds(bridge: Bridge, services: Services) -> Iterator[str]:
    """What this module offers to no peer because of its limits, ready to read."""
    most = bridge.context.settings.limits
    for hidden, kind, limit in (
        (len(bridge.topics.exports.beyond), "topics", most.topics),
        (len(services.exports.beyond), "services", most.services),
    ):
        if hidden:
            which = f"{_count(hidden, kind)} of this module are offered to no peer"
            yield f"{which}: more than limits.{kind} = {limit}; {_remedy(kind)}"


def _count(hidden: int, kind: str) -> str:
    return f"{hidden} {kind if hidden > 1 else kind[:-1]}"


def _remedy(kind: str) -> str:
    return f"raise it in rmpa.toml and `rmpa reload`, or deny some by {_DENY.get(kind, 'bridge.deny')}"
