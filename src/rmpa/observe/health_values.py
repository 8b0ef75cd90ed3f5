"""The evidence of each health check: figures as text, their units in the keys, so that rqt can plot them."""

from __future__ import annotations

from typing import TYPE_CHECKING

from rmpa.observe.transport_text import BY_RULE

if TYPE_CHECKING:
    from rmpa.observe.peer_info import PeerInfo
    from rmpa.observe.snapshot import RouteInfo, SampleSpread, ServiceInfo, Snapshot, SubscriberTransport


def number(value: float | None, scale: float = 1.0) -> str:
    """Six significant digits; empty for ``None``."""
    return "" if value is None else f"{value * scale:.6g}"


def agent_values(snapshot: Snapshot, linked: int) -> dict[str, str]:
    """The agent's own figures, and its counters by name."""
    agent = snapshot.agent
    known = {
        "name": agent.name,
        "GUID": agent.guid,
        "domain": str(agent.domain),
        "ROS core": agent.core_uri,
        "core memory": agent.core_memory,
        "version": agent.version,
        "uptime (s)": number(agent.uptime),
        "CPU (%)": number(agent.cpu),
        "memory (MB)": number(agent.rss, 1e-6),
        "open files": str(agent.files.open) if agent.files else "",
        "limit of open files": str(agent.files.limit) if agent.files else "",
        "peers": str(len(snapshot.peers)),
        "linked": str(linked),
        "proxies": str(agent.proxies),
        "proxies' listening sockets": str(agent.proxy_sockets),
        "real time": "; ".join(agent.realtime),
        "certificate (h left)": number(snapshot.trust.expires - snapshot.taken, 1 / 3600) if snapshot.trust else "",
    }
    return _known(known) | {f"count {name}": str(count) for name, count in snapshot.counters.items()}


def link_values(info: PeerInfo) -> dict[str, str]:
    """The figures of a peer and its link."""
    known = {"state": info.state, "GUID": info.guid, "address": ", ".join(info.addresses)}
    link = info.link
    if link is not None:
        known |= {
            "up (s)": number(link.up_ago),
            "heard (ms ago)": number(link.heard_ago, 1e3),
            "pace": "at rest" if link.rests else "in use",
            "round trip (ms)": number(link.rtt, 1e3),
            "clock offset (ms)": number(link.clock_offset, 1e3),
            "clock error (± ms)": number(link.clock_error, 1e3),
            "bytes in": str(link.bytes_in),
            "bytes out": str(link.bytes_out),
            "queued (B)": str(link.queued),
            "dropped": str(link.dropped),
            "topics in": str(info.topics_in),
            "topics out": str(info.topics_out),
        }
    for bound in info.beyond:
        known[f"{bound.kind} hidden here (limit {bound.limit})"] = str(bound.hidden)
    return _known(known)


def service_values(info: ServiceInfo) -> dict[str, str]:
    """The figures of a service's calls across the mesh."""
    known = {
        "node": info.node,
        "state": info.state,
        "type": info.type,
        "calls": str(info.calls),
        "failed": str(info.failed),
        "under way": str(info.active),
        "last problem": info.problem,
    }
    return _known(known | _milliseconds("latency", info.latency, "p50", "p99", "max"))


def route_values(route: RouteInfo) -> dict[str, str]:
    """The figures of one source of a topic."""
    period, latency = route.period, route.latency
    known = {
        "node": route.node,
        "type": route.type,
        "state": route.state,
        "transport": route.transport,
        "relayed by": route.condition if route.condition != BY_RULE else "",
        "lane": route.lane,
        "rate (Hz)": number(route.rate),
        "bandwidth (B/s)": number(route.bandwidth),
        "age (s)": number(route.age),
    }
    if period is not None:
        known |= _milliseconds("period", period, "mean", "sd", "min", "max", "p99")
        known["jitter (ms)"] = number(route.jitter, 1e3)
    if latency is not None:
        known |= _milliseconds("latency", latency, "p50", "p99", "max", "last")
        known["latency error (± ms)"] = number(latency.error, 1e3)
    if route.direction == "out":
        known |= {"waiting": str(route.kept)}
    if route.oversized:
        known |= {"too long": str(route.oversized), "too long, last (B)": str(route.oversized_bytes)}
    if route.messages or route.dropped or route.lost:
        counted = ("messages", "lost", "late", "expired", "dropped")
        known |= {name: str(getattr(route, name)) for name in counted}
    for one in route.subscribers:
        known |= _direct_values(one)
    known |= {f"contract {key}": str(value) for key, value in route.contract.items()}
    known |= {f"events {kind}": str(count) for kind, count in route.events.items()}
    return _known(known)


def _direct_values(one: SubscriberTransport) -> dict[str, str]:
    """What is known of a subscriber that is connected directly."""
    if one.transport != "direct":
        return {}
    known = {"to": one.endpoint, "since (s)": number(one.since_ago), "interruptions": str(one.interruptions or "")}
    return {f"direct {one.node} {key}": value for key, value in known.items()}


def _milliseconds(what: str, spread: SampleSpread | None, *fields: str) -> dict[str, str]:
    if spread is None:
        return {}
    return {f"{what} {field} (ms)": number(getattr(spread, field), 1e3) for field in fields}


def _known(values: dict[str, str]) -> dict[str, str]:
    return {key: value for key, value in values.items() if value}
