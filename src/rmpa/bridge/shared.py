"""What all parts of the bridge share."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Callable

    from rmpa.bridge.context import BridgeContext
    from rmpa.bridge.policy import Relay
    from rmpa.bridge.rpc import PeerRpc
    from rmpa.bridge.sessions import PeerSessions
    from rmpa.core.counters import Counters
    from rmpa.ros.core.external import Core
    from rmpa.ros.node.slave_node import SlaveNode


class Shared:
    """What all parts of a bridge share; ``Bridge`` makes it."""

    core: Core
    """The local core."""
    node: SlaveNode
    """The agent's own node in the local graph."""
    sessions: PeerSessions
    """The sessions of the peers."""
    rpc: PeerRpc
    """The requests and notifications to and from the peers."""
    relay: Relay
    """Which sources of one peer are offered to others."""
    counters: Counters
    """Counts what happens, by name."""
    rng: Callable[[], float]
    """Uniform numbers in [0, 1), for the jitter of a back-off."""
    context: BridgeContext
    """The rules that hold now; each reading of the settings makes another one."""
