"""What an agent measures of the topics that reach it over the mesh, as the topic commands show it."""

from __future__ import annotations

import contextlib
from typing import TYPE_CHECKING

from rmpa.cli.output import duration, printable, size
from rmpa.core.errors import RmpaError
from rmpa.observe.io.control_client import ControlClient
from rmpa.observe.snapshot import Snapshot
from rmpa.ros import limits

if TYPE_CHECKING:
    from collections.abc import Iterator

    from rmpa.cli.master import Master, TopicName
    from rmpa.observe.snapshot import LatencyInfo, RouteInfo, TopicInfo


def ask_agent(master: Master, topic: str) -> TopicInfo | None:
    """What the master's agent knows of one topic, if it is an agent's master and the agent answers."""
    if master.agent is not None:
        with contextlib.suppress(RmpaError), ControlClient(master.agent) as client:
            topics = client.call("snapshot", Snapshot, topics=(topic,)).topics
            return next((info for info in topics if info.name == topic), None)
    return None


def arriving(master: Master, wanted: TopicName) -> tuple[RouteInfo, ...]:
    """The remote sources of a topic from which something has come, as the agent sees them."""
    info = ask_agent(master, wanted.topic)
    return tuple(
        route
        for route in (info.routes if info else ())
        if route.direction == "in" and route.messages and wanted.peer in (None, route.peer)
    )


def origin(route: RouteInfo) -> str:
    """Whose figures they are: ``joystick /joy_node``."""
    return printable(f"{route.peer} {route.node}")


def rate_text(route: RouteInfo) -> str:
    """How often messages come."""
    if route.rate is None or route.period is None:
        return "one message, no rate yet" if route.messages == 1 else "nothing in the last minute"
    p = route.period
    return (
        f"{route.rate:.3f} Hz, period {duration(p.mean)} (sd {duration(p.sd)}, min {duration(p.min)}, "
        f"max {duration(p.max)}, p99 {duration(p.p99)}), jitter {duration(route.jitter)}"
    )


def latency_text(latency: LatencyInfo | None) -> str:
    """How long they were on the way."""
    if latency is None:
        return "unknown yet"
    return (
        f"p50 {duration(latency.p50)}, p99 {duration(latency.p99)}, max {duration(latency.max)}, "
        f"last {duration(latency.last)}; each ± {duration(latency.error)}"
    )


def bandwidth_text(route: RouteInfo) -> str:
    """How many bytes they need."""
    mean = route.bytes / route.messages if route.messages else None
    return f"{size(route.bandwidth)}/s, {size(mean)} a message" if route.bandwidth is not None else "unknown yet"


def losses_text(route: RouteInfo) -> str:
    """What did not arrive, by its reason."""
    ours = f"{route.dropped} dropped here"
    if route.direction == "in":
        return f"{route.lost} lost, {route.late} late, {route.expired} expired, {ours}"
    return f"{route.lost} lost to {route.peer}" if route.contract.get("reliability") == "reliable" else ours


def oversized_text(route: RouteInfo) -> str:
    """What cannot cross because it is too long."""
    where = f"by the agent of {route.peer}" if route.direction == "in" else "here"
    last, most = size(route.oversized_bytes), size(limits.TCPROS_MESSAGE_MAX)
    return f"{route.oversized} left out {where}, the last of {last}; at most {most} cross: send parts"


def facts(route: RouteInfo) -> Iterator[tuple[str, str]]:
    """All that is known of a route, a label and a text each."""
    if route.wire:
        yield "there", route.wire
    if route.lane:
        yield "lane", route.lane
    if route.direction == "in" and route.messages:
        yield "rate", rate_text(route)
        yield "latency", latency_text(route.latency)
        yield "bandwidth", bandwidth_text(route)
    if route.messages or route.lost:
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
    """A contract's value with its unit; JSON does not tell whole numbers from durations, the key does."""
    if not isinstance(value, int | float):
        return str(value)
    if key == "depth":
        return f"{value:.0f}"
    return f"{value:g} Hz" if key == "max_rate" else duration(value)
