"""The demo at two sites: what crosses by gateways, what goes on without a part of the way, nothing left behind."""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any, Final

import pytest

from lab.bed.processes import Process
from tests.examples.test_demo import (
    DEMO,
    all_linked,
    assert_gone,
    family,
    flows,
    open_ports,
    states,
    summary_of,
    wait_for_view,
)

pytest.importorskip("zenoh", reason="the libraries of rmpa[zenoh] are not installed")
pytest.importorskip("xxhash", reason="the libraries of rmpa[zenoh] are not installed")
pytestmark = pytest.mark.timeout(300)

ARGUMENTS: Final[list[str | Path]] = [sys.executable, DEMO, "--no-web", "--sites", "--json"]


def wait_long(demo: Process, holds: Callable[[dict[str, Any]], bool], what: str) -> dict[str, Any]:
    """Wait for a view; seven agents start at once, which takes long on a busy machine."""
    return wait_for_view(demo, holds, what, 90.0)


def all_there(view: dict[str, Any]) -> bool:
    return flows(view) and all_linked(view)


def command(tidy: dict[str, str], *words: str) -> str:
    with Process([sys.executable, DEMO, *words], env=tidy, name=" ".join(words)) as process:
        assert process.wait() == 0, process.output
        return process.output


def test_the_robot_in_the_field_is_driven_from_the_office(tidy: dict[str, str]) -> None:
    with Process(ARGUMENTS, env=tidy, name="demo-sites") as demo:
        view = wait_long(demo, all_there, "messages of both sites")
        assert {name: module["site"] for name, module in view["modules"].items()} == {
            "joystick": "",
            "velocity": "field",
            "base": "field",
            "pc": "",
        }
        wait_long(
            demo,
            lambda view: [one["profile"] for one in view["modules"].values()] == ["steady", "direct", "full", ""],
            "the profile of each resource, latched in the field",
        )
        wait_long(demo, lambda view: bool(view["pose"]) and view["pose"]["speed"] > 0, "a robot that drives")
        processes = family(demo)
        ports = open_ports(processes)
        assert len(processes) == 12, "the supervisor; an agent and a node for each module; two gateways and a router"

        assert "base is killed" in command(tidy, "kill", "base")
        wait_long(
            demo,
            lambda view: (
                bool(view["restarts"])
                and states(view)["base"] == "gone"
                and view["topics"]["/velocity_order"]["rate"] > 0
            ),
            "base gone, velocity beside it there",
        )
        command(tidy, "start", "base")
        wait_long(demo, lambda view: all_there(view) and any(r["back_after"] for r in view["restarts"]), "base back")
        assert demo.interrupt() == 0, demo.output
    assert_gone(processes, ports)
    (restart,) = summary_of(demo)["restarts"]
    assert restart["back_after"] > 0
