"""What programs read of the agent: parts of its snapshot as JSON (REST), and its figures for Prometheus; no I/O.

The types of the REST API are those of ``observe.snapshot``, as ``--json`` of the commands gives them.

Names, units and types of the metrics are as in prometheus.io/docs/practices/naming: base units, ``_total`` for
counters, times as seconds since the epoch, quantiles as summaries. Labels name peers, topics, nodes and services,
whose numbers are bounded (``limits.METRIC_…``): ``rmpa_metrics_omitted`` says how many are left out. A counter of a
link or a route begins at 0 when that is opened again, which PromQL's ``rate`` understands.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final, NamedTuple, TypeAlias, TypeVar
from urllib.parse import unquote

import msgspec

from rmpa.config.values import did_you_mean
from rmpa.core.identity import is_legal_name
from rmpa.web import limits
from rmpa.web.clients import CLIENT_REFUSALS, PROTOCOLS, ClientFigures
from rmpa.web.server.access import Problem

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence

    from rmpa.core.facts import LinkInfo, RouteInfo, ServiceInfo
    from rmpa.core.statistics import SampleSpread
    from rmpa.observe.snapshot import PeerInfo, Snapshot

# Begins each path; a later version that breaks clients has another number.
PREFIX: Final = "/api/v1"
# What there is below ``PREFIX``: the snapshot, and members of it.
_PATHS: Final = (
    "/snapshot",
    "/agent",
    "/peers",
    "/peers/{name}",
    "/topics",
    "/topics/{name}",
    "/services",
    "/services/{name}",
    "/counters",
    "/notes",
    "/unreachable",
)
# Names that a wrong one is compared with for a hint, which takes some microseconds each.
_NAMES_COMPARED: Final = 1000


def respond(path: str, snapshot: Snapshot | None, why: str = "") -> bytes:
    """The JSON that answers a request by GET or HEAD.

    Args:
        path: Percent-encoded, without the query. Slashes of a topic's or a service's name need no encoding.
        snapshot: The newest; ``None`` while the agent does not answer.
        why: Why it does not, and what to do, where that is known.

    Raises:
        Problem: There is no such thing, or no snapshot.
    """
    below = path.removeprefix(PREFIX)
    kind, slash, rest = below.removeprefix("/").partition("/")
    known = (f"/{kind}/{{name}}" if rest else below) in _PATHS
    if below == path or len(path) > limits.REST_PATH_MAX or not known or bool(slash) != bool(rest):
        raise Problem(404, f"there is no {_short(path)}; below {PREFIX} there are {', '.join(_PATHS)}")
    if snapshot is None:
        raise Problem(503, why or "the agent does not answer; start it with rmpa up, or look at its log")
    found: Any = snapshot if kind == "snapshot" else getattr(snapshot, kind)
    if rest:
        name = unquote(rest, errors="replace")
        wanted = name if kind == "peers" or name.startswith("/") else f"/{name}"
        named = tuple(each for each in found if each.name == wanted)
        if not named:
            raise Problem(404, _missing(kind, wanted, [each.name for each in found[:_NAMES_COMPARED]]))
        found = named if kind == "services" else named[0]
    return msgspec.json.encode(found)


def _missing(kind: str, name: str, names: Sequence[str]) -> str:
    text = f"there is no {kind[:-1]} {_short(name)}"
    if near := did_you_mean(name, names):
        return f"{text}; did you mean {near}?"
    if kind != "peers" and not is_legal_name(name):
        return f"{text}: that is not a ROS name"
    return f"{text}; {PREFIX}/{kind} lists all"


def _short(text: str) -> str:
    return ascii(text if len(text) <= 80 else f"{text[:80]}…")


# The values of ``PeerInfo.state``.
PEER_STATES: Final = ("linked", "linking", "refused", "conflict", "relayed")
# The values of ``EventInfo.kind``; a route with a contract shows all of them from 0 on, so that the first counts.
EVENT_KINDS: Final = (
    "deadline_missed",
    "lifespan_expired",
    "liveliness_lost",
    "liveliness_restored",
    "messages_lost",
    "loss_unknown",
)
# Why the web server refuses requests, connections and clients; all are shown from 0 on, so that an alarm sees the
# first.
REFUSALS: Final = (
    "host",
    "origin",
    "token",
    "method",
    "body",
    "malformed",
    "connections",
    "slow_request",
    "slow_response",
    "oversized",
    *CLIENT_REFUSALS,
)
# Each node has these; they are shown only where they were called across the mesh.
_LOGGER_SERVICES: Final = ("/get_loggers", "/set_logger_level")
_SUFFIXES: Final = {"counter": "_total", "info": "_info"}
_TEXT: Final = "text/plain; version=0.0.4; charset=utf-8"
_OPENMETRICS: Final = "application/openmetrics-text; version=1.0.0; charset=utf-8"
_ESCAPES: Final = str.maketrans({"\\": "\\\\", "\n": "\\n", '"': '\\"'})
_T = TypeVar("_T")
# Each with its labels as ``labels`` writes them; ``None``: not known, and left out.
Samples: TypeAlias = "Iterable[tuple[str, float | None]]"
# A metric of each of several things: the end of its name, what it means, its kind, and its value of one thing.
_Row: TypeAlias = "tuple[str, str, str, Callable[[_T], float | None]]"


class Metric(NamedTuple):
    """A metric: its name without the suffix of its kind, what it means, its kind, and its samples."""

    name: str
    help: str
    kind: str
    samples: Samples


def content_type(accept: str) -> str:
    """The content type of ``/metrics`` for a request's ``Accept`` header: one of two, whatever it is."""
    return _OPENMETRICS if "application/openmetrics-text" in accept else _TEXT


def exposition(metrics: Iterable[Metric], form: str = _TEXT) -> bytes:
    """The body of ``/metrics``; ``form`` is a result of ``content_type``.

    Text format 0.0.4 (prometheus.io/docs/instrumenting/exposition_formats) or OpenMetrics 1.0.
    """
    lines: list[str] = []
    for name, help_, kind, samples in metrics:
        sampled = name + _SUFFIXES.get(kind, "")
        shown = name if form == _OPENMETRICS else sampled
        said = kind if form == _OPENMETRICS or kind != "info" else "gauge"
        lines += (f"# HELP {shown} {help_}", f"# TYPE {shown} {said}")
        # Names that differ only behind what is shown of them would be one series twice, which is an error.
        lines += [f"{sampled}{key} {float(value)!r}" for key, value in dict(samples).items() if value is not None]
    if form == _OPENMETRICS:
        lines.append("# EOF")
    return "\n".join([*lines, ""]).encode()


def labels(**values: str) -> str:
    """Labels as they stand behind a sample's name: cut, escaped, and what is no text replaced."""
    most = limits.METRIC_LABEL_CHARACTERS
    shown = (f'{name}="{value[:most].translate(_ESCAPES)}"' for name, value in values.items())
    return "{" + ",".join(shown).encode("utf-8", "replace").decode() + "}"


def _table(prefix: str, rows: Iterable[_Row[_T]], things: Sequence[tuple[str, _T]]) -> Iterator[Metric]:
    """A metric for each row, with a sample for each thing."""
    for name, help_, kind, value in rows:
        yield Metric(prefix + name, help_, kind, [(key, value(each)) for key, each in things])


def _and(known: str, name: str, value: str) -> str:
    """A further label, of a fixed set of words, behind those of a peer, a route or a service."""
    return f'{known[:-1]},{name}="{value}"}}'


def _quantiles(known: str, spread: SampleSpread | None) -> Samples:
    if spread is None:
        return ()
    return (_and(known, "quantile", "0.5"), spread.p50), (_and(known, "quantile", "0.99"), spread.p99)


def metrics(snapshot: Snapshot | None) -> Iterator[Metric]:
    """All metrics of a snapshot; ``rmpa_up`` alone where there is none."""
    up = snapshot is not None
    yield Metric("rmpa_up", "Whether the agent answers on its control socket.", "gauge", [("", up)])
    if snapshot is None:
        return
    omitted: list[tuple[str, float]] = []

    def bounded(kind: str, items: Sequence[_T], most: int, left: int = 0) -> Sequence[_T]:
        omitted.append((labels(kind=kind), max(0, len(items) - most) + left))
        return items[:most]

    peers = bounded("peer", snapshot.peers, limits.METRIC_PEERS)
    all_routes = [(t.name, route) for t in snapshot.topics for route in t.routes]
    all_routes.sort(key=lambda each: each[1].state == "idle")
    routes = bounded("route", all_routes, limits.METRIC_ROUTES, snapshot.topics_left)
    called = [each for each in snapshot.services if each.calls or not each.name.endswith(_LOGGER_SERVICES)]
    services = bounded("service", called, limits.METRIC_SERVICES, snapshot.services_left)
    reasons = bounded("reason", list(snapshot.counters.items()), limits.METRIC_REASONS)
    yield from _agent(snapshot)
    discards = [(labels(reason=reason), count) for reason, count in reasons]
    yield Metric("rmpa_discards", "What was refused or dropped, by its reason.", "counter", discards)
    yield from _peers(snapshot, peers)
    links = [(labels(peer=each.name), each.link) for each in peers if each.link is not None]
    yield from _links(snapshot.taken, links)
    routed = [(labels(topic=name, peer=x.peer, node=x.node, direction=x.direction), x) for name, x in routes]
    yield from _routes(snapshot.taken, routed)
    yield from _services([(labels(service=x.name, peer=x.peer, direction=x.direction), x) for x in services])
    help_ = "Peers, routes, services and reasons left out for their number."
    yield Metric("rmpa_metrics_omitted", help_, "gauge", omitted)


def _agent(snapshot: Snapshot) -> Iterator[Metric]:
    agent, topics = snapshot.agent, snapshot.topics
    files = agent.files
    who = labels(module=agent.name, version=agent.version, domain=str(agent.domain))
    yield Metric("rmpa_agent", "The agent's module, version and domain.", "info", [(who, 1)])
    figures: tuple[tuple[str, str, float | None], ...] = (
        ("snapshot_timestamp_seconds", "When the agent's state was taken, since the epoch.", snapshot.taken),
        ("agent_start_time_seconds", "When the agent started, since the epoch.", agent.started),
        ("agent_cpu_usage_ratio", "Share of one core.", agent.cpu / 100 if agent.cpu is not None else None),
        ("agent_resident_memory_bytes", "Resident memory.", agent.rss),
        ("agent_open_fds", "Open file descriptors.", files.open if files else None),
        ("agent_max_fds", "Limit of open file descriptors.", files.limit if files else None),
        ("agent_proxies", "Proxies of peers' nodes in the local graph.", agent.proxies),
        ("agent_notes", "Notes for users, as rmpa peer list shows them.", len(snapshot.notes)),
        ("topics", "Topics of the local graph and of what peers offer.", len(topics) + snapshot.topics_left),
        ("topics_crossing", "Topics that policy lets cross.", sum(each.crosses for each in topics)),
        ("topics_mismatched", "Topics whose ends disagree about the type.", sum(bool(t.mismatches) for t in topics)),
        ("services", "Services of the local graph and of peers.", len(snapshot.services) + snapshot.services_left),
        ("nodes_unreachable", "Nodes to which no connection can be made.", len(snapshot.unreachable)),
    )
    for name, help_, value in figures:
        yield Metric(f"rmpa_{name}", help_, "gauge", [("", value)])
    refused = [("", files.refused if files else None)]
    yield Metric("rmpa_agent_fd_refusals", "Attempts that found no free file descriptor.", "counter", refused)


def _peers(snapshot: Snapshot, peers: Iterable[PeerInfo]) -> Iterator[Metric]:
    states = [(labels(state=state), sum(each.state == state for each in snapshot.peers)) for state in PEER_STATES]
    yield Metric("rmpa_peers", "Known peers, by state.", "gauge", states)
    named = [(labels(peer=each.name), each) for each in peers]
    linked = [(key, each.state == "linked") for key, each in named]
    yield Metric("rmpa_peer_linked", "Whether the peer has a link.", "gauge", linked)
    help_ = "Whether the peer has no link and should have one: it is neither linked nor relayed."
    missing = [(key, each.state not in ("linked", "relayed")) for key, each in named]
    yield Metric("rmpa_peer_link_missing", help_, "gauge", missing)
    topics = [
        (_and(key, "direction", direction), count)
        for key, each in named
        for direction, count in (("in", each.topics_in), ("out", each.topics_out))
    ]
    yield Metric("rmpa_peer_topics", "Topics that the peer offers (in) or is offered (out).", "gauge", topics)
    hidden = [(_and(key, "kind", bound.kind), bound.hidden) for key, each in named for bound in each.beyond]
    help_ = "Nodes, topics or services of a peer that this module hides because a limit is exceeded."
    yield Metric("rmpa_peer_hidden", help_, "gauge", hidden)


def _links(taken: float, links: Sequence[tuple[str, LinkInfo]]) -> Iterator[Metric]:
    figures: tuple[_Row[LinkInfo], ...] = (
        ("start_time_seconds", "When the link came up, since the epoch.", "gauge", lambda x: _at(taken, x.up_ago)),
        ("last_heard_timestamp_seconds", "When anything last arrived.", "gauge", lambda x: _at(taken, x.heard_ago)),
        ("round_trip_seconds", "The last round trip on the wire.", "gauge", lambda x: x.rtt),
        ("clock_offset_seconds", "The peer's clock less this machine's.", "gauge", lambda x: x.clock_offset),
        ("clock_error_seconds", "Bound of that offset's error, +/-.", "gauge", lambda x: x.clock_error),
        ("queue_bytes", "Bytes that wait to be sent.", "gauge", lambda x: x.queued),
        ("receive_bytes", "Bytes received since the link came up.", "counter", lambda x: x.bytes_in),
        ("transmit_bytes", "Bytes sent since the link came up.", "counter", lambda x: x.bytes_out),
        ("dropped_messages", "Messages dropped as the link was too slow.", "counter", lambda x: x.dropped),
    )
    yield from _table("rmpa_link_", figures, links)


def _routes(taken: float, routes: Sequence[tuple[str, RouteInfo]]) -> Iterator[Metric]:
    figures: tuple[_Row[RouteInfo], ...] = (
        ("open", "Whether messages can flow.", "gauge", lambda x: x.state == "open"),
        ("problem", "Whether something is wrong; rmpa why says what.", "gauge", lambda x: bool(x.problem)),
        ("messages", "Messages that crossed since the route was opened.", "counter", lambda x: x.messages),
        ("bytes", "Bytes of messages that crossed since then.", "counter", lambda x: x.bytes),
        ("lost_messages", "Messages that never arrived or were given up.", "counter", lambda x: x.lost),
        ("kept_messages", "Messages that wait for a peer that is away.", "gauge", lambda x: x.kept),
        ("last_message_timestamp_seconds", "When the last one crossed.", "gauge", lambda x: _at(taken, x.age)),
        ("jitter_seconds", "The period's 99th percentile less its median.", "gauge", lambda x: x.jitter),
        (
            "latency_error_seconds",
            "Bound of the latency's error, +/-.",
            "gauge",
            lambda x: x.latency.error if x.latency else None,
        ),
    )
    yield from _table("rmpa_route_", figures, routes)
    discarded = [
        (_and(key, "reason", reason), count)
        for key, x in routes
        for reason, count in (
            ("slow_receiver", x.dropped),
            ("late", x.late),
            ("expired", x.expired),
            ("oversized", x.oversized),
        )
    ]
    yield Metric("rmpa_route_discarded_messages", "Messages left out, by reason.", "counter", discarded)
    events = [
        (_and(key, "event", event), count)
        for key, x in routes
        for event, count in {**(dict.fromkeys(EVENT_KINDS, 0) if x.contract else {}), **x.events}.items()
    ]
    yield Metric("rmpa_route_contract_events", "Events of the topic's contract.", "counter", events)
    latency = [each for key, x in routes for each in _quantiles(key, x.latency)]
    yield Metric("rmpa_route_latency_seconds", "One-way latency in the last minute.", "summary", latency)
    period = [each for key, x in routes for each in _quantiles(key, x.period)]
    yield Metric("rmpa_route_period_seconds", "Time between messages in the last minute.", "summary", period)


def _services(services: Sequence[tuple[str, ServiceInfo]]) -> Iterator[Metric]:
    figures: tuple[_Row[ServiceInfo], ...] = (
        ("calls", "Service calls across the mesh.", "counter", lambda x: x.calls),
        ("failed_calls", "Calls that ended with an error.", "counter", lambda x: x.failed),
        ("active_calls", "Calls under way.", "gauge", lambda x: x.active),
    )
    yield from _table("rmpa_service_", figures, services)
    latency = [sample for key, each in services for sample in _quantiles(key, each.latency)]
    yield Metric("rmpa_service_latency_seconds", "Latency of the last successful calls.", "summary", latency)


def _at(taken: float, ago: float | None) -> float | None:
    return None if ago is None else round(taken - ago, 3)


def web_metrics(
    connections: tuple[int, int],
    responses: Mapping[str, int],
    refused: Mapping[str, int],
    reads: tuple[int, float],
    sockets: Mapping[str, ClientFigures],
) -> Iterator[Metric]:
    """All metrics of the web server itself.

    Args:
        connections: How many are open at present, and how many there were so far.
        responses: Responses so far, by HTTP status.
        refused: Refusals so far, by the words of ``REFUSALS``.
        reads: Questions to the agent so far, and the seconds that they took.
        sockets: What is counted of WebSocket clients, by their protocol.
    """
    is_open, accepted = connections
    yield Metric("rmpa_web_connections", "Open connections of clients.", "gauge", [("", is_open)])
    yield Metric("rmpa_web_accepted_connections", "Connections of clients so far.", "counter", [("", accepted)])
    statuses = [(labels(status=status), count) for status, count in sorted(responses.items())]
    yield Metric("rmpa_web_responses", "Responses by HTTP status.", "counter", statuses)
    help_ = "Requests, connections and WebSocket clients refused, by reason."
    reasons = [(labels(reason=reason), refused.get(reason, 0)) for reason in REFUSALS]
    yield Metric("rmpa_web_refused", help_, "counter", reasons)
    read = [*zip(("_count", "_sum"), reads, strict=True)]
    yield Metric("rmpa_web_agent_read_seconds", "Time to read the agent's snapshot.", "summary", read)
    clients = [(labels(protocol=name), sockets.get(name, ClientFigures())) for name in sorted({*PROTOCOLS, *sockets})]
    counts: tuple[_Row[ClientFigures], ...] = (
        ("clients", "WebSocket clients.", "gauge", lambda x: x.clients),
        ("client_queue_bytes", "Bytes that wait for these.", "gauge", lambda x: x.queued),
        ("client_frames", "Messages and answers sent to these.", "counter", lambda x: x.sent),
        (
            "client_dropped_messages",
            "Messages dropped because one of these was slow.",
            "counter",
            lambda x: x.dropped,
        ),
    )
    yield from _table("rmpa_web_", counts, clients)
