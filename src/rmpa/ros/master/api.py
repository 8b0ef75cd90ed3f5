"""The Master API and the Parameter Server API (wiki.ros.org/ROS/Master_API, …/Parameter_Server_API).

A drop-in for rosmaster 1.15: the same methods, codes and values, the same calls to slaves in the same order. Only the
status texts differ.
"""

from __future__ import annotations

import logging
from functools import partial
from typing import TYPE_CHECKING, Final

from rmpa.ros import limits
from rmpa.ros.master.parameters import Parameters, RegistrationKind, holds_nil, resolve, updates, with_slash
from rmpa.ros.master.registrations import ANY_TYPE, Registrations
from rmpa.ros.wire.xmlrpc import RosFault, RosReply, XmlRpcValue, brief

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from rmpa.core.timers import Yielder

_log = logging.getLogger(__name__)

SUCCESS: Final = 1
ERROR: Final = -1
_DOES: Final = {
    RegistrationKind.PUBLISHER: "publishes",
    RegistrationKind.SUBSCRIBER: "subscribes to",
    RegistrationKind.SERVICE: "provides",
}


def checked(name: str, value: XmlRpcValue, caller_id: str) -> XmlRpcValue:
    """The value to use for a parameter of the Master API.

    Refuses what rosmaster answers with code -1; stricter only in the number of a parameter's namespaces.

    Args:
        name: The parameter's name in the API, which tells its kind.
        value: The value, as the caller gave it; names are resolved, URIs and types kept as they are.
        caller_id: The caller's name.

    Raises:
        ValueError: The caller has to correct the value; the text names the parameter and the fault.
    """
    if name in ("msg", "value") or (name == "subgraph" and value == ""):
        return value
    if not isinstance(value, str) or not value:
        raise ValueError(f"{name} must be a non-empty string, not {brief(value)}")
    match name:
        case "caller_api" | "service_api":  # kept unchanged: roscpp recognises itself by the exact text
            if not value.startswith(("http://", "rosrpc://")):
                raise ValueError(f"{name} must be a URI like http://host:port/ or rosrpc://host:port")
            return value
        case "topic_type":
            if value != ANY_TYPE and value.count("/") != 1:
                raise ValueError(f"{name} must be a type like std_msgs/String or *, not {brief(value)}")
            return value
        case "name":
            return value
        case "topic" | "service" | "node":
            if ":" in value or " " in value:
                raise ValueError(f"{name} {brief(value)} is not a graph name: it has a colon or a space in it")
            if value == "/" and name != "node":
                raise ValueError(f"{name} cannot be the root namespace")
    resolved = resolve(value, caller_id)
    if name == "key" and resolved.count("/") > limits.PARAM_DEPTH_MAX:
        raise ValueError(f"{name} has more than {limits.PARAM_DEPTH_MAX} namespaces")
    return resolved


class MasterApi:
    """One master with its parameter server.

    Args:
        uri: The master's URI, for ``getUri``.
        pid: The process id, for ``getPid``.
        on_shutdown: Called with the reason when a client calls ``shutdown``.
        yielder: Iterates, and serves pending data in between, in large graphs and for large parameters.

    Attributes:
        service_lookup: Answers ``lookupService`` for each caller; see ``Core.on_lookup``.
    """

    def __init__(self, uri: str, pid: int, on_shutdown: Callable[[str], None], *, yielder: Yielder = iter) -> None:
        self._yielder = yielder
        self.uri = uri
        self._pid = pid
        self._on_shutdown = on_shutdown
        self.registrations = Registrations()
        self.parameters = Parameters()
        self.service_lookup: Callable[[str, str, str, str], str] | None = None
        self._methods = self._table()

    def call(self, method: str, arguments: Sequence[XmlRpcValue]) -> RosReply:
        """Call a method of the Master or Parameter Server API.

        Args:
            method: The method's name.
            arguments: The parameters, the caller id first.

        Returns:
            Code 1 with the value; or code 0 or -1 with the reason as text and, mostly, a value of the same type.

        Raises:
            RosFault: There is no such method.
        """
        if method not in self._methods:
            raise RosFault(1, f"this master has no method {brief(method)}; system.listMethods names them")
        function, error_value, names = self._methods[method]
        if len(arguments) != 1 + len(names.split()):
            wanted = ", ".join(["caller_id", *names.split()])
            return RosReply(ERROR, f"{method} takes ({wanted}), not {len(arguments)} parameters", error_value)
        caller_id, *rest = arguments
        if not isinstance(caller_id, str):
            return RosReply(ERROR, f"caller_id must be a string, not {brief(caller_id)}", error_value)
        try:
            values = [checked(name, value, caller_id) for name, value in zip(names.split(), rest, strict=True)]
            return function(caller_id, *values)
        except ValueError as error:
            _log.info("! %s: %s: %s", caller_id, method, error)
            return RosReply(ERROR, str(error), error_value)

    def answer(self, method: str, arguments: Sequence[XmlRpcValue]) -> XmlRpcValue:
        """Answer an XML-RPC call: one of the API's, ``system.listMethods`` or ``system.multicall``.

        Raises:
            RosFault: There is no such method, or a system method is called wrongly.
        """
        if method == "system.listMethods":
            return sorted([*self._methods, "system.listMethods", "system.multicall"])
        if method != "system.multicall":
            return self.call(method, arguments)
        match arguments:
            case [list(calls)] | [tuple(calls)]:
                return [self._one_of_many(call) for call in calls]
        raise RosFault(1, "system.multicall takes one list of {methodName, params}")

    def _one_of_many(self, call: XmlRpcValue) -> XmlRpcValue:
        match call:
            case {"methodName": "system.multicall"}:
                problem = RosFault(1, "system.multicall cannot be called within itself")
            case {"methodName": str(method), "params": list(arguments)}:
                try:
                    return [self.answer(method, arguments)]
                except RosFault as fault:
                    problem = fault
            case _:
                problem = RosFault(1, f"{brief(call)} is not a struct of methodName and params")
        return {"faultCode": problem.number, "faultString": problem.text}

    def _shutdown(self, caller_id: str, reason: XmlRpcValue) -> RosReply:
        _log.warning("< %s asks this core to end: %s [core-asked-to-end]", caller_id, brief(reason))
        self._on_shutdown(f"{caller_id}: {brief(reason)}")
        return RosReply(SUCCESS, "the core ends", 0)

    def _delete_param(self, _caller_id: str, key: str) -> RosReply:
        try:
            self.parameters.delete(key)
        except KeyError:
            return RosReply(ERROR, f"there is no parameter {key} to delete", 0)
        self.registrations.calls += updates(self._param_subscribers, key, {})
        return RosReply(SUCCESS, f"deleted {key}", 0)

    def _set_param(self, caller_id: str, key: str, value: XmlRpcValue) -> RosReply:
        if holds_nil(value, self._yielder):
            raise ValueError("value is nil or contains one, which ROS does not have")
        self.parameters.set(key, value)
        self.registrations.calls += updates(self._param_subscribers, key, value, caller_id, self._yielder)
        return RosReply(SUCCESS, f"set {key}", 0)

    @property
    def _param_subscribers(self) -> dict[str, dict[str, str]]:
        return self.registrations.table(RegistrationKind.PARAM)

    def _get_param(self, _caller_id: str, key: str) -> RosReply:
        try:
            return RosReply(SUCCESS, f"the value of {key}", self.parameters.get(key))
        except KeyError:
            return RosReply(ERROR, f"there is no parameter {key}", 0)

    def _search_param(self, caller_id: str, key: str) -> RosReply:
        try:
            found = self.parameters.search(caller_id, key)
        except ValueError as error:
            return RosReply(0, str(error), 0)
        if found is None:
            return RosReply(ERROR, f"there is no {key} in {caller_id} or above", "")
        return RosReply(SUCCESS, f"found {found}", found)

    def _subscribe_param(self, caller_id: str, api: str, key: str) -> RosReply:
        value = self.parameters.get(key) if self.parameters.has(key) else {}
        self.registrations.register(RegistrationKind.PARAM, with_slash(key), caller_id, api)
        return RosReply(SUCCESS, f"subscribed to parameter {key}", value)

    def _unsubscribe_param(self, caller_id: str, api: str, key: str) -> RosReply:
        self.registrations.unregister(RegistrationKind.PARAM, with_slash(key), caller_id, api)
        # rosmaster answers 1 whether it was subscribed or not.
        return RosReply(SUCCESS, f"not subscribed to parameter {key}", 1)

    def _register(self, kind: RegistrationKind, caller_id: str, key: str, detail: str, api: str) -> RosReply:
        self.registrations.register(kind, key, caller_id, api, detail)
        return RosReply(SUCCESS, f"{caller_id} {_DOES[kind]} {key}", self.registrations.counterparts(kind, key))

    def _unregister(self, kind: RegistrationKind, caller_id: str, key: str, detail: str) -> RosReply:
        if self.registrations.unregister(kind, key, caller_id, detail):
            return RosReply(SUCCESS, f"{caller_id} is no longer registered for {key}", 1)
        return RosReply(SUCCESS, f"{caller_id} was not registered for {key} with that URI", 0)

    def _lookup_service(self, caller_id: str, service: str) -> RosReply:
        uri = self.registrations.service_uri(service)
        if uri is None:
            return RosReply(ERROR, f"no provider of {service}", "")
        if self.service_lookup is not None:
            uri = self.service_lookup(service, uri, caller_id, self.registrations.node_api(caller_id) or "") or uri
        return RosReply(SUCCESS, f"the provider of {service}", uri)

    def _lookup_node(self, _caller_id: str, node: str) -> RosReply:
        api = self.registrations.node_api(node)
        if api is None:
            return RosReply(ERROR, f"no node {node} is registered here", "")
        return RosReply(SUCCESS, f"the API of {node}", api)

    def _get_published_topics(self, _caller_id: str, subgraph: str) -> RosReply:
        prefix = subgraph if not subgraph or subgraph.endswith("/") else f"{subgraph}/"
        types = self.registrations.types()
        published = self._yielder(list(self.registrations.table(RegistrationKind.PUBLISHER)))
        found = [[topic, types[topic]] for topic in published if topic.startswith(prefix)]
        return RosReply(SUCCESS, "the topics that somebody publishes", found)

    def _get_topic_types(self, _caller_id: str) -> RosReply:
        types = self._yielder(list(self.registrations.types().items()))
        return RosReply(SUCCESS, "the topics and their types", [list(item) for item in types])

    def _get_system_state(self, _caller_id: str) -> RosReply:
        tables: list[XmlRpcValue] = []
        for kind in _DOES:
            providers = self._yielder(list(self.registrations.table(kind).items()))
            tables.append([[key, list(nodes)] for key, nodes in providers])
        return RosReply(SUCCESS, "publishers, subscribers and services", tables)

    def _table(self) -> dict[str, tuple[Callable[..., RosReply], XmlRpcValue, str]]:
        """Each method's function, the value in the reply of an error, and its parameters after ``caller_id``."""
        publisher, subscriber, provider = _DOES
        return {
            "shutdown": (self._shutdown, 0, "msg"),
            "getUri": (lambda _: RosReply(SUCCESS, "", self.uri), "", ""),
            "getPid": (lambda _: RosReply(SUCCESS, "", self._pid), -1, ""),
            "deleteParam": (self._delete_param, 0, "key"),
            "setParam": (self._set_param, 0, "key value"),
            "getParam": (self._get_param, 0, "key"),
            "searchParam": (self._search_param, 0, "name"),
            "subscribeParam": (self._subscribe_param, 0, "caller_api key"),
            "unsubscribeParam": (self._unsubscribe_param, 0, "caller_api key"),
            # rosmaster puts the name into the status, and old clients read it.
            "hasParam": (lambda _, key: RosReply(SUCCESS, key, self.parameters.has(key)), False, "key"),
            "getParamNames": (lambda _: RosReply(SUCCESS, "", list(self._yielder(self.parameters.names()))), [], ""),
            "registerService": (partial(self._register, provider), 0, "service service_api caller_api"),
            "unregisterService": (partial(self._unregister, provider), 0, "service service_api"),
            "lookupService": (self._lookup_service, "", "service"),
            "registerSubscriber": (partial(self._register, subscriber), [], "topic topic_type caller_api"),
            "unregisterSubscriber": (partial(self._unregister, subscriber), 0, "topic caller_api"),
            "registerPublisher": (partial(self._register, publisher), [], "topic topic_type caller_api"),
            "unregisterPublisher": (partial(self._unregister, publisher), 0, "topic caller_api"),
            "lookupNode": (self._lookup_node, "", "node"),
            "getPublishedTopics": (self._get_published_topics, 0, "subgraph"),
            "getTopicTypes": (self._get_topic_types, [], ""),
            "getSystemState": (self._get_system_state, [[], [], []], ""),
        }
