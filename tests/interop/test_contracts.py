"""Contracts between agents, and a reload that changes them."""

from __future__ import annotations

import json
import re
import signal
from pathlib import Path

import pytest

from lab.bed.namespaces import Lab
from lab.bed.processes import Process, eventually
from tests.interop.conftest import AgentFactory, ModuleFactory, ShellFactory
from tests.interop.modules import Module, flows, whole
from tests.interop.recordings import recorded, wait_last

pytestmark = [pytest.mark.ros, pytest.mark.netns, pytest.mark.timeout(180)]
DEPTH = 20


def rule(topic: str, **keys: object) -> str:
    """One ``[[contract]]``."""
    return "\n".join(
        ["[[contract]]", f'topics = ["{topic}"]', *(f"{key} = {json.dumps(keys[key])}" for key in keys), ""]
    )


def route(module: Module, topic: str) -> dict[str, object]:
    """What ``rmpa topic info --json`` says of the only route of a topic."""
    code, output = module.agent.rmpa("topic", "info", topic, "--json")
    assert code == 0, output
    (found,) = json.loads(output)["mesh"]["routes"]
    return dict(found)


def events(module: Module, topic: str) -> dict[str, int]:
    """How often each event of a topic's contract came."""
    found: dict[str, int] = route(module, topic)["events"]  # type: ignore[assignment]  # as the command promises
    return found


def occurs(module: Module, topic: str, kind: str, count: int = 1) -> None:
    """Wait until an event of a contract came so often."""
    eventually(lambda: events(module, topic).get(kind, 0) >= count, what=f"{count} {kind} of {topic}")


def told(teller: Process, line: str) -> int:
    """Let a teller publish; return how many it has sent since its start."""
    since = teller.mark_events()
    teller.tell(line)
    return int(str(teller.wait_event("told", since=since)["sent"]))


def test_max_rate_thins_out_and_keeps_the_newest(modules: ModuleFactory, tmp_path: Path) -> None:
    a, b = modules("a", "b", config=rule("/fast", max_rate=20))
    heard = b.ros.roscpp("recorder", topic="/fast", nodelay=True, commands=True)
    teller = a.ros.roscpp("teller", topic="/fast", nodelay=True, wait=1, commands=True)
    teller.wait_event("connected")
    last = told(teller, "64 800 200")
    wait_last(heard, last)
    rows = recorded(heard, tmp_path)
    assert 40 <= len(rows) <= 90  # 4 s at 20 Hz; the last one comes as well
    assert rows[-1].sequence == last
    assert not any(row.bad for row in rows)
    # What was left out is older than what came: no message is more than a period and a bit behind its time.
    assert sorted(row.age for row in rows)[len(rows) // 2] < 0.1
    found = route(b, "/fast")
    assert (found["contract"], found["lost"], found["events"]) == ({"max_rate": 20.0}, 0, {})


def test_lifespan_drops_what_an_outage_made_old(modules: ModuleFactory, tmp_path: Path) -> None:
    topics = {"/command": "best_effort", "/goal": "reliable"}
    rules = [rule(topic, lifespan="300 ms", reliability=word) for topic, word in topics.items()]
    a, b = modules("a", "b", config="".join(rules))
    recorders = {topic: b.ros.roscpp("recorder", topic=topic, nodelay=True, commands=True) for topic in topics}
    for topic, recorder in recorders.items():
        a.ros.roscpp("talker", topic=topic, rate=100, wait=1, nodelay=True)
        flows(recorder, 50)
    b.host.outage(1.0)
    for topic, recorder in recorders.items():
        flows(recorder, 50)
        rows = recorded(recorder, tmp_path)
        assert rows == sorted(rows)
        # The age that the contract means begins at the sending agent, and has the clocks' error.
        assert max(row.age for row in rows) < 0.5
        assert len(rows) < rows[-1].sequence, topic
    # What an outage of a second made older than 300 ms, and a reliable route has kept, is counted where it came.
    occurs(b, "/goal", "lifespan_expired", 30)
    assert route(b, "/goal")["lost"] == 0


def test_deadline_and_liveliness_of_a_talker_that_hangs(modules: ModuleFactory) -> None:
    config = rule("/beat", deadline=0.2, liveliness="manual_by_topic", liveliness_lease_duration=0.5)
    a, b = modules("a", "b", config=config)
    talker = a.ros.roscpp("talker", topic="/beat", rate=50, wait=1, nodelay=True)
    heard = b.ros.roscpp("listener", topic="/beat", nodelay=True)
    flows(heard, 50)
    before = events(b, "/beat").get("deadline_missed", 0)
    talker.freeze()
    occurs(b, "/beat", "liveliness_lost")
    occurs(b, "/beat", "deadline_missed", before + 5)
    talker.thaw()
    occurs(b, "/beat", "liveliness_restored")
    flows(heard, 50)
    found = route(b, "/beat")
    kinds = {event["kind"] for event in found["recent"]}  # type: ignore[attr-defined]  # as the command promises
    assert {"deadline_missed", "liveliness_lost", "liveliness_restored"} <= kinds
    code, shown = b.agent.rmpa("topic", "info", "/beat")
    assert code == 0
    assert "no message for" in shown
    b.agent.process.wait_for(r"(?i)warning.*/beat.*no message for")


def test_transient_local_gives_late_joiners_the_last_ones(modules: ModuleFactory, tmp_path: Path) -> None:
    a, b = modules("a", "b", config=rule("/map", durability="transient_local", depth=5))
    early = b.ros.roscpp("recorder", topic="/map", nodelay=True, commands=True)
    teller = a.ros.rospy("teller", topic="/map", nodelay=True, wait=1, commands=True)
    teller.wait_event("connected")
    last = told(teller, "1000 20 100")
    wait_last(early, last)
    for kind in ("roscpp", "rospy"):
        late = b.ros.node(kind, "recorder", topic="/map", nodelay=True, commands=True)
        wait_last(late, last)
        assert [row.sequence for row in recorded(late, tmp_path)] == list(range(last - 4, last + 1))
    assert [row.sequence for row in recorded(early, tmp_path)][-5:] == list(range(last - 4, last + 1))


def test_depth_bounds_the_queue_of_a_stopped_subscriber(modules: ModuleFactory, tmp_path: Path) -> None:
    a, b = modules("a", "b", config=rule("/scan", history="keep_last", depth=DEPTH))
    other = b.ros.roscpp("recorder", "__name:=other", topic="/scan", commands=True)
    stuck = b.ros.rospy("recorder", topic="/scan", commands=True)
    teller = a.ros.roscpp("teller", topic="/scan", wait=1, commands=True)
    teller.wait_event("connected")
    first = told(teller, "200000 20 20")
    for recorder in (other, stuck):
        wait_last(recorder, first)
        recorded(recorder, tmp_path)
    stuck.freeze()
    last = told(teller, "200000 250 50")  # 50 MB: more than the sockets hold
    wait_last(other, last)
    stuck.thaw()
    wait_last(stuck, last)
    rows = recorded(stuck, tmp_path)
    assert not any(row.bad for row in rows)
    sequences = [row.sequence for row in rows]
    assert sequences == sorted(set(sequences))
    # What its socket held, then a gap, then the last DEPTH of them; one of which the socket took a part counts too.
    newest = [number for number in sequences if number > last - DEPTH]
    assert newest in (list(range(last - DEPTH + 1, last + 1)), list(range(last - DEPTH + 2, last + 1)))
    assert newest[0] - sequences[-len(newest) - 1] > 50
    assert [row.sequence for row in recorded(other, tmp_path)] == list(range(first + 1, last + 1))
    assert route(b, "/scan")["dropped"] == last - first - len(rows)


BEFORE = """
[bridge]
deny = ["/later"]
"""
AFTER = """
[bridge]
deny = ["/no_more"]

[[peer]]
name = "a"
remap_in = { "/moved" = "/a/moved" }

[[contract]]
topics = ["/tuned"]
depth = 5
"""


def write(tmp_path: Path, module: Module, text: str) -> None:
    (tmp_path / f"{module.name}.toml").write_text(text, encoding="utf-8")


def connection(module: Module, node: str) -> str:
    """The TCP connection over which a node has its one topic, as the stock ``rosnode info`` shows it."""
    info = module.ros.tool("rosnode", "info", node)
    [found] = re.findall(r"topic: /steady\s.*?direction: \w+ \((\d+ - [\d.:]+)\)", info, re.DOTALL)
    return str(found)


def test_a_reload_loses_no_message_of_a_stream(
    lab: Lab, agent: AgentFactory, shell: ShellFactory, tmp_path: Path
) -> None:
    a, b = (
        Module(host, agent(host, name=host.name, config="" if host.name == "a" else BEFORE), shell(host))
        for host in lab.hosts("a", "b")
    )
    a.agent.wait_peer("b")
    steady = b.ros.roscpp("listener", "__name:=hear_steady", topic="/steady")
    moved, tuned = (b.ros.roscpp("listener", f"__name:=hear_{name}", topic=f"/{name}") for name in ("moved", "tuned"))
    for name in ("moved", "tuned", "no_more", "later"):
        a.ros.roscpp("talker", f"__name:=say_{name}", topic=f"/{name}", rate=50)
    a.ros.roscpp("talker", "__name:=say_steady", topic="/steady", rate=100, wait=1)
    flows(steady)
    flows(moved)
    flows(tuned)
    b.wait_topic("/no_more")
    assert "/later" not in b.topics()
    connections = [connection(a, "/say_steady"), connection(b, "/hear_steady")]

    # What cannot be used changes nothing, and says where it is wrong.
    write(tmp_path, b, AFTER.replace("depth = 5", "depth = 0"))
    code, said = b.agent.rmpa("reload")
    assert code == 2, said
    assert f"{b.name}.toml:11: contract.depth: 0 is out of range" in said

    # A check only tells.
    write(tmp_path, b, AFTER + "[mesh]\nport = 40123\n[log]\nlevel = 'debug'\n")
    code, said = b.agent.rmpa("reload", "--check")
    assert code == 0, said
    assert "b.toml: bridge.deny, [[peer]], [[contract]] would take effect" in said
    assert "mesh.port (40123 instead of 0) would take effect after a restart" in said
    assert "/later" not in b.topics()

    # SIGHUP does it.
    b.agent.process.send(signal.SIGHUP)
    b.wait_topic("/later")
    b.wait_topic("/a/moved")
    b.wait_no_topic("/no_more")
    newly = b.ros.roscpp("listener", "__name:=hear_again", topic="/a/moved")
    flows(newly)
    flows(tuned)
    code, said = b.agent.rmpa("topic", "info", "/tuned", "--json")
    assert code == 0, said
    [route] = json.loads(said)["mesh"]["routes"]
    assert (route["state"], route["contract"]) == ("open", {"depth": 5})

    # And back, by the command, which also names what waits for a restart.
    write(tmp_path, b, BEFORE + "[mesh]\nport = 40123\n")
    code, said = b.agent.rmpa("reload", "--json")
    assert code == 0, said
    reply = json.loads(said)
    assert reply["changed"] == ["bridge.deny", "[[peer]]", "[[contract]]"]
    assert reply["restart"] == ["mesh.port (40123 instead of 0)"]
    b.wait_no_topic("/later")
    flows(moved)

    report = flows(steady)
    whole(report, int(str(report["last"])))
    assert [connection(a, "/say_steady"), connection(b, "/hear_steady")] == connections
