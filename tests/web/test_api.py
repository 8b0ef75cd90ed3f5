"""What programs read: the REST API; /metrics, as Prometheus reads it, and the dashboard that uses it."""

from __future__ import annotations

import contextlib
import json
import re
import shutil
import subprocess
from pathlib import Path
from typing import Any

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st
from prometheus_client.openmetrics.parser import text_string_to_metric_families as parse_openmetrics
from prometheus_client.parser import text_string_to_metric_families

from rmpa.bridge.data.quality import QosEventKind
from rmpa.core.facts import RouteInfo, ServiceInfo, TopicInfo
from rmpa.observe.snapshot import PeerInfo, Snapshot
from rmpa.web import api as rest
from rmpa.web import limits
from rmpa.web.api import EVENT_KINDS, content_type, exposition, metrics, web_metrics
from rmpa.web.server.access import Problem
from tests.web.snapshots import AGENT, FULL, SERVICE, peer, route

API = "/api/v1"


def get(path: str, snapshot: Snapshot | None = FULL) -> bytes:
    return rest.respond(API + path, snapshot)


def missing(path: str, snapshot: Snapshot | None = FULL) -> str:
    """Why there is nothing."""
    with pytest.raises(Problem) as found:
        rest.respond(path, snapshot)
    body = msgspec.json.decode(found.value.body, type=dict[str, str | int])
    assert (body["status"], body["detail"]) == (404 if snapshot else 503, found.value.detail)
    return found.value.detail


def test_the_snapshot_comes_whole_and_its_parts_alone() -> None:
    for path, kind, wanted in (
        ("/snapshot", Snapshot, FULL),
        ("/peers", tuple[PeerInfo, ...], FULL.peers),
        ("/peers/hand", PeerInfo, FULL.peers[1]),
        ("/counters", dict, {"beacon.malformed": 11}),
        ("/notes", list, ["port taken"]),
    ):
        assert msgspec.json.decode(get(path), type=kind) == wanted


@pytest.mark.parametrize("path", ["/topics/image", "/topics//image", "/topics/%2Fimage", "/topics/%69mage"])
def test_a_topic_is_found_by_its_name_however_its_slash_is_written(path: str) -> None:
    assert msgspec.json.decode(get(path), type=TopicInfo) == FULL.topics[0]


def test_all_services_of_a_name_come_which_may_have_slashes() -> None:
    body = get("/services/camera/get_loggers")
    assert [each.node for each in msgspec.json.decode(body, type=list[ServiceInfo])] == ["/camera"]
    both = (SERVICE, msgspec.structs.replace(SERVICE, peer="hand"))
    body = get("/services/set_bool", Snapshot(agent=AGENT, taken=1.0, services=both))
    assert msgspec.json.decode(body, type=tuple[ServiceInfo, ...]) == both


@pytest.mark.parametrize(
    ("path", "said"),
    [
        (f"{API}/topics/imgae", "did you mean /image?"),
        (f"{API}/peers/zzzzz", f"{API}/peers lists all"),
        (f"{API}/topics/a%20b", "that is not a ROS name"),
        *((API + path, "there is no") for path in ("", "/", "/nothing", "/snapshot/x", "/peers/", "/counters/x")),
        *((path, "there is no") for path in (f"{API}/topics/%00%ff", "/metrics", "/api/v2/snapshot")),
    ],
)
def test_what_is_not_there_is_said(path: str, said: str) -> None:
    assert said in missing(path)


def test_a_path_that_is_too_long_is_not_read(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(limits, "REST_PATH_MAX", len(f"{API}/topics/imag"))
    assert "there is no" in missing(f"{API}/topics/image")
    assert get("/topics")


@given(st.text(max_size=40))
def test_no_path_breaks_it(path: str) -> None:
    for prefix in ("", f"{API}/", f"{API}/topics/"):
        with contextlib.suppress(Problem):
            msgspec.json.decode(rest.respond(prefix + path, FULL))


EVERYTHING = (*metrics(FULL), *web_metrics((1, 2), {"200": 3}, {"host": 4}, (5, 0.6), {}))
DOCS = Path(__file__).parents[2] / "docs"
DASHBOARD = DOCS / "grafana" / "rmpa.json"
PAGE = DOCS / "reference" / "metrics.md"
PROMTOOL = shutil.which("promtool")
with_promtool = pytest.mark.skipif(PROMTOOL is None, reason="promtool is not installed (apt install prometheus)")
ROUTE = {"topic": "/image", "peer": "arm", "node": "/camera", "direction": "in"}


def samples(snapshot: Snapshot | None) -> dict[tuple[str, frozenset[tuple[str, str]]], float]:
    text = exposition(metrics(snapshot)).decode()
    found = {}
    for family in text_string_to_metric_families(text):
        assert family.documentation, family.name
        for sample in family.samples:
            key = sample.name, frozenset(sample.labels.items())
            assert key not in found, f"{key} comes twice"
            found[key] = sample.value
    return found


def value(name: str, labels: dict[str, str], snapshot: Snapshot | None = FULL) -> float:
    return samples(snapshot)[name, frozenset(labels.items())]


@pytest.mark.parametrize(
    ("name", "labels", "expected"),
    [
        ("rmpa_up", {}, 1),
        ("rmpa_agent_info", {"module": "base", "version": "0.1.0", "domain": "3"}, 1),
        ("rmpa_agent_cpu_usage_ratio", {}, 0.125),
        ("rmpa_agent_resident_memory_bytes", {}, 50e6),
        ("rmpa_agent_fd_refusals_total", {}, 2),
        ("rmpa_topics", {}, 2),
        ("rmpa_topics_crossing", {}, 1),
        ("rmpa_topics_mismatched", {}, 1),
        ("rmpa_nodes_unreachable", {}, 1),
        ("rmpa_discards_total", {"reason": "beacon.malformed"}, 11),
        ("rmpa_peers", {"state": "linked"}, 1),
        ("rmpa_peers", {"state": "refused"}, 0),
        ("rmpa_peer_linked", {"peer": "hand"}, 0),
        ("rmpa_peer_link_missing", {"peer": "hand"}, 1),
        ("rmpa_peer_link_missing", {"peer": "arm"}, 0),
        ("rmpa_peer_hidden", {"peer": "arm", "kind": "topics"}, 8),
        ("rmpa_link_clock_offset_seconds", {"peer": "arm"}, -0.25),
        ("rmpa_link_start_time_seconds", {"peer": "arm"}, 1_000_050.0),
        ("rmpa_link_receive_bytes_total", {"peer": "arm"}, 1000),
        ("rmpa_route_messages_total", ROUTE, 600),
        ("rmpa_route_lost_messages_total", ROUTE, 2),
        ("rmpa_route_discarded_messages_total", ROUTE | {"reason": "late"}, 5),
        ("rmpa_route_contract_events_total", ROUTE | {"event": "deadline_missed"}, 7),
        ("rmpa_route_latency_seconds", ROUTE | {"quantile": "0.99"}, 0.009),
        ("rmpa_route_last_message_timestamp_seconds", ROUTE, 1_000_099.95),
        ("rmpa_service_calls_total", {"service": "/set_bool", "peer": "arm", "direction": "in"}, 9),
        (
            "rmpa_service_latency_seconds",
            {"service": "/set_bool", "peer": "arm", "direction": "in", "quantile": "0.5"},
            0.1,
        ),
    ],
)
def test_each_figure_of_the_snapshot_has_its_unit(name: str, labels: dict[str, str], expected: float) -> None:
    assert value(name, labels) == pytest.approx(expected)


def test_events_of_a_contract_begin_at_0_so_that_an_alarm_sees_the_first() -> None:
    assert set(EVENT_KINDS) == set(QosEventKind)
    strict = msgspec.structs.replace(route(), contract={"deadline": 0.1}, events={"messages_lost": 3})
    free = msgspec.structs.replace(route(), events={})
    for each, expected in ((strict, dict.fromkeys(EVENT_KINDS, 0.0) | {"messages_lost": 3.0}), (free, {})):
        snapshot = Snapshot(agent=AGENT, taken=1.0, topics=(TopicInfo(name="/t", routes=(each,)),))
        name = "rmpa_route_contract_events_total"
        shown = {dict(labels)["event"]: count for (n, labels), count in samples(snapshot).items() if n == name}
        assert shown == expected


def test_what_is_not_known_or_not_used_is_left_out() -> None:
    assert samples(None) == {("rmpa_up", frozenset()): 0.0}
    found = samples(Snapshot(agent=msgspec.structs.replace(AGENT, cpu=None, rss=None, files=None), taken=1.0))
    assert not any("cpu" in name or "fds" in name for name, _ in found)
    names = {dict(labels).get("service") for _, labels in samples(FULL)}
    assert ("/camera/get_loggers" in names, "/home" in names) == (False, True)  # each node has the first


def test_the_number_of_time_series_is_bounded_and_what_is_left_out_is_counted(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(limits, "METRIC_ROUTES", 3)
    monkeypatch.setattr(limits, "METRIC_PEERS", 2)
    topic = TopicInfo(name="/t", routes=tuple(route(node=f"/n{number}") for number in range(5)))
    peers = tuple(peer(f"p{number}") for number in range(6))
    snapshot = Snapshot(agent=AGENT, taken=1.0, peers=peers, topics=(topic,))
    found = samples(snapshot)
    assert found["rmpa_metrics_omitted", frozenset({("kind", "route")})] == 2
    assert found["rmpa_metrics_omitted", frozenset({("kind", "peer")})] == 4
    assert sum(name == "rmpa_route_messages_total" for name, _ in found) == 3
    assert found["rmpa_peers", frozenset({("state", "linked")})] == 6


def test_what_is_used_comes_before_what_is_not(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(limits, "METRIC_ROUTES", 1)
    idle = RouteInfo(peer="a", node="/n", direction="in", state="idle", type="std_msgs/String")
    used = msgspec.structs.replace(idle, state="open")
    topics = (TopicInfo(name="/a", routes=(idle,)), TopicInfo(name="/b", routes=(used,)))
    found = samples(Snapshot(agent=AGENT, taken=1.0, topics=topics, topics_left=9, services_left=4))
    assert [dict(labels)["topic"] for name, labels in found if name == "rmpa_route_open"] == ["/b"]
    assert found["rmpa_metrics_omitted", frozenset({("kind", "route")})] == 10
    assert found["rmpa_topics", frozenset()] == 11
    assert found["rmpa_services", frozenset()] == 4


def test_hostile_names_break_nothing() -> None:
    names = ('a"b\\c\nd', "x" * 1000, "x" * 1001, "caf\udce9", "")
    snapshot = Snapshot(agent=AGENT, taken=1.0, peers=tuple(peer(name) for name in names))
    found = samples(snapshot)
    shown = [dict(labels)["peer"] for name, labels in found if name == "rmpa_peer_linked"]
    assert 'a"b\\c\nd' in shown
    assert len(shown) == 4
    assert max(map(len, shown)) == limits.METRIC_LABEL_CHARACTERS


# --- the dashboard ---


def expressions() -> list[str]:
    found: list[str] = []

    def walk(part: Any) -> None:
        if isinstance(part, dict):
            found.extend(part[key] for key in ("expr", "definition") if isinstance(part.get(key), str))
            for each in part.values():
                walk(each)
        elif isinstance(part, list):
            for each in part:
                walk(each)

    walk(json.loads(DASHBOARD.read_text(encoding="utf-8")))
    return found


def test_the_dashboard_uses_metrics_and_labels_that_there_are() -> None:
    found = samples(FULL)
    names = {name for name, _ in found}
    labels = {label for _, pairs in found for label, _ in pairs} | {"instance", "job"}
    assert expressions()
    for expression in expressions():
        used = set(re.findall(r"\brmpa_\w+", expression))
        assert used, expression
        assert used <= names, f"{expression}: there is no {used - names}"
        for inside in re.findall(r"\{([^}]*)\}", expression):
            assert set(re.findall(r"(\w+)\s*[=!]", inside)) <= labels, expression


def check_rules(file: Path) -> None:
    assert PROMTOOL is not None
    checked = subprocess.run([PROMTOOL, "check", "rules", str(file)], check=False, capture_output=True, timeout=30)
    assert checked.returncode == 0, checked.stdout.decode() + checked.stderr.decode()


@with_promtool
def test_each_query_of_the_dashboard_is_valid_promql(tmp_path: Path) -> None:
    queries = [each for each in expressions() if not each.startswith("label_values")]
    rules = [
        {"record": f"check:{number}", "expr": re.sub(r"\$\w+", "x", each.replace("$__rate_interval", "5m"))}
        for number, each in enumerate(queries)
    ]
    file = tmp_path / "rules.json"
    file.write_text(json.dumps({"groups": [{"name": "dashboard", "rules": rules}]}), encoding="utf-8")
    check_rules(file)


@with_promtool
def test_the_alarms_of_the_page_are_valid_rules_about_metrics_that_there_are(tmp_path: Path) -> None:
    blocks = re.findall(r"```yaml\n(.*?)```", PAGE.read_text("utf-8"), re.DOTALL)
    rules = next(block for block in blocks if "expr:" in block)
    file = tmp_path / "rules.yaml"
    file.write_text(rules, encoding="utf-8")
    check_rules(file)
    assert set(re.findall(r"rmpa_\w+", rules)) <= {name for name, _ in samples(FULL)}


def test_the_page_has_a_row_for_each_metric() -> None:
    rows = re.findall(r"^\| `(rmpa_\w+)` \| (\w+) \| ([^|]+) \| ([^|]+) \|$", PAGE.read_text("utf-8"), re.MULTILINE)
    written = {name: (kind, set(re.findall(r"\w+", labels)), meaning) for name, kind, labels, meaning in rows}
    families = parse_openmetrics(exposition(EVERYTHING, content_type("application/openmetrics-text")).decode())  # type: ignore[no-untyped-call]
    known = {
        family.samples[0].name: (family.type, set(family.samples[0].labels), family.documentation)
        for family in families
    }
    assert written == known


def test_a_service_has_one_series_for_each_peer() -> None:
    services = tuple(msgspec.structs.replace(SERVICE, peer=name, calls=number) for number, name in enumerate("ab"))
    snapshot = Snapshot(agent=AGENT, taken=1.0, services=services)
    assert value("rmpa_service_calls_total", {"service": "/set_bool", "peer": "b", "direction": "in"}, snapshot) == 1
