"""The connection graph that a Foxglove client is told: which nodes publish, subscribe and serve what."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from rmpa.web.foxglove.protocol import AdvertisedService, ConnectionGraphUpdate, PublishedTopic, SubscribedTopic

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Mapping

    from rmpa.web.hub.requests import GraphChanged

_UNCHANGED: Final = ConnectionGraphUpdate(
    published_topics=(), subscribed_topics=(), advertised_services=(), removed_topics=(), removed_services=()
)


class ConnectionGraph:
    """The graph as one client has been told it; ``update`` is what differs since."""

    def __init__(self) -> None:
        self._publishers: dict[str, tuple[str, ...]] = {}
        self._subscribers: dict[str, tuple[str, ...]] = {}
        self._providers: dict[str, tuple[str, ...]] = {}

    def update(self, graph: GraphChanged) -> ConnectionGraphUpdate | None:
        """The changes that lead to this graph; ``None`` without any. A topic without nodes counts as removed."""
        publishers = {topic.name: topic.publishers for topic in graph.topics if topic.publishers}
        subscribers = {topic.name: topic.subscribers for topic in graph.topics if topic.subscribers}
        providers = {service.name: service.providers for service in graph.services}
        before = self._publishers.keys() | self._subscribers.keys()
        removed = before - publishers.keys() - subscribers.keys()
        update = ConnectionGraphUpdate(
            published_topics=tuple(
                PublishedTopic(name=name, publisher_ids=ids)
                for name, ids in _changed(self._publishers, publishers, removed)
            ),
            subscribed_topics=tuple(
                SubscribedTopic(name=name, subscriber_ids=ids)
                for name, ids in _changed(self._subscribers, subscribers, removed)
            ),
            advertised_services=tuple(
                AdvertisedService(name=name, provider_ids=ids)
                for name, ids in _changed(self._providers, providers, self._providers.keys() - providers.keys())
            ),
            removed_topics=tuple(sorted(removed)),
            removed_services=tuple(sorted(self._providers.keys() - providers.keys())),
        )
        self._publishers, self._subscribers, self._providers = publishers, subscribers, providers
        return update if update != _UNCHANGED else None


def _changed(
    before: Mapping[str, tuple[str, ...]], now: Mapping[str, tuple[str, ...]], removed: Iterable[str]
) -> Iterator[tuple[str, tuple[str, ...]]]:
    """Entries that are new or differ, and with no node those that ended while their name remains in the graph."""
    yield from ((name, ids) for name, ids in now.items() if before.get(name) != ids)
    gone = before.keys() - now.keys() - set(removed)
    yield from ((name, ()) for name in sorted(gone))
