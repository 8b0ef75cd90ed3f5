"""The peers' question about this agent itself."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final

from rmpa.bridge.permission_gate import Needs

if TYPE_CHECKING:
    from rmpa.bridge.session.peer_rpc import PeerRpc
    from rmpa.bridge.session.peer_session import PeerSession
    from rmpa.observe.io.snapshot_builder import SnapshotBuilder
    from rmpa.observe.peer_agent import PeerAgent

INFO: Final = "agent.info"
"""The request for what an agent tells of itself. Replied by ``PeerAgent``."""


class AgentRequests:
    """Answers the peers' question about this agent.

    Args:
        asks: Receives the requests.
        snapshots: Knows the agent's figures.
    """

    def __init__(self, asks: PeerRpc, snapshots: SnapshotBuilder) -> None:
        self._snapshots = snapshots
        asks.on_request(INFO, self._info, Needs((), "figures of the agent, none of the module's graph"))

    def _info(self, _asker: PeerSession, _args: dict[str, Any]) -> PeerAgent:
        return self._snapshots.peer_agent()
