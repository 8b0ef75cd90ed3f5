"""What this module's nodes publish, and to which nodes of peers it goes, where their names or types matter.

The publishers of a topic have each its own type; the agent subscribes to those that a peer wants.

Topics of actions are those whose publisher checks the names of its listeners, not only whether there are any. An
actionlib client accepts a server (``wait_for_server``, ``waitForServer``) when the node that publishes the status
also listens to the client's goals and cancellations. It compares the caller ids of the connections. Over the mesh,
one connection of the agent stands for all listeners of a module. For these topics, therefore, the listeners' names
cross, and the publisher's agent opens one more connection for each, under the listener's name in the publisher's
graph.
"""

from __future__ import annotations

import asyncio
import logging
from typing import TYPE_CHECKING, Any

from rmpa.bridge import limits
from rmpa.bridge.data.export import ExportFlow, RelayedFlow
from rmpa.bridge.data.route_sender import ReliableRouteSender
from rmpa.bridge.messages import Audience, Description, Source, is_crossing_name
from rmpa.bridge.topics.exports import LocalSource
from rmpa.bridge.topics.import_route import ImportRoute
from rmpa.config.peer_rules import Access
from rmpa.core.identity import OWN_NODE, is_own, proxied_node, proxy_name
from rmpa.core.limits import UINT32_MAX
from rmpa.mesh import limits as mesh_limits
from rmpa.mesh.reliable import ResumeTable
from rmpa.ros.node.subscription import InProcessConnection, PublisherConnection
from rmpa.ros.wire.tcpros import TopicDescription
from rmpa.runtime.accept import DESCRIPTORS
from rmpa.runtime.loop import MachineTimer

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Mapping

    from rmpa.bridge.bridge import Bridge
    from rmpa.bridge.data.export import ExportRoute
    from rmpa.bridge.data.route import RouteBegin
    from rmpa.bridge.policy import Relay
    from rmpa.bridge.sessions import PeerSession
    from rmpa.bridge.topics.exports import Exports
    from rmpa.bridge.topics.import_route import RemoteTopic
    from rmpa.bridge.topics.imports import Imports
    from rmpa.bridge.topics.part import Topics
    from rmpa.ros.core.external import Core
    from rmpa.ros.node.publication import Publication
    from rmpa.ros.node.subscription import TopicConnection

_log = logging.getLogger(__name__)


def own_sources(core: Core, topic: str, flows: Callable[[Source], bool] = lambda _: False) -> dict[str, LocalSource]:
    """This module's own publishers of a topic, by node, without those that cannot be reached.

    Args:
        core: The local core.
        topic: The topic.
        flows: Whether the agent is connected to a source; such a source counts as reachable, whatever the core found.
    """
    unreachable = core.unreachable()
    return {
        node: LocalSource(core.type_of(topic, node), uri)
        for node, uri in core.publishers(topic).items()
        if not is_own(node)
        and (node not in unreachable or not unreachable[node].withdrawn or flows(Source(topic, node)))
    }


def relayed_sources(core: Core, relay: Relay, topic: str) -> dict[str, LocalSource]:
    """The proxies of a topic that this agent relays, by node, with their origin; empty if it is no relay."""
    publishers: Mapping[str, str] = core.publishers(topic) if relay.enabled else {}
    return {
        node: LocalSource(core.type_of(topic, node), uri, origin)
        for node, uri in publishers.items()
        if (origin := relay.origin((topic, node))) is not None
    }


class LocalSubscriptions:
    """Subscriptions to local publishers that a peer wants, as the agent's own node, and the routes to the peers.

    Args:
        bridge: The local core and the agent's node; its subscriptions are registered, so that ROS tools show them.
        topics: The part: its exports are told what publishers say; losses are reported.
        find: ``(node, slave API, topic)``: the topic of a proxy of this process, which is subscribed to without a
            socket; ``None`` for others.
    """

    def __init__(
        self,
        bridge: Bridge,
        topics: Topics,
        find: Callable[[str, str, str], Publication | None] = lambda *_: None,
    ) -> None:
        self._core, self._node, self._sessions = bridge.core, bridge.node, bridge.sessions
        self._topics, self._find = topics, find
        # Random, so that no earlier run of this agent, and no other agent, is likely to have had it.
        self._epoch = int(bridge.rng() * UINT32_MAX)
        self._parked: ResumeTable[ExportRoute] = ResumeTable()
        # Kept messages are dropped when their outage is over.
        self._timer = MachineTimer(self._parked.next_timer, lambda now: self._give_up(self._parked.expire(now)))

    @property
    def connections(self) -> Iterable[TopicConnection]:
        """The connections to local publishers."""
        return [flow.connection for flow in self._topics.exports.flows.values()]

    def connect(self, source: Source, uri: str) -> ExportFlow:
        """Subscribe to a publisher at its slave API; the exports are told its header later, or that it is lost."""
        if not self._subscribes(source.topic):
            self._core.call("registerSubscriber", OWN_NODE, source.topic, "*", self._node.uri)
        _log.debug("> subscribe to %s at %s", source, uri)
        publication = self._find(source.node, uri, source.topic)
        relayed = publication is not None and isinstance(publication.events, ImportRoute)
        flow = (RelayedFlow if relayed else ExportFlow)(uri, self._new_epoch)
        flow.connection = self.connection(
            source,
            uri,
            OWN_NODE,
            on_message=flow.message,
            on_parts=flow,
            on_header=lambda fields: self._header(source, flow, fields),
            on_refused=lambda text: self._gone(source, flow, f"its publisher refuses: {text}"),
            on_lost=lambda reason: self._gone(source, flow, reason),
            on_oversized=lambda size: self._topics.losses.oversized(source, flow, size),
        )
        flow.connection.start()
        return flow

    def connection(self, source: Source, uri: str, caller: str, **callbacks: Any) -> TopicConnection:
        """A connection to a publisher, by a socket or within this process; see ``TopicConnection``."""

        def find() -> Callable[[InProcessConnection], None] | None:
            publication = self._find(source.node, uri, source.topic)
            return publication.attach if publication is not None else None

        kind = PublisherConnection if find() is None else InProcessConnection
        return kind(source.topic, uri, caller, number=self._node.next_number(), find=find, **callbacks)

    def _subscribes(self, topic: str) -> bool:
        return any(source.topic == topic for source in self._topics.exports.flows)

    def _is_over(self, source: Source, flow: ExportFlow) -> bool:
        return self._topics.exports.flows.get(source) is not flow

    def _new_epoch(self) -> int:
        """A number that identifies a numbering; not 0."""
        self._epoch = self._epoch % UINT32_MAX + 1
        return self._epoch

    def disconnect(self, source: Source, flow: ExportFlow) -> None:
        """Disconnect a publisher, whose routes have ended."""
        flow.connection.close()
        flow.close()
        if not self._subscribes(source.topic):
            self._core.call("unregisterSubscriber", OWN_NODE, source.topic, self._node.uri)

    def leave(self, source: Source) -> bool:
        """Let a publisher that has unregistered end its connection by itself, so that all that it has sent is read.

        Returns:
            Whether the source is still connected, and sent to a peer; the exports are told when it is lost.
        """
        flow = self._topics.exports.flows.get(source)
        if flow is None or all(route.sender is None for route in flow.routes.values()):
            return False
        if flow.leaving is None:
            gone = lambda: self._gone(source, flow, "its publisher has gone")  # noqa: E731
            flow.leaving = asyncio.get_running_loop().call_later(limits.ROUTE_END, gone)
        return True

    def begin(self, flow: ExportFlow, route: ExportRoute, begin: RouteBegin) -> None:
        """Send on one more route, or resume a suspended one."""
        if (session := self._sessions.get(route.peer)) is None:
            return
        self._parked.claim(route)
        self._timer.arm()
        if begin.resumed and route.sender is not None and route.position is not None:
            route.sender.resume(session.link, route.number, route.position[1])
            if isinstance(route.sender, ReliableRouteSender) and (missed := route.sender.missed()):
                self._topics.losses.missed(route, missed)
        else:
            flow.add(route, session.link, begin)
        self._topics.losses.tell_oversized(route, flow)

    def suspend(self, route: ExportRoute) -> None:
        """Keep the unacknowledged and all further messages of a route for an absent peer, for its outage."""
        route.dismiss()
        sender, loop = route.sender, asyncio.get_running_loop()
        if isinstance(sender, ReliableRouteSender):
            sender.suspend(lambda payload, stamp: self._give_up(self._parked.offer(route, payload, stamp)))
            if full := self._parked.park(route, sender.sender, loop.time() + route.outage):
                loop.call_soon(self._give_up, full)  # later: the exports are at work on these routes now
            self._timer.arm()
        elif sender is not None:
            sender.suspend()
            sender.lapse = loop.call_later(route.outage, self._topics.exports.given_up, route)

    def back(self, peer: int) -> None:
        """Give a peer that has a link again ``mesh.limits.RESUME_CLAIM`` to open its suspended routes."""
        until = asyncio.get_running_loop().time() + mesh_limits.RESUME_CLAIM
        self._parked.limit(self._topics.exports.of(peer), until)
        self._timer.arm()

    def gone(self, peer: int) -> None:
        """Give up the messages that are kept for a peer that will not come back."""
        self._give_up([route for route in self._topics.exports.of(peer) if self._parked.claim(route) is not None])

    def end(self, flow: ExportFlow, route: ExportRoute) -> None:
        """End a route, suspended or not, and drop its waiting messages."""
        self._parked.claim(route)
        self._timer.arm()
        flow.remove(route)
        if route.number and (session := self._sessions.get(route.peer)) is not None and session.linked:
            session.link.close_route(route.number)

    def _give_up(self, routes: list[ExportRoute]) -> None:
        """Reports routes whose messages are not kept any more for absent peers.

        What a relay does not keep is not lost yet: the peer may get it by another path, and counts what it misses.
        """
        exports = self._topics.exports
        for session in dict.fromkeys(route.session for route in routes):
            counts = {
                route.source: route.sender.missed() + route.sender.sender.pending
                for route in routes
                if route.session is session
                and isinstance(route.sender, ReliableRouteSender)
                and not isinstance(exports.flows[route.source], RelayedFlow)
            }
            self._topics.losses.given_up(session, counts)
        for route in routes:
            exports.given_up(route)

    def close(self) -> None:
        """Keep nothing any more; all routes have ended."""
        self._timer.close()

    def _header(self, source: Source, flow: ExportFlow, fields: Mapping[str, str]) -> None:
        about = TopicDescription.from_header(fields)
        text = about.definition.encode(errors="surrogateescape").decode("latin-1")
        description = Description(about.type, about.md5sum, text, about.latching)
        if description.problem:
            self._gone(source, flow, description.problem)
            return
        if isinstance(flow, RelayedFlow) and not self._follows(flow, source, fields):
            return
        if description.latching:
            flow.latch()
        self._topics.exports.described(source, description)

    def _follows(self, flow: RelayedFlow, source: Source, fields: Mapping[str, str]) -> bool:
        """Whether the route that a relayed source comes by gives it its numbers; else it does when it is open."""
        publication = self._find(source.node, flow.uri, source.topic)
        route = publication.events if publication is not None else None
        if publication is None or not isinstance(route, ImportRoute):
            return False
        if route.flow is None:
            route.on_open = lambda: None if self._is_over(source, flow) else self._header(source, flow, fields)
            return False
        flow.follow(route.flow, publication.latched)
        return True

    def _gone(self, source: Source, flow: ExportFlow, reason: str) -> None:
        if self._is_over(source, flow):
            return
        short = DESCRIPTORS.problem  # reported once for the process; the node itself may be well
        _log.log(logging.DEBUG if short else logging.INFO, "= %s: %s", source, reason)
        if flow.connection.malformed:
            self._topics.warn("publisher.malformed", str(source), f"{source}: {reason}")
        flow.connection.close()
        flow.ended()
        if isinstance(flow, RelayedFlow):  # nothing waits: the peers may have what follows by another path
            flow.catch_up()
            self._over(source, flow, reason)
        else:
            flow.leaving = asyncio.get_running_loop().call_later(limits.ROUTE_DRAIN, self._over, source, flow, reason)
            flow.drain(lambda: self._over(source, flow, reason))
        if not short:
            self._core.suspect(source.node)

    def _over(self, source: Source, flow: ExportFlow, reason: str) -> None:
        """Ends a source whose publisher has gone, and whose messages have crossed."""
        if not self._is_over(source, flow):
            self._topics.exports.lost(source, reason)
            self._topics.look((source.topic,))


def is_watched(type_name: str) -> bool:
    """Whether publishers of this type check their listeners' names; judged by type, as topics can be remapped."""
    return type_name.endswith("ActionGoal") or type_name == "actionlib_msgs/GoalID"


def compares_names(type_name: str) -> bool:
    """Whether a topic is of an action, whose client compares the names in the headers of all five topics.

    rospy's client wants one name as listener of goals and cancellations, and as publisher of status, result and
    feedback; roscpp's leaves the last two out. So all have to come by the agents, which give a remote node one name.
    """
    answers = type_name.endswith(("ActionResult", "ActionFeedback"))
    return is_watched(type_name) or type_name == "actionlib_msgs/GoalStatusArray" or answers


def audience(caller_ids: Iterable[str]) -> tuple[str, ...]:
    """The listeners to name to a publisher: sorted, without the agent itself, at most ``limits.AUDIENCE_MAX``.

    Proxies are included: they listen to proxies only in a relay, and name listeners of the modules beyond it.
    """
    names = {name for name in caller_ids if is_crossing_name(name) and name != OWN_NODE}
    return tuple(sorted(names)[: limits.AUDIENCE_MAX])


class RemoteSubscribers:
    """The names of listeners, sent and received, for all peers.

    Args:
        bridge: The rules about modules behind a relay.
        out: Warns of too many.
        exports: Finds the routes of peers.
        imports: Knows the modules behind relays.
    """

    def __init__(self, bridge: Bridge, out: Topics, exports: Exports, imports: Imports) -> None:
        self._bridge, self._out = bridge, out
        self._exports, self._imports = exports, imports
        self._changed: dict[RemoteTopic, None] = {}
        self._soon: asyncio.Handle | None = None

    def changed(self, entry: RemoteTopic) -> None:
        """Send our listeners of a peer's source again soon: they have changed, or its route was opened."""
        if not is_watched(entry.type):
            return
        self._changed[entry] = None
        if self._soon is None:
            # In the next turn: several changes become one message, and a listener's header is answered first.
            self._soon = asyncio.get_running_loop().call_soon(self._tell)

    def _tell(self) -> None:
        self._soon = None
        changed, self._changed = self._changed, {}
        for entry in changed:
            if (flow := entry.flow) is None or entry.publication is None:
                continue
            names = audience(entry.publication.listeners)
            if names != flow.told and entry.open:
                flow.told = names
                self._out.send(entry.peer, Audience(entry.number, names))

    def named(self, session: PeerSession, message: Audience) -> None:
        """Takes the listeners that a peer names for a route; ignored if the route was closed meanwhile."""
        route = self._exports.route(session.peer, message.route)
        if route is None or (local := self._exports.offered.get(route.source)) is None or not is_watched(local.type):
            return
        if self._exports.description(route.source) is None:
            return  # its publisher is not connected
        topic, shown, most = route.source.topic, route.audience, limits.AUDIENCES_MAX
        names = {name for node in message.nodes if (name := self.name(session, node, topic))}
        for name in shown.keys() - names:
            shown.pop(name).close()
        for name in sorted(names - shown.keys()):
            if sum(len(one.audience) for one in self._exports.of(session.peer)) >= most:
                text = f"{session.link.name}: more than {most} of its nodes listen to actions here"
                self._out.warn("audience.too_many", session.link.name, text)
                break
            _log.debug("> %s: %s listens", route.source, name)
            sink = ExportFlow()  # to no peer: the bridge gets the messages by its own connection
            shown[name] = PublisherConnection(topic, local.uri, name, on_message=sink.message, on_parts=sink)
            shown[name].start()

    def name(self, session: PeerSession, node: str, topic: str) -> str:
        """The local name of a peer's listener; empty for a proxy of a module that the peer may not speak for."""
        whose = proxied_node(node)
        if whose is None:
            return proxy_name(session.proxies.prefix, node)
        relay = session.link.name
        if not any((o.name, via) == (whose[0], relay) for o, via in self._imports.ways):
            return ""
        return node if self._bridge.context.gate.admits(Access.SUBSCRIBE, whose[0], topic, relay=relay) else ""

    def close(self) -> None:
        """Tell nothing any more."""
        if self._soon is not None:
            self._soon.cancel()
