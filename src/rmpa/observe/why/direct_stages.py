"""The stages of ``rmpa why`` for subscribers that are connected to the publisher directly. Pure.

Their messages do not pass the agents: the two nodes' own counts show what was sent and what arrived::

    transport ─ connection ─ sent ─ arrived
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from rmpa.observe.check import FAIL, OK, UNKNOWN, WARN, Check
from rmpa.observe.transport_text import fallbacks, remedy, route_texts, stuck

if TYPE_CHECKING:
    from collections.abc import Iterator

    from rmpa.observe.check import CheckLevel
    from rmpa.observe.snapshot import RouteInfo, SubscriberTransport
    from rmpa.observe.why.diagnosis import PublisherReport

_SEVERAL: Final = 2
"""Messages that a publisher counts and a subscriber does not are a fault from here on: one may be on its way."""


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


def direct_stages(route: RouteInfo, report: PublisherReport | None, *, relayed: bool) -> Iterator[Check]:
    """Judge the direct subscribers of a route.

    Args:
        route: The route, as the subscribers' agent sees it last.
        report: Its publisher, as its own agent sees it last; ``None`` if that agent did not tell.
        relayed: Whether others are connected to the proxy, so that the topic may flow for these.
    """
    direct = connected_directly(route)
    bad = WARN if relayed else FAIL
    yield _connection(direct, bad)
    told = {one.node: one for one in report.direct} if report is not None else {}
    if not relayed:
        yield _sent(route, direct, told)
    yield _arrived(direct, told, bad)


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
        *direct_stages(route, None, relayed=False),
    )


def _connection(direct: list[SubscriberTransport], bad: CheckLevel) -> Check:
    missing = [one for one in direct if one.connected is False]
    if missing:
        text = ", ".join(f"{one.node} has no connection to {one.endpoint}" for one in missing)
        advice = "it is made again, or relayed, within seconds: ask again; if it stays so, see that node's log"
        return Check("connection", bad if len(missing) == len(direct) else WARN, text, advice)
    unknown = [one for one in direct if one.connected is None]
    if unknown:
        return Check(
            "connection", UNKNOWN, "; ".join(one.unmeasured or f"{one.node} was not asked" for one in unknown)
        )
    return Check("connection", OK, ", ".join(f"{one.node} is connected to {one.endpoint}" for one in direct))


def _sent(route: RouteInfo, direct: list[SubscriberTransport], told: dict[str, SubscriberTransport]) -> Check:
    known = [(one.node, at) for one in direct if (at := told.get(one.node)) is not None]
    counts = [(node, at.figures.messages) for node, at in known if at.figures is not None]
    counted = [(node, count) for node, count in counts if count is not None]
    if not counted:
        reasons = "; ".join(dict.fromkeys(at.unmeasured for _, at in known if at.unmeasured))
        return Check("sent", UNKNOWN, reasons or f"{route.node} does not tell what it has sent")
    if not any(count for _, count in counted):
        text = f"its publisher {route.node} is connected, and has published nothing since"
        return Check("sent", FAIL, text, f"look at that node; on {route.peer}: rostopic hz {route.wire or 'TOPIC'}")
    text = ", ".join(f"{count} messages to {node}" for node, count in counted)
    return Check("sent", OK, f"{text}, as {route.node} counts")


def _arrived(direct: list[SubscriberTransport], told: dict[str, SubscriberTransport], bad: CheckLevel) -> Check:
    found = [_arrived_at(one, told.get(one.node)) for one in direct]
    troubled = [check for check in found if check.level is not OK]
    if not troubled:
        return Check("arrived", OK, "; ".join(check.text for check in found))
    text = "; ".join(check.text for check in troubled)
    if all(check.level is FAIL for check in found):
        return Check("arrived", bad, text, troubled[0].remedy)
    level = WARN if any(check.level in (WARN, FAIL) for check in troubled) else UNKNOWN
    return Check("arrived", level, text, troubled[0].remedy)


def _arrived_at(one: SubscriberTransport, there: SubscriberTransport | None) -> Check:
    figures = one.figures
    if figures is None:
        advice = f"is it stopped or stuck? rosnode ping {one.node}"
        return Check(
            "arrived", WARN if one.silent else UNKNOWN, one.unmeasured or f"{one.node} was not asked", advice
        )
    count = f"{figures.bytes} bytes" if figures.messages is None else f"{figures.messages} messages"
    moved = figures.rate if figures.messages is not None else figures.bandwidth
    sent = there.figures if there is not None else None
    lately = sent.rate * sent.window if sent is not None and sent.rate is not None else 0.0
    if not figures.bytes or (moved == 0 and lately >= _SEVERAL):
        text = f"{one.node} has received nothing" + (f" for {figures.window:.1f} s" if figures.bytes else "")
        if lately:
            text += f"; {lately:.0f} messages were sent meanwhile"
        return Check("arrived", FAIL, text, "is it stopped, or are its callbacks too slow? look at that node")
    if figures.dropped:
        text = f"{one.node} has dropped {figures.dropped} of {count} by its own queue"
        return Check("arrived", WARN, text, "its callbacks are too slow, or its queue is too short")
    rate = f", {figures.rate:.1f} Hz" if figures.rate is not None else ""
    return Check(
        "arrived", OK, f"{count}{rate}, as {'the kernel' if figures.counted_by == 'kernel' else one.node} counts"
    )
