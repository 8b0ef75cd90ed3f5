"""The part of the neighbour "other sites" that lets actions work: clients accept a server by the names of its nodes.

The five topics of an action cross as all topics do. But a client of actionlib waits for a node that publishes the
status *and* listens to goals and cancellations (``bridge.topics.audience``). The gateway listens to these for all
other sites, by one connection. So it opens one more for each server of another site, under the server's name here.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from rmpa.bridge.topics.subscribers import is_watched
from rmpa.gateway import limits
from rmpa.gateway.neighbour import SourceKind
from rmpa.gateway.sites.part import SitePart

if TYPE_CHECKING:
    from collections.abc import Callable

    from rmpa.gateway.graph.taps import TopicTap
    from rmpa.gateway.neighbour import ForeignSource, MeshSource
    from rmpa.gateway.sites.part import SiteExport, SiteImport

_STATUS: Final = "actionlib_msgs/GoalStatusArray"


class SiteActions(SitePart):
    """Names the action servers of other sites to clients of this one: a ``SitePart``.

    Args:
        attend: Listens to a topic under the name of a foreign node: ``AgentGraph.attend``.
    """

    name = "actions"

    def __init__(self, attend: Callable[[MeshSource, ForeignSource], TopicTap]) -> None:
        self._attend = attend
        self._clients: dict[MeshSource, str] = {}
        """The topics of goals and cancellations of this site, with the action's name."""
        self._offered: dict[MeshSource, set[str]] = {}
        """The sites that each of them is offered to; empty text: all."""
        self._servers: dict[ForeignSource, str] = {}
        """The topics of status of other sites, likewise."""
        self._listening: dict[tuple[MeshSource, ForeignSource], TopicTap] = {}

    def export(self, entry: SiteExport) -> None:
        """A client of this site sends goals or cancellations."""
        source = entry.source
        if source.kind is not SourceKind.TOPIC or not is_watched(source.type):
            return
        self._offered.setdefault(source, set()).add(entry.announced.to)
        if source not in self._clients:
            self._clients[source] = _action(source.here)
            for server, action in self._servers.items():
                self._join(source, server, action)

    def withdraw(self, entry: SiteExport) -> None:
        """It has gone."""
        sites = self._offered.get(entry.source, set())
        sites.discard(entry.announced.to)
        if not sites and self._clients.pop(entry.source, None) is not None:
            self._offered.pop(entry.source, None)
            self._leave(lambda client, _: client == entry.source)

    def show(self, entry: SiteImport) -> None:
        """A server of another site publishes its status."""
        source = entry.source
        if source.kind is SourceKind.TOPIC and source.type == _STATUS:
            action = self._servers[source] = _action(source.name)
            for client in self._clients:
                self._join(client, source, action)

    def hide(self, entry: SiteImport) -> None:
        """It has gone."""
        if self._servers.pop(entry.source, None) is not None:
            self._leave(lambda _, server: server == entry.source)

    async def close(self) -> None:
        """Listen no more."""
        self._leave(lambda _client, _server: True)

    def _join(self, client: MeshSource, server: ForeignSource, action: str) -> None:
        if self._clients[client] == action and len(self._listening) < limits.SITE_ACTIONS_MAX:
            self._listening[client, server] = self._attend(client, server)

    def _leave(self, which: Callable[[MeshSource, ForeignSource], bool]) -> None:
        for pair in [pair for pair in self._listening if which(*pair)]:
            self._listening.pop(pair).close()


def _action(topic: str) -> str:
    """The action that a topic belongs to: ``/arm/move`` for ``/arm/move/goal``."""
    return topic.rpartition("/")[0]
