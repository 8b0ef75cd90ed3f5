"""Answers ``rmpa why``: gathers what this side knows, asks the other agent, and has ``monitor`` judge it."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING, Any, Final, TypeVar

import msgspec

from rmpa.bridge import limits
from rmpa.config.values import did_you_mean
from rmpa.core.errors import ConfigError, RemoteProtocolError, RmpaError
from rmpa.core.names import is_global_name
from rmpa.observe.io.service_facts import ServiceFacts
from rmpa.observe.io.topic_facts import TopicFacts, name_in
from rmpa.observe.why.diagnosis import BothSides, Diagnosis, FarTopic, PathStage, StageResult
from rmpa.observe.why.services import FarService, walk_service
from rmpa.observe.why.topics import find_peer, walk_peer, walk_topic

if TYPE_CHECKING:
    from rmpa.bridge.io.bridge import Bridge
    from rmpa.bridge.services.io.part import Services
    from rmpa.bridge.session.peer_session import PeerSession
    from rmpa.config.settings import Settings
    from rmpa.observe.io.snapshot_builder import SnapshotBuilder
    from rmpa.observe.snapshot import PeerInfo
    from rmpa.ros.core.api import Core

_T = TypeVar("_T")
TOPIC: Final = "why.topic"
"""The question to a publisher's agent: what it knows of a topic (``FarTopic``)."""
SERVICE: Final = "why.service"
"""The question to a server's agent: what it knows of a service (``FarService``)."""
HERE: Final = "why.here"
"""The question to a subscriber's agent: why a topic of the asker does not arrive there (``Diagnosis``, a list)."""
_MOVING: Final = frozenset({"open", "lingering", "opening"})


class WhyService:
    """Reads the rooms and asks peers; changes nothing.

    Args:
        settings: The agent's.
        core: Its ROS core.
        bridge: Its bridge.
        services: The bridge's part for services.
        view: Its snapshots.
    """

    def __init__(
        self, settings: Settings, core: Core, bridge: Bridge, services: Services, view: SnapshotBuilder
    ) -> None:
        self._core = core
        self._bridge = bridge
        self._view = view
        self._topics = TopicFacts(settings, core, bridge, view)
        self._services = ServiceFacts(settings, core, bridge, services)
        bridge.asks.on(TOPIC, self._topics.tell)
        bridge.asks.on(SERVICE, self._services.tell)
        bridge.asks.on(HERE, self._tell_here)

    def reload(self, settings: Settings) -> None:
        """Other settings hold from now on."""
        self._topics.reload(settings)
        self._services.reload(settings)

    async def answer(self, args: dict[str, object]) -> tuple[Diagnosis, ...]:
        """The control socket's op ``why``.

        Args:
            args: ``name``: a topic, or a service; ``peer``: one peer's name or GUID, or ``None`` for all that have to
                do with it; ``service``: whether a service is meant even where a topic has that name.

        Raises:
            ConfigError: The name is none.
        """
        name, peer = args.get("name"), args.get("peer")
        if not isinstance(name, str) or not is_global_name(name):
            raise ConfigError("name", f"{name!r} is not a topic, nor a service", "write /name, or PEER:/name")
        wanted = str(peer) if peer is not None else None
        if args.get("service") is True or self._is_service(name):
            return await self._service(name, wanted)
        found = await (self._everywhere(name) if wanted is None else self._one(wanted, name))
        failed = found[0].failed
        if failed is not None and failed.name == "publisher":
            # No topic has this name anywhere: perhaps a service that does not cross has.
            service = await self._service(name, wanted)
            if any(diagnosis.node for diagnosis in service):
                return service
        return found

    def _is_service(self, name: str) -> bool:
        state = self._core.state()
        if name in state.publishers or name in state.subscribers or any(self._bridge.imports.at(name)):
            return False
        return name in state.services or self._services.known(name)

    # --- topics: this side ------------------------------------------------------------------------------------

    async def _one(self, peer: str, topic: str) -> tuple[Diagnosis, ...]:
        """A topic of one peer; or, where that has no publisher and we have, our own topic on its way there."""
        found = await self._arrives(peer, topic)
        failed = found[0].failed
        if failed is not None and failed.name == "publisher" and self._topics.own(topic):
            return await self._leaves(topic, peer)
        return found

    def _carrier(self, peer: PeerInfo) -> PeerSession | None:
        """Whose link brings what a peer publishes: its own, or that of the relay which passes it on."""
        for attached in self._bridge.attached():
            if str(attached.link.guid) == peer.guid or (peer.via and attached.link.name == peer.via):
                return attached
        return None

    async def _everywhere(self, topic: str) -> tuple[Diagnosis, ...]:
        """Each way that a topic has, in and out; where there is none, what is known of it."""
        peers = [peer for peer in self._view.snapshot(frozenset()).peers if peer.state in ("linked", "relayed")]
        own = self._topics.own(topic)
        coming = [peer.guid for peer in peers if self._offers(peer, topic)]
        if not coming and not own:
            # Nobody offers it: perhaps somebody has it and keeps it at home.
            sights = await asyncio.gather(*(self._sight(peer, topic) for peer in peers))
            coming = [p.guid for p, s in zip(peers, sights, strict=True) if s.far is not None and s.far.sources]
        ways = [self._arrives(guid, topic) for guid in coming]
        ways += [self._leaves(topic, peer.guid) for peer in peers if own and peer.state == "linked"]
        found = [diagnosis for diagnoses in await asyncio.gather(*ways) for diagnosis in diagnoses]
        return tuple(found) or (await self._nowhere(topic, [peer.name for peer in peers]),)

    def _offers(self, peer: PeerInfo, topic: str) -> bool:
        attached = self._carrier(peer)
        return attached is not None and bool(self._topics.near(attached, peer, topic).only)

    async def _nowhere(self, topic: str, linked: list[str]) -> Diagnosis:
        here = self._view.snapshot(frozenset()).agent.name
        if self._topics.own(topic):
            text, remedy = "no peer is linked that it could go to", "`rmpa peer list` tells of the peers"
            stage = PathStage("peer", StageResult.FAIL, text, remedy)
            return Diagnosis(name=topic, peer=here, to="", flows=False, stages=(stage,))
        state = self._core.state()
        near = await asyncio.to_thread(did_you_mean, topic, {*state.publishers, *state.subscribers})
        if awaited := self._topics.awaited(topic):
            text = f"{', '.join(awaited)} published {topic} before this agent was restarted, and does not answer"
            remedy = "it is asked again by itself; is that program stopped or stuck? Else start it again"
            stage = PathStage("publisher", StageResult.FAIL, text, remedy)
            return Diagnosis(name=topic, peer=here, to="", flows=False, stages=(stage,))
        text = f"neither {here} nor a linked peer ({', '.join(linked) or 'there is none'}) publishes {topic}"
        remedy = f"did you mean {near}?" if near else "`rmpa topic list` shows what there is, `rmpa peer list` who"
        stage = PathStage("publisher", StageResult.FAIL, text, remedy)
        return Diagnosis(name=topic, peer="", to=here, flows=False, stages=(stage,))

    async def _arrives(self, name: str, topic: str) -> tuple[Diagnosis, ...]:
        """Walk the ways from a peer to here."""
        peer = find_peer(self._view.snapshot(frozenset()), name)
        if peer is None:
            return walk_topic(BothSides(self._topics.near(None, None, topic)), name)
        topic, wire = self._topics.there(peer.name, topic)
        sight = await self._sight(peer, topic)
        later = None
        if any(r.state in _MOVING for t in sight.near.snapshot.topics for r in t.routes if r.direction == "in"):
            # What moves is told from what stands by looking twice.
            await asyncio.sleep(limits.WHY_WINDOW)
            later = await self._sight(peer, topic)
        return walk_topic(sight, peer.guid, later, wire)

    async def _sight(self, peer: PeerInfo, topic: str) -> BothSides:
        """Both sides now."""
        attached = self._carrier(peer)
        if attached is None:
            return BothSides(self._topics.near(None, peer, topic), refusal="it is not linked")
        _, wire = self._topics.there(peer.name, topic)
        question = {"topic": wire, "instance": peer.instance if peer.state == "relayed" else ""}
        try:
            far, refusal = await self._ask(attached, TOPIC, question, FarTopic), ""
        except RmpaError as error:
            far, refusal = None, str(error)
        return BothSides(self._topics.near(attached, peer, topic), far, refusal)

    # --- topics: the other side -------------------------------------------------------------------------------

    async def _leaves(self, topic: str, name: str) -> tuple[Diagnosis, ...]:
        """Let a peer walk the ways from here to it."""
        snapshot = self._view.snapshot(frozenset())
        here = snapshot.agent.name
        begin = walk_peer(snapshot, name)
        peer = find_peer(snapshot, name)
        attached = self._carrier(peer) if peer is not None else None
        to = peer.name if peer is not None else name
        if attached is None or attached.link.name != to:
            stages = begin if begin[-1].verdict is StageResult.FAIL else (*begin, _no_link(to))
            return (Diagnosis(name=topic, peer=here, to=to, flows=False, stages=stages),)
        question = {"topic": self._bridge.names.wire_name(to, topic, self._core.type_of(topic))}
        try:
            found = await self._ask(attached, HERE, question, tuple[Diagnosis, ...], limits.WHY_TIMEOUT)
            if not found:
                raise RemoteProtocolError("it walked no way at all")
            return found[: limits.WHY_SOURCES_MAX]
        except RmpaError as error:
            remedy = f"run `rmpa why {here}:{topic}` there"
            silent = PathStage("link", StageResult.FAIL, f"{to} does not tell: {error}", remedy)
            return (Diagnosis(name=topic, peer=here, to=to, flows=False, stages=(*begin, silent)),)

    async def _tell_here(self, attached: PeerSession, args: dict[str, Any]) -> tuple[Diagnosis, ...]:
        topic = self._bridge.names.local_name(attached.link.name, name_in(args, "topic"))
        return (await self._arrives(str(attached.link.guid), topic))[: limits.WHY_SOURCES_MAX]

    # --- services ---------------------------------------------------------------------------------------------

    async def _service(self, service: str, name: str | None) -> tuple[Diagnosis, ...]:
        """Walk the way of a service from each peer, or from one, to here."""
        peers = [peer for peer in self._view.snapshot(frozenset()).peers if peer.state in ("linked", "relayed")]
        if name is None:
            carried = [(peer, at) for peer in peers if (at := self._carrier(peer)) is not None]
            offering = [p.guid for p, at in carried if self._services.offers(at, service, p.instance)]
            found = await asyncio.gather(
                *(self._calls(guid, service) for guid in offering or [p.guid for p in peers])
            )
            served = tuple(diagnosis for diagnosis in found if diagnosis.node)
            here = self._view.snapshot(frozenset()).agent.name
            return served or (await self._services.nowhere(here, service, [p.name for p in peers]),)
        return (await self._calls(name, service),)

    async def _calls(self, name: str, service: str) -> Diagnosis:
        snapshot = self._view.snapshot(frozenset())
        peer = find_peer(snapshot, name)
        attached = self._carrier(peer) if peer is not None else None
        if peer is None or attached is None:
            return walk_service(walk_peer(snapshot, name), snapshot.agent.name, name, service)
        service, wire = self._topics.there(peer.name, service)
        far: FarService | None = None
        refusal = ""
        try:
            far = await self._ask(attached, SERVICE, {"service": wire}, FarService)
        except RmpaError as error:
            refusal = str(error)
        near = await self._services.near(attached, service, wire)
        begin = walk_peer(snapshot, name)
        return walk_service(begin, snapshot.agent.name, peer.name, service, near, far, refusal)

    async def _ask(
        self,
        attached: PeerSession,
        what: str,
        args: dict[str, Any],
        kind: type[_T],
        limit: float = limits.ASK_TIMEOUT,
    ) -> _T:
        value = await self._bridge.asks.ask(attached, what, args, limit)
        try:
            return msgspec.convert(value, kind)
        except (msgspec.ValidationError, RecursionError) as error:
            raise RemoteProtocolError(f"it answers in another way: {error}; is it another version?") from None


def _no_link(peer: str) -> PathStage:
    remedy = "ask on its own machine; or try again in a moment"
    return PathStage("link", StageResult.FAIL, f"there is no link to {peer} that could be asked", remedy)
