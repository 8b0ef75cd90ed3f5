"""Which local sources are offered to which peers, and how those flow that a peer wants (one copy for each peer).

A source is connected while at least one peer wants it::

    idle ──open──► connecting ──described──► live
      ▲               │ refused, lost          │ lost, restarted, gone
      └───────────────┴────────────────────────┘  every route of it: Closed(reason)

A peer that lost a route opens it again: the receiving side retries. A reliable route outlives its link: it is
suspended, its source stays connected, and the peer's next ``OpenRoute`` continues it (``link_away``).

The agent subscribes as its own node, and registers that, so that ROS tools show it. Messages to and from peers carry
wire names (``bridge.proxies``). Everything else here is keyed by local names.
"""

from __future__ import annotations

import asyncio
import logging
from collections import OrderedDict
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import msgspec
from msgspec import UNSET

from rmpa.bridge import limits
from rmpa.bridge.data.export import ExportFlow, ExportRoute, RelayedFlow
from rmpa.bridge.data.route_sender import ReliableRouteSender, RouteSender
from rmpa.bridge.messages import (
    Advertise,
    CloseRoute,
    Description,
    OpenRoute,
    RouteClosed,
    RouteOpened,
    Source,
    TopicOffer,
)
from rmpa.bridge.offers import TopicBook
from rmpa.bridge.policy import Local, Relay
from rmpa.bridge.topics.import_route import ImportRoute
from rmpa.bridge.topics.joins import ServedJoin
from rmpa.bridge.topics.reports import is_watched, report_given_up, report_missed, report_oversized, tell_oversized
from rmpa.config.peer_rules import Access
from rmpa.core.contract import Durability, combine
from rmpa.core.identity import OWN_NODE, is_own, proxied_node, proxy_name
from rmpa.core.limits import UINT32_MAX
from rmpa.mesh import limits as mesh_limits
from rmpa.mesh.reliable import ResumeTable
from rmpa.ros.node.subscription import InProcessConnection, PublisherConnection, TopicConnection
from rmpa.ros.wire.tcpros import ANY, TopicDescription
from rmpa.runtime.accept import DESCRIPTORS
from rmpa.runtime.loop import MachineTimer

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping

    from rmpa.bridge.messages import Audience, Origin
    from rmpa.bridge.sessions import PeerSession
    from rmpa.bridge.topics.part import Topics
    from rmpa.ros.core.external import Core
    from rmpa.ros.node.publication import Publication

_log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class LocalSource(Local):
    """A source of the local graph: its message type, its node's slave API, and its origin if it is relayed."""

    type: str
    uri: str
    origin: Origin | None = None


def local_sources(
    core: Core, relay: Relay, topic: str, flows: Callable[[Source], bool] = lambda _: False
) -> dict[str, LocalSource]:
    """The publishers of a topic, by node: those of this module that can be reached, and the proxies that it relays.

    Args:
        core: The local core.
        relay: Which proxies are relayed.
        topic: The topic.
        flows: Whether the agent is connected to a source; such a source counts as reachable, whatever the core found.
    """
    unreachable, found = core.unreachable(), {}
    for node, uri in core.publishers(topic).items():
        origin = relay.origin((topic, node)) if is_own(node) else None
        gone = node in unreachable and unreachable[node].withdrawn and not flows(Source(topic, node))
        if origin is not None or not (is_own(node) or gone):
            found[node] = LocalSource(core.type_of(topic, node), uri, origin)
    return found


def _description(fields: Mapping[str, str]) -> Description:
    about = TopicDescription.from_header(fields)
    text = about.definition.encode(errors="surrogateescape").decode("latin-1")
    return Description(about.type, about.md5sum, text, about.latching)


class Exports(TopicBook[LocalSource, TopicOffer, ExportRoute]):
    """The outbound half of topics.

    Attributes:
        flows: The sources that the agent is connected to, each with its routes by peer.
        _cut: The run of each named peer that had no link when a route of it ended, so that it may miss messages.
        _parked: The reliable routes whose peers are absent, within the bounds that their kept messages have together.
    """

    counter, access, owner, message = "sources.too_many", Access.SUBSCRIBE, "the node", Advertise
    _out: Topics

    def __init__(self, out: Topics) -> None:
        super().__init__(out)
        self.flows: dict[Source, ExportFlow] = {}
        self._cut: OrderedDict[tuple[str, Source], str] = OrderedDict()
        # Random, so that no earlier run of this agent, and no other agent, is likely to have had it.
        self._epoch = int(out.rng() * UINT32_MAX)
        self._parked: ResumeTable[ExportRoute] = ResumeTable()
        self._timer = MachineTimer(self._parked.next_timer, lambda now: self._give_up(self._parked.expire(now)))

    @property
    def connections(self) -> list[TopicConnection]:
        """The connections to local publishers."""
        return [flow.connection for flow in self.flows.values()]

    def topics_for(self, peer: int) -> int:
        """How many topics a peer was told."""
        told = self.peers.get(peer)
        return len({source.topic for source in told.offers}) if told is not None else 0

    def routes(self, source: Source) -> Mapping[int, ExportRoute]:
        """The routes of a source by peer, with the suspended ones."""
        flow = self.flows.get(source)
        return flow.routes if flow is not None else {}

    def of(self, peer: int) -> list[ExportRoute]:
        """The routes to a peer, with the suspended ones."""
        return [flow.routes[peer] for flow in self.flows.values() if peer in flow.routes]

    def senders(self, peer: int) -> list[RouteSender]:
        """The senders of the routes that a linked peer has open, and of the subscribers that join them."""
        told = self.peers.get(peer)
        routes = told.routes.values() if told is not None else ()
        own = [route.sender for route in routes if route.sender is not None]
        joins = (join for route in routes for join in route.joins.values())
        return own + [join.own for join in joins if isinstance(join, ServedJoin)]

    def sender(self, peer: int, number: int) -> RouteSender | None:
        """What sends on a route to a peer, which is a source's or a joining subscriber's."""
        if (route := self.route(peer, number)) is not None:
            return route.sender
        joins = (route.joins.get(number) for route in self.of(peer))
        return next((join.own for join in joins if isinstance(join, ServedJoin)), None)

    def description(self, source: Source) -> Description | None:
        """The header of a source's publisher, while the source is connected; else ``None``."""
        flow = self.flows.get(source)
        return flow.description if flow is not None else None

    def position(self, source: Source) -> tuple[int, int] | None:
        """What a peer has of a source whose publisher is not connected yet; a relay's own route begins behind it."""
        waiting = (route.position for route in self.routes(source).values() if route.sender is None)
        return min((position for position in waiting if position is not None), default=None)

    def offer_for(self, key: Source, local: LocalSource, wire: str) -> TopicOffer:
        """As of ``OfferBook``."""
        return TopicOffer(wire, key.node, local.type, local.origin)

    def reload(self) -> Iterator[None]:
        """Judge by new rules. Routes that they end, end at once: a slow peer is told of the topics later."""
        context = self._out.context
        for source, flow in list(self.flows.items()):
            ours = context.contracts.of(source.topic, self.offered[source].type)
            for route in list(flow.routes.values()):
                contract = combine(ours, route.asked, self.offered[source].type)
                if why := context.gate.why_not(Access.SUBSCRIBE, route.session.name, source.topic):
                    self._refuse(route, why)
                elif not contract.same_route(route.contract):
                    self._refuse(route, "its contract has changed here")
                else:
                    route.contract = contract
        return super().reload()

    def opened(self, peer: int, message: OpenRoute) -> None:
        """Open a route that a peer asks for, at once or when its publisher has answered, or say why not."""
        told, number, why = self.peers[peer], message.route, ""
        if number in told.routes:
            self._out.warn("route.doubled", str(peer), f"a peer opens route {number} twice; the second is ignored")
            return
        asked = Source(message.topic, message.node)
        source = self.local(peer, asked)
        before = self.routes(source).get(peer) if source is not None else None
        if len(told.routes) >= self.limit:
            why = f"more topics are open on one link than limits.topics = {self.limit} there"
        elif source is None:
            self._asked_in_vain(peer, asked.topic)
            why = f"{asked}: not published here, or policy keeps it home"
        elif before is not None and before.number:
            # One copy for each peer: otherwise a peer could multiply the traffic of this module at will.
            why = f"{source} is open on another route of this link"
        if source is None or why:
            self._out.send(peer, RouteClosed(number, why))
            return
        session, local, flow = told.session, self.offered[source], self.flows.get(source)
        if flow is None:
            flow = self.flows[source] = self._connect(source, local.uri)
        route = told.routes[number] = flow.routes[peer] = before or ExportRoute(session, source)
        ours = self._out.context.contracts.of(source.topic, local.type)
        route.number, route.asked, route.contract = (
            number,
            message.contract,
            combine(ours, message.contract, local.type),
        )
        route.position = (message.epoch, message.after) if message.epoch else None
        route.unknown = self._cut.pop((session.name, source), session.instance) != session.instance
        route.shared = flow.description is not None
        if flow.description is not None:
            self._begin(route, flow, flow.description)

    def _connect(self, source: Source, uri: str) -> ExportFlow:
        """Subscribe to a publisher at its slave API; its header comes later, or that it is lost."""
        if all(source.topic != one.topic for one in self.flows):
            bridge = self._out.bridge
            bridge.core.call("registerSubscriber", OWN_NODE, source.topic, ANY, bridge.node.uri)
        _log.debug("> subscribe to %s at %s", source, uri)
        publication = self._proxied(source, uri)
        relayed = publication is not None and isinstance(publication.events, ImportRoute)
        flow = (RelayedFlow if relayed else ExportFlow)(uri, self._new_epoch)
        flow.connection = self.connection(
            source,
            uri,
            OWN_NODE,
            on_message=flow.message,
            on_parts=flow,
            on_header=lambda fields: self.described(source, _description(fields)),
            on_refused=lambda text: self._gone(source, flow, f"its publisher refuses: {text}"),
            on_lost=lambda reason: self._gone(source, flow, reason),
            on_oversized=lambda size: report_oversized(self._out, source, flow, size),
        )
        flow.connection.start()
        return flow

    def connection(self, source: Source, uri: str, caller: str, **callbacks: Any) -> TopicConnection:
        """A connection to a publisher, by a socket or within this process; see ``TopicConnection``."""

        def find() -> Callable[[InProcessConnection], None] | None:
            publication = self._proxied(source, uri)
            return publication.attach if publication is not None else None

        kind, number = (
            PublisherConnection if find() is None else InProcessConnection,
            self._out.bridge.node.next_number(),
        )
        return kind(source.topic, uri, caller, number=number, find=find, **callbacks)

    def _proxied(self, source: Source, uri: str) -> Publication | None:
        """The topic of a proxy of this process, which is subscribed to without a socket; ``None`` for others."""
        return self._out.bridge.proxy_nodes.publication(source.node, uri, source.topic)

    def _new_epoch(self) -> int:
        """A number that identifies a numbering; not 0."""
        self._epoch = self._epoch % UINT32_MAX + 1
        return self._epoch

    def described(self, source: Source, description: Description) -> None:
        """Begin to send on the routes of a source whose publisher has answered with its header."""
        if (flow := self.flows.get(source)) is None:
            return
        if description.problem:
            self._gone(source, flow, description.problem)
            return
        if isinstance(flow, RelayedFlow) and not self._follows(flow, source, description):
            return
        if description.latching:
            flow.latch()
        flow.description = description
        for route in flow.routes.values():
            if route.sender is None:
                self._begin(route, flow, description)

    def _follows(self, flow: RelayedFlow, source: Source, description: Description) -> bool:
        """Whether the route that a relayed source comes by gives it its numbers; else it does when it is open."""
        publication = self._proxied(source, flow.uri)
        route = publication.events if publication is not None else None
        if publication is None or not isinstance(route, ImportRoute):
            return False
        if route.flow is None:
            route.on_open = lambda: None if self._is_over(source, flow) else self.described(source, description)
            return False
        flow.follow(route.flow, publication.latched)
        return True

    def _begin(self, route: ExportRoute, flow: ExportFlow, about: Description) -> None:
        """Tell a peer that its route is open, and send on it; one that was suspended goes on."""
        latching = about.latching or route.contract.durability is Durability.TRANSIENT_LOCAL
        begin, told = flow.begins(route), msgspec.structs.replace(about, latching=latching)
        opened = RouteOpened(route.number, told, route.contract, begin.epoch, begin.first)
        if begin.goes_on:
            opened = msgspec.structs.replace(opened, following=begin.first)
        else:
            opened = msgspec.structs.replace(opened, unknown=route.unknown or UNSET, shared=route.shared or UNSET)
        self._out.send(route.peer, opened)
        if (session := self._out.bridge.sessions.get(route.peer)) is None:
            return
        self._parked.claim(route)
        self._timer.arm()
        if begin.resumed and route.sender is not None and route.position is not None:
            route.sender.resume(session.link, route.number, route.position[1])
            if isinstance(route.sender, ReliableRouteSender) and (missed := route.sender.missed()):
                report_missed(self._out, route, missed)
        else:
            flow.add(route, session.link, begin)
        tell_oversized(self._out, route, flow)

    def closed(self, peer: int, message: CloseRoute) -> None:
        """End a route that a peer closes; one that is not open is ignored, since both ends may close it at once."""
        if (route := self.route(peer, message.route)) is not None:
            self._end_route(route)

    def named(self, session: PeerSession, message: Audience) -> None:
        """Connect to a publisher for each listener that a peer names; ignored if the route was closed meanwhile."""
        route = self.route(session.peer, message.route)
        if route is None or (local := self.offered.get(route.source)) is None or not is_watched(local.type):
            return
        if self.description(route.source) is None:
            return  # its publisher is not connected
        topic, shown, most = route.source.topic, route.audience, limits.AUDIENCES_MAX
        names = {name for node in message.nodes if (name := self.listener(session, node, topic))}
        for name in shown.keys() - names:
            shown.pop(name).close()
        for name in sorted(names - shown.keys()):
            if sum(len(one.audience) for one in self.of(session.peer)) >= most:
                text = f"{session.link.name}: more than {most} of its nodes listen to actions here"
                self._out.warn("audience.too_many", session.link.name, text)
                break
            _log.debug("> %s: %s listens", route.source, name)
            sink = ExportFlow()  # to no peer: the bridge gets the messages by its own connection
            shown[name] = PublisherConnection(topic, local.uri, name, on_message=sink.message, on_parts=sink)
            shown[name].start()

    def listener(self, session: PeerSession, node: str, topic: str) -> str:
        """The local name of a peer's listener; empty for a proxy of a module that the peer may not speak for."""
        whose = proxied_node(node)
        if whose is None:
            return proxy_name(session.proxies.prefix, node)
        relay = session.link.name
        if not any((o.name, via) == (whose[0], relay) for o, via in self._out.imports.ways):
            return ""
        return node if self._out.context.gate.admits(Access.SUBSCRIBE, whose[0], topic, relay=relay) else ""

    def link_away(self, peer: int, *, briefly: bool = False) -> None:
        """Suspend the reliable routes of a peer that may come back, and end its other routes.

        With ``briefly`` the link fell silent, and all routes are suspended. A suspended route that the peer has not
        opened again over this link starts its outage anew.
        """
        self.link_down(peer)
        for route in self.of(peer):
            if route.sender is not None and (route.reliable or briefly):
                route.number = 0
                self._suspend(route)
            else:
                self._end_route(route)

    def _suspend(self, route: ExportRoute) -> None:
        """Keep the unacknowledged and all further messages of a route for an absent peer, for its outage."""
        route.dismiss()
        sender, loop = route.sender, asyncio.get_running_loop()
        if isinstance(sender, ReliableRouteSender):
            sender.suspend(lambda payload, stamp: self._give_up(self._parked.offer(route, payload, stamp)))
            if full := self._parked.park(route, sender.sender, loop.time() + route.outage):
                loop.call_soon(self._give_up, full)  # later: the caller is at work on these routes now
            self._timer.arm()
        elif sender is not None:
            sender.suspend()
            sender.lapse = loop.call_later(route.outage, self.given_up, route)

    def link_back(self, peer: int) -> None:
        """Give a peer that has a link again ``mesh.limits.RESUME_CLAIM`` to open its suspended routes."""
        self._parked.limit(self.of(peer), asyncio.get_running_loop().time() + mesh_limits.RESUME_CLAIM)
        self._timer.arm()

    def gone(self, peer: int) -> Iterator[None]:
        """Give up what is kept for a peer that will not come back, and end its routes, one with each item."""
        self.link_down(peer)
        self._give_up([route for route in self.of(peer) if self._parked.claim(route) is not None])
        for route in self.of(peer):
            self._end_route(route)
            yield

    def outage(self, peer: int) -> float:
        """The longest time, in seconds, for which messages are kept for a peer without a link; 0 if none are."""
        return max((route.outage for route in self.of(peer) if not route.number and route.reliable), default=0.0)

    def _give_up(self, routes: list[ExportRoute]) -> None:
        """Report routes whose messages are not kept any more for absent peers, and end them.

        What a relay does not keep is not lost yet: the peer may get it by another path, and counts what it misses.
        """
        for session in dict.fromkeys(route.session for route in routes):
            counts = {
                route.source: route.sender.missed() + route.sender.sender.pending
                for route in routes
                if route.session is session
                and isinstance(route.sender, ReliableRouteSender)
                and not isinstance(self.flows[route.source], RelayedFlow)
            }
            report_given_up(self._out, session, counts)
        for route in routes:
            self.given_up(route)

    def given_up(self, route: ExportRoute) -> None:
        """End a suspended route, whose messages are not kept any more."""
        if not route.number:
            self._end_route(route)

    def _end_route(self, route: ExportRoute) -> None:
        """End the route to one peer, unless it has ended; a source without any is disconnected."""
        flow = self.flows.get(route.source)
        if flow is None or flow.routes.get(route.peer) is not route:
            return
        self._forget(flow, route)
        if not flow.routes and self.flows.get(route.source) is flow:  # its end may have been waited for
            del self.flows[route.source]
            self._disconnect(route.source, flow)

    def _forget(self, flow: ExportFlow, route: ExportRoute) -> None:
        """Take a route, suspended or not, from its flow, and drop its waiting messages."""
        del flow.routes[route.peer]
        if route.number:
            if (told := self.peers.get(route.peer)) is not None:
                told.routes.pop(route.number, None)
        elif route.reliable:
            self._cut[route.session.name, route.source] = route.session.instance
            if len(self._cut) > mesh_limits.LOSSES_REMEMBERED:
                self._cut.popitem(last=False)
        if route.sender is None:
            return
        self._parked.claim(route)
        self._timer.arm()
        flow.remove(route)
        session = self._out.bridge.sessions.get(route.peer) if route.number else None
        if session is not None and session.linked:
            session.link.close_route(route.number)

    def _refuse(self, route: ExportRoute, why: str) -> None:
        """End a route, and say why."""
        number = route.number
        self._end_route(route)
        if number:
            self._out.send(route.peer, RouteClosed(number, why))

    def _ended_for(self, peer: int, key: Source) -> None:
        if (route := self.routes(key).get(peer)) is not None:
            self._refuse(route, "it is not offered here any more, or by another name")

    def _ended(self, key: Source, reason: str) -> None:
        flow, local = self.flows.get(key), self.offered.get(key)
        if flow is not None and (local is None or flow.uri != local.uri):
            self.lost(key, reason)

    def _leaves(self, key: Source) -> bool:
        """As of ``TopicBook``: a publisher ends its connection by itself, so that all that it has sent is read."""
        flow = self.flows.get(key)
        if flow is None or all(route.sender is None for route in flow.routes.values()):
            return False
        if flow.leaving is None:
            loop = asyncio.get_running_loop()
            flow.leaving = loop.call_later(limits.ROUTE_END, self._gone, key, flow, "its publisher has gone")
        return True

    def _is_over(self, source: Source, flow: ExportFlow) -> bool:
        return self.flows.get(source) is not flow

    def _gone(self, source: Source, flow: ExportFlow, reason: str) -> None:
        """A publisher has gone: its source ends when all that it has sent has crossed."""
        if self._is_over(source, flow):
            return
        short = DESCRIPTORS.problem  # reported once for the process; the node itself may be well
        _log.log(logging.DEBUG if short else logging.INFO, "= %s: %s", source, reason)
        if flow.connection.malformed:
            self._out.warn("publisher.malformed", str(source), f"{source}: {reason}")
        flow.connection.close()
        flow.ended()
        if isinstance(flow, RelayedFlow):  # nothing waits: the peers may have what follows by another path
            flow.catch_up()
            self._over(source, flow, reason)
        else:
            flow.leaving = asyncio.get_running_loop().call_later(limits.ROUTE_DRAIN, self._over, source, flow, reason)
            flow.drain(lambda: self._over(source, flow, reason))
        if not short:
            self._out.bridge.core.suspect(source.node)

    def _over(self, source: Source, flow: ExportFlow, reason: str) -> None:
        if not self._is_over(source, flow):
            self.lost(source, reason)
            self._out.look((source.topic,))

    def lost(self, source: Source, reason: str) -> None:
        """End the routes of a source whose publisher has gone or refused, or that is offered no more.

        The peers are told last: what they open then connects the source anew.
        """
        if (flow := self.flows.pop(source, None)) is None:
            return
        closed = []
        for route in list(flow.routes.values()):
            if route.number:
                last = flow.last(route)
                text = reason[: limits.CONTROL_TEXT_MAX]
                closed.append((route.peer, RouteClosed(route.number, text, UNSET if last is None else last)))
            self._forget(flow, route)
        self._disconnect(source, flow)
        for peer, message in closed:
            self._out.send(peer, message)

    def _disconnect(self, source: Source, flow: ExportFlow) -> None:
        """Disconnect a publisher, whose routes have ended."""
        flow.connection.close()
        flow.close()
        if all(source.topic != one.topic for one in self.flows):
            bridge = self._out.bridge
            bridge.core.call("unregisterSubscriber", OWN_NODE, source.topic, bridge.node.uri)

    def close(self) -> None:
        """Keep nothing any more; all routes have ended."""
        self._timer.close()
