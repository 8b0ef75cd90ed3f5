"""The tables of a master: publishers, subscribers, services and nodes.

Semantics are those of ros_comm's rosmaster 1.15, the order of lists included, because tools print them.
"""

from __future__ import annotations

from typing import Annotated, Final

import msgspec

from rmpa.core.identity import is_type_name, proxied_node
from rmpa.ros.master.parameters import GraphChange, GraphState, RegistrationKind, SlaveCall

# Characters of a name that is read from a state file: rosmaster has no limit, and the longest seen have 200.
_CORE_STATE_NAME_MAX: Final = 4096

ANY_TYPE: Final = "*"
_NONE: Final[dict[str, str]] = {}
_NO_ENTRIES: Final[dict[tuple[RegistrationKind, str], str]] = {}
_OTHER_SIDE: Final = {
    RegistrationKind.PUBLISHER: RegistrationKind.SUBSCRIBER,
    RegistrationKind.SUBSCRIBER: RegistrationKind.PUBLISHER,
}
# A name in a core's state file.
Name = Annotated[str, msgspec.Meta(pattern="^/", max_length=_CORE_STATE_NAME_MAX)]


class NodeRecord(msgspec.Struct):
    """Everything that one node registered, as a core's state file has it.

    Attributes:
        api: The URI of its slave API.
        entries: For each registration the kind, the key and the detail, as for ``Registrations.register``.
    """

    api: Annotated[str, msgspec.Meta(pattern="^http://")]
    entries: list[tuple[RegistrationKind, Name, str]] = []


class Registrations:
    """The tables, and what follows from each change.

    Each change appends to ``calls`` (of slaves, to be made in order) and to ``changes``; the owner takes both.

    Attributes:
        revision: Another number after each change of a node's record.
    """

    def __init__(self) -> None:
        self._apis: dict[str, str] = {}
        # node -> what it registered, in order, each with its detail as of ``register``
        self._entries: dict[str, dict[tuple[RegistrationKind, str], str]] = {}
        # key -> node -> slave API. The inner dicts are replaced, never changed: callers may hold them.
        self._tables: dict[RegistrationKind, dict[str, dict[str, str]]] = {kind: {} for kind in RegistrationKind}
        # service -> node -> service URI, likewise; a service has one provider
        self._services: dict[str, dict[str, str]] = {}
        self._types: dict[str, str] = {}
        # node -> the slave API of the former node of that name, for as long as a new node has the name.
        self._evicted: dict[str, str] = {}
        self._state: GraphState | None = None
        self.revision = 0
        self.calls: list[SlaveCall] = []
        self.changes: list[GraphChange] = []

    def node_api(self, node: str) -> str | None:
        """The slave API of a node; ``None`` if the node has no registration."""
        return self._apis.get(node)

    def nodes(self) -> dict[str, str]:
        """All nodes with their slave APIs."""
        return dict(self._apis)

    def nodes_at(self, api: str) -> list[str]:
        """The nodes with this slave API; nodelets share one."""
        return [node for node, its in self._apis.items() if its == api]

    def at(self, kind: RegistrationKind, key: str) -> dict[str, str]:
        """The nodes registered for a key, in order, and their slave APIs; never changed afterwards."""
        return self._tables[kind].get(key, _NONE)

    def table(self, kind: RegistrationKind) -> dict[str, dict[str, str]]:
        """All keys of a kind, each with its nodes and their slave APIs; not to be changed."""
        return self._tables[kind]

    def counterparts(self, kind: RegistrationKind, key: str) -> list[str] | int:
        """The value in the reply to a registration: the slave APIs at the other side of a topic; 1 for a service."""
        other = _OTHER_SIDE.get(kind)
        return 1 if other is None else list(self.at(other, key).values())

    def service_uri(self, service: str) -> str | None:
        """The ``rosrpc://`` URI of a service's provider."""
        return next(iter(self._services.get(service, _NONE).values()), None)

    def types(self) -> dict[str, str]:
        """The type of each topic that ever had one; not to be changed."""
        return self._types

    def type_of(self, topic: str, node: str = "") -> str:
        """The type with which a node publishes or subscribes to a topic, else the one registered last by any node.

        ``*`` for none.

        The master keeps one type for each topic; publishers may have several.
        """
        entries = self._entries.get(node, _NO_ENTRIES)
        registered = (entries.get((kind, topic), "") for kind in _OTHER_SIDE)
        return next(filter(is_type_name, registered), self._types.get(topic, ANY_TYPE))

    def record(self, node: str) -> NodeRecord | None:
        """Everything that a node registered; ``None`` for an unknown node."""
        if node not in self._apis:
            return None
        record = NodeRecord(self._apis[node])
        for kind, key in self._entries[node]:
            if kind is RegistrationKind.SERVICE:
                detail = self._services.get(key, _NONE).get(node)
            else:
                detail = "" if kind is RegistrationKind.PARAM else self._types.get(key, ANY_TYPE)
            if detail is not None:
                record.entries.append((kind, key, detail))
        return record

    def state(self) -> GraphState:
        """All registrations; the same object until something changes.

        The inner dicts are shared with the tables, so this takes microseconds in a graph of thousands of nodes.
        """
        if self._state is None:
            self._state = GraphState(
                dict(self._tables[RegistrationKind.PUBLISHER]),
                dict(self._tables[RegistrationKind.SUBSCRIBER]),
                dict(self._services),
                dict(self._types),
                self.nodes(),
            )
        return self._state

    def register(self, kind: RegistrationKind, key: str, node: str, api: str, detail: str = "") -> None:
        """Add a registration.

        The subscribers of a topic are notified of a publisher even if it was registered already: clients rely on the
        repeated notification, which makes rospy connect again. A service has one provider, the last one.

        A node whose name another node has taken does not take it back by subscribing to a parameter. With rosmaster
        it does, and the new node is asked to end: roscpp logs the request to end, and its log subscribes to a
        parameter with ``getCached``. This is the one intended difference; tests/interop/test_core_api.py shows both.

        Args:
            kind: The kind of registration.
            key: The topic, service or parameter; the latter ends in ``/``.
            node: The node.
            api: Its slave API.
            detail: The type of a topic (that of a subscriber counts only while the topic has none), or the
                ``rosrpc://`` URI of a service.
        """
        if kind is RegistrationKind.PARAM and self._evicted.get(node) == api:
            return
        self._claim_name(node, api)
        retyped, unknown, providers = False, key not in self._types, self.at(kind, key)
        match kind:
            case RegistrationKind.SERVICE:
                retyped = self.service_uri(key) != detail
                self._services[key] = {node: detail}
                gone = {other: its for other, its in providers.items() if other != node}
                self._tables[kind][key] = providers = {node: api} if node in providers else {}
                for other, its in gone.items():
                    # As in rosmaster, the other node stays known by this service until it has ended.
                    self._changed(kind, key, other, its, added=False)
            case RegistrationKind.PUBLISHER if unknown or detail != ANY_TYPE:
                retyped = self._types.get(key) != detail
                self._types[key] = detail
            case RegistrationKind.SUBSCRIBER if unknown and detail != ANY_TYPE:
                retyped = True
                self._types[key] = detail
        if retyped or node not in providers:
            self._entries[node][kind, key] = detail
            self._tables[kind][key] = {**providers, node: api}
            self._changed(kind, key, node, api, added=True)
        if kind is RegistrationKind.PUBLISHER:
            self.notify_subscribers(key)

    def unregister(self, kind: RegistrationKind, key: str, node: str, detail: str) -> bool:
        """Remove a registration.

        Args:
            kind: The kind of registration.
            key: The topic, service or parameter.
            node: The node.
            detail: The node's slave API; of a service its ``rosrpc://`` URI. Another one removes nothing.

        Returns:
            Whether it was there.
        """
        api = self.at(kind, key).get(node)
        found = api is not None and detail == (self.service_uri(key) if kind is RegistrationKind.SERVICE else api)
        if api is not None and found:
            self._remove(kind, key, node, api)
            if kind is RegistrationKind.PUBLISHER:
                self.notify_subscribers(key)
        if self._entries.get(node) == {}:
            self._forget(node)
        return found

    def purge(self, node: str, api: str) -> bool:
        """Remove everything of a dead node and notify the subscribers of its topics.

        Returns:
            Whether there was such a node with this slave API.
        """
        if self._apis.get(node) != api:
            return False
        topics = self._empty(node)
        self._forget(node)
        for topic in topics:
            self.notify_subscribers(topic)
        return True

    def notify_subscribers(self, topic: str) -> None:
        """Send the subscribers of a topic the list of its publishers; a proxy connects to none, and needs no list."""
        publishers = list(self.at(RegistrationKind.PUBLISHER, topic).values())
        # Nodelets of one process share a slave API, which is notified once.
        subscribers = self.at(RegistrationKind.SUBSCRIBER, topic)
        apis = dict.fromkeys(api for node, api in subscribers.items() if proxied_node(node) is None)
        self.calls += [(api, "publisherUpdate", topic, publishers) for api in apis]

    def take(self) -> tuple[list[SlaveCall], list[GraphChange]]:
        """Return the calls of slaves and the changes since the previous call of this method, in order."""
        taken = self.calls, self.changes
        self.calls, self.changes = [], []
        return taken

    def _claim_name(self, node: str, api: str) -> None:
        """Make the node's entry; a node of that name at another URI loses its registrations and is asked to end."""
        before = self._apis.get(node)
        if before == api:
            return
        self._apis[node] = api  # the name keeps its place in the order of nodes, as in rosmaster
        if before is not None:
            self._evicted[node] = before
            self.calls.append((before, "shutdown", node, self._empty(node)))
        self._entries[node] = {}
        self._touch()

    def _remove(self, kind: RegistrationKind, key: str, node: str, api: str) -> None:
        providers = {other: its for other, its in self._tables[kind][key].items() if other != node}
        if providers:
            self._tables[kind][key] = providers
        else:
            del self._tables[kind][key]
            if kind is RegistrationKind.SERVICE:
                del self._services[key]
        del self._entries[node][kind, key]
        self._changed(kind, key, node, api, added=False)

    def _empty(self, node: str) -> list[str]:
        """Remove all registrations of a node; return the topics that it published."""
        entries = list(self._entries[node])
        for kind, key in entries:
            if (api := self.at(kind, key).get(node)) is not None:
                self._remove(kind, key, node, api)
        return [key for kind, key in entries if kind is RegistrationKind.PUBLISHER]

    def _forget(self, node: str) -> None:
        del self._apis[node], self._entries[node]
        self._evicted.pop(node, None)
        self._touch()

    def _changed(self, kind: RegistrationKind, key: str, node: str, api: str, *, added: bool) -> None:
        self._touch()
        if kind is not RegistrationKind.PARAM:
            topic_type = "" if kind is RegistrationKind.SERVICE else self._types.get(key, "")
            self.changes.append(GraphChange(kind, added, key, node, api, topic_type))

    def _touch(self) -> None:
        self._state = None
        self.revision += 1
