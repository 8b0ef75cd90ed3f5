"""Smart Resources end to end: ``rmpa run`` in two modules, real rospy clients, a link that is degraded, kill -9."""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import pytest

from lab.bed.agents import RMPA, Agent
from lab.bed.namespaces import Host, Lab
from lab.bed.processes import Event, Process, eventually
from tests.interop.conftest import ShellFactory
from tests.interop.ros import Ros

pytestmark = [pytest.mark.ros, pytest.mark.netns, pytest.mark.timeout(180)]

RESOURCES: Final = Path(__file__).parent / "resources"
OK, WARN, ERROR, STALE = range(4)
# Seconds for windows, cool-downs and routes on a shared machine.
LONG: Final = 40.0


@dataclass
class Running:
    """A module of one file, run as a user runs it, and a ROS user's shell beside it."""

    host: Host
    agent: Agent
    ros: Ros
    file: Path
    process: Process | None = None

    def start(self, *words: str) -> Process:
        """``rmpa run`` with an agent of its own; return when its resource is active."""
        argv: list[str | Path] = [RMPA, "run", self.file, "--name", self.agent.name, *words]
        self.process = Process(self.host.command(argv), env=self.agent.env, name=self.file.name)
        self.process.wait_for("active on", LONG)
        return self.process

    def end(self) -> None:
        """Make sure that it is gone; a failing test shows its output."""
        if self.process is not None:
            self.process.end()
            print(self.process.output[-8000:])

    def client(self, name: str, **options: str) -> Process:
        """A rospy node that asks and listens."""
        node = self.ros.rospy("quality_client", commands=True, name=name, **options)  # type: ignore[arg-type]  # of the node
        node.wait_event("up")
        return node


@pytest.fixture
def pair(lab: Lab, shell: ShellFactory, tmp_path: Path) -> Iterator[tuple[Running, Running]]:
    """The camera in one module and the viewer in another, not started."""
    with ExitStack() as stack:
        made = []
        for host, file in zip(lab.hosts("cam", "pc"), ("camera.py", "viewer.py"), strict=True):
            one = Running(host, Agent(host, tmp_path, name=host.name), shell(host), RESOURCES / file)
            stack.callback(one.end)
            made.append(one)
        yield made[0], made[1]


def ask(node: Process, **values: str) -> None:
    node.tell(json.dumps(values))


def heard(node: Process, kind: str, level: int, text: str = "", *, name: str = "", since: int = 0) -> Event:
    """Wait for a status of this level."""

    def fits(event: Event) -> bool:
        own = kind != "response" or bool(event["own"])
        return own and event["level"] == level and text in str(event["message"]) and name in str(event["name"])

    return node.wait_event(kind, LONG, where=fits, since=since)


def runs(node: Process, profile: str, since: int = 0) -> None:
    node.wait_event("profile", LONG, where=lambda e: e["name"] == profile, since=since)


def test_a_resource_adapts_to_a_degraded_link(pair: tuple[Running, Running]) -> None:
    camera, viewer = pair
    camera.start()
    viewer.start()
    driver = viewer.client("driver", observe="/camera/frames")
    watcher = viewer.client("watcher")
    ask(driver, rate=">= 10 Hz hard", sharpness=">= 640")
    runs(driver, "full")
    heard(driver, "response", OK, "profile full")

    mark = driver.mark_events()
    camera.host.shape("2mbit")
    alarm = heard(driver, "alarm", WARN, "rate fell short under full; small takes over", since=mark)
    assert "wanted at least 10 Hz, given" in str(alarm["values"])
    heard(driver, "diagnostics", WARN, "adaptation", name="camera", since=mark)
    runs(driver, "small", since=mark)
    heard(driver, "response", WARN, "sharpness falls short", since=mark)  # soft, and known: all else is given
    over = heard(driver, "alarm", OK, "over: adaptation", since=mark)
    assert "reaction" in dict(over["values"])  # type: ignore[call-overload] # a mapping

    mark = driver.mark_events()
    camera.host.unshape()
    runs(driver, "full", since=mark)  # behind its cool-down, and only because it is better
    heard(driver, "response", OK, "profile full", since=mark)

    mark = driver.mark_events()
    ask(driver, rate=">= 50 Hz hard")
    heard(driver, "alarm", ERROR, "no profile gives rate as asked; rescue is the best there is", since=mark)
    heard(driver, "response", ERROR, "non-adaptable", since=mark)
    heard(driver, "diagnostics", ERROR, "non-adaptable", name="camera", since=mark)
    runs(driver, "rescue", since=mark)

    ask(driver, rate=">= 10 parsecs")
    heard(driver, "response", ERROR, "parsecs", since=mark)
    mark = watcher.mark_events()
    driver.kill()  # with it goes what it asked
    watcher.wait_event("clients", LONG, where=lambda e: e["names"] == [], since=mark)
    heard(watcher, "diagnostics", OK, "profile", name="camera", since=mark)


def test_what_was_asked_chosen_and_set_is_back_after_a_crash(pair: tuple[Running, Running]) -> None:
    camera, viewer = pair
    first = camera.start()
    viewer.start()
    driver, watcher = viewer.client("driver"), viewer.client("watcher", resource="/viewer")
    heard(watcher, "diagnostics", OK, name="viewer")
    ask(driver, rate=">= 10 Hz", sharpness=">= 600")
    runs(driver, "full")
    choose = ["rosservice", "call", "/camera/set_parameters"]
    change = "config: {doubles: [{name: exposure, value: 7.5}], strs: [{name: profile, value: small}]}"
    camera.ros.tool(*choose, change)
    runs(driver, "small")
    store = Path(camera.agent.env["RMPA_STATE_DIR"]) / camera.agent.name / "camera.json"
    eventually(lambda: kept(store) == ("small", {"exposure": 7.5}), what="it to be kept")

    mark, stale = driver.mark_events(), watcher.mark_events()
    first.kill()
    killed = driver.mark_events()
    heard(watcher, "diagnostics", STALE, "no node publishes /camera/frames", name="viewer", since=stale)
    heard(watcher, "alarm", STALE, "no node publishes /camera/frames", since=stale)
    again = watcher.mark_events()
    second = camera.start()
    assert "remembered: 1 parameters, 1 clients, profile small chosen by hand" in second.output
    runs(driver, "small", since=mark)
    heard(driver, "response", WARN, "sharpness falls short", since=killed)
    assert "7.5" in camera.ros.tool("rosparam", "get", "/camera/exposure")
    heard(watcher, "alarm", OK, "over: no node publishes /camera/frames", since=again)
    heard(watcher, "diagnostics", OK, name="viewer", since=again)

    assert second.interrupt() == 0
    store.write_bytes(b"not what it was")
    third = camera.start()
    assert "camera.json is damaged" in third.output
    assert store.with_name("camera.json.damaged").exists()


def kept(store: Path) -> tuple[str, dict[str, float]]:
    """The profile chosen by hand and the parameters in a resource's file."""
    found: dict[str, Any] = json.loads(store.read_text()) if store.exists() else {"chosen": "", "parameters": {}}
    return found["chosen"], found["parameters"]
