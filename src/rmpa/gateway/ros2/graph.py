"""The graph of a ROS 2 domain, read from liveliness tokens. A machine without I/O.

Tokens are declared by any program that reaches the router. What is malformed, has an impossible name or is more than
``limits`` allow is ignored and counted; so are the tokens of gateways, this one's included.
"""

from __future__ import annotations

import re
from collections import Counter
from typing import TYPE_CHECKING, Final

from rmpa.core.errors import RemoteProtocolError
from rmpa.gateway import limits
from rmpa.gateway.ros2.tokens import EntityKind, Ros2Endpoint, Ros2Node, parse_token

if TYPE_CHECKING:
    from collections.abc import Iterator

OWN_NAMESPACE: Final = "/rmpa/"
"""The namespace of the nodes that gateways declare: ``/rmpa/<module>/<node>``, as in the graphs of ROS 1. No ROS 2
node may use it: one that does is taken for a gateway's, and ignored. So two gateways in one domain make no loop."""
_NAME: Final = re.compile(r"(/[A-Za-z0-9_]+)+")
_TYPE: Final = re.compile(r"[A-Za-z][A-Za-z0-9_]*/(msg|srv|action)/[A-Za-z][A-Za-z0-9_]*")


class Ros2Graph:
    """The nodes and endpoints of one ROS 2 domain.

    Args:
        domain: The ROS domain id; tokens of others are ignored.
        own_zid: The Zenoh session of this gateway; its tokens are ignored.
    """

    def __init__(self, domain: int, own_zid: str) -> None:
        self._domain = domain
        self._own_zid = own_zid
        self._nodes: dict[str, Ros2Node] = {}
        self._endpoints: dict[str, Ros2Endpoint] = {}
        self._by_name: dict[str, dict[str, Ros2Endpoint]] = {}
        self._rivals: dict[str, Ros2Node] = {}
        self._rivals_named: dict[str, dict[str, str]] = {}
        """By the name of a node the tokens and sessions of other gateways that show it."""
        self.ignored: Counter[str] = Counter()
        """Tokens that were ignored, by reason."""

    @property
    def nodes(self) -> set[str]:
        """The full names of all nodes that have a token of their own."""
        return {node.name for node in self._nodes.values()}

    def __len__(self) -> int:
        """The number of endpoints."""
        return len(self._endpoints)

    def at(self, name: str, *kinds: EntityKind) -> Iterator[Ros2Endpoint]:
        """The endpoints of a topic or service, of the given kinds, in the order in which they appeared."""
        return (each for each in self._by_name.get(name, {}).values() if each.kind in kinds)

    def rival(self, key: str, *, alive: bool) -> str:
        """Take in that another gateway's node appeared or disappeared.

        Returns:
            The node's name; empty if the token is no such one.
        """
        if not alive:
            gone = self._rivals.pop(key, None)
            if gone is None:
                return ""
            del self._rivals_named[gone.name][key]
            if not self._rivals_named[gone.name]:
                del self._rivals_named[gone.name]
            return gone.name
        try:
            node = parse_token(key)
        except RemoteProtocolError:
            return ""
        if not isinstance(node, Ros2Node) or node.zid == self._own_zid or node.domain != self._domain:
            return ""
        if not node.name.startswith(OWN_NAMESPACE) or len(self._rivals) >= limits.ROS2_NODES_MAX:
            return ""
        self._rivals[key] = node
        self._rivals_named.setdefault(node.name, {})[key] = node.zid
        return node.name

    def led_by(self, node: str) -> str:
        """The Zenoh session of another gateway that shows a module's node; empty if this gateway is to show it.

        Two gateways of one mesh would show each node twice, and each message would come twice. Of those that show a
        node the one with the least session id goes on.
        """
        shown = self._rivals_named.get(node, {}).values()
        return min((zid for zid in shown if _order(zid) < _order(self._own_zid)), key=_order, default="")

    def change(self, key: str, *, alive: bool) -> Ros2Node | Ros2Endpoint | None:
        """Take in that a token appeared or disappeared.

        Returns:
            The node or endpoint that is new or gone; ``None`` if nothing has changed.
        """
        if not alive:
            return self._remove(key)
        if key in self._nodes or key in self._endpoints:
            return None
        try:
            entity = parse_token(key)
        except RemoteProtocolError:
            self.ignored["malformed"] += 1
            return None
        node = entity if isinstance(entity, Ros2Node) else entity.node
        if node.zid == self._own_zid:
            return None
        if reason := self._problem(node, entity):
            self.ignored[reason] += 1
            return None
        if isinstance(entity, Ros2Node):
            self._nodes[key] = entity
        else:
            self._endpoints[key] = entity
            self._by_name.setdefault(entity.name, {})[key] = entity
        return entity

    def _problem(self, node: Ros2Node, entity: Ros2Node | Ros2Endpoint) -> str:
        """Why a token is ignored; empty for no reason."""
        if node.domain != self._domain:
            return "other domain"
        if not _valid(node.name):
            return "impossible name"
        if f"{node.name}/".startswith(OWN_NAMESPACE):
            return "other gateway"
        if isinstance(entity, Ros2Node):
            return "too many nodes" if len(self._nodes) >= limits.ROS2_NODES_MAX else ""
        if not _valid(entity.name) or _TYPE.fullmatch(entity.type) is None:
            return "impossible name"
        if len(self._endpoints) >= limits.ROS2_ENDPOINTS_MAX:
            return "too many endpoints"
        return ""

    def _remove(self, key: str) -> Ros2Node | Ros2Endpoint | None:
        if (node := self._nodes.pop(key, None)) is not None:
            return node
        if (endpoint := self._endpoints.pop(key, None)) is None:
            return None
        others = self._by_name[endpoint.name]
        del others[key]
        if not others:
            del self._by_name[endpoint.name]
        return endpoint


def _order(zid: str) -> int:
    try:
        return int(zid, 16)
    except ValueError:
        return 1 << 128  # no session of Zenoh's: it never leads


def valid_name(name: str) -> bool:
    """Whether ROS 2 allows a topic, service or node of this full name."""
    return _valid(name) and not any(part[0].isdigit() for part in name.split("/")[1:])


def _valid(name: str) -> bool:
    return len(name) <= limits.ROS2_NAME_MAX and _NAME.fullmatch(name) is not None
