"""The nodes of a resource: started, attached to, restarted, taken over after a crash, ended; what is said of it."""

from __future__ import annotations

import asyncio
import os
import signal
import subprocess
import sys
from collections.abc import AsyncIterator, Callable
from pathlib import Path
from typing import Any

import pytest
from msgspec import structs

from rmpa.core.errors import PeerRefused
from rmpa.resource import limits
from rmpa.resource.declare import ManagedNode
from rmpa.resource.node import ResourceNode
from rmpa.resource.processes import NodeState, command_of
from rmpa.resource.resource import Resource
from rmpa.ros.core.embedded import RosCore
from rmpa.ros.executables import find_executable
from rmpa.ros.node.node import Node
from rmpa.runtime.programs import ProgramMark, ResourceRun, end_program, figures
from tests.resource.rig import ARRAY, OK, WARN, status
from tests.waiting import until

TINY = [sys.executable, "-S", "-E", str(Path(__file__).parent / "nodes" / "tiny_node.py")]
Make = Callable[..., ResourceNode]


def described(*profiles: tuple[str, ...], **nodes: Any) -> Resource:
    """A resource whose profiles, best first, name these nodes; ``nodes``: further words of each node's command."""
    one = Resource("cam", role="sensing")
    one.adaptation(window=0.1, settle=0.1, cool_down=60.0, dwell=0.0)
    for key, how in nodes.items():
        given = {"words": how} if isinstance(how, tuple) else dict(how or {})
        words = given.pop("words", ())
        if how is not None:
            given["command"] = (*TINY, f"/{key}", *words)
        one.node(key, **{"stop_after": 2.0, **given})
    one.attribute("worth", better="max")
    for rank, names in enumerate(profiles or ((),)):
        one.profile(name=f"p{rank}", offers={"worth": 10.0 - rank}, cost=float(rank), nodes=names)(lambda: None)
    return one


@pytest.fixture
async def make(core: RosCore, tmp_path: Path) -> AsyncIterator[Make]:
    """Make a resource node with a folder of its own; what runs at the end is ended."""
    made: list[ResourceNode] = []

    def one(resource: Resource) -> ResourceNode:
        made.append(ResourceNode(resource, core.uri, state=tmp_path / "cam.json"))
        return made[-1]

    yield one
    for each in made:
        await each.close()


async def runs(node: ResourceNode, key: str) -> int:
    pid: int = await until(lambda: node.processes.pid(key), f"{key} does not run")
    return pid


async def record(folder: Path) -> ResourceRun:
    found = await asyncio.to_thread(ResourceRun.load, folder / "run" / "cam.json")
    assert found is not None
    return found


async def test_a_node_is_started_by_its_profile_and_ended_by_the_next(make: Make, tmp_path: Path) -> None:
    one = make(described(("laser",), (), always=(), laser={"words": ("--child",), "env": {"COLOUR": "red"}}))
    one.resource.folder = tmp_path
    await one.start()
    always, laser = await runs(one, "always"), await runs(one, "laser")
    log = (tmp_path / "log" / "cam.laser.log").read_text()
    assert f"begins: ['--child'] in {tmp_path} with red" in log
    child = int(log.partition("child ")[2].split()[0])
    await one.processes.note()
    told = {each.node: each for each in (await record(tmp_path)).nodes}
    assert {name: (each.pid, each.state) for name, each in told.items()} == {
        "/always": (always, NodeState.RUNNING),
        "/laser": (laser, NodeState.RUNNING),
    }
    assert all(each.mark and each.mark.runs and each.since for each in told.values())
    one.adapter.pin("p1")
    await until(lambda: one.adapter.adaptation.profile == "p1")
    assert figures(laser) is figures(child) is None, "with all processes that it has started"
    assert "ends in order" in (tmp_path / "log" / "cam.laser.log").read_text()
    assert one.processes.pid("always") == always
    await one.close()
    assert figures(always) is None
    assert (await record(tmp_path)).state == "finalized"


async def test_a_node_that_the_user_started_is_attached_to_and_never_ended(
    make: Make, core: RosCore, node: Node
) -> None:
    env = {**os.environ, "ROS_MASTER_URI": core.uri}
    with subprocess.Popen([*TINY, "/laser"], env=env, stdout=subprocess.DEVNULL) as theirs:
        try:
            await until(lambda: "/laser" in core.state().nodes)
            alarms = await node.subscribe("/cam/alarms", ARRAY)
            one = make(described(("laser",), (), laser=None))
            await one.start()
            assert await runs(one, "laser") == theirs.pid
            with pytest.raises(PeerRefused, match="node /laser runs, and was not started by cam"):
                await one.processes.restart("laser")
            one.adapter.pin("p1")
            await until(lambda: one.adapter.adaptation.profile == "p1")
            one.adapter.pin("")
            await until(lambda: one.adapter.adaptation.profile == "p0")
            assert theirs.poll() is None
            theirs.kill()
            told = await status(alarms, lambda each: each.level == WARN and "/laser" in each.message)
            assert "node /laser has ended" in told.message
            await until(lambda: one.adapter.adaptation.profile == "p1")
        finally:
            theirs.kill()
    await one.close()


async def test_a_node_that_is_missing_fails_its_profile_with_the_reason(make: Make) -> None:
    one = make(described(("laser",), (), laser=None))
    await one.start()
    assert one.adapter.adaptation.profile == "p1"
    scores = one.adapter.adaptation.explain(asyncio.get_running_loop().time())
    assert "node /laser does not run" in next(each.excluded for each in scores if each.profile == "p0")
    with pytest.raises(PeerRefused, match="/laser does not run; start it, or say in the file how it is started"):
        await one.processes.require(["laser"])


async def test_a_node_that_cannot_start_fails_its_profile_with_the_end_of_its_log(make: Make) -> None:
    one = make(described(("laser",), ("ghost",), (), laser=("--refuse",), ghost=None))
    one.resource.nodes["ghost"] = ghost = ManagedNode("ghost", "/ghost", run="no_package no_node")
    one.processes._nodes["ghost"].declared = ghost
    await one.start()
    assert one.adapter.adaptation.profile == "p2"
    cooling = one.adapter.adaptation.cooling(0.0)
    assert "/laser has ended with code 3 before it was registered" in cooling["p0"].why
    assert "no device /dev/none" in cooling["p0"].why
    assert "no_package no_node refused: there is no such executable" in cooling["p1"].why


async def test_a_node_that_always_runs_is_started_again_by_its_policy(make: Make, node: Node) -> None:
    alarms = await node.subscribe("/cam/alarms", ARRAY)
    one = make(described((), laser=(), once={"restart": "never"}))
    await one.start()
    laser, once = await runs(one, "laser"), await runs(one, "once")
    os.kill(laser, signal.SIGKILL)
    await status(alarms, lambda each: each.level == OK and "over: node /laser runs again" in each.message)
    assert await runs(one, "laser") != laser
    assert [each.run.restarts for each in one.processes._nodes.values()] == [1, 0]
    os.kill(once, signal.SIGTERM)
    told = await status(alarms, lambda each: "/once" in each.message)
    assert 'is not started again (restart = "never", and it ended in order)' in told.message
    assert "node /once has ended with code 0" in one.runtime.problems()[1][0]


async def test_a_node_that_fails_again_and_again_blocks_its_profiles(
    make: Make, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(limits, "NODE_FAILURES_MAX", 1)
    one = make(described(("laser",), (), laser=()))
    await one.start()
    os.kill(await runs(one, "laser"), signal.SIGKILL)
    await until(one.processes.blocked)
    assert "is not started again (1 times in a row)" in one.processes.blocked()["p0"]
    monkeypatch.setattr(limits, "NODE_BLOCKED", 0.0)
    assert not one.processes.blocked()


async def test_what_a_killed_run_had_started_is_taken_over_and_ended_in_order(make: Make, tmp_path: Path) -> None:
    first = make(described((), laser=(), camera=()))
    await first.start()
    before = {key: await runs(first, key) for key in ("laser", "camera")}
    await first.processes.note()
    kept = (tmp_path / "run" / "cam.json").read_bytes()
    children = [each._process for each in first.processes._nodes.values()]
    for each in first.processes._nodes.values():  # as after kill -9: nothing of it acts any more
        assert each._keeper is not None
        each._keeper.cancel()
        each.run, each._process = structs.replace(each.run, mark=None), None
    await first.close()
    (tmp_path / "run" / "cam.json").write_bytes(kept)
    assert all(figures(pid) for pid in before.values())

    second = make(described((), laser=()))  # the camera is not declared any more
    await second.start()
    assert await runs(second, "laser") == before["laser"]
    assert figures(before["camera"]) is None
    assert second.processes._nodes["laser"].own
    await second.close()
    assert figures(before["laser"]) is None
    assert [child is not None and child.poll() is not None for child in children] == [True, True]


async def test_a_restart_gives_arguments_and_another_process(make: Make) -> None:
    one = make(described((), ("rest",), laser=(), rest=()))
    await one.start()
    laser = await runs(one, "laser")
    await one.processes.restart("laser", args={"fps": "10"})
    assert await runs(one, "laser") != laser
    assert figures(laser) is None
    await one.processes.restart("rest", args={"fps": "10"})
    assert one.processes.pid("rest") is None, "its profile does not run"


async def test_a_script_that_ends_in_order_behind_its_node_is_not_started_again(make: Make) -> None:
    one = make(described((), laser=()))
    words = ("sh", "-c", f"{' '.join(TINY)} /laser; sleep 0.1; exit 0")
    one.processes._nodes["laser"].declared = ManagedNode("laser", "/laser", command=words)
    await one.start()
    os.kill(await runs(one, "laser"), signal.SIGTERM)
    await until(lambda: one.runtime.problems()[1])
    assert 'not started again (restart = "on-failure", and it ended in order)' in one.runtime.problems()[1][0]


async def test_a_deaf_program_is_killed_in_time(core: RosCore, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("rmpa.runtime.programs._TERMINATED", 0.1)
    env = {**os.environ, "ROS_MASTER_URI": core.uri}
    words = [*TINY, "/deaf", "--deaf"]
    process = subprocess.Popen(words, env=env, start_new_session=True, stdout=subprocess.DEVNULL)
    await until(lambda: "/deaf" in core.state().nodes)
    mark = ProgramMark.of(process.pid)
    assert mark is not None
    await end_program(mark, 0.1)
    assert process.wait(5) == -signal.SIGKILL
    assert not mark.runs
    await end_program(mark, 0.1)  # it is gone: nothing is done


def test_command_lines(tmp_path: Path) -> None:
    node = ManagedNode("cam", "/front/cam", run="demo node.py", args=("-v",), remap={"image": "/img"})
    prefix = tmp_path / "opt"
    for place in (prefix / "lib/demo/node.py", prefix / "env.sh"):
        place.parent.mkdir(parents=True, exist_ok=True)
        place.write_text("#!/bin/sh\n")
        place.chmod(0o755)
    found = command_of(node, {}, {"CMAKE_PREFIX_PATH": str(prefix)})
    assert found == [f"{prefix}/lib/demo/node.py", "-v", "image:=/img", "__name:=cam", "__ns:=/front"]
    source = tmp_path / "src" / "demo"
    (source / "scripts").mkdir(parents=True)
    (source / "package.xml").write_text("<package><name>demo</name></package>")
    script = source / "scripts" / "node.py"
    script.write_text("#!/bin/sh\n")
    script.chmod(0o755)
    assert find_executable("demo", "node.py", {"ROS_PACKAGE_PATH": str(tmp_path / "src")}) == [str(script)]
    launch = ManagedNode("cam", "/cam", launch="demo cam.launch", args=("fps:=30", "--wait"))
    (tmp_path / "roslaunch").write_text("#!/bin/sh\n")
    (tmp_path / "roslaunch").chmod(0o755)
    words = command_of(launch, {"fps": "10"}, {"PATH": str(tmp_path)})
    assert words == [f"{tmp_path}/roslaunch", "--screen", "demo", "cam.launch", "--wait", "fps:=10"]
    plain = ManagedNode("cam", "/cam", command=("docker", "run", "x"))
    assert command_of(plain, {}, {}) == ["docker", "run", "x"]
