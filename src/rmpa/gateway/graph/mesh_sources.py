"""The sources of the modules at this site, as the gateway's core and relay know them."""

from __future__ import annotations

import asyncio
import logging
from typing import TYPE_CHECKING

from rmpa.bridge.messages import is_crossing_name, is_crossing_type
from rmpa.bridge.policy import Policy, is_outside, is_own, service_place
from rmpa.bridge.topics.local import LocalSources
from rmpa.core.counters import logged_failure
from rmpa.gateway.neighbour import MeshSource, SourceKind
from rmpa.ros.master.parameters import RegistrationKind
from rmpa.runtime.loop import yielding_to_data

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable

    from rmpa.agent.agent import Agent
    from rmpa.config.settings import Settings
    from rmpa.ros.master.parameters import GraphChange

_log = logging.getLogger(__name__)

SourceKey = tuple[SourceKind, str, str]
"""Kind, name here, and node here."""
OnChange = "Callable[[MeshSource, bool], None]"

_ANY = "*"


class MeshSources:
    """Follows the gateway's graph, and reports which sources of the mesh there are.

    A source counts if the gateway's own policy lets it cross. What a neighbour has brought here, through this gateway
    or another one of this site, does not count.

    Args:
        agent: The gateway's agent.
        settings: Its settings.
    """

    def __init__(self, agent: Agent, settings: Settings) -> None:
        self._name = settings.name
        self._core = agent.core
        self._relay = agent.bridge.relay
        self._topics = agent.bridge.topics
        self._services = agent.services
        self._local = LocalSources(agent.core, agent.bridge.relay)
        self._policy = Policy(settings.policy, settings.peers, settings.time)
        self.known: dict[SourceKey, MeshSource] = {}
        """The sources that were reported."""
        self._by_name: dict[tuple[SourceKind, str], dict[SourceKey, MeshSource]] = {}
        self._watchers: list[Callable[[MeshSource, bool], None]] = []
        self._changed: dict[tuple[SourceKind, str], None] = {}
        self._soon: asyncio.Handle | None = None
        self._begun = False

    def watch(self, on_change: Callable[[MeshSource, bool], None]) -> None:
        """Report each source that is there, then each change."""
        self._watchers.append(on_change)
        for source in list(self.known.values()):
            on_change(source, True)

    def unwatch(self, kept: Callable[[MeshSource, bool], None]) -> None:
        """Report to one watcher alone."""
        self._watchers = [kept]

    def begin(self) -> None:
        """Begin to report; the agent's place in the network is known."""
        self._begun = True
        self.look_at_all()

    def close(self) -> None:
        """Report nothing more."""
        self._begun = False
        self._watchers.clear()
        if self._soon is not None:
            self._soon.cancel()
            self._soon = None

    def reload(self, settings: Settings) -> None:
        """Take other rules."""
        self._policy = Policy(settings.policy, settings.peers, settings.time)
        self.look_at_all()

    def changed(self, change: GraphChange) -> None:
        """Have a name examined that was registered or unregistered."""
        self._local.changed(change)
        if change.kind is RegistrationKind.PUBLISHER:
            self._look((SourceKind.TOPIC, change.name))
        elif change.kind is RegistrationKind.SERVICE:
            self._look((SourceKind.SERVICE, change.name))

    def look_at_all(self) -> None:
        """Have every name examined."""
        state = self._core.state()
        for names in (
            [(SourceKind.TOPIC, topic) for topic in state.publishers],
            [(SourceKind.SERVICE, service) for service in state.services],
            list(self._by_name),
        ):
            for name in names:
                self._look(name)

    def _look(self, name: tuple[SourceKind, str]) -> None:
        self._changed[name] = None
        if self._begun and self._soon is None:
            self._soon = asyncio.get_running_loop().call_soon(self._examine)

    def _examine(self) -> None:
        self._soon = None
        changed, self._changed = self._changed, {}
        for kind, name in yielding_to_data(list(changed), every=16):
            found = self._topic(name) if kind is SourceKind.TOPIC else self._service(name)
            self._replace((kind, name), {(kind, name, source.proxy): source for source in found})

    def _replace(self, name: tuple[SourceKind, str], found: dict[SourceKey, MeshSource]) -> None:
        before = self._by_name.pop(name, {})
        if found:
            self._by_name[name] = found
        for key, source in before.items():
            if found.get(key) != source:
                del self.known[key]
                self._tell(source, there=False)
        for key, source in found.items():
            if before.get(key) != source:
                self.known[key] = source
                self._tell(source, there=True)

    def _tell(self, source: MeshSource, *, there: bool) -> None:
        for on_change in tuple(self._watchers):
            with logged_failure(_log, "a neighbour failed at %s; the others are told", source):
                on_change(source, there)

    def _topic(self, topic: str) -> Iterable[MeshSource]:
        for node, local in self._local.of(topic).items():
            if self._may_cross(topic, local.type, node):
                yield MeshSource(
                    SourceKind.TOPIC, self._name, self._relay.instance, node, topic, local.type, topic, node
                )
        for proxy, local in self._local.relayed(topic).items():
            shown = self._relay.source((topic, proxy))
            if local.origin is None or shown is None or is_outside(local.origin):
                continue
            if self._may_cross(topic, local.type, local.origin.node):
                origin, wire = local.origin, shown[1].topic
                yield MeshSource(
                    SourceKind.TOPIC, origin.name, origin.instance, origin.node, wire, local.type, topic, proxy
                )

    def _may_cross(self, topic: str, type_name: str, node: str) -> bool:
        known = is_crossing_name(topic) and is_crossing_name(node) and is_crossing_type(type_name)
        return known and self._policy.judge(topic, type_name, node).allowed

    def _service(self, service: str) -> Iterable[MeshSource]:
        for node in self._core.state().services.get(service, {}):
            if not is_own(node):
                if is_crossing_name(service) and self._services.rules.judge(service, node).allowed:
                    yield MeshSource(
                        SourceKind.SERVICE, self._name, self._relay.instance, node, service, _ANY, service, node
                    )
                continue
            origin, shown = (self._relay.origin(place := service_place(service, node)), self._relay.source(place))
            if origin is None or shown is None or is_outside(origin):
                continue
            if is_crossing_name(service) and self._services.rules.judge(service, origin.node).allowed:
                remote = self._services.imports.get(shown[0], service)
                wire = remote.wire if remote is not None else service
                yield MeshSource(
                    SourceKind.SERVICE, origin.name, origin.instance, origin.node, wire, _ANY, service, node
                )
