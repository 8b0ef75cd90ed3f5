"""Makes the neighbour ROS 2 with all its parts, and has it answer for itself."""

from __future__ import annotations

from typing import TYPE_CHECKING

from rmpa.gateway.ros2.io.actions import Ros2Actions
from rmpa.gateway.ros2.io.answers import Ros2Answers
from rmpa.gateway.ros2.io.neighbour import Ros2Neighbour
from rmpa.gateway.ros2.io.services import Ros2Services
from rmpa.gateway.ros2.io.topics import Ros2Topics

if TYPE_CHECKING:
    from rmpa.config.peer_rules import Access
    from rmpa.config.settings import Settings
    from rmpa.gateway.graph.own_graph import AgentGraph
    from rmpa.gateway.zenoh.session import OpenSession


def make_ros2_neighbour(graph: AgentGraph, session: OpenSession, settings: Settings) -> Ros2Neighbour:
    """Make the neighbour, after that of the sites if there is one; it is not started.

    Raises:
        ConfigError: A setting of it is wrong.
    """
    agent = graph.agent
    parts = (Ros2Actions, Ros2Services, Ros2Topics)
    neighbour = Ros2Neighbour(graph, session, settings.gateway, parts, settings.make_contracts())
    sites = agent.sites.answerer if settings.gateway.site else None
    gate = agent.bridge.gate

    def may(asker: str, access: Access, name: str) -> bool:
        return not asker or gate.judge(access, asker, name).allowed

    agent.sites.serve(Ros2Answers(settings.name, neighbour, lambda: session.endpoints, sites, may))
    return neighbour
