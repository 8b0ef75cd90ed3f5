"""The services of rosapi, computed from a snapshot of the graph in memory: no question goes to a master.

Names, requests and responses are those of rosbridge_suite's package rosapi (branch ros1). They are answered here,
and not offered as ROS services.
"""

from __future__ import annotations

import functools
import json
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any, Final, TypeAlias
from urllib.parse import urlsplit

from rmpa.core.errors import RmpaError
from rmpa.ros.types.codec import codec_for
from rmpa.ros.types.definitions import parse_definition
from rmpa.ros.types.installed import ServiceType
from rmpa.web import limits
from rmpa.web.rosbridge.protocol import OpError, graph_name, type_name

if TYPE_CHECKING:
    from collections.abc import Coroutine

    from rmpa.ros.types.definitions import Field, Specification
    from rmpa.ros.types.messages import MessageType
    from rmpa.web.hub.graph import GraphService, GraphTopic, GraphWatch
    from rmpa.web.hub.hub import HubClient
    from rmpa.web.hub.node_link import ParamValue


# rosapi's TypeDef: a message type as lists of names, types and examples, for clients that make forms of them.


_TIMES: Final = ("time", "duration")
_EXAMPLES: Final = {"string": "", "bool": "False", "float32": "0.0", "float64": "0.0", "time": "{}", "duration": "{}"}


def typedefs_of(kind: MessageType) -> list[dict[str, Any]]:
    """The type, then all that it embeds, each once, in the order of the fields."""
    return _typedefs(kind.name, kind.definition)


@functools.lru_cache(maxsize=64)
def _typedefs(name: str, definition: str) -> list[dict[str, Any]]:
    known = parse_definition(name, definition)
    order: dict[str, None] = {}
    _visit(name, known, order)
    return [_time(each) if each in _TIMES else _typedef(known[each]) for each in order]


def _visit(name: str, known: Mapping[str, Specification], order: dict[str, None]) -> None:
    order[name] = None
    for field in known[name].fields if name in known else ():
        # The depth is bounded by the definition's parser.
        if field.type not in order and (field.type in _TIMES or not field.primitive):
            _visit(field.type, known, order)


def _typedef(specification: Specification) -> dict[str, Any]:
    fields = specification.fields
    constants = sorted(_constant(each) for each in specification.constants)
    return {
        "type": specification.name,
        "fieldnames": [field.name for field in fields],
        "fieldtypes": [field.type for field in fields],
        "fieldarraylen": [(field.size or 0) if field.array else -1 for field in fields],
        "examples": [_example(field) for field in fields],
        "constnames": [name for name, _ in constants],
        "constvalues": [value for _, value in constants],
    }


def _constant(text: str) -> tuple[str, str]:
    """The name and value of ``type name=value``."""
    name, _, value = text.partition(" ")[2].partition("=")
    return name, value


def _example(field: Field) -> str:
    if field.array:
        return "[]"
    return _EXAMPLES.get(field.type, "0") if field.primitive else "{}"


def _time(name: str) -> dict[str, Any]:
    return {
        "type": name,
        "fieldnames": ["secs", "nsecs"],
        "fieldtypes": ["int32", "int32"],
        "fieldarraylen": [-1, -1],
        "examples": ["0", "0"],
        "constnames": [],
        "constvalues": [],
    }


Values: TypeAlias = dict[str, Any]
Answer: TypeAlias = "Values | Coroutine[Any, Any, Values | None]"
NAMESPACE: Final = "/rosapi/"
_NANO: Final = 1_000_000_000
_ACTION_TOPICS: Final = ("cancel", "feedback", "goal", "result", "status")
_SERVER_TOPICS: Final = ("feedback", "result", "status")
"""Those that an action's server publishes."""
_STATUS_TYPE: Final = "actionlib_msgs/GoalStatusArray"


class Rosapi:
    """Answers the services of rosapi.

    Args:
        client: Asks.
    """

    def __init__(self, client: HubClient) -> None:
        self._client = client
        self._types = client.hub.types
        self._services: Mapping[str, tuple[str, Callable[[Any], Answer]]] = {
            "topics": ("Topics", self._topics),
            "topics_for_type": ("TopicsForType", self._topics_for_type),
            "topics_and_raw_types": ("TopicsAndRawTypes", self._topics_and_raw_types),
            "topic_type": ("TopicType", self._topic_type),
            "publishers": ("Publishers", self._publishers),
            "subscribers": ("Subscribers", self._subscribers),
            "services": ("Services", lambda _: {"services": list(self._graph.services)}),
            "services_for_type": ("ServicesForType", self._services_for_type),
            "service_type": ("ServiceType", self._service_type),
            "service_node": ("ServiceNode", self._service_node),
            "service_host": ("ServiceHost", self._service_host),
            "service_providers": ("ServiceProviders", self._service_providers),
            "service_request_details": ("ServiceRequestDetails", self._service_request_details),
            "service_response_details": ("ServiceResponseDetails", self._service_response_details),
            "message_details": ("MessageDetails", self._message_details),
            "nodes": ("Nodes", lambda _: {"nodes": list(self._graph.nodes)}),
            "node_details": ("NodeDetails", self._node_details),
            "action_servers": ("GetActionServers", self._action_servers),
            "get_param": ("GetParam", self._get_param),
            "set_param": ("SetParam", self._set_param),
            "has_param": ("HasParam", self._has_param),
            "search_param": ("SearchParam", self._search_param),
            "delete_param": ("DeleteParam", self._delete_param),
            "get_param_names": ("GetParamNames", self._get_param_names),
            "get_time": ("GetTime", self._get_time),
        }

    @property
    def services(self) -> dict[str, str]:
        """The type of each service by its global name."""
        return {f"{NAMESPACE}{name}": f"rosapi/{kind}" for name, (kind, _) in self._services.items()}

    def offers(self, service: str) -> bool:
        """Whether a global name is that of a service of rosapi."""
        return service.startswith(NAMESPACE) and service.removeprefix(NAMESPACE) in self._services

    def call(self, service: str, arguments: Any) -> Answer:
        """Answer a call.

        Args:
            service: A global name that `offers` knows.
            arguments: An object of the request's fields, a list of them, or None.

        Returns:
            The response's fields; or what takes time and returns them, or None where there are none.

        Raises:
            RmpaError: The arguments do not fit, or ask for something that is not there.
        """
        kind, answer = self._services[service.removeprefix(NAMESPACE)]
        codec = codec_for(ServiceType(f"rosapi/{kind}").request)
        # Once to bytes and back: each field is there, and of its type.
        request = codec.json_values(memoryview(codec.write_arguments(arguments, 0).payload))
        return answer(request)

    @property
    def _graph(self) -> GraphWatch:
        return self._client.hub.graph

    # --- topics ---------------------------------------------------------------------------------------------------

    def _topics(self, _: Any) -> Values:
        topics = self._graph.topics
        return {"topics": list(topics), "types": [_first_type(each) for each in topics.values()]}

    def _topics_and_raw_types(self, _: Any) -> Values:
        values = self._topics(_)
        texts = {name: self._full_text(name) for name in set(values["types"])}
        return values | {"typedefs_full_text": [texts[name] for name in values["types"]]}

    def _full_text(self, name: str) -> str:
        try:
            return self._types.message(name).definition if name else ""
        except RmpaError:
            return ""  # as rosapi does: the client then knows the name only

    def _topics_for_type(self, request: Any) -> Values:
        kind = type_name(request["type"])
        return {"topics": [each.name for each in self._graph.topics.values() if kind in each.types]}

    def _topic_type(self, request: Any) -> Values:
        topic = self._topic(request)
        return {"type": _first_type(topic) if topic else ""}

    def _publishers(self, request: Any) -> Values:
        topic = self._topic(request)
        return {"publishers": list(topic.publishers) if topic else []}

    def _subscribers(self, request: Any) -> Values:
        topic = self._topic(request)
        return {"subscribers": list(topic.subscribers) if topic else []}

    def _topic(self, request: Any) -> GraphTopic | None:
        return self._graph.topics.get(graph_name(request["topic"]))

    def _action_servers(self, _: Any) -> Values:
        """As rosapi, the names of which all topics of an action are there; and those that publish a server's topics.

        Of a peer's server the topics that it subscribes to are not in this module's graph until a client publishes.
        """
        topics = self._graph.topics

        def serves(name: str) -> bool:
            status = topics.get(f"{name}/status")
            published = all((there := topics.get(f"{name}/{part}")) and there.publishers for part in _SERVER_TOPICS)
            return published and status is not None and _STATUS_TYPE in status.types

        names = (name.rpartition("/")[0] for name in topics if name.endswith(("/goal", "/status")))
        found = dict.fromkeys(name for name in names if name)
        return {
            "action_servers": [
                each for each in found if all(f"{each}/{part}" in topics for part in _ACTION_TOPICS) or serves(each)
            ]
        }

    # --- services -------------------------------------------------------------------------------------------------

    def _services_for_type(self, request: Any) -> Answer:
        kind = type_name(request["type"])

        def answer() -> Values:
            return {"services": [each.name for each in self._graph.services.values() if each.type == kind]}

        return self._with_types(answer)

    def _with_types(self, answer: Callable[[], Values]) -> Answer:
        async def find() -> Values:
            await self._graph.find_all()
            return answer()

        return answer() if all(each.type for each in self._graph.services.values()) else find()

    def _service(self, request: Any) -> GraphService | None:
        return self._graph.services.get(graph_name(request["service"]))

    def _service_type(self, request: Any) -> Answer:
        name = graph_name(request["service"])
        if self.offers(name):
            return {"type": self.services[name]}
        service = self._graph.services.get(name)

        async def find() -> Values:
            try:
                return {"type": await self._graph.find(name)}
            except RmpaError:
                return {"type": ""}

        return find() if service is not None and not service.type else {"type": service.type if service else ""}

    def _service_node(self, request: Any) -> Values:
        service = self._service(request)
        return {"node": service.providers[0] if service and service.providers else ""}

    def _service_host(self, request: Any) -> Values:
        service = self._service(request)
        try:
            return {"host": (urlsplit(service.uri).hostname or "") if service else ""}
        except ValueError:
            return {"host": ""}

    def _service_providers(self, request: Any) -> Answer:
        # rosapi's own answer compares types, though its field is named service: both are understood.
        asked = request["service"]

        def answer() -> Values:
            found = [
                each for each in self._graph.services.values() if each.type == asked or each.name == graph_name(asked)
            ]
            return {"providers": [node for each in found for node in each.providers]}

        return answer() if graph_name(asked) in self._graph.services else self._with_types(answer)

    # --- types ----------------------------------------------------------------------------------------------------

    def _message_details(self, request: Any) -> Values:
        return {"typedefs": typedefs_of(self._types.message(type_name(request["type"])))}

    def _service_request_details(self, request: Any) -> Values:
        return {"typedefs": typedefs_of(self._types.service(type_name(request["type"])).request)}

    def _service_response_details(self, request: Any) -> Values:
        return {"typedefs": typedefs_of(self._types.service(type_name(request["type"])).response)}

    # --- nodes and time -------------------------------------------------------------------------------------------

    def _node_details(self, request: Any) -> Values:
        node = graph_name(request["node"])
        topics = self._graph.topics.values()
        return {
            "subscribing": [each.name for each in topics if node in each.subscribers],
            "publishing": [each.name for each in topics if node in each.publishers],
            "services": [each.name for each in self._graph.services.values() if node in each.providers],
        }

    def _get_time(self, _: Any) -> Values:
        secs, nsecs = divmod(max(0, self._client.hub.time.now_ns()), _NANO)
        return {"time": {"secs": secs, "nsecs": nsecs}}

    # --- parameters -----------------------------------------------------------------------------------------------

    def _parameter(self, name: str) -> tuple[bool, ParamValue]:
        """Whether a global name is there, and its value."""
        value: ParamValue = dict(self._client.param_tree)
        for part in filter(None, name.split("/")):
            if not isinstance(value, Mapping) or part not in value:
                return False, None
            value = value[part]
        return True, value

    def _get_param(self, request: Any) -> Values:
        there, value = self._parameter(graph_name(request["name"]))
        default = request["default"]
        if not there and default:
            try:
                value = json.loads(default)
            except (ValueError, RecursionError):
                value = default
        return {"value": json.dumps(value, default=_binary)}

    def _set_param(self, request: Any) -> Answer:
        try:
            value = json.loads(request["value"])
        except RecursionError:
            raise OpError("the value of set_param is nested too deep") from None
        except ValueError as error:
            problem = f"the value of set_param is JSON, in a string: {error}"
            raise OpError(problem, 'a text is written with its quotes, "\\"text\\""') from None
        _check_depth(value)
        return self._client.set_param(graph_name(request["name"]), value)

    def _has_param(self, request: Any) -> Values:
        return {"exists": self._parameter(graph_name(request["name"]))[0]}

    def _search_param(self, request: Any) -> Values:
        # As rospy.search_param of the node /rosapi: first below its name, then upwards.
        name = request["name"]
        if name.startswith("/"):
            there = self._parameter(graph_name(name))[0]
            return {"global_name": graph_name(name) if there else ""}
        first = graph_name(name).split("/")[1]
        for namespace in (NAMESPACE, "/"):
            if self._parameter(f"{namespace}{first}")[0]:
                return {"global_name": graph_name(f"{namespace}{name}")}
        return {"global_name": ""}

    def _delete_param(self, request: Any) -> Answer:
        name = graph_name(request["name"])
        return self._client.delete_param(name) if self._parameter(name)[0] else {}

    def _get_param_names(self, _: Any) -> Values:
        names: list[str] = []
        todo: list[tuple[str, ParamValue]] = [("", dict(self._client.param_tree))]
        while todo:
            name, value = todo.pop()
            if isinstance(value, Mapping) and (value or not name):
                todo += [(f"{name}/{key}", inner) for key, inner in value.items()]
            else:
                names.append(name)
        return {"names": sorted(names)}


def _first_type(topic: GraphTopic) -> str:
    return topic.types[0] if topic.types else ""


def _binary(value: object) -> object:
    """Values of parameters that JSON has not: bytes are base64 there."""
    import base64  # noqa: PLC0415 - a rare value

    return base64.b64encode(value).decode() if isinstance(value, bytes) else str(value)


def _check_depth(value: object) -> None:
    """Refuse a parameter that is nested too deep.

    Raises:
        OpError: It is.
    """
    todo = [(value, 1)]
    while todo:
        inner, depth = todo.pop()
        if not isinstance(inner, dict | list):
            continue
        if depth > limits.PARAMETER_DEPTH_MAX:
            raise OpError(f"the value of set_param is nested deeper than {limits.PARAMETER_DEPTH_MAX}")
        todo += [(each, depth + 1) for each in (inner.values() if isinstance(inner, dict) else inner)]
