"""A copy of the graph of a master that is another program; it marks the agent's own registrations.

It has two sources: the agent's own registrations, which count at once, and surveys, which show those of others. A
survey also shows own registrations that the master lacks (it was restarted), and leftovers that have to be
unregistered (an agent was killed, or a call was lost).
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Final, TypeAlias

from rmpa.core.errors import RemoteProtocolError
from rmpa.ros.master.parameters import GraphChange, RegistrationKind
from rmpa.ros.master.registrations import ANY_TYPE, Registrations
from rmpa.ros.wire.xmlrpc import RosReply, XmlRpcValue, brief

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence

    from rmpa.core.counters import Yielder


# A survey of a master that is another program: one ``system.multicall``, and its answer.
#
# A ROS master does not notify of changes in its graph, so it is polled. ``getSystemState`` returns only names. The
# URI
# of each node and service is looked up in the same call, because only the URI shows that a node was restarted.


_KINDS: Final = (RegistrationKind.PUBLISHER, RegistrationKind.SUBSCRIBER, RegistrationKind.SERVICE)
"""The kinds of the three lists of ``getSystemState``, in order."""
_HEAD: Final = ("getSystemState", "getTopicTypes", "getPid")

Holders = dict[str, tuple[str, ...]]
"""The nodes by topic or service."""


@dataclass(frozen=True, slots=True)
class Survey:
    """A master's graph at one moment.

    Args:
        holders: By kind, then by topic or service: the nodes, in the master's order.
        types: By topic.
        run: Identifies the run of the master: its process and its ``/run_id``.
        uris: Slave APIs of the nodes that were looked up and exist.
        services: ``rosrpc://`` URIs of the services that were looked up and exist.
    """

    holders: dict[RegistrationKind, Holders]
    types: dict[str, str]
    run: str
    uris: dict[str, str] = field(default_factory=dict)
    services: dict[str, str] = field(default_factory=dict)

    def nodes(self) -> dict[str, None]:
        """All nodes."""
        return dict.fromkeys(node for table in self.holders.values() for nodes in table.values() for node in nodes)

    def holders_of_services(self) -> Holders:
        """All services with their nodes."""
        return self.holders[RegistrationKind.SERVICE]

    def with_more(self, uris: Mapping[str, str], services: Mapping[str, str]) -> Survey:
        """Return a copy of the survey with further look-up results: URIs of nodes and of services."""
        return Survey(self.holders, self.types, self.run, {**self.uris, **uris}, {**self.services, **services})


def one_call(method: str, params: Sequence[XmlRpcValue]) -> XmlRpcValue:
    """One call within a ``system.multicall``."""
    return {"methodName": method, "params": list(params)}


def survey_calls(caller_id: str, nodes: Iterable[str], services: Iterable[str]) -> list[XmlRpcValue]:
    """The calls of a survey, with look-ups of the given nodes and services; ``read_survey`` reads the answers."""
    calls = [one_call(method, [caller_id]) for method in _HEAD]
    # After the state, so that the look-ups are not older.
    return [*calls, one_call("getParam", [caller_id, "/run_id"]), *lookup_calls(caller_id, nodes, services)]


def lookup_calls(caller_id: str, nodes: Iterable[str], services: Iterable[str]) -> list[XmlRpcValue]:
    """The calls that look up the URIs of nodes and services; ``read_lookups`` reads the answers."""
    calls = [one_call("lookupNode", [caller_id, node]) for node in nodes]
    return calls + [one_call("lookupService", [caller_id, service]) for service in services]


def read_survey(
    answer: XmlRpcValue, nodes: Sequence[str], services: Sequence[str], *, yielder: Yielder = iter
) -> Survey:
    """Read the answer to ``survey_calls`` with the same nodes and services.

    Raises:
        RemoteProtocolError: The answer is malformed.
    """
    if not isinstance(answer, list) or len(answer) < len(_HEAD) + 1:
        raise RemoteProtocolError(f"the master's answer to system.multicall is no list of answers: {brief(answer)}")
    state, types, pid, run_id = (_value(one) for one in answer[: len(_HEAD) + 1])
    if not isinstance(state, list) or len(state) != len(_KINDS):
        raise RemoteProtocolError(f"the master's system state is not three lists: {brief(state)}")
    survey = Survey(
        {kind: _holders(table, yielder) for kind, table in zip(_KINDS, state, strict=True)},
        dict(yielder(_pairs(types))),
        f"{pid} {run_id}",
    )
    return survey.with_more(*read_lookups(answer[len(_HEAD) + 1 :], nodes, services, yielder=yielder))


def read_lookups(
    answer: XmlRpcValue, nodes: Sequence[str], services: Sequence[str], *, yielder: Yielder = iter
) -> tuple[dict[str, str], dict[str, str]]:
    """Read the answer to ``lookup_calls`` with the same nodes and services.

    Returns:
        The URIs of the nodes and of the services that exist.

    Raises:
        RemoteProtocolError: The answer is malformed.
    """
    if not isinstance(answer, list) or len(answer) != len(nodes) + len(services):
        raise RemoteProtocolError(f"the master's answer to system.multicall is no list of answers: {brief(answer)}")
    found = [_value(one) for one in yielder(answer)]
    places = [value if isinstance(value, str) else "" for value in found]
    uris = {node: uri for node, uri in zip(nodes, places, strict=False) if uri}
    return uris, {name: uri for name, uri in zip(services, places[len(nodes) :], strict=True) if uri}


def _value(answer: XmlRpcValue) -> XmlRpcValue:
    """The value of one answer of a ``system.multicall``; ``None`` where the method failed."""
    match answer:
        case [[1, _, value]]:
            return value
    return None


def _holders(table: XmlRpcValue, yielder: Yielder) -> Holders:
    found: Holders = {}
    for entry in yielder(table) if isinstance(table, list) else ():
        match entry:
            case [str(key), list(nodes)]:
                found[key] = tuple(node for node in nodes if isinstance(node, str))
            case _:
                raise RemoteProtocolError(f"the master's system state has {brief(entry)} in it")
    return found


def _pairs(types: XmlRpcValue) -> Iterable[tuple[str, str]]:
    for entry in types if isinstance(types, list) else ():
        match entry:
            case [str(topic), str(type_name)]:
                yield topic, type_name


Call: TypeAlias = tuple[str, tuple[XmlRpcValue, ...]]
"""A method of the Master API and its parameters."""
Entry: TypeAlias = tuple[RegistrationKind, str, str]
"""One registration: its kind, the topic, service or parameter, and the node."""

REGISTRATIONS: Final = {
    "registerPublisher": (RegistrationKind.PUBLISHER, 4),
    "registerSubscriber": (RegistrationKind.SUBSCRIBER, 4),
    "registerService": (RegistrationKind.SERVICE, 4),
    "subscribeParam": (RegistrationKind.PARAM, 3),
    "unregisterPublisher": (RegistrationKind.PUBLISHER, 3),
    "unregisterSubscriber": (RegistrationKind.SUBSCRIBER, 3),
    "unregisterService": (RegistrationKind.SERVICE, 3),
    "unsubscribeParam": (RegistrationKind.PARAM, 3),
}
"""The methods that ``Mirror.apply`` accepts: what they register, and the number of their parameters."""


@dataclass(frozen=True, slots=True)
class _Own:
    """One registration of the agent: the call, the node's slave API, and the call that unregisters it."""

    call: Call
    api: str
    undo: Call


class Mirror:
    """The copy of the graph of one master.

    Args:
        yielder: Iterates, and serves pending data in between, in surveys of thousands of topics.
    """

    def __init__(self, *, yielder: Yielder = iter) -> None:
        self._yielder = yielder
        self.registrations = Registrations()
        self._own: dict[Entry, _Own] = {}
        # Registrations changed by ``apply`` since the last survey began, with the number of that call: the survey may
        # not show the change yet.
        self._touched: dict[Entry, int] = {}
        self._asked = 0
        # Nodes whose registrations the master has although nothing listens at their address any more.
        self._dead: dict[str, str] = {}
        # Nodes that the previous run of the master knew and the present one lacks: they may live, and their
        # connections go on.
        self._orphans: dict[str, str] = {}
        self._run = ""

    # --- questions --------------------------------------------------------------------------------------------

    @property
    def asked(self) -> int:
        """Count of calls of ``apply``: a survey that begins now shows the effect of these."""
        return self._asked

    @property
    def dead(self) -> Mapping[str, str]:
        """Nodes that were found dead, and their slave APIs."""
        return self._dead

    def is_ours(self, node: str) -> bool:
        """Whether the agent registered something for this node."""
        return any(entry[2] == node for entry in self._own)

    def others(self) -> dict[str, str]:
        """The nodes that are not the agent's, with their slave APIs."""
        ours = {node for _, _, node in self._own}
        return {node: api for node, api in self.registrations.nodes().items() if node not in ours}

    def unregister_calls(self) -> list[Call]:
        """The calls that unregister all that the agent registered, the latest registration first."""
        return [own.undo for own in reversed(self._own.values())]

    def take_changes(self) -> list[GraphChange]:
        """Return the changes since the previous call of this method."""
        self.registrations.effects.clear()  # the master notifies the nodes
        changes, self.registrations.changes = self.registrations.changes, []
        return changes

    # --- the agent's own registrations ------------------------------------------------------------------------

    def apply(self, method: str, params: Sequence[XmlRpcValue]) -> RosReply:
        """Apply a call of the agent, one of ``REGISTRATIONS``, to the copy; the caller sends it to the master.

        Returns:
            The answer that the copy gives in place of the master.
        """
        self._asked += 1
        words = [param for param in params if isinstance(param, str)]
        kind, arity = REGISTRATIONS[method]
        if not len(words) == len(params) == arity:
            return RosReply(-1, f"{method} does not take {brief(params)}", 0)
        return self._unregister(kind, words) if method.startswith("un") else self._register(kind, method, words)

    def _register(self, kind: RegistrationKind, method: str, words: list[str]) -> RosReply:
        value: XmlRpcValue = 1
        match kind, words:
            case RegistrationKind.PUBLISHER, [node, key, type_name, api]:
                self.registrations.register_publisher(key, type_name, node, api)
                undo: Call = "unregisterPublisher", (node, key, api)
                value = self.registrations.apis(RegistrationKind.SUBSCRIBER, key)
            case RegistrationKind.SUBSCRIBER, [node, key, type_name, api]:
                self.registrations.register_subscriber(key, type_name, node, api)
                undo = "unregisterSubscriber", (node, key, api)
                value = self.registrations.apis(RegistrationKind.PUBLISHER, key)
            case RegistrationKind.SERVICE, [node, key, uri, api]:
                self.registrations.register_service(key, uri, node, api)
                undo = "unregisterService", (node, key, uri)
            case _, [node, api, key]:
                undo = "unsubscribeParam", (node, api, key)
            case _:
                raise AssertionError(words)
        self._touched[kind, key, node] = self._asked
        self._own[kind, key, node] = _Own((method, tuple(words)), api, undo)
        return RosReply(1, "will be registered", value)

    def _unregister(self, kind: RegistrationKind, words: list[str]) -> RosReply:
        node, key = (words[0], words[2]) if kind is RegistrationKind.PARAM else (words[0], words[1])
        self._touched[kind, key, node] = self._asked
        own = self._own.get((kind, key, node))
        if own is None or own.undo[1] != tuple(words):
            return RosReply(1, f"{node} is not registered for {key}", 0)
        self._forget(kind, key, node)
        return RosReply(1, "will be unregistered", 1)

    def forget(self, call: Call) -> None:
        """Drop a registration of the agent's that the master refused."""
        for entry, own in list(self._own.items()):
            if own.call == call:
                self._forget(*entry)

    def _forget(self, kind: RegistrationKind, key: str, node: str) -> None:
        own = self._own.pop((kind, key, node))
        if kind is RegistrationKind.SERVICE:
            self.registrations.unregister_service(key, str(own.undo[1][2]), node)
        elif kind is not RegistrationKind.PARAM:
            self.registrations.unregister(kind, key, node, own.api)

    # --- the others -------------------------------------------------------------------------------------------

    def mark_dead(self, node: str, api: str) -> None:
        """Remove a dead node from the copy, and ignore the registrations that the master still has of it."""
        self._dead[node] = api
        self._orphans.pop(node, None)
        self.registrations.purge(node, api)

    def mark_alive(self, node: str) -> None:
        """Undo ``mark_dead``: the next survey shows the node again."""
        self._dead.pop(node, None)

    def taken(self, survey: Survey, node: str, seen: int) -> str:
        """The slave API that a node of the agent has at the master, if another agent has registered it there.

        Args:
            survey: The survey.
            node: The node.
            seen: ``asked`` when the survey began.
        """
        ours = {
            own.api for entry, own in self._own.items() if entry[2] == node and self._touched.get(entry, 0) <= seen
        }
        there = survey.uris.get(node, "")
        return there if ours and there not in ours else ""

    def update(self, survey: Survey, seen: int) -> list[Call]:
        """Apply a survey to the copy.

        Args:
            survey: The survey, in which every node and service that still exists was looked up.
            seen: ``asked`` when the survey began.

        Returns:
            Calls that register what the master lacks of the agent's registrations, and unregister those of the
            agent's nodes that the agent does not have.
        """
        if self._run and survey.run != self._run:
            # Nodes do not register at a restarted master until they restart themselves, but their connections go on.
            # They stay in the copy, so that the routes to and from them go on too.
            self._orphans |= self.others()
        again = [] if survey.run == self._run else self._own_params()
        self._run = survey.run
        listed = survey.nodes()
        self._orphans = {node: api for node, api in self._orphans.items() if node not in listed}
        self._dead = {node: api for node, api in self._dead.items() if survey.uris.get(node) == api}
        ours = {node for _, _, node in self._own}
        passed = {*ours, *self._dead}
        for kind, table in survey.holders.items():
            self._drop_gone(kind, table, ours, passed, survey)
        for kind, table in survey.holders.items():
            self._add_new(kind, table, passed, survey, seen)
        self._update_types(survey, passed)
        again += self._missing(survey, seen)
        again += self._surplus(survey, seen)
        self._touched = {entry: asked for entry, asked in self._touched.items() if asked > seen}
        return again

    def _own_params(self) -> list[Call]:
        """Calls that subscribe to parameters; no survey shows these, so a restarted master gets all of them again."""
        return [own.call for (kind, _, _), own in self._own.items() if kind is RegistrationKind.PARAM]

    def _drop_gone(
        self,
        kind: RegistrationKind,
        table: Mapping[str, Sequence[str]],
        ours: set[str],
        passed: set[str],
        survey: Survey,
    ) -> None:
        for key, nodes in self._yielder(self.registrations.providers(kind)):
            there = table.get(key, ())
            for node, api in nodes.items():
                # A survey showed what a node of ours had before, while it had no registration by which it was known.
                leftover = node in ours and (kind, key, node) not in self._own
                if not leftover and (node in passed or self._orphans.get(node) == api):
                    continue
                if leftover or node not in there or survey.uris.get(node) != api:
                    if kind is RegistrationKind.SERVICE:
                        uri = self.registrations.service_uri(key)
                        self.registrations.unregister_service(key, uri or "", node)
                    else:
                        self.registrations.unregister(kind, key, node, api)

    def _add_new(
        self, kind: RegistrationKind, table: Mapping[str, Sequence[str]], passed: set[str], survey: Survey, seen: int
    ) -> None:
        for key, nodes in self._yielder(table.items()):
            for node in nodes:
                api = survey.uris.get(node)
                if node in passed or api is None:
                    continue
                known = self.registrations.at(kind, key).get(node) == api
                match kind:
                    case RegistrationKind.PUBLISHER if not known:
                        self.registrations.register_publisher(key, survey.types.get(key, ANY_TYPE), node, api)
                    case RegistrationKind.SUBSCRIBER if not known:
                        self.registrations.register_subscriber(key, survey.types.get(key, ANY_TYPE), node, api)
                    case RegistrationKind.SERVICE if key in survey.services:
                        self._take_service(key, survey.services[key], node, api, seen)

    def _take_service(self, service: str, uri: str, node: str, api: str, seen: int) -> None:
        if self.registrations.service_uri(service) == uri and node in self.registrations.at(
            RegistrationKind.SERVICE, service
        ):
            return
        for ours in tuple(self.registrations.at(RegistrationKind.SERVICE, service)):
            entry = RegistrationKind.SERVICE, service, ours
            if entry in self._own:
                if self._touched.get(entry, 0) > seen:
                    return
                # The last provider of a service counts: the agent's was replaced, and is not registered again.
                self._forget(*entry)
        self.registrations.register_service(service, uri, node, api)

    def _update_types(self, survey: Survey, passed: set[str]) -> None:
        """Update the types of topics: the master has the type that was registered last."""
        types = self.registrations.types()
        for topic, type_name in self._yielder(survey.types.items()):
            if types.get(topic) == type_name or type_name == ANY_TYPE:
                continue
            for node, api in self.registrations.at(RegistrationKind.PUBLISHER, topic).items():
                if node not in passed:
                    self.registrations.register_publisher(topic, type_name, node, api)
            if topic not in types and (nodes := self.registrations.at(RegistrationKind.SUBSCRIBER, topic)):
                node, api = next(iter(nodes.items()))
                self.registrations.register_subscriber(topic, type_name, node, api)

    def _missing(self, survey: Survey, seen: int) -> list[Call]:
        again = []
        for (kind, key, node), own in self._yielder(list(self._own.items())):
            if kind is RegistrationKind.PARAM or self._touched.get((kind, key, node), 0) > seen:
                continue
            there = node in survey.holders[kind].get(key, ()) and survey.uris.get(node) == own.api
            if not there or (kind is RegistrationKind.SERVICE and survey.services.get(key) != own.undo[1][2]):
                again.append(own.call)
        return again

    def _surplus(self, survey: Survey, seen: int) -> list[Call]:
        """Calls that unregister what the master has of the agent's nodes and the agent does not have."""
        ours = {node: own.api for (_, _, node), own in self._own.items()}
        nodes = {node: api for node, api in ours.items() if survey.uris.get(node) == api}
        again: list[Call] = []
        for kind, table in survey.holders.items():
            for key, holders in self._yielder(table.items()):
                for node in holders:
                    if (
                        node not in nodes
                        or (kind, key, node) in self._own
                        or self._touched.get((kind, key, node), 0) > seen
                    ):
                        continue
                    match kind:
                        case RegistrationKind.PUBLISHER:
                            again.append(("unregisterPublisher", (node, key, nodes[node])))
                        case RegistrationKind.SUBSCRIBER:
                            again.append(("unregisterSubscriber", (node, key, nodes[node])))
                        case _:
                            again.append(("unregisterService", (node, key, survey.services.get(key, ""))))
        return again
