"""What two agents say of one direct connection: the question, the grant, and each condition that fails as a reason.

docs/guides/contracts.md lists the conditions for users, docs/design/protocol.md has examples of the messages. Topics
and services have the same three: ``direct.topic`` or ``direct.service`` asks, ``…_again`` makes the asking side ask
again, ``…_release`` gives a grant back.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from typing import TYPE_CHECKING, Annotated, Any, Final, NamedTuple

import msgspec

from rmpa.bridge import limits
from rmpa.bridge.messages import Name, NameOrNone, convert, is_crossing_name
from rmpa.core.contract import Contract, Transport, needs_agents
from rmpa.core.errors import RemoteProtocolError

if TYPE_CHECKING:
    from rmpa.bridge.bridge import Bridge
    from rmpa.bridge.messages import Origin
    from rmpa.bridge.sessions import PeerSession


class Condition(StrEnum):
    """A condition of direct transport; its value is the word in ``--json`` and between agents.

    Attributes:
        TRANSPORT: The transport of the contract, or of the service's rule, is not ``relay``.
        CONTRACT: The contract asks for nothing that only agents do.
        NAME: The topic or service has the same name in both modules: TCPROS headers carry it.
        OWN_SOURCE: The source is the peer's own, and does not come by a relay.
        ACTION: It is no topic whose publisher compares the names of its subscribers.
        RELEASE: The peer's agent knows direct transport.
        AGENT: The peer's agent answers in time.
        OFFERED: The peer offers the topic or service now.
        NODE: The publisher's node answers its agent.
        LISTENING: The publisher's node listens where the subscriber's module can reach it, not only on loopback.
        REACHABLE: A connection from the subscriber's module to the publisher's node works.
        CALLER_ID: No other subscriber of the same name is connected to the publisher.
        SUBSCRIBER: The subscriber's node connects to other machines (ROS_IP and ROS_HOSTNAME do not bind it to
            loopback).
        MEASURES: The subscriber is no tool that measures by the agents.
        LATCHED: No latched message would be delivered twice by the move.
        STABLE: Direct connections of this subscriber have not broken repeatedly.
        LIMIT: The peer's direct connections are within ``limits.DIRECT_MAX``.
        TRUST: The mesh is not secured, or both modules let plain connections cross (``trust.direct``), or share a
            machine.
        CORE: The local core can answer each node by itself: services only.
    """

    TRANSPORT = "transport"
    CONTRACT = "contract"
    NAME = "name"
    OWN_SOURCE = "own_source"
    ACTION = "action"
    RELEASE = "release"
    AGENT = "agent"
    OFFERED = "offered"
    NODE = "node"
    LISTENING = "listening"
    REACHABLE = "reachable"
    CALLER_ID = "caller_id"
    SUBSCRIBER = "subscriber"
    MEASURES = "measures"
    LATCHED = "latched"
    STABLE = "stable"
    LIMIT = "limit"
    TRUST = "trust"
    CORE = "core"


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


# What holds while there is no link.
NO_LINK: Final = Unmet(Condition.OFFERED, "its module has no link")


class Grant(NamedTuple):
    """A peer's permission to connect to one of its nodes.

    Args:
        port: The node's TCPROS port; the address is that of the link.
        node: The node's name in the peer's graph.
        probe: A service of the node, by which it is probed; empty: none is known.
    """

    port: int
    node: str
    probe: str = ""


def unmet_by_contract(contract: Contract, where: str) -> Unmet | None:
    """The condition that a contract does not meet, if any.

    Args:
        contract: The contract.
        where: Whose it is, as text.
    """
    if contract.transport is Transport.RELAY:
        return Unmet(Condition.TRANSPORT, f'the setting transport = "relay" of {where} asks for it')
    terms = needs_agents(contract)
    return Unmet(Condition.CONTRACT, f"the contract asks for what only agents do: {terms}") if terms else None


def unmet_by_rules(
    contract: Contract, bridge: Bridge, peer: PeerSession, where: str, owner: str, other: str, origin: Origin | None
) -> Unmet | None:
    """The condition that is not met by what both sides of topics and services judge alike, if any.

    Args:
        contract: That of the side that judges; of a service the transport alone.
        bridge: Whether the mesh is secured, and whether plain connections are let all the same.
        peer: The peer: on one machine a connection does not leave it.
        where: Whose rules these are, as text.
        owner: The owner's module, as text.
        other: The name that the topic or service has there, if it is another one here; else empty.
        origin: The module that a relayed one belongs to.
    """
    if (unmet := unmet_by_contract(contract, where)) is not None:
        return unmet
    if not (bridge.context.gate.plain or peer.same_machine):
        text = f"the mesh is secured, and nothing would protect the connection; trust.direct is false in {where}"
        return Unmet(Condition.TRUST, text)
    if origin is not None:
        return Unmet(Condition.OWN_SOURCE, f"it is {origin.name}'s, and comes by a relay")
    return Unmet(Condition.NAME, f"it is {other} in {owner}") if other else None


class Want(NamedTuple):
    """What is to be reached directly.

    Args:
        name: The topic or service, by its name on the wire.
        node: The node that publishes or provides it.
        user: The subscribing node; empty: a service, for every node of the asking module.
    """

    name: str
    node: str
    user: str = ""


class DirectAsk(msgspec.Struct, frozen=True, omit_defaults=True):
    """May this be reached directly? A notification has the fields of ``Want`` alone.

    Args:
        name: As in ``Want``.
        node: As in ``Want``.
        user: As in ``Want``.
        contract: What the subscriber's module asks for; topics only.
        broken: Whether an earlier connection ended by itself, so that the publisher may be dead.
    """

    name: Name
    node: Name
    user: NameOrNone = ""
    contract: Contract | None = None
    broken: bool = False

    @property
    def want(self) -> Want:
        """What is asked for."""
        return Want(self.name, self.node, self.user)


def read_ask(args: dict[str, Any]) -> DirectAsk:
    """Read and validate a question or a notification.

    Raises:
        RemoteProtocolError: A name or a value is invalid.
    """
    return convert("direct transport", args, DirectAsk)


class _Reply(msgspec.Struct, frozen=True):
    """The answer of the owner's agent: a port, or a reason."""

    port: Annotated[int, msgspec.Meta(gt=0, lt=1 << 16)] | None = None
    probe: str = ""
    why: str | None = None
    text: str = ""


def read_reply(value: object, node: str) -> Grant | Unmet:
    """Read the answer of a peer. A reason's text is safe to show; one of a later release counts as ``RELEASE``.

    Args:
        value: What the peer sent.
        node: The node that was asked for.

    Raises:
        RemoteProtocolError: It is neither a port nor a reason.
    """
    reply = convert("direct transport", value, _Reply)
    if reply.port is not None:
        return Grant(reply.port, node, reply.probe if is_crossing_name(reply.probe) else "")
    if reply.why is None:
        raise RemoteProtocolError("direct transport: an answer has neither a port nor a reason")
    condition = Condition(reply.why) if reply.why in set(Condition) else Condition.RELEASE
    return Unmet(condition, "".join(one if one.isprintable() else "�" for one in reply.text[:300]))


def reply_of(found: Grant | Unmet) -> dict[str, object]:
    """The answer to a peer."""
    if isinstance(found, Grant):
        return {"port": found.port, "probe": found.probe}
    return {"why": found.condition.value, "text": found.text}


# When a subscriber was without its direct path, by the peer's name and what is reached: how often, when the last time
# began, and when it ended (``None``: it lasts), monotonic seconds. It outlasts links. What was published meanwhile is
# lost to it, and not counted.
Interruptions = dict[tuple[str, Want], tuple[int, float, float | None]]


def interrupted(known: Interruptions, peer: str, want: Want, now: float, *, lasts: bool) -> None:
    """Note that a path is gone (``lasts``), or that a subscriber has one again, direct or relayed."""
    count, began, ended = known.pop((peer, want), (0, now, now))
    if lasts and ended is not None:
        count, began, ended = count + 1, now, None
    elif not lasts and ended is None:
        ended = now
    if count:
        known[peer, want] = count, began, ended
    if len(known) > limits.DIRECT_MAX:
        del known[next(iter(known))]
