"""The stages of ``rmpa why`` for subscribers that are connected to the publisher directly. Pure.

Their messages do not pass the agents: after the transport there is the connection alone.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from rmpa.observe.check import OK, WARN, Check
from rmpa.observe.transport_text import UNMEASURED, fallbacks, remedy, route_texts, stuck

if TYPE_CHECKING:
    from rmpa.observe.snapshot import RouteInfo, SubscriberTransport


def connected_directly(route: RouteInfo) -> list[SubscriberTransport]:
    """The subscribers of a route that were answered the publisher's own address."""
    return [one for one in route.subscribers if one.transport == "direct"]


def transport(route: RouteInfo) -> Check:
    """The transport of each subscriber, and by which condition it is relayed. It is never the stage that fails."""
    text = "; ".join(route_texts(route)) or "relayed"
    troubled = [*stuck(route), *fallbacks(route)]
    if troubled:
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
