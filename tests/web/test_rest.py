"""The REST API."""

from __future__ import annotations

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rmpa.observe.peer_info import PeerInfo
from rmpa.observe.snapshot import ServiceInfo, Snapshot, TopicInfo
from rmpa.web import api as rest
from rmpa.web import limits
from tests.web.snapshots import AGENT, FULL, SERVICE

API = "/api/v1"


def get(path: str, snapshot: Snapshot | None = FULL) -> rest.RestResponse:
    return rest.respond(API + path, snapshot)


def problem(response: rest.RestResponse) -> str:
    assert response.content_type == "application/problem+json"
    body = msgspec.json.decode(response.body, type=rest.Problem)
    assert (body.status, body.detail) == (response.status, response.detail)
    return body.detail


def test_the_snapshot_comes_whole() -> None:
    response = get("/snapshot")
    assert (response.status, response.content_type) == (200, "application/json")
    assert msgspec.json.decode(response.body, type=Snapshot) == FULL


def test_its_parts_come_alone() -> None:
    assert msgspec.json.decode(get("/peers").body, type=tuple[PeerInfo, ...]) == FULL.peers
    assert msgspec.json.decode(get("/peers/hand").body, type=PeerInfo) == FULL.peers[1]
    assert msgspec.json.decode(get("/counters").body) == {"beacon.malformed": 11}
    assert msgspec.json.decode(get("/notes").body) == ["port taken"]


@pytest.mark.parametrize("path", ["/topics/image", "/topics//image", "/topics/%2Fimage", "/topics/%69mage"])
def test_a_topic_is_found_by_its_name_however_its_slash_is_written(path: str) -> None:
    assert msgspec.json.decode(get(path).body, type=TopicInfo) == FULL.topics[0]


def test_a_name_with_slashes_needs_no_encoding() -> None:
    body = get("/services/camera/get_loggers").body
    assert [each.node for each in msgspec.json.decode(body, type=list[ServiceInfo])] == ["/camera"]


def test_all_services_of_a_name_come() -> None:
    both = (SERVICE, msgspec.structs.replace(SERVICE, peer="hand"))
    body = get("/services/set_bool", Snapshot(agent=AGENT, taken=1.0, services=both)).body
    assert msgspec.json.decode(body, type=tuple[ServiceInfo, ...]) == both


def test_a_name_that_is_nearly_right_gets_a_hint() -> None:
    assert "did you mean /image?" in problem(get("/topics/imgae"))
    assert f"{API}/peers lists all" in problem(get("/peers/zzzzz"))
    assert get("/topics/imgae").status == 404


@pytest.mark.parametrize("path", ["", "/", "/nothing", "/snapshot/x", "/peers/", "/counters/x", "/topics/%00%ff"])
def test_what_is_not_there_is_said(path: str) -> None:
    response = get(path)
    assert response.status == 404
    assert "there is no" in problem(response)


def test_a_path_outside_of_the_api_is_not_its_business() -> None:
    assert rest.respond("/metrics", FULL).status == 404
    assert rest.respond("/api/v2/snapshot", FULL).status == 404


def test_a_path_that_is_too_long_is_not_read(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(limits, "REST_PATH_MAX", len(f"{API}/topics/imag"))
    assert get("/topics/image").status == 404
    assert get("/topics").status == 200


def test_without_an_agent_it_says_so_and_what_to_do() -> None:
    response = get("/snapshot", None)
    assert response.status == 503
    assert "rmpa up" in problem(response)


@given(st.text(max_size=40))
def test_no_path_breaks_it(path: str) -> None:
    for prefix in ("", f"{API}/", f"{API}/topics/"):
        response = rest.respond(prefix + path, FULL)
        assert response.status in (200, 404)
        msgspec.json.decode(response.body)
