"""The local graph as the control socket tells it: all of it, or the topics and services that have changed since.

A row is the present state of one topic or service, so it does not matter how often it changed meanwhile. The history
has names alone; the rows are read from the graph when a client asks.
"""

from __future__ import annotations

import itertools
from collections import deque
from typing import TYPE_CHECKING

import msgspec

from rmpa.observe import limits
from rmpa.ros.master.parameters import RegistrationKind

if TYPE_CHECKING:
    from collections.abc import Iterable

    from rmpa.ros.master.parameters import GraphChange, GraphState

_Nodes = tuple[str, ...]


class TopicRow(msgspec.Struct, frozen=True, array_like=True):
    """A topic as it is now; one without publishers and subscribers is gone.

    Attributes:
        name: Its name.
        type: The type last registered; ``*`` or empty where none is known.
        publishers: Names of nodes.
        subscribers: Likewise.
    """

    name: str
    type: str
    publishers: _Nodes
    subscribers: _Nodes


class ServiceRow(msgspec.Struct, frozen=True, array_like=True):
    """A service as it is now; one without providers is gone.

    Attributes:
        name: Its name.
        providers: Names of nodes.
    """

    name: str
    providers: _Nodes


class GraphRows(msgspec.Struct, kw_only=True, frozen=True, omit_defaults=True):
    """What a client has to know of the graph.

    Attributes:
        whole: Whether these are all topics and services; else those that have changed since the revision that the
            client knows.
        topics: Topics.
        services: Services.
    """

    whole: bool = False
    topics: tuple[TopicRow, ...] = ()
    services: tuple[ServiceRow, ...] = ()


class GraphRevision(msgspec.Struct, kw_only=True, frozen=True, omit_defaults=True):
    """The value of the operation ``graph``.

    Attributes:
        revision: Stands for the present local graph; another number stands for another graph.
        core_uri: The master whose graph it is; empty without ``rows``.
        rows: The graph, for a client that asked for rows. ``None`` where the core is another program, which can be
            read without the agent and knows its graph first; an older agent has none either.
    """

    revision: int
    core_uri: str = ""
    rows: GraphRows | None = None


class GraphHistory:
    """Which topics and services have changed at the last ``limits.GRAPH_HISTORY`` revisions.

    It is kept while clients ask for rows: without one, a change of the graph costs nothing.

    Args:
        revision: The first one.
    """

    def __init__(self, revision: int) -> None:
        self.revision = revision
        """The present one."""
        self._changes: deque[tuple[RegistrationKind, str]] | None = None
        self._asked = 0

    def __len__(self) -> int:
        """The number of revisions that are kept."""
        return len(self._changes or ())

    def add(self, change: GraphChange) -> None:
        """The graph has changed, which makes a new revision."""
        self.revision += 1
        if self._changes is None:
            return
        if self.revision - self._asked > limits.GRAPH_HISTORY:
            self._changes = None  # the client that asked last is too far behind by now, or has gone
        else:
            self._changes.append((change.kind, change.name))

    def rows_since(self, known: object, state: GraphState) -> GraphRows:
        """What has changed since a revision, or everything where the history does not reach back to it.

        Args:
            known: The revision that a client knows; ``None``, or anything that is not one of this agent: none.
            state: The present graph.
        """
        self._asked = self.revision
        if self._changes is None:
            self._changes = deque(maxlen=limits.GRAPH_HISTORY)
        behind = self.revision - known if type(known) is int else -1
        if not 0 <= behind <= len(self._changes):
            topics = state.publishers.keys() | state.subscribers.keys()
            return GraphRows(
                whole=True, topics=_topics(sorted(topics), state), services=_services(sorted(state.services), state)
            )
        recent = dict.fromkeys(itertools.islice(reversed(self._changes), behind))
        topics_changed = dict.fromkeys(name for kind, name in recent if kind is not RegistrationKind.SERVICE)
        services_changed = [name for kind, name in recent if kind is RegistrationKind.SERVICE]
        return GraphRows(topics=_topics(topics_changed, state), services=_services(services_changed, state))


def _topics(names: Iterable[str], state: GraphState) -> tuple[TopicRow, ...]:
    publishers, subscribers, types = state.publishers, state.subscribers, state.types
    return tuple(
        TopicRow(name, types.get(name, ""), tuple(publishers.get(name, ())), tuple(subscribers.get(name, ())))
        for name in names
    )


def _services(names: Iterable[str], state: GraphState) -> tuple[ServiceRow, ...]:
    return tuple(ServiceRow(name, tuple(state.services.get(name, ()))) for name in names)
