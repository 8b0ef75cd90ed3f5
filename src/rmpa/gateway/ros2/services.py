"""Services between ROS 1 and ROS 2, in both directions; and what the parts of the neighbour ROS 2 share.

ROS 2 has no reply that says "the call failed". rmw_zenoh's client prints the text of a Zenoh error reply and goes on
waiting (rmw_data_types.cpp, ``client_data_handler``), so a failed call of ROS 1 is answered with one, never with an
empty response.
"""

from __future__ import annotations

import asyncio
import logging
import time
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Final, TypeVar

from rmpa.core.errors import PeerRefused, RmpaError, UnreachableError
from rmpa.gateway import limits
from rmpa.gateway.foreign import Answering, ProxiedService
from rmpa.gateway.ros2.asking import Ros2Asker
from rmpa.gateway.ros2.conversion import NoConversion
from rmpa.gateway.ros2.format import GID_BYTES, EntityKind, Ros2Attachment, Ros2Endpoint
from rmpa.gateway.ros2.graph import SITE, OwnRos2Nodes, Ros2Graph, valid_name
from rmpa.gateway.ros2.pairs import ActionPair, Ros2Pairs, ServicePair, TypeMapping
from rmpa.gateway.ros2.types import WITHOUT_HASH, Ros2Types, TypePair
from rmpa.gateway.rules import CrossingRules, ForeignSource, MeshSource, SourceKind
from rmpa.ros.types.find import find_service_type
from rmpa.runtime.tasks import OwnedTasks

if TYPE_CHECKING:
    from collections.abc import Callable

    from rmpa.config.rules import GatewaySettings
    from rmpa.core.contract import Contracts
    from rmpa.gateway.own_graph import AgentGraph
    from rmpa.gateway.ros2.graph import OwnEndpoint, Query, Ros2Link
    from rmpa.ros.types.messages import MessageType
    from rmpa.ros.wire.tcpros import ServiceDescription

_log = logging.getLogger(__name__)

# Seconds until a service that could not be asked for its type is asked again: at first, and at most; it doubles.
_ROS2_DESCRIBE_AGAIN: Final = (0.5, 30.0)

# RMW_GID_STORAGE_SIZE up to ROS 2 Humble.
_GID_BYTES_BEFORE: Final = 24
_LOGGERS: Final = "loggers of ROS 1 nodes have no counterpart in ROS 2"
# Why the other side has no use of a service, by its type or package; of ROS 2 with the kind of its types.
_WITHOUT_USE: Final = {
    "roscpp/GetLoggers": _LOGGERS,
    "roscpp/SetLoggerLevel": _LOGGERS,
    "dynamic_reconfigure/Reconfigure": "ROS 2 has parameters of nodes instead",
    "rosapi": "rosapi asks for a graph of ROS 1",
    "rcl_interfaces/srv": "ROS 1 has no parameters of nodes",
    "type_description_interfaces/srv": "ROS 1 has definitions in the headers of its connections",
    "lifecycle_msgs/srv": "ROS 1 has no managed nodes",
}
# The types of services that each node of rospy and roscpp has, by the ends of their names.
_LOGGER_TYPES: Final = {"get_loggers": "roscpp/GetLoggers", "set_logger_level": "roscpp/SetLoggerLevel"}


def without_use(type_name: str) -> str:
    """Why the other side has no use of a service of ROS 1 (``package/Name``) or ROS 2; empty if it has."""
    package = type_name.rpartition("/")[0]
    if package.endswith("/action"):
        return "it is a part of an action"
    return _WITHOUT_USE.get(type_name) or _WITHOUT_USE.get(package, "")


_Pair = TypeVar("_Pair", ServicePair, ActionPair)


class Ros2Context(OwnedTasks):
    """What the parts of the neighbour ROS 2 share, with its tasks; each part joins topics, services or actions.

    Args:
        graph: The gateway's own graph.
        session: The Zenoh session.
        settings: The table ``[gateway]``.
        contracts: The contracts of topics, for their QoS.
        find: Finds a ROS 1 type on this machine by its name; raises ``RmpaError`` if there is none.

    Attributes:
        types: The types of ROS 2's distribution, and those that were learnt.
        pairs: Which type is which, by names and mapping files.
        ros2: ROS 2's graph; what this gateway declares is not in it.
        problems: What is wrong, by what it is about.

    Raises:
        ConfigError: The distribution is not known, or a mapping file is wrong.
    """

    # More than twelve fields: each is what a part needs.

    def __init__(
        self,
        graph: AgentGraph,
        session: Ros2Link,
        settings: GatewaySettings,
        contracts: Contracts,
        find: Callable[[str], MessageType],
    ) -> None:
        super().__init__()
        ros2 = settings.ros2
        self.graph: Final = graph
        self.session: Final = session
        self.settings: Final = settings
        self.contracts: Final = contracts
        self.rules: Final = CrossingRules(settings.rules)
        self.types: Final = Ros2Types(ros2.distribution)
        mapping = TypeMapping()
        for path in ros2.mapping:
            mapping.read(Path(path))
        self.pairs: Final = Ros2Pairs(self.types, mapping, find)
        size = _GID_BYTES_BEFORE if ros2.distribution in WITHOUT_HASH else GID_BYTES
        self.nodes: Final = OwnRos2Nodes(session, ros2.domain, graph.name, size)
        self.ros2: Final = Ros2Graph(ros2.domain, session.zid)
        self.asker: Final = Ros2Asker(self.nodes, self.ros2, self.types, self.rules)
        self.problems: dict[str, str] = {}

    async def find_pair(
        self,
        server: Ros2Endpoint,
        ros2: str,
        kind: type[_Pair],
        *endpoints: tuple[str, EntityKind],
    ) -> _Pair:
        """Pair the type of a server of ROS 2; what is not known here its node is asked for.

        Args:
            server: The endpoint whose hash tells whether the types are those that are known here.
            ros2: ``package/srv/Name`` or ``package/action/Name``.
            kind: The class of the pair, which finds ROS 1's types by their name, or makes them from those of ROS 2.
            endpoints: The names and kinds of those whose types the node is asked for; none: that of ``server``.

        Raises:
            RmpaError: The types are no pair, or ROS 2's are not known.
        """
        ros1 = self.pairs.mapping.ros1_type(ros2)
        rule = self.pairs.mapping.counterpart(ros1, ros2.split("/")[1])
        if rule.name != ros2:
            rule = TypePair(ros2)
        kinds = None
        try:
            kinds = await kind.find(ros1)
            pair = kind(kinds, rule, self.types)
            if pair.type_hash == server.type_hash:
                return pair
            problem = (
                f"{server.type} has the hash {server.type_hash} there, and {pair.type_hash} is that of {ros1} here: "
                "the definitions differ"
            )
        except RmpaError as error:
            problem = str(error)
        try:
            types = self.types.variant(await self.asker.learn(*endpoints, of=server))
            return kind(kinds or kind.derive(types.store, ros2, ros1, self.pairs.ros1_name), rule, types)
        except RmpaError as error:
            raise NoConversion(f"{problem}; {error}") from error
        except KeyError as error:
            raise NoConversion(f"{problem}; {ros2} has no form in ROS 1: {error}") from error

    def say(self, subject: str, text: str) -> None:
        """Log a problem once, and keep it: what it is about, and the text. An empty text: it is solved."""
        if not text:
            self.problems.pop(subject, None)
        elif self.problems.get(subject) != text:
            if len(self.problems) >= limits.ROS2_PROBLEMS_MAX:
                del self.problems[next(iter(self.problems))]
            self.problems[subject] = text
            _log.warning("! ROS 2: %s: %s [no-conversion]", subject, text)


class OfferedService:
    """Offers one service to ROS 2: it asks the server for its type, declares it, and passes on calls.

    Args:
        context: What the parts share.
        source: The service.
    """

    def __init__(self, context: Ros2Context, source: MeshSource) -> None:
        self.source = source
        self._context = context
        self._endpoint: OwnEndpoint | None = None
        self._answering = Answering(f"service {source.here}", "the gateway ends", limits.ROS2_CALLS_MAX)
        self._offering: asyncio.Task[None] | None = None

    def start(self) -> None:
        """Begin to offer it; once."""
        if self._offering is None:
            self._offering = self._context.start(self._offer(), f"offer {self.source.here}")

    def close(self) -> None:
        """Take it back; calls under way get an error."""
        if self._offering is not None:
            self._offering.cancel()
        self._say("")
        self._answering.cancel()
        if self._endpoint is not None:
            self._endpoint.close()

    def _say(self, text: str) -> None:
        self._context.say(self.source.here, text)

    def _without_use(self, type_name: str) -> bool:
        """Whether ROS 2 has no use of it, and no rule of a user says that it has."""
        reason = without_use(type_name)
        if not reason or self._context.pairs.mapping.has_service_rule(type_name):
            return False
        _log.debug("%s is not offered to ROS 2: %s", self.source.here, reason)
        return True

    async def _describe(self) -> ServiceDescription:
        """Ask the server for its type until it answers."""
        again, longest = _ROS2_DESCRIBE_AGAIN
        while True:
            try:
                return await self._context.graph.describe(self.source)
            except RmpaError as error:
                self._say(f"the service cannot be asked for its type: {error}")
            await asyncio.sleep(again)
            again = min(again * 2, longest)

    async def _offer(self) -> None:
        context, name = self._context, self.source.here
        if self._without_use(_LOGGER_TYPES.get(self.source.name.rpartition("/")[2], "")):
            return  # not even asked for its type: each node has two of these
        description = await self._describe()
        if self._without_use(description.type):
            return
        try:
            kind = await asyncio.to_thread(find_service_type, description.type, description.md5sum)
            pair = ServicePair(kind, context.pairs.mapping.counterpart(kind.name, "srv"), context.types)
        except RmpaError as error:
            self._say(f"ROS 2 does not see this service: {error}")
            return
        if not valid_name(name):
            self._say("ROS 2 does not allow this name; a rule with another name lets the service cross")
            return
        self._say("")
        respond = partial(self._respond, pair)
        self._endpoint = context.nodes.declare(
            self.source.proxy,
            EntityKind.SERVICE,
            name,
            (pair.ros2, pair.type_hash),
            take=lambda query: self._answering.take(query, respond),
        )

    async def _respond(self, pair: ServicePair, query: Query) -> tuple[bytes, bytes]:
        """Call the server; a call that fails gets Zenoh's error reply, for ROS 2 has no response that says so."""
        try:
            asked = Ros2Attachment.parse(query.attachment)
            request = pair.request.to_ros1(query.payload)
            response = await self._context.graph.call(self.source, request, limits.ROS2_CALL_TIMEOUT)
            attachment = Ros2Attachment(asked.sequence, time.time_ns(), asked.gid)
            return pair.response.to_ros2(response), attachment.serialize()
        except RmpaError as error:
            _log.warning("! a call of %s by ROS 2 failed: %s [service-failed]", self.source.here, error)
            raise


class ShownRos2Service:
    """Shows one service of ROS 2 to the nodes here, and passes on their calls.

    Args:
        context: What the parts share.
        server: The server's endpoint.
        here: Its name in the gateway's graph.
    """

    def __init__(self, context: Ros2Context, server: Ros2Endpoint, here: str) -> None:
        self.server = server
        self.here = here
        self._context = context
        self._service: ProxiedService | None = None
        self._client: OwnEndpoint | None = None
        self._calls = 0
        self._showing = context.start(self._show(), f"show {here}")

    def close(self) -> None:
        """Take it out of the graph; calls under way get an error."""
        self._showing.cancel()
        self._context.say(self.here, "")
        if self._service is not None:
            self._service.close()
        if self._client is not None:
            self._client.close()

    async def _show(self) -> None:
        """Find the types, and show it if they are a pair."""
        context, server = self._context, self.server
        try:
            pair = await context.find_pair(server, server.type, ServicePair)
        except RmpaError as error:
            context.say(self.here, f"the service of ROS 2's node {server.node.name} is not shown: {error}")
            return

        async def describe() -> ServiceDescription:
            return pair.ros1.describe()

        source = ForeignSource(SourceKind.SERVICE, SITE, "", server.node.name, self.here, pair.ros1.name)
        self._service = context.graph.show_service(source, partial(self._serve, pair), describe)

    async def _serve(self, pair: ServicePair, request: bytes) -> bytes:
        server, nodes = self.server, self._context.nodes
        if self._calls >= limits.ROS2_CALLS_MAX:
            raise PeerRefused(self.here, f"{self._calls} calls are under way")
        asked = pair.request.to_ros2(request)
        if self._client is None:  # it appears in ROS 2's graph with its first call
            terms = EntityKind.CLIENT, server.name, (server.type, server.type_hash)
            self._client = nodes.declare(nodes.own_name, *terms)
        self._calls += 1
        try:
            answer = await self._client.call(asked, limits.ROS2_CALL_TIMEOUT)
        finally:
            self._calls -= 1
        if answer is None:
            raise UnreachableError("server of ROS 2", server.name, "it ended, or gave no response")
        if not answer.ok:
            raise PeerRefused(server.node.name, answer.text)
        return pair.response.to_ros1(answer.payload)


class Ros2Services:
    """Joins services both ways. Of several servers of one name the first is called, as in each of the graphs.

    Attributes:
        shown: The services of ROS 2 in the gateway's graph, by their names in ROS 2.
    """

    def __init__(self, context: Ros2Context) -> None:
        self._context = context
        self._offered: dict[str, list[OfferedService]] = {}
        self.shown: dict[str, ShownRos2Service] = {}

    def mesh_source(self, source: MeshSource, *, there: bool) -> None:
        """Offer a service of a module to ROS 2, or take it back."""
        services = self._offered.setdefault(source.here, [])
        known = next((each for each in services if each.source == source), None)
        if known is not None:
            services.remove(known)
            known.close()
        if there and self._context.rules.outgoing_to(SITE, source.module, source.name).allowed:
            services.append(OfferedService(self._context, source))
        if services:
            services[0].start()
        else:
            del self._offered[source.here]

    def endpoint(self, endpoint: Ros2Endpoint, *, there: bool) -> None:
        """Show a service of ROS 2 in the gateway's graph, or take it out."""
        shown = self.shown.get(endpoint.name)
        if shown is not None and shown.server == endpoint and not there:
            self.shown.pop(endpoint.name).close()
        if there and shown is not None:
            return
        others = self._context.ros2.at(endpoint.name, EntityKind.SERVICE)
        first = next((each for each in others if not without_use(each.type)), None)
        if first is not None and endpoint.name not in self.shown:
            source = ForeignSource(SourceKind.SERVICE, SITE, "", "", endpoint.name, "*")
            decision = self._context.rules.incoming(source)
            if decision.allowed:
                self.shown[endpoint.name] = ShownRos2Service(self._context, first, decision.name)

    def close(self) -> None:
        """Take back all services of both sides."""
        for offered in (each for services in self._offered.values() for each in services):
            offered.close()
        for shown in self.shown.values():
            shown.close()
