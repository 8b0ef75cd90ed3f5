from __future__ import annotations

import json

import pytest
from rich.console import Console

import table
from trail import draw
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


def test_the_agent_tells_the_latency_of_what_has_no_header() -> None:
    watch = Watch(100.0)
    watch.latency(ORDER, 100.0, 9.0)  # before the first message there is nothing to measure
    drive(watch, 100.0, 1.0)
    watch.latency(ORDER, 100.5, 9.0)  # still settling
    drive(watch, 101.0, 2.0)
    watch.latency(ORDER, 103.0, 0.0004)
    for whole in (False, True):
        latency = watch.view(103.0, whole=whole).topics[ORDER].latency
        assert latency is not None
        assert (latency.count, latency.max) == (1, 0.0004)


def test_a_silent_topic_keeps_its_figures_without_a_rate() -> None:
    watch = Watch(100.0)
    drive(watch, 100.0, 5.0)
    assert watch.view(108.0).topics[COMMAND].rate == 0
    assert watch.view(108.0, whole=True).topics[COMMAND].rate == pytest.approx(10)


def test_a_lost_order_is_counted() -> None:
    watch = Watch(100.0)
    drive(watch, 100.0, 3.0)
    watch.message(COMMAND, 103.0)
    watch.message(COMMAND, 103.1)
    watch.message(ORDER, 103.102)
    view = watch.view(103.2)
    assert view.unanswered == 1
    assert view.command_to_velocity.max == pytest.approx(0.002)


def test_an_order_before_its_command_shifts_nothing() -> None:
    watch = Watch(100.0)
    drive(watch, 100.0, 3.0)
    watch.message(ORDER, 102.9995)
    watch.message(COMMAND, 103.0)
    drive(watch, 103.1, 1.0)
    assert watch.view(104.2).command_to_velocity.max == pytest.approx(0.002)


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


def test_a_module_that_was_never_seen_is_waited_for_not_gone() -> None:
    watch = Watch(0.0)
    watch.peers({"base": "linking"}, 1.0)
    states = {name: module.state for name, module in watch.view(1.0).modules.items()}
    assert states == {"joystick": "waiting", "velocity": "waiting", "base": "linking", "pc": "here"}


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


def test_the_trail_of_a_square_in_ascii() -> None:
    corners = [(0.0, 0.0), (2.0, 0.0), (2.0, 2.0), (0.0, 2.0)]
    assert draw(corners, 0.0, 9, 5, unicode=False) == [
        ">       .",
        "         ",
        "         ",
        "         ",
        ".       .",
    ]


def test_the_trail_in_braille_keeps_to_its_size() -> None:
    lines = draw([(0.0, 0.0), (5.0, 0.1), (5.0, -3.0)], -1.6, 20, 6)
    assert [len(line) for line in lines] == [20] * 6
    assert "↓" in "".join(lines)
    assert draw([], 0.0, 3, 2) == ["   ", "   "]
