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
from rmpa.bridge.messages import Audience, Description, Mismatch, Source, encode, is_crossing_name
from rmpa.bridge.topics.exports import LocalSource
from rmpa.bridge.topics.peer_topics import PeerTopic
from rmpa.config.peer_rules import Access
from rmpa.config.rules import CLOCK
from rmpa.core.identity import OWN_NODE, is_own, is_type_name, proxied_node, proxy_name
from rmpa.core.limits import UINT32_MAX
from rmpa.mesh import limits as mesh_limits
from rmpa.mesh.reliable import ResumeTable
from rmpa.ros.master.parameters import GraphChange, RegistrationKind
from rmpa.ros.node.subscription import InProcessConnection, PublisherConnection
from rmpa.ros.wire.tcpros import TopicDescription as TcprosDescription
from rmpa.runtime.accept import DESCRIPTORS
from rmpa.runtime.loop import MachineTimer

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Mapping

    from rmpa.bridge.data.route import RouteBegin
    from rmpa.bridge.data.route_sender import RouteSender
    from rmpa.bridge.messages import Message
    from rmpa.bridge.offers import Effects
    from rmpa.bridge.policy import Relay
    from rmpa.bridge.sessions import PeerSession
    from rmpa.bridge.shared import Shared
    from rmpa.bridge.topics.exports import ExportRoute, Exports
    from rmpa.bridge.topics.imports import Imports
    from rmpa.bridge.topics.peer_topics import LossReports, PeerTopics
    from rmpa.mesh.io.link import PeerLink
    from rmpa.ros.core.external import Core
    from rmpa.ros.node.publication import Publication
    from rmpa.ros.node.subscription import TopicConnection

_log = logging.getLogger(__name__)


class LocalSources:
    """The core's publishers, each with the type that it registered itself.

    The master keeps one type for each topic, the last one registered; peers need the type of each publisher.

    Args:
        core: The local core.
        relay: Knows which proxies are offered to other modules.
        flows: Whether the agent is connected to a source; such a source counts as reachable, whatever the core found.
    """

    def __init__(self, core: Core, relay: Relay, flows: Callable[[Source], bool] = lambda _: False) -> None:
        self._core = core
        self._flows = flows
        self._relay = relay
        self._types: dict[Source, str] = {}

    def changed(self, change: GraphChange) -> None:
        """Remembers the type of a publisher that registers; forgets it when the publisher leaves."""
        if change.kind is RegistrationKind.PUBLISHER:
            if is_own(change.node) and not self._relay.enabled:
                return  # thousands of proxies, whose types only a relay needs
            source = Source(change.name, change.node)
            if not change.added:
                self._types.pop(source, None)
            elif is_type_name(change.type):
                self._types[source] = change.type

    def of(self, topic: str) -> dict[str, LocalSource]:
        """This module's own publishers of a topic, by node, without those that cannot be reached."""
        unreachable = self._core.unreachable()
        return {
            node: LocalSource(self._type(topic, node), uri)
            for node, uri in self._core.publishers(topic).items()
            if not is_own(node)
            and (node not in unreachable or not unreachable[node].withdrawn or self._flows(Source(topic, node)))
        }

    def relayed(self, topic: str) -> dict[str, LocalSource]:
        """The proxies of a topic that this agent relays, by node, with their origin; empty if it is no relay."""
        publishers: Mapping[str, str] = self._core.publishers(topic) if self._relay.enabled else {}
        return {
            node: LocalSource(self._type(topic, node), uri, origin)
            for node, uri in publishers.items()
            if (origin := self._relay.origin((topic, node))) is not None
        }

    def _type(self, topic: str, node: str) -> str:
        return self._types.get(Source(topic, node)) or self._core.type_of(topic)


class LocalSubscriptions:
    """Subscriptions to local publishers that a peer wants, as the agent's own node, and the routes to the peers.

    Args:
        shared: The local core and the agent's node; its subscriptions are registered, so that ROS tools show them.
        exports: Is told what publishers say.
        losses: Reports what peers miss.
        out: Warns of publishers that break TCPROS.
        find: ``(node, slave API, topic)``: the topic of a proxy of this process, which is subscribed to without a
            socket; ``None`` for others.
        on_over: Called once a publisher has gone, and all that it has published has crossed.

    Attributes:
        flows: The flow of each source that the agent is connected to, for snapshots.
        senders: The sender of each open route, by its peer and its id.
    """

    def __init__(
        self,
        shared: Shared,
        exports: Exports,
        losses: LossReports,
        out: Effects,
        find: Callable[[str, str, str], Publication | None] = lambda *_: None,
        on_over: Callable[[Source], None] = lambda _: None,
    ) -> None:
        self._core = shared.core
        self._node = shared.node
        self._exports, self._losses, self._out = exports, losses, out
        self._find, self._on_over = find, on_over
        # Random, so that no earlier run of this agent, and no other agent, is likely to have had it.
        self._epoch = int(shared.rng() * UINT32_MAX)
        self.flows: dict[Source, ExportFlow] = {}
        self.senders: dict[tuple[int, int], RouteSender] = {}
        self._parked: ResumeTable[tuple[int, Source]] = ResumeTable()
        # Kept messages are dropped when their outage is over.
        self._timer = MachineTimer(self._parked.next_timer, lambda now: self._give_up(self._parked.expire(now)))

    @property
    def connections(self) -> Iterable[TopicConnection]:
        """The connections to local publishers."""
        return [flow.connection for flow in self.flows.values()]

    def connect(self, source: Source, uri: str) -> None:
        """Subscribe to a publisher at its slave API; the exports are told its header later, or that it is lost."""
        if not any(one.topic == source.topic for one in self.flows):
            self._core.call("registerSubscriber", OWN_NODE, source.topic, "*", self._node.uri)
        _log.debug("> subscribe to %s at %s", source, uri)
        publication = self._find(source.node, uri, source.topic)
        relayed = publication is not None and isinstance(publication.events, PeerTopic)
        flow = self.flows[source] = (RelayedFlow if relayed else ExportFlow)(self._new_epoch)
        flow.connection = self.connection(
            source,
            uri,
            OWN_NODE,
            on_message=flow.message,
            on_parts=flow,
            on_header=lambda fields: self._header(source, fields),
            on_refused=lambda text: self._gone(source, flow, f"its publisher refuses: {text}"),
            on_lost=lambda reason: self._gone(source, flow, reason),
            on_oversized=lambda size: self._losses.oversized(source, flow, size),
        )
        flow.connection.start()

    def connection(self, source: Source, uri: str, caller: str, **callbacks: Any) -> TopicConnection:
        """A connection to a publisher, by a socket or within this process; see ``TopicConnection``."""

        def find() -> Callable[[InProcessConnection], None] | None:
            publication = self._find(source.node, uri, source.topic)
            return publication.attach if publication is not None else None

        kind = PublisherConnection if find() is None else InProcessConnection
        return kind(source.topic, uri, caller, number=self._node.next_number(), find=find, **callbacks)

    def _new_epoch(self) -> int:
        """A number that identifies a numbering; not 0."""
        self._epoch = self._epoch % UINT32_MAX + 1
        return self._epoch

    def disconnect(self, source: Source) -> None:
        """Disconnect one publisher, and drop its routes."""
        if (flow := self.flows.get(source)) is not None:
            flow.connection.close()
            flow.ended()
            for peer in list(flow.by_peer):
                self.remove_route(source, peer)
            flow.close()
            del self.flows[source]
            if not any(one.topic == source.topic for one in self.flows):
                self._core.call("unregisterSubscriber", OWN_NODE, source.topic, self._node.uri)

    def leave(self, source: Source) -> bool:
        """Let a publisher that has unregistered end its connection by itself, so that all that it has sent is read.

        Returns:
            Whether the source is still connected, and sent to a peer; the exports are told when it is lost.
        """
        flow = self.flows.get(source)
        if flow is None or not flow.by_peer:
            return False
        if flow.leaving is None:
            gone = lambda: self._gone(source, flow, "its publisher has gone")  # noqa: E731
            flow.leaving = asyncio.get_running_loop().call_later(limits.ROUTE_END, gone)
        return True

    def begins(self, source: Source, peer: int, route: ExportRoute) -> RouteBegin:
        """Where a route to a peer begins."""
        return self.flows[source].begins(peer, route.contract, route.position)

    def add_route(self, source: Source, peer: int, route: ExportRoute, begin: RouteBegin, link: PeerLink) -> None:
        """Send a source to one more peer, or resume its suspended route."""
        flow = self.flows[source]
        sender = flow.by_peer.get(peer)
        if begin.resumed and sender is not None and route.position is not None:
            self._parked.claim((peer, source))
            self._timer.arm()
            sender.resume(link, route.number, route.position[1])
            if isinstance(sender, ReliableRouteSender) and (missed := sender.missed()):
                self._losses.missed(source, peer, missed)
        else:
            self.remove_route(source, peer)
            sender = flow.add(peer, link, route.number, route.contract, begin)
        self.senders[peer, route.number] = sender

    def suspend_route(self, source: Source, peer: int, outage: float) -> None:
        """Keep a source's messages for an absent peer, for a time in seconds."""
        sender = self.sender_of(source, peer)
        self._forget(peer, sender)
        if isinstance(sender, ReliableRouteSender):
            key = (peer, source)
            sender.suspend(lambda payload, stamp: self._give_up(self._parked.offer(key, payload, stamp)))
            loop = asyncio.get_running_loop()
            if full := self._parked.park(key, sender.sender, loop.time() + outage):
                loop.call_soon(self._give_up, full)  # later: the exports are at work on these routes now
            self._timer.arm()
        elif sender is not None:
            sender.suspend()
            give_up = self._exports.given_up
            sender.lapse = asyncio.get_running_loop().call_later(outage, give_up, source, peer)

    def back(self, peer: int) -> None:
        """Give a peer that has a link again ``mesh.limits.RESUME_CLAIM`` to open its suspended routes."""
        until = asyncio.get_running_loop().time() + mesh_limits.RESUME_CLAIM
        self._parked.limit([(peer, source) for source in self.flows], until)
        self._timer.arm()

    def gone(self, peer: int) -> None:
        """Give up the messages that are kept for a peer that will not come back."""
        keys = [(peer, source) for source in self.flows]
        self._give_up([key for key in keys if self._parked.claim(key) is not None])

    def remove_route(self, source: Source, peer: int) -> None:
        """End a source's route to a peer, if there is one, suspended or not."""
        self._parked.claim((peer, source))
        self._timer.arm()
        if (sender := self.sender_of(source, peer)) is not None:
            self._forget(peer, sender)
            self.flows[source].remove(peer)

    def last(self, source: Source, peer: int) -> int | None:
        """The last message of a route whose publisher has gone; ``None``: others may have been lost."""
        sender = self.sender_of(source, peer)
        return sender.last if sender is not None and self.flows[source].complete else None

    def sender_of(self, source: Source, peer: int) -> RouteSender | None:
        """The sender of a source's route to a peer, suspended or not; ``None`` if there is none."""
        flow = self.flows.get(source)
        return flow.by_peer.get(peer) if flow is not None else None

    def _give_up(self, keys: list[tuple[int, Source]]) -> None:
        """Reports routes whose messages are not kept any more for absent peers.

        What a relay does not keep is not lost yet: the peer may get it by another path, and counts what it misses.
        """
        for peer in dict.fromkeys(peer for peer, _ in keys):
            counts = {}
            for source in (source for one, source in keys if one == peer):
                sender = self.sender_of(source, peer)
                if isinstance(sender, ReliableRouteSender):
                    counts[source] = sender.missed() + sender.sender.pending
            own = {one: count for one, count in counts.items() if not isinstance(self.flows[one], RelayedFlow)}
            self._losses.given_up(peer, own)
            for source in counts:
                self._exports.given_up(source, peer)

    def lane_lost(self, peer: int) -> None:
        """Report the loss of a peer's bulk lane to its routes."""
        for (owner, _), route_sender in list(self.senders.items()):
            if owner == peer:
                route_sender.lane_lost()

    def _forget(self, peer: int, sender: RouteSender | None) -> None:
        """Takes no marks of a route any more; of a suspended one another route may have the id since."""
        if sender is not None and self.senders.get((peer, sender.route)) is sender:
            del self.senders[peer, sender.route]

    def close(self) -> None:
        """Disconnect all publishers."""
        for source in list(self.flows):
            self.disconnect(source)
        self._timer.close()

    def _header(self, source: Source, fields: Mapping[str, str]) -> None:
        about = TcprosDescription.from_header(fields)
        text = about.definition.encode(errors="surrogateescape").decode("latin-1")
        description = Description(about.type, about.md5sum, text, about.latching)
        if description.problem:
            self._gone(source, self.flows[source], description.problem)
            return
        flow = self.flows[source]
        if isinstance(flow, RelayedFlow) and not self._follows(flow, source, fields):
            return
        if description.latching:
            flow.latch()
        self._exports.described(source, description)

    def _follows(self, flow: RelayedFlow, source: Source, fields: Mapping[str, str]) -> bool:
        """Whether the route that a relayed source comes by gives it its numbers; else it does when it is open."""
        publication = self._find(source.node, flow.connection.uri, source.topic)
        topic = publication.events if publication is not None else None
        if publication is None or not isinstance(topic, PeerTopic):
            return False
        if topic.flow is None:
            topic.on_open = lambda: self._header(source, fields) if self.flows.get(source) is flow else None
            return False
        flow.follow(topic.flow, publication.latched)
        return True

    def _gone(self, source: Source, flow: ExportFlow, reason: str) -> None:
        if self.flows.get(source) is not flow:
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
            self._core.suspect(source.node)

    def _over(self, source: Source, flow: ExportFlow, reason: str) -> None:
        """Ends a source whose publisher has gone, and whose messages have crossed."""
        if self.flows.get(source) is not flow:
            return
        lasts = {peer: last for peer in flow.by_peer if (last := self.last(source, peer)) is not None}
        self.disconnect(source)  # first: what follows may connect the source anew
        self._exports.lost(source, reason[: limits.CONTROL_TEXT_MAX], lasts)
        self._on_over(source)


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


class Mismatches:
    """Subscribers whose type or definition does not fit a source: local ones of peers' sources, and peers' of ours.

    A subscriber is given by its name: ``/viewer`` here, ``base/viewer`` at the peer ``base``.

    Args:
        out: Sends messages and warns.
        exports: Finds the local source that a peer means.
        imports: Knows the peers that have a source.
    """

    def __init__(self, out: Effects, exports: Exports, imports: Imports) -> None:
        self._out, self._exports, self._imports = out, exports, imports
        self._texts: dict[Source, dict[str, str]] = {}

    def texts(self, source: Source) -> tuple[str, ...]:
        """The texts about one source, for ``rmpa topic info`` and the diagnostics."""
        return tuple(self._texts.get(source, {}).values())

    def _add(self, source: Source, subscriber: str, text: str) -> None:
        """Remembers a mismatch, or replaces its text; dropped beyond ``limits.MISMATCHES_MAX`` for one source."""
        known = self._texts.setdefault(source, {})
        if subscriber in known or len(known) < limits.MISMATCHES_MAX:
            known[subscriber] = text

    def refused(self, peer: int, source: Source, subscriber: str, text: str) -> None:
        """A local subscriber does not fit a peer's source: remember it, and tell the peer."""
        self._add(source, subscriber, text)
        self._out.warn("mismatch.md5", str(source), text)
        self._out.send(peer, Mismatch(source.topic, source.node, subscriber, text))

    def reported(self, peer: int, name: str, message: Mismatch) -> None:
        """A peer reports that a subscriber there does not fit a local source; an empty text: that it fits now."""
        source = self._exports.local(peer, Source(message.topic, message.node))
        if source is None:
            return  # it went meanwhile
        subscriber = f"{name}{message.subscriber}"
        if not message.text:
            self._texts.get(source, {}).pop(subscriber, None)
            return
        self._add(source, subscriber, message.text)
        where = f"{name}: {source}"
        counter = "clock.second" if source.topic == CLOCK else "mismatch.remote"
        self._out.warn(counter, where, f"{where}: {message.text}")

    def registration_changed(self, topic: str, subscriber: str) -> None:
        """A local subscriber has gone or has registered again: forget its mismatch, here and at the peers."""
        for peer, source in list(self._imports.at(topic)) if self._texts else ():
            if self._texts.get(source, {}).pop(subscriber, None) is not None:
                self._out.send(peer, Mismatch(source.topic, source.node, subscriber, ""))

    def peer_gone(self, name: str) -> None:
        """Forget all subscribers at a peer that is gone."""
        for known in self._texts.values():
            for subscriber in [one for one in known if one.startswith(f"{name}/")]:
                del known[subscriber]

    def forget_gone(self) -> None:
        """Forget the mismatches of sources that are gone."""
        for source in list(self._texts):
            if source not in self._exports.offered and not self._imports.knows(source):
                del self._texts[source]


class RemoteSubscribers:
    """The names of listeners, sent and received, for all peers.

    Args:
        shared: The peers, and the rules about modules behind a relay.
        out: Warns of too many.
        exports: Finds the source of a peer's route.
        imports: Finds the route of a peer's source.
        peers: The peers' topics in the local graph, by the numbers of their sessions.

    Attributes:
        _shown: The connections that stand for a peer's listeners, by the listeners' local names.
    """

    def __init__(
        self, shared: Shared, out: Effects, exports: Exports, imports: Imports, peers: Mapping[int, PeerTopics]
    ) -> None:
        self._shared, self._out = shared, out
        self._exports, self._imports, self._peers = exports, imports, peers
        self._changed: dict[tuple[int, Source], None] = {}
        self._soon: asyncio.Handle | None = None
        self._shown: dict[tuple[int, Source], dict[str, PublisherConnection]] = {}

    # --- our listeners, to the peer that publishes ------------------------------------------------------------------

    def changed(self, peer: int, source: Source) -> None:
        """Send the listeners of a peer's source again soon: they have changed, or its route was opened."""
        entry = self._imports.get(peer, source)
        if entry is None or not is_watched(entry.type):
            return
        self._changed[peer, source] = None
        if self._soon is None:
            # In the next turn: several changes become one message, and a listener's header is answered first.
            self._soon = asyncio.get_running_loop().call_soon(self._tell)

    def _tell(self) -> None:
        self._soon = None
        changed, self._changed = self._changed, {}
        for peer, source in changed:
            topic = topics.topics.get(source) if (topics := self._peers.get(peer)) is not None else None
            if topics is None or topic is None or (flow := topic.flow) is None:
                continue
            names = audience(topic.publication.listeners)
            if names != flow.told and topics.flows.get(flow.route) is flow:
                flow.told = names
                topics.session.link.send_control(encode(Audience(flow.route, names)))

    # --- the peer's listeners, to our publisher ---------------------------------------------------------------------

    def message(self, session: PeerSession, message: Message) -> bool:
        """Takes the listeners that a peer names for a route; ignored if the route was closed meanwhile."""
        if not isinstance(message, Audience):
            return False
        source = self._exports.source(session.peer, message.route)
        if source is None or (local := self._exports.offered.get(source)) is None or not is_watched(local.type):
            return True
        if self._exports.description(source) is None:
            return True  # its publisher is not connected
        names = {name for node in message.nodes if (name := self.name(session, node, source.topic))}
        shown, most = self._shown.setdefault((session.peer, source), {}), limits.AUDIENCES_MAX
        for name in shown.keys() - names:
            shown.pop(name).close()
        for name in sorted(names - shown.keys()):
            if sum(len(names) for (peer, _), names in self._shown.items() if peer == session.peer) >= most:
                text = f"{session.link.name}: more than {most} of its nodes listen to actions here"
                self._out.warn("audience.too_many", session.link.name, text)
                break
            _log.debug("> %s: %s listens", source, name)
            sink = ExportFlow()  # to no peer: the bridge gets the messages by its own connection
            shown[name] = PublisherConnection(source.topic, local.uri, name, on_message=sink.message, on_parts=sink)
            shown[name].start()
        if not shown:
            del self._shown[session.peer, source]
        return True

    def name(self, session: PeerSession, node: str, topic: str) -> str:
        """The local name of a peer's listener; empty for a proxy of a module that the peer may not speak for."""
        whose = proxied_node(node)
        if whose is None:
            return proxy_name(session.proxies.prefix, node)
        relay = session.link.name
        if not any((o.name, via) == (whose[0], relay) for o, via in self._imports.ways):
            return ""
        return node if self._shared.context.gate.admits(Access.SUBSCRIBE, whose[0], topic, relay=relay) else ""

    def route_over(self, peer: int, source: Source) -> None:
        """Close the connections for a source's listeners at a peer, since its route has ended."""
        for connection in self._shown.pop((peer, source), {}).values():
            connection.close()

    def link_down(self, peer: int) -> None:
        """Close the connections for all listeners of a peer whose link is gone."""
        for owner, source in [key for key in self._shown if key[0] == peer]:
            self.route_over(owner, source)

    def close(self) -> None:
        """Close all connections."""
        if self._soon is not None:
            self._soon.cancel()
        for peer, source in list(self._shown):
            self.route_over(peer, source)
