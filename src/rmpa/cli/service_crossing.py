"""What the agent knows of the services that cross the mesh, as ``rmpa service`` shows it."""

from __future__ import annotations

from typing import TYPE_CHECKING

from rmpa.cli.output import duration, print_line, warn

if TYPE_CHECKING:
    from rmpa.cli.graph import GraphName
    from rmpa.cli.master import Master
    from rmpa.observe.snapshot import ServiceInfo


def crossing(master: Master, wanted: GraphName) -> tuple[ServiceInfo, ...]:
    """What the master's agent knows of a service, at all peers or the named one; empty without an agent."""
    snapshot = master.snapshot(topics=(), services=(wanted.name,), peers=False)
    return tuple(
        info
        for info in (snapshot.services if snapshot is not None else ())
        if info.name == wanted.name and wanted.peer in (None, info.peer)
    )


def transports(master: Master) -> dict[str, ServiceInfo]:
    """The peers' services in the master's graph, by name; empty without an agent."""
    snapshot = master.snapshot(topics=(), services=True, peers=False)
    return {info.name: info for info in (snapshot.services if snapshot is not None else ()) if info.transport}


def transport_json(info: ServiceInfo | None) -> dict[str, str]:
    """The transport of a peer's service, and the condition by which it is relayed; empty for others."""
    if info is None:
        return {}
    return {"transport": info.transport} | ({"condition": info.condition} if info.condition else {})


def transport_text(info: ServiceInfo | None) -> str:
    """The transport of a peer's service in a few words; empty for others."""
    if info is None:
        return ""
    if info.transport == "direct":
        return "direct"
    return f"relayed ({info.condition})" if info.condition and info.wanted != "relay" else "relayed"


def print_crossing(infos: tuple[ServiceInfo, ...]) -> None:
    """Print whether a service may cross, each peer that offers it, and how its calls went."""
    for info in infos:
        print_line(f" * {_headline(info)}")
        for label, text in _facts(info):
            print_line(f"     {label:<10} {text}")
        if info.problem:
            warn(f"{info.peer or info.node}: {info.problem}")


def _headline(info: ServiceInfo) -> str:
    if info.direction == "out":
        who = f", open at {', '.join(info.callers)}" if info.callers else ""
        return f"{'may cross' if info.crosses else 'stays home'}: {info.policy}{who}"
    over_there = f", {info.wire} over there" if info.wire else ""
    state = f"not here: {info.hidden}" if info.hidden else info.state
    return f"from {info.peer}: {info.node}{over_there}, {state}"


def _transport(info: ServiceInfo) -> list[tuple[str, str]]:
    if info.direct_callers:
        return [("transport", f"direct for {', '.join(info.direct_callers)}")]
    if info.transport == "direct":
        return [("transport", f"direct, at {info.address}, {info.lookups} lookups answered so")]
    if info.transport and info.wanted != "relay":
        why = f" ({info.condition}): {info.relayed_because}" if info.condition else "; its module is being asked"
        return [("transport", f"relayed{why}")]
    return []


def _facts(info: ServiceInfo) -> list[tuple[str, str]]:
    facts = _transport(info)
    if info.calls or info.active:
        under_way = f", {info.active} under way" if info.active else ""
        facts.append(("calls", f"{info.calls}, {info.failed} failed{under_way}"))
    if info.latency is not None:
        spread = info.latency
        label = "latency" if info.direction == "in" else "server"
        facts.append((label, f"p50 {duration(spread.p50)}, p99 {duration(spread.p99)}, max {duration(spread.max)}"))
    return facts
