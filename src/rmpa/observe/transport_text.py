"""The transport of routes and of their subscribers in words, for the command line, ``rmpa why`` and health. Pure."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from rmpa.observe.snapshot import RouteInfo, SubscriberTransport

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
STUCK_REMEDY: Final = "give the agent CAP_NET_ADMIN (docs/systemd.md), or start that subscriber again"
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
        if one.stuck:
            return f"{text}, has to be relayed, but its connection cannot be ended ({one.stuck}): {reason}"
        if one.state == "relayed":
            return f"{text}, is moved to the relayed transport: {reason}"
        return text
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
    """What to do about a subscriber that is relayed, or cannot be."""
    return STUCK_REMEDY if one.stuck else _REMEDIES.get(one.condition, REMEDY)


def fallbacks(route: RouteInfo) -> list[SubscriberTransport]:
    """The subscribers that are relayed although their module's contract says ``direct``; without those by rule."""
    return [
        one
        for one in route.subscribers
        if one.wanted == "direct" and one.state == "relayed" and one.condition not in {BY_RULE, BY_TOOL}
    ]


def stuck(route: RouteInfo) -> list[SubscriberTransport]:
    """The subscribers whose direct connection cannot be ended although they have to be relayed."""
    return [one for one in route.subscribers if one.stuck]
