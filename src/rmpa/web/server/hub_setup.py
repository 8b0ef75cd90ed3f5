"""The hub of ``rmpa web``: its node joins the core of the agent that the server shows."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Final

from rmpa.core.contract import Priority
from rmpa.core.errors import UnreachableError
from rmpa.ros.node.node import Node
from rmpa.web.hub.hub import Hub
from rmpa.web.hub.rights import FULL, READ_ONLY, Rights

if TYPE_CHECKING:
    from collections.abc import Callable

    from rmpa.core.contract import Contracts
    from rmpa.ros.wire.xmlrpc import XmlRpcValue
    from rmpa.web.server.agent_watch import AgentWatch

_DEFAULT_PORT: Final = 8480
_PRIORITIES: Final = {Priority.HIGH: 1, Priority.NORMAL: 0, Priority.LOW: -1}


def make_hub(watch: AgentWatch, port: int) -> Hub:
    """A hub whose master is the agent's.

    Args:
        watch: Gives the agent's snapshot.
        port: The server's; each server of one core has a node of its own.
    """
    name = "rmpa_web" if port == _DEFAULT_PORT else f"rmpa_web_{port}"

    async def where() -> str:
        reading = await watch.reading()
        if reading.snapshot is None:
            raise UnreachableError("agent", "its control socket", reading.problem)
        return reading.snapshot.agent.core_uri

    def make_node(uri: str, updated: Callable[[str, XmlRpcValue], None]) -> Node:
        return Node(name, master_uri=uri, on_param_update=updated)

    return Hub(where, make_node)


def rights_of(*, has_token: bool, control: bool, drive: bool = False) -> Rights:
    """What clients may do.

    Args:
        has_token: Whether all clients have shown a token: without one parameters and files are not read either.
        control: Whether they may change anything.
        drive: Whether the monitor's joystick may command a robot.
    """
    if not has_token:
        return READ_ONLY
    return replace(FULL if control else Rights(read_parameters=True, fetch_assets=True), drive=drive)


def priority_of(hub: Hub, contracts: Contracts) -> Callable[[str], int]:
    """The priority of a topic's messages, by its contract."""

    def priority(topic: str) -> int:
        known = hub.graph.topics.get(topic)
        type_ = known.types[0] if known is not None and known.types else ""
        return _PRIORITIES[contracts.of(topic, type_).priority]

    return priority
