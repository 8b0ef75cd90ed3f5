"""The services of modules in ROS 2's graph, and ROS 2's services in the gateway's graph."""

from __future__ import annotations

from collections import Counter
from typing import TYPE_CHECKING

from rmpa.gateway.neighbour import SourceKind
from rmpa.gateway.ros2.io.offered_service import OfferedService
from rmpa.gateway.ros2.io.shown_service import ShownRos2Service
from rmpa.gateway.ros2.service_pair import ros2_without_use
from rmpa.gateway.ros2.tokens import EntityKind

if TYPE_CHECKING:
    from rmpa.gateway.neighbour import MeshSource
    from rmpa.gateway.ros2.io.part import Ros2Context
    from rmpa.gateway.ros2.tokens import Ros2Endpoint


class Ros2Services:
    """Joins services both ways. Of several servers of one name the first is called, as in each of the graphs."""

    def __init__(self, context: Ros2Context) -> None:
        self._context = context
        self._offered: dict[str, list[OfferedService]] = {}
        self._shown: dict[str, ShownRos2Service] = {}
        self._counts: Counter[str] = Counter()

    def mesh_source(self, source: MeshSource, *, there: bool) -> bool:
        """Offer a service of a module to ROS 2, or take it back."""
        if source.kind is not SourceKind.SERVICE:
            return False
        if not there:
            self._withdraw(source)
        elif self._context.crossing.outgoing(source.module, source.name).allowed:
            services = self._offered.setdefault(source.here, [])
            services.append(OfferedService(self._context, source, self._counts))
            services[0].start()
        return True

    def endpoint(self, endpoint: Ros2Endpoint, *, there: bool) -> bool:
        """Show a service of ROS 2 in the gateway's graph, or take it out."""
        if endpoint.kind is not EntityKind.SERVICE:
            return False
        if ros2_without_use(endpoint.name, endpoint.type):
            self._counts["without_use"] += there
            return True
        shown = self._shown.get(endpoint.name)
        if there and shown is None:
            self._show(endpoint)
        elif not there and shown is not None and shown.server == endpoint:
            self._replace(endpoint)
        return True

    def close(self) -> None:
        """Take back all services of both sides."""
        for services in self._offered.values():
            for each in services:
                each.close()
        for shown in self._shown.values():
            shown.close()
        self._offered.clear()
        self._shown.clear()

    def report(self) -> dict[str, object]:
        """The services that are joined, and counts of calls, errors and refusals."""
        return {
            "services_in": {name: each.server.type for name, each in self._shown.items()},
            "service_calls": dict(self._counts),
        }

    # --- inside -----------------------------------------------------------------------------------------------------

    def _withdraw(self, source: MeshSource) -> None:
        services = self._offered.get(source.here, [])
        for each in services:
            if each.source == source:
                services.remove(each)
                each.close()
                break
        if services:
            services[0].start()
        else:
            self._offered.pop(source.here, None)

    def _show(self, endpoint: Ros2Endpoint) -> None:
        if (here := self._context.crossing.name_here(endpoint.name)) is not None:
            self._shown[endpoint.name] = shown = ShownRos2Service(self._context, endpoint, here, self._counts)
            shown.start()

    def _replace(self, gone: Ros2Endpoint) -> None:
        """A server is gone: the next of that name takes its place."""
        self._shown.pop(gone.name).close()
        others = self._context.ros2.at(gone.name, EntityKind.SERVICE)
        if (other := next((each for each in others if not ros2_without_use(each.name, each.type)), None)) is not None:
            self._show(other)
