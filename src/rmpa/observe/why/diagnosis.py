"""What ``rmpa why`` is made of: the stages of a path, what the peers tell of it, and transports in words."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final, Self

import msgspec

from rmpa.config.peer_rules import Access
from rmpa.core.facts import PublisherReport  # noqa: TC001 - msgspec needs it to decode
from rmpa.observe.check import FAIL, OK, WARN, Check
from rmpa.trust.permissions import prohibition, refusal

if TYPE_CHECKING:
    from collections.abc import Iterable

    from rmpa.core.facts import RouteInfo, SubscriberTransport

# The stage of what the publisher's (server's) module lets this one do.
PERMISSION_THERE: Final = "permission there"
# The stage of what this module lets that of the publisher (server) do.
PERMISSION_HERE: Final = "permission here"

# The last stage of a path that nothing uses: no node subscribes, so nothing is sent.
UNASKED: Final = "demand"


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
    denied = permission_there(found.to, found.peer, Access.PUBLISH, found.name)
    allowed = Check(PERMISSION_HERE, OK, f"{found.to} lets {found.peer} publish it")
    ruled = ((stage, stage.name == PERMISSION_HERE) for stage in found.stages)
    shown = (stage if not by_rule else denied if stage.level is FAIL else allowed for stage, by_rule in ruled)
    return msgspec.structs.replace(found, stages=tuple(shown))


def until_failure(stages: Iterable[Check]) -> tuple[Check, ...]:
    """The stages up to the first that fails; later ones are not evaluated."""
    walked = []
    for stage in stages:
        walked.append(stage)
        if stage.level is FAIL:
            break
    return tuple(walked)


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


class ServiceAtServer(msgspec.Struct, frozen=True, kw_only=True):
    """What the server's agent knows of a service; its answer to ``why.service``.

    Attributes:
        node: The node of its module that provides the service; empty if none does.
        service: The service's name in its own graph.
        crosses: Whether the policy of its module lets it cross to the agent that asks.
        rule: The rule that says so.
        refusal: Why the server did not answer its own agent's probe, or empty.
        similar: A service of that module with nearly this name, or empty; ``near`` on the wire.
        permitted: Whether the permissions of its module let the module that asks call it; ``None``: trust is off
            there. If not, nothing else is told, also not whether there is such a service.
    """

    node: str = ""
    service: str = ""
    crosses: bool = True
    rule: str = ""
    refusal: str = ""
    similar: str = msgspec.field(default="", name="near")
    permitted: bool | None = None


# The transport of routes and of their subscribers in words, for the command line, ``rmpa why`` and health. Pure.


# ``Condition.MEASURES``: the subscriber is a tool of RMPA, and relayed on purpose.
BY_TOOL: Final = "measures"
# ``Condition.TRANSPORT``: the contract of one end says ``relay``.
BY_RULE: Final = "transport"
# What a user may do about some of the conditions; the others say it themselves, or pass.
_REMEDIES: Final = {
    "contract": 'take these terms out of [[contract]], or set its transport to "relay"',
    "name": "leave it out of prefix and remap of the [[peer]]",
    "listening": "start the publisher without ROS_IP and ROS_HOSTNAME, or with an address of that network",
    "subscriber": "start the subscriber without ROS_IP and ROS_HOSTNAME, or with an address of that network",
    "caller_id": "give one of both nodes another name",
    "reachable": "see that TCP gets through from this machine to the ports of nodes on that machine (a firewall?)",
    "latched": "start the subscriber again",
    "trust": "trust.direct = true in both modules allows it, on a trusted network (docs/guides/trust.md#permissions)",
}
# In place of figures.
UNMEASURED: Final = "not measured: the nodes are connected directly"
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
    reason = _reason(one.condition, one.text)
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
        return [f"relayed: {_reason(route.condition, route.condition_text)}"]
    return []


def _reason(condition: str, text: str) -> str:
    """Why something is relayed, with the word of the condition; a setting's text says all."""
    return f"{text} (condition {condition})" if condition not in ("", "transport") else text


def remedy_for(one: SubscriberTransport) -> str:
    """What to do about a subscriber that is relayed, or has to be."""
    if one.transport == "direct":
        return (
            "if it lasts, give the agent CAP_NET_ADMIN (docs/guides/direct-transport.md#cap_net_admin), "
            "or restart that subscriber"
        )
    return _REMEDIES.get(one.condition, "docs/guides/contracts.md explains the conditions")


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


def connected_directly(route: RouteInfo) -> list[SubscriberTransport]:
    """The subscribers of a route that were answered the publisher's own address."""
    return [one for one in route.subscribers if one.transport == "direct"]


def judge_peer_clock(agent: str, peer: str, offset: float, error: float | None) -> Check:
    """Whether two modules' clocks agree well enough for tf and message filters; both in seconds."""
    bound = f" ±{error * 1e3:.1f} ms" if error is not None else ""
    text = f"{peer}'s clock is {abs(offset) * 1e3:.1f} ms{bound} {'ahead of' if offset > 0 else 'behind'} ours"
    if abs(offset) - (error or 0.0) <= 0.02:  # two periods of a 100 Hz transform
        return Check("clock", OK, text, where=f"{agent}-{peer}")
    remedy = "let both follow one clock (chrony); until then tf says 'extrapolation into the future'"
    return Check("clock", WARN, text, remedy, where=f"{agent}-{peer}")
