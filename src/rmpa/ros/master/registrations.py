"""Who publishes, subscribes and serves what: the master's tables, in the order that rosmaster keeps.

Semantics are those of ros_comm's rosmaster 1.15, its order of lists included, because tools print them. Beside the
tables stand the nodes of the run before (``awaited``): no question shows them until they have answered themselves.
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
    """One node: where its slave API is, and what it registered (dicts, for their order)."""

    api: str
    keys: dict[RegistrationKind, dict[str, None]] = field(
        default_factory=lambda: {kind: {} for kind in RegistrationKind}
    )

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
        self._tables: dict[RegistrationKind, dict[str, dict[str, str]]] = {kind: {} for kind in RegistrationKind}
        self._service_uris: dict[str, str] = {}
        # service -> node -> service URI, likewise
        self._services: dict[str, dict[str, str]] = {}
        self._types: dict[str, str] = {}
        # The URI that each node's name was last taken from, while the name is in use.
        self._evicted: dict[str, str] = {}
        self._state: GraphState | None = None
        self.unverified = UnverifiedNodes()
        self._restored: set[str] = set()
        self._revision = 0
        self.revisions: dict[str, int] = {}
        """Of each node that is registered or awaited: a number that is another one after each change of it."""
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

    def apis(self, kind: RegistrationKind, key: str) -> list[str]:
        """The slave APIs registered for a key, in order."""
        return list(self._tables[kind].get(key, {}).values())

    def at(self, kind: RegistrationKind, key: str) -> dict[str, str]:
        """The nodes registered for a key, in order, and their slave APIs; never changed afterwards."""
        return self._tables[kind].get(key, _NOBODY)

    def param_subscribers(self) -> dict[str, dict[str, str]]:
        """Subscribed parameters (keys end in ``/``), each with its nodes and their APIs; not to be changed."""
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
        """All keys of a kind, each with its nodes and their slave APIs; not to be changed."""
        return list(self._tables[kind].items())

    def state(self) -> GraphState:
        """All registrations; the same object until something changes.

        What is in it is shared with the tables, so that a look at a graph of thousands costs microseconds.
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
        """Add a publisher and tell the topic's subscribers, also when it was there before.

        Clients rely on the repetition: it is what makes rospy connect again.
        """
        retyped = False
        if topic_type != ANY_TYPE or topic not in self._types:
            retyped = self._types.get(topic) != topic_type
            self._types[topic] = topic_type
        self._register(RegistrationKind.PUBLISHER, topic, node, api, retyped=retyped)
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
        """Tell this node of changes below ``key``, which ends in ``/``.

        A node that was pushed out does not take its name back by this, as it does at rosmaster, which then asks the
        new node to end (the one difference by intent; tests/interop/test_core_api.py shows both). roscpp does so: it
        logs that it was asked to end, and its log asks for a parameter with ``getCached``.
        """
        if self._evicted.get(node) != api:
            self._register(RegistrationKind.PARAM, key, node, api)

    def unregister(self, kind: RegistrationKind, key: str, node: str, api: str) -> bool:
        """Take a publisher, subscriber or parameter's subscriber away, if ``api`` is still that node's.

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
        """Take a service away, if its provider still is this node with this ``rosrpc://`` URI.

        Returns:
            Whether it was so.
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
        """Take everything of a dead node away and tell the subscribers of its topics.

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

    # --- nodes of the run before ------------------------------------------------------------------------------

    def record(self, node: str) -> NodeRecord | None:
        """Everything that a node has registered, and what an awaited one had."""
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
        """Remember a node of the run before; nothing shows it. Its topics have their types again."""
        self.unverified.add(node, record)
        for topic, topic_type in [*record.publishers.items(), *record.subscribers.items()]:
            self._types.setdefault(topic, topic_type)
        self._state = None
        self._mark_changed(node)

    def confirm(self, node: str) -> tuple[list[str], list[str]]:
        """Show an awaited node, which has answered. What others registered meanwhile stays theirs.

        Returns:
            The topics that it publishes and those that it subscribes to: ``announce`` and ``tell`` them.
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
        """Tell one subscriber who publishes a topic."""
        api = self.at(RegistrationKind.SUBSCRIBER, topic).get(node)
        if api is not None:
            publishers = self._publishers(topic, awaited=node in self._restored)
            self.effects.append(PublisherUpdate(api, topic, publishers))

    def discard(self, node: str) -> None:
        """Forget an awaited node, and tell those that may be connected to it."""
        record = self.unverified.pop(node)
        if record is not None:
            self._mark_changed(node)
            for topic in record.publishers:
                self._notify_subscribers(topic, self._restored.__contains__)

    def notify_new_subscribers(self, topic: str) -> None:
        """Tell the subscribers of a topic that do not know those of its publishers that were taken up."""
        self._notify_subscribers(topic, lambda node: node not in self._restored)

    def _withdraw(self, kind: RegistrationKind, key: str, node: str, api: str) -> bool:
        """Take a registration of an awaited node away; whether it was there."""
        if not self.unverified.withdraw(kind, key, node, api):
            return False
        record = self.unverified.get(node)
        if record is not None and not any(record.of(kind) for kind in RegistrationKind):
            self.unverified.pop(node)
        self._mark_changed(node)
        return True

    def _mark_changed(self, node: str) -> None:
        """What is to be kept of a node has changed."""
        if node in self._nodes or self.unverified.get(node) is not None:
            self._revision += 1
            self.revisions[node] = self._revision
        else:
            self.revisions.pop(node, None)
            self._restored.discard(node)

    # --- the tables -------------------------------------------------------------------------------------------

    def _claim_name(self, node: str, api: str) -> _Node:
        """The node's record; a node of the same name at another URI is pushed out with all it had."""
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
            # Its place in the order of nodes stays, as rosmaster has it.
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

    def _publishers(self, topic: str, *, awaited: bool) -> tuple[str, ...]:
        """The slave APIs of a topic's publishers, with or without those of the run before."""
        apis = self.apis(RegistrationKind.PUBLISHER, topic)
        more = self.unverified.publishers(topic) if awaited else ()
        return tuple(dict.fromkeys([*apis, *more])) if more else tuple(apis)

    def _notify_subscribers(self, topic: str, which: Callable[[str], bool] | None = None) -> None:
        """Tell the subscribers of a topic who publishes it, or only those nodes for which ``which`` says so.

        Who was taken up is connected to publishers that have not answered yet, and would hang up on them.
        """
        known = self._publishers(topic, awaited=False)
        old = self._publishers(topic, awaited=True)
        told: dict[str, tuple[str, ...]] = {}
        for node, api in self.at(RegistrationKind.SUBSCRIBER, topic).items():
            if api not in told and (
                which is None or which(node)
            ):  # nodelets of one process share an API: it is told once
                told[api] = old if node in self._restored else known
        self.effects += [PublisherUpdate(api, topic, publishers) for api, publishers in told.items()]
