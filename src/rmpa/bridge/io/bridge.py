"""The bridge of one agent: carries out what the exports and imports decide."""

from __future__ import annotations

import asyncio
import itertools
import logging
from collections import OrderedDict, deque
from dataclasses import dataclass, field
from itertools import islice
from typing import TYPE_CHECKING, Final

from rmpa.bridge import actions as act
from rmpa.bridge import limits
from rmpa.bridge.data.io.absent_peers import Absent, AbsentPeers
from rmpa.bridge.data.qos_events import shown_seconds
from rmpa.bridge.io.loss_reports import LossReports
from rmpa.bridge.io.node_shutdown import RemoteKills
from rmpa.bridge.messages import (
    Advertise,
    CloseRoute,
    Description,
    Message,
    Mismatch,
    OpenRoute,
    Origin,
    RouteClosed,
    RouteOpened,
    Source,
    decode,
    encode,
)
from rmpa.bridge.naming import Names
from rmpa.bridge.pacing import Pacing
from rmpa.bridge.policy import OWN_NODE, Policy, is_own
from rmpa.bridge.proxy_names import proxy_name, proxy_prefix
from rmpa.bridge.relay import LinkedPeer, Relay
from rmpa.bridge.session.peer_rpc import PeerRpc
from rmpa.bridge.session.proxy_nodes import ProxyNodes
from rmpa.bridge.topics.exports import Exports
from rmpa.bridge.topics.imports import Imports
from rmpa.bridge.topics.io.local_sources import LocalSources
from rmpa.bridge.topics.io.local_subscriptions import LocalSubscriptions
from rmpa.bridge.topics.io.proxies import PeerProxies
from rmpa.bridge.topics.io.remote_subscribers import RemoteSubscribers
from rmpa.bridge.topics.mismatches import Mismatches
from rmpa.config.settings import LimitSettings
from rmpa.core.contract import Contracts, Priority
from rmpa.core.counters import Counters, RefusalLog
from rmpa.core.errors import LimitExceeded, RemoteProtocolError
from rmpa.core.guid import Guid
from rmpa.core.identity import Identity
from rmpa.mesh import limits as mesh_limits
from rmpa.mesh.frames import FrameKind
from rmpa.ros.master.effects import GraphChange, RegistrationKind
from rmpa.ros.node.slave_node import SlaveNode
from rmpa.runtime.event_loop import yield_to_data

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from rmpa.bridge.data.io.export_flow import ExportFlow
    from rmpa.bridge.data.qos_events import QosEvent
    from rmpa.bridge.relay import Place
    from rmpa.bridge.session.part import DataHandler, Part
    from rmpa.config.settings import Settings
    from rmpa.mesh.io.link import PeerLink
    from rmpa.ros.core.api import Core
    from rmpa.ros.wire.xmlrpc import XmlRpcValue

_log = logging.getLogger(__name__)
_ADVERTISE: Final = b'{"op":"advertise"'
_SERVICES: Final = b'{"op":"services"'
_ROUNDING: Final = 0.001


@dataclass(slots=True)
class PeerSession:
    """One link and what came of it."""

    peer: int
    link: PeerLink
    inbound: PeerProxies
    away: asyncio.TimerHandle | None = None
    """Runs while the link is gone and reliable routes wait for the peer; ``link`` is the last one."""
    away_since: float = 0.0
    """When that link ended, monotonic seconds."""
    back: asyncio.TimerHandle | None = None
    """Runs while it is back and may still ask for routes that waited."""
    untold: bool = False
    """Whether it has not been told yet of all that it may ask for: ``back`` runs anew when it has."""
    takers: dict[int, DataHandler] = field(default_factory=dict)
    """What comes on routes that are not topics'; by the parts."""


class Bridge:
    """Joins the local core and the links of the mesh.

    Args:
        core: The local core, started.
        policy: What may cross.
        contracts: What its topics need.
        names: How names read at the peers, and theirs here.
        relay: Whether what comes from one peer is offered to others.
        most: How much of one peer is taken, and how much is offered.
        rng: Uniform numbers in [0, 1) for back-off jitter.
    """

    def __init__(
        self,
        core: Core,
        policy: Policy,
        *,
        rng: Callable[[], float],
        contracts: Contracts | None = None,
        names: Names | None = None,
        relay: bool = False,
        most: LimitSettings | None = None,
    ) -> None:
        most = most if most is not None else LimitSettings()
        self._core = core
        self.names = names if names is not None else Names()
        """How names read at the peers, and theirs here; another one after ``reload``."""
        self._imports = Imports(policy, rng, contracts, self._position, self.names, most)
        self.counters = Counters()
        self.asks = PeerRpc(self.counters)
        self._kills = RemoteKills(self.asks)
        self._node = SlaveNode(
            OWN_NODE,
            core.node_host,
            core.uri,
            advertised_host=core.node_address,
            counters=self.counters,
            on_param_update=self._param_update,
            on_kill=self._kills.own,
            taps=lambda: self._outbound.connections,
        )
        self.proxy_nodes = ProxyNodes(core, self.counters)
        """How what stands for the nodes of peers listens."""
        self._outbound = LocalSubscriptions(
            core,
            self._node,
            on_described=self._described,
            on_lost=self._lost,
            on_given_up=self._given_up,
            on_let_go=lambda keys: self.losses.let_go(keys, self._outbound.lost),
            on_missed=self._missed,
            on_oversized=self._oversized,
            on_malformed=lambda source, text: self._warn("publisher.malformed", str(source), f"{source}: {text}"),
        )
        self._exports = Exports(policy, contracts, self.names, most, self._outbound)
        self._absent = AbsentPeers(lambda peer: self._act(self._exports.unclaimed(peer)), self._outbound.forget)
        self._numbers = itertools.count(1)
        self._by_number: dict[int, PeerSession] = {}
        self._by_link: dict[PeerLink, PeerSession] = {}
        self._closing: set[asyncio.Task[None]] = set()
        self._timer: asyncio.TimerHandle | None = None
        self._ticker: asyncio.TimerHandle | None = None
        self._reconciler: asyncio.TimerHandle | None = None
        self._rescan: asyncio.Handle | None = None
        self._closed = False
        # Topics of the local graph to look at, advertisements to learn, and what is to be done: each is worked off a
        # little at a time, so that a graph of thousands delays no message.
        # Ordered: to take the first of a plain dict passes over all that were taken before it.
        self._changed: OrderedDict[str, None] = OrderedDict()
        self._learning: deque[tuple[PeerSession, bytes | Iterator[Advertise]]] = deque()
        self._learning_bytes = 0
        self._pacing = Pacing()
        self._forgetting: deque[Iterator[act.Action]] = deque()
        self._rejudging: Iterator[list[act.Action]] = iter(())
        self._actions: deque[act.Action] = deque()
        self._acting = False
        self._mismatches = Mismatches()
        self._refusals = RefusalLog(_log, self.counters)
        get = self._by_number.get
        self.losses = LossReports(self._exports, get, self._absent, self.asks, self.counters, self._refusals)
        """What does not reach its listeners, for the monitor."""
        self._presence = RemoteSubscribers(self._exports, self._imports, self._by_number.get, self._refusals)
        self.relay = Relay(enabled=relay)
        """What is passed on between peers."""
        self._local = LocalSources(core, self.relay, lambda source: self._exports.description(source) is not None)
        self._relayed: dict[str, str] = {}
        self._parts: list[Part] = [self.asks, self._presence]

    def place(self, identity: Identity) -> None:
        """Who we are, from now on: what comes back to us by relays is told by it. There are no links yet."""
        self.relay.instance = self._imports.ways.instance = identity.instance.hex()

    def add(self, part: Part) -> None:
        """Let a part hear of everything; before ``start()``."""
        self._parts.append(part)

    def reload(self, settings: Settings) -> None:
        """Other rules hold from now on: policy, contracts, names, and what the parts have.

        What they leave as it is goes on untouched; the rest follows in a moment.
        """
        policy, contracts = Policy(settings.policy, settings.peers, settings.time), Contracts(settings.contracts)
        self.names = Names(settings.peers)
        most = settings.limits
        self._act(self._exports.rules(policy, contracts, self.names, most))
        self._rejudging = self._imports.rules(policy, contracts, self.names, self._loop.time(), most)
        self._scan_all()
        for part in self._parts:
            part.reload(settings)

    @property
    def node(self) -> SlaveNode:
        """The agent's own node in the local graph."""
        return self._node

    @property
    def exports(self) -> Exports:
        """The outbound plan, for the monitor."""
        return self._exports

    @property
    def imports(self) -> Imports:
        """The inbound plan, for the monitor."""
        return self._imports

    @property
    def outbound(self) -> LocalSubscriptions:
        """The outbound side, for the monitor."""
        return self._outbound

    def mismatches(self, source: Source) -> tuple[str, ...]:
        """What did not fit a source, here or over there, ready to read; forgotten with the source."""
        return self._mismatches.texts(source)

    def attached(self) -> Iterator[PeerSession]:
        """Every peer whose link is up, for the monitor."""
        return (attached for attached in self._by_number.values() if attached.away is None)

    def everyone(self) -> Iterator[PeerSession]:
        """These, and the peers that are away while reliable routes wait for them."""
        return iter(self._by_number.values())

    async def start(self) -> None:
        """Follow the local graph."""
        self._loop = asyncio.get_running_loop()
        await self._node.start()
        await self.proxy_nodes.start()
        self._core.on_change(self._graph_changed)
        self._scan_all()
        self._reconciler = self._loop.call_later(limits.RECONCILE_INTERVAL, self._reconcile)
        for part in self._parts:
            part.start()

    async def close(self) -> None:
        """Retract all that came from elsewhere and leave all local publishers."""
        self._closed = True
        for timer in (self._ticker, self._timer, self._reconciler, self._rescan):
            if timer is not None:
                timer.cancel()
        for attached in list(self._by_number.values()):
            self._give_up(attached)
        if self._closing:
            await asyncio.gather(*self._closing)
        for part in reversed(self._parts):
            await part.close()
        self._outbound.close()
        await self.proxy_nodes.close()
        await self._node.close()

    # --- the mesh's side ---------------------------------------------------------------------------------------

    def link_up(self, link: PeerLink) -> None:
        """A link is up: tell what we have, and let what it has appear, or go on where its last link ended."""
        back = self._claim(link)
        if back is not None:
            _log.info("= %s is back: reliable topics go on", link.name)
            back.link = link
            back.inbound.time.resumed_at = lambda: link.resumed_at
            self._by_link[link] = back
            self._await_claims(back)
            self._introduce(back)
            self._parts_link_up(back)
            self._schedule()
            return
        absent = self._absent.back(link.identity)
        again = absent is not None and absent.identity.instance == link.identity.instance
        peer = absent.peer if absent is not None and again else next(self._numbers)
        prefix = proxy_prefix(link.identity, self._prefixes(link.identity.instance.hex()))
        inbound = PeerProxies(
            self._core,
            prefix,
            nodes=self.proxy_nodes,
            counters=self.counters,
            on_demand=lambda source, wanted: self._demand(peer, source, wanted=wanted),
            on_mismatch=lambda source, subscriber, text: self._mismatched(peer, source, subscriber, text),
            on_occurred=lambda source, occurred: self._occurred(peer, source, occurred),
            on_listeners=lambda source: self._presence.changed(peer, source),
            pasts=absent.pasts if absent is not None else None,
            on_kill=lambda node, caller, reason: self._kills.proxy(attached, node, caller, reason),
        )
        inbound.time.resumed_at = lambda: link.resumed_at
        attached = PeerSession(peer, link, inbound)
        if absent is not None:
            if not again:
                self._exports.inherit(absent.peer, peer)
                self._outbound.inherit(absent.peer, peer)
            away = shown_seconds(self._loop.time() - absent.since)
            _log.info("= %s is back after %s%s", link.name, away, "" if again else ", another run of it")
            self._await_claims(attached)
        self._by_number[peer] = self._by_link[link] = attached
        self._introduce(attached)
        self._parts_link_up(attached)
        self._schedule()

    def _introduce(self, attached: PeerSession) -> None:
        who = attached.link.identity
        linked = LinkedPeer(who.name, who.instance.hex(), who.guid)
        self._act(self._imports.link_up(attached.peer, who.name, linked))
        self._act(self._exports.link_up(attached.peer, who.name, linked.instance))
        self._told(attached)

    def _prefixes(self, instance: str) -> set[str]:
        """The namespaces of proxies that a module must leave to others."""
        linked = (a for a in self._by_number.values() if a.link.identity.instance.hex() != instance)
        relayed = (prefix for other, prefix in self._relayed.items() if other != instance)
        return {*(attached.inbound.prefix for attached in linked), *relayed}

    def _stands_for(self, origin: Origin) -> str:
        """What stands here for a node that a relay passes on: the same as if its module had a link."""
        prefix = self._relayed.get(origin.instance)
        if prefix is None:
            module = Identity(Guid.parse(origin.guid), bytes.fromhex(origin.instance), origin.name)
            prefix = self._relayed[origin.instance] = proxy_prefix(module, self._prefixes(origin.instance))
        return proxy_name(prefix, origin.node)

    def _parts_link_up(self, attached: PeerSession) -> None:
        for part in self._parts:
            part.link_up(attached)

    def link_down(self, link: PeerLink) -> None:
        """A link is gone: retract what came over it, but for what a reliable route brings back."""
        attached = self._by_link.pop(link, None)
        if attached is None:
            return
        if attached.back is not None:
            attached.back.cancel()
            attached.back = None
        interrupted = attached.inbound.link_down()
        if interrupted:
            # What is published until the next link stands is sent to nobody, and has no number that could be missed.
            self.counters.add("route.interrupted", interrupted)
        for part in self._parts:
            part.link_down(attached)
        attached.takers.clear()
        self._learning = deque(lesson for lesson in self._learning if lesson[0] is not attached)
        self._learning_bytes = sum(len(lesson) for _, lesson in self._learning if isinstance(lesson, bytes))
        exports, _ = self._exports.link_away(attached.peer)
        self._act(exports)
        attached.away_since = self._loop.time()
        if link.silent:
            # Most silences end soon, by a new link: until then nobody need notice.
            attached.away = self._loop.call_later(mesh_limits.AWAY_GRACE, self._stay_away, attached)
            imports, _ = self._imports.link_away(attached.peer, briefly=True)
            self._act(imports)
        else:
            self._stay_away(attached)

    def _stay_away(self, attached: PeerSession) -> None:
        """A peer without a link does not come back at once: only what a reliable route needs waits for it."""
        name = attached.link.name
        if not self._exports.waits_for(attached.peer) and not self._imports.waits_for(attached.peer):
            self._act(self._imports.detached(attached.peer))
            self._give_up(attached)
            return
        imports, _ = self._imports.link_away(attached.peer)
        self._act(imports)
        outages = {*self._imports.outages(attached.peer), self._exports.outage(attached.peer)}
        _log.info("= %s is away: its reliable topics wait for %s", name, shown_seconds(max(outages)))
        self._outlast(attached)

    def _outlast(self, attached: PeerSession) -> None:
        """A peer has been away for a while: give up what does not wait for longer, and all when nothing does."""
        away_for = self._loop.time() - attached.away_since
        self._act(self._imports.outlasted(attached.peer, away_for))
        outages = {*self._imports.outages(attached.peer), self._exports.outage(attached.peer)}
        due = min((outage for outage in outages if outage > away_for), default=None)
        if due is None:
            self._give_up(attached)
        else:
            # A moment later, for the loop's clock may round to before it.
            when = attached.away_since + due + _ROUNDING
            attached.away = self._loop.call_at(when, self._outlast, attached)

    def _await_claims(self, attached: PeerSession) -> None:
        """A peer is back: it can ask for what waits for it as soon as it was told of it."""
        attached.untold = True
        attached.back = self._loop.call_later(mesh_limits.RESUME_CLAIM_MAX, self._unclaimed, attached)

    def _told(self, attached: PeerSession) -> None:
        """A peer may have been told everything: then it asks soon. A large graph takes long on a busy lane."""
        if attached.back is not None and attached.untold and not self._exports.beginning(attached.peer):
            attached.untold = False
            attached.back.cancel()
            attached.back = self._loop.call_later(mesh_limits.RESUME_CLAIM, self._unclaimed, attached)

    def _unclaimed(self, attached: PeerSession) -> None:
        """A peer has known everything for a while: what it has not asked for is not wanted any more."""
        attached.back = None
        self._act(self._exports.unclaimed(attached.peer))
        self._outbound.unclaimed(attached.peer)

    def clock(self, link: PeerLink) -> None:
        """A link knows its peer's clock better."""
        attached = self._by_link.get(link)
        if attached is not None:
            attached.inbound.time.set(link.clock_offset, link.clock_error)

    def lane_lost(self, link: PeerLink) -> None:
        """A link has lost its bulk lane's connection, and half a message perhaps on either side."""
        attached = self._by_link.get(link)
        if attached is not None:
            for flow in attached.inbound.flows.values():
                if flow.contract.priority is not Priority.HIGH:
                    flow.torn()
            self._outbound.lane_lost(attached.peer)
            for part in self._parts:
                part.lane_lost(attached)

    def mark(self, link: PeerLink, kind: FrameKind, route: int, sequence: int) -> None:
        """An acknowledgement or the answer to a fence came; one for a route that was closed meanwhile is dropped."""
        attached = self._by_link.get(link)
        leg = self._outbound.leg(attached.peer, route) if attached is not None else None
        if leg is None:
            return
        if kind is FrameKind.ACK:
            leg.acknowledged(sequence)
        elif kind is FrameKind.FENCED:
            leg.fenced(sequence)

    def control(self, link: PeerLink, payload: bytes | bytearray | memoryview) -> None:
        """A control frame came.

        Raises:
            RemoteProtocolError: It is not a message that belongs here; the link is to be closed.
        """
        attached = self._by_link.get(link)
        if attached is None:
            return
        if payload[: len(_ADVERTISE)] != _ADVERTISE:
            if len(payload) > limits.ADVERTISEMENT_MAX and payload[: len(_SERVICES)] == _SERVICES:
                raise LimitExceeded("advertisement", len(payload), limits.ADVERTISEMENT_MAX)
            self._dispatch(attached, decode(payload))
            return
        if len(payload) > limits.ADVERTISEMENT_MAX:
            raise LimitExceeded("advertisement", len(payload), limits.ADVERTISEMENT_MAX)
        # It takes long to read, and no data waits for it: this is a reader of data, so not now.
        self._learning.append((attached, bytes(payload)))
        self._learning_bytes += len(payload)
        self._schedule()
        while self._learning_bytes > limits.ADVERTISED_WAITING_BYTES:
            self._learn(*self._learning.popleft())

    def data(self, link: PeerLink, route: int, sequence: int, stamp_ns: int, payload: memoryview) -> None:
        """A data frame came: the hot path. One for a route that was closed meanwhile is dropped."""
        attached = self._by_link.get(link)
        flow: DataHandler | None = attached.inbound.flows.get(route) if attached is not None else None
        if flow is None:
            flow = attached.takers.get(route) if attached is not None else None
            if flow is None:
                self.counters.add("route.unknown")
                return
        if len(payload) < 4 or int.from_bytes(payload[:4], "little") != len(payload) - 4:
            raise RemoteProtocolError(
                f"a data frame of {len(payload)} bytes on route {route} does not hold one message"
            )
        flow.message(sequence, stamp_ns, payload)

    def part(self, link: PeerLink, route: int, sequence: int, stamp_ns: int, flags: int, part: memoryview) -> None:
        """A part of a large message came; one for a route that was closed meanwhile is dropped."""
        attached = self._by_link.get(link)
        if attached is None:
            return
        flow: DataHandler | None = attached.inbound.flows.get(route) or attached.takers.get(route)
        if flow is None:
            self.counters.add("route.unknown")
        else:
            flow.part(sequence, stamp_ns, flags, part)

    def _dispatch(self, attached: PeerSession, message: Message) -> None:
        peer, now = attached.peer, self._loop.time()
        match message:
            case Advertise():
                for portion in self._portions(attached, message):
                    self._act(self._imports.advertised(peer, portion, now))
            case OpenRoute():
                self._act(self._exports.opened(peer, message))
            case RouteOpened():
                self._act(self._imports.opened(peer, message, now))
            case CloseRoute():
                self._act(self._exports.closed(peer, message))
            case RouteClosed():
                if actions := self._imports.closed(peer, message, now):
                    _log.info("< %s closes route %d: %s", attached.link.name, message.route, message.reason)
                    self._act(actions)
            case Mismatch():
                self._mismatched_there(attached, message)
            case _ if not any(part.message(attached, message) for part in self._parts):
                raise RemoteProtocolError(f"a message of kind {type(message).__name__} that nobody here takes")

    def _mismatched_there(self, attached: PeerSession, message: Mismatch) -> None:
        source = self._exports.local(attached.peer, message.source)
        if source is None:
            return  # it went meanwhile
        subscriber = f"{attached.link.name}{message.subscriber}"
        if not message.text:
            self._mismatches.mended(source, subscriber)
            return
        self._mismatches.add(source, subscriber, message.text)
        who = f"{attached.link.name}: {source}"
        self._warn("mismatch.remote", who, f"{who}: {message.text}")

    def _claim(self, link: PeerLink) -> PeerSession | None:
        """The peer that was away, if it is this one; another instance in its place shows that it will not come."""
        for attached in list(self._by_number.values()):
            if attached.away is None:
                continue
            if attached.link.identity.instance == link.identity.instance:
                attached.away.cancel()
                attached.away = None
                return attached
            if attached.link.guid.place == link.guid.place or attached.link.name == link.name:
                self._give_up(attached)
        return None

    def _give_up(self, attached: PeerSession) -> None:
        """A peer will not come back: retract all that is left of it."""
        for timer in (attached.away, attached.back):
            if timer is not None:
                timer.cancel()
        self._by_number.pop(attached.peer, None)
        self._mismatches.peer_gone(attached.link.name)
        if self._by_link.pop(attached.link, None) is not None:
            for part in self._parts:
                part.link_down(attached)
        for part in self._parts:
            part.gone(attached)
        absent = Absent(attached.peer, attached.link.identity, attached.away_since, attached.inbound.leave())
        counting = self._exports.waits_for(attached.peer)
        for action in self._exports.link_down(attached.peer, counting=not self._closed):
            self._act([action])
        # Its actions are what closing the inbound side does at once.
        self._forgetting.append(self._imports.link_down(attached.peer))
        self.relay.peer_gone(attached.peer)
        self._pacing.forget(attached.peer)
        self._act(self._imports.unlinked(attached.peer))
        self._schedule()
        task = asyncio.create_task(attached.inbound.close(), name=f"retract {attached.inbound.prefix}")
        self._closing.add(task)
        task.add_done_callback(self._closing.discard)
        self._set_timer()
        if not self._closed and (counting or absent.pasts):
            self._absent.add(absent)
        else:
            self._outbound.forget(attached.peer)

    def _position(self, peer: int, source: Source) -> tuple[int, int] | None:
        attached = self._by_number.get(peer)
        return attached.inbound.position(source) if attached is not None else None

    def _occurred(self, peer: int, source: Source, occurred: QosEvent) -> None:
        attached = self._by_number.get(peer)
        if attached is not None:
            text = f"{attached.link.name}: {source}: {occurred.text}"
            self._warn(f"contract.{occurred.kind.value}", f"{peer} {source}", text)

    # --- the local graph's side --------------------------------------------------------------------------------

    def _graph_changed(self, change: GraphChange) -> None:
        self._local.changed(change)
        if change.kind is RegistrationKind.SUBSCRIBER and self._mismatches:
            self._comes_anew(change.name, change.node)
        if change.kind is not RegistrationKind.SERVICE:
            self._changed[change.name] = None
            self._schedule()
        for part in self._parts:
            part.graph_changed(change)

    def _param_update(self, key: str, _value: XmlRpcValue) -> bool:
        return sum(part.param_update(key) for part in self._parts) > 0  # each of them hears it

    def _schedule(self) -> None:
        if self._rescan is None and not self._closed:
            self._rescan = self._loop.call_soon(self._scan)

    def _scan_all(self) -> None:
        self._changed |= dict.fromkeys((*self._exports.topics, *self._core.state().publishers))
        self._schedule()

    def _scan(self) -> None:
        """Do a part of what has to be done since graphs have changed, the local one or a peer's."""
        self._rescan = None
        for _ in range(min(len(self._changed), limits.RESCANNED_AT_ONCE)):
            topic, _ = self._changed.popitem(last=False)
            yield_to_data()
            self._look_at(topic)
        told = self._exports.tell(self._may_tell)
        self._act(told)
        if told:
            for attached in self._by_number.values():
                self._told(attached)
        if self._learning:
            self._learn(*self._learning.popleft())
        if self._forgetting and not tuple(islice(self._forgetting[0], limits.LEARNT_AT_ONCE)):
            self._forgetting.popleft()
        rejudged = tuple(islice(self._rejudging, limits.LEARNT_AT_ONCE))
        # In one: what data brings in between belongs behind all of it.
        self._act([action for actions in rejudged for action in actions])
        if self._changed or self._learning or self._forgetting or rejudged or (told and self._exports.untold):
            self._schedule()
        elif self._exports.untold:
            self._scan_later()
        elif self._mismatches:
            self._mismatches.keep(lambda source: source in self._exports.offered or self._imports.knows(source))

    def _scan_later(self) -> None:
        """Peers have to be told more, but what they were told is still on its way."""
        if self._rescan is None and not self._closed:
            self._rescan = self._loop.call_later(limits.TELL_PAUSE, self._scan)

    def _may_tell(self, peer: int) -> bool:
        attached = self._by_number.get(peer)
        busy = attached is not None and attached.link.busy
        return self._pacing.ready(peer, self._loop.time(), busy=busy)

    def _learn(self, attached: PeerSession, lesson: bytes | Iterator[Advertise]) -> None:
        """Read an advertisement, or take in the next portion of one that was read."""
        if isinstance(lesson, bytes):
            self._learning_bytes -= len(lesson)
        if attached.peer not in self._by_number:
            return
        if isinstance(lesson, bytes):
            try:
                message = decode(lesson)
            except RemoteProtocolError as error:
                self._refuse(attached, error)
                return
            if isinstance(message, Advertise):
                self._learning.appendleft((attached, self._portions(attached, message)))
        elif (portion := next(lesson, None)) is not None:
            self._learning.appendleft((attached, lesson))
            self._act(self._imports.advertised(attached.peer, portion, self._loop.time()))

    def _refuse(self, attached: PeerSession, error: RemoteProtocolError) -> None:
        """A peer said what cannot be: close its link."""
        text = f"{attached.link.name} broke the protocol: {error}"
        self._warn("link.malformed", attached.link.remote_endpoint[0], text)
        attached.link.abort(text)

    def _portions(self, attached: PeerSession, message: Advertise) -> Iterator[Advertise]:
        if message.added or message.removed:
            changes = (len(message.added), len(message.removed))
            _log.info("< %s publishes %d more topics, %d less", attached.link.name, *changes)
        return self._imports.portions(attached.peer, message)

    def _look_at(self, topic: str) -> None:
        local = self._local.of(topic)
        self._act(self._exports.graph(topic, local | self._local.relayed(topic)))
        self._act(self._imports.local_type(topic, next((one.type for one in reversed(local.values())), None)))

    def _reconcile(self) -> None:
        self._reconciler = self._loop.call_later(limits.RECONCILE_INTERVAL, self._reconcile)
        self._scan_all()
        self._absent.expire(self._loop.time())
        publishers = self._core.state().publishers
        self._forget_unheard()
        for attached in list(self._by_number.values()):
            yield_to_data()
            if again := attached.inbound.reconcile(publishers):
                self.counters.add("proxy.registered_again", again)
        used = {name for attached in self._by_number.values() for name in attached.inbound.names.values()}
        self._relayed = {
            instance: prefix
            for instance, prefix in self._relayed.items()
            if any(name.startswith(f"{prefix}/") for name in used)
        }
        for part in self._parts:
            yield_to_data()
            part.reconcile()

    def _forget_unheard(self) -> None:
        """What nobody subscribes to any more is not missed."""
        subscribers = self._core.state().subscribers

        def subscribed(topic: str) -> bool:
            return any(not is_own(node) for node in subscribers.get(topic, ()))

        self._absent.unheard(subscribed)
        for attached in self._by_number.values():
            attached.inbound.unheard(subscribed)

    def _demand(self, peer: int, source: Source, *, wanted: bool) -> None:
        self._act(self._imports.demand(peer, source, self._loop.time(), wanted=wanted))

    def _tick(self) -> None:
        """Wake up now and then while data comes: a link that was silent is told from an agent that slept."""
        self._ticker = None
        if not self._closed and any(attached.inbound.flows for attached in self._by_number.values()):
            self._ticker = self._loop.call_later(mesh_limits.STALE_TICK, self._tick)

    def _mismatched(self, peer: int, source: Source, subscriber: str, text: str) -> None:
        self._mismatches.add(source, subscriber, text)
        self._act(self._imports.mismatched(peer, source, subscriber, text))

    def _comes_anew(self, topic: str, subscriber: str) -> None:
        """A local subscriber has gone, or begins again: that it did not fit before is over, here and over there."""
        for peer, source in list(self._imports.at(topic)):
            if self._mismatches.mended(source, subscriber):
                self._act([act.Send(peer, Mismatch(source.topic, source.node, subscriber, ""))])

    def _described(self, source: Source, description: Description) -> None:
        self._act(self._exports.described(source, description))

    def _lost(self, source: Source, reason: str) -> None:
        self._act(self._exports.lost(source, reason))

    def _missed(self, source: Source, peer: int, count: int, why: str) -> None:
        self.losses.missed(source, peer, count, why)

    def _oversized(self, source: Source, flow: ExportFlow) -> None:
        self.losses.oversized(source, flow)

    def _given_up(self, source: Source, peer: int) -> None:
        self.losses.uncounted(source)
        self._act(self._exports.given_up(source, peer))

    # --- carrying out ------------------------------------------------------------------------------------------

    def _act(self, actions: list[act.Action]) -> None:
        """Do these behind those that are being done: in between data may come first, and bring more of them."""
        for action in actions:
            if isinstance(action, act.Describe):
                self._do(action)  # now: data may be right behind it, and nothing that waits belongs before it
            else:
                self._actions.append(action)
        if self._acting:
            return
        self._acting = True
        try:
            while self._actions:
                self._do(self._actions.popleft())
                yield_to_data()
        finally:
            self._acting = False
        self._set_timer()

    def _do(self, action: act.Action) -> None:
        match action:
            case act.Warn():
                self._warn(action.kind, action.who, action.text)
            case act.Send():
                attached = self._by_number.get(action.peer)
                if attached is not None and attached.away is None:
                    attached.link.send_control(encode(action.message))
            case act.Publish() | act.Retract() | act.Describe() | act.Detach():
                self._do_inbound(action)
            case _:
                self._do_outbound(action)

    def _do_outbound(self, action: act.Outgoing) -> None:
        match action:
            case act.Connect():
                self._outbound.connect(action)
            case act.Disconnect():
                self._outbound.disconnect(action.source)
            case act.SuspendRoute():
                self._presence.route_over(action.peer, action.source)
                self._outbound.suspend_route(action)
            case act.AddRoute():
                attached = self._by_number.get(action.peer)
                if attached is not None:
                    try:
                        self._outbound.add_route(action, attached.link)
                        flow = self._outbound.flows[action.source]
                        self.losses.tell_oversized(action.source, flow, action.peer)
                    except RemoteProtocolError as error:
                        # Here, for what waits to be done has other causes. The next link begins a new numbering.
                        self._refuse(attached, error)
                        if attached.away is None:
                            self._act(self._exports.closed(action.peer, CloseRoute(action.route)))
                        else:
                            self._act(self._exports.given_up(action.source, action.peer))
            case act.RemoveRoute():
                self._presence.route_over(action.peer, action.source)
                self._outbound.remove_route(action)
                attached = self._by_number.get(action.peer)
                if attached is not None and attached.away is None:
                    attached.link.close_route(action.route)

    def _do_inbound(self, action: act.Incoming) -> None:
        attached = self._by_number.get(action.peer)
        if attached is None:
            return
        match action:
            case act.Publish():
                self._publish(attached, action)
            case act.Retract():
                self.relay.gone(action.peer, action.source)
                attached.inbound.retract(action)
            case act.Describe():
                # This link: of the next one the same number is another source's route.
                route, link = action.route, attached.link
                if self._ticker is None:
                    self._ticker = self._loop.call_later(mesh_limits.STALE_TICK, self._tick)
                attached.inbound.describe(action, lambda last: link.mark(FrameKind.ACK, route, last))
                self._presence.changed(action.peer, action.source)
            case act.Detach():
                attached.inbound.detach(action)

    def _publish(self, attached: PeerSession, action: act.Publish) -> None:
        source = action.source
        name = self.stand_in(attached, source.node, action.origin)
        self.relay_on(attached, source, (action.topic or source.topic, name), action.origin)
        attached.inbound.publish(action)

    def stand_in(self, attached: PeerSession, node: str, origin: Origin | None) -> str:
        """The name of what stands here for a node of a peer, or for one that it passes on."""
        if origin is None:
            return proxy_name(attached.inbound.prefix, node)
        name = attached.inbound.names[node] = self._stands_for(origin)
        return name

    def relay_on(self, attached: PeerSession, source: Source, place: Place, origin: Origin | None) -> None:
        """Let what a peer brings be offered to others, if this module relays."""
        if self.relay.enabled:
            who = attached.link.identity
            whose = origin or Origin(who.name, str(who.guid), who.instance.hex(), source.node)
            self.relay.shown(attached.peer, source, place, whose)

    def _warn(self, kind: str, who: str, text: str) -> None:
        self._refusals.refuse(self._loop.time(), kind, who, text)

    def _set_timer(self) -> None:
        due = self._imports.next_timer()
        if self._timer is not None:
            if self._timer.when() == due:
                return
            self._timer.cancel()
            self._timer = None
        if due is not None and not self._closed:
            self._timer = self._loop.call_at(due, self._on_timer)

    def _on_timer(self) -> None:
        self._timer = None
        self._act(self._imports.handle_timer(self._loop.time()))
