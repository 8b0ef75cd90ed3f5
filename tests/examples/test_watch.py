from __future__ import annotations

import json

import pytest
from rich.console import Console

import table
from watch import COMMAND, ORDER, PoseView, Watch

ODOM = "/odom"


def drive(watch: Watch, start: float, seconds: float, *, order_after: float | None = 0.002) -> None:
    """Ten commands a second, each answered, and odometry at 50 Hz."""
    events: list[tuple[float, str]] = []
    for tick in range(round(seconds * 10)):
        events.append((start + tick / 10, COMMAND))
        if order_after is not None:
            events.append((start + tick / 10 + order_after, ORDER))
    events += [(start + 0.001 + tick / 50, ODOM) for tick in range(round(seconds * 50))]
    for at, topic in sorted(events):
        watch.message(topic, at, None if topic == ORDER else 0.0005)


def test_figures_of_a_steady_drive() -> None:
    watch = Watch(100.0)
    drive(watch, 100.0, 5.0)
    view = watch.view(105.0)
    assert {name: round(topic.rate, 3) for name, topic in view.topics.items()} == {COMMAND: 10, ORDER: 10, ODOM: 50}
    assert view.topics[COMMAND].messages == 50
    assert view.topics[COMMAND].period.sd == pytest.approx(0, abs=1e-9)
    latency = view.topics[ODOM].latency
    assert latency is not None
    assert latency.p50 == pytest.approx(0.0005)
    assert view.topics[ORDER].latency is None
    assert view.command_to_velocity.mean == pytest.approx(0.002)
    assert view.unanswered == 0


def test_a_lost_order_is_counted() -> None:
    watch = Watch(100.0)
    drive(watch, 100.0, 3.0)
    watch.message(COMMAND, 103.0)
    watch.message(COMMAND, 103.1)
    watch.message(ORDER, 103.102)
    view = watch.view(103.2)
    assert view.unanswered == 1
    assert view.command_to_velocity.max == pytest.approx(0.002)


def test_an_outage_of_a_module_is_no_period() -> None:
    watch = Watch(100.0)
    everyone = dict.fromkeys(("joystick", "velocity", "base"), "linked")
    watch.peers(everyone, 100.2)
    drive(watch, 100.0, 5.0)
    assert {name: module.state for name, module in watch.view(105.0).modules.items()} == {
        "joystick": "linked",
        "velocity": "linked",
        "base": "linked",
        "pc": "here",
    }
    for name, profile in (("joystick", "steady"), ("base", "full")):
        watch.profile(name, profile)
    watch.killed("base", 105.0)
    watch.peers({**everyone, "base": "linking"}, 105.25)
    assert watch.view(105.3).modules["base"].state == "gone"
    assert [module.profile for module in watch.view(105.3).modules.values()] == ["steady", "", "", ""]
    watch.started("base", 106.0)
    watch.message(ODOM, 106.01)  # of the run before
    watch.peers(everyone, 106.5)
    watch.message(ODOM, 106.6)
    drive(watch, 106.6, 3.0)
    view = watch.view(109.6, whole=True)
    assert view.modules["base"].state == "linked"
    (restart,) = view.restarts
    assert (restart.module, restart.killed) == ("base", 5.0)
    assert restart.seen_gone_after == pytest.approx(0.25)
    assert restart.back_after == pytest.approx(0.6)
    watch.profile("base", "saving")
    view = watch.view(109.6)
    assert "base:linked/saving" in table.line(view)
    assert view.modules["joystick"].profile == "steady"
    watch.peers({**everyone, "joystick": "linking"}, 109.8)
    assert watch.view(109.8).modules["joystick"].profile == "", "it may be another when it comes back"
    view = watch.view(109.8, whole=True)
    assert view.topics[ODOM].period.max == pytest.approx(0.02)


def test_everything_can_be_shown() -> None:
    watch = Watch(100.0)
    console = Console(width=80, record=True, force_terminal=True)
    watch.peers(dict.fromkeys(("joystick", "velocity", "base"), "linked"), 100.0)
    for at in (100.0, 105.0):
        console.print(table.live(watch.view(at), watch.trail()))
        drive(watch, 100.0, 5.0)
        watch.pose(PoseView(1.0, 2.0, 0.5, 0.3, 0.1), 104.0)
        watch.killed("base", 104.5)
        watch.note("joystick: is gone")
        watch.profile("base", "saving")
    view = watch.view(105.0, whole=True)
    console.print(*table.summary(view))
    text = console.export_text()
    assert "joystick: is gone" in text
    assert "base killed" in text
    assert "saving" in text
    assert max(map(len, text.splitlines())) <= 80
    assert "…" not in text, "a column is too narrow"
    assert "CMD 10.0 Hz" in table.line(watch.view(105.0))
    assert json.loads(table.json_line(Watch(0.0).view(0.0)))["command_to_velocity"]["mean"] is None
    assert json.loads(table.json_summary(view))["summary"]["topics"][ODOM]["messages"] == 500
