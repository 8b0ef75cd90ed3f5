"""The demo as users run it, end to end: figures, a killed module, every way it may end, nothing left behind."""

from __future__ import annotations

import asyncio
import json
import os
import re
import signal
import socket
import sys
import urllib.error
import urllib.request
from collections.abc import Callable
from pathlib import Path
from typing import Any, Final

import psutil
import pytest

from lab.bed.processes import Process, eventually
from rmpa.observe.control_client import ControlClient, choose_agent
from rmpa.resource import ResourceClient, at_least, at_most
from rmpa.ros.node.node import Node
from stick import AXIS, BUTTON, EVENT

ROOT: Final = Path(__file__).parents[2]
DEMO: Final = ROOT / "examples" / "turtlebot" / "demo.py"
MODULES: Final = ("joystick", "velocity", "base", "pc")
pytestmark = pytest.mark.timeout(120)


def family(demo: Process) -> list[psutil.Process]:
    """All processes of a demo: the supervisor, its children, and theirs."""
    supervisor = psutil.Process(demo.pid)
    return [supervisor, *supervisor.children(recursive=True)]


def open_ports(processes: list[psutil.Process]) -> set[int]:
    return {
        connection.laddr.port
        for process in processes
        for connection in process.net_connections()
        if connection.status == psutil.CONN_LISTEN
    }


def assert_gone(processes: list[psutil.Process], ports: set[int]) -> None:
    _, alive = psutil.wait_procs(processes, timeout=10)
    for process in alive:
        process.kill()
    assert not alive, "processes are left"
    assert ports, "there was something to close"
    for port in ports:
        with socket.socket() as probe:
            assert probe.connect_ex(("127.0.0.1", port)) != 0, f"port {port} is left open"


def views(demo: Process) -> list[dict[str, Any]]:
    """What the pc showed so far, one object a second."""
    return [json.loads(line) for line in demo.output.splitlines() if line.startswith('{"seconds"')]


def summary_of(demo: Process) -> dict[str, Any]:
    (line,) = [line for line in demo.output.splitlines() if line.startswith('{"summary"')]
    found: dict[str, Any] = json.loads(line)["summary"]
    return found


def states(view: dict[str, Any]) -> dict[str, str]:
    return {name: module["state"] for name, module in view["modules"].items()}


def wait_for_view(
    demo: Process, holds: Callable[[dict[str, Any]], bool], what: str, within: float = 75.0
) -> dict[str, Any]:
    """Wait until one of the last views is as wanted, at most so many seconds."""

    def look() -> list[dict[str, Any]]:
        assert demo.returncode is None, f"the demo ended with {demo.returncode}\n{demo.output}"
        return [view for view in views(demo)[-2:] if holds(view)]

    return eventually(look, within, what=what)[0]


def flows(view: dict[str, Any]) -> bool:
    return all(topic["rate"] > 0 for topic in view["topics"].values())


def all_linked(view: dict[str, Any]) -> bool:
    return states(view) == {"joystick": "linked", "velocity": "linked", "base": "linked", "pc": "here"}


def web_address(demo: Process) -> str:
    """The address of the web page, without its token: the first line of ``--json`` has it."""
    address: str = json.loads(demo.wait_for(r'^\{"web": ').string)["web"]
    return address.partition("?")[0]


def status_of(url: str) -> int:
    try:
        with urllib.request.urlopen(url, timeout=30) as response:
            status: int = response.status
    except urllib.error.HTTPError as error:
        with error:
            status = error.code
    return status


def test_the_paper_s_set_up_runs_and_leaves_nothing(tidy: dict[str, str]) -> None:
    with Process([sys.executable, DEMO, "--no-web", "--seconds", "24", "--json"], env=tidy, name="demo") as demo:
        wait_for_view(demo, lambda view: all_linked(view) and flows(view), "messages of all four modules")
        processes = family(demo)
        ports = open_ports(processes)
        assert len(processes) == 9, "the supervisor; an agent and a node for each module"
        assert demo.wait(30) == 0, demo.output
    assert_gone(processes, ports)
    summary = summary_of(demo)
    assert states(summary) == {"joystick": "linked", "velocity": "linked", "base": "linked", "pc": "here"}
    rates = {name: topic["rate"] for name, topic in summary["topics"].items()}
    assert rates == {
        "/command_information": pytest.approx(10, rel=0.2),
        "/velocity_order": pytest.approx(10, rel=0.2),
        "/odom": pytest.approx(50, rel=0.2),
    }
    for name in ("/command_information", "/odom"):
        assert 0 < summary["topics"][name]["latency"]["p50"] < 1
    assert abs(summary["topics"]["/velocity_order"]["latency"]["p50"]) < 1, "by the link's clock: it has no header"
    assert 0 < summary["command_to_velocity"]["mean"] < 0.1
    assert summary["pose"]["x"] != 0 or summary["pose"]["y"] != 0
    poses = {(view["pose"]["x"], view["pose"]["y"]) for view in views(demo) if view["pose"]}
    assert len(poses) > 2, "the robot drives"
    assert all(module["first_message"] > 0 for module in summary["modules"].values())


async def test_the_demos_modules_are_smart_resources(tidy: dict[str, str]) -> None:
    async def profile(name: str, wanted: str) -> None:
        subscriber = await node.subscribe(f"/{name}/profile", "std_msgs/String")
        async with asyncio.timeout(30):
            async for received in subscriber:
                if received.message.data == wanted:
                    break
        await subscriber.close()

    async def period(topic: str, kind: str) -> float:
        stamps: list[float] = []
        subscriber = await node.subscribe(topic, kind)
        async with asyncio.timeout(30):
            async for received in subscriber:
                stamps.append(received.message.header.stamp.sec + received.message.header.stamp.nanosec * 1e-9)
                if len(stamps) == 12:  # what waited for the route to open comes first
                    break
        await subscriber.close()
        return (stamps[-1] - stamps[1]) / 10

    with Process([sys.executable, DEMO, "--no-web", "--json"], env=tidy, name="demo") as demo:
        before = await asyncio.to_thread(
            wait_for_view, demo, lambda view: all_linked(view) and flows(view), "messages"
        )
        assert before["notes"] == [], "nothing to say at the start"
        # From the pc, of whose core they know nothing.
        (agents,) = Path(tidy["TMPDIR"]).glob("rmpa-demo-*/agents")
        with ControlClient(choose_agent({"RMPA_RUNTIME_DIR": str(agents)}, "pc").path) as agent:
            uri = agent.snapshot().agent.core_uri
        async with Node("guest", master_uri=uri) as node:
            async with (
                ResourceClient(node, "joystick") as joystick,
                ResourceClient(node, "velocity") as velocity,
                ResourceClient(node, "base") as base,
            ):
                await joystick.require(timeout=30.0, rate=at_least("20 Hz", hard=True))
                await velocity.require(timeout=30.0, acceleration=at_most("1.2 m/s²"))
                await base.require(timeout=30.0, power=at_most("6 W", hard=True))
                await asyncio.gather(profile("joystick", "brisk"), profile("velocity", "gentle"))
                await profile("base", "saving")
                assert await period("/odom", "nav_msgs/Odometry") == pytest.approx(0.1, rel=0.2)
                assert await period("/command_information", "sensor_msgs/Joy") == pytest.approx(0.04, rel=0.2)
            # The guest asks for nothing any more.
            await asyncio.gather(
                profile("joystick", "steady"), profile("velocity", "direct"), profile("base", "full")
            )
            assert await period("/odom", "nav_msgs/Odometry") == pytest.approx(0.02, rel=0.2)
        for name in ("joystick", "velocity", "base", "pc"):
            with ControlClient(choose_agent({"RMPA_RUNTIME_DIR": str(agents)}, name).path) as agent:
                assert [peer.conflicts for peer in agent.snapshot().peers] == [()] * 3, "they are of different kinds"
        assert await asyncio.to_thread(demo.interrupt) == 0, demo.output


@pytest.mark.long
def test_a_killed_module_is_shown_gone_and_comes_back(tidy: dict[str, str]) -> None:
    def command(*words: str) -> Process:
        return Process([sys.executable, DEMO, *words], env=tidy, name=" ".join(words))

    with Process([sys.executable, DEMO, "--no-web", "--json"], env=tidy, name="demo") as demo:
        before = wait_for_view(demo, lambda view: all_linked(view) and flows(view), "messages of all modules")
        with command("kill", "base") as kill:
            assert kill.wait() == 0, kill.output
            pids = [int(pid) for pid in re.findall(r"\d+", kill.output.partition("processes")[2])]
        assert len(pids) == 2
        assert not any(map(psutil.pid_exists, pids))
        gone = wait_for_view(
            demo,
            lambda view: (
                states(view)["base"] == "gone"
                and view["topics"]["/odom"]["rate"] == 0
                and view["topics"]["/velocity_order"]["rate"] > 0
            ),
            "base gone",
        )
        assert states(gone)["joystick"] == states(gone)["velocity"] == "linked"
        assert (
            gone["topics"]["/command_information"]["messages"] > before["topics"]["/command_information"]["messages"]
        )

        for words, answer in (
            (("kill", "base"), "base does not run"),
            (("start", "pc"), "pc runs already"),
            (("kill", "bas"), "no module named 'bas': there are joystick, velocity, base, pc"),
            (("kill", "base", "--demo", "1"), "no demo has the pid 1"),
        ):
            with command(*words) as refused:
                assert refused.wait() == 1
                assert answer in refused.output

        with command("start", "base") as start:
            assert start.wait() == 0, start.output
        wait_for_view(demo, lambda view: all_linked(view) and flows(view), "base back")
        wait_for_view(
            demo,
            lambda view: [one["profile"] for one in view["modules"].values()] == ["steady", "direct", "full", ""],
            "the profile of each resource",
        )
        assert demo.interrupt() == 0, demo.output
    (restart,) = summary_of(demo)["restarts"]
    assert restart["module"] == "base"
    assert restart["seen_gone_after"] > 0
    assert restart["back_after"] > 0


@pytest.mark.parametrize("number", [signal.SIGTERM, pytest.param(signal.SIGHUP, marks=pytest.mark.long)])
def test_it_ends_in_order_when_it_is_told_to(tidy: dict[str, str], number: signal.Signals) -> None:
    with Process([sys.executable, DEMO, "--no-web"], env=tidy, name="demo") as demo:
        demo.wait_for(r"base:linked.* ODOM [1-9]", 75)
        processes = family(demo)
        ports = open_ports(processes)
        os.kill(demo.pid, number)
        assert demo.wait() == 0, demo.output
    assert_gone(processes, ports)
    assert "Summary of" in demo.output
    assert "Traceback" not in demo.output


def test_it_can_be_interrupted_while_it_starts(tidy: dict[str, str]) -> None:
    with Process([sys.executable, DEMO, "--no-web"], env=tidy, name="demo") as demo:
        eventually(lambda: len(family(demo)) > 3, 20, what="some children")
        processes = family(demo)
        os.kill(demo.pid, signal.SIGINT)
        assert demo.wait(20) == 0, demo.output
    _, alive = psutil.wait_procs(processes, timeout=10)
    assert not alive
    assert "Traceback" not in demo.output


def test_a_killed_demo_leaves_no_children_and_no_files(tidy: dict[str, str]) -> None:
    with Process([sys.executable, DEMO, "--no-web"], env=tidy, name="demo") as demo:
        demo.wait_for(r"base:linked", 30)
        processes = family(demo)
        ports = open_ports(processes)
        os.kill(demo.pid, signal.SIGKILL)
        assert demo.wait() == -signal.SIGKILL
    assert_gone(processes, ports)
    assert len(list(Path(tidy["TMPDIR"]).iterdir())) == 1, "no process was left to remove it"
    with Process([sys.executable, DEMO, "kill", "base"], env=tidy) as kill:
        assert kill.wait() == 1
        assert "no demo runs here" in kill.output
    with Process([sys.executable, DEMO, "--no-web", "--seconds", "0.1"], env=tidy) as following:
        assert following.wait(30) == 0, following.output


@pytest.mark.long
def test_two_demos_on_one_machine_do_not_meet(tidy: dict[str, str]) -> None:
    with (
        Process([sys.executable, DEMO, "--no-web", "--json"], env=tidy, name="first") as first,
        Process([sys.executable, DEMO, "--no-web", "--json"], env=tidy, name="second") as second,
    ):
        for demo in (first, second):
            wait_for_view(demo, lambda view: all_linked(view) and flows(view), "messages of all modules")
        with Process([sys.executable, DEMO, "kill", "base"], env=tidy) as kill:
            assert kill.wait() == 1
            assert "several demos run here; name one with --demo PID" in kill.output
        with Process([sys.executable, DEMO, "kill", "base", "--demo", str(first.pid)], env=tidy) as kill:
            assert kill.wait() == 0, kill.output
        wait_for_view(first, lambda view: states(view)["base"] == "gone", "base of the first gone")
        assert all_linked(views(second)[-1])
        assert first.interrupt() == second.interrupt() == 0


def test_a_real_joystick_steers_and_may_be_unplugged(tidy: dict[str, str], tmp_path: Path) -> None:
    device = tmp_path / "js0"
    os.mkfifo(device)
    plug = os.open(device, os.O_RDWR)
    with Process([sys.executable, DEMO, "--no-web", "--json", "--joystick", device], env=tidy, name="demo") as demo:
        os.write(plug, EVENT.pack(0, 1, BUTTON, 0) + EVENT.pack(0, -32767, AXIS, 1))
        wait_for_view(demo, lambda view: bool(view["pose"]) and view["pose"]["speed"] == 0.65, "full speed ahead")
        os.close(plug)
        gone = "is gone (end of file): the robot stops"  # later it may be found again: the file is still there
        wait_for_view(
            demo,
            lambda view: any(gone in note for note in view["notes"]) and view["pose"]["speed"] == 0,
            "a stop and why",
        )
        stopped = wait_for_view(
            demo, lambda view: view["topics"]["/command_information"]["rate"] > 0, "it goes on to publish"
        )
        assert stopped["pose"]["y"] == pytest.approx(0, abs=1e-9)
        assert demo.interrupt() == 0, demo.output


@pytest.mark.long
def test_the_pc_itself_can_be_killed(tidy: dict[str, str]) -> None:
    with Process([sys.executable, DEMO, "--json"], env=tidy, name="demo") as demo:
        wait_for_view(demo, flows, "messages")
        page = web_address(demo)
        assert status_of(f"{page}healthz") == 200
        with Process([sys.executable, DEMO, "kill", "pc"], env=tidy) as kill:
            assert kill.wait() == 0, kill.output
        assert status_of(f"{page}healthz") == 503, "the web page outlives the pc, and says that its agent is gone"
        demo.wait_for("the pc is killed, the others go on")
        count = len(views(demo))
        with Process([sys.executable, DEMO, "start", "pc"], env=tidy) as start:
            assert start.wait() == 0, start.output
        eventually(lambda: len(views(demo)) > count and flows(views(demo)[-1]), 30, what="a table again")
        eventually(lambda: status_of(f"{page}healthz") == 200, 30, what="the web page with its agent")
        assert demo.interrupt() == 0, demo.output
    assert summary_of(demo)["modules"]["pc"]["first_message"] > 0


@pytest.mark.parametrize(
    ("flags", "status", "text"),
    [
        (["--joystick", "/nowhere/js0"], 1, "--joystick /nowhere/js0: No such file or directory; there is "),
        (["--joystick", "/etc/passwd"], 1, "--joystick /etc/passwd: is not a device"),
        (["--seconds", "0"], 2, "0 is not a number of seconds"),
        (["--seconds", "nan"], 2, "nan is not a number of seconds"),
        (["--seconds", "soon"], 2, "soon is not a number of seconds"),
    ],
)
def test_wrong_flags_are_refused_plainly(tidy: dict[str, str], flags: list[str], status: int, text: str) -> None:
    with Process([sys.executable, DEMO, *flags], env=tidy) as demo:
        assert demo.wait() == status
        assert text in demo.output
        assert "Traceback" not in demo.output


def test_the_commands_of_the_pages(tidy: dict[str, str]) -> None:
    commands = ["demo", "demo-kill MODULE=base", "demo-start MODULE=base"]
    for page in ("README.md", "docs/start/demo.md"):
        text = (ROOT / page).read_text(encoding="utf-8")
        assert re.findall(r"^\$ make (demo[^#\n]*?) *(?:#.*)?$", text, re.MULTILINE) == commands, page
    # The environment that `make` would build first is the one that these tests run in.
    make = ["make", "-C", str(ROOT), "-o", ".venv/.installed", f"BIN={Path(sys.executable).parent}"]
    with Process([*make, *commands[0].split()], env=tidy, name="make demo") as demo:
        demo.wait_for(r"base:linked.* ODOM [1-9]", 30)
        processes = family(demo)
        ports = open_ports(processes)
        for command, wanted in ((commands[1], r"base:gone.* ODOM 0.0"), (commands[2], r"base:linked.* ODOM [1-9]")):
            mark = demo.mark()
            with Process([*make, *command.split()], env=tidy, name=command) as second_terminal:
                assert second_terminal.wait() == 0, second_terminal.output
            demo.wait_for(wanted, 30, since=mark)
        demo.send(signal.SIGINT)  # to make as well, as a terminal does
        demo.wait(20)
    assert_gone(processes, ports)
    assert "Summary of" in demo.output
    assert re.search(r"base killed, seen gone after [\d.]+ s, back [\d.]+ s after its start", demo.output)
