"""What the agent knows of the topics that cross the mesh, as the topic commands show it."""

from __future__ import annotations

from typing import TYPE_CHECKING

from rmpa.cli.output import duration, printable, size
from rmpa.observe.health import UNMEASURED, route_texts, subscriber_text
from rmpa.ros import limits

if TYPE_CHECKING:
    from collections.abc import Iterator

    from rmpa.cli.graph import GraphName
    from rmpa.cli.master import Master
    from rmpa.observe.snapshot import LatencyInfo, RouteInfo, SubscriberTransport, TopicInfo


def ask_agent(master: Master, topic: str) -> TopicInfo | None:
    """What the master's agent knows of a topic; ``None`` without an agent, or if it does not answer.

    Args:
        master: The master.
        topic: The topic.
    """
    snapshot = master.snapshot(topics=(topic,), peers=False)
    return next((info for info in snapshot.topics if info.name == topic), None) if snapshot is not None else None


def arriving(master: Master, wanted: GraphName) -> tuple[RouteInfo, ...]:
    """The routes of a topic's remote sources from which a message has come."""
    info = ask_agent(master, wanted.name)
    return tuple(
        route
        for route in (info.routes if info else ())
        if route.direction == "in" and route.messages and wanted.peer in (None, route.peer)
    )


def origin(route: RouteInfo) -> str:
    """The source that figures are about: ``joystick /joy_node``."""
    return printable(f"{route.peer} {route.node}")


def rate_text(route: RouteInfo) -> str:
    """Rate, period and jitter."""
    if route.rate is None or route.period is None:
        return "one message, no rate yet" if route.messages == 1 else "nothing in the last minute"
    p = route.period
    return (
        f"{route.rate:.3f} Hz, period {duration(p.mean)} (sd {duration(p.sd)}, min {duration(p.min)}, "
        f"max {duration(p.max)}, p99 {duration(p.p99)}), jitter {duration(route.jitter)}"
    )


def latency_text(latency: LatencyInfo | None) -> str:
    """One-way latency, with the bound of its error."""
    if latency is None:
        return "unknown yet"
    return (
        f"p50 {duration(latency.p50)}, p99 {duration(latency.p99)}, max {duration(latency.max)}, "
        f"last {duration(latency.last)}; each ± {duration(latency.error)}"
    )


def bandwidth_text(route: RouteInfo) -> str:
    """Bytes a second, and bytes a message."""
    mean = route.bytes / route.messages if route.messages else None
    return f"{size(route.bandwidth)}/s, {size(mean)} a message" if route.bandwidth is not None else "unknown yet"


def losses_text(route: RouteInfo) -> str:
    """Messages that did not arrive, by reason."""
    ours = f"{route.dropped} dropped here"
    if route.direction == "in":
        lost = f"{route.lost} lost"
        if unknown := route.events.get("loss_unknown", 0):
            lost = f"loss unknown ({_times(unknown)})" + (f", {route.lost} more lost" if route.lost else "")
        return f"{lost}, {route.late} late, {route.expired} expired, {ours}"
    return f"{route.lost} lost to {route.peer}" if route.contract.get("reliability") == "reliable" else ours


def oversized_text(route: RouteInfo) -> str:
    """Messages that were left out because they are too long."""
    where = f"by the agent of {route.peer}" if route.direction == "in" else "here"
    last, most = size(route.oversized_bytes), size(limits.TCPROS_MESSAGE_MAX)
    return f"{route.oversized} left out {where}, the last of {last}; at most {most} cross: send parts"


def shown_state(route: RouteInfo) -> str:
    """The state of a route, where its messages pass the agents or not: ``open``, ``direct``, ``open and direct``."""
    if route.transport == "direct":
        return "direct"
    return f"{route.state} and direct" if route.transport == "both" else route.state


def transport_lines(route: RouteInfo) -> Iterator[tuple[str, str]]:
    """The transport of each subscriber: label and text of each line."""
    if not route.subscribers:
        yield from (("transport", text) for text in route_texts(route))
    for one in route.subscribers:
        since = duration(one.since_ago) if one.since_ago is not None else ""
        yield "transport", subscriber_text(one, since)
        if one.interruptions:
            yield "", interruption_text(one)
        if one.transport == "direct":
            yield "", UNMEASURED


def interruption_text(one: SubscriberTransport) -> str:
    """How often a subscriber was without its path, and for how long the last time."""
    lasted = duration(one.interrupted)
    over = (
        f"{lasted}, until {duration(one.interrupted_ago)} ago" if one.interrupted_ago is not None else f"{lasted} now"
    )
    return f"interrupted {_times(one.interruptions)}, the last for {over}; what is lost of that time is not counted"


def _times(count: int) -> str:
    return "once" if count == 1 else f"{count} times"


def facts(route: RouteInfo) -> Iterator[tuple[str, str]]:
    """All that the agent knows of a route: label and text of each line."""
    if route.wire:
        yield "there", route.wire
    yield from transport_lines(route)
    if route.lane:
        yield "lane", route.lane
    if route.direction == "in" and route.messages:
        yield "rate", rate_text(route)
        yield "latency", latency_text(route.latency)
        yield "bandwidth", bandwidth_text(route)
    if route.messages or route.lost or route.events.get("loss_unknown"):
        yield "missing", losses_text(route)
    if route.kept:
        yield "waiting", f"{route.kept} messages for {route.peer}"
    if route.oversized:
        yield "too long", oversized_text(route)
    if route.contract:
        yield "contract", ", ".join(f"{key} {_value(key, value)}" for key, value in route.contract.items())
    if route.events:
        yield "events", ", ".join(f"{kind} {count}" for kind, count in route.events.items())
    for event in route.recent:
        yield "", f"{duration(event.ago)} ago: {event.kind}: {event.text}"


def _value(key: str, value: object) -> str:
    """A contract's value with its unit: only the key says whether a number is a count, a rate or seconds."""
    if not isinstance(value, int | float):
        return str(value)
    if key == "depth":
        return f"{value:.0f}"
    return f"{value:g} Hz" if key == "max_rate" else duration(value)
