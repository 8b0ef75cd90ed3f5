"""The stages of a service's way, and what this agent knows of a topic and a service on theirs.

What this agent knows of a service on its path: for its own user, and for the agent at the other end.
"""

from __future__ import annotations

import asyncio
from dataclasses import dataclass
from itertools import chain
from typing import TYPE_CHECKING, Any, Final

import msgspec

from rmpa.bridge import limits
from rmpa.bridge.messages import Source
from rmpa.bridge.peer_offers import CONFLICT, DENIED
from rmpa.config import limits as config_limits
from rmpa.config.peer_rules import Access
from rmpa.config.values import did_you_mean
from rmpa.core.contract import Reliability
from rmpa.core.errors import RemoteProtocolError, RmpaError
from rmpa.core.identity import OWN_NODE, is_global_name, is_own
from rmpa.observe import limits as observe_limits
from rmpa.observe.peer_info import FAIL, OK, UNKNOWN, WARN, Check
from rmpa.observe.why.diagnosis import (
    PERMISSION_THERE,
    Diagnosis,
    ProxyState,
    PublisherReport,
    SubscriberConnection,
    TopicAtPublisher,
    TopicAtSubscriber,
    permission_here,
    permission_there,
    until_failure,
)
from rmpa.ros.node.service_client import ServiceConnection
from rmpa.ros.wire.tcpros import printable
from rmpa.runtime.loop import yielding_to_data

if TYPE_CHECKING:
    from collections.abc import Iterator

    from rmpa.bridge.bridge import Bridge
    from rmpa.bridge.services.imports import RemoteService
    from rmpa.bridge.services.part import Services
    from rmpa.bridge.sessions import PeerSession
    from rmpa.bridge.topics.imports import RemoteTopic
    from rmpa.observe.peer_info import PeerInfo
    from rmpa.observe.snapshot_builder import SnapshotBuilder
    from rmpa.ros.core.external import Core


# Why a service of a peer cannot be called here: the stages between the client and the server, in order.
#
# The stages::
#
#     peer ─ link ─ server ─ policy there ─ permission there ─ offer ─ shown (permission here) ─ graph ─ transport
#          ─ answer ─ calls


class ServiceAtServer(msgspec.Struct, frozen=True, kw_only=True):
    """What the server's agent knows of a service; its answer to ``why.service``.

    Attributes:
        node: The node of its module that provides the service; empty if none does.
        service: The service's name in its own graph.
        crosses: Whether the policy of its module lets it cross to the agent that asks.
        rule: The rule that says so.
        refusal: Why the server did not answer its own agent's probe, or empty.
        similar: A service of that module with nearly this name, or empty; ``near`` on the wire.
        permitted: Whether the permissions of its module let the module that asks call it; ``None``: trust is off
            there. If not, nothing else is told, also not whether there is such a service.
    """

    node: str = ""
    service: str = ""
    crosses: bool = True
    rule: str = ""
    refusal: str = ""
    similar: str = msgspec.field(default="", name="near")
    permitted: bool | None = None


@dataclass(frozen=True, slots=True)
class ServiceTransport:
    """How the nodes of a module call a service of a peer.

    Args:
        wanted: The transport that the module's rules ask for.
        address: Where they call the server directly; empty if the calls are relayed.
        condition: The condition of direct transport that does not hold, in one word; empty if none is known.
        problem: That condition's fact.
    """

    wanted: str = "relay"
    address: str = ""
    condition: str = ""
    problem: str = ""


@dataclass(frozen=True, slots=True)
class ServiceAtClient:
    """What the clients' agent knows of a service of one peer.

    Args:
        wire: Its name at the peer.
        offered: Whether the peer has offered it.
        node: Its node at the peer.
        hidden: Why it is not shown here, or empty.
        denied: Whether that is a permission.
        registered: Whether the local core sends clients to it.
        transport: How the nodes of this module call it.
        answer: The type and md5 sum that a probe brought; empty if it was refused.
        refusal: Why the probe was refused, or empty.
        calls: The number of calls from here.
        failed: The number of these calls that failed.
        problem: Why the last one failed, if it did not reach the server.
        mismatch: The error that a client with another definition received, or empty.
    """

    wire: str = ""
    offered: bool = False
    node: str = ""
    hidden: str = ""
    denied: bool = False
    registered: bool = False
    transport: ServiceTransport = ServiceTransport()
    answer: str = ""
    refusal: str = ""
    calls: int = 0
    failed: int = 0
    problem: str = ""
    mismatch: str = ""


_NOTHING: Final = ServiceAtClient()


def diagnose_service(
    begin: tuple[Check, ...],
    to: str,
    peer: str,
    service: str,
    here: ServiceAtClient = _NOTHING,
    there: ServiceAtServer | None = None,
    refusal: str = "",
) -> Diagnosis:
    """Judge all stages.

    Args:
        begin: The stages of the peer and its link.
        to: This module.
        peer: The module that should provide it.
        service: Its name here.
        here: What is known here.
        there: What the peer's agent answered; ``None`` if it did not.
        refusal: Why the peer's agent did not answer.
    """
    stages = until_failure(chain(begin, _stages(peer, service, to, here, there, refusal)))
    node = (there.node if there is not None else "") or here.node
    return Diagnosis.of(stages, kind="service", name=service, peer=peer, to=to, node=node)


def _stages(
    peer: str, service: str, to: str, here: ServiceAtClient, there: ServiceAtServer | None, refusal: str
) -> Iterator[Check]:
    yield from _at_server(peer, here.wire or service, to, here, there, refusal)
    if not here.offered:
        remedy = (
            f"if it stays so for more than {limits.RECONCILE_INTERVAL:g} s, it is a bug of ours: both logs, please"
        )
        yield Check("offer", FAIL, f"the offer of {peer} has not come here", remedy)
    yield Check("offer", OK, f"{peer} offers it")
    if here.denied:
        yield permission_here(peer, Access.SERVE, service, here.hidden)
    if here.hidden:
        yield Check("shown", FAIL, f"it is not shown here: {here.hidden}", _unhide(here.hidden))
    was = f" (its {here.wire})" if here.wire not in ("", service) else ""
    yield Check("shown", OK, f"it is {service} here{was}")
    if not here.registered:
        remedy = f"it is put there again within {limits.RECONCILE_INTERVAL:g} s; if not, the agent's log says why"
        yield Check("graph", FAIL, "the local core does not have it", remedy)
    yield Check("graph", OK, "the local core sends clients to it")
    yield _transport(peer, here.transport)
    yield _answer(peer, here)
    yield _calls(here)


def _at_server(
    peer: str, wire: str, to: str, here: ServiceAtClient, there: ServiceAtServer | None, refusal: str
) -> Iterator[Check]:
    if there is None:
        level = UNKNOWN if here.offered else FAIL
        yield Check("server", level, f"{peer} does not tell ({refusal})", f"ask on {peer}: rosservice info {wire}")
        return
    if there.permitted is False:
        yield permission_there(peer, to, Access.CALL, wire)
    if not there.node:
        remedy = (
            f"did you mean {there.similar}?"
            if there.similar
            else f"start its server there (on {peer}: rosservice list)"
        )
        yield Check("server", FAIL, f"no node of {peer} provides {wire}", remedy)
    was = f" as {there.service}" if there.service not in ("", wire) else ""
    if there.refusal:
        text = f"{there.node} on {peer} is registered for it, and does not answer: {there.refusal}"
        yield Check("server", FAIL, text, f"is it stopped, or dead? on {peer}: rosnode ping {there.node}")
    yield Check("server", OK, f"{there.node} on {peer} provides it{was}")
    if not there.crosses:
        remedy = f"change [services] or [[peer]] in the rmpa.toml of {peer}, and `rmpa reload` there"
        yield Check("policy there", FAIL, f"{peer} keeps it at home: {there.rule}", remedy)
    yield Check("policy there", OK, f"{peer} lets it cross: {there.rule}")
    if there.permitted:
        yield Check(PERMISSION_THERE, OK, f"{peer} lets {to} call it")


def _unhide(hidden: str) -> str:
    if hidden.startswith("policy"):
        return "change [services] or [[peer]] in this module's rmpa.toml, and `rmpa reload`"
    return "a graph has one provider for each service; give one of them another name (prefix or remap_in of [[peer]])"


def _transport(peer: str, found: ServiceTransport) -> Check:
    if found.address:
        return Check("transport", OK, f"direct: clients call the server itself, at {found.address}")
    if found.wanted == "relay":
        return Check("transport", OK, 'relayed by both agents: transport is "relay" here')
    if not found.condition:
        return Check("transport", OK, f"relayed by both agents; {peer} is being asked for direct calls")
    if found.wanted == "direct" and found.condition != "transport":
        text = f'relayed although transport is "direct" ({found.condition}): {found.problem}'
        return Check("transport", WARN, text, "docs/services.md says what each condition needs")
    return Check("transport", OK, f"relayed by both agents ({found.condition}): {found.problem}")


def _answer(peer: str, here: ServiceAtClient) -> Check:
    if here.answer:
        return Check("answer", OK, f"its server answers: {here.answer}")
    return Check(
        "answer", FAIL, here.refusal or "no answer", f"is the server on {peer} alive? its node's log may tell"
    )


def _calls(here: ServiceAtClient) -> Check:
    text = f"{here.calls} from here, {here.failed} of them failed"
    if here.transport.address:
        text = f"{text}; direct ones are not counted"
    if here.mismatch:
        return Check("calls", WARN, here.mismatch, "build both sides with one version of the service")
    if here.problem:
        return Check("calls", WARN, f"{text}; the last time: {here.problem}", "docs/services.md")
    return Check("calls", OK, text)


# What this agent knows of a topic on its path: for its own user, and for the agent at the other end.


class TopicEvidence:
    """Reads what the rooms know of one topic; changes nothing.

    Args:
        core: The agent's ROS core.
        bridge: Its bridge.
        snapshots: Its snapshots.
    """

    def __init__(self, core: Core, bridge: Bridge, snapshots: SnapshotBuilder) -> None:
        self._core = core
        self._bridge = bridge
        self._snapshots = snapshots

    def own(self, topic: str) -> dict[str, str]:
        """The module's own publishers of a topic, and their addresses."""
        return {node: uri for node, uri in self._core.publishers(topic).items() if not is_own(node)}

    def there(self, peer: str, topic: str) -> tuple[str, str]:
        """The names of a topic of a peer here and at the peer.

        A user may write either: a name that no topic of the peer can have here is taken for the peer's own.
        """
        names = self._bridge.context.names.of(peer)
        wires = names.wires_of(topic)
        return (topic, wires[0]) if wires else (names.local_name(topic), topic)

    def here(self, session: PeerSession | None, peer: PeerInfo | None, topic: str) -> TopicAtSubscriber:
        """What is known here of a topic that a peer publishes.

        Args:
            session: The session whose link carries it, if one does.
            peer: The module of its publishers.
            topic: Its name here.
        """
        snapshot = self._snapshots.build(frozenset({topic}))
        if session is None or peer is None:
            return TopicAtSubscriber(snapshot, topic)
        proxies = {}
        publishers, standing = self._core.publishers(topic), dict(session.proxies)
        for number, source in list(self._bridge.topics.imports.at(topic)):
            entry = self._bridge.topics.imports.get(number, source)
            if number != session.peer or entry is None:
                continue
            if (entry.origin.instance if entry.origin else session.link.identity.instance.hex()) != peer.instance:
                continue
            node = source.node
            name = session.proxies.name(node)
            proxies[node] = ProxyState(
                name=name,
                permission=self._permission(session.link.name, entry),
                denied=entry.cause == DENIED,
                registered=node in standing and publishers.get(name) == standing[node].uri,
                conflict=entry.cause == CONFLICT,
                connections=self._connections(session, source),
                mismatches=self._bridge.topics.mismatches(source),
            )
        return TopicAtSubscriber(snapshot, topic, session.link.name, proxies)

    def _permission(self, peer: str, entry: RemoteTopic) -> str:
        """The rule about which modules may publish a peer's topic; empty if trust is off."""
        gate = self._bridge.gate
        if not gate.on:
            return ""
        module, relay = (peer, "") if entry.origin is None else (entry.origin.name, peer)
        return gate.judge(Access.PUBLISH, module, entry.topic, relay=relay).rule

    def _connections(self, session: PeerSession, source: Source) -> tuple[SubscriberConnection, ...]:
        publication = self._bridge.topics.of(session).publication(source)
        return tuple(
            SubscriberConnection(
                number=link.number,
                node=printable(link.other),
                held=not link.connected,
                messages=link.messages,
                waiting=link.waiting,
                dropped=link.dropped,
            )
            for link in (publication.connections() if publication is not None else ())
        )

    async def answer(self, session: PeerSession, args: dict[str, Any]) -> TopicAtPublisher:
        """The reply to ``why.topic``.

        Args:
            session: The peer that asks.
            args: ``topic``: its name on the wire; ``instance``: the instance id of its module, if this module only
                relays it.
        """
        wire = name_in(args, "topic")
        instance = args.get("instance") or ""
        asker = session.link.name
        names = self._bridge.context.names.of(asker)
        state = self._core.state()
        sources: list[PublisherReport] = []
        subscribers: list[str] = []
        topics = [topic for topic in names.locals_of(wire) if self._may_know(asker, topic)]
        if not topics:
            return TopicAtPublisher(permitted=False)
        for topic in topics:
            nodes = self._relayed(topic, instance) if instance else list(self.own(topic))
            sources += [self._report(session, Source(topic, node)) for node in nodes]
            subscribers += [node for node in state.subscribers.get(topic, {}) if not is_own(node)]
        return TopicAtPublisher(
            sources=tuple(sources[: observe_limits.WHY_SOURCES_MAX]),
            subscribers=tuple(subscribers[: observe_limits.WHY_SOURCES_MAX]),
            similar="" if sources else await self._similar(session.link.name, wire),
            permitted=True if self._bridge.gate.on else None,
        )

    def _may_know(self, asker: str, topic: str) -> bool:
        """Whether a peer may subscribe to a topic, and so be told of it."""
        return self._bridge.gate.judge(Access.SUBSCRIBE, asker, topic).allowed

    async def _similar(self, asker: str, wire: str) -> str:
        """The topic of this module whose name on the wire is most like this one; empty if none is."""
        names, state = self._bridge.context.names.of(asker), self._core.state()
        known = {
            names.wire_name(topic)
            for topic, nodes in yielding_to_data(list(state.publishers.items()))
            if not all(map(is_own, nodes)) and self._may_know(asker, topic)
        }
        # In a thread: comparing thousands of names takes longer than a message may wait.
        return await asyncio.to_thread(did_you_mean, wire, known) or ""

    def _relayed(self, topic: str, instance: object) -> list[str]:
        """The proxies of the nodes of a module whose topic this one relays."""
        offered = self._bridge.topics.exports.offered
        return [
            node
            for node in self._core.publishers(topic)
            if (local := offered.get(Source(topic, node))) is not None
            and local.origin is not None
            and local.origin.instance == instance
        ]

    def _report(self, session: PeerSession, source: Source) -> PublisherReport:
        exports = self._bridge.topics.exports
        local = exports.seen.get(source)
        kind = local.type if local is not None else self._core.type_of(source.topic)
        decision = exports.decision(session.peer, source)
        if decision is None:  # it has just come, or cannot be reached
            decision = self._bridge.context.policy.judge(source.topic, kind, source.node)
        flow = self._bridge.topics.outbound.flows.get(source)
        numbering = self._bridge.topics.outbound.numbering(source, session.peer)
        contract = exports.contract(source, session.peer)
        reliable = contract is not None and contract.reliability is Reliability.RELIABLE
        return PublisherReport(
            node=source.node,
            topic=source.topic,
            type=kind,
            crosses=decision.allowed,
            rule=decision.rule,
            offered=exports.offer(session.peer, source) is not None,
            route="open" if session.peer in exports.flowing(source) else "opening" if contract is not None else "",
            messages=flow.messages if flow is not None else 0,
            dropped=flow.dropped if flow is not None and not reliable else 0,
            lost=numbering.lost if numbering is not None else 0,
            oversized=flow.oversized if flow is not None else 0,
            oversized_bytes=flow.oversized_bytes if flow is not None else 0,
            beyond=exports.limit if source in exports.beyond else 0,
            unreachable="" if flow is not None and flow.messages else self._unreachable(source.node),
        )

    def _unreachable(self, node: str) -> str:
        found = self._core.unreachable().get(node)
        return f"{found.api}: {found.problem}" if found is not None else ""


def name_in(args: dict[str, Any], key: str) -> str:
    """The argument ``key`` of a peer's request, a ROS name.

    Raises:
        RemoteProtocolError: It is not a ROS name.
    """
    name = args.get(key)
    if not isinstance(name, str) or len(name) > config_limits.CROSSING_NAME_MAX or not is_global_name(name):
        raise RemoteProtocolError(f"the question names no {key}")
    return name


class ServiceEvidence:
    """Reads what the rooms know of one service, and probes servers; changes nothing.

    Args:
        core: The agent's ROS core.
        bridge: Its bridge.
        services: The bridge's part for services.
    """

    def __init__(self, core: Core, bridge: Bridge, services: Services) -> None:
        self._core = core
        self._bridge = bridge
        self._services = services

    def known(self, service: str) -> bool:
        """Whether a peer offers a service; ``service`` is its name here."""
        return any(remote.name == service for _, remote in self._services.imports)

    def offers(self, session: PeerSession, service: str, instance: str) -> bool:
        """Whether a link carries a service of the module with this instance id: the peer's own, or a relayed one."""
        remote = self._services.imports.get(session.peer, service)
        if remote is None:
            return False
        return (remote.origin.instance if remote.origin else session.link.identity.instance.hex()) == instance

    async def nowhere(self, here: str, service: str, linked: list[str]) -> Diagnosis:
        """The diagnosis of a service that no peer has."""
        state = self._core.state()
        own = [node for node in state.services.get(service, {}) if not is_own(node)]
        similar = await asyncio.to_thread(did_you_mean, service, {*state.services})
        text = f"no linked peer ({', '.join(linked) or 'there is none'}) provides {service}"
        remedy = (
            f"did you mean {similar}?" if similar else "`rosservice list` and `rmpa peer list` show what there is"
        )
        if own:
            text = f"{own[0]} of this module provides {service}; clients here call it without us"
            remedy = f"whether another module may call it: `rmpa why {here}:{service}` over there"
        stage = Check("server", OK if own else FAIL, text, remedy)
        return Diagnosis.of((stage,), kind="service", name=service, peer="", to=here)

    async def here(self, session: PeerSession, service: str, wire: str) -> ServiceAtClient:
        """What is known here of a service of a peer; its proxy is probed as a client would."""
        remote = self._services.imports.get(session.peer, service)
        if remote is None:
            return ServiceAtClient(wire=wire)
        shown = self._services.shown(remote)
        hidden, cause = self._services.imports.why_hidden(remote)
        if shown is None or shown.proxy is None:
            return ServiceAtClient(wire=wire, offered=True, node=remote.node, hidden=hidden, denied=cause == DENIED)
        uri = self._core.state().services.get(service, {}).get(shown.proxy.name, "")
        answer, refusal = await _probe(uri, service) if uri else ("", "")
        return ServiceAtClient(
            wire=wire,
            offered=True,
            node=remote.node,
            hidden=hidden,
            registered=bool(uri),
            transport=self._transport(remote),
            answer=answer,
            refusal=refusal,
            calls=shown.stats.calls,
            failed=shown.stats.failed,
            problem=shown.stats.problem,
            mismatch=shown.mismatch,
        )

    def _transport(self, remote: RemoteService) -> ServiceTransport:
        direct, wanted = self._services.direct_imports, self._bridge.context.services.transport(remote.name)
        address, unmet = direct.address(remote.peer, remote.name), direct.unmet(remote)
        if address:
            return ServiceTransport(wanted, address)
        if unmet is None:
            return ServiceTransport(wanted)
        return ServiceTransport(wanted, condition=unmet.condition, problem=unmet.text)

    async def answer(self, session: PeerSession, args: dict[str, Any]) -> ServiceAtServer:
        """The reply to ``why.service``; the server is probed.

        Args:
            session: The peer that asks.
            args: ``service``: its name on the wire.
        """
        wire = name_in(args, "service")
        peer = session.link.name
        seen, gate = self._services.exports.seen, self._bridge.gate
        services = self._bridge.context.names.of(peer).locals_of(wire)
        services = tuple(service for service in services if gate.judge(Access.CALL, peer, service).allowed)
        if not services:
            return ServiceAtServer(permitted=False)
        for service in services:
            server = seen.get(service)
            if server is None:
                for node in self._core.state().services.get(service, {}):
                    if (found := self._core.unreachable().get(node)) is not None:
                        refusal = f"it cannot be reached at {found.api} ({found.problem})"
                        return ServiceAtServer(node=node, service=service, refusal=refusal)
                continue
            decision = self._services.exports.decision(session.peer, service)
            _, refusal = await _probe(server.uri, service)
            return ServiceAtServer(
                node=server.node,
                service=service,
                crosses=decision is None or decision.allowed,
                rule=decision.rule if decision is not None else "",
                refusal=refusal,
                permitted=True if gate.on else None,
            )
        known = {
            self._bridge.context.services.wire_name(peer, service)
            for service in yielding_to_data(list(seen))
            if gate.judge(Access.CALL, peer, service).allowed
        }
        # In a thread: comparing thousands of names takes longer than a message may wait.
        similar = await asyncio.to_thread(did_you_mean, wire, known)
        return ServiceAtServer(similar=similar or "")


async def _probe(uri: str, service: str) -> tuple[str, str]:
    """A server's description of its service, and why there is none; asked as ``rospy.wait_for_service`` does."""
    try:
        found = await ServiceConnection.open(
            uri, service, OWN_NODE, probe=True, persistent=False, timeout=observe_limits.WHY_PROBE
        )
    except RmpaError as error:
        return "", str(error)
    found.close()
    return f"{found.description.type}, md5 {found.description.md5sum}", ""
