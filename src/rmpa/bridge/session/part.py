"""What the bridge is made of: topics, services, parameters and others are parts alike."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rmpa.bridge.messages import Message
    from rmpa.bridge.session.peer_session import PeerSession
    from rmpa.config.settings import Settings
    from rmpa.core.identity import Identity
    from rmpa.ros.master.effects import GraphChange


class Part:
    """Gets every event of the bridge and does nothing with it; parts override what they need.

    All methods are called from the event loop.
    """

    advertisement = ""
    """The kind of control message that ``advertised`` takes before it is parsed; empty: none."""

    def start(self) -> None:
        """The bridge has started: the local core answers."""

    async def close(self) -> None:
        """The bridge ends: all sessions have ended, the local core is still there."""

    # --- sessions ----------------------------------------------------------------------------------------------

    def remembered(self, identity: Identity) -> int | None:  # noqa: ARG002 - for those that override it
        """The number of an ended session of this run of a peer, if the part still knows something under it."""
        return None

    def link_up(self, session: PeerSession) -> None:
        """A link is up, of a new peer or of one whose session waited (then ``link_down`` came before)."""

    def link_down(self, session: PeerSession) -> None:
        """A link is gone; the peer may come back."""

    def grace_over(self, session: PeerSession) -> bool:  # noqa: ARG002 - for those that override it
        """The peer did not come back within ``mesh.limits.AWAY_GRACE``, or its link did not end by silence.

        Returns:
            Whether the part keeps something for the peer: then the session waits.
        """
        return False

    def outlasted(self, session: PeerSession, seconds: float) -> float | None:  # noqa: ARG002 - likewise
        """The peer has been away for ``seconds``: what is not kept for longer goes.

        Returns:
            For how many seconds the next thing is kept, more than ``seconds``; ``None``: nothing is kept any more.
        """
        return None

    def gone(self, session: PeerSession) -> None:
        """The session ends for good: what came from the peer leaves the local graph."""

    def lane_lost(self, session: PeerSession) -> None:
        """The bulk lane of a link is gone, and perhaps half a message in either direction."""

    # --- messages ----------------------------------------------------------------------------------------------

    def message(self, session: PeerSession, message: Message) -> bool:  # noqa: ARG002 - for those that override it
        """A control message came.

        Returns:
            Whether it was this part's.

        Raises:
            RemoteProtocolError: It is not one that can come now; the link is closed.
        """
        return False

    def advertised(self, session: PeerSession, payload: bytes) -> None:
        """A control message of the kind ``advertisement`` came, not parsed yet.

        Raises:
            LimitExceeded: It is longer than ``limits.ADVERTISEMENT_MAX``; the link is closed.
        """

    # --- the local graph ---------------------------------------------------------------------------------------

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
        """Compare what is with what should be, and mend it; called each ``limits.RECONCILE_INTERVAL``."""
