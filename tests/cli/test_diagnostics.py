"""``rmpa diagnostics`` against our own core, with nodes of this module and a proxy of a peer's."""

from __future__ import annotations

import asyncio
import json
from collections.abc import Callable, Iterator
from typing import Any

import pytest

from rmpa.ros.core.embedded import RosCore
from rmpa.ros.node.node import Node
from tests.cli.conftest import Background, Place, Rmpa, until, with_core

GROUP = ("diagnostics",)
Report = Callable[..., None]


@pytest.fixture
def report(node: Callable[..., Node], background: Background) -> Iterator[Report]:
    """Makes a node send one status 20 times a second, as diagnostic_updater does; called again, another one."""
    levels: dict[str, dict[str, Any]] = {}
    tasks: list[asyncio.Task[None]] = []

    async def send(name: str, one: Node) -> None:
        publisher = await one.advertise("/diagnostics", "diagnostic_msgs/DiagnosticArray")
        while True:
            publisher.publish(status=[levels[name]])
            await asyncio.sleep(0.05)

    async def start(name: str, one: Node) -> None:
        tasks.append(asyncio.create_task(send(name, one)))

    async def stop() -> None:
        for task in tasks:
            task.cancel()

    def report(name: str, level: int = 0, message: str = "fine", label: str = "") -> None:
        values = [{"key": "volts", "value": "24.1 V"}, {"key": "\x1b[31m", "value": "nan"}]
        known = name in levels
        label = label or f"{name.rpartition('/')[2]}: Battery"
        levels[name] = {"level": level, "name": label, "message": message, "hardware_id": "SN 1", "values": values}
        if not known:
            background.do(start(name, node(name)))

    yield report
    background.do(stop())


def test_it_shows_the_worst_first_whose_it_is_and_exits_1_at_an_error(
    rmpa: Rmpa, report: Report, place: Place, core: RosCore, agent: Callable[..., None]
) -> None:
    agent(snapshot=with_core(core.uri))
    report("/laser")
    code, out, err = rmpa()
    assert (code, err) == (0, "")
    report("/rmpa/joystick/arm", level=2, message="too hot")
    code, out, err = rmpa()
    assert (code, err) == (1, "")
    summary, _, first, second = out.splitlines()
    assert summary == "2 statuses: 1 ERROR, 1 OK"
    assert first.split() == ["arm:", "Battery", "ERROR", "joystick", "SN", "1", "too", "hot"]
    assert second.split()[:4] == ["laser:", "Battery", "OK", "base"]
    assert rmpa("base")[0] == 0
    assert rmpa("--name", "laser*", "--level", "warn")[:2] == (0, "there is no such status\n")
    (shown,) = json.loads(rmpa("joystick", "--json")[1])
    assert shown["values"] == {"volts": "24.1 V", "\x1b[31m": "nan"}
    assert (shown["module"], shown["hardware"], shown["node"], shown["level"]) == (
        "joystick",
        "SN 1",
        "/arm",
        "ERROR",
    )
    assert "    \\x1b[31m: nan\n" in rmpa("joystick", "-v")[1]
    code, _, err = rmpa("nono")
    assert code == 1
    assert "[unknown-name]" in err


def test_without_a_publisher_or_an_answer_it_says_so(rmpa: Rmpa, core: RosCore, listening: str) -> None:
    code, out, err = rmpa("--json")
    assert (code, out) == (0, "[]\n")
    assert "[no-publisher]" in err
    assert core.call("registerPublisher", "/mute", "/diagnostics", "diagnostic_msgs/DiagnosticArray", listening).code
    _, _, err = rmpa()
    assert "/mute has sent nothing for 3 s [nothing-sent]" in err


def test_it_follows_changes_of_levels_alone(rmpa: Rmpa, report: Report, place: Place, core: RosCore) -> None:
    place.environ["ROS_MASTER_URI"] = core.uri
    report("/laser")
    with place.start("diagnostics", "-f", "--json") as process:
        assert process.stdout is not None
        first = json.loads(process.stdout.readline())
        report("/laser", level=1, message="late")
        second = json.loads(process.stdout.readline())
        process.terminate()
        rest = process.stdout.read()
    assert (first["level"], second["level"], second["message"], rest) == ("OK", "WARN", "late", "")
    until(lambda: process.poll() is not None)
