"""Rates of topics where they are published: counted by rospy and roscpp, or sampled, and nothing is woken by it."""

from __future__ import annotations

from typing import Any

import pytest

from lab.bed.agents import Agent
from lab.bed.processes import eventually
from rmpa.observe.control_client import ControlClient
from tests.interop.conftest import ModuleFactory
from tests.interop.modules import Module

pytestmark = [pytest.mark.ros, pytest.mark.netns, pytest.mark.timeout(180)]


def rates(agent: Agent) -> dict[str, dict[str, list[Any]]]:
    """What an agent tells of all modules' topics, by module and topic."""
    assert agent.runtime_dir is not None
    with ControlClient(agent.runtime_dir / f"{agent.name}.sock", 10.0) as client:
        told: Any = client.call("rates", object)
    return {module: {one[0]: one[1:] for one in rows} for module, rows in told.items() if isinstance(rows, list)}


def wait_rate(asker: Module, of: Module, topic: str, how: str, rate: float) -> None:
    """Wait until an agent tells that a topic of a module is measured in that way, at about that rate."""

    def told() -> bool:
        found = rates(asker.agent).get(of.name, {}).get(topic)
        if found is None or found[2] != how or not found[1]:
            return False
        size = float(found[1] / found[0])  # bytes of each message
        return bool(rate * 0.5 < found[0] < rate * 1.5) and 75 < size < 77

    eventually(told, 60.0, what=f"{rate} Hz of {topic}, {how}")


@pytest.mark.parametrize("kind", ["rospy", "roscpp"])
def test_rates_are_counted_where_there_are_subscribers_and_sampled_elsewhere(
    modules: ModuleFactory, kind: str
) -> None:
    a, b = modules("a", "b")
    a.ros.node(kind, "talker", topic="/heard", rate=20).wait_event("up")
    a.ros.node(kind, "talker", topic="/unheard", rate=10).wait_event("up")
    a.ros.node("rospy", "listener", topic="/heard")
    a.ros.start("rostopic", "pub", "-r", "5", "/camera", "sensor_msgs/Image", "{}")
    b.wait_topic("/unheard")
    wait_rate(b, a, "/heard", "counted", 20.0)
    wait_rate(b, a, "/unheard", "sampled", 10.0)
    wait_rate(a, a, "/heard", "counted", 20.0)
    eventually(lambda: rates(b.agent)["a"].get("/camera") == [None, None, "no subscriber"], what="/camera sleeps")
    assert "rates" not in b.ros.tool("rosnode", "list") + a.ros.tool("rostopic", "info", "/unheard")
