"""The bridge of one agent: its parts connect the local core with the links of the mesh."""

from __future__ import annotations

from typing import TYPE_CHECKING

from rmpa.bridge import limits
from rmpa.bridge.launch import Launcher
from rmpa.bridge.log import ModuleLogs
from rmpa.bridge.messages import decode, op_of
from rmpa.bridge.nodes import ProxyKills
from rmpa.bridge.policy import BridgeContext, PermissionGate, Relay
from rmpa.bridge.proxies import ProxyNodes
from rmpa.bridge.recordings import Recordings
from rmpa.bridge.rpc import PeerRpc
from rmpa.bridge.sessions import Part, PeerSessions, call_each, guarded
from rmpa.bridge.topics.part import Topics
from rmpa.core.errors import RemoteProtocolError
from rmpa.core.identity import OWN_NODE, Identity
from rmpa.core.statistics import Counters
from rmpa.mesh.frames import FrameKind
from rmpa.ros.node.slave_node import SlaveNode
from rmpa.runtime.loop import call_at_tick, yield_to_data

if TYPE_CHECKING:
    import asyncio
    from collections.abc import Callable

    from rmpa.config.settings import Settings
    from rmpa.mesh.io.link import PeerLink
    from rmpa.ros.core.external import Core
    from rmpa.ros.wire.xmlrpc import XmlRpcValue
    from rmpa.trust.permissions import Permissions


class Bridge:
    """Wires the parts: each gets the sessions of the peers, their messages and the changes of the local graph.

    The parts know each other, and what they share, by it.

    Args:
        core: The local core, started.
        settings: What may cross, and how.
        rng: Uniform numbers in [0, 1) for back-off jitter.
        permissions: What each peer may do here; ``None``: the mesh is not secured.

    Attributes:
        node: The agent's own node in the local graph.
        sessions: The sessions of the peers.
        rpc: The requests and notifications to and from the peers.
        relay: Which sources of one peer are offered to others.
        counters: Counts what happens, by name.
        context: The rules that hold now; each reading of the settings makes another one.
        gate: Decides what each peer may do.
        log: The part with the log of this module and its peers.
        launch: The part that starts this module's resources.
        recordings: The part with the recordings of this module and its peers.
        proxy_nodes: Makes the nodes that stand for the nodes of peers.
    """

    def __init__(
        self,
        core: Core,
        settings: Settings,
        *,
        rng: Callable[[], float],
        permissions: Permissions | None = None,
    ) -> None:
        self.core = core
        self.rng = rng
        self.counters = Counters()
        self.gate = PermissionGate(permissions, self.counters)
        self.context = BridgeContext.of(settings, self.gate)
        self.rpc = PeerRpc(self.counters)
        kills = ProxyKills(self)
        self.node = SlaveNode(
            OWN_NODE,
            core.node_host,
            core.uri,
            advertised_host=core.node_address,
            counters=self.counters,
            on_param_update=self._param_update,
            on_kill=kills.own,
            taps=lambda: self.topics.exports.connections,
        )
        self.proxy_nodes = ProxyNodes(core, self.counters, kills.proxy)
        self._parts: list[Part] = [self.rpc]
        self._by_op: dict[str, Part] = {}
        self.sessions = PeerSessions(self._parts, self.proxy_nodes, self.gate)
        self.relay = Relay(enabled=settings.relay)
        self.topics = Topics(self)
        self.log = ModuleLogs(self)
        self.launch = Launcher(self)
        self.add(self.topics)
        self.add(self.log)
        self.add(self.launch)
        self.recordings = Recordings(self)
        self.add(self.recordings)
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
        self.context = BridgeContext.of(settings, self.gate)
        call_each(self._parts, lambda part: part.reload())

    async def start(self) -> None:
        """Start the agent's node, the parts and the following of the local graph."""
        self.node.master_uri = self.core.uri  # only now does the embedded core listen
        await self.node.start()
        await self.proxy_nodes.start()
        self._reconciler = call_at_tick(limits.RECONCILE_INTERVAL, self._reconcile)
        for part in self._parts:
            self.core.on_change(part.graph_changed)
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

    def control(self, link: PeerLink, payload: bytes | bytearray | memoryview) -> None:
        """Pass a control frame of a link to the part that it belongs to.

        Raises:
            RemoteProtocolError: It is no valid message, or belongs to no part; the caller closes the link.
        """
        session = self.sessions.of(link)
        if session is None:
            return
        part = self._by_op.get(op_of(payload))
        if part is None:
            message = decode(payload)
            part = self._by_op.get(str(message.__struct_config__.tag))  # its JSON has blanks, or another order
            if part is None:
                if not any(each.message(session, message) for each in self._parts):
                    raise RemoteProtocolError(f"a message of kind {type(message).__name__} that no part here takes")
                return
        # Parsing takes long, and this is called from a reader of data: so it is done later.
        part.advertised(session, bytes(payload))

    def mark(self, link: PeerLink, kind: FrameKind, route: int, sequence: int) -> None:
        """Pass an acknowledgement, or the answer to a fence, to the route's sender."""
        session = self.sessions.of(link)
        sender = self.topics.exports.sender(session.peer, route) if session is not None else None
        if sender is None:
            return
        if kind is FrameKind.ACK:
            sender.acknowledged(sequence)
        elif kind is FrameKind.FENCED:
            sender.fenced(sequence)

    def _param_update(self, key: str, _value: XmlRpcValue) -> bool:
        return sum(part.param_update(key) for part in self._parts) > 0  # a sum, because every part must be called

    def _reconcile(self) -> None:
        self._reconciler = call_at_tick(limits.RECONCILE_INTERVAL, self._reconcile)
        self.sessions.reconcile()
        for part in self._parts:
            yield_to_data()
            with guarded(part):
                part.reconcile()
