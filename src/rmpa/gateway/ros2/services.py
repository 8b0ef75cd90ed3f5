"""Services between ROS 1 and ROS 2, in both directions; and what the parts of the neighbour ROS 2 share."""

from __future__ import annotations

import asyncio
import logging
import time
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Final, TypeVar

from rmpa.bridge.policy import Needs
from rmpa.core.errors import PeerRefused, RmpaError, UnreachableError
from rmpa.gateway import limits
from rmpa.gateway.foreign import Answering
from rmpa.gateway.ros2.conversion import ActionPair, Conversion, NoConversion
from rmpa.gateway.ros2.format import GID_BYTES, EntityKind, Ros2Attachment, Ros2Qos, data_key
from rmpa.gateway.ros2.graph import SITE, OwnRos2Nodes, Ros2Graph, Ros2TypeAsker, valid_name
from rmpa.gateway.ros2.pairs import TypeMapping, derive_service
from rmpa.gateway.ros2.types import WITHOUT_HASH, Ros2Types, TypePair
from rmpa.gateway.rules import CrossingRules, ForeignSource, SourceKind
from rmpa.ros.types.definitions import known_types
from rmpa.ros.types.find import find_service_type
from rmpa.runtime.tasks import OwnedTasks

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable

    from rosbags.typesys.store import Typestore

    from rmpa.config.rules import GatewaySettings
    from rmpa.core.contract import Contracts
    from rmpa.gateway.foreign import ProxiedService
    from rmpa.gateway.own_graph import AgentGraph
    from rmpa.gateway.ros2.format import Ros2Endpoint
    from rmpa.gateway.ros2.graph import OwnEndpoint
    from rmpa.gateway.ros2.link import Declared, Query, Ros2Link
    from rmpa.gateway.rules import MeshSource
    from rmpa.ros.types.installed import ServiceType
    from rmpa.ros.wire.tcpros import ServiceDescription

_log = logging.getLogger(__name__)

# Seconds until a service that could not be asked for its type is asked again: at first, and at most; it doubles.
_ROS2_DESCRIBE_AGAIN: Final = (0.5, 30.0)

# RMW_GID_STORAGE_SIZE up to ROS 2 Humble.
_GID_BYTES_BEFORE: Final = 24
SERVICE_NEEDS: Final = Needs(
    (),
    "`[[gateway.rule]]` for `ros2` alone: ROS 2 has no permissions",
    key="services and actions of ROS 2",
)


# A service type of ROS 1 and its counterpart in ROS 2. Names, hash, conversion of requests and responses.
#
# ROS 2 has no reply that says "the call failed". rmw_zenoh's client prints the text of a Zenoh error reply and goes
# on waiting (rmw_data_types.cpp, ``client_data_handler``), so a failed call of ROS 1 is answered with one, never with
# an empty response.


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

    Attributes:
        type_hash: The hash in keys and tokens.
        request: Converts requests.
        response: Converts responses.

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
        self.request = Conversion(ros1.request, f"{pair.name}_Request", types, pair.paths.get("request"))
        self.response = Conversion(ros1.response, f"{pair.name}_Response", types, pair.paths.get("response"))


_Kinds = TypeVar("_Kinds")
_Pair = TypeVar("_Pair", ServicePair, ActionPair)


class Ros2Context(OwnedTasks):
    """What the parts of the neighbour ROS 2 share, with its tasks; each part joins topics, services or actions.

    Args:
        graph: The gateway's own graph.
        session: The Zenoh session.
        settings: The table ``[gateway]``.
        contracts: The contracts of topics, for their QoS.

    Attributes:
        types: The types of ROS 2's distribution, and those that were learnt.
        ros2: ROS 2's graph; what this gateway declares is not in it.
        problems: What is wrong, by what it is about.

    Raises:
        ConfigError: The distribution is not known, or a mapping file is wrong.
    """

    # More than twelve fields: each is what a part needs.

    def __init__(self, graph: AgentGraph, session: Ros2Link, settings: GatewaySettings, contracts: Contracts) -> None:
        super().__init__()
        ros2 = settings.ros2
        self.graph: Final = graph
        self.session: Final = session
        self.settings: Final = settings
        self.contracts: Final = contracts
        self.rules: Final = CrossingRules(settings.rules)
        self.types: Final = Ros2Types(ros2.distribution)
        self.mapping: Final = TypeMapping()
        for path in ros2.mapping:
            self.mapping.read(Path(path))
        size = _GID_BYTES_BEFORE if ros2.distribution in WITHOUT_HASH else GID_BYTES
        self.nodes: Final = OwnRos2Nodes(session, ros2.domain, graph.name, size)
        self.ros2: Final = Ros2Graph(ros2.domain, session.zid)
        self.asker: Final = Ros2TypeAsker(self.nodes, self.ros2, self.types)
        self.problems: dict[str, str] = {}

    def ros1_name(self, name: str) -> str:
        """The name of ROS 1 for a message type of ROS 2, ``package/msg/Name``."""
        return self.mapping.ros1_type(name, known_types())

    async def find_pair(
        self,
        server: Ros2Endpoint,
        ros2: str,
        find: Callable[[str], Awaitable[_Kinds]],
        make: Callable[[_Kinds, TypePair, Ros2Types], _Pair],
        derive: Callable[[Typestore, str], _Kinds],
        *endpoints: tuple[str, EntityKind],
    ) -> _Pair:
        """Pair the type of a server of ROS 2; what is not known here its node is asked for.

        Args:
            server: The endpoint whose hash tells whether the types are those that are known here.
            ros2: ``package/srv/Name`` or ``package/action/Name``.
            find: Finds ROS 1's types by the name of the pair in ROS 1.
            make: Makes the pair.
            derive: Makes ROS 1's types of that name from those of ROS 2.
            endpoints: The names and kinds of those whose types the node is asked for; none: that of ``server``.

        Raises:
            RmpaError: The types are no pair, or ROS 2's are not known.
        """
        ros1 = self.mapping.ros1_type(ros2)
        rule = self.mapping.counterpart(ros1, ros2.split("/")[1])
        if rule.name != ros2:
            rule = TypePair(ros2)
        kinds = None
        try:
            kinds = await find(ros1)
            pair = make(kinds, rule, self.types)
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
            return make(kinds or derive(types.store, ros1), rule, types)
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
    """Offers one service to ROS 2: it asks the server for its type, declares the token, and passes on calls.

    Args:
        context: What the parts share.
        source: The service.
    """

    def __init__(self, context: Ros2Context, source: MeshSource) -> None:
        self.source = source
        self._context = context
        self._pair: ServicePair | None = None
        self._declared: tuple[Declared | OwnEndpoint, ...] = ()
        self._answering = Answering(f"service {source.here}", "the gateway ends", limits.ROS2_CALLS_MAX)
        self._started = self._closed = False

    def start(self) -> None:
        """Begin to offer it; once."""
        if not self._started:
            self._started = True
            self._context.start(self._offer(), f"offer {self.source.here}")

    def close(self) -> None:
        """Take it back; calls under way get an error."""
        self._closed = True
        self._say("")
        self._answering.cancel()
        for each in self._declared:
            each.close()

    def _say(self, text: str) -> None:
        self._context.say(self.source.here, text)

    def _without_use(self, service_type: str) -> bool:
        reason = ros1_without_use(service_type, ruled=self._context.mapping.has_service_rule(service_type))
        if reason:
            _log.debug("%s is not offered to ROS 2: %s", self.source.here, reason)
        return bool(reason)

    async def _describe(self) -> ServiceDescription | None:
        """Ask the server for its type until it answers; ``None`` once the service is gone."""
        again, longest = _ROS2_DESCRIBE_AGAIN
        while not self._closed:
            try:
                return await self._context.graph.describe(self.source)
            except RmpaError as error:
                if not self._closed:
                    self._say(f"the service cannot be asked for its type: {error}")
            await asyncio.sleep(again)
            again = min(again * 2, longest)
        return None

    async def _offer(self) -> None:
        context, name = self._context, self.source.here
        if self._without_use(type_by_name(self.source.name)):
            return  # not even asked for its type: each node has two of these
        description = await self._describe()
        if description is None or self._without_use(description.type):
            return
        try:
            kind = await asyncio.to_thread(find_service_type, description.type, description.md5sum)
            pair = self._pair = ServicePair(kind, context.mapping.counterpart(kind.name, "srv"), context.types)
        except RmpaError as error:
            self._say(f"ROS 2 does not see this service: {error}")
            return
        if self._closed:
            return
        if not valid_name(name):
            self._say("ROS 2 does not allow this name; a rule with another name lets the service cross")
            return
        self._say("")
        key = data_key(context.settings.ros2.domain, name, pair.ros2, pair.type_hash)
        # Before its token: a client may call as soon as it sees that.
        take = partial(self._answering.take, respond=self._respond)
        queryable = context.session.queryable(key, take, SERVICE_NEEDS)
        kind_of = EntityKind.SERVICE
        self._declared = (
            queryable,
            context.nodes.declare(self.source.proxy, kind_of, name, pair.ros2, pair.type_hash, Ros2Qos()),
        )

    async def _respond(self, query: Query) -> tuple[bytes, bytes]:
        """Call the server; a call that fails gets Zenoh's error reply, for ROS 2 has no response that says so."""
        assert self._pair is not None  # noqa: S101 - the queryable is declared with it
        try:
            asked = Ros2Attachment.parse(query.attachment)
            request = self._pair.request.to_ros1(query.payload)
            response = await self._context.graph.call(self.source, request, limits.ROS2_CALL_TIMEOUT)
            attachment = Ros2Attachment(asked.sequence, time.time_ns(), asked.gid)
            return self._pair.response.to_ros2(response), attachment.serialize()
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
        self._pair: ServicePair | None = None
        self._service: ProxiedService | None = None
        self._client: OwnEndpoint | None = None
        self._calls = 0
        self._closed = False
        context.start(self._show(), f"show {here}")

    def close(self) -> None:
        """Take it out of the graph; calls under way get an error."""
        self._closed = True
        self._context.say(self.here, "")
        if self._service is not None:
            self._service.close()
        if self._client is not None:
            self._client.close()

    async def _show(self) -> None:
        """Find the types, and show it if they are a pair."""
        context, server = self._context, self.server

        async def find(name: str) -> ServiceType:
            return await asyncio.to_thread(find_service_type, name)

        def derive(store: Typestore, name: str) -> ServiceType:
            return derive_service(store, server.type, name, context.ros1_name)

        try:
            pair = self._pair = await context.find_pair(server, server.type, find, ServicePair, derive)
        except RmpaError as error:
            context.say(self.here, f"the service of ROS 2's node {server.node.name} is not shown: {error}")
            return

        async def describe() -> ServiceDescription:
            return pair.ros1.describe()

        if not self._closed:
            source = ForeignSource(SourceKind.SERVICE, SITE, "", server.node.name, self.here, pair.ros1.name)
            self._service = context.graph.show_service(source, self._serve, describe)

    async def _serve(self, request: bytes) -> bytes:
        pair, server, nodes = self._pair, self.server, self._context.nodes
        if pair is None or self._closed:
            raise UnreachableError("service", self.here)
        if self._calls >= limits.ROS2_CALLS_MAX:
            raise PeerRefused(self.here, f"{self._calls} calls are under way")
        asked = pair.request.to_ros2(request)
        if self._client is None:  # it appears in ROS 2's graph with its first call
            terms = server.name, server.type, server.type_hash, Ros2Qos()
            self._client = nodes.declare(nodes.own_name, EntityKind.CLIENT, *terms)
        self._calls += 1
        try:
            answer = await nodes.call(server.key(), self._client.gid, asked, limits.ROS2_CALL_TIMEOUT)
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

    def mesh_source(self, source: MeshSource, *, there: bool) -> bool:
        """Offer a service of a module to ROS 2, or take it back."""
        if source.kind is not SourceKind.SERVICE:
            return False
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
        return True

    def endpoint(self, endpoint: Ros2Endpoint, *, there: bool) -> bool:
        """Show a service of ROS 2 in the gateway's graph, or take it out."""
        if endpoint.kind is not EntityKind.SERVICE:
            return False
        shown = self.shown.get(endpoint.name)
        if shown is not None and shown.server == endpoint and not there:
            self.shown.pop(endpoint.name).close()
        if there and shown is not None:
            return True
        others = self._context.ros2.at(endpoint.name, EntityKind.SERVICE)
        first = next((each for each in others if not ros2_without_use(each.name, each.type)), None)
        if first is not None and endpoint.name not in self.shown:
            source = ForeignSource(SourceKind.SERVICE, SITE, "", "", endpoint.name, "*")
            decision = self._context.rules.incoming(source)
            if decision.allowed:
                self.shown[endpoint.name] = ShownRos2Service(self._context, first, decision.name)
        return True

    def close(self) -> None:
        """Take back all services of both sides."""
        for offered in (each for services in self._offered.values() for each in services):
            offered.close()
        for shown in self.shown.values():
            shown.close()
