"""Changes of the local graph as clients of the control socket get them: all of it, or what has changed since.

A client may wait for the next change. A row is the present state of one topic or service, so it does not matter how
often it changed meanwhile. The history has names alone; the rows are read from the graph when a client asks.
"""

from __future__ import annotations

import asyncio
import contextlib
import itertools
import secrets
from collections import deque
from typing import TYPE_CHECKING, Any, Final

import msgspec

from rmpa.core.errors import ConfigError
from rmpa.observe import limits
from rmpa.ros.master.parameters import GraphChange, GraphState, RegistrationKind

if TYPE_CHECKING:
    from collections.abc import Iterable

    from rmpa.ros.core.external import Core

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


# Each revision is an integer that all programs read exactly from JSON, and no two agents begin near each other.
_REVISION_BITS: Final = 52


class GraphHistory:
    """Which topics and services have changed at the last ``limits.GRAPH_HISTORY`` revisions.

    A row is the present state of one topic or service, so it does not matter how often it changed meanwhile. The
    history has names alone, and is kept while clients ask for rows: without one, a change of the graph costs nothing.

    Args:
        revision: The first one.
    """

    def __init__(self, revision: int) -> None:
        # The present one: stands for the present local graph.
        self.revision = revision
        self._changes: deque[tuple[RegistrationKind, str]] | None = None
        self._asked = 0

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
        whole = not 0 <= behind <= len(self._changes)
        topics: Iterable[str] = sorted(state.publishers.keys() | state.subscribers.keys()) if whole else ()
        services: Iterable[str] = sorted(state.services) if whole else ()
        if not whole:
            recent = dict.fromkeys(itertools.islice(reversed(self._changes), behind))
            topics = dict.fromkeys(name for kind, name in recent if kind is not RegistrationKind.SERVICE)
            services = [name for kind, name in recent if kind is RegistrationKind.SERVICE]
        publishers, subscribers, types = state.publishers, state.subscribers, state.types
        return GraphRows(
            whole=whole,
            topics=tuple(
                TopicRow(name, types.get(name, ""), tuple(publishers.get(name, ())), tuple(subscribers.get(name, ())))
                for name in topics
            ),
            services=tuple(ServiceRow(name, tuple(state.services.get(name, ()))) for name in services),
        )


class GraphRevisions:
    """The revision of a core's graph: a number that every change of the graph replaces.

    Args:
        core: Tells the changes.
        rows: Whether clients get the changes themselves. Those of a core that is another program are known here later
            than there.
    """

    def __init__(self, core: Core, *, rows: bool) -> None:
        self._core = core
        self._rows = rows
        # Begins anywhere, so that a client takes the graph of an agent that was started again for another one.
        self._history = GraphHistory(secrets.randbits(_REVISION_BITS))
        self._changed = asyncio.Event()
        core.on_change(self._add)

    def _add(self, change: GraphChange) -> None:
        self._history.add(change)
        self._changed.set()

    async def after(self, args: dict[str, Any]) -> GraphRevision:
        """The revision, as soon as it differs from the one that the client knows.

        Args:
            args: ``after``: the known revision; ``wait``: the most seconds to wait for another one, 0 by default;
                ``rows``: true for what has changed since ``after``.

        Raises:
            ConfigError: An argument is out of range.
        """
        known, wait = args.get("after"), args.get("wait", 0)
        if not isinstance(wait, int | float) or not 0 <= wait <= limits.CONTROL_WAIT_MAX:
            raise ConfigError("wait", f"{wait!r} is not between 0 and {limits.CONTROL_WAIT_MAX:g} s")
        if known == self._history.revision:
            self._changed.clear()  # those who wait already were called when it was set
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(wait):
                    await self._changed.wait()
        if not self._rows or args.get("rows") is not True:
            return GraphRevision(revision=self._history.revision)
        rows = self._history.rows_since(known, self._core.state())
        return GraphRevision(revision=self._history.revision, core_uri=self._core.uri, rows=rows)
