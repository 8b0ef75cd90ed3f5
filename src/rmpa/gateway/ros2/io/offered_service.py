"""One service of a module, in ROS 2's graph."""

from __future__ import annotations

import asyncio
import logging
import time
from typing import TYPE_CHECKING, Final

from rmpa.core.errors import RemoteProtocolError, RmpaError
from rmpa.gateway import limits
from rmpa.gateway.ros2.attachment import Ros2Attachment
from rmpa.gateway.ros2.graph import valid_name
from rmpa.gateway.ros2.io.part import SERVICE_NEEDS
from rmpa.gateway.ros2.qos import Ros2Qos
from rmpa.gateway.ros2.service_pair import ServicePair, ros1_without_use, type_by_name
from rmpa.gateway.ros2.tokens import EntityKind, data_key
from rmpa.ros.types.find import find_service_type

if TYPE_CHECKING:
    from collections import Counter

    from rmpa.gateway.neighbour import MeshSource
    from rmpa.gateway.ros2.io.own_nodes import OwnEndpoint
    from rmpa.gateway.ros2.io.part import Ros2Context
    from rmpa.gateway.zenoh.queries import ArrivedQuery
    from rmpa.gateway.zenoh.session import Declaration
    from rmpa.ros.wire.tcpros import ServiceDescription

_log: Final = logging.getLogger(__name__)


class OfferedService:
    """Offers one service to ROS 2: it asks the server for its type, declares the token, and passes on calls.

    Args:
        context: What the parts share.
        source: The service.
        counts: Calls and errors of all services.
    """

    def __init__(self, context: Ros2Context, source: MeshSource, counts: Counter[str]) -> None:
        self.source = source
        self._context = context
        self._counts = counts
        self._pair: ServicePair | None = None
        self._endpoint: OwnEndpoint | None = None
        self._queryable: Declaration | None = None
        self._calls = 0
        self._started = False
        self._closed = False

    @property
    def type(self) -> str:
        """The type in ROS 2; empty until it is offered."""
        return "" if self._pair is None else self._pair.ros2

    def start(self) -> None:
        """Begin to offer it; once."""
        if not self._started:
            self._started = True
            self._context.spawn(self._offer())

    def close(self) -> None:
        """Take it back; the answers of calls under way are dropped."""
        self._closed = True
        self._context.say(self.source.here, "")
        if self._queryable is not None:
            self._queryable.close()
        if self._endpoint is not None:
            self._endpoint.close()

    # --- inside -----------------------------------------------------------------------------------------------------

    async def _describe(self) -> ServiceDescription | None:
        """Ask the server for its type until it answers; ``None`` once the service is gone."""
        again, longest = limits.ROS2_DESCRIBE_AGAIN
        while not self._closed:
            try:
                return await self._context.graph.describe(self.source)
            except RmpaError as error:
                self._say(f"the service cannot be asked for its type: {error}")
            await asyncio.sleep(again)
            again = min(again * 2, longest)
        return None

    def _without_use(self, service_type: str) -> bool:
        reason = ros1_without_use(service_type, ruled=self._context.mapping.has_service_rule(service_type))
        if reason:
            self._counts["without_use"] += 1
            _log.debug("%s is not offered to ROS 2: %s", self.source.here, reason)
        return bool(reason)

    async def _offer(self) -> None:
        if self._without_use(type_by_name(self.source.name)):
            return  # not even asked for its type: each node has two of these
        description = await self._describe()
        if description is None or self._closed or self._without_use(description.type):
            return
        try:
            kind = await asyncio.to_thread(find_service_type, description.type, description.md5sum)
            self._pair = ServicePair(kind, self._context.mapping.service(kind.name), self._context.types)
        except RmpaError as error:
            self._say(f"ROS 2 does not see this service: {error}")
            return
        if not self._closed:
            self._declare(self._pair)

    def _declare(self, pair: ServicePair) -> None:
        if not valid_name(self.source.here):
            self._say("ROS 2 does not allow this name; a rule with another name lets the service cross")
            return
        self._say("")
        context, name = self._context, self.source.here
        key = data_key(context.settings.ros2.domain, name, pair.ros2, pair.type_hash)
        # Before its token: a client may call as soon as it sees that.
        self._queryable = context.session.queryable(key, self._query, SERVICE_NEEDS)
        self._endpoint = context.nodes.declare(
            self.source.proxy, EntityKind.SERVICE, name, pair.ros2, pair.type_hash, Ros2Qos()
        )

    def _say(self, text: str) -> None:
        self._context.say(self.source.here, text)

    def _query(self, query: ArrivedQuery) -> None:
        if self._calls >= limits.ROS2_CALLS_MAX:
            self._counts["refused"] += 1
            query.reply_error(f"{self._calls} calls of {self.source.here} are under way")
            return
        self._calls += 1
        self._context.spawn(self._answer(query))

    async def _answer(self, query: ArrivedQuery) -> None:
        """Call the server; a call that fails gets Zenoh's error reply, for ROS 2 has no response that says so."""
        self._counts["out"] += 1
        try:
            reply, attachment = await self._call(query)
        except RmpaError as error:
            self._counts["out_failed"] += 1
            _log.warning("a call of %s by ROS 2 failed: %s", self.source.here, error)
            query.reply_error(str(error))
        except asyncio.CancelledError:
            query.reply_error("the gateway ends")
            raise
        else:
            query.reply(query.key, reply, attachment)
            query.finish()
        finally:
            self._calls -= 1

    async def _call(self, query: ArrivedQuery) -> tuple[bytes, bytes]:
        if self._pair is None or self._closed:
            raise RemoteProtocolError(f"the service {self.source.here} is gone")
        asked = Ros2Attachment.parse(query.attachment)
        request = self._pair.request.to_ros1(query.payload)
        response = await self._context.graph.call(self.source, request, limits.ROS2_CALL_TIMEOUT)
        return self._pair.response.to_ros2(response), Ros2Attachment(
            asked.sequence, time.time_ns(), asked.gid
        ).serialize()
