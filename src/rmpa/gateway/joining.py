"""Which session a gateway opens and which neighbours it has, by its settings."""

from __future__ import annotations

from typing import TYPE_CHECKING

from rmpa.core.errors import StartError
from rmpa.gateway.zenoh.config import ZenohConfig, ZenohMode
from rmpa.gateway.zenoh.session import open_session

if TYPE_CHECKING:
    from rmpa.config.gateway_rules import GatewaySettings
    from rmpa.config.settings import Settings
    from rmpa.gateway.gateway import OwnedSession
    from rmpa.gateway.neighbour import Neighbour, OwnGraph
    from rmpa.gateway.zenoh_api import ZenohSession


def zenoh_config(settings: GatewaySettings) -> ZenohConfig:
    """What the session is opened with.

    Raises:
        StartError: The session would not be encrypted, and ``insecure`` is not set.
    """
    endpoints = (*settings.connect, *settings.listen)
    if not settings.insecure and not all(_is_on_this_machine(endpoint) for endpoint in endpoints):
        raise StartError(
            f"zenoh {', '.join(endpoints)}",
            "this module has no certificates for it",
            "say --insecure to join without them",
        )
    mode = ZenohMode.ROUTER if settings.router else ZenohMode.PEER if settings.listen else ZenohMode.CLIENT
    return ZenohConfig(mode, settings.connect, settings.listen)


async def open_gateway_session(settings: Settings) -> OwnedSession:
    """Open the session that the settings ask for.

    Raises:
        StartError: It may not be opened, an address is taken, or no router answers.
    """
    return await open_session(zenoh_config(settings.gateway))


def make_neighbours(graph: OwnGraph, session: ZenohSession, settings: Settings) -> dict[str, Neighbour]:
    """Make the neighbours that the settings ask for, by their names; they are not started.

    Raises:
        ConfigError: A setting of one is wrong.
    """
    neighbours: dict[str, Neighbour] = {}
    gateway = settings.gateway
    if gateway.ros2.enabled:
        from rmpa.gateway.ros2.io.neighbour import Ros2Neighbour  # noqa: PLC0415 - it reads all types of ROS
        from rmpa.gateway.ros2.io.services import Ros2Services  # noqa: PLC0415 - likewise

        neighbours["ros2"] = Ros2Neighbour(graph, session, gateway, (Ros2Services(),), settings.make_contracts())
    return neighbours


def _is_on_this_machine(endpoint: str) -> bool:
    """Whether an endpoint such as ``tcp/127.0.0.1:7447`` is on loopback."""
    host = endpoint.partition("/")[2].rpartition(":")[0]
    return host == "localhost" or host.startswith("127.") or host == "[::1]"
