"""What modules tell each other of topics beside their messages.

Definitions that do not fit, reliable messages that were given up, messages that are too long to cross: in the log,
and to the agent at the other end. And which subscribers are told by their names.

Topics of actions are those whose publisher checks the names of its listeners, not only whether there are any. An
actionlib client accepts a server (``wait_for_server``, ``waitForServer``) when the node that publishes the status
also listens to the client's goals and cancellations. It compares the caller ids of the connections. Over the mesh,
one connection of the agent stands for all listeners of a module. For these topics, therefore, the listeners' names
cross, and the publisher's agent opens one more connection for each, under the listener's name in the publisher's
graph.
"""

from __future__ import annotations

from itertools import islice
from typing import TYPE_CHECKING, Any, Final

from rmpa.bridge import limits
from rmpa.bridge.data.quality import shown_seconds
from rmpa.bridge.messages import Mismatch, Source, is_crossing_name
from rmpa.config.rules import CLOCK
from rmpa.core.errors import RemoteProtocolError
from rmpa.core.identity import OWN_NODE
from rmpa.mesh import limits as mesh_limits
from rmpa.ros import limits as ros_limits

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

    from rmpa.bridge.data.export import ExportFlow, ExportRoute
    from rmpa.bridge.offers import PeerRun
    from rmpa.bridge.sessions import PeerSession
    from rmpa.bridge.topics.part import Topics

# The notification that a publisher sends messages that are too long.
OVERSIZED: Final = "message.oversized"
# Sources that one line of the log names; further ones are only counted.
_NAMED: Final = 3


class Mismatches:
    """Subscribers whose type or definition does not fit a source: local ones of peers' sources, and peers' of ours.

    A subscriber is given by its name: ``/viewer`` here, ``base/viewer`` at the peer ``base``.

    Args:
        out: The part, which knows the sources of both sides.
    """

    def __init__(self, out: Topics) -> None:
        self._out = out
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
        source = self._out.exports.local(peer, Source(message.topic, message.node))
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
        for entry in self._out.imports.at(topic) if self._texts else ():
            if self._texts.get(entry.wire, {}).pop(subscriber, None) is not None:
                self._out.send(entry.peer, Mismatch(entry.wire.topic, entry.node, subscriber, ""))

    def peer_gone(self, name: str) -> None:
        """Forget all subscribers at a peer that is gone."""
        for known in self._texts.values():
            for subscriber in [one for one in known if one.startswith(f"{name}/")]:
                del known[subscriber]

    def forget_gone(self) -> None:
        """Forget the mismatches of sources that are gone."""
        for source in list(self._texts):
            if source not in self._out.exports.offered and not self._out.imports.knows(source):
                del self._texts[source]


def report_given_up(part: Topics, peer: PeerRun, counts: Mapping[Source, int]) -> None:
    """Report that messages are not kept any more for an absent peer.

    Args:
        part: The part, which warns.
        peer: The peer.
        counts: By source: how many messages it misses until now.
    """
    if not (count := sum(counts.values())):
        return
    name, seconds = peer.name, part.now() - peer.away_since
    shown = ", ".join(map(str, islice(counts, _NAMED)))
    if len(counts) > _NAMED:
        shown += f" and {len(counts) - _NAMED} others"
    text = f"{name} has been away for {shown_seconds(seconds)}: {count} messages for it are given up, of {shown} "
    text += "(the contract's outage is for how long they are kept, "
    text += f"at most {mesh_limits.RESUME_BYTES_MAX >> 20} MiB over all)"
    part.bridge.counters.add("message.given_up", count)
    part.bridge.counters.add("route.given_up", len(counts) - 1)
    part.warn("route.given_up", name, text)


def report_missed(part: Topics, route: ExportRoute, count: int) -> None:
    """Report how many messages of a reliable source a peer that is back has missed."""
    source, name = route.source, route.session.name
    part.bridge.counters.add("message.given_up", count)
    text = f"{source}: {name} has missed {count} messages: it was away for longer than they were kept"
    part.warn("route.missed", f"{name} {source}", text)


def report_oversized(part: Topics, source: Source, flow: ExportFlow, size: int) -> None:
    """Count a message that is too long, and report it in the log and to the peers to which its source flows."""
    flow.oversized += 1
    flow.oversized_bytes = size
    text = f"{source}: a message of {size} bytes is left out, at most {ros_limits.TCPROS_MESSAGE_MAX} cross"
    part.warn("message.oversized", str(source), f"{text}; others do: send it in parts, or compressed")
    for route in flow.flowing:
        tell_oversized(part, route, flow)


def tell_oversized(part: Topics, route: ExportRoute, flow: ExportFlow) -> None:
    """Report to one peer how many messages of a source were left out until now, if any."""
    session = part.bridge.sessions.get(route.peer) if flow.oversized else None
    if session is not None and session.linked and (offer := part.exports.offer(route.peer, route.source)) is not None:
        told = {"topic": offer.topic, "node": offer.node, "count": flow.oversized, "size": flow.oversized_bytes}
        part.bridge.rpc.notify(session, OVERSIZED, told)


def oversized_there(part: Topics, session: PeerSession, args: dict[str, Any]) -> None:
    """Take a peer's report of messages that it left out.

    Raises:
        RemoteProtocolError: The report names no source, or no numbers above 0.
    """
    match args:
        case {"topic": str(topic), "node": str(node), "count": int(count), "size": int(size)} if min(count, size) > 0:
            source = Source(topic, node)
        case _:
            raise RemoteProtocolError(f"{OVERSIZED} names no source, or no number of messages")
    entry = part.imports.get(session.peer, source)
    flow = entry.flow if entry is not None else None
    if flow is not None and (count, size) != (flow.oversized, flow.oversized_bytes):
        flow.oversized, flow.oversized_bytes = count, size
        who = f"{session.link.name}: {source}"
        text = f"{who}: its messages of {size} bytes are too long to cross and are left out ({count} until now)"
        part.warn("message.oversized_there", who, text)


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
