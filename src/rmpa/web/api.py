"""What programs read of the agent: the REST API, and ``/metrics``, made in a process of its own if it is large.

The REST API: parts of the agent's snapshot as JSON; no I/O.

The types are those of ``observe.snapshot``, as ``--json`` of the commands gives them. Errors are problem details
(RFC 9457).
"""

from __future__ import annotations

import asyncio
import difflib
import os
import pickle
import sys
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, NamedTuple, TypeVar
from urllib.parse import unquote

import msgspec
from prometheus_client import CollectorRegistry
from prometheus_client.exposition import choose_encoder
from prometheus_client.metrics_core import Metric
from prometheus_client.registry import Collector

from rmpa.core.identity import is_legal_name
from rmpa.observe.snapshot import Snapshot
from rmpa.web import limits
from rmpa.web.server.access import web_metrics

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence

    from rmpa.observe.peer_info import LinkInfo, PeerInfo
    from rmpa.observe.snapshot import RouteInfo, SampleSpread, ServiceInfo
    from rmpa.web.server.access import Figures

PREFIX: Final = "/api/v1"
"""Begins each path; a later version that breaks clients has another number."""
_JSON: Final = "application/json"
_PROBLEM_JSON: Final = "application/problem+json"
_NAME: Final = "{name}"


class Problem(msgspec.Struct, kw_only=True, frozen=True):
    """Why a request has no result (RFC 9457).

    Attributes:
        title: What happened, the same for all errors of this status.
        status: The HTTP status.
        detail: What happened with this request, and what to do.
    """

    title: str
    status: int
    detail: str


@dataclass(frozen=True, slots=True)
class RestResponse:
    """An HTTP response: status, body, its type, and further headers."""

    status: int
    body: bytes
    content_type: str = _JSON
    headers: tuple[tuple[str, str], ...] = ()


class _Missing(NamedTuple):
    """No resource has the name that was asked for; ``names`` are those that there are."""

    what: str
    name: str
    names: tuple[str, ...]


def _peer(snapshot: Snapshot, name: str) -> object:
    found = next((each for each in snapshot.peers if each.name == name), None)
    return found or _Missing("peer", name, tuple(each.name for each in snapshot.peers))


def _topic(snapshot: Snapshot, name: str) -> object:
    wanted = _global(name)
    found = next((each for each in snapshot.topics if each.name == wanted), None)
    return found or _Missing("topic", wanted, tuple(each.name for each in snapshot.topics))


def _service(snapshot: Snapshot, name: str) -> object:
    wanted = _global(name)
    found = tuple(each for each in snapshot.services if each.name == wanted)
    return found or _Missing("service", wanted, tuple(each.name for each in snapshot.services))


def _global(name: str) -> str:
    return name if name.startswith("/") else f"/{name}"


_RESOURCES: Final[Mapping[str, Callable[[Snapshot, str], object]]] = {
    "/snapshot": lambda s, _: s,
    "/agent": lambda s, _: s.agent,
    "/peers": lambda s, _: s.peers,
    "/peers/{name}": _peer,
    "/topics": lambda s, _: s.topics,
    "/topics/{name}": _topic,
    "/services": lambda s, _: s.services,
    "/services/{name}": _service,
    "/counters": lambda s, _: s.counters,
    "/notes": lambda s, _: s.notes,
    "/unreachable": lambda s, _: s.unreachable,
}
"""What each path below ``PREFIX`` gives."""


def respond(path: str, snapshot: Snapshot | None, why: str = "") -> RestResponse:
    """The response to a request by GET or HEAD.

    Args:
        path: Percent-encoded, without the query. Slashes of a topic's or a service's name need no encoding.
        snapshot: The newest; ``None`` while the agent does not answer.
        why: Why it does not, and what to do, where that is known.
    """
    read, name = _find(path)
    if read is None:
        return problem(404, f"there is no {_short(path)}; below {PREFIX} there are {', '.join(_RESOURCES)}")
    if snapshot is None:
        return problem(503, why or "the agent does not answer; start it with rmpa up, or look at its log")
    result = read(snapshot, name)
    if isinstance(result, _Missing):
        return problem(404, _missing(result))
    return RestResponse(200, msgspec.json.encode(result))


def _find(path: str) -> tuple[Callable[[Snapshot, str], object] | None, str]:
    below = path.removeprefix(PREFIX)
    if below == path or len(path) > limits.REST_PATH_MAX:
        return None, ""
    if below in _RESOURCES and _NAME not in below:
        return _RESOURCES[below], ""
    kind, _, rest = below.removeprefix("/").partition("/")
    read = _RESOURCES.get(f"/{kind}/{_NAME}")
    return (read, unquote(rest, errors="replace")) if read and rest else (None, "")


def _missing(missing: _Missing) -> str:
    text = f"there is no {missing.what} {_short(missing.name)}"
    near = difflib.get_close_matches(missing.name, missing.names[: limits.REST_NAMES_COMPARED], 1)
    if near:
        return f"{text}; did you mean {near[0]}?"
    if missing.what != "peer" and not is_legal_name(missing.name):
        return f"{text}: that is not a ROS name"
    return f"{text}; {PREFIX}/{missing.what}s lists all"


def _short(text: str) -> str:
    return ascii(text if len(text) <= 80 else f"{text[:80]}…")


_TITLES: Final = {
    400: "Bad request",
    401: "A token is needed",
    403: "Refused",
    404: "Not found",
    405: "Method not allowed",
    413: "Too large",
    500: "Internal error",
    503: "The agent does not answer",
}


def detail_of(response: RestResponse) -> str:
    """The text of a response that ``problem`` made."""
    return msgspec.json.decode(response.body, type=Problem).detail


def problem(status: int, detail: str, headers: tuple[tuple[str, str], ...] = ()) -> RestResponse:
    """The problem details of a status, as a response."""
    body = msgspec.json.encode(Problem(title=_TITLES[status], status=status, detail=detail))
    return RestResponse(status, body, _PROBLEM_JSON, headers)


# The agent's snapshot as Prometheus metrics, for ``/metrics``.
#
# Names, units and types are as in prometheus.io/docs/practices/naming: base units, ``_total`` for counters, times
# as
# seconds since the epoch, quantiles as summaries. Labels name peers, topics, nodes and services, whose numbers are
# bounded (``limits.METRIC_…``): ``rmpa_metrics_omitted`` says how many are left out. A counter of a link or a route
# begins at 0 when that is opened anew, which PromQL's ``rate`` understands.


PEER_STATES: Final = ("linked", "linking", "refused", "conflict", "relayed")
"""The values of ``PeerInfo.state``."""
_IN_ORDER: Final = frozenset({"linked", "relayed"})
"""States of a peer that has its link, or needs none."""
EVENT_KINDS: Final = (
    "deadline_missed",
    "lifespan_expired",
    "liveliness_lost",
    "liveliness_restored",
    "messages_lost",
    "loss_unknown",
)
"""The values of ``EventInfo.kind``; a route with a contract shows all of them from 0 on, so that the first counts."""
_LOGGER_SERVICES: Final = ("/get_loggers", "/set_logger_level")
"""Each node has these; they are shown only where they were called across the mesh."""
_T = TypeVar("_T")


class _Family:
    """A metric with its samples: adds the name's suffix, cleans label values, and drops samples that come twice."""

    def __init__(self, name: str, help_: str, kind: str, labels: tuple[str, ...] = ()) -> None:
        self.metric = Metric(name, help_, kind)
        self._sample = {"counter": f"{name}_total", "info": f"{name}_info"}.get(kind, name)
        self._labels = labels
        self._seen: set[tuple[str, ...]] = set()

    def add(self, value: float | None, *labels: str) -> None:
        """Add one sample; none where the value is not known."""
        cleaned = tuple(_label(each) for each in labels)
        if value is not None and cleaned not in self._seen:
            self._seen.add(cleaned)
            self.metric.add_sample(self._sample, dict(zip(self._labels, cleaned, strict=True)), float(value))

    def add_quantiles(self, spread: SampleSpread | None, *labels: str) -> None:
        """Add the median and the 99th percentile; the last label is ``quantile``."""
        if spread is not None:
            self.add(spread.p50, *labels, "0.5")
            self.add(spread.p99, *labels, "0.99")


def _label(text: str) -> str:
    return text[: limits.METRIC_LABEL_CHARACTERS].encode("utf-8", "replace").decode()


class SnapshotCollector(Collector):
    """Makes the metrics of the newest snapshot at each scrape.

    Args:
        read: Returns the snapshot; ``None`` while the agent does not answer, which ``rmpa_up`` then says.
        further: Metrics that follow those of the snapshot.
    """

    def __init__(self, read: Callable[[], Snapshot | None], further: Iterable[Metric] = ()) -> None:
        self._read = read
        self._further = further

    def describe(self) -> Iterator[Metric]:
        """Nothing: a registration needs no snapshot."""
        return iter(())

    def collect(self) -> Iterator[Metric]:
        """All metrics."""
        yield from metrics(self._read())
        yield from self._further


def exposition(snapshot: Snapshot | None, accept: str = "", further: Iterable[Metric] = ()) -> tuple[bytes, str]:
    """The body of ``/metrics`` and its content type.

    Args:
        snapshot: ``None`` while the agent does not answer.
        accept: The request's ``Accept`` header: it chooses between Prometheus's text format and OpenMetrics.
        further: Metrics that follow those of the snapshot: the web server's own.
    """
    registry = CollectorRegistry(auto_describe=False)
    registry.register(SnapshotCollector(lambda: snapshot, further))
    encode, content_type = choose_encoder(accept)
    return encode(registry), content_type


def content_type(accept: str) -> str:
    """The content type of ``/metrics`` for a request's ``Accept`` header: one of few, whatever it is."""
    return str(choose_encoder(accept)[1])


def metrics(snapshot: Snapshot | None) -> Iterator[Metric]:
    """All metrics of a snapshot; ``rmpa_up`` alone where there is none."""
    up = _Family("rmpa_up", "Whether the agent answers on its control socket.", "gauge")
    up.add(snapshot is not None)
    yield up.metric
    if snapshot is None:
        return
    omitted = _Family(
        "rmpa_metrics_omitted", "Peers, routes, services and reasons left out for their number.", "gauge", ("kind",)
    )
    peers = _bounded(omitted, "peer", snapshot.peers, limits.METRIC_PEERS)
    all_routes = [(t.name, route) for t in snapshot.topics for route in t.routes]
    all_routes.sort(key=lambda each: each[1].state == "idle")
    routes = _bounded(omitted, "route", all_routes, limits.METRIC_ROUTES, snapshot.topics_left)
    shown = [each for each in snapshot.services if each.calls or not each.name.endswith(_LOGGER_SERVICES)]
    services = _bounded(omitted, "service", shown, limits.METRIC_SERVICES, snapshot.services_left)
    reasons = _bounded(omitted, "reason", list(snapshot.counters.items()), limits.METRIC_REASONS)
    yield from _agent(snapshot)
    yield from _graph(snapshot)
    yield from _discards(reasons)
    yield from _peers(snapshot, peers)
    yield from _links(snapshot.taken, [(peer.name, peer.link) for peer in peers if peer.link is not None])
    yield from _routes(snapshot.taken, routes)
    yield from _services(services)
    yield omitted.metric


def _bounded(omitted: _Family, kind: str, items: Sequence[_T], most: int, left: int = 0) -> Sequence[_T]:
    """The first ones; ``left`` counts those that the snapshot itself leaves out."""
    omitted.add(max(0, len(items) - most) + left, kind)
    return items[:most]


def _agent(snapshot: Snapshot) -> Iterator[Metric]:
    agent = snapshot.agent
    info = _Family("rmpa_agent", "The agent's module, version and domain.", "info", ("module", "version", "domain"))
    info.add(1, agent.name, agent.version, str(agent.domain))
    yield info.metric
    files = agent.files
    figures: tuple[tuple[str, str, float | None], ...] = (
        ("snapshot_timestamp_seconds", "When the agent's state was taken, since the epoch.", snapshot.taken),
        ("agent_start_time_seconds", "When the agent started, since the epoch.", agent.started),
        ("agent_cpu_usage_ratio", "Share of one core.", agent.cpu / 100 if agent.cpu is not None else None),
        ("agent_resident_memory_bytes", "Resident memory.", agent.rss),
        ("agent_open_fds", "Open file descriptors.", files.open if files else None),
        ("agent_max_fds", "Limit of open file descriptors.", files.limit if files else None),
        ("agent_proxies", "Proxies of peers' nodes in the local graph.", agent.proxies),
        ("agent_notes", "Notes for users, as rmpa peer list shows them.", len(snapshot.notes)),
    )
    for name, help_, value in figures:
        family = _Family(f"rmpa_{name}", help_, "gauge")
        family.add(value)
        yield family.metric
    refused = _Family("rmpa_agent_fd_refusals", "Attempts that found no free file descriptor.", "counter")
    refused.add(files.refused if files else None)
    yield refused.metric


def _graph(snapshot: Snapshot) -> Iterator[Metric]:
    topics = snapshot.topics
    figures = (
        ("topics", "Topics of the local graph and of what peers offer.", len(topics) + snapshot.topics_left),
        (
            "topics_crossing",
            "Topics that policy lets cross.",
            sum(each.crosses for each in topics),
        ),
        ("topics_mismatched", "Topics whose ends disagree about the type.", sum(bool(t.mismatches) for t in topics)),
        ("services", "Services of the local graph and of peers.", len(snapshot.services) + snapshot.services_left),
        ("nodes_unreachable", "Nodes to which no connection can be made.", len(snapshot.unreachable)),
    )
    for name, help_, value in figures:
        family = _Family(f"rmpa_{name}", help_, "gauge")
        family.add(value)
        yield family.metric


def _discards(reasons: Iterable[tuple[str, int]]) -> Iterator[Metric]:
    family = _Family("rmpa_discards", "What was refused or dropped, by its reason.", "counter", ("reason",))
    for reason, count in reasons:
        family.add(count, reason)
    yield family.metric


def _peers(snapshot: Snapshot, peers: Iterable[PeerInfo]) -> Iterator[Metric]:
    number = _Family("rmpa_peers", "Known peers, by state.", "gauge", ("state",))
    for state in PEER_STATES:
        number.add(sum(peer.state == state for peer in snapshot.peers), state)
    yield number.metric
    linked = _Family("rmpa_peer_linked", "Whether the peer has a link.", "gauge", ("peer",))
    missing = _Family(
        "rmpa_peer_link_missing",
        "Whether the peer has no link and should have one: it is neither linked nor relayed.",
        "gauge",
        ("peer",),
    )
    topics = _Family(
        "rmpa_peer_topics", "Topics that the peer offers (in) or is offered (out).", "gauge", ("peer", "direction")
    )
    hidden = _Family(
        "rmpa_peer_hidden",
        "Nodes, topics or services of a peer that this module hides because a limit is exceeded.",
        "gauge",
        ("peer", "kind"),
    )
    for peer in peers:
        linked.add(peer.state == "linked", peer.name)
        missing.add(peer.state not in _IN_ORDER, peer.name)
        topics.add(peer.topics_in, peer.name, "in")
        topics.add(peer.topics_out, peer.name, "out")
        for bound in peer.beyond:
            hidden.add(bound.hidden, peer.name, bound.kind)
    yield from (family.metric for family in (linked, missing, topics, hidden))


def _links(taken: float, links: Sequence[tuple[str, LinkInfo]]) -> Iterator[Metric]:
    figures: tuple[tuple[str, str, str, Callable[[LinkInfo], float | None]], ...] = (
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
    for name, help_, kind, value in figures:
        family = _Family(f"rmpa_link_{name}", help_, kind, ("peer",))
        for peer, link in links:
            family.add(value(link), peer)
        yield family.metric


_ROUTE: Final = ("topic", "peer", "node", "direction")


def _routes(taken: float, routes: Sequence[tuple[str, RouteInfo]]) -> Iterator[Metric]:
    figures: tuple[tuple[str, str, str, Callable[[RouteInfo], float | None]], ...] = (
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
    for name, help_, kind, value in figures:
        family = _Family(f"rmpa_route_{name}", help_, kind, _ROUTE)
        for topic, route in routes:
            family.add(value(route), *_key(topic, route))
        yield family.metric
    yield from _route_details(routes)


def _route_details(routes: Sequence[tuple[str, RouteInfo]]) -> Iterator[Metric]:
    discarded = _Family(
        "rmpa_route_discarded_messages", "Messages left out, by reason.", "counter", (*_ROUTE, "reason")
    )
    events = _Family("rmpa_route_contract_events", "Events of the topic's contract.", "counter", (*_ROUTE, "event"))
    latency = _Family(
        "rmpa_route_latency_seconds", "One-way latency in the last minute.", "summary", (*_ROUTE, "quantile")
    )
    period = _Family(
        "rmpa_route_period_seconds", "Time between messages in the last minute.", "summary", (*_ROUTE, "quantile")
    )
    for topic, route in routes:
        key = _key(topic, route)
        discarded.add(route.dropped, *key, "slow_receiver")
        discarded.add(route.late, *key, "late")
        discarded.add(route.expired, *key, "expired")
        discarded.add(route.oversized, *key, "oversized")
        known = dict.fromkeys(EVENT_KINDS, 0) if route.contract else {}
        for kind, count in {**known, **route.events}.items():
            events.add(count, *key, kind)
        latency.add_quantiles(route.latency, *key)
        period.add_quantiles(route.period, *key)
    yield from (family.metric for family in (discarded, events, latency, period))


def _services(services: Sequence[ServiceInfo]) -> Iterator[Metric]:
    labels = ("service", "peer", "direction")
    calls = _Family("rmpa_service_calls", "Service calls across the mesh.", "counter", labels)
    failed = _Family("rmpa_service_failed_calls", "Calls that ended with an error.", "counter", labels)
    active = _Family("rmpa_service_active_calls", "Calls under way.", "gauge", labels)
    latency = _Family(
        "rmpa_service_latency_seconds", "Latency of the last successful calls.", "summary", (*labels, "quantile")
    )
    for service in services:
        key = service.name, service.peer, service.direction
        calls.add(service.calls, *key)
        failed.add(service.failed, *key)
        active.add(service.active, *key)
        latency.add_quantiles(service.latency, *key)
    yield from (family.metric for family in (calls, failed, active, latency))


def _key(topic: str, route: RouteInfo) -> tuple[str, str, str, str]:
    return topic, route.peer, route.node, route.direction


def _at(taken: float, ago: float | None) -> float | None:
    return None if ago is None else round(taken - ago, 3)


# The text of ``/metrics`` of a large graph, made in a process of its own: ``python -m`` this module.
#
# Thousands of topics take some 0.5 s. A thread of the server would share its interpreter lock with all live
# clients,
# whose messages then wait for it again and again. The process costs its start, and runs with less priority than
# them.


_NICE: Final = 5


async def make_metrics(snapshot: Snapshot | None, accept: str, figures: Figures) -> tuple[bytes, str]:
    """The body of ``/metrics`` and its content type; see ``metrics.exposition``."""
    if snapshot is not None and sum(len(each.routes) for each in snapshot.topics) > limits.METRIC_ROUTES_IN_THREAD:
        made = await _in_process(pickle.dumps((msgspec.json.encode(snapshot), accept, figures)))
        if made is not None:
            return made
    return await asyncio.to_thread(exposition, snapshot, accept, tuple(web_metrics(figures)))


async def _in_process(asked: bytes) -> tuple[bytes, str] | None:
    """The answer of a process; ``None`` where it fails, as without memory for it."""
    try:
        process = await asyncio.create_subprocess_exec(
            sys.executable, "-m", __name__, stdin=asyncio.subprocess.PIPE, stdout=asyncio.subprocess.PIPE
        )
    except OSError:
        return None
    try:
        async with asyncio.timeout(limits.METRIC_PROCESS_TIMEOUT):
            answer, _ = await process.communicate(asked)
    except TimeoutError:
        return None
    finally:
        if process.returncode is None:
            process.kill()
            await process.wait()
    kind, _, body = answer.partition(b"\n")
    return (body, kind.decode()) if process.returncode == 0 else None


def main() -> None:
    """Read the question from the standard input, and write the content type and the body."""
    os.nice(_NICE)
    encoded, accept, figures = pickle.loads(sys.stdin.buffer.read())  # noqa: S301 - of the server that started it
    snapshot = msgspec.json.decode(encoded, type=Snapshot)
    body, kind = exposition(snapshot, accept, tuple(web_metrics(figures)))
    sys.stdout.buffer.write(kind.encode() + b"\n" + body)


if __name__ == "__main__":
    main()
