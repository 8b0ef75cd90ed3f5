"""What the bridge is made of beside topics: each part hears of links, of their messages and of the local graph.

A part is an object of its own (services, questions, followed parameters …), so that the bridge only hands on.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Protocol

if TYPE_CHECKING:
    from rmpa.bridge.io.bridge import PeerSession
    from rmpa.bridge.messages import Message
    from rmpa.config.settings import Settings
    from rmpa.ros.master.effects import GraphChange


class Part:
    """Hears of everything and does nothing; parts override what they care for. All calls come from the loop."""

    def start(self) -> None:
        """The bridge has started: the local core answers."""

    async def close(self) -> None:
        """The bridge ends: links are gone, the local core is still there."""

    def link_up(self, attached: PeerSession) -> None:
        """A link is up, of a new peer or of one that was away for a moment (then ``link_down`` came before)."""

    def link_down(self, attached: PeerSession) -> None:
        """A link is gone; the peer may come back within ``limits.AWAY_GRACE`` (``gone`` is not called then)."""

    def gone(self, attached: PeerSession) -> None:
        """A peer is gone for good: what came from it leaves the local graph."""

    def message(self, attached: PeerSession, message: Message) -> bool:  # noqa: ARG002 - for those that override it
        """A control message came.

        Returns:
            Whether it was this part's.

        Raises:
            RemoteProtocolError: It is not one that can come now; the link is closed.
        """
        return False

    def graph_changed(self, change: GraphChange) -> None:
        """A registration in the local graph came, changed or went."""

    def param_update(self, key: str) -> bool:  # noqa: ARG002 - for those that override it
        """A parameter that the agent's own node has subscribed to has changed.

        Args:
            key: Which, without a slash at its end; one below it may be what was subscribed to, or one above.

        Returns:
            Whether this part has subscribed to it.
        """
        return False

    def reload(self, settings: Settings) -> None:
        """The settings were read again; of those that a running agent can take, others may hold from now on."""

    def reconcile(self) -> None:
        """Each ``limits.RECONCILE_INTERVAL``: compare what is with what should be, and mend it."""

    def lane_lost(self, attached: PeerSession) -> None:
        """The bulk lane of a link is gone, and half a message perhaps."""


class DataHandler(Protocol):
    """Takes what comes on a route that is not a topic's (``limits.SERVICE_ROUTES`` and above)."""

    def message(self, sequence: int, stamp_ns: int, framed: memoryview) -> None:
        """A whole message, its 4-byte length in front; only valid during the call."""
        ...

    def part(self, sequence: int, stamp_ns: int, flags: int, part: memoryview) -> None:
        """A part of a large one (``core.outbox`` FIRST, LAST, ABORT); only valid during the call."""
        ...
