"""The bed of both systems: cables as they were asked for, and a host that is lost as by a pulled plug."""

from __future__ import annotations

from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest

from lab.bed.plan import Client, Kind, Plan
from lab.bed.processes import Process, run
from lab.bed.stage import Stage, make_stage
from lab.experiments import flow

if TYPE_CHECKING:
    from collections.abc import Iterator

    from lab.bed.system import System

pytestmark = [pytest.mark.timeout(180), pytest.mark.ros, pytest.mark.netns]
HOSTS = ["joystick", "velocity", "pc"]
TOPICS = ["/cmd", "/vel"]
PLAN = Plan(clients=("roscpp",))


@contextmanager
def _system(kind: Kind) -> Iterator[tuple[Stage, System]]:
    with make_stage(PLAN) as stage, stage.system(kind, HOSTS) as robot:
        yield stage, robot


def _nodes(robot: System, stage: Stage) -> tuple[Process, Process]:
    """A source on joystick, a velocity node on its host and a sink on pc, through which messages come."""
    client: Client = stage.plan.clients[0]
    sink = robot.node("pc", "sink", client, nodelay=True)
    robot.node("velocity", "velocity", client, nodelay=True)
    source = robot.node("joystick", "source", client)
    flow.wait_connected(source)
    flow.wait_flowing(source, sink, TOPICS, stage.scratch)
    return source, sink


class TestCables:
    @pytest.mark.parametrize(("link", "bands"), [("100mbit", True), ("100mbit", False), ("", True)])
    def test_cables_carry_what_was_asked_for_and_still_do_after_a_restart(self, link: str, bands: bool) -> None:
        more: Any = {"config": "domain = 7\n", "flags": ["--realtime"]}
        with make_stage(PLAN) as stage, stage.system("rmpa", ["a"], link=link, bands=bands, **more) as robot:
            words = robot._own("a")[0].argv
            assert "--realtime" in words
            config = Path(words[words.index("--config") + 1])
            assert config.read_text(encoding="utf-8").startswith("domain = 7\n")
            for _ in range(2):
                shown = run(robot._place.host("a").command(["tc", "qdisc", "show", "dev", "eth0"]))
                assert ("tbf" in shown, "100Mbit" in shown) == (bool(link), bool(link))
                assert ("pfifo_fast" in shown) == bool(link and bands)
                robot.kill("a")
                robot.start("a")

    def test_traffic_is_counted_and_a_pulled_plug_tells_nobody(self) -> None:
        """A killed process's kernel closes its connections; a host without power does not, so others keep theirs."""
        with _system("classic") as (stage, robot):
            source, sink = _nodes(robot, stage)
            before = robot.traffic("joystick"), robot.traffic("pc")
            begun = flow.begin(source, stage.scratch, size=10_000, rate=100, count=20)
            flow.sent(begun)
            flow.noted(sink, TOPICS, stage.scratch, begun.number)
            after = robot.traffic("joystick"), robot.traffic("pc")
            # To pc and to velocity; from joystick and from velocity.
            for was, now, way in zip(before, after, ("tx", "rx"), strict=True):
                assert now[f"{way}_bytes"] - was[f"{way}_bytes"] > 2 * 20 * 10_000
                assert now[f"{way}_packets"] > was[f"{way}_packets"]
            address = robot._place.host("velocity").address
            standing = _connections(robot, address)
            robot.kill("velocity")
            # The source's packets to it are lost by now, and nothing has come back.
            flow.sent(flow.begin(source, stage.scratch, size=64, rate=100, count=10))
            assert standing
            assert _connections(robot, address) == standing
            assert not [event for event in source.events("connected") if event["subscribers"] == 1][1:]


def _connections(robot: System, address: str) -> set[str]:
    """The established connections of joystick to an address, as ``ss`` names them."""
    here = robot._place.host("joystick")
    shown = run(here.command(["ss", "-Htn", "state", "established", "dst", address]))
    return {" ".join(line.split()[2:4]) for line in shown.splitlines()}
