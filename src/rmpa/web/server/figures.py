"""The server's own figures, for ``/metrics``; no I/O."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Final

from prometheus_client.metrics_core import CounterMetricFamily, GaugeMetricFamily, SummaryMetricFamily

from rmpa.web.gateways.figures import PROTOCOLS, GatewayFigures
from rmpa.web.gateways.figures import REASONS as GATEWAY_REASONS
from rmpa.web.server import auth

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

    from prometheus_client.metrics_core import Metric

REASONS: Final = (
    *auth.REASONS,
    "method",
    "body",
    "malformed",
    "connections",
    "slow_request",
    "slow_response",
    "oversized",
    *GATEWAY_REASONS,
)
"""Why requests, connections and clients are refused; all are shown from 0 on, so that an alarm sees the first."""


@dataclass(frozen=True, slots=True)
class Figures:
    """What the server counts.

    Attributes:
        connections: Open at present.
        accepted: Connections so far.
        responses: Responses so far, by HTTP status.
        refused: Refusals so far, by the words of ``REASONS``.
        reads: Questions to the agent so far.
        read_seconds: Seconds that they took.
        gateways: What each gateway counts, by its protocol.
    """

    connections: int
    accepted: int
    responses: Mapping[str, int]
    refused: Mapping[str, int]
    reads: int
    read_seconds: float
    gateways: Mapping[str, GatewayFigures] = field(default_factory=dict)


def web_metrics(figures: Figures) -> Iterator[Metric]:
    """All metrics of the server."""
    yield GaugeMetricFamily("rmpa_web_connections", "Open connections of clients.", figures.connections)
    yield CounterMetricFamily("rmpa_web_accepted_connections", "Connections of clients so far.", figures.accepted)
    responses = CounterMetricFamily("rmpa_web_responses", "Responses by HTTP status.", labels=("status",))
    for status, count in sorted(figures.responses.items()):
        responses.add_metric((status,), count)
    yield responses
    refused = CounterMetricFamily(
        "rmpa_web_refused", "Requests, connections and WebSocket clients refused, by reason.", labels=("reason",)
    )
    for reason in REASONS:
        refused.add_metric((reason,), figures.refused.get(reason, 0))
    yield refused
    yield SummaryMetricFamily(
        "rmpa_web_agent_read_seconds", "Time to read the agent's snapshot.", figures.reads, figures.read_seconds
    )
    yield from _gateway_metrics(figures)


def _gateway_metrics(figures: Figures) -> Iterator[Metric]:
    labels = ("protocol",)
    clients = GaugeMetricFamily("rmpa_web_clients", "WebSocket clients of the gateways.", labels=labels)
    queued = GaugeMetricFamily("rmpa_web_client_queue_bytes", "Bytes that wait for these.", labels=labels)
    sent = CounterMetricFamily("rmpa_web_client_frames", "Messages and answers sent to these.", labels=labels)
    dropped = CounterMetricFamily(
        "rmpa_web_client_dropped_messages", "Messages dropped because one of these was slow.", labels=labels
    )
    for protocol in PROTOCOLS:
        gateway = figures.gateways.get(protocol, GatewayFigures())
        clients.add_metric((protocol,), gateway.clients)
        queued.add_metric((protocol,), gateway.queued)
        sent.add_metric((protocol,), gateway.sent)
        dropped.add_metric((protocol,), gateway.dropped)
    yield from (clients, queued, sent, dropped)
