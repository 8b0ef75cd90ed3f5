"""What ``rmpa why`` is made of: stages, what both ends know, and why a topic is direct or relayed.

What ``rmpa why`` is made of: the stages of a path, and what the agents at its two ends know.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, Self

import msgspec

from rmpa.config.peer_rules import Access
from rmpa.observe.peer_info import FAIL, OK, WARN, Check
from rmpa.trust.permissions import prohibition, refusal

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

    from rmpa.observe.snapshot import RouteInfo, Snapshot, SubscriberTransport

PERMISSION_THERE: Final = "permission there"
"""The stage of what the publisher's (server's) module lets this one do."""
PERMISSION_HERE: Final = "permission here"
"""The stage of what this module lets that of the publisher (server) do."""

UNASKED: Final = "demand"
"""The last stage of a path that nothing uses: no node subscribes, so nothing is sent."""


class Diagnosis(msgspec.Struct, frozen=True, kw_only=True):
    """The path of a topic (service) from its publisher (server) in one module to its users in another.

    Attributes:
        kind: ``topic``, ``service`` or ``module``.
        name: Its name in the graph of the module that diagnoses.
        peer: The module of the publisher (server).
        to: The module of the users.
        node: The publisher (server), by its name in its own module; empty where there is none.
        flows: Whether messages (calls) get through, or would if a node subscribed (``unasked``).
        stages: From the peer to the reader, up to the first that fails.
    """

    kind: str = "topic"
    name: str
    peer: str
    to: str
    node: str = ""
    flows: bool
    stages: tuple[Check, ...]

    @classmethod
    def of(
        cls, stages: tuple[Check, ...], *, name: str, peer: str, to: str, node: str = "", kind: str = "topic"
    ) -> Self:
        """The diagnosis that follows from the stages: it flows if none of them fails."""
        flows = all(stage.level is not FAIL for stage in stages)
        return cls(kind=kind, name=name, peer=peer, to=to, node=node, flows=flows, stages=stages)

    @property
    def unasked(self) -> bool:
        """Whether nothing is sent because no node subscribes."""
        return bool(self.stages) and self.stages[-1].name == UNASKED

    @property
    def failed(self) -> Check | None:
        """The first stage that fails."""
        return next((stage for stage in self.stages if stage.level is FAIL), None)


def permission_there(peer: str, to: str, access: Access, name: str) -> Check:
    """The stage that fails because a peer does not let this module do something: it does not say by which rule.

    Args:
        peer: The peer.
        to: This module.
        access: What it may not do.
        name: The topic or service, by its name at the peer.
    """
    text = refusal(access, to, name, f"of {peer}")
    remedy = f"allow it by a [[permission]] in the rmpa.toml of {peer}; `rmpa trust check {to} {access} {name}` there"
    return Check(PERMISSION_THERE, FAIL, text, f"{remedy} names the rule")


def permission_here(peer: str, access: Access, name: str, rule: str) -> Check:
    """The stage that fails because this module does not let a peer do something.

    Args:
        peer: The peer, or the relay by which it comes.
        access: What the module may not do.
        name: The topic or service, by its name here.
        rule: The rule that forbids it.
    """
    remedy = "change [[permission]] in this module's rmpa.toml, and `rmpa reload`"
    return Check(PERMISSION_HERE, FAIL, f"{prohibition(access, peer, name)} here: {rule}", remedy)


def without_rules(found: Diagnosis) -> Diagnosis:
    """A diagnosis for the peer whose topic it is: whether it may publish, but not by which rule."""
    return msgspec.structs.replace(
        found,
        stages=tuple(_outcome(found, stage) if stage.name == PERMISSION_HERE else stage for stage in found.stages),
    )


def _outcome(found: Diagnosis, stage: Check) -> Check:
    if stage.level is FAIL:
        return permission_there(found.to, found.peer, Access.PUBLISH, found.name)
    return Check(stage.name, OK, f"{found.to} lets {found.peer} publish it")


def until_failure(stages: Iterable[Check]) -> tuple[Check, ...]:
    """The stages up to the first that fails; later ones are not evaluated."""
    walked = []
    for stage in stages:
        walked.append(stage)
        if stage.level is FAIL:
            break
    return tuple(walked)


class PublisherReport(msgspec.Struct, frozen=True, kw_only=True):
    """One publisher, as its own agent sees it.

    Attributes:
        node: Its name.
        topic: The topic's name in its own graph.
        type: Its message type; ``*`` where it is not known.
        crosses: Whether the policy of its module lets it cross to the agent that asks.
        rule: The rule that says so.
        offered: Whether peers are offered it.
        route: The state of the route to the agent that asks: empty (none), ``opening`` (the publisher has not
            answered) or ``open``.
        messages: Messages received from the publisher since its agent connected to it.
        dropped: Of these, those that were dropped because a link was too slow.
        lost: Messages of a reliable route to the agent that asks that were given up after too long an outage.
        oversized: Messages that are too long, and were left out.
        oversized_bytes: The length of the last of these, in bytes.
        beyond: ``limits.topics`` of its module, if it is not offered because there are more; else 0.
        unreachable: Why its agent cannot connect to it, ready to read; empty where it can.
    """

    node: str
    topic: str = ""
    type: str = ""
    crosses: bool = True
    rule: str = ""
    offered: bool = True
    route: str = ""
    messages: int = 0
    dropped: int = 0
    lost: int = 0
    oversized: int = 0
    oversized_bytes: int = 0
    beyond: int = 0
    unreachable: str = ""


class TopicAtPublisher(msgspec.Struct, frozen=True, kw_only=True):
    """What the publisher's agent knows of a topic; its answer to ``why.topic``.

    Attributes:
        sources: The publishers of the topic in its own module.
        subscribers: The subscribers in its own module.
        similar: A topic of that module with nearly this name, or empty; ``near`` on the wire.
        permitted: Whether the permissions of its module let the module that asks subscribe; ``None``: trust is off
            there. If not, nothing else is told, also not whether there is such a topic.
    """

    sources: tuple[PublisherReport, ...] = ()
    subscribers: tuple[str, ...] = ()
    similar: str = msgspec.field(default="", name="near")
    permitted: bool | None = None


class SubscriberConnection(msgspec.Struct, frozen=True, kw_only=True):
    """A local subscriber's connection to a proxy.

    Attributes:
        number: The proxy's number for the connection.
        node: The subscriber's name.
        held: Whether it waits for the header, because the route is not open yet.
        messages: Messages handed to the connection, including dropped ones.
        waiting: Bytes in its queue.
        dropped: Messages dropped because the subscriber read too slowly.
    """

    number: int
    node: str
    held: bool = False
    messages: int = 0
    waiting: int = 0
    dropped: int = 0


@dataclass(frozen=True, slots=True)
class ProxyState:
    """What the subscribers' agent knows of the proxy for one publisher.

    Args:
        name: The proxy's name.
        registered: Whether it is a publisher of the topic in the local graph.
        permission: The rule by which the module may publish it here, or may not; empty: trust is off.
        denied: Whether it may not.
        conflict: Whether the publisher's type differs from that of the local publishers.
        connections: Those of local subscribers.
        mismatches: The subscribers that were refused here or at the peer, ready to read.
    """

    name: str = ""
    registered: bool = False
    permission: str = ""
    denied: bool = False
    conflict: bool = False
    connections: tuple[SubscriberConnection, ...] = ()
    mismatches: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class TopicAtSubscriber:
    """What the subscribers' agent knows of a topic of one peer.

    Args:
        snapshot: The agent's, of this topic at least.
        topic: The topic's name here.
        carrier: The peer whose link carries it; another one where a relay passes it on.
        proxies: Those of the peer's publishers, by the publisher's name; ``None`` without a link.
    """

    snapshot: Snapshot
    topic: str
    carrier: str = ""
    proxies: Mapping[str, ProxyState] | None = None

    def proxy(self, node: str) -> ProxyState:
        """The proxy for a publisher."""
        return (self.proxies or {}).get(node, ProxyState())


@dataclass(frozen=True, slots=True)
class BothEnds:
    """What is known at both ends of a topic's path at one moment.

    Args:
        here: At the subscribers' agent.
        there: At the publisher's agent; ``None`` if it did not answer.
        refusal: Why it did not.
    """

    here: TopicAtSubscriber
    there: TopicAtPublisher | None = None
    refusal: str = ""


# The transport of routes and of their subscribers in words, for the command line, ``rmpa why`` and health. Pure.


BY_TOOL: Final = "measures"
"""``Condition.MEASURES``: the subscriber is a tool of RMPA, and relayed on purpose."""
BY_RULE: Final = "transport"
"""``Condition.TRANSPORT``: the contract of one end says ``relay``."""
_REMEDIES: Final = {
    "contract": 'take these terms out of [[contract]], or set its transport to "relay"',
    "name": "leave it out of prefix and remap of the [[peer]]",
    "listening": "start the publisher without ROS_IP and ROS_HOSTNAME, or with an address of that network",
    "subscriber": "start the subscriber without ROS_IP and ROS_HOSTNAME, or with an address of that network",
    "caller_id": "give one of both nodes another name",
    "reachable": "see that TCP gets through from this machine to the ports of nodes over there (a firewall?)",
    "latched": "start the subscriber again",
    "trust": "trust.direct = true in both modules allows it, where the network is trusted (docs/permissions.md)",
}
"""What a user may do about some of the conditions; the others say it themselves, or pass."""
REMEDY: Final = "docs/contracts.md explains the conditions"
UNMEASURED: Final = "not measured: the nodes are connected directly"
"""In place of figures."""
_STAYS_DIRECT: Final = (
    "if it stays so, give the agent CAP_NET_ADMIN (docs/systemd.md), or start that subscriber again"
)
_WAITS: Final = {
    "asking": "the peer's agent is asked for a direct connection, and its node is tried",
    "direct": "it may connect directly, and has not asked for the topic yet",
}
_MOVES: Final = {
    "asking": "the peer's agent is asked whether it may be direct",
    "direct": "it is moved to a direct connection",
}


def subscriber_text(one: SubscriberTransport, since: str = "") -> str:
    """The transport of one subscriber: ``direct to 10.0.0.2:41234 for /viewer (3 min)``.

    Args:
        one: The subscriber.
        since: For how long, as text.
    """
    node = f"{one.node} ({since})" if since else one.node
    reason = f"{one.text} (condition {one.condition})" if one.condition else one.text
    if one.state == "granted":
        return f"direct for {node}, to port {one.endpoint} of this machine"
    if one.transport == "direct":
        text = f"direct to {one.endpoint} for {node}"
        return f"{text}, has to be relayed: {reason}" if one.state == "relayed" else text
    if one.transport == "relay":
        return f"relayed for {node}: {reason or _MOVES.get(one.state, one.state)}"
    if one.state == "relayed":
        return f"relayed for {node}, once it connects: {reason}"
    return f"none yet for {node}: {_WAITS.get(one.state, one.state)}"


def route_texts(route: RouteInfo) -> list[str]:
    """The transport of a route: one text for each subscriber that has, or may get, a direct connection."""
    if route.subscribers:
        return [subscriber_text(one) for one in route.subscribers]
    if route.transport == "relay" and route.condition:
        return [f"relayed: {route.condition_text} (condition {route.condition})"]
    return []


def remedy(one: SubscriberTransport) -> str:
    """What to do about a subscriber that is relayed, or has to be."""
    return _STAYS_DIRECT if one.transport == "direct" else _REMEDIES.get(one.condition, REMEDY)


def misplaced(route: RouteInfo) -> list[SubscriberTransport]:
    """The subscribers that are direct and have to be relayed, or relayed although their contract says ``direct``.

    Without those that are relayed by a rule, or because RMPA's own tools measure.
    """
    return [
        one
        for one in route.subscribers
        if one.state == "relayed"
        and (one.transport == "direct" or (one.wanted == "direct" and one.condition not in {BY_RULE, BY_TOOL}))
    ]


# The stages of ``rmpa why`` for subscribers that are connected to the publisher directly. Pure.
#
# Their messages do not pass the agents: after the transport there is the connection alone.


def connected_directly(route: RouteInfo) -> list[SubscriberTransport]:
    """The subscribers of a route that were answered the publisher's own address."""
    return [one for one in route.subscribers if one.transport == "direct"]


def transport(route: RouteInfo) -> Check:
    """The transport of each subscriber, and by which condition it is relayed. It is never the stage that fails."""
    text = "; ".join(route_texts(route)) or "relayed"
    if troubled := misplaced(route):
        return Check("transport", WARN, text, remedy(troubled[0]))
    return Check("transport", OK, text)


def connection(route: RouteInfo) -> Check:
    """The direct subscribers of a route; their agent looks each second whether the connections stand."""
    text = ", ".join(f"{one.node} is connected to {one.endpoint}" for one in connected_directly(route))
    return Check("connection", OK, f"{text}; {UNMEASURED}")


def adrift_stages(link: Check, route: RouteInfo) -> tuple[Check, ...]:
    """Judge the direct subscribers of a peer whose agent has died: their messages go on without it.

    Args:
        link: The stage of the link, which fails.
        route: The route.
    """
    text = f"{link.text}; without its agent only what is connected directly goes on"
    return (
        Check("link", WARN, text, f"start the agent of {route.peer} again: it takes the direct connections over"),
        transport(route),
        connection(route),
    )
