"""The publishers of a topic in the local graph, each with its own type, as input of the exports."""

from __future__ import annotations

from typing import TYPE_CHECKING

from rmpa.bridge.messages import Source
from rmpa.bridge.policy import is_own
from rmpa.bridge.topics.exports import LocalSource
from rmpa.core.identity import is_type_name
from rmpa.ros.master.parameters import RegistrationKind

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from rmpa.bridge.relay import Relay
    from rmpa.ros.core.api import Core
    from rmpa.ros.master.parameters import GraphChange
    from rmpa.ros.master.registrations import Unreachable


class LocalSources:
    """The core's publishers, each with the type that it registered itself.

    The master keeps one type for each topic, the last one registered; peers need the type of each publisher.

    Args:
        core: The local core.
        relay: Knows which proxies are offered to other modules.
        flows: Whether the agent is connected to a source; such a source counts as reachable, whatever the core found.
    """

    def __init__(self, core: Core, relay: Relay, flows: Callable[[Source], bool] = lambda _: False) -> None:
        self._core = core
        self._flows = flows
        self._relay = relay
        self._types: dict[Source, str] = {}

    def changed(self, change: GraphChange) -> None:
        """Remembers the type of a publisher that registers; forgets it when the publisher leaves."""
        if change.kind is RegistrationKind.PUBLISHER:
            if is_own(change.node) and not self._relay.enabled:
                return  # thousands of proxies, whose types only a relay needs
            source = Source(change.name, change.node)
            if not change.added:
                self._types.pop(source, None)
            elif is_type_name(change.type):
                self._types[source] = change.type

    def of(self, topic: str) -> dict[str, LocalSource]:
        """This module's own publishers of a topic, by node, without those that cannot be reached."""
        unreachable = self._core.unreachable()
        nodes = {
            node: uri
            for node, uri in self._core.publishers(topic).items()
            if not is_own(node) and not (node in unreachable and self._withdrawn(unreachable[node], topic, node))
        }
        said = self._core.type_of(topic) if nodes else ""
        return {node: LocalSource(self._type(topic, node, said), uri) for node, uri in nodes.items()}

    def relayed(self, topic: str) -> dict[str, LocalSource]:
        """The proxies of a topic that this agent relays, by node, with their origin; empty if it is no relay."""
        if not self._relay.enabled:
            return {}
        said = self._core.type_of(topic)
        publishers: Mapping[str, str] = self._core.publishers(topic)
        return {
            node: LocalSource(self._type(topic, node, said), uri, origin)
            for node, uri in publishers.items()
            if (origin := self._relay.origin((topic, node))) is not None
        }

    def _withdrawn(self, found: Unreachable, topic: str, node: str) -> bool:
        return found.withdrawn and not self._flows(Source(topic, node))

    def _type(self, topic: str, node: str, otherwise: str) -> str:
        return self._types.get(Source(topic, node)) or otherwise
