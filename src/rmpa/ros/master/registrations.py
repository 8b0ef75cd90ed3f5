"""The master's tables of publishers, subscribers, services and parameter subscriptions.

Semantics are those of ros_comm's rosmaster 1.15, the order of lists included, because tools print them. Nodes
restored from the previous run (``unverified``) are in no table and no answer until they are verified (``confirm``).
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Final

from rmpa.ros.master.effects import Effect, GraphChange, GraphState, PublisherUpdate, RegistrationKind, Shutdown
from rmpa.ros.master.unverified import NodeRecord, UnverifiedNodes

if TYPE_CHECKING:
    from collections.abc import Callable

ANY_TYPE: Final = "*"
_NOBODY: Final[dict[str, str]] = {}


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
        self.unverified = UnverifiedNodes()
        self._restored: set[str] = set()
        self.revision = 0
        """Another number after each change of a node's record."""
        self.revisions: dict[str, int] = {}
        """A number for each registered or unverified node, which differs after each change of the node."""
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
        self._notify_subscribers(topic)

    def repeat_publishers(self, topic: str) -> None:
        """Send the subscribers of a topic its list of publishers once more."""
        self._notify_subscribers(topic)

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
        withdrawn = self._withdraw(kind, key, node, api)
        found = self._tables[kind].get(key, {}).get(node) == api
        if found:
            self._remove(kind, key, node, api)
        if kind is RegistrationKind.PUBLISHER and (found or withdrawn):
            self._notify_subscribers(key)
        self._forget_if_empty(node)
        return found or withdrawn

    def unregister_service(self, service: str, uri: str, node: str) -> bool:
        """Remove a service, if its provider still is this node with this ``rosrpc://`` URI.

        Returns:
            Whether it was there.
        """
        api = self._tables[RegistrationKind.SERVICE].get(service, {}).get(node)
        found = api is not None and self._service_uris.get(service) == uri
        if api is not None and found:
            self._remove(RegistrationKind.SERVICE, service, node, api)
        record = self.unverified.get(node)
        if record is not None and record.services.get(service) == uri:
            found = self._withdraw(RegistrationKind.SERVICE, service, node, record.api)
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
        self._mark_changed(node)
        for topic in topics:
            self._notify_subscribers(topic)
        return True

    # --- nodes of the previous run ----------------------------------------------------------------------------

    def record(self, node: str) -> NodeRecord | None:
        """Everything that a node registered before the core's restart and after it; ``None`` for an unknown node."""
        found, awaited = self._nodes.get(node), self.unverified.get(node)
        if found is None:
            return awaited
        types = self._types
        record = NodeRecord(
            found.api,
            {topic: types.get(topic, ANY_TYPE) for topic in found.keys[RegistrationKind.PUBLISHER]},
            {topic: types.get(topic, ANY_TYPE) for topic in found.keys[RegistrationKind.SUBSCRIBER]},
            {
                name: uri
                for name in found.keys[RegistrationKind.SERVICE]
                if (uri := self._services.get(name, {}).get(node))
            },
            dict(found.keys[RegistrationKind.PARAM]),
        )
        if awaited is not None:
            for kind in RegistrationKind:
                record.of(kind).update(awaited.of(kind))  # type: ignore[arg-type] # both of one kind
        return record

    def restore(self, node: str, record: NodeRecord) -> None:
        """Restore a node of the previous run as unverified. The types of its topics count at once."""
        self.unverified.add(node, record)
        for topic, topic_type in [*record.publishers.items(), *record.subscribers.items()]:
            self._types.setdefault(topic, topic_type)
        self._state = None
        self._mark_changed(node)

    def confirm(self, node: str) -> tuple[list[str], list[str]]:
        """Register an unverified node, which has answered, with all that it had.

        A service that another node provides by now stays with that node.

        Returns:
            The topics that it publishes, for ``notify_new_subscribers``, and those that it subscribes to, for
            ``notify_subscriber``.
        """
        record = self.unverified.pop(node)
        if record is None:
            return [], []
        self._restored.add(node)
        for topic in record.publishers:
            self._register(RegistrationKind.PUBLISHER, topic, node, record.api)
        for topic in record.subscribers:
            self._register(RegistrationKind.SUBSCRIBER, topic, node, record.api)
        for service, uri in record.services.items():
            if service not in self._service_uris:
                self.register_service(service, uri, node, record.api)
        for key in record.params:
            self._register(RegistrationKind.PARAM, key, node, record.api)
        self._mark_changed(node)
        return list(record.publishers), list(record.subscribers)

    def notify_subscriber(self, topic: str, node: str) -> None:
        """Send one subscriber the publishers of a topic."""
        api = self.at(RegistrationKind.SUBSCRIBER, topic).get(node)
        if api is not None:
            publishers = self._publishers(topic, unverified=node in self._restored)
            self.effects.append(PublisherUpdate(api, topic, publishers))

    def discard(self, node: str) -> None:
        """Drop an unverified node, and notify the restored subscribers, which may be connected to it."""
        record = self.unverified.pop(node)
        if record is not None:
            self._mark_changed(node)
            for topic in record.publishers:
                self._notify_subscribers(topic, self._restored.__contains__)

    def notify_new_subscribers(self, topic: str) -> None:
        """Notify those subscribers of a topic that registered after the core's restart."""
        self._notify_subscribers(topic, lambda node: node not in self._restored)

    def _withdraw(self, kind: RegistrationKind, key: str, node: str, api: str) -> bool:
        """Remove a registration of an unverified node; return whether it was there."""
        if not self.unverified.withdraw(kind, key, node, api):
            return False
        record = self.unverified.get(node)
        if record is not None and not any(record.of(kind) for kind in RegistrationKind):
            self.unverified.pop(node)
        self._mark_changed(node)
        return True

    def _mark_changed(self, node: str) -> None:
        """Give a node a new revision, because its record has changed; forget one that has no record left."""
        self.revision += 1
        if node in self._nodes or self.unverified.get(node) is not None:
            self.revisions[node] = self.revision
        else:
            self.revisions.pop(node, None)
            self._restored.discard(node)

    # --- the tables -------------------------------------------------------------------------------------------

    def _claim_name(self, node: str, api: str) -> _Node:
        """Return the node's entry; a node of that name at another URI loses its registrations and is asked to end."""
        awaited = self.unverified.get(node)
        if awaited is not None and awaited.api != api:
            self.effects.append(Shutdown(awaited.api, node, tuple(awaited.publishers)))
            self._evicted[node] = awaited.api
            self.discard(node)
        found = self._nodes.get(node)
        if found is not None and found.api != api:
            self.effects.append(Shutdown(found.api, node, tuple(found.keys[RegistrationKind.PUBLISHER])))
            self._empty(node)
            self._evicted[node] = found.api
            self._restored.discard(node)
            found = None
            # The name keeps its place in the order of nodes, as in rosmaster.
        if found is None:
            found = self._nodes[node] = _Node(api)
        return found

    def _register(self, kind: RegistrationKind, key: str, node: str, api: str, *, retyped: bool = False) -> None:
        keys = self._claim_name(node, api).keys[kind]
        if retyped or key not in keys:
            keys[key] = None
            self._mark_changed(node)
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
        self._mark_changed(node)
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
            self._mark_changed(node)

    def _changed(self, kind: RegistrationKind, key: str, node: str, api: str, *, added: bool) -> None:
        self._state = None
        if kind is not RegistrationKind.PARAM:
            topic_type = "" if kind is RegistrationKind.SERVICE else self._types.get(key, "")
            self.changes.append(GraphChange(kind, added, key, node, api, topic_type))

    def _publishers(self, topic: str, *, unverified: bool) -> tuple[str, ...]:
        """The slave APIs of a topic's publishers, with or without unverified ones."""
        apis = self.apis(RegistrationKind.PUBLISHER, topic)
        more = self.unverified.publishers(topic) if unverified else ()
        return tuple(dict.fromkeys([*apis, *more])) if more else tuple(apis)

    def _notify_subscribers(self, topic: str, which: Callable[[str], bool] | None = None) -> None:
        """Send the subscribers of a topic (those that ``which`` accepts) the list of its publishers.

        Restored subscribers get unverified publishers too: they are connected to these, and would disconnect if the
        list lacked them.
        """
        known = self._publishers(topic, unverified=False)
        old = self._publishers(topic, unverified=True)
        told: dict[str, tuple[str, ...]] = {}
        for node, api in self.at(RegistrationKind.SUBSCRIBER, topic).items():
            if api not in told and (
                which is None or which(node)
            ):  # nodelets of one process share a slave API, which is notified once
                told[api] = old if node in self._restored else known
        self.effects += [PublisherUpdate(api, topic, publishers) for api, publishers in told.items()]
