"""The services of rosapi, computed from a snapshot of the graph in memory: no question goes to a master.

Names, requests and responses are those of rosbridge_suite's package rosapi (branch ros1). They are answered here,
and not offered as ROS services.
"""

from __future__ import annotations

import base64
import contextlib
import functools
import json
from collections.abc import Callable, Coroutine, Iterable, Mapping
from typing import TYPE_CHECKING, Any, Final, TypeAlias
from urllib.parse import urlsplit

from rmpa.core.errors import PeerRefused, RmpaError
from rmpa.ros.types.codec import codec_for
from rmpa.ros.types.definitions import Field, Specification, parse_definition
from rmpa.ros.types.installed import ServiceType
from rmpa.ros.types.values import SIZES
from rmpa.web.hub.graph import GraphService, GraphTopic, GraphWatch
from rmpa.web.hub.params import MISSING, ros_time
from rmpa.web.rosbridge import limits
from rmpa.web.rosbridge.protocol import OpError, graph_name, type_name
from rmpa.web.rosbridge.tf import SERVICE, SERVICE_TYPE

if TYPE_CHECKING:
    from rmpa.ros.types.messages import MessageType
    from rmpa.web.hub.hub import HubClient
    from rmpa.web.hub.node_link import ParamValue

Values: TypeAlias = dict[str, Any]
# The response's fields; or what takes time and returns them, or None where there are none.
Answer: TypeAlias = "Values | Coroutine[Any, Any, Values | None]"
NAMESPACE: Final = "/rosapi/"
_TIMES: Final = ("time", "duration")
_EXAMPLES: Final = {"string": "", "bool": "False", "float32": "0.0", "float64": "0.0", "time": "{}", "duration": "{}"}
_ACTION_TOPICS: Final = ("cancel", "feedback", "goal", "result", "status")
# Those that an action's server publishes.
_SERVER_TOPICS: Final = ("feedback", "result", "status")
_STATUS_TYPE: Final = "actionlib_msgs/GoalStatusArray"


@functools.lru_cache(maxsize=64)
def _typedefs(name: str, definition: str) -> list[Values]:
    """Rosapi's TypeDef of a type, for clients that make forms of it, then of all that it embeds, each once."""
    known = parse_definition(name, definition)
    order: dict[str, None] = {}

    def visit(name: str) -> None:
        order[name] = None
        for field in known[name].fields if name in known else ():
            # The depth is bounded by the definition's parser.
            if field.type not in order and (field.type in _TIMES or not field.primitive):
                visit(field.type)

    visit(name)
    return [_typedef(each, known.get(each)) for each in order]


def _typedef(name: str, specification: Specification | None) -> Values:
    if specification is None:  # time or duration
        fields = [("secs", "int32", -1, "0"), ("nsecs", "int32", -1, "0")]
        constants: list[list[str]] = []
    else:
        fields = [
            (each.name, each.type, (each.size or 0) if each.array else -1, _example(each))
            for each in specification.fields
        ]
        # As ``type name=value``.
        constants = sorted(each.partition(" ")[2].split("=", 1) for each in specification.constants)
    values: Values = {"type": name}
    for at, key in enumerate(("fieldnames", "fieldtypes", "fieldarraylen", "examples")):
        values[key] = [each[at] for each in fields]
    return values | {"constnames": [each[0] for each in constants], "constvalues": [each[1] for each in constants]}


def _example(field: Field) -> str:
    if field.array:
        return "[]"
    return _EXAMPLES.get(field.type, "0") if field.primitive else "{}"


class Rosapi:
    """Answers the services of rosapi. Each is a method ``_answer_…``, whose keywords are the request's fields.

    Args:
        client: Asks.
    """

    def __init__(self, client: HubClient) -> None:
        self._client = client

    @property
    def _graph(self) -> GraphWatch:
        return self._client.hub.graph

    @staticmethod
    def offers(service: str) -> bool:
        """Whether a global name is that of a service of rosapi."""
        return service in SERVICES

    def call(self, service: str, arguments: Any) -> Answer:
        """Answer a call.

        Args:
            service: A global name that `offers` knows.
            arguments: An object of the request's fields, a list of them, or None.

        Raises:
            RmpaError: The arguments do not fit, or ask for something that is not there.
        """
        codec = codec_for(ServiceType(SERVICES[service]).request)
        # Once to bytes and back: each field is there, and of its type.
        request = codec.json_values(memoryview(codec.write_arguments(arguments, 0).payload))
        answer: Answer = getattr(self, f"_answer_{service.removeprefix(NAMESPACE)}")(**request)
        return answer

    def _answer_topics(self) -> Values:
        topics = self._graph.topics
        return {"topics": list(topics), "types": [_first_type(each) for each in topics.values()]}

    def _answer_topics_and_raw_types(self) -> Values:
        values = self._answer_topics()
        texts = {name: self._full_text(name) for name in set(values["types"])}
        return values | {"typedefs_full_text": [texts[name] for name in values["types"]]}

    def _full_text(self, name: str) -> str:
        try:
            return self._client.hub.types.message(name).definition if name else ""
        except RmpaError:
            return ""  # as rosapi does: the client then knows the name only

    def _answer_topics_for_type(self, type: str) -> Values:  # noqa: A002 - the field's name
        kind = type_name(type)
        return {"topics": [each.name for each in self._graph.topics.values() if kind in each.types]}

    def _answer_topic_type(self, topic: str) -> Values:
        return {"type": _first_type(self._topic(topic))}

    def _answer_publishers(self, topic: str) -> Values:
        return {"publishers": list(self._topic(topic).publishers)}

    def _answer_subscribers(self, topic: str) -> Values:
        return {"subscribers": list(self._topic(topic).subscribers)}

    def _topic(self, name: str) -> GraphTopic:
        return self._graph.topics.get(graph_name(name)) or GraphTopic(name, ())

    def _answer_action_servers(self) -> Values:
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

    def _answer_services(self) -> Values:
        return {"services": list(self._graph.services)}

    def _answer_services_for_type(self, type: str) -> Answer:  # noqa: A002 - the field's name
        kind = type_name(type)
        return self._with_types(lambda: {"services": [name for name, each in self._services() if each.type == kind]})

    def _services(self) -> Iterable[tuple[str, GraphService]]:
        return self._graph.services.items()

    def _with_types(self, answer: Callable[[], Values]) -> Answer:
        async def find() -> Values:
            await self._graph.find_all()
            return answer()

        return answer() if all(each.type for _, each in self._services()) else find()

    def _service(self, name: str) -> GraphService:
        return self._graph.services.get(graph_name(name)) or GraphService(name, "")

    def _answer_service_type(self, service: str) -> Answer:
        name = graph_name(service)

        async def find() -> Values:
            with contextlib.suppress(RmpaError):
                return {"type": await self._graph.find(name)}
            return {"type": ""}

        known = SERVICES.get(name) or self._service(name).type or (SERVICE_TYPE if name == SERVICE else "")
        return find() if not known and name in self._graph.services else {"type": known}

    def _answer_service_node(self, service: str) -> Values:
        return {"node": next(iter(self._service(service).providers), "")}

    def _answer_service_host(self, service: str) -> Values:
        try:
            return {"host": urlsplit(self._service(service).uri).hostname or ""}
        except ValueError:
            return {"host": ""}

    def _answer_service_providers(self, service: str) -> Answer:
        # rosapi's own answer compares types, though its field is named service: both are understood.
        name = graph_name(service)

        def answer() -> Values:
            found = [each for each_name, each in self._services() if each.type == service or each_name == name]
            return {"providers": [node for each in found for node in each.providers]}

        return answer() if name in self._graph.services else self._with_types(answer)

    def _answer_message_details(self, type: str) -> Values:  # noqa: A002 - the field's name
        if type in SIZES or type == "string":
            return {"typedefs": []}
        return _details(self._client.hub.types.message(type_name(type)))

    def _answer_service_request_details(self, type: str) -> Values:  # noqa: A002 - the field's name
        return _details(self._client.hub.types.service(type_name(type)).request)

    def _answer_service_response_details(self, type: str) -> Values:  # noqa: A002 - the field's name
        return _details(self._client.hub.types.service(type_name(type)).response)

    def _answer_nodes(self) -> Values:
        return {"nodes": list(self._graph.nodes)}

    def _answer_node_details(self, node: str) -> Values:
        name = graph_name(node)
        topics = self._graph.topics.values()
        return {
            "subscribing": [each.name for each in topics if name in each.subscribers],
            "publishing": [each.name for each in topics if name in each.publishers],
            "services": [each for each, service in self._services() if name in service.providers],
        }

    def _answer_get_time(self) -> Values:
        return {"time": ros_time(self._client.hub.time.now_ns())}

    def _is_parameter(self, name: str) -> bool:
        return self._client.read_param(name) is not MISSING

    def _answer_get_param(self, name: str, default: str) -> Values:
        value = self._client.read_param(graph_name(name))
        there, value = value is not MISSING, None if value is MISSING else value
        if not there and default:
            try:
                value = json.loads(default)
            except (ValueError, RecursionError):
                value = default
        return {"value": json.dumps(value, default=_binary)}

    def _answer_set_param(self, name: str, value: str) -> Answer:
        try:
            read = json.loads(value)
        except RecursionError:
            raise OpError("the value of set_param is nested too deep") from None
        except ValueError as error:
            problem = f"the value of set_param is JSON, in a string: {error}"
            raise OpError(problem, 'a text is written with its quotes, "\\"text\\""') from None
        _check_depth(read, 1)
        return self._client.set_param(graph_name(name), read)

    def _answer_has_param(self, name: str) -> Values:
        return {"exists": self._is_parameter(graph_name(name))}

    def _answer_search_param(self, name: str) -> Values:
        # As rospy.search_param of the node /rosapi: first below its name, then upwards.
        if name.startswith("/"):
            return {"global_name": graph_name(name) if self._is_parameter(graph_name(name)) else ""}
        first = graph_name(name).split("/")[1]
        with contextlib.suppress(PeerRefused):  # below its name, where rules seldom let anything be read
            if self._is_parameter(f"{NAMESPACE}{first}"):
                return {"global_name": graph_name(f"{NAMESPACE}{name}")}
        return {"global_name": graph_name(f"/{name}") if self._is_parameter(f"/{first}") else ""}

    def _answer_delete_param(self, name: str) -> Answer:
        self._client.check_command("delete parameters")
        return self._client.delete_param(graph_name(name)) if self._is_parameter(graph_name(name)) else {}

    def _answer_get_param_names(self) -> Values:
        names: list[str] = []
        todo: list[tuple[str, ParamValue]] = [("", dict(self._client.param_tree))]
        while todo:
            name, value = todo.pop()
            if isinstance(value, Mapping) and (value or not name):
                todo += [(f"{name}/{key}", inner) for key, inner in value.items()]
            else:
                names.append(name)
        return {"names": sorted(names)}


_TYPE_NAMES: Final = {"action_servers": "GetActionServers"}
# The type of each service by its global name.
SERVICES: Final = {
    f"{NAMESPACE}{name}": f"rosapi/{_TYPE_NAMES.get(name) or ''.join(map(str.capitalize, name.split('_')))}"
    for name in (each.removeprefix("_answer_") for each in vars(Rosapi) if each.startswith("_answer_"))
}


def _details(kind: MessageType) -> Values:
    return {"typedefs": _typedefs(kind.name, kind.definition)}


def _first_type(topic: GraphTopic) -> str:
    return topic.types[0] if topic.types else ""


def _binary(value: object) -> object:
    """Values of parameters that JSON has not: bytes are base64 there."""
    return base64.b64encode(value).decode() if isinstance(value, bytes) else str(value)


def _check_depth(value: object, depth: int) -> None:
    """Refuse a parameter that is nested too deep."""
    if isinstance(value, dict | list):
        if depth > limits.PARAMETER_DEPTH_MAX:
            raise OpError(f"the value of set_param is nested deeper than {limits.PARAMETER_DEPTH_MAX}")
        for each in value.values() if isinstance(value, dict) else value:
            _check_depth(each, depth + 1)
