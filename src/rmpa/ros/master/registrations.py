"""The tables of a master: publishers, subscribers, services and nodes.

Registered nodes to which connecting fails: an address without a route, a host name that does not resolve.

Such a node may live: its network may be down for a moment. It stays registered, as at roscore, but after
``limits.NODE_UNREACHABLE_AFTER`` it is *withdrawn*: its topics and services are no longer offered to peers. Pure: the
time is an argument.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Final

import msgspec

from rmpa.ros import limits
from rmpa.ros.master.parameters import Effect, GraphChange, GraphState, PublisherUpdate, RegistrationKind, Shutdown

if TYPE_CHECKING:
    from collections.abc import Mapping


@dataclass(frozen=True, slots=True)
class Unreachable:
    """A node to which connecting fails.

    Args:
        api: The slave API's URI that it registered with.
        problem: Why the last attempt failed, for people.
        since: When the first attempt failed, in seconds of the monotonic clock.
        withdrawn: Whether its topics and services are no longer offered to peers.
    """

    api: str
    problem: str
    since: float
    withdrawn: bool = False


class Reachability:
    """The nodes that could not be reached when they were last tried."""

    def __init__(self) -> None:
        self._nodes: dict[str, Unreachable] = {}

    @property
    def unreachable(self) -> Mapping[str, Unreachable]:
        """The nodes that could not be reached, by name; not to be changed."""
        return self._nodes

    def failed(self, node: str, api: str, problem: str, now: float) -> bool:
        """Note an attempt to connect that failed without being refused; return whether this withdraws the node.

        Args:
            node: The node's name.
            api: Its slave API.
            problem: Why the attempt failed, for people.
            now: Monotonic seconds.
        """
        known = self._nodes.get(node)
        if known is None or known.api != api:
            known = Unreachable(api, problem, now)
        withdrawn = now - known.since >= limits.NODE_UNREACHABLE_AFTER
        self._nodes[node] = replace(known, problem=problem, withdrawn=withdrawn)
        return withdrawn and not known.withdrawn

    def reached(self, node: str) -> bool:
        """Note that a node can be connected to; return whether it was withdrawn before."""
        known = self._nodes.pop(node, None)
        return known is not None and known.withdrawn

    def keep(self, nodes: Mapping[str, str]) -> None:
        """Drop all but these nodes at these slave APIs."""
        if self._nodes:
            self._nodes = {node: known for node, known in self._nodes.items() if nodes.get(node) == known.api}


# The master's tables of publishers, subscribers, services and parameter subscriptions.
#
# Semantics are those of ros_comm's rosmaster 1.15, the order of lists included, because tools print them.


ANY_TYPE: Final = "*"
_NOBODY: Final[dict[str, str]] = {}


class NodeRecord(msgspec.Struct, omit_defaults=True):
    """Everything that one node registered.

    Attributes:
        api: The URI of its slave API.
        publishers: Topics that it publishes, with their types.
        subscribers: Topics that it subscribes to, with their types.
        services: Services that it provides, with their ``rosrpc://`` URIs.
        params: Parameters that it subscribed to; each ends in ``/``.
    """

    api: str
    publishers: dict[str, str] = {}
    subscribers: dict[str, str] = {}
    services: dict[str, str] = {}
    params: list[str] = []


@dataclass(slots=True)
class _Node:
    """One node: its slave API, and what it registered (dicts, for their order)."""

    api: str
    keys: dict[RegistrationKind, dict[str, None]] = field(
        default_factory=lambda: {kind: {} for kind in RegistrationKind}
    )

    @property
    def empty(self) -> bool:
        return not any(self.keys.values())


class Registrations:
    """The tables, and the effects of each change.

    Each change appends to ``effects`` (calls to be made to slaves, in order) and to ``changes``; the owner empties
    both.
    """

    def __init__(self) -> None:
        self._nodes: dict[str, _Node] = {}
        # key -> node -> slave API. The inner dicts are replaced, never changed: callers may hold them.
        self._tables: dict[RegistrationKind, dict[str, dict[str, str]]] = {kind: {} for kind in RegistrationKind}
        self._service_uris: dict[str, str] = {}
        # service -> node -> service URI, likewise
        self._services: dict[str, dict[str, str]] = {}
        self._types: dict[str, str] = {}
        # node -> the slave API of the former node of that name, for as long as a new node has the name.
        self._evicted: dict[str, str] = {}
        self._state: GraphState | None = None
        self.revision = 0
        """Another number after each change of a node's record."""
        self.effects: list[Effect] = []
        self.changes: list[GraphChange] = []

    # --- questions --------------------------------------------------------------------------------------------

    def node_api(self, node: str) -> str | None:
        """The slave API of a node; ``None`` if the node has no registration."""
        found = self._nodes.get(node)
        return found.api if found is not None else None

    def nodes(self) -> dict[str, str]:
        """All nodes with their slave APIs."""
        return {name: node.api for name, node in self._nodes.items()}

    def nodes_at(self, api: str) -> list[str]:
        """The nodes with this slave API; nodelets share one."""
        return [name for name, node in self._nodes.items() if node.api == api]

    def apis(self, kind: RegistrationKind, key: str) -> list[str]:
        """The slave APIs registered for a key, in order."""
        return list(self._tables[kind].get(key, {}).values())

    def at(self, kind: RegistrationKind, key: str) -> dict[str, str]:
        """The nodes registered for a key, in order, and their slave APIs; never changed afterwards."""
        return self._tables[kind].get(key, _NOBODY)

    def param_subscribers(self) -> dict[str, dict[str, str]]:
        """Subscribed parameters (keys end in ``/``), each with its nodes and their slave APIs; not to be changed."""
        return self._tables[RegistrationKind.PARAM]

    def service_uri(self, service: str) -> str | None:
        """The ``rosrpc://`` URI of a service's provider."""
        return self._service_uris.get(service)

    def types(self) -> dict[str, str]:
        """The type of each topic that ever had one; not to be changed."""
        return self._types

    def published(self) -> list[str]:
        """Topics with a publisher."""
        return list(self._tables[RegistrationKind.PUBLISHER])

    def providers(self, kind: RegistrationKind) -> list[tuple[str, dict[str, str]]]:
        """All keys (topics, services or parameters) of a kind, each with its nodes and their slave APIs.

        The caller must not change the inner dicts.
        """
        return list(self._tables[kind].items())

    def record(self, node: str) -> NodeRecord | None:
        """Everything that a node registered; ``None`` for an unknown node."""
        found = self._nodes.get(node)
        if found is None:
            return None
        services = found.keys[RegistrationKind.SERVICE]
        return NodeRecord(
            found.api,
            {topic: self._types.get(topic, ANY_TYPE) for topic in found.keys[RegistrationKind.PUBLISHER]},
            {topic: self._types.get(topic, ANY_TYPE) for topic in found.keys[RegistrationKind.SUBSCRIBER]},
            {name: uri for name in services if (uri := self._services.get(name, {}).get(node))},
            list(found.keys[RegistrationKind.PARAM]),
        )

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

    # --- changes ----------------------------------------------------------------------------------------------

    def register_publisher(self, topic: str, topic_type: str, node: str, api: str) -> None:
        """Add a publisher and notify the topic's subscribers, even if it was registered already.

        Clients rely on the repeated notification: it makes rospy connect again.
        """
        retyped = False
        if topic_type != ANY_TYPE or topic not in self._types:
            retyped = self._types.get(topic) != topic_type
            self._types[topic] = topic_type
        self._register(RegistrationKind.PUBLISHER, topic, node, api, retyped=retyped)
        self.notify_subscribers(topic)

    def register_subscriber(self, topic: str, topic_type: str, node: str, api: str) -> None:
        """Add a subscriber; its type counts only while the topic has none."""
        retyped = topic not in self._types and topic_type != ANY_TYPE
        if retyped:
            self._types[topic] = topic_type
        self._register(RegistrationKind.SUBSCRIBER, topic, node, api, retyped=retyped)

    def register_service(self, service: str, uri: str, node: str, api: str) -> None:
        """Make this node the service's provider, in place of any other."""
        self._claim_name(node, api)
        retyped = self._service_uris.get(service) != uri
        before = self.at(RegistrationKind.SERVICE, service)
        if gone := [other for other in before if other != node]:
            self._tables[RegistrationKind.SERVICE][service] = {n: its for n, its in before.items() if n == node}
            for other in gone:
                self._changed(RegistrationKind.SERVICE, service, other, before[other], added=False)
        self._service_uris[service] = uri
        self._services[service] = {node: uri}
        self._register(RegistrationKind.SERVICE, service, node, api, retyped=retyped)

    def subscribe_param(self, key: str, node: str, api: str) -> None:
        """Notify this node of changes below ``key``, which ends in ``/``.

        A node whose name another node has taken does not take it back by this call. With rosmaster it does, and the
        new node is asked to end: roscpp logs the request to end, and its log subscribes to a parameter with
        ``getCached``. This is the one intended difference; tests/interop/test_core_api.py shows both.
        """
        if self._evicted.get(node) != api:
            self._register(RegistrationKind.PARAM, key, node, api)

    def unregister(self, kind: RegistrationKind, key: str, node: str, api: str) -> bool:
        """Remove a publisher, subscriber or parameter subscriber, if ``api`` is still that node's.

        Returns:
            Whether it was there.
        """
        found = self._tables[kind].get(key, {}).get(node) == api
        if found:
            self._remove(kind, key, node, api)
            if kind is RegistrationKind.PUBLISHER:
                self.notify_subscribers(key)
        self._forget_if_empty(node)
        return found

    def unregister_service(self, service: str, uri: str, node: str) -> bool:
        """Remove a service, if its provider still is this node with this ``rosrpc://`` URI.

        Returns:
            Whether it was there.
        """
        api = self._tables[RegistrationKind.SERVICE].get(service, {}).get(node)
        found = api is not None and self._service_uris.get(service) == uri
        if api is not None and found:
            self._remove(RegistrationKind.SERVICE, service, node, api)
        self._forget_if_empty(node)
        return found

    def purge(self, node: str, api: str) -> bool:
        """Remove everything of a dead node and notify the subscribers of its topics.

        Returns:
            Whether there was such a node with this slave API.
        """
        found = self._nodes.get(node)
        if found is None or found.api != api:
            return False
        topics = list(found.keys[RegistrationKind.PUBLISHER])
        self._empty(node)
        self._nodes.pop(node, None)
        self._evicted.pop(node, None)
        self.revision += 1
        for topic in topics:
            self.notify_subscribers(topic)
        return True

    def notify_subscribers(self, topic: str) -> None:
        """Send the subscribers of a topic the list of its publishers."""
        publishers = tuple(self.apis(RegistrationKind.PUBLISHER, topic))
        # Nodelets of one process share a slave API, which is notified once.
        apis = dict.fromkeys(self.apis(RegistrationKind.SUBSCRIBER, topic))
        self.effects += [PublisherUpdate(api, topic, publishers) for api in apis]

    # --- the tables -------------------------------------------------------------------------------------------

    def _claim_name(self, node: str, api: str) -> _Node:
        """Return the node's entry; a node of that name at another URI loses its registrations and is asked to end."""
        found = self._nodes.get(node)
        if found is not None and found.api != api:
            self.effects.append(Shutdown(found.api, node, tuple(found.keys[RegistrationKind.PUBLISHER])))
            self._empty(node)
            self._evicted[node] = found.api
            found = None
            # The name keeps its place in the order of nodes, as in rosmaster.
        if found is None:
            found = self._nodes[node] = _Node(api)
        return found

    def _register(self, kind: RegistrationKind, key: str, node: str, api: str, *, retyped: bool = False) -> None:
        keys = self._claim_name(node, api).keys[kind]
        if retyped or key not in keys:
            keys[key] = None
            self.revision += 1
        providers = self.at(kind, key)
        new = node not in providers
        if providers.get(node) != api:
            self._tables[kind][key] = {**providers, node: api}
        self._state = None
        if new or retyped:
            self._changed(kind, key, node, api, added=True)

    def _remove(self, kind: RegistrationKind, key: str, node: str, api: str) -> None:
        providers = self._tables[kind][key]
        if len(providers) > 1:
            self._tables[kind][key] = {other: its for other, its in providers.items() if other != node}
        else:
            del self._tables[kind][key]
            if kind is RegistrationKind.SERVICE:
                del self._service_uris[key]
                del self._services[key]
        self._nodes[node].keys[kind].pop(key, None)
        self.revision += 1
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
            self.revision += 1

    def _changed(self, kind: RegistrationKind, key: str, node: str, api: str, *, added: bool) -> None:
        self._state = None
        if kind is not RegistrationKind.PARAM:
            topic_type = "" if kind is RegistrationKind.SERVICE else self._types.get(key, "")
            self.changes.append(GraphChange(kind, added, key, node, api, topic_type))
