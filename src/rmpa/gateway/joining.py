"""Which session a gateway opens and which neighbours it has, by its settings."""

from __future__ import annotations

from typing import TYPE_CHECKING

from rmpa.gateway.zenoh.trust import open_trusted_session

if TYPE_CHECKING:
    from rmpa.config.settings import Settings
    from rmpa.gateway.gateway import OwnedSession
    from rmpa.gateway.graph.own_graph import AgentGraph
    from rmpa.gateway.neighbour import Neighbour


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
        from rmpa.gateway.ros2.io.actions import Ros2Actions  # noqa: PLC0415 - likewise
        from rmpa.gateway.ros2.io.answers import Ros2Answers  # noqa: PLC0415 - likewise
        from rmpa.gateway.ros2.io.neighbour import Ros2Neighbour  # noqa: PLC0415 - it reads all types of ROS
        from rmpa.gateway.ros2.io.services import Ros2Services  # noqa: PLC0415 - likewise
        from rmpa.gateway.ros2.io.topics import Ros2Topics  # noqa: PLC0415 - likewise

        parts = (Ros2Actions(), Ros2Services(), Ros2Topics())
        neighbours["ros2"] = ros2 = Ros2Neighbour(graph, session, gateway, parts, settings.make_contracts())
        requests = graph.agent.sites
        sites = requests.answerer if gateway.site else None
        requests.serve(Ros2Answers(settings.name, ros2, lambda: session.endpoints, sites))
    return neighbours
