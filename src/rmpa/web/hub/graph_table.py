"""The topics, services and nodes of the graph, from rows of the agent or from the master's own answers; no I/O."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final, TypeVar

from rmpa.observe.control import GraphRows, ServiceRow, TopicRow
from rmpa.ros.wire.tcpros import ANY
from rmpa.web import limits
from rmpa.web.hub.requests import GraphService, GraphTopic

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Mapping, Sequence

    from rmpa.ros.wire.xmlrpc import XmlRpcValue

_Rows = dict[str, tuple[str, ...]]
_T = TypeVar("_T")
_KNOWN_TYPES: Final = {"/rosout": "rosgraph_msgs/Log", "/rosout_agg": "rosgraph_msgs/Log"}
"""Types where the master has none: clients tell ROS 1 by that of ``/rosout``."""


class GraphTable:
    """The graph as it was last told. What did not change costs next to nothing.

    Args:
        found: ``(service)``: its type and URI as far as known, else two empty texts.
        services_changed: ``(names)``: services that have other providers than before, or were registered anew.
    """

    def __init__(
        self, found: Callable[[str], tuple[str, str]], services_changed: Callable[[Iterable[str]], None]
    ) -> None:
        self._found = found
        self._services_changed = services_changed
        self._rows: dict[str, TopicRow] = {}
        self._seen: dict[str, dict[str, None]] = {}
        self._nodes: Sequence[str] | None = None
        self.topics: Mapping[str, GraphTopic] = {}
        """By name, in order of names; replaced by each change, so that it may be kept."""
        self.services: Mapping[str, GraphService] = {}
        """Likewise."""

    @property
    def nodes(self) -> Sequence[str]:
        """In order of names."""
        if self._nodes is None:
            found = {node for row in self._rows.values() for node in (*row.publishers, *row.subscribers)}
            self._nodes = sorted(found.union(*(service.providers for service in self.services.values())))
        return self._nodes

    def update(self, rows: GraphRows) -> bool:
        """Take rows; returns whether the graph differs from what it was."""
        topics = _differing(self._rows, rows.topics)
        services = [row for row in rows.services if not rows.whole or self._other_providers(row)]
        if rows.whole:
            names = {row.name for row in rows.topics}
            topics += [TopicRow(name, "", (), ()) for name in self._rows if name not in names]
            names = {row.name for row in rows.services}
            services += [ServiceRow(name, ()) for name in self.services if name not in names]
        if not topics and not services:
            return False
        self._nodes = None
        for row in topics:
            self._keep(row)
        if topics:
            self.topics = _updated(self.topics, {row.name: self._topic(row.name) for row in topics})
        if services:
            self._services_changed([row.name for row in services])
            self.services = _updated(self.services, {row.name: self._service(row) for row in services})
        return True

    def saw_type(self, topic: str, type_: str) -> bool:
        """A publisher of a topic has this type; the master knows one only. Returns whether the graph differs now."""
        seen = self._seen.setdefault(topic, {})
        if type_ in seen or len(seen) >= limits.SEEN_TYPES_MAX:
            return False
        seen[type_] = None
        known = self.topics.get(topic)
        if known is None or type_ in known.types:
            return False
        self.topics = _updated(self.topics, {topic: self._topic(topic)})
        return True

    def found_services(self) -> None:
        """Types of services became known."""
        rows = (ServiceRow(service.name, service.providers) for service in self.services.values())
        self.services = {row.name: service for row in rows if (service := self._service(row))}

    def _other_providers(self, row: ServiceRow) -> bool:
        known = self.services.get(row.name)
        return set(row.providers) != set(known.providers if known else ())

    def _keep(self, row: TopicRow) -> None:
        if row.publishers or row.subscribers:
            self._rows[row.name] = row
        else:
            self._rows.pop(row.name, None)
        if not row.publishers:
            self._seen.pop(row.name, None)

    def _topic(self, name: str) -> GraphTopic | None:
        row = self._rows.get(name)
        if row is None:
            return None
        types = dict.fromkeys(() if row.type in (ANY, "") else (row.type,)) | self._seen.get(name, {})
        known = tuple(types) or ((_KNOWN_TYPES[name],) if name in _KNOWN_TYPES else ())
        return GraphTopic(name, known, tuple(sorted(row.publishers)), tuple(sorted(row.subscribers)))

    def _service(self, row: ServiceRow) -> GraphService | None:
        if not row.providers:
            return None
        type_, uri = self._found(row.name)
        return GraphService(row.name, type_, tuple(sorted(row.providers)), uri)


def rows_of(state: XmlRpcValue, types: XmlRpcValue) -> GraphRows:
    """All rows, from the answers of a master.

    Args:
        state: The value of ``getSystemState``; what is malformed in it is left out.
        types: The value of ``getTopicTypes``, likewise.
    """
    tables = state if isinstance(state, list) and len(state) == 3 else [[], [], []]
    publishers, subscribers, services = map(_table, tables)
    known: dict[str, str] = {}
    for row in types if isinstance(types, list) else ():
        match row:
            case [str(name), str(type_)]:
                known[name] = type_
    return GraphRows(
        whole=True,
        topics=tuple(
            TopicRow(name, known.get(name, ANY), publishers.get(name, ()), subscribers.get(name, ()))
            for name in publishers.keys() | subscribers.keys()
        ),
        services=tuple(ServiceRow(name, providers) for name, providers in services.items()),
    )


def _table(value: XmlRpcValue) -> _Rows:
    found: _Rows = {}
    for row in value if isinstance(value, list) else ():
        match row:
            case [str(name), list(nodes)]:
                found[name] = tuple(str(node) for node in nodes)
    return found


def _differing(known: Mapping[str, TopicRow], rows: Iterable[TopicRow]) -> list[TopicRow]:
    return [row for row in rows if known.get(row.name) != row]


def _updated(before: Mapping[str, _T], changes: Mapping[str, _T | None]) -> dict[str, _T]:
    """A copy in order of names with these changes; ``None`` removes."""
    made = dict(before)
    for name, value in changes.items():
        if value is None:
            made.pop(name, None)
        else:
            made[name] = value
    if all(name in before for name in changes):
        return made
    return {name: made[name] for name in sorted(made)}
