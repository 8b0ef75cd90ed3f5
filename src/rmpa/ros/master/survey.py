"""A survey of a master that is another program: one ``system.multicall``, and its answer.

A ROS master does not notify of changes in its graph, so it is polled. ``getSystemState`` returns only names. The URI
of each node and service is looked up in the same call, because only the URI shows that a node was restarted.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Final

from rmpa.core.errors import RemoteProtocolError
from rmpa.ros.master.effects import RegistrationKind
from rmpa.ros.wire.xmlrpc import XmlRpcValue, brief

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence

    from rmpa.core.counters import Yielder

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
