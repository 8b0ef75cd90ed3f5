"""The nodes and endpoints that the gateway declares in ROS 2's graph, for the nodes of its modules.

A module's node is ``/rmpa/<module>/<node>`` there, as its proxy is here. What the gateway itself subscribes to or
calls, for nodes and modules that want it, belongs to one node of its own, ``/rmpa/<name of the gateway>``.
"""

from __future__ import annotations

import re
from typing import TYPE_CHECKING, Final

from rmpa.gateway.ros2.graph import OWN_NAMESPACE
from rmpa.gateway.ros2.tokens import Ros2Endpoint, Ros2Node

if TYPE_CHECKING:
    from rmpa.gateway.ros2.qos import Ros2Qos
    from rmpa.gateway.ros2.tokens import EntityKind
    from rmpa.gateway.zenoh.session import Declaration, OpenSession

_NOT_IN_NAMES: Final = re.compile(r"[^A-Za-z0-9_]")


class OwnEndpoint:
    """One endpoint with its token in ROS 2's graph.

    Args:
        nodes: The node's owner.
        endpoint: The endpoint.
        gid_bytes: The length of its GID.
    """

    def __init__(self, nodes: OwnRos2Nodes, endpoint: Ros2Endpoint, gid_bytes: int) -> None:
        self.endpoint = endpoint
        self.gid = gid_of(endpoint.token(), gid_bytes)
        """What its messages, requests or replies have in their attachment."""
        self._nodes = nodes
        self._token: Declaration | None = nodes.session.token(endpoint.token())

    def close(self) -> None:
        """Take its token back, and its node's if it was the last of it."""
        if self._token is not None:
            self._token.close()
            self._token = None
            self._nodes.release(self.endpoint.node)


class OwnRos2Nodes:
    """Declares nodes and endpoints; all numbers of a session are given here.

    Args:
        session: The Zenoh session.
        domain: The ROS domain id.
        name: The gateway's name.
        gid_bytes: The length of a GID: 16, and 24 in ROS 2 Humble.
    """

    def __init__(self, session: OpenSession, domain: int, name: str, gid_bytes: int) -> None:
        self.session = session
        self.own_name = OWN_NAMESPACE + _NOT_IN_NAMES.sub("_", name)
        """The node that subscribes and calls for all nodes of the mesh."""
        self.gids: set[bytes] = set()
        """The GIDs of all endpoints that are declared: what comes with one of them is this gateway's own."""
        self._domain = domain
        self._gid_bytes = gid_bytes
        self._next = 0
        self._nodes: dict[str, tuple[Ros2Node, Declaration]] = {}
        self._uses: dict[str, int] = {}

    def declare(
        self, node: str, kind: EntityKind, name: str, type_name: str, type_hash: str, qos: Ros2Qos
    ) -> OwnEndpoint:
        """Declare an endpoint, and its node if it is the first of it.

        Args:
            node: The node's full name, ``/rmpa/<module>/<node>`` or ``own_name``.
            kind: What it is.
            name: The topic or service, ``/like/this``.
            type_name: ``package/msg/Name`` or ``package/srv/Name``.
            type_hash: The hash of the type.
            qos: Its QoS.
        """
        if node not in self._nodes:
            made = Ros2Node(self._domain, self.session.zid, self._number(), node)
            self._nodes[node] = (made, self.session.token(made.token()))
        owner = self._nodes[node][0]
        self._uses[node] = self._uses.get(node, 0) + 1
        endpoint = Ros2Endpoint(owner, self._number(), kind, name, type_name, type_hash, qos)
        declared = OwnEndpoint(self, endpoint, self._gid_bytes)
        self.gids.add(declared.gid)
        return declared

    def release(self, node: Ros2Node) -> None:
        """One endpoint of a node was taken back; the node's token goes with the last."""
        self._uses[node.name] -= 1
        if not self._uses[node.name]:
            del self._uses[node.name]
            self._nodes.pop(node.name)[1].close()

    def _number(self) -> int:
        self._next += 1
        return self._next - 1


def gid_of(token: str, size: int = 16) -> bytes:
    """The GID of an endpoint: the XXH3-128 of its token, the low half first; longer ones have zeros behind."""
    import xxhash  # noqa: PLC0415 - of the extra "zenoh"

    return int(xxhash.xxh3_128_intdigest(token.encode())).to_bytes(16, "little").ljust(size, b"\0")
