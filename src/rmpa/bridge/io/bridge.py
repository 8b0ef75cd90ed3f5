"""The bridge of one agent: its parts connect the local core with the links of the mesh."""

from __future__ import annotations

import logging
from typing import TYPE_CHECKING

from rmpa.bridge import limits
from rmpa.bridge.data.io.receiver import DataReceiver
from rmpa.bridge.io.proxy_kills import ProxyKills
from rmpa.bridge.messages import decode, op_of
from rmpa.bridge.naming import Names
from rmpa.bridge.permission_gate import PermissionGate
from rmpa.bridge.policy import OWN_NODE, Policy
from rmpa.bridge.relay import Relay
from rmpa.bridge.session.part import guarded
from rmpa.bridge.session.peer_rpc import PeerRpc
from rmpa.bridge.session.peer_sessions import PeerSessions
from rmpa.bridge.session.proxy_nodes import ProxyNodes
from rmpa.bridge.topics.io.part import Topics
from rmpa.config.settings import LimitSettings
from rmpa.core.contract import Contracts
from rmpa.core.counters import Counters
from rmpa.core.errors import RemoteProtocolError
from rmpa.ros.node.slave_node import SlaveNode
from rmpa.runtime.loop import call_at_tick, yield_to_data

if TYPE_CHECKING:
    import asyncio
    from collections.abc import Callable

    from rmpa.bridge.data.io.route_sender import RouteSender
    from rmpa.bridge.session.part import Part
    from rmpa.config.settings import Settings
    from rmpa.core.identity import Identity
    from rmpa.mesh.io.link import PeerLink
    from rmpa.ros.core.api import Core
    from rmpa.ros.master.parameters import GraphChange
    from rmpa.ros.wire.xmlrpc import XmlRpcValue
    from rmpa.trust.documents import Permissions

_log = logging.getLogger(__name__)


class Bridge:
    """Wires the parts: each gets the sessions of the peers, their messages and the changes of the local graph.

    Args:
        core: The local core, started.
        policy: Decides what may cross.
        contracts: The contracts of the module's topics.
        names: Translates names between this module and its peers.
        relay: Whether this module offers the sources of one peer to others.
        limit_settings: Bounds what is taken from one peer, and what is offered.
        rng: Uniform numbers in [0, 1) for back-off jitter.
        permissions: What each peer may do here; ``None``: the mesh is not secured.
    """

    def __init__(
        self,
        core: Core,
        policy: Policy,
        *,
        rng: Callable[[], float],
        contracts: Contracts | None = None,
        names: Names | None = None,
        relay: bool = False,
        limit_settings: LimitSettings | None = None,
        permissions: Permissions | None = None,
    ) -> None:
        self._core = core
        self.counters = Counters()
        self.gate = PermissionGate(permissions, self.counters)
        """Decides what each peer may do."""
        self.rpc = PeerRpc(self.counters)
        """The requests and notifications to and from the peers."""
        kills = ProxyKills(self.rpc)
        self.node = SlaveNode(
            OWN_NODE,
            core.node_host,
            core.uri,
            advertised_host=core.node_address,
            counters=self.counters,
            on_param_update=self._param_update,
            on_kill=kills.own,
            taps=lambda: self.topics.outbound.connections,
        )
        """The agent's own node in the local graph."""
        self.proxy_nodes = ProxyNodes(core, self.counters)
        """Makes the nodes that stand for the nodes of peers."""
        self.receiver = DataReceiver(self.counters, self._sender)
        """Takes the data frames of the links."""
        self._parts: list[Part] = [self.rpc]
        self._by_op: dict[str, Part] = {}
        self.sessions = PeerSessions(self._parts, self.proxy_nodes, self.receiver, kills.proxy, self.gate)
        """The sessions of the peers."""
        self.relay = Relay(enabled=relay)
        """Which sources of one peer are offered to others."""
        self.topics = Topics(
            core,
            self.node,
            self.sessions,
            self.rpc,
            self.relay,
            policy,
            contracts=contracts if contracts is not None else Contracts(),
            names=names if names is not None else Names(),
            limit_settings=limit_settings if limit_settings is not None else LimitSettings(),
            rng=rng,
            counters=self.counters,
            gate=self.gate,
            find=self.proxy_nodes.publication,
        )
        self.add(self.topics)
        self._reconciler: asyncio.TimerHandle | None = None

    def add(self, part: Part) -> None:
        """Add a part; before ``start()``."""
        self._parts.append(part)
        if part.advertisement:
            self._by_op[part.advertisement] = part

    def place(self, identity: Identity) -> None:
        """Set this agent's identity, before the first link; its own sources that a relay brings back are hidden."""
        self.relay.instance = identity.instance.hex()

    def reload(self, settings: Settings) -> None:
        """Take new settings; unchanged sources and routes go on, changes follow in later turns of the loop."""
        self.gate.reload(settings.trust)
        for part in self._parts:
            with guarded(part):
                part.reload(settings)

    async def start(self) -> None:
        """Start the agent's node, the parts and the following of the local graph."""
        self.node.master_uri = self._core.uri  # only now does the embedded core listen
        await self.node.start()
        await self.proxy_nodes.start()
        self._core.on_change(self._graph_changed)
        self._reconcile_later()
        for part in self._parts:
            part.start()

    async def close(self) -> None:
        """Retract everything that came from peers, and disconnect all local publishers."""
        if self._reconciler is not None:
            self._reconciler.cancel()
        await self.sessions.close()
        for part in reversed(self._parts):
            with guarded(part):
                await part.close()
        await self.proxy_nodes.close()
        await self.node.close()

    # --- the mesh's side ---------------------------------------------------------------------------------------

    def control(self, link: PeerLink, payload: bytes | bytearray | memoryview) -> None:
        """Pass a control frame of a link to the part that it belongs to.

        Raises:
            RemoteProtocolError: It is no valid message, or belongs to no part; the caller closes the link.
        """
        session = self.sessions.of(link)
        if session is None:
            return
        part = self._by_op.get(op_of(payload))
        if part is not None:
            # Parsing takes long, and this is called from a reader of data: so it is done later.
            part.advertised(session, bytes(payload))
            return
        message = decode(payload)
        if not any(part.message(session, message) for part in self._parts):
            raise RemoteProtocolError(f"a message of kind {type(message).__name__} that no part here takes")

    def _sender(self, peer: int, route: int) -> RouteSender | None:
        return self.topics.outbound.sender(peer, route)

    # --- the local graph's side --------------------------------------------------------------------------------

    def _graph_changed(self, change: GraphChange) -> None:
        for part in self._parts:
            with guarded(part):
                part.graph_changed(change)

    def _param_update(self, key: str, _value: XmlRpcValue) -> bool:
        return sum(part.param_update(key) for part in self._parts) > 0  # a sum, because every part must be called

    def _reconcile_later(self) -> None:
        self._reconciler = call_at_tick(limits.RECONCILE_INTERVAL, self._reconcile)

    def _reconcile(self) -> None:
        self._reconcile_later()
        self.sessions.reconcile()
        for part in self._parts:
            yield_to_data()
            with guarded(part):
                part.reconcile()
