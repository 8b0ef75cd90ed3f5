"""``rmpa resource start``, ``stop``, ``log`` and ``rmpa top`` beside a fake agent: what is asked, shown, refused."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import pytest

from rmpa.bridge.launched import LaunchedProcess, LaunchedResource, ModuleResources, ResourceLog
from rmpa.cli.launch import _read_name
from rmpa.core.errors import ConfigError
from rmpa.ros.environment import NodeCost
from tests.cli.conftest import Place

Fake = Callable[..., None]
DRIVER = LaunchedProcess(node="/driver", pid=43, cpu=0.125, rss=25_000_000, restarts=2, state="running", own=True)


def camera(state: str = "active", why: str = "", **more: Any) -> LaunchedResource:
    pid = 42 if state == "active" else None
    processes = (DRIVER,) if pid else ()
    return LaunchedResource(
        name="camera", file="camera.py", state=state, pid=pid, why=why, processes=processes, **more
    )


def test_a_resource_is_started_where_it_is_named(place: Place, agent: Fake) -> None:
    asked: list[dict[str, Any]] = []

    def launch(args: dict[str, Any]) -> Any:
        asked.append(args)
        return (ModuleResources(module=str(args.get("module", "arm")), resources=(camera(),)),)

    agent(launch=launch)
    code, output, _ = place.run("resource", "start", "base:camera")
    assert (code, output.splitlines()) == (
        0,
        ["base:camera is active, process 42", "  /driver is running: process 43, 12 %, 25.0 MB"],
    )
    assert asked == [{"what": "start", "name": "camera", "module": "base"}]
    (found,) = place.json("resource", "restart", "/camera", "--json")
    assert (found["module"], found["state"], found["processes"][0]["node"]) == ("arm", "active", "/driver")
    assert asked[-1] == {"what": "restart", "name": "camera"}


def test_what_is_refused_or_fails_is_said_and_exits_1(place: Place, agent: Fake) -> None:
    answers = {
        "start": ModuleResources(module="base", problem="the permissions there do not let arm", code="not-permitted"),
        "stop": ModuleResources(module="base", resources=(camera("failed", "has ended\x1b[2J"),)),
    }
    agent(launch=lambda args: (answers[args["what"]],))
    code, _, errors = place.run("resource", "start", "base:camera")
    assert code == 1
    assert "base: the permissions there do not let arm; a [[permission]] there may allow it: launch" in errors
    assert "[not-permitted]" in errors
    code, output, _ = place.run("resource", "stop", "base:camera")
    assert (code, output) == (1, "base:camera is failed: has ended\\x1b[2J\n")


def test_only_a_name_is_asked_for() -> None:
    assert _read_name("camera.resource.toml") == _read_name("/camera") == (None, "camera")
    assert _read_name("base:camera.py") == ("base", "camera")
    for text in ("../camera", "/etc/passwd", "", "base:", "~/camera.py"):
        with pytest.raises(ConfigError, match="is not the name of a resource"):
            _read_name(text)


def test_the_log_of_a_resource_has_its_nodes_in_front(place: Place, agent: Fake) -> None:
    logs = (
        ResourceLog(source="", lines=("active",), next=7),
        ResourceLog(source="driver", lines=("open\x1b[2J", "up"), next=9),
    )
    asked: list[dict[str, Any]] = []

    def launch(args: dict[str, Any]) -> Any:
        asked.append(args)
        return (ModuleResources(module="arm", logs=logs),)

    agent(launch=launch)
    assert place.run("resource", "log", "camera")[1] == "active\ndriver: open\\x1b[2J\ndriver: up\n"
    assert asked == [{"what": "log", "name": "camera", "lines": 50}]
    lines = place.json("resource", "log", "camera", "--node", "driver", "-n", "2", "--json")
    assert [each["text"] for each in lines] == ["open\x1b[2J", "up"]
    code, _, errors = place.run("resource", "log", "camera", "--node", "drivr")
    assert (code, "did you mean driver?" in errors) == (1, True)


def test_top_shows_all_modules_and_says_which_does_not_answer(
    place: Place, agent: Fake, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("rmpa.cli.launch._MEASURED", 0.0)
    now = time.time()
    busy = NodeCost(node="/driver", pid=43, cpu=0.5, rss=25_000_000, threads=4, since=now - 90, started_by="camera")
    idle = NodeCost(node="/idle", pid=44, rss=1_000_000, threads=1, since=now - 3)
    far = NodeCost(node="/far")
    told = {"arm": (idle, busy, far), "old": "agent 'old' does not answer"}
    rates = {"arm": [["/frames", 30.0, 2e6, "counted"], ["/mute", None, None, "no subscriber"]], "old": "no"}
    agent(top=lambda _args: told, rates=lambda _args: rates)
    code, output, errors = place.run("top", "--once")
    assert code == 0
    rows = [line.split() for line in output.splitlines()]
    assert rows[1] == ["arm:/driver", "43", "50", "%", "25.0", "MB", "4", "2", "min", "camera"]
    assert rows[2][:2] == ["arm:/far", "-"]
    assert rows[3][:2] == ["arm:/idle", "44"]
    assert rows[-1] == ["arm:/frames", "30.0", "Hz", "2.00", "MB/s"]
    assert "old: agent 'old' does not answer" in errors
    assert place.run("top", "old")[0] == 1
    (found,) = place.json("top", "--json")
    first, second = found["modules"]
    assert (first["nodes"][1]["started_by"], first["topics"][0]["topic"]) == ("camera", "/frames")
    assert (second["problem"], second["nodes"]) == ("agent 'old' does not answer", [])
