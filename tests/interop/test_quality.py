"""What is told of a topic: its quality, and why it does not come."""

from __future__ import annotations

import json
import subprocess
from shutil import which
from typing import Any

import pytest

from lab.bed.agents import Agent
from lab.bed.namespaces import Lab
from lab.bed.processes import eventually, run
from rmpa.observe.why.diagnosis import UNASKED
from tests.interop.conftest import AgentFactory, ModuleFactory, ShellFactory
from tests.interop.modules import Module, flows
from tests.interop.ros import PYTHON

pytestmark = [pytest.mark.ros, pytest.mark.netns, pytest.mark.timeout(180)]
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


def test_figures_are_plausible_and_hz_bw_and_delay_tell_them_too(modules: ModuleFactory) -> None:
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


def why(agent: Agent, *words: str) -> list[dict[str, Any]]:
    code, output = agent.rmpa("why", *words, "--json")
    assert "Traceback" not in output
    found: list[dict[str, Any]] = json.loads(output)
    assert code == (0 if all(one["flows"] for one in found) else 1), output
    return found


def stop(agent: Agent, *words: str) -> str:
    """The stage at which the only way ends; empty if it does not."""
    (found,) = why(agent, *words)
    last = found["stages"][-1]
    assert found["flows"] or last["remedy"]
    return "" if found["flows"] and last["name"] != UNASKED else f"{last['name']}: {last['text']}"


def until(module: Module, begins: str, *words: str) -> str:
    """Ask until the answer begins so (empty: until it flows); return it."""
    found: list[str] = []

    def asked() -> bool:
        found.append(stop(module.agent, *words))
        return found[-1].startswith(begins) if begins else not found[-1]

    eventually(asked, 40.0, what=f"rmpa why {' '.join(words)} says {begins!r}; it said {found}")
    return found[-1]


def test_why_names_each_stage_of_a_topic_that_fails(modules: ModuleFactory) -> None:
    a, b = modules("a", "b", config="[services]\nloggers = true\n")
    topic = f"{a.name}:/chatter"
    assert stop(b.agent, topic) == f"publisher: no node of {a.name} publishes /chatter"
    talker = a.ros.rospy("talker", topic="/chatter", rate=50, size=100_000, name="talker")
    talker.wait_event("up")
    until(b, f"{UNASKED}: no node here subscribes", topic)

    # A subscriber of another type is refused, loudly at both ends.
    wrong = b.ros.rospy("listener", topic="/chatter", type="String", name="wrong")
    wrong.wait_event("up")
    assert "md5" in until(b, "md5: ", topic)
    wrong.end()

    heard = b.ros.roscpp("listener", topic="/chatter", name="listener")
    flows(heard)
    code, text = b.agent.rmpa("why", topic)
    assert (code, text.splitlines()[-1]) == (0, "it flows"), text
    (found,) = why(a.agent, "/chatter")
    assert (found["flows"], found["peer"], found["to"]) == (True, a.name, b.name), "the other end says so too"

    # A reader that is stopped: 5 MB/s fill what the kernel keeps for it in a moment.
    heard.freeze()
    assert "/listener (" in until(b, "reader: ", topic)
    heard.thaw()

    # A publisher that is stopped; its logger service does not answer either.
    service = f"{a.name}:/talker/get_loggers"
    assert stop(b.agent, service) == ""
    talker.freeze()
    assert "does not answer" in stop(b.agent, service)
    until(b, "arrived: nothing for", topic)
    talker.thaw()

    # The cable is out.
    a.host.cut()
    b.agent.wait_no_peer(a.name)
    assert stop(b.agent, topic).startswith(("link: ", "peer: "))


def test_what_a_relay_passes_on(lab: Lab, agent: AgentFactory, shell: ShellFactory) -> None:
    loggers = "[services]\nloggers = true\n"
    relays = "[relay]\nenabled = true\n"
    hosts = [lab.host("a", 0), lab.host("b", 1), lab.host("r", 0, 1)]
    a, b, r = (
        Module(host, agent(host, name=host.name, config=loggers + (relays if host.name == "r" else "")), shell(host))
        for host in hosts
    )
    a.agent.wait_peer("r")
    b.agent.wait_peer("r")
    a.ros.rospy("talker", topic="/chatter", rate=20, name="talker")
    until(b, f"{UNASKED}: no node here", "a:/chatter")
    heard = b.ros.roscpp("listener", topic="/chatter", name="listener")
    flows(heard)
    (found,) = why(b.agent, "/chatter")
    assert (found["flows"], found["peer"], found["to"]) == (True, "a", "b"), found
    assert found["stages"][1]["text"] == "no link of its own; r passes on what it publishes"
    until(b, "", "a:/talker/get_loggers")
    assert stop(b.agent, "r:/chatter") == "publisher: no node of r publishes /chatter"
    r.agent.kill()
    b.agent.wait_no_peer("r")
    assert stop(b.agent, "a:/chatter").startswith(("peer: ", "link: "))


def test_the_doctor_of_a_host_and_multicast_between_two(modules: ModuleFactory) -> None:
    a, b = modules("a", "b")
    cable = b.host.cables[0].interface

    def findings(*words: str) -> dict[tuple[str, str], dict[str, str]]:
        code, output = b.agent.rmpa("doctor", "--json", *words)
        answers = json.loads(output)
        assert code == int(any(answer["level"] == "fail" for answer in answers))
        return {(answer["check"], answer["subject"]): answer for answer in answers}

    found = findings("--listen", "5")  # a's agent sends more often than that
    assert found["multicast", cable]["level"] == "ok"
    assert found["multicast", cable]["text"].endswith(f"; heard of other machines: {a.host.address}")
    assert found["agent", b.name]["level"] == "ok"
    assert found["peer", f"{b.name}-{a.name}"]["text"].startswith("linked by ")
    assert found["clock", f"{b.name}-{a.name}"]["level"] == "ok"
    assert found["route", f"{a.host.address} ({a.name})"]["level"] == "ok"
    assert b.name in found["port", "11311"]["text"]
    assert not any("beacon.malformed" in line for line in a.agent.process.lines), (
        "agents pass the doctor's packet over"
    )
    # The interface goes down: no multicast, and no way to the peer.
    b.host.switch_off()
    found = findings()
    assert ("multicast", cable) not in found
    assert found["interface", ""]["level"] == "warn"
    b.host.switch_on()


@pytest.mark.skipif(which("nft") is None, reason="nftables is not installed (scripts/install-ros installs it)")
def test_the_doctor_finds_the_firewall_of_a_host(lab: Lab, agent: AgentFactory) -> None:
    (host,) = lab.hosts("a")
    here = agent(host)
    name = host.cables[0].interface

    def looked(rule: str) -> tuple[str, str]:
        run(host.command(["nft", rule]))
        found = json.loads(here.rmpa("doctor", "--json")[1])
        by_check = {(answer["check"], answer["subject"]): answer["level"] for answer in found}
        return by_check["firewall", "nft"], by_check["multicast", name]

    run(host.command(["nft", "add table inet filter"]))
    chain = "add chain inet filter input { type filter hook input priority 0; policy drop; }"
    assert looked(chain) == ("warn", "fail"), "nothing names our port, and what we send is not heard"
    assert looked("add rule inet filter input udp dport 11400-11450 accept") == ("ok", "ok")
    assert looked("insert rule inet filter input udp dport 11411 drop") == ("fail", "fail")
