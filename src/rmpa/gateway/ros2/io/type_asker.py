"""Asks nodes of ROS 2 for the fields of types that are not known here, by their service ``get_type_description``."""

from __future__ import annotations

import asyncio
import time
from typing import TYPE_CHECKING, Any

from rmpa.gateway import limits
from rmpa.gateway.ros2.attachment import Ros2Attachment
from rmpa.gateway.ros2.conversion import NoConversion
from rmpa.gateway.ros2.io.own_nodes import gid_of
from rmpa.gateway.ros2.pairs import described_types
from rmpa.gateway.ros2.tokens import EntityKind, Ros2Endpoint
from rmpa.gateway.ros2.type_description import SERVICE, parse_type_response, type_request

if TYPE_CHECKING:
    from collections.abc import Mapping

    from rmpa.gateway.ros2.graph import Ros2Graph
    from rmpa.gateway.ros2.io.own_nodes import OwnRos2Nodes
    from rmpa.gateway.ros2.tokens import Ros2Node
    from rmpa.gateway.ros2.types import Ros2Types
    from rmpa.gateway.zenoh.session import OpenSession


class Ros2TypeAsker:
    """Asks for types; at most ``limits.ROS2_ASKS_MAX`` nodes at one time.

    Args:
        session: The Zenoh session.
        nodes: Our nodes in ROS 2's graph.
        ros2: ROS 2's graph.
        types: The types of ROS 2's distribution.
    """

    def __init__(self, session: OpenSession, nodes: OwnRos2Nodes, ros2: Ros2Graph, types: Ros2Types) -> None:
        self._session = session
        self._nodes = nodes
        self._ros2 = ros2
        self._types = types
        self._appeared = asyncio.Event()
        self._learnt: dict[tuple[str, str], Mapping[str, Any]] = {}
        self._asked = 0
        self._asking = 0

    def appeared(self) -> None:
        """An endpoint is new in ROS 2's graph."""
        if self._asking:
            self._appeared.set()
            self._appeared = asyncio.Event()

    async def learn(self, *endpoints: tuple[str, EntityKind], of: Ros2Endpoint) -> dict[str, Any]:
        """The fields of the types of some endpoints of one node, which waits for those that have not appeared yet.

        Args:
            endpoints: The names and kinds of the endpoints; none: the type of ``of`` itself is meant.
            of: An endpoint of the node, which has appeared.

        Returns:
            The fields of the types and of all that they embed, in rosbags' form; each type has the hash of its key.

        Raises:
            NoConversion: The node does not describe them, or describes others.
            RemoteProtocolError: Its answer is malformed.
        """
        found: dict[str, Any] = {}
        if self._asking >= limits.ROS2_ASKS_MAX:
            raise NoConversion(f"{self._asking} ROS 2 nodes are asked for types already; this one is not")
        self._asking += 1
        try:
            for name, kind in endpoints or ((of.name, of.kind),):
                endpoint = of if (name, kind) == (of.name, of.kind) else await self._wait(name, kind, of.node)
                if endpoint is None:
                    raise NoConversion(f"node {of.node.name} has no {name}")
                found |= await self._fields(endpoint)
        finally:
            self._asking -= 1
        return found

    async def _fields(self, endpoint: Ros2Endpoint) -> Mapping[str, Any]:
        key = endpoint.type, endpoint.type_hash
        if key not in self._learnt:
            fields = await self._ask(endpoint)
            described_types(self._types, endpoint.type, endpoint.type_hash, fields)
            if len(self._learnt) >= limits.ROS2_TYPES_MAX:
                del self._learnt[next(iter(self._learnt))]
            self._learnt[key] = fields
        return self._learnt[key]

    async def _ask(self, endpoint: Ros2Endpoint) -> dict[str, Any]:
        server = await self._wait(f"{endpoint.node.name}/{SERVICE}", EntityKind.SERVICE, endpoint.node)
        if server is None:
            raise NoConversion(self._unknown(endpoint))
        self._asked += 1
        gid = gid_of(f"{self._nodes.own_name}/{SERVICE}")
        replies = await self._session.get(
            server.key(),
            type_request(endpoint.type, endpoint.type_hash),
            Ros2Attachment(self._asked, time.time_ns(), gid).serialize(),
            timeout=limits.ROS2_SERVICE_WAIT,
            all_complete=True,
        )
        answer = next((reply for reply in replies if reply.ok), None)
        if answer is None:
            raise NoConversion(f"{server.name} does not answer; {self._unknown(endpoint)}")
        return parse_type_response(answer.payload)

    async def _wait(self, name: str, kind: EntityKind, node: Ros2Node) -> Ros2Endpoint | None:
        """An endpoint of a node, once it is there; ``None`` if it does not appear."""
        try:
            async with asyncio.timeout(limits.ROS2_SERVICE_WAIT):
                while True:
                    for found in self._ros2.at(name, kind):
                        if found.node.name == node.name:
                            return found
                    await self._appeared.wait()
        except TimeoutError:
            return None

    def _unknown(self, endpoint: Ros2Endpoint) -> str:
        distribution = self._types.distribution
        if endpoint.type in self._types:
            return (
                f"its type hash {endpoint.type_hash} is not that of {distribution}'s {endpoint.type}, and node "
                f"{endpoint.node.name} offers no get_type_description: set gateway.ros2.distribution to the one of "
                "that node, or start it with the parameter start_type_description_service"
            )
        return (
            f"the fields of {endpoint.type} are not known, and node {endpoint.node.name} offers no "
            "get_type_description: start the node with the parameter start_type_description_service, or source a "
            "ROS 1 workspace that has the type, with the same fields, where the gateway runs"
        )
