"""Services between ROS 1 and ROS 2, in both directions.

One service of a module, in ROS 2's graph.
"""

from __future__ import annotations

import asyncio
import logging
import time
from collections import Counter
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, Protocol

from rmpa.bridge.policy import Needs
from rmpa.core.errors import PeerRefused, RemoteProtocolError, RmpaError, UnreachableError
from rmpa.gateway import limits
from rmpa.gateway.neighbour import ForeignSource, SourceKind
from rmpa.gateway.ros2.conversion import Conversion, NoConversion
from rmpa.gateway.ros2.format import EntityKind, Ros2Attachment, Ros2Qos, data_key
from rmpa.gateway.ros2.graph import SITE, valid_name
from rmpa.gateway.ros2.mapping import TypePair
from rmpa.gateway.ros2.pairs import derive_service
from rmpa.ros.types.definitions import known_types
from rmpa.ros.types.find import find_service_type

if TYPE_CHECKING:
    from collections.abc import Callable, Coroutine

    from rmpa.config.rules import GatewaySettings
    from rmpa.core.contract import Contracts
    from rmpa.gateway.foreign import ProxiedService
    from rmpa.gateway.neighbour import MeshSource
    from rmpa.gateway.own_graph import AgentGraph
    from rmpa.gateway.ros2.format import Ros2Endpoint
    from rmpa.gateway.ros2.graph import OwnEndpoint, OwnRos2Nodes, Ros2Crossing, Ros2Graph, Ros2TypeAsker
    from rmpa.gateway.ros2.mapping import TypeMapping
    from rmpa.gateway.ros2.types import Ros2Types
    from rmpa.gateway.zenoh.config import ArrivedQuery
    from rmpa.gateway.zenoh.session import Declaration, OpenSession
    from rmpa.ros.types.installed import ServiceType
    from rmpa.ros.wire.tcpros import ServiceDescription


# A service type of ROS 1 and its counterpart in ROS 2: names, hash, conversion of requests and responses.
#
# ROS 2 has no reply that says "the call failed". rmw_zenoh's client prints the text of a Zenoh error reply and
# goes on
# waiting (rmw_data_types.cpp, ``client_data_handler``), so a failed call of ROS 1 is answered with one, never with
# an
# empty response.


_LOGGERS: Final = "loggers of ROS 1 nodes have no counterpart in ROS 2"
_ROS1_WITHOUT_USE: Final = {
    "roscpp/GetLoggers": _LOGGERS,
    "roscpp/SetLoggerLevel": _LOGGERS,
    "dynamic_reconfigure/Reconfigure": "ROS 2 has parameters of nodes instead",
}
_ROS2_WITHOUT_USE: Final = {
    "rcl_interfaces": "ROS 1 has no parameters of nodes",
    "type_description_interfaces": "ROS 1 has definitions in the headers of its connections",
    "lifecycle_msgs": "ROS 1 has no managed nodes",
}
_ACTION_PART: Final = "/_action/"


_LOGGER_NAMES: Final = {"get_loggers": "roscpp/GetLoggers", "set_logger_level": "roscpp/SetLoggerLevel"}


def type_by_name(name: str) -> str:
    """The type of a service that each node of rospy and roscpp has, by its name; empty for others."""
    return _LOGGER_NAMES.get(name.rpartition("/")[2], "")


def ros1_without_use(service_type: str, *, ruled: bool = False) -> str:
    """Why ROS 2 has no use of a service of ROS 1; empty if it has.

    Args:
        service_type: ``package/Name``.
        ruled: Whether a mapping file has a rule for it, which the user wrote because there is a use.
    """
    if ruled:
        return ""
    package = service_type.partition("/")[0]
    if package == "rosapi":
        return "rosapi asks for a graph of ROS 1"
    return _ROS1_WITHOUT_USE.get(service_type, "")


def ros2_without_use(name: str, service_type: str) -> str:
    """Why ROS 1 has no use of a service of ROS 2 as a service; empty if it has.

    Args:
        name: The service's name.
        service_type: ``package/srv/Name``.
    """
    package, kind, *_ = service_type.split("/")
    if _ACTION_PART in name or kind == "action":
        return "it is a part of an action"
    return _ROS2_WITHOUT_USE.get(package, "")


class ServicePair:
    """Converts the calls of one service type.

    Args:
        ros1: The type of ROS 1.
        pair: Its counterpart.
        types: ROS 2's types; the service type is learnt from ROS 1's fields if it is not known.

    Raises:
        NoConversion: The types are no pair.
    """

    def __init__(self, ros1: ServiceType, pair: TypePair, types: Ros2Types) -> None:
        if pair.paths and pair.name not in types:
            raise NoConversion(
                f"the rule of {ros1.name} maps fields to {pair.name}, whose definition is not known here: "
                "source the ROS 2 workspace that has it"
            )
        self.ros1 = ros1
        self.ros2 = pair.name
        self.type_hash = types.service_hash(ros1, pair.name)
        """The hash in keys and tokens."""
        self.request = Conversion(ros1.request, f"{pair.name}_Request", types, pair.paths.get("request"))
        """Converts requests."""
        self.response = Conversion(ros1.response, f"{pair.name}_Response", types, pair.paths.get("response"))
        """Converts responses."""


# The parts of the neighbour ROS 2: each joins topics, services or actions, both ways.


SERVICE_NEEDS: Final = Needs(
    (),
    "`[[gateway.rule]]` for `ros2` alone: ROS 2 has no permissions",
    key="services and actions of ROS 2",
)


@dataclass(frozen=True, slots=True)
class Ros2Context:
    """What the parts share.

    Args:
        graph: The gateway's own graph.
        session: The Zenoh session.
        settings: The table ``[gateway]``.
        contracts: The contracts of topics, for their QoS.
        types: The types of ROS 2's distribution, and those that were learnt.
        mapping: The rules of the mapping files.
        crossing: Which sources cross, and under which name.
        nodes: Declares our nodes and endpoints in ROS 2's graph, and gives their GIDs.
        ros2: ROS 2's graph; what this gateway declares is not in it.
        asker: Asks nodes of ROS 2 for types that are not known here.
        spawn: Runs a coroutine in the background; it is cancelled when the neighbour closes.
        say: Logs a problem once, and keeps it for ``report``: what it is about, and the text. An empty text: solved.
    """

    graph: AgentGraph
    session: OpenSession
    settings: GatewaySettings
    contracts: Contracts
    types: Ros2Types
    mapping: TypeMapping
    crossing: Ros2Crossing
    nodes: OwnRos2Nodes
    ros2: Ros2Graph
    asker: Ros2TypeAsker
    spawn: Callable[[Coroutine[None, None, None]], None]
    say: Callable[[str, str], None]

    def ros1_name(self, name: str) -> str:
        """The name of ROS 1 for a message type of ROS 2, ``package/msg/Name``."""
        return self.mapping.ros1_type(name, known_types())


class Ros2Part(Protocol):
    """One part. All is called in the event loop. The first part that takes a source or an endpoint has it."""

    def mesh_source(self, source: MeshSource, *, there: bool) -> bool:
        """A source of a module appeared or is gone. Rules were not looked at.

        Returns:
            Whether this part takes it: then no other part is told.
        """

    def endpoint(self, endpoint: Ros2Endpoint, *, there: bool) -> bool:
        """An endpoint of a ROS 2 node appeared or is gone.

        Returns:
            Whether this part takes it: then no other part is told.
        """

    def close(self) -> None:
        """Take back everything that was declared."""

    def report(self) -> dict[str, object]:
        """What ``rmpa site`` and the snapshot show of it, as JSON values."""


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


# One service of ROS 2, in the gateway's graph.


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
        name = context.mapping.ros1_type(server.type)
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


# The services of modules in ROS 2's graph, and ROS 2's services in the gateway's graph.


class Ros2Services:
    """Joins services both ways. Of several servers of one name the first is called, as in each of the graphs."""

    def __init__(self, context: Ros2Context) -> None:
        self._context = context
        self._offered: dict[str, list[OfferedService]] = {}
        self._shown: dict[str, ShownRos2Service] = {}
        self._counts: Counter[str] = Counter()

    def mesh_source(self, source: MeshSource, *, there: bool) -> bool:
        """Offer a service of a module to ROS 2, or take it back."""
        if source.kind is not SourceKind.SERVICE:
            return False
        if not there:
            self._withdraw(source)
        elif self._context.crossing.outgoing(source.module, source.name).allowed:
            services = self._offered.setdefault(source.here, [])
            services.append(OfferedService(self._context, source, self._counts))
            services[0].start()
        return True

    def endpoint(self, endpoint: Ros2Endpoint, *, there: bool) -> bool:
        """Show a service of ROS 2 in the gateway's graph, or take it out."""
        if endpoint.kind is not EntityKind.SERVICE:
            return False
        if ros2_without_use(endpoint.name, endpoint.type):
            self._counts["without_use"] += there
            return True
        shown = self._shown.get(endpoint.name)
        if there and shown is None:
            self._show(endpoint)
        elif not there and shown is not None and shown.server == endpoint:
            self._replace(endpoint)
        return True

    def close(self) -> None:
        """Take back all services of both sides."""
        for services in self._offered.values():
            for each in services:
                each.close()
        for shown in self._shown.values():
            shown.close()
        self._offered.clear()
        self._shown.clear()

    def report(self) -> dict[str, object]:
        """The services that are joined, and counts of calls, errors and refusals."""
        return {
            "services_in": {name: each.server.type for name, each in self._shown.items()},
            "service_calls": dict(self._counts),
        }

    # --- inside -----------------------------------------------------------------------------------------------------

    def _withdraw(self, source: MeshSource) -> None:
        services = self._offered.get(source.here, [])
        for each in services:
            if each.source == source:
                services.remove(each)
                each.close()
                break
        if services:
            services[0].start()
        else:
            self._offered.pop(source.here, None)

    def _show(self, endpoint: Ros2Endpoint) -> None:
        if (here := self._context.crossing.name_here(endpoint.name)) is not None:
            self._shown[endpoint.name] = shown = ShownRos2Service(self._context, endpoint, here, self._counts)
            shown.start()

    def _replace(self, gone: Ros2Endpoint) -> None:
        """A server is gone: the next of that name takes its place."""
        self._shown.pop(gone.name).close()
        others = self._context.ros2.at(gone.name, EntityKind.SERVICE)
        if (other := next((each for each in others if not ros2_without_use(each.name, each.type)), None)) is not None:
            self._show(other)
