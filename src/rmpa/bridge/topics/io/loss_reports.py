"""Reports messages that do not reach their listeners, in the log and to the agent at the other end.

These are reliable messages that were given up, and messages that are too long to cross.
"""

from __future__ import annotations

import asyncio
from itertools import islice
from typing import TYPE_CHECKING, Any, Final

from rmpa.bridge.data.qos_events import shown_seconds
from rmpa.bridge.messages import Source
from rmpa.bridge.permission_gate import Needs
from rmpa.core.errors import RemoteProtocolError
from rmpa.mesh import limits as mesh_limits
from rmpa.ros import limits as ros_limits

if TYPE_CHECKING:
    from collections.abc import Mapping

    from rmpa.bridge.data.io.export_flow import ExportFlow
    from rmpa.bridge.session.peer_rpc import PeerRpc
    from rmpa.bridge.session.peer_session import PeerSession
    from rmpa.bridge.session.peer_sessions import PeerSessions
    from rmpa.bridge.topics.exports import Exports
    from rmpa.bridge.topics.io.peer_topics import PeerTopics
    from rmpa.core.counters import Counters, RefusalLog

OVERSIZED: Final = "message.oversized"
"""The notification that a publisher sends messages that are too long."""
_NAMED: Final = 3
"""Sources that one line of the log names; further ones are only counted."""


class LossReports:
    """The reports of losses, sent and received, for all peers.

    Args:
        exports: Finds the peers that a source goes to.
        sessions: The peers.
        topics: The peers' topics in the local graph, by the numbers of their sessions.
        rpc: Sends and receives notifications.
        counters: Counts ``message.given_up`` and ``route.given_up``.
        refusals: Logs and counts ``route.missed``, ``message.oversized`` and ``message.oversized_there``.
    """

    def __init__(
        self,
        exports: Exports,
        sessions: PeerSessions,
        topics: Mapping[int, PeerTopics],
        rpc: PeerRpc,
        counters: Counters,
        refusals: RefusalLog,
    ) -> None:
        self._exports = exports
        self._sessions = sessions
        self._topics = topics
        self._rpc = rpc
        self._counters = counters
        self._refusals = refusals
        rpc.on_notification(OVERSIZED, self._oversized_there, Needs((), "the peer's own topics; a text for the log"))

    def away(self, peer: int) -> tuple[str, float]:
        """The name of an absent peer, and for how many seconds it has been away."""
        session = self._topics[peer].session
        return session.link.name, asyncio.get_running_loop().time() - session.away_since

    def given_up(self, peer: int, counts: Mapping[Source, int]) -> None:
        """Report that messages are not kept any more for an absent peer.

        Args:
            peer: The peer's number.
            counts: By source: how many messages it misses until now.
        """
        if not (count := sum(counts.values())):
            return
        name, seconds = self.away(peer)
        shown = ", ".join(map(str, islice(counts, _NAMED)))
        if len(counts) > _NAMED:
            shown += f" and {len(counts) - _NAMED} others"
        text = f"{name} has been away for {shown_seconds(seconds)}: {count} messages for it are given up, of {shown} "
        text += "(the contract's outage is for how long they are kept, "
        text += f"at most {mesh_limits.RESUME_BYTES_MAX >> 20} MiB over all)"
        self._counters.add("message.given_up", count)
        self._counters.add("route.given_up", len(counts) - 1)
        self._say("route.given_up", name, text)

    def missed(self, source: Source, peer: int, count: int) -> None:
        """Report how many messages of a reliable source a peer that is back has missed."""
        name = self._topics[peer].session.link.name
        self._counters.add("message.given_up", count)
        text = f"{source}: {name} has missed {count} messages: it was away for longer than they were kept"
        self._say("route.missed", f"{name} {source}", text)

    def oversized(self, source: Source, flow: ExportFlow) -> None:
        """Report a message that is too long, in the log and to the peers to which its source flows."""
        bound = ros_limits.TCPROS_MESSAGE_MAX
        text = f"{source}: a message of {flow.oversized_bytes} bytes is left out, at most {bound} cross"
        self._say("message.oversized", str(source), f"{text}; others do: send it in parts, or compressed")
        for peer in self._exports.flowing(source):
            self.tell_oversized(source, flow, peer)

    def tell_oversized(self, source: Source, flow: ExportFlow, peer: int) -> None:
        """Report to one peer how many messages of a source were left out until now, if any."""
        session, offer = self._sessions.get(peer), self._exports.offer(peer, source)
        if flow.oversized and session is not None and session.linked and offer is not None:
            told = {"topic": offer.topic, "node": offer.node, "count": flow.oversized, "size": flow.oversized_bytes}
            self._rpc.notify(session, OVERSIZED, told)

    def _oversized_there(self, session: PeerSession, args: dict[str, Any]) -> None:
        """Takes a peer's report of messages that it left out.

        Raises:
            RemoteProtocolError: The report names no source, or no numbers above 0.
        """
        names = (args.get("topic"), args.get("node"))
        numbers = (args.get("count"), args.get("size"))
        match names, numbers:
            case (str(topic), str(node)), (int(count), int(size)) if count > 0 and size > 0:
                source = Source(topic, node)
            case _:
                raise RemoteProtocolError(f"{OVERSIZED} names no source, or no number of messages")
        if self._topics[session.peer].left_out(source, count, size):
            who = f"{session.link.name}: {source}"
            text = f"{who}: its messages of {size} bytes are too long to cross and are left out ({count} until now)"
            self._say("message.oversized_there", who, text)

    def _say(self, kind: str, who: str, text: str) -> None:
        self._refusals.refuse(asyncio.get_running_loop().time(), kind, who, text)
