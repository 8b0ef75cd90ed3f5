"""The conditions of direct transport: each one that fails is a reason to relay. Pure.

docs/contracts.md lists them for users.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from typing import TYPE_CHECKING, Final

from rmpa.bridge.messages import is_crossing_name
from rmpa.core.contract import Transport, needs_agents
from rmpa.core.errors import RemoteProtocolError

if TYPE_CHECKING:
    from rmpa.bridge.permission_gate import PermissionGate
    from rmpa.core.contract import Contract

_TEXT_MAX: Final = 300
"""Characters of a peer's text that are kept."""


class Condition(StrEnum):
    """A condition of direct transport; its value is the word in ``--json`` and between agents."""

    TRANSPORT = "transport"
    """The transport of the contract, or of the service's rule, is not ``relay``."""
    CONTRACT = "contract"
    """The contract asks for nothing that only agents do."""
    NAME = "name"
    """The topic or service has the same name in both modules: TCPROS headers carry it."""
    OWN_SOURCE = "own_source"
    """The source is the peer's own, and does not come by a relay."""
    ACTION = "action"
    """It is no topic whose publisher compares the names of its subscribers."""
    RELEASE = "release"
    """The peer's agent knows direct transport."""
    AGENT = "agent"
    """The peer's agent answers in time."""
    OFFERED = "offered"
    """The peer offers the topic or service now."""
    NODE = "node"
    """The publisher's node answers its agent."""
    LISTENING = "listening"
    """The publisher's node listens where the subscriber's module can reach it, not only on loopback."""
    REACHABLE = "reachable"
    """A connection from the subscriber's module to the publisher's node works."""
    CALLER_ID = "caller_id"
    """No other subscriber of the same name is connected to the publisher."""
    SUBSCRIBER = "subscriber"
    """The subscriber's node connects to other machines (ROS_IP and ROS_HOSTNAME do not bind it to loopback)."""
    MEASURES = "measures"
    """The subscriber is no tool that measures by the agents."""
    LATCHED = "latched"
    """No latched message would be delivered twice by the move."""
    STABLE = "stable"
    """Direct connections of this subscriber have not broken repeatedly."""
    LIMIT = "limit"
    """The peer's direct connections are within ``limits.DIRECT_MAX``."""
    TRUST = "trust"
    """The mesh is not secured, or both modules let plain connections cross (``trust.direct``), or share a machine."""
    CORE = "core"
    """The local core can answer each node by itself: services only."""


_PASSING: Final = frozenset({Condition.AGENT, Condition.NODE, Condition.REACHABLE, Condition.STABLE, Condition.LIMIT})


@dataclass(frozen=True, slots=True)
class Unmet:
    """A condition that does not hold, and the fact as text for the user."""

    condition: Condition
    text: str

    @property
    def lasting(self) -> bool:
        """Whether only a change that is noticed can make it hold, so that trying again by time is of no use."""
        return self.condition not in _PASSING


NO_LINK: Final = Unmet(Condition.OFFERED, "its module has no link")
"""What holds while there is no link."""


@dataclass(frozen=True, slots=True)
class Grant:
    """A peer's permission to connect to one of its nodes.

    Args:
        port: The node's TCPROS port; the address is that of the link.
        node: The node's name in the peer's graph.
        probe: A service of the node, by which it is probed; empty: none is known.
    """

    port: int
    node: str
    probe: str = ""


def read_reply(value: object, node: str) -> Grant | Unmet:
    """Read the response of a peer to ``direct.open`` or ``direct.service``.

    Args:
        value: What the peer sent.
        node: The node that was asked for.

    Raises:
        RemoteProtocolError: It is neither a port nor a reason.
    """
    if isinstance(value, dict):
        port, probe = value.get("port"), value.get("probe", "")
        if isinstance(port, int) and not isinstance(port, bool) and 0 < port < 1 << 16 and isinstance(probe, str):
            return Grant(port, node, probe if is_crossing_name(probe) else "")
        why, text = value.get("why"), value.get("text", "")
        if isinstance(why, str) and isinstance(text, str):
            return read_unmet(why, text)
    raise RemoteProtocolError("the answer about a direct connection has neither a port nor a reason")


def read_unmet(why: str, text: str) -> Unmet:
    """Read a condition that a peer names; one of a later release counts as ``RELEASE``. The text is safe to show."""
    try:
        condition = Condition(why)
    except ValueError:
        condition = Condition.RELEASE
    return Unmet(condition, "".join(one if one.isprintable() else "�" for one in text[:_TEXT_MAX]))


def reply_of(found: Grant | Unmet) -> dict[str, object]:
    """The response to a peer's ``direct.open`` or ``direct.service``."""
    if isinstance(found, Grant):
        return {"port": found.port, "probe": found.probe}
    return {"why": found.condition.value, "text": found.text}


def unmet_by_trust(gate: PermissionGate, where: str, *, same_machine: bool) -> Unmet | None:
    """The condition that a secured mesh does not meet, if any.

    Args:
        gate: Whether the mesh is secured, and whether plain connections are let all the same.
        where: Whose setting that is, as text.
        same_machine: Whether both modules are on one machine, so that the connection does not leave it.
    """
    if gate.plain or same_machine:
        return None
    text = f"the mesh is secured, and nothing would protect the connection; trust.direct is false in {where}"
    return Unmet(Condition.TRUST, text)


def unmet_by_contract(contract: Contract, where: str) -> Unmet | None:
    """The condition that a contract does not meet, if any.

    Args:
        contract: The contract.
        where: Whose it is, as text.
    """
    if contract.transport is Transport.RELAY:
        return Unmet(Condition.TRANSPORT, f'transport is "relay" in {where}')
    terms = needs_agents(contract)
    return Unmet(Condition.CONTRACT, f"the contract asks for what only agents do: {terms}") if terms else None
