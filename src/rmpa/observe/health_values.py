"""The key-values of each diagnostic status: figures without their unit, which stands in the key, for rqt to plot."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rmpa.observe.snapshot import PeerInfo, RouteInfo, ServiceInfo, Snapshot


def number(value: float | None, scale: float = 1.0) -> str:
    """Six significant digits; empty for what is not known."""
    return "" if value is None else f"{value * scale:.6g}"


def agent_values(snapshot: Snapshot, linked: int) -> dict[str, str]:
    """The agent's own, and all that it refused or dropped by name."""
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
    }
    return _known(known) | {f"count {name}": str(count) for name, count in snapshot.counters.items()}


def link_values(info: PeerInfo) -> dict[str, str]:
    """A peer's, and its link's."""
    known = {"state": info.state, "GUID": info.guid, "address": ", ".join(info.addresses)}
    link = info.link
    if link is not None:
        known |= {
            "up (s)": number(link.up_ago),
            "heard (ms ago)": number(link.heard_ago, 1e3),
            "round trip (ms)": number(link.rtt, 1e3),
            "clock offset (ms)": number(link.clock_offset, 1e3),
            "clock error (± ms)": number(link.clock_error, 1e3),
            "bytes in": str(link.bytes_in),
            "bytes out": str(link.bytes_out),
            "queued (B)": str(link.queued),
            "dropped": str(link.dropped),
            "packet (B)": number(link.packet),
            "path": link.path_problem,
            "topics in": str(info.topics_in),
            "topics out": str(info.topics_out),
        }
    for bound in info.beyond:
        where = "here" if bound.here else "there"
        known[f"{bound.kind} hidden {where} (limit {bound.limit})"] = str(bound.hidden)
    return _known(known)


def service_values(info: ServiceInfo) -> dict[str, str]:
    """A service's calls across the mesh."""
    known = {
        "node": info.node,
        "state": info.state,
        "type": info.type,
        "calls": str(info.calls),
        "failed": str(info.failed),
        "under way": str(info.active),
        "last problem": info.problem,
    }
    if info.latency is not None:
        known |= {
            "latency p50 (ms)": number(info.latency.p50, 1e3),
            "latency p99 (ms)": number(info.latency.p99, 1e3),
            "latency max (ms)": number(info.latency.max, 1e3),
        }
    return _known(known)


def route_values(route: RouteInfo) -> dict[str, str]:
    """Those of one source of a topic."""
    period, latency = route.period, route.latency
    known = {
        "node": route.node,
        "type": route.type,
        "state": route.state,
        "lane": route.lane,
        "rate (Hz)": number(route.rate),
        "bandwidth (B/s)": number(route.bandwidth),
        "age (s)": number(route.age),
    }
    if period is not None:
        known |= {
            "period mean (ms)": number(period.mean, 1e3),
            "period sd (ms)": number(period.sd, 1e3),
            "period min (ms)": number(period.min, 1e3),
            "period max (ms)": number(period.max, 1e3),
            "period p99 (ms)": number(period.p99, 1e3),
            "jitter (ms)": number(route.jitter, 1e3),
        }
    if latency is not None:
        known |= {
            "latency p50 (ms)": number(latency.p50, 1e3),
            "latency p99 (ms)": number(latency.p99, 1e3),
            "latency max (ms)": number(latency.max, 1e3),
            "latency last (ms)": number(latency.last, 1e3),
            "latency error (± ms)": number(latency.error, 1e3),
        }
    if route.direction == "out":
        known |= {"waiting": str(route.kept)}
    if route.oversized:
        known |= {"too long": str(route.oversized), "too long, last (B)": str(route.oversized_bytes)}
    if route.messages or route.dropped or route.lost:
        counted = ("messages", "lost", "late", "expired", "dropped")
        known |= {name: str(getattr(route, name)) for name in counted}
    known |= {f"contract {key}": str(value) for key, value in route.contract.items()}
    known |= {f"events {kind}": str(count) for kind, count in route.events.items()}
    return _known(known)


def _known(values: dict[str, str]) -> dict[str, str]:
    return {key: value for key, value in values.items() if value}
