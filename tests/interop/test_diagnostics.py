"""What an unmodified rospy driver reports on /diagnostics, seen from another module."""

from __future__ import annotations

import json
from typing import Any

import pytest

from lab.bed.processes import eventually
from tests.interop.conftest import ModuleFactory

pytestmark = [pytest.mark.ros, pytest.mark.netns, pytest.mark.timeout(180)]


def test_the_errors_of_a_driver_elsewhere_are_seen_here(modules: ModuleFactory) -> None:
    pc, base = modules("pc", "base")
    driver = base.ros.rospy("diagnosed", name="driver", commands=True)
    driver.wait_event("up")
    pc.wait_topic("/diagnostics")

    def shown() -> tuple[int, dict[str, dict[str, Any]]]:
        code, output = pc.agent.rmpa("diagnostics", "base", "--json")
        return code, {one["name"]: one for one in json.loads(output.splitlines()[-1])}

    eventually(lambda: "driver: Battery" in shown()[1], what="the driver's statuses at the pc")
    code, statuses = shown()
    assert code == 0
    battery = statuses["driver: Battery"]
    assert (battery["module"], battery["hardware"], battery["node"]) == ("base", "SN 4711", "/driver")
    assert battery["values"] == {"Voltage": "24.1 V", "Current": "nan"}
    driver.tell(json.dumps({"level": 2, "message": "too hot"}))
    eventually(lambda: shown()[0] == 1, what="exit code 1 for an error")
    assert shown()[1]["driver: Battery"]["message"] == "too hot"
