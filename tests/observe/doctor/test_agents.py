"""What ``rmpa doctor`` says of the agents of this machine."""

from __future__ import annotations

import msgspec

from rmpa.observe.doctor.agents import judge_agents
from rmpa.observe.peer_info import FOREIGN, Check, CheckLevel, PeerInfo, exit_code
from rmpa.observe.snapshot import FilesInfo, UnreachableInfo
from tests.observe.samples import SNAPSHOT


def test_none_runs() -> None:
    (found,) = judge_agents({}, "0.1.0")
    assert found.level is CheckLevel.SKIPPED
    assert "rmpa up" in found.remedy


def test_one_that_does_not_answer() -> None:
    (found,) = judge_agents({"base": "no agent answers in time"}, "0.1.0")
    assert found.level is CheckLevel.FAIL


def test_peers_clocks_and_notes() -> None:
    found = judge_agents({"base": SNAPSHOT}, "0.1.0")
    texts = {(f.name, f.where, f.level): f.text for f in found}
    assert texts["agent", "base", CheckLevel.OK] == "domain 3, core http://127.0.0.1:11311/, mesh 10.0.0.1:40001"
    assert texts["proxies", "base", CheckLevel.OK].startswith(
        "17 nodes of peers, 2 listening sockets: two for all, ports"
    )
    assert texts["agent", "base", CheckLevel.WARN] == "no multicast on eth0"
    assert texts["core memory", "base", CheckLevel.OK] == SNAPSHOT.agent.core_memory
    assert "found by multicast" in texts["peer", "base-joystick", CheckLevel.OK]
    assert texts["peer", "base-joystick", CheckLevel.WARN].startswith("2 messages were given up")
    assert "1.2 ms ±0.2 ms behind ours" in texts["clock", "base-joystick", CheckLevel.OK]
    assert texts["peer", "base-pc", CheckLevel.WARN] == "linking: connection refused"
    assert any("shares its name" in f.text and f.level is CheckLevel.WARN for f in found)


def test_a_conflict_that_keeps_a_peer_out_fails() -> None:
    pc = msgspec.structs.replace(SNAPSHOT.peers[1], state="conflict")
    shown = msgspec.structs.replace(SNAPSHOT, peers=(pc,))
    failed = [f for f in judge_agents({"base": shown}, "0.1.0") if f.level is CheckLevel.FAIL]
    assert [f.text for f in failed] == ["shares its name with 10.0.0.9:40003#4"]


def test_a_module_that_is_not_of_this_mesh_is_told_in_place_of_advice_on_multicast() -> None:
    text = "not of this mesh: it has not joined; let it join"
    stranger = PeerInfo(name="opn", guid="g", instance="33" * 16, state=FOREIGN, since_ago=1.0, last_error=text)
    shown = msgspec.structs.replace(SNAPSHOT, peers=(), strangers=(stranger,))
    (found,) = [f for f in judge_agents({"base": shown}, "0.1.0") if f.name == "peer"]
    assert (found.where, found.level) == ("base-opn", CheckLevel.WARN)
    assert (found.text, found.remedy) == ("not of this mesh: it has not joined", "let it join")


def test_a_peer_that_needs_no_link_is_not_a_problem() -> None:
    linked = SNAPSHOT.peers[0]
    assert linked.link is not None
    states = (
        msgspec.structs.replace(linked, name="idle", link=msgspec.structs.replace(linked.link, rests=True)),
        msgspec.structs.replace(linked, name="beyond", state="relayed", link=None, via="idle"),
    )
    shown = msgspec.structs.replace(SNAPSHOT, peers=states)
    found = {
        f.where: f for f in judge_agents({"base": shown}, "0.1.0") if f.name == "peer" and f.level is CheckLevel.OK
    }
    assert found["base-idle"].text == "linked by 10.0.0.2:40002, at rest, found by multicast"
    assert found["base-beyond"].text == "relayed: another peer passes on its topics"
    assert exit_code(judge_agents({"base": shown}, "0.1.0")) == 0


def test_of_many_peers_those_with_a_problem_are_listed() -> None:
    joystick, pc = SNAPSHOT.peers
    others = [msgspec.structs.replace(joystick, name=f"m{n}", state="relayed", link=None) for n in range(999)]
    shown = msgspec.structs.replace(SNAPSHOT, peers=(*others, joystick, pc))
    found = [f for f in judge_agents({"base": shown}, "0.1.0") if f.name in ("peer", "clock")]
    assert [(f.where, f.level) for f in found] == [
        ("base-joystick", CheckLevel.WARN),
        ("base-pc", CheckLevel.WARN),
        ("base-pc", CheckLevel.WARN),
        ("base", CheckLevel.OK),
    ]
    assert found[-1].text == "999 of 1,001 have no problem: 999 relayed"


def test_what_permissions_refused() -> None:
    counters = {"link.up": 3, "permission.call": 1, "permission.publish": 4}
    shown = msgspec.structs.replace(SNAPSHOT, counters=counters)
    (found,) = [f for f in judge_agents({"base": shown}, "0.1.0") if f.name == "permissions"]
    assert (found.level, found.text) == (
        CheckLevel.OK,
        "refused so far: 1 call, 4 publish; its log names the rules",
    )


def test_nodes_that_cannot_be_reached() -> None:
    cam = UnreachableInfo(node="/cam", uri="http://nosuch:1/", problem="no such name", ago=3.0)
    gone = UnreachableInfo(node="/gone", uri="http://10.9.9.9:1/", problem="no answer", ago=60.0, withdrawn=True)
    shown = msgspec.structs.replace(SNAPSHOT, unreachable=(cam, gone))
    found = [f for f in judge_agents({"base": shown}, "0.1.0") if f.name == "node"]
    assert [(f.where, f.level, f.text) for f in found] == [
        ("/cam", CheckLevel.WARN, "/cam cannot be reached at http://nosuch:1/ (no such name)"),
        (
            "/gone",
            CheckLevel.FAIL,
            "/gone cannot be reached at http://10.9.9.9:1/ (no answer), so peers are not offered it",
        ),
    ]
    assert all("ROS_IP=127.0.0.1" in f.remedy for f in found)


def test_alone_and_of_another_version() -> None:
    alone = msgspec.structs.replace(SNAPSHOT, peers=(), notes=())
    found = judge_agents({"base": alone}, "0.2.0")
    warned = [f.text for f in found if f.level is CheckLevel.WARN]
    assert warned == ["it is RMPA 0.1.0, this command is 0.2.0", "knows no peer (domain 3, looking on wlan0)"]


def test_the_agents_descriptors_are_judged() -> None:
    def files(problem: str = "", *, near: bool = False) -> Check:
        few = FilesInfo(open=60, limit=64, hard=64, reserved=16, near=near, problem=problem)
        agent = msgspec.structs.replace(SNAPSHOT.agent, files=few)
        shown = msgspec.structs.replace(SNAPSHOT, agent=agent, notes=(problem,) if problem else ())
        found = judge_agents({"base": shown}, "0.1.0")
        assert not any(f.text == problem for f in found), "said once"
        return next(f for f in found if f.name == "files")

    assert (files().level, files().text) == (
        CheckLevel.OK,
        "60 of 64 file descriptors are open; the last 16 are kept for the core and the links",
    )
    assert files(near=True).level is CheckLevel.WARN
    assert "prlimit --pid 4242" in files(near=True).remedy
    bad = files("node /x is refused: none left; raise it", near=True)
    assert (bad.level, bad.text, bad.remedy) == (
        CheckLevel.FAIL,
        "node /x is refused: none left; 60 are open",
        "raise it",
    )
