"""Answers ``rmpa why``: gathers what this agent knows, asks the agent at the other end, and has both judged."""

from __future__ import annotations

import asyncio
import contextlib
from typing import TYPE_CHECKING, Any, Final, TypeVar

import msgspec

from rmpa.bridge import limits
from rmpa.bridge.policy import Needs
from rmpa.config import limits as config_limits
from rmpa.config.peer_rules import Access
from rmpa.config.values import did_you_mean
from rmpa.core.errors import ConfigError, RemoteProtocolError, RmpaError
from rmpa.core.facts import DENIED, Arrival, PublisherReport
from rmpa.core.identity import OWN_NODE, is_global_name, is_own
from rmpa.observe import limits as observe_limits
from rmpa.observe.check import FAIL, OK, Check
from rmpa.observe.sites import SITE_WHY, SiteRequests
from rmpa.observe.snapshot import INFO, ModuleFacts, PeerInfo, Snapshot
from rmpa.observe.why.diagnosis import (
    PERMISSION_THERE,
    Diagnosis,
    ServiceAtServer,
    TopicAtPublisher,
    connected_directly,
    without_rules,
)
from rmpa.observe.why.services import ServiceHere, diagnose_module, diagnose_service
from rmpa.observe.why.stages import Ends, diagnose_topic, find_peer, peer_stages
from rmpa.ros.node.service_client import ServiceConnection
from rmpa.runtime.loop import yielding_to_data

if TYPE_CHECKING:
    from collections.abc import Iterable

    from rmpa.bridge.facts import BridgeFacts
    from rmpa.bridge.sessions import PeerSession
    from rmpa.observe.snapshot_builder import SnapshotBuilder

_T = TypeVar("_T")
# The request to a publisher's agent: what it knows of a topic. Replied by ``TopicAtPublisher``.
TOPIC: Final = "why.topic"
# The request to a server's agent: what it knows of a service. Replied by ``ServiceAtServer``.
SERVICE: Final = "why.service"
# The request to a subscriber's agent: how a topic of this module arrives there. Replied by ``Diagnosis``, a list.
HERE: Final = "why.here"
# The stages that fail where a peer has no publisher, or does not tell of one: the name may be something else's.
_NO_PUBLISHER: Final = frozenset({"publisher", PERMISSION_THERE})
# States of peers that can be asked.
_REACHED: Final = frozenset({"linked", "relayed"})
_MOVING: Final = frozenset({"open", "lingering", "opening"})


class WhyService:
    """The op ``why`` of the control socket, and the peers' requests about it. Changes nothing.

    Args:
        name: The module's.
        facts: What its bridge tells.
        snapshots: Its snapshots.
        sites: Asks gateways for the ways through them.
    """

    def __init__(self, name: str, facts: BridgeFacts, snapshots: SnapshotBuilder, sites: SiteRequests) -> None:
        self._name = name
        self._facts, self._services = facts, facts.services.part
        self._bridge, self._core = facts.bridge, facts.bridge.core
        self._snapshots = snapshots
        self._sites = sites
        rpc = self._bridge.rpc
        rpc.on_request(TOPIC, self._answer_topic, Needs((Access.SUBSCRIBE,), "the topic, and those like it"))
        rpc.on_request(SERVICE, self._answer_service, Needs((Access.CALL,), "the service, and those like it"))
        rpc.on_request(HERE, self._answer_here, Needs((Access.PUBLISH,), "the topic, which the peer publishes"))

    async def answer(self, args: dict[str, Any]) -> tuple[Diagnosis, ...]:
        """The control socket's op ``why``.

        Args:
            args: ``name``: a topic or a service; ``peer``: one peer's name or GUID, or ``None`` for all peers that
                have it or receive it; ``service``: whether a service is meant even where a topic has that name. Or
                ``module`` alone: a peer's name or GUID.

        Raises:
            ConfigError: The name is not a ROS name.
        """
        name, peer, service = args.get("name"), args.get("peer"), args.get("service") is True
        if isinstance(module := args.get("module"), str) and module:
            return (await self._module(module),)
        if not isinstance(name, str) or not is_global_name(name):
            raise ConfigError("name", f"{name!r} is not a topic, nor a service", "write /name, or PEER:/name")
        wanted = str(peer) if peer is not None else None
        of_a_site = wanted is not None and "/" in wanted
        if of_a_site and (ways := await self._through_gateways(name, wanted, service=service)):
            return ways
        # At once: a peer whose agent hangs holds up both.
        found, ways = await asyncio.gather(
            self._in_the_mesh(name, wanted, service=service), self._through_gateways(name, wanted, service=service)
        )
        if any(diagnosis.peer != self._name for diagnosis in ways):
            # "No peer publishes it" is not the answer where another site does, or would.
            found = tuple(diagnosis for diagnosis in found if diagnosis.node or diagnosis.flows)
        return (*found, *ways)

    async def _through_gateways(self, name: str, peer: str | None, *, service: bool) -> tuple[Diagnosis, ...]:
        """The ways from other sites and to them: ``peer`` is a site, or a site and a module of it."""
        site, _, module = (peer or "").partition("/")
        asked = {"name": name, "site": site, "module": module, "service": service}
        found: list[Diagnosis] = []
        for answer in await self._sites.all(SITE_WHY, asked):
            with contextlib.suppress(msgspec.ValidationError):  # of another release
                found += msgspec.convert(answer, tuple[Diagnosis, ...])
        return tuple(found)

    async def _in_the_mesh(self, name: str, wanted: str | None, *, service: bool) -> tuple[Diagnosis, ...]:
        if service or self._is_service(name):
            return await self._service(name, wanted)
        found = await (self._everywhere(name) if wanted is None else self._one(wanted, name))
        if _has_no_publisher(found[0]) and not found[0].node:
            # No topic has this name anywhere; a service that does not cross may have it.
            calls = await self._service(name, wanted)
            if any(diagnosis.node for diagnosis in calls):
                return calls
            denied = tuple(filter(_is_denied, calls))
            # A peer that denies both does not tell whether there is a topic or a service of this name.
            return tuple(map(_with_calls, found)) if _is_denied(found[0]) and denied else (*found, *denied)
        return found

    async def _module(self, name: str) -> Diagnosis:
        """A module itself: its link, and what its agent tells."""
        told, refusal = None, ""
        peer = find_peer(self._snapshot(), name)
        session = self._session(peer) if peer is not None else None
        if peer is not None and session is not None and session.linked and str(session.link.guid) == peer.guid:
            try:
                told = await self._ask(session, INFO, {}, ModuleFacts)
            except RmpaError as error:
                refusal = str(error)
        return diagnose_module(self._snapshot(), name, told, refusal)

    def _snapshot(self) -> Snapshot:
        """Of the agent and its peers."""
        return self._snapshots.build(())

    def _is_service(self, name: str) -> bool:
        state = self._core.state()
        if name in state.publishers or name in state.subscribers or any(self._bridge.topics.imports.at(name)):
            return False
        return name in state.services or any(remote.name == name for _, remote in self._services.imports)

    def _session(self, peer: PeerInfo) -> PeerSession | None:
        """The session that carries what a peer publishes: its own, or that of the relay that passes it on.

        One without a link stays while a part of the bridge keeps something for the peer.
        """
        sessions = sorted(self._bridge.sessions, key=lambda session: not session.linked)
        fitting = (at for at in sessions if str(at.link.guid) == peer.guid or (peer.via and at.link.name == peer.via))
        return next(fitting, None)

    def _names(self, peer: str, name: str) -> tuple[str, str]:
        """The names of a topic or service of a peer here and at the peer.

        A user may write either: a name that nothing of the peer can have here is taken for the peer's own.
        """
        names = self._bridge.context.names.of(peer)
        wires = names.wires_of(name)
        return (name, wires[0]) if wires else (names.local_name(name), name)

    def _own(self, topic: str) -> list[str]:
        """The module's own publishers of a topic."""
        return [node for node in self._core.publishers(topic) if not is_own(node)]

    async def _one(self, peer: str, topic: str) -> tuple[Diagnosis, ...]:
        """A topic of one peer; or, where only this module has a publisher, its own topic on its path to that peer."""
        found = await self._arrives(peer, topic)
        return await self._leaves(topic, peer) if _has_no_publisher(found[0]) and self._own(topic) else found

    async def _everywhere(self, topic: str) -> tuple[Diagnosis, ...]:
        """All paths of a topic, in and out; where there is none, what is known of it."""
        known, own = self._snapshot().peers, self._own(topic)
        peers = [peer for peer in known if peer.state in _REACHED]
        coming = [peer.guid for peer in peers if self._arrivals(peer, topic)]
        # Peers whose agent has died while a node of theirs is connected directly to a subscriber here.
        adrift = [
            peer.guid
            for peer in known
            if peer.state not in _REACHED
            and any(connected_directly(arrival.route) for arrival in self._arrivals(peer, topic).values())
        ]
        if not coming and not own and not adrift:
            # No peer offers it; one may have it, and not let it cross.
            ends = zip(peers, await asyncio.gather(*(self._both_ends(peer, topic) for peer in peers)), strict=True)
            told = [(peer.guid, end.there) for peer, end in ends if end.there is not None]
            coming = [guid for guid, there in told if there.sources]
            coming = coming or [guid for guid, there in told if there.permitted is False]
        ways = [self._arrives(guid, topic) for guid in (*coming, *adrift)]
        ways += [self._leaves(topic, peer.guid) for peer in peers if own and peer.state == "linked"]
        found = [diagnosis for diagnoses in await asyncio.gather(*ways) for diagnosis in diagnoses]
        return tuple(found) or (await self._nowhere(topic, [peer.name for peer in peers]),)

    async def _nowhere(self, topic: str, linked: list[str]) -> Diagnosis:
        if self._own(topic):
            text, remedy = "no peer is linked that it could go to", "`rmpa peer list` shows the peers"
            return Diagnosis.of((Check("peer", FAIL, text, remedy),), name=topic, peer=self._name, to="")
        state = self._core.state()
        names = {*state.publishers, *state.subscribers} - {topic}
        longer = sorted(name for name in names if name.endswith(topic))[:3]  # those of a namespace, or with a prefix
        similar = " or ".join(longer) if longer else await asyncio.to_thread(did_you_mean, topic, names)
        text = f"neither {self._name} nor a linked peer ({', '.join(linked) or 'there is none'}) publishes {topic}"
        remedy = "`rmpa topic list` shows the topics, `rmpa peer list` the modules"
        remedy = f"did you mean {similar}?" if similar else remedy
        if not linked and (strangers := self._snapshot().strangers):
            remedy = f"{strangers[0].name} is {strangers[0].last_error}"
        return Diagnosis.of((Check("publisher", FAIL, text, remedy),), name=topic, peer="", to=self._name)

    async def _arrives(self, name: str, topic: str) -> tuple[Diagnosis, ...]:
        """Judge the paths from a peer to here."""
        snapshot = self._snapshot()
        peer = find_peer(snapshot, name)
        if peer is None:
            return diagnose_topic(Ends(snapshot, topic, topic), name)
        topic, _ = self._names(peer.name, topic)
        ends, later = await self._both_ends(peer, topic), None
        if any(arrival.route.state in _MOVING for arrival in ends.arrivals.values()):
            # Only a second count shows whether messages flow.
            await asyncio.sleep(observe_limits.WHY_WINDOW)
            later = await self._both_ends(peer, topic)
        return diagnose_topic(ends, peer.guid, later)

    async def _both_ends(self, peer: PeerInfo, topic: str) -> Ends:
        """What both ends know now."""
        session, (_, wire) = self._session(peer), self._names(peer.name, topic)
        there, refusal = None, "it is not linked"
        if session is not None and session.linked:
            question = {"topic": wire, "instance": peer.instance if peer.state == "relayed" else ""}
            try:
                there = await self._ask(session, TOPIC, question, TopicAtPublisher)
            except RmpaError as error:
                refusal = str(error)
        subscribers = tuple(node for node in self._core.state().subscribers.get(topic, ()) if not is_own(node))
        arrivals = self._arrivals(peer, topic)
        return Ends(self._snapshot(), topic, wire, subscribers, arrivals, there, refusal)

    def _arrivals(self, peer: PeerInfo, topic: str) -> dict[str, Arrival]:
        """What is known here of a peer's publishers of a topic, by node."""
        session = self._session(peer)
        return dict(self._facts.topics.arrivals(session, peer.instance, topic)) if session is not None else {}

    async def _leaves(self, topic: str, name: str) -> tuple[Diagnosis, ...]:
        """Have a peer judge the paths from here to it."""
        snapshot = self._snapshot()
        begin, peer = peer_stages(snapshot, name), find_peer(snapshot, name)
        session, to = (self._session(peer), peer.name) if peer is not None else (None, name)
        if session is None or not session.linked or session.link.name != to:
            remedy = "ask on its own machine; or try again in a moment"
            no_link = Check("link", FAIL, f"there is no link to {to} that could be asked", remedy)
            stages = begin if begin[-1].level is FAIL else (*begin, no_link)
            return (Diagnosis.of(stages, name=topic, peer=self._name, to=to),)
        question = {"topic": self._bridge.context.names.of(to).wire_name(topic)}
        try:
            # Its time window, and at most two requests to this agent of ASK_TIMEOUT each.
            found = await self._ask(session, HERE, question, tuple[Diagnosis, ...], 12.0)
            if not found:
                raise RemoteProtocolError("it checked no path")
            return found[: observe_limits.WHY_SOURCES_MAX]
        except RmpaError as error:
            silent = Check("link", FAIL, f"{to} does not tell: {error}", f"run `rmpa why {self._name}:{topic}` there")
            return (Diagnosis.of((*begin, silent), name=topic, peer=self._name, to=to),)

    async def _answer_here(self, session: PeerSession, args: dict[str, Any]) -> tuple[Diagnosis, ...]:
        topic = self._bridge.context.names.of(session.link.name).local_name(_name_in(args, "topic"))
        found = await self._arrives(str(session.link.guid), topic)
        return tuple(without_rules(one) for one in found[: observe_limits.WHY_SOURCES_MAX])

    async def _answer_topic(self, session: PeerSession, args: dict[str, Any]) -> TopicAtPublisher:
        """The reply to ``why.topic``.

        Args:
            session: The peer that asks.
            args: ``topic``: its name on the wire; ``instance``: the instance id of its module, if this module only
                relays it.
        """
        wire, instance, asker = _name_in(args, "topic"), args.get("instance") or "", session.link.name
        names, state, gate = self._bridge.context.names.of(asker), self._core.state(), self._bridge.gate
        topics = [topic for topic in names.locals_of(wire) if gate.judge(Access.SUBSCRIBE, asker, topic).allowed]
        if not topics:
            return TopicAtPublisher(permitted=False)
        sources: list[PublisherReport] = []
        subscribers: list[str] = []
        for topic in topics:
            sources += self._facts.topics.reports(session, topic, instance)
            subscribers += [node for node in state.subscribers.get(topic, {}) if not is_own(node)]
        known = (topic for topic, nodes in state.publishers.items() if not all(map(is_own, nodes)))
        similar = "" if sources else await self._similar(asker, Access.SUBSCRIBE, wire, known)
        return TopicAtPublisher(
            sources=tuple(sources[: observe_limits.WHY_SOURCES_MAX]),
            subscribers=tuple(subscribers[: observe_limits.WHY_SOURCES_MAX]),
            similar=similar,
            permitted=True if gate.on else None,
        )

    async def _similar(self, asker: str, access: Access, wire: str, names: Iterable[str]) -> str:
        """Which of the names of this module, of those that a peer may know, is most like one on the wire."""
        context, gate = self._bridge.context, self._bridge.gate
        allowed = (name for name in yielding_to_data(list(names)) if gate.judge(access, asker, name).allowed)
        known = {context.names.of(asker).wire_name(name) for name in allowed}
        # In a thread: comparing thousands of names takes longer than a message may wait.
        return await asyncio.to_thread(did_you_mean, wire, known) or ""

    async def _service(self, service: str, name: str | None) -> tuple[Diagnosis, ...]:
        """Judge the path of a service from one peer, or from each, to here."""
        if name is not None:
            return (await self._calls(name, service),)
        peers = [peer for peer in self._snapshot().peers if peer.state in _REACHED]
        offering = [peer.guid for peer in peers if self._offers(peer, service)]
        found = await asyncio.gather(*(self._calls(guid, service) for guid in offering or [p.guid for p in peers]))
        served = tuple(diagnosis for diagnosis in found if diagnosis.node) or tuple(filter(_is_denied, found))
        return served or (await self._no_server(service, [peer.name for peer in peers]),)

    def _offers(self, peer: PeerInfo, service: str) -> bool:
        """Whether a link carries a service of a peer: the link's own peer, or a relayed one."""
        session = self._session(peer)
        remote = self._services.imports.get(session.peer, service) if session is not None else None
        return session is not None and remote is not None and session.instance_of(remote.origin) == peer.instance

    async def _no_server(self, service: str, linked: list[str]) -> Diagnosis:
        """The diagnosis of a service that no peer has."""
        state = self._core.state()
        own = [node for node in state.services.get(service, {}) if not is_own(node)]
        similar = await asyncio.to_thread(did_you_mean, service, {*state.services})
        text = f"no linked peer ({', '.join(linked) or 'there is none'}) provides {service}"
        remedy = "`rosservice list` and `rmpa peer list` show what there is"
        remedy = f"did you mean {similar}?" if similar else remedy
        if own:
            text = f"{own[0]} of this module provides {service}; clients here call it without us"
            remedy = f"whether another module may call it: `rmpa why {self._name}:{service}` there"
        stage = Check("server", OK if own else FAIL, text, remedy)
        return Diagnosis.of((stage,), kind="service", name=service, peer="", to=self._name)

    async def _calls(self, name: str, service: str) -> Diagnosis:
        snapshot, there, refusal = self._snapshot(), None, ""
        peer = find_peer(snapshot, name)
        session = self._session(peer) if peer is not None else None
        if peer is None or session is None or not session.linked:
            return diagnose_service(peer_stages(snapshot, name), self._name, name, service)
        service, wire = self._names(peer.name, service)
        try:
            there = await self._ask(session, SERVICE, {"service": wire}, ServiceAtServer)
        except RmpaError as error:
            refusal = str(error)
        here, begin = await self._service_here(session, service), peer_stages(self._snapshot(), name)
        return diagnose_service(begin, self._name, peer.name, service, wire, here, there, refusal)

    async def _service_here(self, session: PeerSession, service: str) -> ServiceHere:
        """What is known here of a service of a peer; its proxy is probed as a client would."""
        remote = self._services.imports.get(session.peer, service)
        if remote is None:
            return ServiceHere()
        info, shown = self._facts.services.of_peer(session.peer, remote), self._services.shown(remote)
        if shown is None or shown.proxy is None:
            return ServiceHere(info, denied=self._services.imports.why_hidden(remote)[1] == DENIED)
        uri = self._core.state().services.get(service, {}).get(shown.proxy.name, "")
        answer, refusal = await _probe(uri, service) if uri else ("", "")
        return ServiceHere(
            info, registered=bool(uri), answer=answer, refusal=refusal, mismatched=bool(shown.mismatch)
        )

    async def _answer_service(self, session: PeerSession, args: dict[str, Any]) -> ServiceAtServer:
        """The reply to ``why.service``; the server is probed.

        Args:
            session: The peer that asks.
            args: ``service``: its name on the wire.
        """
        wire, asker = _name_in(args, "service"), session.link.name
        seen, gate = self._services.exports.seen, self._bridge.gate
        services = self._bridge.context.names.of(asker).locals_of(wire)
        services = tuple(service for service in services if gate.judge(Access.CALL, asker, service).allowed)
        if not services:
            return ServiceAtServer(permitted=False)
        for service in services:
            server = seen.get(service)
            if server is not None:
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
            for node in self._core.state().services.get(service, {}):
                if (found := self._core.unreachable().get(node)) is not None:
                    refusal = f"it cannot be reached at {found.api} ({found.problem})"
                    return ServiceAtServer(node=node, service=service, refusal=refusal)
        return ServiceAtServer(similar=await self._similar(asker, Access.CALL, wire, seen))

    async def _ask(
        self, session: PeerSession, what: str, args: dict[str, Any], kind: type[_T], limit: float = limits.ASK_TIMEOUT
    ) -> _T:
        value = await self._bridge.rpc.request(session, what, args, limit)
        try:
            return msgspec.convert(value, kind)
        except (msgspec.ValidationError, RecursionError) as error:
            raise RemoteProtocolError(f"it answers in another way: {error}; is it another version?") from None


def _name_in(args: dict[str, Any], key: str) -> str:
    """The argument ``key`` of a peer's request, a ROS name.

    Raises:
        RemoteProtocolError: It is not a ROS name.
    """
    name = args.get(key)
    if not isinstance(name, str) or len(name) > config_limits.CROSSING_NAME_MAX or not is_global_name(name):
        raise RemoteProtocolError(f"the question names no {key}")
    return name


async def _probe(uri: str, service: str) -> tuple[str, str]:
    """A server's description of its service, and why there is none."""
    try:
        found = await ServiceConnection.probe(uri, service, OWN_NODE, timeout=2.0)
    except RmpaError as error:
        return "", str(error)
    return f"{found.description.type}, md5 {found.description.md5sum}", ""


def _has_no_publisher(found: Diagnosis) -> bool:
    return found.failed is not None and found.failed.name in _NO_PUBLISHER


def _is_denied(found: Diagnosis) -> bool:
    """Whether a peer tells nothing of a name, because its permissions do not let this module have it."""
    return found.failed is not None and found.failed.name == PERMISSION_THERE


def _with_calls(found: Diagnosis) -> Diagnosis:
    """A denied topic, where calls of a service of this name are denied too."""
    *walked, last = found.stages
    text = f"{last.text}, nor call it if it is a service"
    return msgspec.structs.replace(found, stages=(*walked, msgspec.structs.replace(last, text=text)))
