"""Metrics of a large graph, made beside the server."""

from __future__ import annotations

import asyncio
import sys
from typing import TYPE_CHECKING

import msgspec
import pytest

from rmpa.web import limits
from rmpa.web.api import exposition, make_metrics
from rmpa.web.server.access import Figures, web_metrics
from tests.web.snapshots import FULL

if TYPE_CHECKING:
    from rmpa.observe.snapshot import Snapshot

OPEN_METRICS = "application/openmetrics-text; version=1.0.0"
FIGURES = Figures(1, 2, {"200": 3}, {}, 4, 0.5)


def large() -> Snapshot:
    topic = max(FULL.topics, key=lambda each: len(each.routes))
    copies = [msgspec.structs.replace(topic, name=f"/t{number}") for number in range(limits.METRIC_ROUTES_IN_THREAD)]
    return msgspec.structs.replace(FULL, topics=(*FULL.topics, *copies))


@pytest.mark.parametrize("accept", ["", OPEN_METRICS])
async def test_a_large_graph_has_the_same_metrics_without_the_server_s_thread(
    accept: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    snapshot = large()
    expected = exposition(snapshot, accept, tuple(web_metrics(FIGURES)))
    with monkeypatch.context() as patch:
        patch.delattr(asyncio, "to_thread")
        assert await make_metrics(snapshot, accept, FIGURES) == expected


async def test_metrics_are_made_all_the_same_where_no_process_can_be_started(monkeypatch: pytest.MonkeyPatch) -> None:
    snapshot = large()
    expected = exposition(snapshot, "", tuple(web_metrics(FIGURES)))
    for program in ("/nonexistent", "/bin/false"):
        monkeypatch.setattr(sys, "executable", program)
        assert await make_metrics(snapshot, "", FIGURES) == expected
