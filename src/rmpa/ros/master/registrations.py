"""Who publishes, subscribes and serves what: the master's tables, in the order that rosmaster keeps.

Semantics are those of ros_comm's rosmaster 1.15, its order of lists included, because tools print them.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Final

from rmpa.ros.master.effects import Effect, GraphChange, GraphState, Kind, PublisherUpdate, Shutdown

ANY_TYPE: Final = "*"
_NOBODY: Final[dict[str, str]] = {}


@dataclass(slots=True)
class _Node:
    """One node: where its slave API is, and what it registered (dicts, for their order)."""

    api: str
    keys: dict[Kind, dict[str, None]] = field(default_factory=lambda: {kind: {} for kind in Kind})

    @property
    def empty(self) -> bool:
        return not any(self.keys.values())


class Registrations:
    """The tables, and what follows from each change.

    Each change appends to ``effects`` (calls to be made to slaves, in order) and to ``changes``; the owner takes
    them away.
    """

    def __init__(self) -> None:
        self._nodes: dict[str, _Node] = {}
        # key -> node -> slave API. The inner dicts are never changed but replaced: they may have been handed out.
        self._tables: dict[Kind, dict[str, dict[str, str]]] = {kind: {} for kind in Kind}
        self._service_uris: dict[str, str] = {}
        # service -> node -> service URI, likewise
        self._services: dict[str, dict[str, str]] = {}
        self._types: dict[str, str] = {}
        # The URI that each node's name was last taken from, while the name is in use.
        self._evicted: dict[str, str] = {}
        self._state: GraphState | None = None
        self.effects: list[Effect] = []
        self.changes: list[GraphChange] = []

    # --- questions --------------------------------------------------------------------------------------------

    def node_api(self, node: str) -> str | None:
        """The slave API of a node, if it has any registration."""
        found = self._nodes.get(node)
        return found.api if found is not None else None

    def nodes(self) -> dict[str, str]:
        """All nodes with their slave APIs."""
        return {name: node.api for name, node in self._nodes.items()}

    def nodes_at(self, api: str) -> list[str]:
        """The nodes with this slave API; nodelets share one."""
        return [name for name, node in self._nodes.items() if node.api == api]

    def apis(self, kind: Kind, key: str) -> list[str]:
        """The slave APIs registered for a key, in order."""
        return list(self._tables[kind].get(key, {}).values())

    def at(self, kind: Kind, key: str) -> dict[str, str]:
        """The nodes registered for a key, in order, and their slave APIs; never changed afterwards."""
        return self._tables[kind].get(key, _NOBODY)

    def param_subscribers(self) -> dict[str, dict[str, str]]:
        """Subscribed parameters (keys end in ``/``), each with its nodes and their APIs; not to be changed."""
        return self._tables[Kind.PARAM]

    def service_uri(self, service: str) -> str | None:
        """The ``rosrpc://`` URI of a service's provider."""
        return self._service_uris.get(service)

    def types(self) -> dict[str, str]:
        """The type of each topic that ever had one; not to be changed."""
        return self._types

    def published(self) -> list[str]:
        """Topics with a publisher."""
        return list(self._tables[Kind.PUBLISHER])

    def providers(self, kind: Kind) -> list[tuple[str, dict[str, str]]]:
        """All keys of a kind, each with its nodes and their slave APIs; not to be changed."""
        return list(self._tables[kind].items())

    def state(self) -> GraphState:
        """All registrations; the same object until something changes.

        What is in it is shared with the tables, so that a look at a graph of thousands costs microseconds.
        """
        if self._state is None:
            self._state = GraphState(
                dict(self._tables[Kind.PUBLISHER]),
                dict(self._tables[Kind.SUBSCRIBER]),
                dict(self._services),
                dict(self._types),
                self.nodes(),
            )
        return self._state

    # --- changes ----------------------------------------------------------------------------------------------

    def register_publisher(self, topic: str, topic_type: str, node: str, api: str) -> None:
        """Add a publisher and tell the topic's subscribers, also when it was there before.

        Clients rely on the repetition: it is what makes rospy connect again.
        """
        retyped = False
        if topic_type != ANY_TYPE or topic not in self._types:
            retyped = self._types.get(topic) != topic_type
            self._types[topic] = topic_type
        self._register(Kind.PUBLISHER, topic, node, api, retyped=retyped)
        self._tell_subscribers(topic)

    def register_subscriber(self, topic: str, topic_type: str, node: str, api: str) -> None:
        """Add a subscriber; its type counts only while the topic has none."""
        retyped = topic not in self._types and topic_type != ANY_TYPE
        if retyped:
            self._types[topic] = topic_type
        self._register(Kind.SUBSCRIBER, topic, node, api, retyped=retyped)

    def register_service(self, service: str, uri: str, node: str, api: str) -> None:
        """Make this node the service's provider, in place of any other."""
        self._seat(node, api)
        retyped = self._service_uris.get(service) != uri
        before = self.at(Kind.SERVICE, service)
        if gone := [other for other in before if other != node]:
            self._tables[Kind.SERVICE][service] = {n: its for n, its in before.items() if n == node}
            for other in gone:
                self._changed(Kind.SERVICE, service, other, before[other], added=False)
        self._service_uris[service] = uri
        self._services[service] = {node: uri}
        self._register(Kind.SERVICE, service, node, api, retyped=retyped)

    def subscribe_param(self, key: str, node: str, api: str) -> None:
        """Tell this node of changes below ``key``, which ends in ``/``.

        A node that was pushed out does not take its name back by this, as it does at rosmaster, which then asks the
        new node to end (the one difference by intent; tests/interop/test_core_api.py shows both). roscpp does so: it
        logs that it was asked to end, and its log asks for a parameter with ``getCached``.
        """
        if self._evicted.get(node) != api:
            self._register(Kind.PARAM, key, node, api)

    def unregister(self, kind: Kind, key: str, node: str, api: str) -> bool:
        """Take a publisher, subscriber or parameter's subscriber away, if ``api`` is still that node's.

        Returns:
            Whether it was there.
        """
        found = self._tables[kind].get(key, {}).get(node) == api
        if found:
            self._remove(kind, key, node, api)
            if kind is Kind.PUBLISHER:
                self._tell_subscribers(key)
        self._forget_if_empty(node)
        return found

    def unregister_service(self, service: str, uri: str, node: str) -> bool:
        """Take a service away, if its provider still is this node with this ``rosrpc://`` URI.

        Returns:
            Whether it was so.
        """
        api = self._tables[Kind.SERVICE].get(service, {}).get(node)
        found = api is not None and self._service_uris.get(service) == uri
        if api is not None and found:
            self._remove(Kind.SERVICE, service, node, api)
        self._forget_if_empty(node)
        return found

    def purge(self, node: str, api: str) -> bool:
        """Take everything of a dead node away and tell the subscribers of its topics.

        Returns:
            Whether there was such a node with this slave API.
        """
        found = self._nodes.get(node)
        if found is None or found.api != api:
            return False
        topics = list(found.keys[Kind.PUBLISHER])
        self._empty(node)
        self._nodes.pop(node, None)
        self._evicted.pop(node, None)
        for topic in topics:
            self._tell_subscribers(topic)
        return True

    # --- the tables -------------------------------------------------------------------------------------------

    def _seat(self, node: str, api: str) -> _Node:
        """The node's record; a node of the same name at another URI is pushed out with all it had."""
        found = self._nodes.get(node)
        if found is not None and found.api != api:
            self.effects.append(Shutdown(found.api, node, tuple(found.keys[Kind.PUBLISHER])))
            self._empty(node)
            self._evicted[node] = found.api
            found = None
            # Its place in the order of nodes stays, as rosmaster has it.
        if found is None:
            found = self._nodes[node] = _Node(api)
        return found

    def _register(self, kind: Kind, key: str, node: str, api: str, *, retyped: bool = False) -> None:
        self._seat(node, api).keys[kind][key] = None
        providers = self.at(kind, key)
        new = node not in providers
        if providers.get(node) != api:
            self._tables[kind][key] = {**providers, node: api}
        self._state = None
        if new or retyped:
            self._changed(kind, key, node, api, added=True)

    def _remove(self, kind: Kind, key: str, node: str, api: str) -> None:
        providers = self._tables[kind][key]
        if len(providers) > 1:
            self._tables[kind][key] = {other: its for other, its in providers.items() if other != node}
        else:
            del self._tables[kind][key]
            if kind is Kind.SERVICE:
                del self._service_uris[key]
                del self._services[key]
        self._nodes[node].keys[kind].pop(key, None)
        self._changed(kind, key, node, api, added=False)

    def _empty(self, node: str) -> None:
        for kind, keys in self._nodes[node].keys.items():
            for key in list(keys):
                api = self._tables[kind].get(key, {}).get(node)
                if api is not None:
                    self._remove(kind, key, node, api)

    def _forget_if_empty(self, node: str) -> None:
        found = self._nodes.get(node)
        if found is not None and found.empty:
            del self._nodes[node]
            self._evicted.pop(node, None)
            self._state = None

    def _changed(self, kind: Kind, key: str, node: str, api: str, *, added: bool) -> None:
        self._state = None
        if kind is not Kind.PARAM:
            topic_type = "" if kind is Kind.SERVICE else self._types.get(key, "")
            self.changes.append(GraphChange(kind, added, key, node, api, topic_type))

    def _tell_subscribers(self, topic: str) -> None:
        publishers = tuple(self.apis(Kind.PUBLISHER, topic))
        # Nodelets of one process share an API: it is told once.
        for api in dict.fromkeys(self.apis(Kind.SUBSCRIBER, topic)):
            self.effects.append(PublisherUpdate(api, topic, publishers))
