"""Answers ``rmpa why``: gathers what this agent knows, asks the agent at the other end, and has both judged."""

from __future__ import annotations

import asyncio
import contextlib
from itertools import chain
from typing import TYPE_CHECKING, Any, Final, TypeVar

import msgspec

from rmpa.bridge import limits
from rmpa.bridge.policy import Needs
from rmpa.config.peer_rules import Access
from rmpa.config.values import did_you_mean
from rmpa.core.errors import ConfigError, RemoteProtocolError, RmpaError
from rmpa.core.identity import is_global_name
from rmpa.observe import limits as observe_limits
from rmpa.observe.doctor.machine import judge_peer_clock
from rmpa.observe.operations import WHY as WHY_SITES
from rmpa.observe.peer_info import FAIL, OK, UNKNOWN, WARN, Check, PeerAgent
from rmpa.observe.peer_info import INFO as AGENT_INFO
from rmpa.observe.why.diagnosis import (
    PERMISSION_THERE,
    BothEnds,
    Diagnosis,
    TopicAtPublisher,
    connected_directly,
    until_failure,
    without_rules,
)
from rmpa.observe.why.services import ServiceAtServer, ServiceEvidence, TopicEvidence, diagnose_service, name_in
from rmpa.observe.why.topics import diagnose_topic, find_peer, peer_stages

if TYPE_CHECKING:
    from collections.abc import Iterator

    from rmpa.bridge.bridge import Bridge
    from rmpa.bridge.services.part import Services
    from rmpa.bridge.sessions import PeerSession
    from rmpa.observe.operations import SiteRequests
    from rmpa.observe.peer_info import LinkInfo, PeerInfo
    from rmpa.observe.snapshot import Snapshot
    from rmpa.observe.snapshot_builder import SnapshotBuilder
    from rmpa.ros.core.external import Core


# Why a module is reached or not: the stages from its beacon to what crosses its link, in order.
#
# Pure: the snapshot of this agent, and what the peer's agent tells of itself, go in; stages come out::
#
#     peer ─ link ─ path ─ lanes ─ answer ─ clock ─ load ─ limits ─ offers


_BUSY: Final = 90.0
"""Percent of a core from which on an agent counts as busy: it has one thread for all messages."""
_FILES: Final = 0.9
"""Share of its file descriptors from which on an agent is warned of."""


def diagnose_module(snapshot: Snapshot, name: str, told: PeerAgent | None = None, refusal: str = "") -> Diagnosis:
    """Judge all stages for one module.

    Args:
        snapshot: This agent's.
        name: The module's name or GUID.
        told: What its agent tells of itself; ``None`` if it did not.
        refusal: Why it did not, ready to read.
    """
    own = snapshot.agent
    if name in (own.name, own.guid, own.guid.partition("#")[0]):
        here = Check("peer", OK, f"{own.name} is this module ({own.guid}); its agent has answered")
        return Diagnosis.of((here,), name=own.name, peer=own.name, to=own.name, kind="module")
    peer = find_peer(snapshot, name)
    stages = peer_stages(snapshot, name)
    if peer is not None:
        stages = until_failure(chain(stages, _further(snapshot, peer, told, refusal)))
    shown = peer.name if peer is not None else name
    return Diagnosis.of(stages, name=shown, peer=shown, to=own.name, kind="module")


def _further(snapshot: Snapshot, peer: PeerInfo, told: PeerAgent | None, refusal: str) -> Iterator[Check]:
    link = peer.link
    if link is not None:
        yield from _lanes(link)
        yield _answer(peer, snapshot.agent.version, told, refusal)
        if link.clock_offset is not None:
            yield judge_peer_clock(snapshot.agent.name, peer.name, link.clock_offset, link.clock_error)
        if told is not None:
            yield from _load(peer.name, told)
    for bound in peer.beyond:
        yield Check.from_message("limits", WARN, bound.text)
    text = f"{peer.name} offers {peer.topics_in} topics, and is offered {peer.topics_out}"
    if peer.topics_in or peer.state == "relayed":
        yield Check("offers", OK, text)
    else:
        remedy = f"does a node of {peer.name} publish anything? Its [bridge] rules, and the ones here, may deny it"
        yield Check("offers", WARN, text, remedy)


def _lanes(link: LinkInfo) -> Iterator[Check]:
    for lane in link.lanes:
        if not lane.connected and not lane.unneeded:
            text = f"the {lane.name} lane has no connection: {lane.queued} bytes wait"
            yield Check("lanes", WARN, text, "it is dialled again by itself; is a firewall between the modules?")
    if link.dropped:
        text = f"{link.dropped} messages were dropped, because the link is slower than what it should carry"
        yield Check("lanes", WARN, text, "contracts with max_rate or priority say what may be left out")
    elif all(lane.connected for lane in link.lanes):
        yield Check("lanes", OK, f"{len(link.lanes) or 'all'} lanes are connected, nothing was dropped")
    elif all(lane.connected or lane.unneeded for lane in link.lanes):
        idle = ", ".join(lane.name for lane in link.lanes if not lane.connected)
        yield Check("lanes", OK, f"nothing was dropped; the {idle} lane is connected when a message wants it")


def _answer(peer: PeerInfo, version: str, told: PeerAgent | None, refusal: str) -> Check:
    if told is None:
        return Check(
            "answer", UNKNOWN, f"the agent of {peer.name} does not tell about itself: {refusal or 'not asked'}"
        )
    if told.version != version:
        text = f"its agent answers, and is of version {told.version or '?'}; this one is of {version}"
        return Check("answer", WARN, text, "install the same release on both, if something does not work")
    return Check("answer", OK, f"its agent answers, and is of version {told.version}, as this one")


def _load(name: str, told: PeerAgent) -> Iterator[Check]:
    if told.cpu is not None and told.cpu >= _BUSY:
        text = f"the agent of {name} uses {told.cpu:.0f} % of a core: messages wait"
        yield Check(
            "load", WARN, text, "`rmpa topic hz` there shows what is so much; direct transport relieves agents"
        )
    elif told.cpu is not None:
        yield Check("load", OK, f"the agent of {name} uses {told.cpu:.0f} % of a core")
    if told.files_open is not None and told.files_limit and told.files_open >= _FILES * told.files_limit:
        text = f"the agent of {name} has {told.files_open} of {told.files_limit} files open"
        yield Check("files", WARN, text, "raise its limit: ulimit -n, or LimitNOFILE of its service")


_T = TypeVar("_T")
TOPIC: Final = "why.topic"
"""The request to a publisher's agent: what it knows of a topic. Replied by ``TopicAtPublisher``."""
SERVICE: Final = "why.service"
"""The request to a server's agent: what it knows of a service. Replied by ``ServiceAtServer``."""
HERE: Final = "why.here"
"""The request to a subscriber's agent: how a topic of this module arrives there. Replied by ``Diagnosis``, a list."""
_NO_PUBLISHER: Final = frozenset({"publisher", PERMISSION_THERE})
"""The stages that fail where a peer has no publisher, or does not tell of one: the name may be something else's."""
_REACHED: Final = frozenset({"linked", "relayed"})
"""States of peers that can be asked."""
_MOVING: Final = frozenset({"open", "lingering", "opening"})


class WhyService:
    """The op ``why`` of the control socket, and the peers' requests about it. Changes nothing.

    Args:
        name: The module's.
        core: Its ROS core.
        bridge: Its bridge.
        services: The bridge's part for services.
        snapshots: Its snapshots.
        sites: Asks gateways for the ways through them.
    """

    def __init__(
        self,
        name: str,
        core: Core,
        bridge: Bridge,
        services: Services,
        snapshots: SnapshotBuilder,
        sites: SiteRequests,
    ) -> None:
        self._core = core
        self._name = name
        self._sites = sites
        self._bridge = bridge
        self._snapshots = snapshots
        self._topics = TopicEvidence(core, bridge, snapshots)
        self._services = ServiceEvidence(core, bridge, services)
        rpc = bridge.rpc
        rpc.on_request(TOPIC, self._topics.answer, Needs((Access.SUBSCRIBE,), "the topic, and those like it"))
        rpc.on_request(SERVICE, self._services.answer, Needs((Access.CALL,), "the service, and those like it"))
        rpc.on_request(HERE, self._answer_here, Needs((Access.PUBLISH,), "the topic, which the peer publishes"))

    async def answer(self, args: dict[str, object]) -> tuple[Diagnosis, ...]:
        """The control socket's op ``why``.

        Args:
            args: ``name``: a topic or a service; ``peer``: one peer's name or GUID, or ``None`` for all peers that
                have it or receive it; ``service``: whether a service is meant even where a topic has that name. Or
                ``module`` alone: a peer's name or GUID.

        Raises:
            ConfigError: The name is not a ROS name.
        """
        name, peer = args.get("name"), args.get("peer")
        if isinstance(module := args.get("module"), str) and module:
            return (await self._module(module),)
        if not isinstance(name, str) or not is_global_name(name):
            raise ConfigError("name", f"{name!r} is not a topic, nor a service", "write /name, or PEER:/name")
        wanted = str(peer) if peer is not None else None
        service = args.get("service") is True
        if (
            wanted is not None
            and "/" in wanted
            and (ways := await self._through_gateways(name, wanted, service=service))
        ):
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
        for answer in await self._sites.all(WHY_SITES, asked):
            with contextlib.suppress(msgspec.ValidationError):  # of another release
                found += msgspec.convert(answer, tuple[Diagnosis, ...])
        return tuple(found)

    async def _in_the_mesh(self, name: str, wanted: str | None, *, service: bool) -> tuple[Diagnosis, ...]:
        if service or self._is_service(name):
            return await self._service(name, wanted)
        found = await (self._everywhere(name) if wanted is None else self._one(wanted, name))
        failed = found[0].failed
        if failed is not None and failed.name in _NO_PUBLISHER and not found[0].node:
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
        snapshot = self._snapshots.build(frozenset())
        found = find_peer(snapshot, name)
        session = next((s for s in self._bridge.sessions.linked() if found and str(s.link.guid) == found.guid), None)
        if session is not None:
            try:
                told = msgspec.convert(await self._bridge.rpc.request(session, AGENT_INFO, {}), PeerAgent)
            except (RmpaError, msgspec.ValidationError) as error:
                refusal = str(error)
        return diagnose_module(self._snapshots.build(frozenset()), name, told, refusal)

    def _is_service(self, name: str) -> bool:
        state = self._core.state()
        if name in state.publishers or name in state.subscribers or any(self._bridge.topics.imports.at(name)):
            return False
        return name in state.services or self._services.known(name)

    # --- topics of peers --------------------------------------------------------------------------------------

    async def _one(self, peer: str, topic: str) -> tuple[Diagnosis, ...]:
        """A topic of one peer; or, where only this module has a publisher, its own topic on its path to that peer."""
        found = await self._arrives(peer, topic)
        failed = found[0].failed
        if failed is not None and failed.name in _NO_PUBLISHER and self._topics.own(topic):
            return await self._leaves(topic, peer)
        return found

    def _carrier(self, peer: PeerInfo) -> PeerSession | None:
        """The link that carries what a peer publishes: its own, or that of the relay that passes it on."""
        for session in self._bridge.sessions.linked():
            if str(session.link.guid) == peer.guid or (peer.via and session.link.name == peer.via):
                return session
        return None

    async def _everywhere(self, topic: str) -> tuple[Diagnosis, ...]:
        """All paths of a topic, in and out; where there is none, what is known of it."""
        peers = self._reachable_peers()
        own = self._topics.own(topic)
        coming = [peer.guid for peer in peers if self._offers(peer, topic)]
        if not coming and not own and not self._adrift(topic):
            # No peer offers it; one may have it, and not let it cross.
            known = await asyncio.gather(*(self._both_ends(peer, topic) for peer in peers))
            told = [(p.guid, e.there) for p, e in zip(peers, known, strict=True) if e.there is not None]
            coming = [guid for guid, there in told if there.sources]
            coming = coming or [guid for guid, there in told if there.permitted is False]
        coming += self._adrift(topic)
        ways = [self._arrives(guid, topic) for guid in coming]
        to = [peer for peer in peers if own and peer.state == "linked"]
        ways += [self._leaves(topic, peer.guid) for peer in to]
        found = [diagnosis for diagnoses in await asyncio.gather(*ways) for diagnosis in diagnoses]
        return tuple(found) or (await self._nowhere(topic, [peer.name for peer in peers]),)

    def _reachable_peers(self) -> list[PeerInfo]:
        return [peer for peer in self._snapshots.build(frozenset()).peers if peer.state in _REACHED]

    def _adrift(self, topic: str) -> list[str]:
        """The peers whose agent has died while a node of theirs is connected directly to a subscriber here."""
        snapshot = self._snapshots.build(frozenset({topic}))
        left = {r.peer for t in snapshot.topics for r in t.routes if r.direction == "in" and connected_directly(r)}
        return [p.guid for p in snapshot.peers if p.name in left and p.state not in _REACHED]

    def _offers(self, peer: PeerInfo, topic: str) -> bool:
        session = self._carrier(peer)
        return session is not None and bool(self._topics.here(session, peer, topic).proxies)

    async def _nowhere(self, topic: str, linked: list[str]) -> Diagnosis:
        here = self._snapshots.build((), peers=False).agent.name
        if self._topics.own(topic):
            text, remedy = "no peer is linked that it could go to", "`rmpa peer list` tells of the peers"
            return Diagnosis.of((Check("peer", FAIL, text, remedy),), name=topic, peer=here, to="")
        state = self._core.state()
        similar = await asyncio.to_thread(did_you_mean, topic, {*state.publishers, *state.subscribers} - {topic})
        text = f"neither {here} nor a linked peer ({', '.join(linked) or 'there is none'}) publishes {topic}"
        remedy = "`rmpa topic list` shows the topics, `rmpa peer list` the modules"
        remedy = f"did you mean {similar}?" if similar else remedy
        if not linked and (strangers := self._snapshots.build(()).strangers):
            remedy = f"{strangers[0].name} is {strangers[0].last_error}"
        return Diagnosis.of((Check("publisher", FAIL, text, remedy),), name=topic, peer="", to=here)

    async def _arrives(self, name: str, topic: str) -> tuple[Diagnosis, ...]:
        """Judge the paths from a peer to here."""
        peer = find_peer(self._snapshots.build(frozenset()), name)
        if peer is None:
            return diagnose_topic(BothEnds(self._topics.here(None, None, topic)), name)
        topic, wire = self._topics.there(peer.name, topic)
        ends = await self._both_ends(peer, topic)
        later = None
        routes = [r for t in ends.here.snapshot.topics for r in t.routes if r.direction == "in"]
        if any(route.state in _MOVING for route in routes):
            # Only a second count shows whether messages flow.
            await asyncio.sleep(observe_limits.WHY_WINDOW)
            later = await self._both_ends(peer, topic)
        return diagnose_topic(ends, peer.guid, later, wire)

    async def _both_ends(self, peer: PeerInfo, topic: str) -> BothEnds:
        """What both ends know now."""
        session = self._carrier(peer)
        if session is None:
            return BothEnds(self._topics.here(None, peer, topic), refusal="it is not linked")
        _, wire = self._topics.there(peer.name, topic)
        question = {"topic": wire, "instance": peer.instance if peer.state == "relayed" else ""}
        try:
            there, refusal = await self._ask(session, TOPIC, question, TopicAtPublisher), ""
        except RmpaError as error:
            there, refusal = None, str(error)
        return BothEnds(self._topics.here(session, peer, topic), there, refusal)

    # --- topics of this module -------------------------------------------------------------------------------

    async def _leaves(self, topic: str, name: str) -> tuple[Diagnosis, ...]:
        """Have a peer judge the paths from here to it."""
        snapshot = self._snapshots.build(frozenset())
        here = snapshot.agent.name
        begin = peer_stages(snapshot, name)
        peer = find_peer(snapshot, name)
        session = self._carrier(peer) if peer is not None else None
        to = peer.name if peer is not None else name
        if session is None or session.link.name != to:
            stages = begin if begin[-1].level is FAIL else (*begin, _no_link(to))
            return (Diagnosis.of(stages, name=topic, peer=here, to=to),)
        question = {"topic": self._bridge.context.names.wire_name(to, topic)}
        try:
            found = await self._ask(session, HERE, question, tuple[Diagnosis, ...], observe_limits.WHY_TIMEOUT)
            if not found:
                raise RemoteProtocolError("it walked no way at all")
            return found[: observe_limits.WHY_SOURCES_MAX]
        except RmpaError as error:
            remedy = f"run `rmpa why {here}:{topic}` there"
            silent = Check("link", FAIL, f"{to} does not tell: {error}", remedy)
            return (Diagnosis.of((*begin, silent), name=topic, peer=here, to=to),)

    async def _answer_here(self, session: PeerSession, args: dict[str, Any]) -> tuple[Diagnosis, ...]:
        topic = self._bridge.context.names.local_name(session.link.name, name_in(args, "topic"))
        found = await self._arrives(str(session.link.guid), topic)
        return tuple(without_rules(one) for one in found[: observe_limits.WHY_SOURCES_MAX])

    # --- services ---------------------------------------------------------------------------------------------

    async def _service(self, service: str, name: str | None) -> tuple[Diagnosis, ...]:
        """Judge the path of a service from one peer, or from each, to here."""
        peers = self._reachable_peers()
        if name is None:
            carried = [(peer, at) for peer in peers if (at := self._carrier(peer)) is not None]
            offering = [p.guid for p, at in carried if self._services.offers(at, service, p.instance)]
            found = await asyncio.gather(
                *(self._calls(guid, service) for guid in offering or [p.guid for p in peers])
            )
            served = tuple(diagnosis for diagnosis in found if diagnosis.node)
            served = served or tuple(diagnosis for diagnosis in found if _is_denied(diagnosis))
            here = self._snapshots.build((), peers=False).agent.name
            return served or (await self._services.nowhere(here, service, [p.name for p in peers]),)
        return (await self._calls(name, service),)

    async def _calls(self, name: str, service: str) -> Diagnosis:
        snapshot = self._snapshots.build(frozenset())
        peer = find_peer(snapshot, name)
        session = self._carrier(peer) if peer is not None else None
        if peer is None or session is None:
            return diagnose_service(peer_stages(snapshot, name), snapshot.agent.name, name, service)
        service, wire = self._topics.there(peer.name, service)
        there: ServiceAtServer | None = None
        refusal = ""
        try:
            there = await self._ask(session, SERVICE, {"service": wire}, ServiceAtServer)
        except RmpaError as error:
            refusal = str(error)
        here = await self._services.here(session, service, wire)
        begin = peer_stages(snapshot, name)
        return diagnose_service(begin, snapshot.agent.name, peer.name, service, here, there, refusal)

    async def _ask(
        self,
        session: PeerSession,
        what: str,
        args: dict[str, Any],
        kind: type[_T],
        limit: float = limits.ASK_TIMEOUT,
    ) -> _T:
        value = await self._bridge.rpc.request(session, what, args, limit)
        try:
            return msgspec.convert(value, kind)
        except (msgspec.ValidationError, RecursionError) as error:
            raise RemoteProtocolError(f"it answers in another way: {error}; is it another version?") from None


def _is_denied(found: Diagnosis) -> bool:
    """Whether a peer tells nothing of a name, because its permissions do not let this module have it."""
    return found.failed is not None and found.failed.name == PERMISSION_THERE


def _with_calls(found: Diagnosis) -> Diagnosis:
    """A denied topic, where calls of a service of this name are denied too."""
    *walked, last = found.stages
    text = f"{last.text}, nor call it if it is a service"
    return msgspec.structs.replace(found, stages=(*walked, msgspec.structs.replace(last, text=text)))


def _no_link(peer: str) -> Check:
    remedy = "ask on its own machine; or try again in a moment"
    return Check("link", FAIL, f"there is no link to {peer} that could be asked", remedy)
