"""Answers ``rmpa why``: gathers what this side knows, asks the other agent, and has ``monitor.why`` judge it."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING, Any, Final, TypeVar

import msgspec

from rmpa.bridge.messages import Source
from rmpa.bridge.policy import Policy, is_own
from rmpa.bridge.proxy_names import proxy_name
from rmpa.core import limits
from rmpa.core.config_values import did_you_mean
from rmpa.core.errors import ConfigError, RemoteProtocolError, RmpaError
from rmpa.core.names import is_global_name
from rmpa.monitor.diagnosis import Diagnosis, FarSource, FarTopic, Near, Reader, Sight, Stage, Verdict
from rmpa.monitor.why import find_peer, walk_peer, walk_topic
from rmpa.ros.tcpros import printable

if TYPE_CHECKING:
    from rmpa.agent.view import View
    from rmpa.bridge.aio.bridge import Attached, Bridge
    from rmpa.core.config import Settings
    from rmpa.monitor.snapshot import PeerInfo
    from rmpa.ros.aio.core_api import Core

_T = TypeVar("_T")
TOPIC: Final = "why.topic"
"""The question to a publisher's agent: what it knows of a topic (``FarTopic``)."""
HERE: Final = "why.here"
"""The question to a subscriber's agent: why a topic of the asker does not arrive there (``Diagnosis``, a list)."""


class Why:
    """Reads the rooms and asks peers; changes nothing.

    Args:
        settings: The agent's.
        core: Its ROS core.
        bridge: Its bridge.
        view: Its snapshots.
    """

    def __init__(self, settings: Settings, core: Core, bridge: Bridge, view: View) -> None:
        self._core = core
        self._bridge = bridge
        self._view = view
        self.reload(settings)
        bridge.asks.on(TOPIC, self._tell_topic)
        bridge.asks.on(HERE, self._tell_here)

    def reload(self, settings: Settings) -> None:
        """Other settings hold from now on."""
        self._policy = Policy(settings.policy, settings.peers, settings.time)

    async def answer(self, args: dict[str, object]) -> tuple[Diagnosis, ...]:
        """The control socket's op ``why``.

        Args:
            args: ``name``: a topic; ``peer``: one peer's name or GUID, or ``None`` for all that have to do with it.

        Raises:
            ConfigError: The name is none.
        """
        topic, peer = args.get("name"), args.get("peer")
        if not isinstance(topic, str) or not is_global_name(topic):
            raise ConfigError("name", f"{topic!r} is not a topic", "write /name, or PEER:/name")
        if peer is not None:
            found = await self._arrives(str(peer), topic)
            failed = found[0].failed
            if failed is not None and failed.name == "publisher" and self._own(topic):
                return await self._leaves(topic, str(peer))
            return found
        return await self._everywhere(topic)

    # --- this side --------------------------------------------------------------------------------------------

    def _own(self, topic: str) -> dict[str, str]:
        """The module's own publishers of a topic, and their addresses."""
        return {node: uri for node, uri in self._core.publishers(topic).items() if not is_own(node)}

    def _attached(self, guid: str) -> Attached | None:
        return next((at for at in self._bridge.attached() if str(at.link.guid) == guid), None)

    async def _everywhere(self, topic: str) -> tuple[Diagnosis, ...]:
        """Each way that a topic has, in and out; where there is none, what is known of it."""
        snapshot = self._view.snapshot(frozenset({topic}))
        linked = [peer for peer in snapshot.peers if peer.state == "linked"]
        offering = {route.peer for info in snapshot.topics for route in info.routes if route.direction == "in"}
        found: list[Diagnosis] = []
        coming = [peer.guid for peer in linked if peer.name in offering]
        if not coming and not self._own(topic):
            # Nobody offers it: perhaps somebody has it and keeps it at home.
            sights = await asyncio.gather(*(self._sight(peer, topic) for peer in linked))
            coming = [p.guid for p, s in zip(linked, sights, strict=True) if s.far is not None and s.far.sources]
        for diagnoses in await asyncio.gather(*(self._arrives(guid, topic) for guid in coming)):
            found += diagnoses
        if self._own(topic):
            for diagnoses in await asyncio.gather(*(self._leaves(topic, peer.guid) for peer in linked)):
                found += diagnoses
        if not found:
            found.append(self._nowhere(topic, [peer.name for peer in linked]))
        return tuple(found)

    def _nowhere(self, topic: str, linked: list[str]) -> Diagnosis:
        here = self._view.snapshot(frozenset()).agent.name
        if self._own(topic):
            text, remedy = "no peer is linked that it could go to", "`rmpa peer list` tells of the peers"
            stage = Stage("peer", Verdict.FAIL, text, remedy)
            return Diagnosis(name=topic, peer=here, to="", flows=False, stages=(stage,))
        state = self._core.state()
        near = did_you_mean(topic, {*state.publishers, *state.subscribers})
        text = f"neither {here} nor a linked peer ({', '.join(linked) or 'there is none'}) publishes {topic}"
        remedy = f"did you mean {near}?" if near else "`rmpa topic list` shows what there is, `rmpa peer list` who"
        stage = Stage("publisher", Verdict.FAIL, text, remedy)
        return Diagnosis(name=topic, peer="", to=here, flows=False, stages=(stage,))

    async def _arrives(self, name: str, topic: str) -> tuple[Diagnosis, ...]:
        """Walk the ways from a peer to here."""
        peer = find_peer(self._view.snapshot(frozenset()), name)
        if peer is None:
            return walk_topic(Sight(self._near(None, topic)), name)
        sight = await self._sight(peer, topic)
        later = None
        if any(r.state in ("open", "lingering", "opening") for t in sight.near.snapshot.topics for r in t.routes):
            # What moves is told from what stands by looking twice.
            await asyncio.sleep(limits.WHY_WINDOW)
            later = await self._sight(peer, topic)
        return walk_topic(sight, peer.guid, later)

    async def _sight(self, peer: PeerInfo, topic: str) -> Sight:
        """Both sides now."""
        attached = self._attached(peer.guid)
        if attached is None:
            return Sight(self._near(None, topic), refusal="it is not linked")
        try:
            answer = await self._bridge.asks.ask(attached, TOPIC, {"topic": topic})
            far, refusal = _convert(answer, FarTopic), ""
        except RmpaError as error:
            far, refusal = None, str(error)
        return Sight(self._near(attached, topic), far, refusal)

    def _near(self, attached: Attached | None, topic: str) -> Near:
        snapshot = self._view.snapshot(frozenset({topic}))
        if attached is None:
            return Near(snapshot, topic)
        registered, conflict = set(), set()
        readers, mismatches = {}, {}
        publishers = self._core.publishers(topic)
        proxies = dict(attached.inbound)
        for route in (route for info in snapshot.topics for route in info.routes if route.direction == "in"):
            if route.peer != attached.link.name:
                continue
            source = Source(topic, route.node)
            entry = self._bridge.imports.get(attached.peer, source)
            if entry is not None and entry.conflict:
                conflict.add(route.node)
            proxy = proxies.get(route.node)
            name = proxy_name(attached.inbound.prefix, route.node)
            if proxy is not None and publishers.get(name) == proxy.node.uri:
                registered.add(route.node)
            publication = attached.inbound.publication(source)
            readers[route.node] = tuple(
                Reader(
                    number=link.number,
                    node=printable(link.other),
                    held=not link.connected,
                    messages=link.messages,
                    waiting=link.waiting,
                    dropped=link.dropped,
                )
                for link in (publication.connections() if publication is not None else ())
            )
            mismatches[route.node] = self._bridge.mismatches(source)
        return Near(snapshot, topic, frozenset(registered), frozenset(conflict), readers, mismatches)

    # --- the other side ---------------------------------------------------------------------------------------

    async def _leaves(self, topic: str, name: str) -> tuple[Diagnosis, ...]:
        """Let a peer walk the ways from here to it."""
        snapshot = self._view.snapshot(frozenset())
        here = snapshot.agent.name
        begin = walk_peer(snapshot, name)
        peer = find_peer(snapshot, name)
        attached = self._attached(peer.guid) if peer is not None else None
        to = peer.name if peer is not None else name
        if attached is None:
            stages = begin if begin[-1].verdict is Verdict.FAIL else (*begin, _gone(to))
            return (Diagnosis(name=topic, peer=here, to=to, flows=False, stages=stages),)
        try:
            answer = await self._bridge.asks.ask(attached, HERE, {"topic": topic}, limits.WHY_TIMEOUT)
            return _convert(answer, tuple[Diagnosis, ...])
        except RmpaError as error:
            remedy = f"run `rmpa why {here}:{topic}` there"
            silent = Stage("link", Verdict.FAIL, f"{to} does not tell: {error}", remedy)
            return (Diagnosis(name=topic, peer=here, to=to, flows=False, stages=(*begin, silent)),)

    async def _tell_here(self, attached: Attached, args: dict[str, Any]) -> tuple[Diagnosis, ...]:
        return (await self._arrives(str(attached.link.guid), _topic(args)))[: limits.WHY_SOURCES_MAX]

    def _tell_topic(self, attached: Attached, args: dict[str, Any]) -> FarTopic:
        topic = _topic(args)
        state = self._core.state()
        own = list(self._own(topic))
        names = {name for name, nodes in state.publishers.items() if not all(map(is_own, nodes))}
        return FarTopic(
            sources=tuple(self._far(attached, Source(topic, node)) for node in own[: limits.WHY_SOURCES_MAX]),
            subscribers=tuple(n for n in state.subscribers.get(topic, {}) if not is_own(n))[: limits.WHY_SOURCES_MAX],
            near="" if own else did_you_mean(topic, names) or "",
        )

    def _far(self, attached: Attached, source: Source) -> FarSource:
        exports = self._bridge.exports
        local = exports.offered.get(source)
        kind = local.type if local is not None else self._core.type_of(source.topic)
        decision = self._policy.judge(source.topic, kind, source.node)
        flow = self._bridge.outbound.flows.get(source)
        opening = exports.contract(source, attached.peer) is not None
        return FarSource(
            node=source.node,
            type=kind,
            crosses=decision.allowed,
            rule=decision.rule,
            offered=local is not None,
            route="open" if attached.peer in exports.flowing(source) else "opening" if opening else "",
            messages=flow.messages if flow is not None else 0,
            dropped=flow.dropped if flow is not None else 0,
        )


def _gone(peer: str) -> Stage:
    return Stage("link", Verdict.FAIL, f"the link to {peer} has just ended", "try again in a moment")


def _topic(args: dict[str, Any]) -> str:
    topic = args.get("topic")
    if not isinstance(topic, str) or len(topic) > limits.CROSSING_NAME_MAX or not is_global_name(topic):
        raise RemoteProtocolError("the question names no topic")
    return topic


def _convert(value: object, kind: type[_T]) -> _T:
    try:
        return msgspec.convert(value, kind)
    except (msgspec.ValidationError, RecursionError) as error:
        raise RemoteProtocolError(f"it answers in another way: {error}; is it another version?") from None
