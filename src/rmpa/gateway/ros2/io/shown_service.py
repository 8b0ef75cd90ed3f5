"""One service of ROS 2, in the gateway's graph."""

from __future__ import annotations

import asyncio
import time
from typing import TYPE_CHECKING

from rmpa.core.errors import PeerRefused, RmpaError, UnreachableError
from rmpa.gateway import limits
from rmpa.gateway.neighbour import ForeignSource, SourceKind
from rmpa.gateway.ros2.attachment import Ros2Attachment
from rmpa.gateway.ros2.conversion import NoConversion
from rmpa.gateway.ros2.crossing import SITE
from rmpa.gateway.ros2.derived import derive_service
from rmpa.gateway.ros2.mapping import TypePair
from rmpa.gateway.ros2.qos import Ros2Qos
from rmpa.gateway.ros2.service_pair import ServicePair
from rmpa.gateway.ros2.tokens import EntityKind
from rmpa.ros.types.find import find_service_type

if TYPE_CHECKING:
    from collections import Counter

    from rmpa.gateway.graph.foreign_service import ProxiedService
    from rmpa.gateway.ros2.io.own_nodes import OwnEndpoint
    from rmpa.gateway.ros2.io.part import Ros2Context
    from rmpa.gateway.ros2.tokens import Ros2Endpoint
    from rmpa.ros.wire.tcpros import ServiceDescription


class ShownRos2Service:
    """Shows one service of ROS 2 to the nodes here, and passes on their calls.

    Args:
        context: What the parts share.
        server: The server's endpoint.
        here: Its name in the gateway's graph.
        counts: Calls and errors of all services.
    """

    def __init__(self, context: Ros2Context, server: Ros2Endpoint, here: str, counts: Counter[str]) -> None:
        self.server = server
        self.here = here
        self._context = context
        self._counts = counts
        self._pair: ServicePair | None = None
        self._service: ProxiedService | None = None
        self._client: OwnEndpoint | None = None
        self._sequence = 0
        self._calls = 0
        self._closed = False

    def start(self) -> None:
        """Find the types, and show it if they are a pair."""
        self._context.spawn(self._show())

    def close(self) -> None:
        """Take it out of the graph; calls under way get an error."""
        self._closed = True
        self._context.say(self.here, "")
        if self._service is not None:
            self._service.close()
        if self._client is not None:
            self._client.close()

    # --- inside -----------------------------------------------------------------------------------------------------

    async def _show(self) -> None:
        context, server = self._context, self.server
        name = context.mapping.ros1_service(server.type)
        try:
            self._pair = await self._find_pair(name)
        except RmpaError as error:
            context.say(self.here, f"the service of ROS 2's node {server.node.name} is not shown: {error}")
            return
        if not self._closed:
            source = ForeignSource(SourceKind.SERVICE, SITE, "", server.node.name, self.here, name)
            self._service = context.graph.show_service(source, self._serve, self._describe)

    async def _find_pair(self, name: str) -> ServicePair:
        """Pair the service's type with ROS 1's ``name``; what is not known here its node is asked for.

        Raises:
            RmpaError: The types are no pair, or ROS 2's is not known.
        """
        context, server = self._context, self.server
        rule = context.mapping.service(name)
        if rule.name != server.type:
            rule = TypePair(server.type)
        kind = None
        try:
            kind = await asyncio.to_thread(find_service_type, name)
            pair = ServicePair(kind, rule, context.types)
            if pair.type_hash == server.type_hash:
                return pair
            problem = (
                f"{server.type} has the hash {server.type_hash} there, and {pair.type_hash} is that of "
                f"{kind.name} here: the definitions differ"
            )
        except RmpaError as error:
            problem = str(error)
        try:
            types = context.types.variant(await context.asker.learn(of=server))
        except RmpaError as error:
            raise NoConversion(f"{problem}; {error}") from error
        try:
            if kind is None:
                kind = derive_service(types.store, server.type, name, context.ros1_name)
            return ServicePair(kind, rule, types)
        except KeyError as error:
            raise NoConversion(f"{server.type} has no form in ROS 1: {error}") from error

    async def _describe(self) -> ServiceDescription:
        if self._pair is None:
            raise UnreachableError("service", self.here)
        return self._pair.ros1.describe()

    async def _serve(self, request: bytes) -> bytes:
        self._counts["in"] += 1
        try:
            return await self._call(request)
        except RmpaError:
            self._counts["in_failed"] += 1
            raise

    async def _call(self, request: bytes) -> bytes:
        pair, server = self._pair, self.server
        if pair is None or self._closed:
            raise UnreachableError("service", self.here)
        if self._calls >= limits.ROS2_CALLS_MAX:
            raise PeerRefused(self.here, f"{self._calls} calls are under way")
        asked = pair.request.to_ros2(request)
        self._calls += 1
        try:
            answers = await self._context.session.get(
                server.key(), asked, self._attachment(), timeout=limits.ROS2_CALL_TIMEOUT, all_complete=True
            )
        finally:
            self._calls -= 1
        for answer in answers:
            if answer.ok:
                return pair.response.to_ros1(answer.payload)
        if answers:
            raise PeerRefused(server.node.name, answers[0].payload.decode(errors="replace"))
        raise UnreachableError("server of ROS 2", server.name, "it ended, or gave no response")

    def _attachment(self) -> bytes:
        """Number the request; the client appears in ROS 2's graph with its first call."""
        if self._client is None:
            server = self.server
            self._client = self._context.nodes.declare(
                self._context.nodes.own_name,
                EntityKind.CLIENT,
                server.name,
                server.type,
                server.type_hash,
                Ros2Qos(),
            )
        self._sequence += 1
        return Ros2Attachment(self._sequence, time.time_ns(), self._client.gid).serialize()
