"""The flight recorder beside real agents and ROS nodes: kept at all modules, whole, and read by ROS's own tools."""

from __future__ import annotations

import json
import os
import random
import signal
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any, Final

import pytest

from lab.bed.agents import RMPA, Agent
from lab.bed.processes import Process, eventually
from rmpa.bridge.kept import KEPT, Kept, write_kept
from rmpa.record.bag import read_any
from rmpa.record.format import EVENTS, read_event
from tests.interop.conftest import ModuleFactory
from tests.interop.modules import Module
from tests.interop.nodes.payload import HEADER

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


def keep(module: Module, path: Path, *words: str) -> dict[str, Any]:
    code, output = module.agent.rmpa("record", "keep", "by a test", "--json", "-o", str(path), *words)
    assert code == 0, output
    found: dict[str, Any] = json.loads(output.splitlines()[0])
    return found


def sequences(path: Path, topic: str) -> list[int]:
    """The numbers of the payloads on a topic."""
    return [HEADER.unpack_from(m.data, 12)[1] for m in read_any(path) if m.source.topic == topic]  # behind the layout


def test_what_all_modules_kept_is_one_file_that_ros_reads(modules: ModuleFactory, tmp_path: Path) -> None:
    a, b = modules("a", "b", fresh=True, config=CONFIG)
    a.ros.rospy("talker", topic="/odom", rate=50, name="base")
    b.ros.rospy("talker", topic="/scan", rate=50, name="laser", source=2)
    recorders(a.agent, "/odom", "/scan")
    listener = a.ros.rospy("listener", topic="/scan")  # it has a proxy at a, which must not be recorded again
    listener.wait_event("report", where=lambda e: int(str(e["count"])) > 5)
    path = tmp_path / "all.mcap"
    answer = keep(a, path)
    assert answer["modules"] == {"a": "", "b": ""}
    assert recordings(b.agent)[answer["id"]] == ["b", "a"]
    for topic in ("/odom", "/scan"):
        numbers = sequences(path, topic)
        assert numbers == list(range(numbers[0], numbers[0] + len(numbers))), f"{topic}: none missing, none twice"
        assert len(numbers) > 10
    modules_of = {m.source.topic: m.source.module for m in read_any(path) if m.source.topic != EVENTS}
    assert (modules_of["/odom"], modules_of["/scan"]) == ("a", "b")

    bag = tmp_path / "all.bag"
    assert a.agent.rmpa("record", "merge", str(path), "-o", str(bag))[0] == 0
    info = a.ros.tool("rosbag", "info", str(bag))
    assert "/odom" in info
    assert "/scan" in info
    assert "does not need any migrations" in a.ros.tool("rosbag", "check", str(bag))
    story = json.loads(a.agent.rmpa("story", str(path), "--json")[1])
    assert story["lines"]


@pytest.mark.long
def test_a_lost_link_keeps_both_sides_and_an_absent_module_later(modules: ModuleFactory, tmp_path: Path) -> None:
    a, b = modules("a", "b", fresh=True, config=CONFIG)
    a.ros.rospy("talker", topic="/odom", rate=50, name="base")
    recorders(a.agent, "/odom")
    b.host.cut()
    answer = json.loads(a.agent.rmpa("record", "keep", "while b is away", "--json")[1])
    eventually(lambda: any("peer_lost" in name for name in recordings(a.agent)), LONG, what="the lost peer is kept")
    b.host.restore()
    eventually(lambda: "b" in recordings(a.agent).get(answer["id"], []), LONG, what="b keeps it when it is back")
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
    os.kill(status["pid"], signal.SIGKILL)

    def again() -> bool:
        now = json.loads(a.agent.rmpa("record", "list", "--json")[1])[0]["status"]
        return bool(now) and now["pid"] != status["pid"] and now["messages"].get("/odom", 0) > 10

    eventually(again, LONG, what="another recorder")
    path = tmp_path / "killed.mcap"
    keep(a, path)
    numbers = sequences(path, "/odom")
    jumps = [(one, other) for one, other in pairwise(numbers) if other != one + 1]
    assert len(jumps) == 1, "the time from the kill to the next recorder"
    before = [m.log_time for m in read_any(path) if m.source.topic == "/odom"][numbers.index(jumps[0][0])]
    assert before / 1e9 > status["at"] - 1.0, "what was there a second before the last status is kept"
    talker.end()


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
