"""ROS 2's graph: the way to it, what its tokens tell, and what the gateway declares there.

The way is a Zenoh session, or a process with rclpy (``rclpy_session``): both have endpoints, messages and calls by
rmw_zenoh's tokens and keys.
"""

from __future__ import annotations

import itertools
import re
import time
from collections import Counter
from typing import TYPE_CHECKING, Any, Final, TypeAlias

from rmpa.bridge.policy import Needs
from rmpa.config.rules import ROS2
from rmpa.core.errors import RemoteProtocolError
from rmpa.gateway import limits
from rmpa.gateway.ros2.format import (
    NO_HASH,
    OWN_NAMESPACE,
    USUAL_QOS,
    EntityKind,
    Ros2Attachment,
    Ros2Endpoint,
    Ros2Node,
    gid_of,
    parse_token,
)
from rmpa.gateway.zenoh.threads import QueuedPublisher, ZenohSample, first_answer

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from contextlib import ExitStack

    from rmpa.gateway.ros2.format import Ros2Qos
    from rmpa.gateway.ros2.rclpy_session import RclpyPublisher, RclpyQuery, RclpySession
    from rmpa.gateway.zenoh.session import ArrivedQuery, Declaration, OpenSession
    from rmpa.ros.wire.tcpros import Buffer

    Ros2Link: TypeAlias = OpenSession | RclpySession
    Declared: TypeAlias = Declaration | ExitStack
    Publishing: TypeAlias = QueuedPublisher | RclpyPublisher
    Query: TypeAlias = ArrivedQuery | RclpyQuery

# The name of ROS 2 among the sites, in rules and in the names of proxies; it is ``{module}`` too.
SITE: Final = ROS2
_NEEDS: Final = Needs(
    (),
    "`[[gateway.rule]]` for `ros2` alone: ROS 2 has no permissions",
    key="services and actions of ROS 2",
)


# Two endpoints of one name that do not hear each other, as their keys differ. ROS 2 itself says nothing.


def mismatch(own: Ros2Endpoint, other: Ros2Endpoint, distribution: str) -> str:
    """Why a ROS 2 endpoint does not hear a publisher of ours of the same name; empty if it does.

    Args:
        own: Our publisher.
        other: The ROS 2 node's publisher or subscription.
        distribution: ``gateway.ros2.distribution``.
    """
    does = "subscribes to" if other.kind is EntityKind.SUBSCRIPTION else "publishes"
    if other.type != own.type:
        return (
            f"the node {does} {other.type}; {own.node.name} publishes {own.type}: messages cannot pass between them. "
            "Rename one of the topics, or map the ROS 1 type to the other one (gateway.ros2.mapping)"
        )
    if other.type_hash == own.type_hash:
        return ""
    head = f"the node {does} {other.type} with the type hash {other.type_hash}, {own.node.name} has {own.type_hash}"
    if NO_HASH in (other.type_hash, own.type_hash):
        older = "it" if other.type_hash == NO_HASH else "the gateway"
        return (
            f"{head}: {older} speaks as ROS 2 Humble or older. Messages cannot pass; gateway.ros2.distribution is "
            f"{distribution!r}"
        )
    return (
        f"{head}: their definitions differ, so messages cannot pass. Use the same definition on both sides; for "
        f"types of ROS 2 itself set gateway.ros2.distribution, which is {distribution!r}"
    )


# The graph of a ROS 2 domain, read from liveliness tokens
#
# Tokens are declared by any program that reaches the router. What is malformed, has an impossible name or is more
# than ``limits`` allow is ignored and counted; so are the tokens of gateways, this one's included.


_OTHER_GATEWAY: Final = "other gateway"
_NAME: Final = re.compile(r"(/[A-Za-z0-9_]+)+")
_TYPE: Final = re.compile(r"[A-Za-z][A-Za-z0-9_]*/(msg|srv|action)/[A-Za-z][A-Za-z0-9_]*")


class Ros2Graph:
    """The nodes and endpoints of one ROS 2 domain.

    Args:
        domain: The ROS domain id; tokens of others are ignored.
        own_zid: The Zenoh session of this gateway; its tokens are ignored.

    Attributes:
        ignored: Tokens that were ignored, by reason.
    """

    def __init__(self, domain: int, own_zid: str) -> None:
        self._domain = domain
        self._own_zid = own_zid
        self._nodes: dict[str, Ros2Node] = {}
        self._endpoints: dict[str, Ros2Endpoint] = {}
        self._by_name: dict[str, dict[str, Ros2Endpoint]] = {}
        # The nodes that other gateways show, by token, and their tokens by name.
        self._rivals: dict[str, Ros2Node] = {}
        self._rivals_of: dict[str, set[str]] = {}
        self.ignored: Counter[str] = Counter()

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

    def led_by(self, node: str) -> str:
        """The Zenoh session of another gateway that shows a module's node; empty if this gateway is to show it.

        Two gateways of one mesh would show each node twice, and each message would come twice. Of those that show a
        node the one with the least session id goes on.
        """
        shown = (self._rivals[key].zid for key in self._rivals_of.get(node, ()))
        return min((zid for zid in shown if _order(zid) < _order(self._own_zid)), key=_order, default="")

    def change(self, key: str, *, alive: bool) -> Ros2Node | Ros2Endpoint | None:
        """Take in that a token appeared or disappeared.

        Returns:
            The node or endpoint that is new or gone, also a node that another gateway shows; ``None`` if nothing has
            changed.
        """
        if not alive:
            gone = self._nodes.pop(key, None) or self._endpoints.pop(key, None)
            if gone is None and (rival := self._rivals.pop(key, None)) is not None:
                self._rivals_of[rival.name].remove(key)
                if not self._rivals_of[rival.name]:
                    del self._rivals_of[rival.name]
                return rival
            if isinstance(gone, Ros2Endpoint):
                del self._by_name[gone.name][key]
                if not self._by_name[gone.name]:
                    del self._by_name[gone.name]
            return gone
        if key in self._nodes or key in self._endpoints or key in self._rivals:
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
            if reason != _OTHER_GATEWAY or node is not entity or len(self._rivals) >= limits.ROS2_NODES_MAX:
                return None
            self._rivals[key] = node
            self._rivals_of.setdefault(node.name, set()).add(key)
            return node
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
            return _OTHER_GATEWAY
        if isinstance(entity, Ros2Node):
            return "too many nodes" if len(self._nodes) >= limits.ROS2_NODES_MAX else ""
        if not _valid(entity.name) or _TYPE.fullmatch(entity.type) is None:
            return "impossible name"
        return "too many endpoints" if len(self._endpoints) >= limits.ROS2_ENDPOINTS_MAX else ""


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


# The nodes and endpoints that the gateway declares in ROS 2's graph, for the nodes of its modules. A module's node is
# ``/rmpa/<module>/<node>`` there, as its proxy is here. What the gateway itself subscribes to or calls, for nodes and
# modules that want it, belongs to one node of its own, ``/rmpa/<name of the gateway>``.


_NOT_IN_NAMES: Final = re.compile(r"[^A-Za-z0-9_]")


class OwnEndpoint:
    """One endpoint with its token in ROS 2's graph, and with what takes what comes for it.

    Args:
        nodes: The node's owner.
        endpoint: The endpoint.
        gid: What its messages, requests or replies have in their attachment.
        taking: What takes messages or calls; ``None``: none come.
    """

    def __init__(self, nodes: OwnRos2Nodes, endpoint: Ros2Endpoint, gid: bytes, taking: Declared | None) -> None:
        self.endpoint = endpoint
        self.gid = gid
        self._nodes = nodes
        self._declared: list[Declared] = [
            nodes.session.token(endpoint.token()),
            *([] if taking is None else [taking]),
        ]

    async def call(self, request: Buffer, within: float) -> ZenohSample | None:
        """Call its service as this client; ``None``: it gave no answer in ``within`` seconds."""
        return await self._nodes.call(self.endpoint.key(), self.gid, request, within)

    def close(self) -> None:
        """Take it back, and its node's token if it was the last of it."""
        declared, self._declared = self._declared, []
        for each in declared:
            each.close()
        if declared:
            self._nodes.release(self.endpoint.node)


class OwnRos2Nodes:
    """Declares nodes and endpoints; all numbers of a session are given here.

    Args:
        session: The Zenoh session.
        domain: The ROS domain id.
        name: The gateway's name.
        gid_bytes: The length of a GID: 16, and 24 in ROS 2 Humble.

    Attributes:
        own_name: The node that subscribes and calls for all nodes of the mesh.
        gids: The GIDs of all endpoints that are declared: what comes with one of them is this gateway's own.
    """

    def __init__(self, session: Ros2Link, domain: int, name: str, gid_bytes: int) -> None:
        self.session = session
        self.own_name = OWN_NAMESPACE + _NOT_IN_NAMES.sub("_", name)
        self.gids: set[bytes] = set()
        self._domain = domain
        self._gid_bytes = gid_bytes
        self._numbers = itertools.count()
        self._calls = itertools.count(1)
        self._nodes: dict[str, tuple[Ros2Node, Declared]] = {}
        self._uses: Counter[str] = Counter()

    def declare(
        self,
        node: str,
        kind: EntityKind,
        name: str,
        types: tuple[str, str],
        qos: Ros2Qos = USUAL_QOS,
        *,
        take: Callable[[Any], object] | None = None,
        history: bool = False,
    ) -> OwnEndpoint:
        """Declare an endpoint, and its node if it is the first of it.

        Args:
            node: The node's full name, ``/rmpa/<module>/<node>`` or ``own_name``.
            kind: What it is.
            name: The topic or service, ``/like/this``.
            types: ``package/msg/Name`` or ``package/srv/Name``, and the hash of that type.
            qos: Its QoS.
            take: Called with each message of a subscription (``ZenohSample``), or each call of a service (``Query``).
            history: Whether a subscription gets what publishers keep.
        """
        if node not in self._nodes:
            made = Ros2Node(self._domain, self.session.zid, next(self._numbers), node)
            self._nodes[node] = (made, self.session.token(made.token()))
        self._uses[node] += 1
        owner = self._nodes[node][0]
        endpoint = Ros2Endpoint(owner, next(self._numbers), kind, name, *types, qos)
        gid = gid_of(endpoint.token(), self._gid_bytes)
        self.gids.add(gid)
        taking: Declared | None = None
        if take is not None and kind is EntityKind.SERVICE:
            taking = self.session.queryable(endpoint.key(), take, _NEEDS)  # a client may call once it sees the token
        elif take is not None:
            taking = self.session.subscribe(endpoint.key(), take, history=history)
        return OwnEndpoint(self, endpoint, gid, taking)

    async def call(self, key: str, gid: bytes, request: Buffer, within: float) -> ZenohSample | None:
        """Call a service of ROS 2 as the client with a GID; ``None``: it gave no answer in ``within`` seconds."""
        attachment = Ros2Attachment(next(self._calls), time.time_ns(), gid).serialize()
        return first_answer(await self.session.get(key, request, attachment, timeout=within, all_complete=True))

    def release(self, node: Ros2Node) -> None:
        """One endpoint of a node was taken back; the node's token goes with the last."""
        self._uses[node.name] -= 1
        if not self._uses[node.name]:
            del self._uses[node.name]
            self._nodes.pop(node.name)[1].close()
