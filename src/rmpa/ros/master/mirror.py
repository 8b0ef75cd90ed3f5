"""A copy of the graph of a master that is another program; it marks the agent's own registrations.

It has two sources: the agent's own registrations, which count at once, and surveys, which show those of others. A
survey also shows own registrations that the master lacks (it was restarted), and leftovers that have to be
unregistered (an agent was killed, or a call was lost).

A ROS master does not notify of changes in its graph, so it is polled: a survey is one ``system.multicall``.
``getSystemState`` returns only names. The URI of each node and service is looked up in the same call, because only
the URI shows that a node was restarted.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Final, TypeAlias, TypeVar

import msgspec

from rmpa.core.errors import RemoteProtocolError
from rmpa.ros.master.parameters import RegistrationKind
from rmpa.ros.master.registrations import ANY_TYPE, Registrations
from rmpa.ros.wire.xmlrpc import RosReply, XmlRpcValue, brief

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence

    from rmpa.core.timers import Yielder

# The kinds of the three lists of ``getSystemState``, in order.
_KINDS: Final = (RegistrationKind.PUBLISHER, RegistrationKind.SUBSCRIBER, RegistrationKind.SERVICE)
_HEAD: Final = ("getSystemState", "getTopicTypes", "getPid")
# The methods that ``Mirror.apply`` accepts, and what they register.
REGISTRATIONS: Final = {
    **{f"register{kind.value.title()}": kind for kind in _KINDS},
    **{f"unregister{kind.value.title()}": kind for kind in _KINDS},
    "subscribeParam": RegistrationKind.PARAM,
    "unsubscribeParam": RegistrationKind.PARAM,
}

_V = TypeVar("_V")
# A method of the Master API and its parameters.
Call: TypeAlias = tuple[str, tuple[XmlRpcValue, ...]]
# One registration: its kind, the topic, service or parameter, and the node.
Entry: TypeAlias = tuple[RegistrationKind, str, str]


@dataclass(slots=True)
class Survey:
    """A master's graph at one moment.

    Args:
        holders: By kind, then by topic or service: the nodes, in the master's order.
        types: By topic.
        run: Identifies the run of the master: its process and its ``/run_id``.
        uris: Slave APIs of the nodes that were looked up and exist.
        services: ``rosrpc://`` URIs of the services that were looked up and exist.
    """

    holders: dict[RegistrationKind, dict[str, tuple[str, ...]]]
    types: dict[str, str]
    run: str
    uris: dict[str, str] = field(default_factory=dict)
    services: dict[str, str] = field(default_factory=dict)

    def nodes(self) -> dict[str, None]:
        """All nodes."""
        return dict.fromkeys(node for table in self.holders.values() for nodes in table.values() for node in nodes)


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
    return Survey(
        {
            kind: _table(table, tuple[str, tuple[str, ...]], yielder)
            for kind, table in zip(_KINDS, state, strict=True)
        },
        _table(types or [], tuple[str, str], yielder),
        f"{pid} {run_id}",
        *read_lookups(answer[len(_HEAD) + 1 :], nodes, services, yielder=yielder),
    )


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


def _table(rows: Any, row_type: type[tuple[str, _V]], yielder: Yielder) -> dict[str, _V]:
    try:
        return dict(msgspec.convert(row, row_type) for row in yielder(rows))
    except (msgspec.ValidationError, TypeError) as error:
        raise RemoteProtocolError(f"the master's answer is malformed: {error}") from None


def _register(entry: Entry, api: str, detail: str) -> Call:
    """The call that makes a registration; the parameters are those of ``Registrations.register``."""
    kind, key, node = entry
    if kind is RegistrationKind.PARAM:
        return "subscribeParam", (node, api, key)
    return f"register{kind.value.title()}", (node, key, detail, api)


def _unregister(entry: Entry, api: str, detail: str) -> Call:
    """The call that ends a registration."""
    kind, key, node = entry
    if kind is RegistrationKind.PARAM:
        return "unsubscribeParam", (node, api, key)
    return f"unregister{kind.value.title()}", (node, key, detail if kind is RegistrationKind.SERVICE else api)


class Mirror:
    """The copy of the graph of one master.

    Args:
        yielder: Iterates, and serves pending data in between, in surveys of thousands of topics.

    Attributes:
        asked: Count of calls of ``apply``: a survey that begins now shows the effect of these.
        dead: Nodes of which the master has registrations although nothing listens at their slave APIs any more.
    """

    def __init__(self, *, yielder: Yielder = iter) -> None:
        self._yielder = yielder
        self.registrations = Registrations()
        self.asked = 0
        self.dead: dict[str, str] = {}
        # The agent's registrations: the slave API, and the type of a topic or the URI of a service.
        self._own: dict[Entry, tuple[str, str]] = {}
        # Registrations changed by ``apply`` since the last survey began, with the number of that call: the survey may
        # not show the change yet.
        self._touched: dict[Entry, int] = {}
        # Nodes that the previous run of the master knew and the present one lacks: they may live, and their
        # connections go on.
        self._orphans: dict[str, str] = {}
        self._run = ""

    def ours(self) -> dict[str, str]:
        """The nodes for which the agent registered something, with their slave APIs."""
        return {node: api for (_, _, node), (api, _) in self._own.items()}

    def others(self) -> dict[str, str]:
        """The nodes that are not the agent's, with their slave APIs."""
        ours = self.ours()
        return {node: api for node, api in self.registrations.nodes().items() if node not in ours}

    def unregister_calls(self) -> list[Call]:
        """The calls that unregister all that the agent registered, the latest registration first."""
        return [_unregister(entry, *own) for entry, own in reversed(self._own.items())]

    def apply(self, method: str, params: Sequence[XmlRpcValue]) -> RosReply:
        """Apply a call of the agent, one of ``REGISTRATIONS``, to the copy; the caller sends it to the master.

        Returns:
            The answer that the copy gives in place of the master.
        """
        self.asked += 1
        ends, kind = method.startswith("un"), REGISTRATIONS[method]
        match kind, params:
            case RegistrationKind.PARAM, [str(node), str(api), str(key)]:
                detail = ""
            case _, [str(node), str(key), str(detail), str(api)] if not ends:
                pass
            case _, [str(node), str(key), str(api)] if ends:
                detail = api
            case _:
                return RosReply(-1, f"{method} does not take {brief(params)}", 0)
        entry = kind, key, node
        self._touched[entry] = self.asked
        if not ends:
            self._own[entry] = api, detail
            if kind is not RegistrationKind.PARAM:
                self.registrations.register(kind, key, node, api, detail)
            return RosReply(1, "will be registered", self.registrations.counterparts(kind, key))
        if entry not in self._own or _unregister(entry, *self._own[entry]) != (method, tuple(params)):
            return RosReply(1, f"{node} is not registered for {key}", 0)
        self._forget(entry)
        return RosReply(1, "will be unregistered", 1)

    def forget(self, call: Call) -> None:
        """Drop a registration of the agent's that the master refused."""
        for entry, own in list(self._own.items()):
            if _register(entry, *own) == call:
                self._forget(entry)

    def _forget(self, entry: Entry) -> None:
        (kind, key, node), (api, detail) = entry, self._own.pop(entry)
        self.registrations.unregister(kind, key, node, detail if kind is RegistrationKind.SERVICE else api)

    def mark_dead(self, node: str, api: str) -> None:
        """Remove a dead node from the copy, and ignore the registrations that the master still has of it.

        After its removal from ``dead`` the next survey shows the node again.
        """
        self.dead[node] = api
        self._orphans.pop(node, None)
        self.registrations.purge(node, api)

    def taken(self, survey: Survey, node: str, seen: int) -> str:
        """The slave API that a node of the agent has at the master, if another agent has registered it there.

        Args:
            survey: The survey.
            node: The node.
            seen: ``asked`` when the survey began.
        """
        ours = {api for entry, (api, _) in self._own.items() if entry[2] == node and not self._is_newer(entry, seen)}
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
        restarted = survey.run != self._run
        if restarted and self._run:
            # Nodes do not register at a restarted master until they restart themselves, but their connections go on.
            # They stay in the copy, so that the routes to and from them go on too.
            self._orphans |= self.others()
        self._run = survey.run
        listed = survey.nodes()
        self._orphans = {node: api for node, api in self._orphans.items() if node not in listed}
        self.dead = {node: api for node, api in self.dead.items() if survey.uris.get(node) == api}
        ours = self.ours()
        passed = {*ours, *self.dead}
        for kind in _KINDS:
            self._drop_gone(kind, survey, ours)
        for kind in _KINDS:
            self._add_new(kind, survey, passed, seen)
        self._update_types(survey, passed)
        again = [*self._missing(survey, seen, restarted=restarted), *self._surplus(survey, seen)]
        self._touched = {entry: asked for entry, asked in self._touched.items() if asked > seen}
        return again

    def _is_newer(self, entry: Entry, seen: int) -> bool:
        """Whether the agent has changed a registration since a survey began."""
        return self._touched.get(entry, 0) > seen

    def _drop_gone(self, kind: RegistrationKind, survey: Survey, ours: Mapping[str, str]) -> None:
        for key, nodes in self._yielder(list(self.registrations.table(kind).items())):
            there = survey.holders[kind].get(key, ())
            for node, api in nodes.items():
                # A survey showed what a node of ours had before, while it had no registration by which it was known.
                if (kind, key, node) in self._own or (
                    node not in ours
                    and (
                        node in self.dead
                        or self._orphans.get(node) == api
                        or (node in there and survey.uris.get(node) == api)
                    )
                ):
                    continue
                uri = self.registrations.service_uri(key) if kind is RegistrationKind.SERVICE else None
                self.registrations.unregister(kind, key, node, uri or api)

    def _add_new(self, kind: RegistrationKind, survey: Survey, passed: set[str], seen: int) -> None:
        is_service = kind is RegistrationKind.SERVICE
        details = survey.services if is_service else survey.types
        for key, nodes in self._yielder(survey.holders[kind].items()):
            detail = details.get(key, "" if is_service else ANY_TYPE)
            for node in nodes:
                api = survey.uris.get(node)
                if node in passed or api is None or not detail:
                    continue
                there = self.registrations.at(kind, key)
                if there.get(node) == api and (not is_service or self.registrations.service_uri(key) == detail):
                    continue
                if is_service and (own := [entry for each in there if (entry := (kind, key, each)) in self._own]):
                    if self._is_newer(own[0], seen):
                        continue
                    # The last provider of a service counts: the agent's was replaced, and is not registered again.
                    self._forget(own[0])
                self.registrations.register(kind, key, node, api, detail)

    def _update_types(self, survey: Survey, passed: set[str]) -> None:
        """Update the types of topics: the master has the type that was registered last."""
        types, register = self.registrations.types(), self.registrations.register
        for topic, type_name in self._yielder(survey.types.items()):
            if types.get(topic) == type_name or type_name == ANY_TYPE:
                continue
            for node, api in self.registrations.at(RegistrationKind.PUBLISHER, topic).items():
                if node not in passed:
                    register(RegistrationKind.PUBLISHER, topic, node, api, type_name)
            if topic not in types and (nodes := self.registrations.at(RegistrationKind.SUBSCRIBER, topic)):
                node, api = next(iter(nodes.items()))
                register(RegistrationKind.SUBSCRIBER, topic, node, api, type_name)

    def _missing(self, survey: Survey, seen: int, *, restarted: bool) -> Iterable[Call]:
        """Calls that register what the master lacks; no survey shows subscriptions to parameters."""
        for entry, (api, detail) in self._yielder(list(self._own.items())):
            kind, key, node = entry
            if kind is RegistrationKind.PARAM:
                there = not restarted
            else:
                there = node in survey.holders[kind].get(key, ()) and survey.uris.get(node) == api
                there = there and (kind is not RegistrationKind.SERVICE or survey.services.get(key) == detail)
            if not there and not self._is_newer(entry, seen):
                yield _register(entry, api, detail)

    def _surplus(self, survey: Survey, seen: int) -> Iterable[Call]:
        """Calls that unregister what the master has of the agent's nodes and the agent does not have."""
        nodes = {node: api for node, api in self.ours().items() if survey.uris.get(node) == api}
        for kind in _KINDS:
            for key, holders in self._yielder(survey.holders[kind].items()):
                for node in holders:
                    entry = kind, key, node
                    if node in nodes and entry not in self._own and not self._is_newer(entry, seen):
                        yield _unregister(entry, nodes[node], survey.services.get(key, ""))
