"""The parts of the neighbour ROS 2: each joins topics, services or actions, both ways."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, Protocol

from rmpa.bridge.policy import Needs
from rmpa.ros.types.definitions import known_types

if TYPE_CHECKING:
    from collections.abc import Callable, Coroutine

    from rmpa.config.rules import GatewaySettings
    from rmpa.core.contract import Contracts
    from rmpa.gateway.graph.own_graph import AgentGraph
    from rmpa.gateway.neighbour import MeshSource
    from rmpa.gateway.ros2.crossing import Ros2Crossing
    from rmpa.gateway.ros2.graph import Ros2Graph
    from rmpa.gateway.ros2.io.own_nodes import OwnRos2Nodes
    from rmpa.gateway.ros2.io.type_asker import Ros2TypeAsker
    from rmpa.gateway.ros2.mapping import TypeMapping
    from rmpa.gateway.ros2.tokens import Ros2Endpoint
    from rmpa.gateway.ros2.types import Ros2Types
    from rmpa.gateway.zenoh.session import OpenSession


SERVICE_NEEDS: Final = Needs(
    (),
    "`[[gateway.rule]]` for `ros2` alone: ROS 2 has no permissions",
    key="services and actions of ROS 2",
)


@dataclass(frozen=True, slots=True)
class Ros2Context:
    """What the parts share.

    Args:
        graph: The gateway's own graph.
        session: The Zenoh session.
        settings: The table ``[gateway]``.
        contracts: The contracts of topics, for their QoS.
        types: The types of ROS 2's distribution, and those that were learnt.
        mapping: The rules of the mapping files.
        crossing: Which sources cross, and under which name.
        nodes: Declares our nodes and endpoints in ROS 2's graph, and gives their GIDs.
        ros2: ROS 2's graph; what this gateway declares is not in it.
        asker: Asks nodes of ROS 2 for types that are not known here.
        spawn: Runs a coroutine in the background; it is cancelled when the neighbour closes.
        say: Logs a problem once, and keeps it for ``report``: what it is about, and the text. An empty text: solved.
    """

    graph: AgentGraph
    session: OpenSession
    settings: GatewaySettings
    contracts: Contracts
    types: Ros2Types
    mapping: TypeMapping
    crossing: Ros2Crossing
    nodes: OwnRos2Nodes
    ros2: Ros2Graph
    asker: Ros2TypeAsker
    spawn: Callable[[Coroutine[None, None, None]], None]
    say: Callable[[str, str], None]

    def ros1_name(self, name: str) -> str:
        """The name of ROS 1 for a message type of ROS 2, ``package/msg/Name``."""
        return self.mapping.ros1_message(name, known_types())


class Ros2Part(Protocol):
    """One part. All is called in the event loop. The first part that takes a source or an endpoint has it."""

    def mesh_source(self, source: MeshSource, *, there: bool) -> bool:
        """A source of a module appeared or is gone. Rules were not looked at.

        Returns:
            Whether this part takes it: then no other part is told.
        """

    def endpoint(self, endpoint: Ros2Endpoint, *, there: bool) -> bool:
        """An endpoint of a ROS 2 node appeared or is gone.

        Returns:
            Whether this part takes it: then no other part is told.
        """

    def close(self) -> None:
        """Take back everything that was declared."""

    def report(self) -> dict[str, object]:
        """What ``rmpa site`` and the snapshot show of it, as JSON values."""
