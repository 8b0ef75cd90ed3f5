"""The flight recorder beside real agents and ROS nodes: kept at all modules, whole, and read by ROS's own tools."""

from __future__ import annotations

import json
import os
import random
import shutil
import signal
import subprocess
import time
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any, Final

import pytest

from lab.bed.agents import RMPA, Agent
from lab.bed.namespaces import Lab
from lab.bed.processes import Process, eventually
from rmpa.bridge.kept import KEPT, Kept, request_keep, write_kept
from rmpa.core.errors import RmpaError
from rmpa.observe.control_client import ControlClient, choose_agent
from rmpa.record.format import EVENTS, read_event
from tests.interop.conftest import AgentFactory, ModuleFactory, ShellFactory
from tests.interop.modules import Module
from tests.interop.nodes.payload import HEADER, Pattern
from tests.interop.secured import SecuredMesh
from tests.record.conftest import read_any

pytestmark = [pytest.mark.ros, pytest.mark.netns, pytest.mark.timeout(180)]

CONFIG: Final = "[record]\nenabled = true\nafter = 0.5\nseconds = 60\n"
LONG: Final = 40.0


def recordings(agent: Agent) -> dict[str, list[str]]:
    """By recording the modules that have it, as ``rmpa record list`` shows."""
    found: dict[str, list[str]] = {}
    for module in json.loads(agent.rmpa("record", "list", "--json")[1]):
        for kept in module["kept"]:
            found.setdefault(kept["id"], []).append(module["module"])
    return found


def recorders(agent: Agent, *topics: str) -> None:
    """Wait until all modules record these topics."""

    def ready() -> bool:
        listed = json.loads(agent.rmpa("record", "list", "--json")[1])
        counts: dict[str, int] = {}
        for module in listed:
            counts |= module.get("status", {}).get("messages", {})
        return all(counts.get(topic, 0) > 10 for topic in topics)

    eventually(ready, LONG, what=f"{', '.join(topics)} in the recorders' status")


def reach_back(agent: Agent, seconds: float) -> None:
    """Wait until the rings of all linked modules have so much of the past."""

    def there() -> bool:
        listed = json.loads(agent.rmpa("record", "list", "--json")[1])
        return all(module.get("status", {}).get("ring", (0, 0.0))[1] >= seconds for module in listed)

    eventually(there, seconds + LONG, what=f"{seconds:g} s in the rings", every=1.0)


def keep(module: Module, path: Path, *words: str) -> dict[str, Any]:
    code, output = module.agent.rmpa("record", "keep", "by a test", "--json", "-o", str(path), *words)
    assert code == 0, output
    found: dict[str, Any] = json.loads(output.splitlines()[0])
    return found


def folder_of(module: Module) -> Path:
    """The recorder's folder of a module."""
    return module.agent.home / "state" / module.host.name / module.name / "record"


def assert_whole(path: Path, topic: str, source: int, since: float, until: float) -> None:
    """All that a talker has published on a topic from one time to another is there: each message, once, in order."""
    found = [framed(m.data) for m in read_any(path) if m.source.topic == topic]
    heads = [HEADER.unpack_from(data) for data in found]
    numbers = [sequence for _, sequence, _, _ in heads]
    assert numbers == list(range(numbers[0], numbers[0] + len(numbers))), f"{topic}: none missing, none twice"
    assert heads[0][2] <= since * 1e9 or numbers[0] == 1, f"{topic}: {heads[0][2] / 1e9 - since:.3f} s are missing"
    assert heads[-1][2] >= until * 1e9, f"{topic}: the last {until - heads[-1][2] / 1e9:.3f} s are missing"
    pattern = Pattern(len(found[0]))
    for data, (_, sequence, stamp, _) in zip(found, heads, strict=True):
        sent = pattern.payload(source, sequence)
        assert (data[:8], data[16:], stamp > 0) == (sent[:8], sent[16:], True)


def framed(data: bytes) -> bytes:
    """The payload of a UInt8MultiArray: behind its layout and length."""
    return data[12:]


def sequences(path: Path, topic: str) -> list[int]:
    """The numbers of the payloads on a topic."""
    return [HEADER.unpack_from(m.data, 12)[1] for m in read_any(path) if m.source.topic == topic]  # behind the layout


def test_what_all_modules_kept_is_one_file_that_ros_reads(modules: ModuleFactory, tmp_path: Path) -> None:
    a, b = modules("a", "b", fresh=True, config=CONFIG)
    a.ros.rospy("talker", topic="/odom", rate=50, name="base")
    b.ros.rospy("talker", topic="/scan", rate=50, name="laser", source=2)
    recorders(a.agent, "/odom", "/scan")
    listener = a.ros.rospy(
        "listener", topic="/scan", name="display"
    )  # it has a proxy at a, which must not be recorded again
    listener.wait_event("report", where=lambda e: int(str(e["count"])) > 5)
    path = tmp_path / "all.mcap"

    def kept_with_its_story() -> dict[str, Any]:
        path.unlink(missing_ok=True)
        answer = keep(a, path)
        story = json.loads(a.agent.rmpa("story", str(path), "--json")[1])
        return answer if any(line["text"] == "/display is there" for line in story["lines"]) else {}

    answer = eventually(kept_with_its_story, LONG, what="the node that came, in the story")
    assert answer["modules"] == {"a": "", "b": ""}
    assert recordings(b.agent)[answer["id"]] == ["b", "a"]
    for topic in ("/odom", "/scan"):
        numbers = sequences(path, topic)
        assert numbers == list(range(numbers[0], numbers[0] + len(numbers))), f"{topic}: none missing, none twice"
        assert len(numbers) > 10
    modules_of = {m.source.topic: m.source.module for m in read_any(path) if m.source.topic != EVENTS}
    assert (modules_of["/odom"], modules_of["/scan"]) == ("a", "b")

    bag = tmp_path / "all.bag"
    code, output = a.agent.rmpa("record", "merge", str(path), "-o", str(bag))
    assert (code, r"\n" in output) == (0, False), output
    info = a.ros.tool("rosbag", "info", str(bag))
    assert "/odom" in info
    assert "/scan" in info
    assert "does not need any migrations" in a.ros.tool("rosbag", "check", str(bag))
    # What cannot be written is told, also where another module has been asked.
    kept = folder_of(b) / "kept"
    shutil.rmtree(kept)
    kept.write_text("no folder")
    code, output = a.agent.rmpa("record", "keep", "b cannot", "--json")
    told = json.loads(output)["modules"]
    assert (code, told["a"]) == (1, "")
    assert "Not a directory" in told["b"]


@pytest.mark.long
def test_a_cut_of_a_minute_while_it_is_kept(modules: ModuleFactory, tmp_path: Path) -> None:
    """What is asked for meanwhile is done when the link is back; the minute before is there on both."""
    a, b = modules("a", "b", fresh=True, config=CONFIG.replace("seconds = 60", "seconds = 120"))
    a.ros.rospy("talker", topic="/odom", rate=50, name="base")
    b.ros.rospy("talker", topic="/scan", rate=50, name="laser", source=2)
    recorders(a.agent, "/odom", "/scan")
    reach_back(a.agent, 15.0)
    b.host.cut()
    cut = time.time()
    a.agent.wait_no_peer("b")
    reach_back(a.agent, 62.0)
    asked = time.time()
    answer = json.loads(a.agent.rmpa("record", "keep", "while b is away", "--seconds", "60", "--json")[1])
    assert answer["modules"] == {"a": ""}
    eventually(lambda: time.time() > cut + 60, 90.0, what="the end of the minute")
    b.host.restore()
    eventually(lambda: "b" in recordings(a.agent).get(answer["id"], []), LONG, what="b keeps it when it is back")
    assert a.agent.rmpa("record", "fetch", answer["id"], "-o", str(tmp_path / "cut"))[0] == 0
    for module, topic, source in (("a", "/odom", 1), ("b", "/scan", 2)):
        assert_whole(tmp_path / "cut" / module, topic, source, asked - 60.0, asked)
    name = next(name for name in recordings(a.agent) if "peer_lost" in name)
    folder = tmp_path / "lost"
    assert a.agent.rmpa("record", "fetch", name, "-o", str(folder))[0] == 0
    events = [read_event(m.data) for m in read_any(folder) if m.source.topic == EVENTS]
    assert any(event is not None and event.kind == "peer_lost" and event.trigger for event in events)


@pytest.mark.long
def test_a_recorder_that_is_killed_has_lost_less_than_a_second(modules: ModuleFactory, tmp_path: Path) -> None:
    (a,) = modules("a", fresh=True, config=CONFIG)
    talker = a.ros.rospy("talker", topic="/odom", rate=100, name="base")
    recorders(a.agent, "/odom")
    status = json.loads(a.agent.rmpa("record", "list", "--json")[1])[0]["status"]
    now = time.time_ns()
    asked = Kept(id="asked", why="just before the kill", since=now - 10 * 10**9, until=now + 4 * 10**9)
    request_keep(folder_of(a), asked)
    eventually(lambda: time.time_ns() > now + 10**9)  # it waits for the end of that time
    os.kill(status["pid"], signal.SIGKILL)

    def again() -> bool:
        now = json.loads(a.agent.rmpa("record", "list", "--json")[1])[0]["status"]
        return bool(now) and now["pid"] != status["pid"] and now["messages"].get("/odom", 0) > 10

    eventually(again, LONG, what="another recorder")
    eventually(lambda: "asked" in recordings(a.agent), LONG, what="what was asked of the one that was killed")
    path = tmp_path / "killed.mcap"
    keep(a, path)
    numbers = sequences(path, "/odom")
    jumps = [(one, other) for one, other in pairwise(numbers) if other != one + 1]
    assert len(jumps) == 1, "the time from the kill to the next recorder"
    before = [m.log_time for m in read_any(path) if m.source.topic == "/odom"][numbers.index(jumps[0][0])]
    assert before / 1e9 > status["at"] - 1.0, "what was there a second before the last status is kept"
    talker.end()


@pytest.mark.long
def test_an_alarm_keeps_the_minute_before_it_on_every_module(modules: ModuleFactory, tmp_path: Path) -> None:
    a, b, c = made = modules("a", "b", "c", fresh=True, config=CONFIG.replace("after = 0.5", "after = 5"))
    a.ros.rospy("talker", topic="/odom", rate=100, name="base", size=200)
    b.ros.roscpp("talker", topic="/scan", rate=200, name="laser", size=1000, source=2)
    c.ros.rospy("talker", topic="/joints", rate=50, name="joints", size=64, source=3)
    topics = {"a": ("/odom", 1), "b": ("/scan", 2), "c": ("/joints", 3)}
    arm = a.ros.rospy("diagnosed", "/diagnostics:=/arm/alarms", name="arm", commands=True)
    recorders(a.agent, "/odom", "/scan", "/joints")
    reach_back(a.agent, 65.0)
    arm.tell('{"level": 2, "message": "the arm is too hot"}')

    def kept() -> str:
        found = recordings(a.agent)
        return next((one for one in found if "alarm" in one and sorted(found[one]) == ["a", "b", "c"]), "")

    name = eventually(kept, LONG, what="a recording of the alarm at all modules")
    assert a.agent.rmpa("record", "fetch", name, "-o", str(tmp_path / "alarm"))[0] == 0
    events = [
        (m.log_time / 1e9, read_event(m.data)) for m in read_any(tmp_path / "alarm/a") if m.source.topic == EVENTS
    ]
    alarms = [at for at, one in events if one is not None and one.kind == "alarm"]
    assert len(alarms) == 1, "it is said again and again, and is one"
    for module in made:
        topic, source = topics[module.name]
        path = tmp_path / "alarm" / module.name
        assert_whole(path, topic, source, alarms[0] - 60.0, alarms[0] + 4.5)
        first = next(m for m in read_any(path) if m.source.topic == topic)
        assert HEADER.unpack_from(framed(first.data))[1] > 1 or first.log_time / 1e9 <= alarms[0] - 60.0
    whole = tmp_path / "alarm.mcap"
    assert a.agent.rmpa("record", "merge", str(tmp_path / "alarm"), "-o", str(whole))[0] == 0
    for topic, source in topics.values():
        assert_whole(whole, topic, source, alarms[0] - 60.0, alarms[0] + 4.5)


@pytest.mark.long
def test_a_node_that_is_killed_keeps_a_recording_and_one_that_ends_does_not(modules: ModuleFactory) -> None:
    (a,) = modules("a", fresh=True, config=CONFIG)
    killed = a.ros.rospy("talker", topic="/odom", rate=50, name="base")
    ended = a.ros.rospy("talker", topic="/scan", rate=50, name="laser")
    recorders(a.agent, "/odom", "/scan")
    ended.end()
    killed.kill()
    name = eventually(lambda: next(iter(recordings(a.agent)), ""), LONG, what="a recording of the death")
    assert "node_died" in name
    events = [read_event(m.data) for m in read_any(folder_of(a) / "kept" / name) if m.source.topic == EVENTS]
    told = {(one.kind, one.subject, one.text) for one in events if one is not None and one.kind.startswith("node_")}
    assert ("node_died", "/base", "/base died: no process listens where it did") in told
    assert ("node_gone", "/laser", "/laser is gone") in told
    assert not {("node_died", "/laser"), ("node_gone", "/base")} & {one[:2] for one in told}


@pytest.mark.long
def test_a_module_that_dies_for_good(modules: ModuleFactory, tmp_path: Path) -> None:
    """The others keep what they have, and what they merge says that it is missing."""
    a, b, c = modules("a", "b", "c", fresh=True, config=CONFIG)
    for number, module in enumerate((a, b, c)):
        module.ros.rospy("talker", topic=f"/odom_{module.name}", rate=50, name="base", source=number + 1)
    recorders(a.agent, "/odom_a", "/odom_b", "/odom_c")
    for pid in subprocess.check_output(["ip", "netns", "pids", c.host.namespace], text=True).split():
        os.kill(int(pid), signal.SIGKILL)

    def kept() -> str:
        found = recordings(a.agent)
        return next((one for one in found if "peer_lost" in one and sorted(found[one]) == ["a", "b"]), "")

    name = eventually(kept, LONG, what="a recording of the lost peer at those that are left")
    folder, path = tmp_path / "lost", tmp_path / "lost.mcap"
    assert b.agent.rmpa("record", "fetch", name, "-o", str(folder))[0] == 0
    code, output = b.agent.rmpa("record", "merge", str(folder), "-o", str(path))
    assert code == 0
    assert "Nothing of c is here, which was linked" in output
    assert "Nothing of c is here" in b.agent.rmpa("story", str(path))[1]
    modules_of = {m.source.topic: m.source.module for m in read_any(path) if m.source.topic.startswith("/odom_")}
    assert modules_of == {"/odom_a": "a", "/odom_b": "b"}


@pytest.mark.long
def test_a_topic_that_changes_its_type_and_a_type_that_only_its_publisher_knows(
    modules: ModuleFactory, tmp_path: Path
) -> None:
    (a,) = modules("a", fresh=True, config=CONFIG)
    for words in ([("another-md5", True)], [], [("type", "String")]):  # of another release, of this one, another one
        talker = a.ros.node("rospy", "talker", topic="/odd", rate=50, name="odd", **dict(words))
        more = counted(a.agent, "/odd") + 20
        eventually(partial(reaches, a.agent, "/odd", more), LONG, what=f"/odd with {words}")
        talker.end()
    path, bag = tmp_path / "odd.mcap", tmp_path / "odd.bag"
    keep(a, path)
    types = {(m.source.type, m.source.md5sum) for m in read_any(path) if m.source.topic == "/odd"}
    assert {("std_msgs/UInt8MultiArray", "f" * 32), ("std_msgs/String", "992ce8a1687cec8c8bd883ec73ca41d1")} < types
    assert len(types) == 3
    assert any("float32 quality" in m.source.definition for m in read_any(path))
    assert a.agent.rmpa("record", "merge", str(path), "-o", str(bag))[0] == 0
    info = a.ros.tool("rosbag", "info", str(bag))
    assert "992ce8a1687cec8c8bd883ec73ca41d1" in info
    assert "f" * 32 in info
    code, output = a.agent.rmpa("play", str(path), "-t", "/odd", "-r", "20")
    assert code == 0, output
    assert "not played: /odd as std_msgs/String: it is std_msgs/UInt8MultiArray at first" in output


def reaches(agent: Agent, topic: str, count: int) -> bool:
    return counted(agent, topic) >= count


def counted(agent: Agent, topic: str) -> int:
    """Messages of a topic that the recorders of a module's mesh have taken."""
    listed = json.loads(agent.rmpa("record", "list", "--json")[1])
    return int(sum(module.get("status", {}).get("messages", {}).get(topic, 0) for module in listed))


@pytest.mark.long
@pytest.mark.timeout(600)
def test_sixteen_modules_keep_within_a_second(modules: ModuleFactory) -> None:
    """From the request to the last of 16 files ``recording.json``; the best of five, because machines are shared."""
    made = modules(*(f"m{number:02}" for number in range(16)), fresh=True, config=CONFIG, log_level="info")
    for module in made:
        eventually((folder_of(module) / "status.json").exists, 120.0, what=f"a recorder at {module.name}")
    took = []
    with ControlClient(choose_agent(made[0].agent.env, made[0].name).path, timeout=60.0) as client:
        for number in range(5):
            began, name = time.time(), f"all-{number}"
            answers = client.call("record", dict[str, str], what="keep", id=name, why="all", seconds=60.0)
            assert answers == dict.fromkeys([module.name for module in made], "")
            paths = [folder_of(module) / "kept" / name / "recording.json" for module in made]
            for path in paths:
                eventually(path.exists, 60.0, what=str(path))
            took.append(max(path.stat().st_mtime for path in paths) - began)
    print("seconds to keep at 16 modules:", took, "load:", os.getloadavg())
    assert min(took) <= 1.0, took


RECORDED: Final = "[record]\nenabled = true\nafter = 0.5\n"
ALLOWED: Final = RECORDED + '[[permission]]\nmodules = ["joystick"]\nrecord = ["/**"]\n'
OPEN: Final = RECORDED + '[[permission]]\nmodules = ["*"]\nrecord = ["/**"]\npublish = ["/**"]\nsubscribe = ["/**"]\n'


@pytest.mark.long
def test_a_member_needs_permission_to_have_recordings_kept_and_to_read_them(
    lab: Lab, agent: AgentFactory, shell: ShellFactory, tmp_path: Path
) -> None:
    mesh = SecuredMesh(tmp_path, "base")
    mesh.add("joystick")
    base, joystick = (
        Module(host, agent(host, name=host.name, config=config), shell(host))
        for host, config in zip(lab.hosts("base", "joystick"), (RECORDED, OPEN), strict=True)
    )
    joystick.agent.wait_peer("base")
    base.ros.rospy("talker", topic="/odom", rate=50, name="base")
    recorders(base.agent, "/odom")
    kept = keep(base, tmp_path / "own.mcap")
    assert kept["modules"] == {"base": "", "joystick": ""}, "the joystick lets the base do it"

    refused = "do not let joystick use the recording"
    listed = {one["module"]: one for one in json.loads(joystick.agent.rmpa("record", "list", "--json")[1])}
    assert not listed["base"].get("kept")
    assert not listed["base"].get("status"), "the names of its topics are its own"
    assert refused in listed["base"]["problem"]
    code, output = joystick.agent.rmpa("record", "keep", "mine", "--json")
    told = json.loads(output)["modules"]
    assert (code, told["joystick"]) == (1, "")
    assert refused in told["base"]
    code, output = joystick.agent.rmpa("record", "fetch", kept["id"], "-o", str(tmp_path / "theirs"))
    assert [path.name for path in (tmp_path / "theirs").iterdir()] == ["joystick"]
    code, output = joystick.agent.rmpa("record", "rm", kept["id"], "--module", "base")
    assert code == 1
    assert refused in output
    file = next((folder_of(base) / "kept" / kept["id"]).glob("*.mcap")).name
    with (
        ControlClient(choose_agent(joystick.agent.env, "joystick").path) as client,
        pytest.raises(RmpaError, match=refused),
    ):
        client.call("record", object, what="read", module="base", id=kept["id"], file=file, offset=0)
    assert [one for one in recordings(base.agent).values() if "base" in one] == [["base", "joystick"]]

    (tmp_path / "base.toml").write_text(ALLOWED)
    assert base.agent.rmpa("reload")[0] == 0
    eventually(lambda: recordings(joystick.agent).get(kept["id"]) == ["joystick", "base"], LONG, what="it is listed")
    both = keep(joystick, tmp_path / "both.mcap")
    assert both["modules"] == {"joystick": "", "base": ""}
    assert sequences(tmp_path / "both.mcap", "/odom")
    assert joystick.agent.rmpa("record", "rm", both["id"])[0] == 0
    assert both["id"] not in recordings(base.agent)


RINGS: Final = '[record]\nenabled = true\nseconds = 20\nthin = "unlimited"\n'


@pytest.mark.long
def test_by_hand_of_the_mesh_is_what_all_modules_published_of_the_topics_that_are_wanted(
    modules: ModuleFactory, tmp_path: Path
) -> None:
    a, b = modules("a", "b", fresh=True, config=RINGS)
    a.ros.rospy("talker", topic="/odom", rate=50, name="base")
    b.ros.rospy("talker", topic="/scan", rate=50, name="laser", source=2)
    b.ros.rospy("talker", topic="/chatter", rate=50, name="chat", source=3)
    recorders(a.agent, "/odom", "/scan", "/chatter")

    def mesh(name: str, *words: str) -> tuple[int, str]:
        return a.agent.rmpa("record", "-o", str(tmp_path / name), *words)

    code, output = mesh("long.mcap", "--mesh", "--duration", "3600")
    assert (code, "ring of" in output) == (2, True), output
    assert mesh("both.mcap", "--mesh", "--here")[0] == mesh("both.mcap", "--mesh", "--peer", "b")[0] == 2
    code, output = mesh("all.bag", "--mesh", "--duration", "3", "-t", "/odom", "-t", "/sc*", "--json")
    answer = json.loads(output)
    assert (code, answer["problems"], answer["left_out"], answer["modules"]) == (0, {}, {}, ["a", "b"])
    assert {m.source.topic for m in read_any(tmp_path / "all.bag")} - {EVENTS} == {"/odom", "/scan"}
    for topic in ("/odom", "/scan"):
        numbers = sequences(tmp_path / "all.bag", topic)
        assert numbers == list(range(numbers[0], numbers[0] + len(numbers)))
        assert len(numbers) >= 150
    code, output = mesh("b.mcap", "--peer", "b", "--peer", "none", "--duration", "1")
    assert (code, "none is not recorded: it is not linked" in output) == (1, True), output
    assert {m.source.module for m in read_any(tmp_path / "b.mcap")} == {"b"}
    assert not recordings(a.agent), "it is in the files, and no module keeps it for ever"
    assert {path.suffix for path in tmp_path.glob("*.*")} & {".parts", ".new"} == set()


@pytest.mark.long
@pytest.mark.parametrize("way", ["here", "mesh"])
def test_ctrl_c_ends_a_recording_by_hand_and_a_second_one_loses_nothing(
    way: str, modules: ModuleFactory, tmp_path: Path
) -> None:
    (a,) = modules("a", fresh=True, config=RINGS)
    a.ros.rospy("talker", topic="/odom", rate=50, name="base")
    recorders(a.agent, "/odom")
    for times in (1, 2):
        path, parts = tmp_path / f"{times}.mcap", tmp_path / f"{times}.mcap.parts"
        words: list[str | Path] = [RMPA, "record", "-o", path, f"--{way}", "--json"]
        with Process(a.host.command(words), env={**a.agent.env, "RMPA_AGENT": "a"}) as command:
            eventually(partial(begun, command, parts), LONG, what="the command records")
            for _ in range(times):
                command.send(signal.SIGINT)
            code = command.wait(LONG)
        assert code == 0 or (times, code) == (2, 130), command.output
        if path.exists():
            assert sequences(path, "/odom")
            assert not parts.exists()
        elif parts.exists():
            assert f"rmpa record merge {parts}" in command.output
            assert sequences(parts, "/odom")
        elif way == "mesh":
            assert all(f"rmpa record fetch {name}" in command.output for name in recordings(a.agent))


def begun(command: Process, parts: Path) -> bool:
    """Whether a recording by hand has begun."""
    return "it ends by itself" in command.output or any(parts.rglob("*.mcap"))


@pytest.mark.long
def test_a_fetch_goes_on_after_a_cut_and_after_its_own_death(modules: ModuleFactory, tmp_path: Path) -> None:
    a, b = modules("a", "b", fresh=True)
    data = random.Random(1).randbytes(6_000_000)
    place = Path(b.agent.env["RMPA_STATE_DIR"]) / "b" / "record" / KEPT / "fall"
    place.mkdir(parents=True)
    for number in (1, 2):
        (place / f"{number}.mcap").write_bytes(data)
    write_kept(place, Kept(id="fall"))
    b.host.shape("20mbit")
    got = tmp_path / "fall" / "b"

    def size() -> int:
        return sum(path.stat().st_size for path in got.glob("*"))

    def fetching() -> Process:
        words: list[str | Path] = [RMPA, "record", "fetch", "fall", "-o", got.parent]
        return Process(a.host.command(words), env={**a.agent.env, "RMPA_AGENT": "a"})

    with fetching() as command:
        eventually(lambda: size() > 1_000_000, LONG, what="a part of it")
        command.kill()
    killed = size()
    with fetching() as command:
        eventually(lambda: size() > killed + 1_000_000, LONG, what="more of it")
        b.host.cut()
        a.agent.wait_no_peer("b")
        b.host.restore()
        assert command.wait(2 * LONG) == 0, command.output
    assert [path.read_bytes() == data for path in sorted(got.glob("*"))] == [True, True]
    (got / "1.mcap").write_bytes(b"another file")
    code, output = a.agent.rmpa("record", "fetch", "fall", "-o", str(got.parent))
    assert (code, "is another file than that of fall" in output) == (1, True), output
    assert (got / "1.mcap").read_bytes() == b"another file"
