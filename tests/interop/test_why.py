"""``rmpa why`` and ``rmpa doctor`` between real nodes on several hosts: the cases that need those."""

from __future__ import annotations

import json
from shutil import which
from typing import TYPE_CHECKING, Any

import pytest

from lab.bed.processes import eventually, run
from rmpa.observe.why.diagnosis import UNASKED
from tests.interop.modules import Module, flows

if TYPE_CHECKING:
    from lab.bed.agents import Agent
    from lab.bed.namespaces import Lab
    from tests.interop.conftest import AgentFactory, ModuleFactory, ShellFactory

pytestmark = [pytest.mark.ros, pytest.mark.netns, pytest.mark.timeout(180)]


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
