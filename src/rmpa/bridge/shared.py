"""What all parts of the bridge share."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Callable

    from rmpa.bridge.context import BridgeContext
    from rmpa.bridge.policy import Relay
    from rmpa.bridge.rpc import PeerRpc
    from rmpa.bridge.sessions import PeerSessions
    from rmpa.core.statistics import Counters
    from rmpa.ros.core.external import Core
    from rmpa.ros.node.slave_node import SlaveNode


class Shared:
    """What all parts of a bridge share; ``Bridge`` makes it.

    Attributes:
        core: The local core.
        node: The agent's own node in the local graph.
        sessions: The sessions of the peers.
        rpc: The requests and notifications to and from the peers.
        relay: Which sources of one peer are offered to others.
        counters: Counts what happens, by name.
        rng: Uniform numbers in [0, 1), for the jitter of a back-off.
        context: The rules that hold now; each reading of the settings makes another one.
    """

    core: Core
    node: SlaveNode
    sessions: PeerSessions
    rpc: PeerRpc
    relay: Relay
    counters: Counters
    rng: Callable[[], float]
    context: BridgeContext
