"""What ``rmpa doctor`` says of the agents of this machine."""

from __future__ import annotations

import msgspec

from rmpa.doctor.agents import judge_agents
from rmpa.doctor.finding import Level
from tests.monitor.samples import SNAPSHOT


def test_none_runs() -> None:
    (found,) = judge_agents({}, "0.1.0")
    assert found.level is Level.SKIPPED
    assert "rmpa up" in found.remedy


def test_one_that_does_not_answer() -> None:
    (found,) = judge_agents({"base": "no agent answers in time"}, "0.1.0")
    assert found.level is Level.FAIL


def test_peers_clocks_and_notes() -> None:
    found = judge_agents({"base": SNAPSHOT}, "0.1.0")
    texts = {(f.check, f.subject, f.level): f.text for f in found}
    assert texts["agent", "base", Level.OK] == "domain 3, core http://127.0.0.1:11311/, mesh 10.0.0.1:40001"
    assert texts["agent", "base", Level.WARN] == "no multicast on eth0"
    assert "found by multicast" in texts["peer", "base-joystick", Level.OK]
    assert texts["peer", "base-joystick", Level.WARN].startswith("2 messages were given up")
    assert "1.2 ms ±0.2 ms behind ours" in texts["clock", "base-joystick", Level.OK]
    assert texts["peer", "base-pc", Level.WARN] == "linking: connection refused"
    assert "shares its name" in texts["peer", "base-pc", Level.FAIL]


def test_alone_and_of_another_version() -> None:
    alone = msgspec.structs.replace(SNAPSHOT, peers=(), notes=())
    found = judge_agents({"base": alone}, "0.2.0")
    warned = [f.text for f in found if f.level is Level.WARN]
    assert warned == ["it is RMPA 0.1.0, this command is 0.2.0", "knows no peer (domain 3, looking on wlan0)"]
