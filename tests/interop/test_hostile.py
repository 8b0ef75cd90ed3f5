"""Hostile bytes on every port that an agent opens, while real traffic flows: nothing breaks, nothing grows."""

from __future__ import annotations

import re
import sys
from functools import partial
from pathlib import Path

import pytest

from lab.bed.namespaces import Lab
from lab.bed.processes import Process, eventually, run
from rmpa.core import limits
from tests.interop.conftest import ModuleFactory
from tests.interop.modules import Module, flows
from tests.interop.ros import NODES

pytestmark = [pytest.mark.alone, pytest.mark.ros, pytest.mark.netns, pytest.mark.timeout(240)]

# Above an agent's own 45 MB, its largest buffers and the proxies one peer may have; one believed length is more.
_MEMORY = 180 * 1024 * 1024
# Warnings and errors that one attack may leave in a log: at most 20 a kind of refusal, each five seconds.
_LINES = 60


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
    (proxy,) = re.findall(r"http://(127[0-9.]+):\d+/\s+/rmpa/b/", a.ros.tool("rosnode", "list", "-a"))
    within = a.ros.start(sys.executable, script, proxy, "5", *ports, name="attack on a proxy")
    outer = b.ros.start(sys.executable, script, a.host.address, "5", *ports, name="attack from outside")
    for attack in (local, within, outer):
        assert int(str(attack.wait_event("done", 60.0)["attacks"])) > 100
    report = flows(heard, 50)
    assert (report["bad"], report["gaps"], report["doubled"]) == (0, 0, 0)
    assert a.agent.process.returncode is None
    assert _peak(a.agent.pid) < _MEMORY
    assert _tracebacks(a) == ""
    counters = a.agent.snapshot().counters
    for refused in ("tcpros.refused.malformed", "http.too_large"):
        assert counters.get(refused, 0) > 0, counters
    a.agent.wait_peer("b")
    assert "/to_a" in a.topics()


class Siege:
    """Two modules with traffic both ways, which an attack must not touch."""

    def __init__(self, modules: ModuleFactory) -> None:
        self.a, self.b = self.both = modules("a", "b", log_level="info")
        self.heard = [m.ros.roscpp("listener", topic=topic) for m, topic in ((self.a, "/to_a"), (self.b, "/to_b"))]
        self.b.ros.roscpp("talker", "__name:=other", topic="/to_a", rate=100)
        self.a.ros.roscpp("talker", "__name:=speaker", topic="/to_b", rate=100)
        for listener in self.heard:
            flows(listener)

    def counted(self, refused: str) -> bool:
        """Whether the first module has refused something for this reason."""
        return self.a.agent.snapshot().counters.get(refused, 0) > 0

    def guid(self, module: Module) -> str:
        return module.agent.snapshot().agent.guid

    def held(self) -> None:
        """Fail unless everything went on, within its bounds."""
        for listener in self.heard:
            report = flows(listener, 50)
            assert (report["bad"], report["gaps"], report["doubled"]) == (0, 0, 0)
        for module, other in ((self.a, "b"), (self.b, "a")):
            assert module.agent.process.returncode is None
            assert module.agent.peers()[other]["state"] == "linked"
            assert _tracebacks(module) == ""
            assert _peak(module.agent.pid) < _MEMORY
            loud = [line for line in module.agent.process.lines if re.search(r"^\S+ (warning|error|critical) ", line)]
            assert len(loud) < _LINES, "\n".join(loud)


def test_forged_beacons_from_another_host(modules: ModuleFactory, lab: Lab) -> None:
    siege = Siege(modules)
    eve = lab.host("eve", 0)
    for number in range(100, 160):  # what one address may send is limited; sixty are not
        eve.ip("address", "add", f"10.77.0.{number}/24", "dev", "eth0")
    guids = [siege.guid(module) for module in siege.both]
    with Process(eve.command([sys.executable, NODES / "hostile_peer.py", "group", eve.address, *guids])) as attack:
        done = attack.wait_event("done", 60.0)
    assert int(str(done["packets"])) > 10_000
    siege.held()
    for module in siege.both:
        snapshot = module.agent.snapshot()
        assert len(snapshot.peers) <= limits.PEERS_MAX
        for refused in ("beacon.malformed", "beacon.version", "beacon.other_domain", "roster.full"):
            assert snapshot.counters.get(refused, 0) > 0, snapshot.counters
    # A real peer that comes now finds the rosters full of forgeries, and is linked all the same.
    (late,) = modules("late", linked=False)
    late.agent.wait_peer("a")
    siege.a.agent.wait_peer("late")
    siege.held()


def test_a_peer_that_breaks_the_protocol_is_dropped(modules: ModuleFactory, lab: Lab) -> None:
    siege = Siege(modules)
    evil = siege.a.ros.rospy("listener", topic="/evil", type="String")
    evil.wait_event("up")
    eve = lab.host("eve", 0)
    words: list[str | Path] = [sys.executable, NODES / "hostile_peer.py", "mesh", eve.address, siege.guid(siege.a)]
    with Process(eve.command(words)) as attack:
        done = attack.wait_event("done", 90.0)
        assert int(str(done["attacks"])) >= 15
        assert [event["data"] for event in evil.events("text")] == ["ok"], "the good message alone"
        for refused in ("link.malformed", "route.unknown", "nodes.too_many"):
            eventually(partial(siege.counted, refused), what=f"{refused} is counted")
    siege.held()
    eventually(lambda: "eve" not in siege.a.agent.peers() or siege.a.agent.peers()["eve"]["state"] != "linked")
    eventually(lambda: "/many" not in siege.a.topics(), what="what eve offered is retracted")
    siege.held()


def _peak(pid: int) -> int:
    """The most memory that a process ever had resident, in bytes."""
    (line,) = [row for row in Path(f"/proc/{pid}/status").read_text().splitlines() if row.startswith("VmHWM:")]
    return int(line.split()[1]) * 1024


def _tracebacks(module: Module) -> str:
    """What the agent's log has around a traceback; empty if there is none."""
    lines = module.agent.process.lines
    at = next((number for number, line in enumerate(lines) if "Traceback" in line), None)
    return "" if at is None else "\n".join(lines[max(0, at - 3) : at + 40])
