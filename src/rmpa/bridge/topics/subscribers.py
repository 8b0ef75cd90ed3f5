"""Subscribers of peers, where their names or types matter: actionlib's clients, and types that differ.

Topics whose publisher checks the names of its listeners, not only whether there are any.

An actionlib client accepts a server (``wait_for_server``, ``waitForServer``) when the node that publishes the status
also listens to the client's goals and cancellations. It compares the caller ids of the connections. Over the mesh,
one connection of the agent stands for all listeners of a module. For these topics, therefore, the listeners' names
cross, and the publisher's agent opens one more connection for each, under the listener's name in the publisher's
graph.
"""

from __future__ import annotations

import asyncio
import logging
from typing import TYPE_CHECKING, Final

from rmpa.bridge import limits
from rmpa.bridge.data.export import ExportFlow
from rmpa.bridge.messages import Audience, Mismatch, encode, is_crossing_name
from rmpa.config.peer_rules import Access
from rmpa.core.identity import OWN_NODE, proxied_node, proxy_name
from rmpa.ros.node.subscription import PublisherConnection

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

    from rmpa.bridge.messages import Message, Source
    from rmpa.bridge.offers import Effects
    from rmpa.bridge.sessions import PeerSession
    from rmpa.bridge.shared import Shared
    from rmpa.bridge.topics.exports import Exports
    from rmpa.bridge.topics.imports import Imports
    from rmpa.bridge.topics.peer_topics import PeerTopics

_log = logging.getLogger(__name__)

_GOAL: Final = "ActionGoal"
_CANCEL: Final = "actionlib_msgs/GoalID"
_STATUS: Final = "actionlib_msgs/GoalStatusArray"
_ANSWERS: Final = ("ActionResult", "ActionFeedback")


def is_watched(type_name: str) -> bool:
    """Whether publishers of this type check their listeners' names; judged by type, as topics can be remapped."""
    return type_name.endswith(_GOAL) or type_name == _CANCEL


def compares_names(type_name: str) -> bool:
    """Whether a topic is of an action, whose client compares the names in the headers of all five topics.

    rospy's client wants one name as listener of goals and cancellations, and as publisher of status, result and
    feedback; roscpp's leaves the last two out. So all have to come by the agents, which give a remote node one name.
    """
    return is_watched(type_name) or type_name == _STATUS or type_name.endswith(_ANSWERS)


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
        source = self._exports.local(peer, message.source)
        if source is None:
            return  # it went meanwhile
        subscriber = f"{name}{message.subscriber}"
        if not message.text:
            self._texts.get(source, {}).pop(subscriber, None)
            return
        self._add(source, subscriber, message.text)
        where = f"{name}: {source}"
        self._out.warn("mismatch.remote", where, f"{where}: {message.text}")

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
        names = {name for node in message.nodes if (name := self._name(session, node, source.topic))}
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

    def _name(self, session: PeerSession, node: str, topic: str) -> str:
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
