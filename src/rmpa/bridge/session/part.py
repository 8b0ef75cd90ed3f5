"""The base class of the bridge's parts: topics, services, parameters and others."""

from __future__ import annotations

import logging
from typing import TYPE_CHECKING

from rmpa.core.counters import logged_failure

if TYPE_CHECKING:
    from contextlib import AbstractContextManager

    from rmpa.bridge.messages import Message
    from rmpa.bridge.session.peer_session import PeerSession
    from rmpa.config.settings import Settings
    from rmpa.ros.master.parameters import GraphChange

_log = logging.getLogger(__name__)


class Part:
    """Ignores every event of the bridge; parts override the methods that they need.

    All methods are called from the event loop.
    """

    advertisement = ""
    """The ``op`` of the control messages that ``advertised`` gets unparsed; empty: none."""

    def start(self) -> None:
        """The bridge has started: the local core answers."""

    async def close(self) -> None:
        """Release everything; all sessions have ended, and the local core still answers."""

    # --- sessions ----------------------------------------------------------------------------------------------

    def link_up(self, session: PeerSession) -> None:
        """A link is up, of a new peer or of one whose session waited (after ``link_down``)."""

    def link_down(self, session: PeerSession) -> None:
        """A link is gone; the peer may come back."""

    def grace_over(self, session: PeerSession) -> bool:  # noqa: ARG002 - for those that override it
        """The peer is not back within ``mesh.limits.SILENT_GRACE``, or its link ended otherwise than by silence.

        Returns:
            Whether the part keeps something for the peer: then the session waits.
        """
        return False

    def outlasted(self, session: PeerSession, seconds: float) -> float | None:  # noqa: ARG002 - likewise
        """Drop everything that is kept for an absent peer for at most ``seconds``, the time that it has been away.

        Returns:
            The next shortest time in seconds, more than ``seconds``; ``None``: nothing is kept any more.
        """
        return None

    def gone(self, session: PeerSession) -> None:
        """The session ends for good: remove everything of the peer from the local graph."""

    def lane_lost(self, session: PeerSession) -> None:
        """A link lost its bulk lane, perhaps in the middle of a message in either direction."""

    def depends(self, session: PeerSession) -> bool:  # noqa: ARG002 - for those that override it
        """Whether something here needs to know within a second that this linked peer is gone.

        Open routes are known by the session's handlers; this is for what has no handler.
        """
        return False

    # --- messages ----------------------------------------------------------------------------------------------

    def message(self, session: PeerSession, message: Message) -> bool:  # noqa: ARG002 - for those that override it
        """Handle a control message from a peer.

        Returns:
            Whether the message belongs to this part.

        Raises:
            RemoteProtocolError: The message is not allowed now; the link is closed.
        """
        return False

    def advertised(self, session: PeerSession, payload: bytes) -> None:
        """Handle a control message of the kind ``advertisement``, not parsed yet.

        Raises:
            LimitExceeded: It is longer than ``limits.ADVERTISEMENT_MAX``; the link is closed.
        """

    # --- the local graph ---------------------------------------------------------------------------------------

    def graph_changed(self, change: GraphChange) -> None:
        """Handle a registration in the local graph that was added, changed or removed."""

    def param_update(self, key: str) -> bool:  # noqa: ARG002 - for those that override it
        """Handle the change of a parameter that the agent's own node has subscribed to.

        Args:
            key: The changed key, without a slash at its end. The subscribed key may be this one, one below it or one
                above it.

        Returns:
            Whether this part has subscribed to the parameter.
        """
        return False

    def reload(self, settings: Settings) -> None:
        """Take settings that were read again, as far as they can change in a running agent."""

    def reconcile(self) -> None:
        """Compare the actual state with the planned one, and mend it; called each ``limits.RECONCILE_INTERVAL``."""


def guarded(part: Part) -> AbstractContextManager[None]:
    """Log a failure of one part; the next parts are called all the same."""
    return logged_failure(_log, "%s failed; the other parts go on", type(part).__name__)
