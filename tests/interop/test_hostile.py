"""Hostile bytes on every port that an agent opens, while real traffic flows: nothing breaks, nothing grows."""

from __future__ import annotations

import re
import sys
from typing import TYPE_CHECKING

import psutil
import pytest

from tests.interop.modules import Module, flows
from tests.interop.processes import run
from tests.interop.ros import NODES

if TYPE_CHECKING:
    from tests.interop.conftest import ModuleFactory

pytestmark = [pytest.mark.ros, pytest.mark.netns, pytest.mark.timeout(120)]

_MEMORY = 300 * 1024 * 1024
"""Far above an agent's own 45 MB, far below what one believed length would take."""


def listening(module: Module) -> dict[str, str]:
    """Every TCP and UDP port that the agent listens at: ``{"tcp:11311": "127.0.0.1"}``."""
    ports: dict[str, str] = {}
    for line in run(module.host.command(["ss", "-tulnpH"])).splitlines():
        if f"pid={module.agent.pid}," in line:
            address, _, port = line.split()[4].rpartition(":")
            ports[f"{line.split()[0]}:{port}"] = re.sub(r"%.*|[\[\]]", "", address)
    return ports


def test_hostile_bytes_on_every_port_while_traffic_flows(modules: ModuleFactory) -> None:
    a, b = modules("a", "b")
    heard = a.ros.roscpp("listener", topic="/to_a")
    b.ros.roscpp("talker", topic="/to_a", rate=100)
    flows(heard)
    ports = listening(a)
    assert any(key.startswith("udp:") for key in ports), ports
    assert "tcp:11311" in ports, ports
    assert len([key for key in ports if key.startswith("tcp:")]) >= 3, ports  # mesh, XML-RPC, TCPROS
    script = NODES / "hostile.py"
    local = a.ros.start(sys.executable, script, "127.0.0.1", "5", *ports, name="attack from inside")
    outer = b.ros.start(sys.executable, script, a.host.address, "5", *ports, name="attack from outside")
    for attack in (local, outer):
        assert int(str(attack.wait_event("done", 60.0)["attacks"])) > 100
    report = flows(heard, 50)
    assert (report["bad"], report["gaps"], report["doubled"]) == (0, 0, 0)
    assert a.agent.process.returncode is None
    assert psutil.Process(a.agent.pid).memory_info().rss < _MEMORY
    assert _tracebacks(a) == ""
    a.agent.wait_peer("b")
    assert "/to_a" in a.topics()


def test_the_core_is_open_to_this_machine_only(modules: ModuleFactory) -> None:
    (a,) = modules("a")
    a.ros.roscpp("talker", topic="/chatter", rate=10)
    a.wait_topic("/chatter")
    assert listening(a)["tcp:11311"] == "127.0.0.1"


def _tracebacks(module: Module) -> str:
    """What the agent's log has around a traceback; empty if there is none."""
    lines = module.agent.process.lines
    at = next((number for number, line in enumerate(lines) if "Traceback" in line), None)
    return "" if at is None else "\n".join(lines[max(0, at - 3) : at + 40])
