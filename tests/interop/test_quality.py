"""The agent's figures of topics between real nodes, and the stock tools' view of them."""

from __future__ import annotations

import json
import subprocess
from typing import TYPE_CHECKING

import pytest

from lab.bed.processes import eventually
from tests.interop.modules import flows
from tests.interop.ros import PYTHON

if TYPE_CHECKING:
    from tests.interop.conftest import ModuleFactory
    from tests.interop.modules import Module

pytestmark = [pytest.mark.ros, pytest.mark.netns, pytest.mark.timeout(120)]

RATE = 50.0
SIZE = 1000


def route_of(module: Module, topic: str) -> dict[str, object]:
    """What ``rmpa topic info`` says of the only source of a topic that comes from a peer."""
    code, output = module.agent.rmpa("topic", "info", topic, "--json")
    assert code == 0, output
    routes = [r for r in json.loads(output)["mesh"]["routes"] if r["direction"] == "in"]
    assert len(routes) == 1
    found: dict[str, object] = routes[0]
    return found


def streaming(modules: ModuleFactory, config: str = "") -> tuple[Module, Module]:
    """Two modules, and messages without a header from the first to the second for some seconds."""
    a, b = modules("a", "b", config=config)
    heard = b.ros.roscpp("listener", topic="/chatter")
    a.ros.roscpp("talker", topic="/chatter", rate=RATE, size=SIZE, wait=1)
    flows(heard, 4 * int(RATE))
    return a, b


def test_figures_are_plausible(modules: ModuleFactory) -> None:
    a, b = streaming(modules)
    route = route_of(b, "/chatter")
    assert (route["peer"], route["state"], route["lost"], route["dropped"]) == (a.name, "open", 0, 0)
    rate, period, latency = route["rate"], route["period"], route["latency"]
    assert isinstance(rate, float)
    assert abs(rate - RATE) < 0.2 * RATE
    assert isinstance(period, dict)
    assert period["mean"] == pytest.approx(1 / rate)
    assert 0 < period["min"] <= period["p50"] <= period["p99"] <= period["max"]
    assert isinstance(latency, dict)
    # Both hosts have one clock: the offset is zero, and what is measured must be the truth within its bound.
    assert 0 < latency["p50"] < 0.05
    assert latency["min"] > -latency["error"]
    assert 0 < latency["error"] < 0.02
    bandwidth = route["bandwidth"]
    assert isinstance(bandwidth, float)
    assert bandwidth == pytest.approx(rate * (SIZE + 12), rel=0.01), "the payload and the array's own twelve bytes"
    link = b.agent.peers()[a.name]["link"]
    assert isinstance(link, dict)
    assert abs(link["clock_offset"]) <= link["clock_error"]


def test_hz_bw_and_delay_tell_them_too_without_a_header(modules: ModuleFactory) -> None:
    a, b = streaming(modules)
    lines: dict[str, dict[str, object]] = {}
    for command in ("hz", "bw", "delay"):
        code, output = b.agent.rmpa("topic", command, f"{a.name}:/chatter", "-n", "50", "--json")
        assert code == 0, output
        lines[command] = json.loads(output.splitlines()[-1])
        assert len(lines[command]["routes"]) == 1  # type: ignore[arg-type] # as the command promises
    assert (lines["hz"]["source"], lines["bw"]["source"], lines["delay"]["source"]) == (
        "subscriber",
        "subscriber",
        "link",
    )
    delay, error = lines["delay"]["delay"], lines["delay"]["error"]
    assert isinstance(delay, float)
    assert isinstance(error, float)
    assert -error < delay < 0.05
    code, output = b.agent.rmpa("topic", "delay", "/chatter", "-n", "20")
    assert code == 0
    assert f"by the link's clock, from {a.name} " in output


def test_an_outage_of_a_reliable_topic_is_reported(modules: ModuleFactory) -> None:
    rule = '[[contract]]\ntopics = ["/chatter"]\nreliability = "reliable"\ndeadline = "300 ms"\n'
    a, b = streaming(modules, rule)
    assert route_of(b, "/chatter")["contract"] == {"reliability": "reliable", "deadline": 0.3}
    before = int(str(route_of(b, "/chatter")["messages"]))
    a.host.cut()
    eventually(lambda: route_of(b, "/chatter")["problem"] == "its peer is away", what="the outage")
    during = route_of(b, "/chatter")
    assert during["state"] == "waiting"
    assert int(str(during["messages"])) >= before, "its figures are still there"
    a.host.restore()
    a.agent.wait_peer(b.name)

    def goes_on() -> bool:
        route = route_of(b, "/chatter")
        age = route["age"]
        return route["state"] == "open" and isinstance(age, float) and age < 0.2

    eventually(goes_on, what="messages behind the outage")
    after = route_of(b, "/chatter")
    assert (after["lost"], after["problem"]) == (0, "")
    assert int(str(after["messages"])) > int(str(during["messages"]))
    events, recent = after["events"], after["recent"]
    assert isinstance(events, dict)
    assert isinstance(recent, list)
    assert events["deadline_missed"] >= 3
    assert any("deadline 300 ms" in event["text"] for event in recent)
    code, text = b.agent.rmpa("topic", "info", "/chatter")
    assert code == 0
    assert "deadline_missed" in text


@pytest.mark.skipif(
    subprocess.run([PYTHON, "-c", "import diagnostic_msgs"], capture_output=True, check=False).returncode != 0,
    reason="python3-diagnostic-msgs is not installed (scripts/install-ros installs it)",
)
def test_rostopic_reads_diagnostics_and_they_stay_home(modules: ModuleFactory) -> None:
    a, b = streaming(modules)
    said = b.ros.tool("rostopic", "echo", "-n", "2", "/diagnostics", timeout=30.0)
    assert f'name: "rmpa: {a.name}: /chatter"' in said
    assert f'name: "rmpa: {a.name}"' in said
    assert 'name: "rmpa: this module"' in said
    assert 'key: "latency p50 (ms)"' in said
    info = b.ros.tool("rostopic", "info", "/diagnostics")
    assert "diagnostic_msgs/DiagnosticArray" in info
    assert info.count("/rmpa") == 1, "only this module's agent publishes here"
    rate = b.ros.start("rostopic", "hz", "/diagnostics", name="hz")
    rate.wait_for(r"average rate: (0\.9|1\.[01])", 30.0)
    echo = b.ros.start("rostopic", "echo", "/diagnostics", name="echo")
    a.agent.kill()
    eventually(lambda: "is gone" in echo.output or "no link to" in echo.output, what="the peer is stale")
