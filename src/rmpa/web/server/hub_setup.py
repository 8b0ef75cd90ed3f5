"""The hub of ``rmpa web``: its node joins the core of the agent that the server shows."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from rmpa.core.contract import Priority
from rmpa.core.errors import UnreachableError
from rmpa.ros.node.node import Node
from rmpa.web.hub.hub import Hub
from rmpa.web.hub.rights import EVERYTHING

if TYPE_CHECKING:
    from collections.abc import Callable

    from rmpa.core.contract import Contracts
    from rmpa.ros.wire.xmlrpc import XmlRpcValue
    from rmpa.web.hub.rights import NodeRules
    from rmpa.web.server.agent_watch import AgentWatch

_DEFAULT_PORT: Final = 8480
_PRIORITIES: Final = {Priority.HIGH: 1, Priority.NORMAL: 0, Priority.LOW: -1}


def make_hub(watch: AgentWatch, port: int, rules: NodeRules = EVERYTHING) -> Hub:
    """A hub whose master is the agent's.

    Args:
        watch: Gives the agent's snapshot.
        port: The server's; each server of one core has a node of its own.
        rules: What the node may do.
    """
    name = "rmpa_web" if port == _DEFAULT_PORT else f"rmpa_web_{port}"

    async def where() -> str:
        reading = await watch.reading()
        if reading.snapshot is None:
            raise UnreachableError("agent", "its control socket", reading.problem)
        return reading.snapshot.agent.core_uri

    def make_node(uri: str, updated: Callable[[str, XmlRpcValue], None]) -> Node:
        return Node(name, master_uri=uri, on_param_update=updated)

    return Hub(where, make_node, rules=rules)


def priority_of(hub: Hub, contracts: Contracts) -> Callable[[str], int]:
    """The priority of a topic's messages, by its contract."""

    def priority(topic: str) -> int:
        known = hub.graph.topics.get(topic)
        type_ = known.types[0] if known is not None and known.types else ""
        return _PRIORITIES[contracts.of(topic, type_).priority]

    return priority
