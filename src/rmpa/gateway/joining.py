"""Which session a gateway opens and which neighbours it has, by its settings."""

from __future__ import annotations

from typing import TYPE_CHECKING

from rmpa.gateway.zenoh.trust import open_trusted_session

if TYPE_CHECKING:
    from rmpa.config.settings import Settings
    from rmpa.gateway.graph.own_graph import AgentGraph
    from rmpa.gateway.neighbour import Neighbour
    from rmpa.gateway.zenoh_api import OwnedSession


async def open_gateway_session(settings: Settings) -> OwnedSession:
    """Open the session that the settings ask for.

    Raises:
        StartError: It may not be opened, an address is taken, or no router answers.
    """
    return await open_trusted_session(settings)


def make_neighbours(graph: AgentGraph, session: OwnedSession, settings: Settings) -> dict[str, Neighbour]:
    """Make the neighbours that the settings ask for, by their names; they are not started.

    Raises:
        ConfigError: A setting of one is wrong.
    """
    neighbours: dict[str, Neighbour] = {}
    gateway = settings.gateway
    if gateway.site:
        from rmpa.gateway.sites.io.joining import make_site_neighbour  # noqa: PLC0415 - not every gateway needs it

        neighbours["sites"] = make_site_neighbour(graph, session, settings, graph.agent)
    if gateway.ros2.enabled:
        from rmpa.gateway.ros2.io.joining import make_ros2_neighbour  # noqa: PLC0415 - it reads all types of ROS

        neighbours["ros2"] = make_ros2_neighbour(graph, session, settings)
    return neighbours
