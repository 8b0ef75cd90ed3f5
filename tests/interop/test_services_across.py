"""Services between modules, and real clients and servers at our own."""

from __future__ import annotations

import asyncio
import signal
import time
from typing import Any

import pytest

from lab.bed.namespaces import Lab
from lab.bed.processes import CommandFailed, Process, eventually
from rmpa.core.errors import RmpaError
from rmpa.ros.node.node import Node
from rmpa.ros.types.installed import ServiceType
from tests.interop.conftest import ModuleFactory, ShellFactory
from tests.interop.ros import PYTHON, Ros
from tests.interop.services import caller, calls, wait_services, worker

pytestmark = [pytest.mark.ros, pytest.mark.timeout(120)]
CLIENTS = ["rospy", "roscpp"]
LARGE = 5_000_000
_SWITCH = """
import rospy
from std_srvs.srv import SetBool
def switch(request):
    if not request.data:
        raise rospy.ServiceException("it sticks")
    return True, "on"
rospy.init_node("switch")
service = rospy.Service("/arm/switch", SetBool, switch)
print("up", flush=True)
rospy.spin()
"""


@pytest.mark.netns
def test_calls_of_both_libraries_to_both_libraries(modules: ModuleFactory) -> None:
    a, b = modules("a", "b")
    for kind in CLIENTS:
        worker(a, kind, f"/arm/{kind}")
    for server in CLIENTS:
        for kind in CLIENTS:
            client = caller(b, kind, f"/arm/{server}")
            for how, count in (("once", 5), ("persistent", 20), ("parallel", 5)):
                done = calls(client, f"echo 0 1000 {count} {how}")
                assert (done["ok"], done["same"]) == (count, count), (server, kind, how, done)
            done = calls(client, f"echo 0 {LARGE} 2 persistent")
            assert (done["ok"], done["same"]) == (2, 2), (server, kind, done)
            done = calls(client, "sleep 0.5 10 8 parallel")
            assert done["same"] == 8
            assert float(str(done["took"])) < 3.0, "calls must be served at once, not one after the other"
            done = calls(client, "fail 0 10 1 once")
            assert done["ok"] == 0
            if kind == server == "rospy":
                assert "the gripper is jammed" in str(done["errors"])
            done = calls(client, "echo 0 10 1 once")
            assert done["same"] == 1, "an error ends one call, no more"
            client.end()


@pytest.mark.netns
def test_a_server_that_is_killed_in_the_middle_of_a_call(modules: ModuleFactory) -> None:
    a, b = modules("a", "b")
    server = worker(a, "rospy", "/work")
    steady = worker(a, "roscpp", "/steady")
    client = caller(b, "rospy", "/work")
    assert calls(client, "echo 0 10 1 once")["same"] == 1
    began = time.monotonic()
    done = calls(client, "die 0 10 1 once")
    assert done["ok"] == 0
    assert "in the middle of the call" in str(done["errors"])
    assert time.monotonic() - began < 20.0, "long before the call's time-out of 60 s"
    server.wait()
    wait_services(b.ros, "/work", there=False)
    assert "unavailable" in str(calls(client, "echo 0 10 1 once")["errors"])  # rospy's own words
    other = caller(b, "roscpp", "/steady")
    assert calls(other, "echo 0 10 3 persistent")["same"] == 3
    assert steady.returncode is None
    worker(a, "roscpp", "/work")  # another process, and another library
    wait_services(b.ros, "/work")
    assert calls(client, "echo 0 10 2 persistent")["same"] == 2


@pytest.mark.netns
def test_a_server_that_hangs_costs_one_deadline(modules: ModuleFactory) -> None:
    config = "[services]\ntimeout = 10\n[[service]]\nnames = ['/slow/**']\ntimeout = '1 s'\n"
    a, b = modules("a", "b", config=config)
    server = worker(a, "roscpp", "/slow/work")
    client = caller(b, "rospy", "/slow/work")
    assert calls(client, "echo 0 10 1 persistent")["same"] == 1
    server.send(signal.SIGSTOP)
    began = time.monotonic()
    done = calls(client, "echo 0 10 2 persistent")
    assert done["ok"] == 0
    assert "within 1 s" in str(done["errors"])
    assert time.monotonic() - began < 8.0
    server.send(signal.SIGCONT)
    assert calls(client, "echo 0 10 2 once")["same"] == 2


@pytest.mark.netns
def test_a_lost_link_fails_calls_and_its_return_restores_services(modules: ModuleFactory) -> None:
    a, b = modules("a", "b")
    server = worker(a, "rospy", "/work", quiet=False)
    client = caller(b, "rospy", "/work")
    assert calls(client, "echo 0 10 1 once")["same"] == 1
    a.host.outage(1.2)
    b.agent.process.wait_for("link down: a was silent")
    b.agent.wait_peer(a.name)
    wait_services(b.ros, "/work")
    assert calls(client, "echo 0 10 2 once")["same"] == 2
    client.tell("sleep 15 10 1 once")
    server.wait_event("call", where=lambda event: event["op"] == "sleep")
    began, since = time.monotonic(), client.mark_events()
    a.agent.kill()
    done = client.wait_event("done", since=since)
    assert done["ok"] == 0
    assert "/work" in str(done["errors"])
    assert time.monotonic() - began < 8.0
    wait_services(b.ros, "/work", there=False)


@pytest.mark.netns
def test_the_stock_tools_say_what_they_say_under_one_roscore(
    modules: ModuleFactory, shell: ShellFactory, lab: Lab
) -> None:
    alone = shell(lab.host("alone"))
    alone.roscore()
    a, b = modules("a", "b")
    answers: list[dict[str, str]] = []
    for here, there in ((alone, alone), (a.ros, b.ros)):
        here.start(PYTHON, "-c", _SWITCH).wait_for("up")
        wait_services(there, "/arm/switch")
        said = {
            word: there.tool("rosservice", word, "/arm/switch") for word in ("type", "info", "uri", "node", "args")
        }
        said["find"] = there.tool("rosservice", "find", "std_srvs/SetBool")
        said["call"] = there.tool("rosservice", "call", "/arm/switch", "true")
        said["list"] = "".join(
            line for line in there.tool("rosservice", "list").splitlines(True) if line.startswith("/arm")
        )
        with pytest.raises(CommandFailed) as caught:
            there.tool("rosservice", "call", "/arm/switch", "false")
        said["error"] = str(caught.value).partition("status")[2]
        with pytest.raises(CommandFailed) as caught:
            there.tool("rosservice", "call", "/arm/nothing")
        said["unknown"] = str(caught.value).partition("status")[2]
        answers.append(said)
    one, mesh = answers
    assert "it sticks" in mesh["error"]
    assert (one["node"].strip(), mesh["node"].strip()) == ("/switch", "/rmpa/a/switch")
    assert mesh["uri"].startswith("rosrpc://127.")
    for said in answers:
        said["info"] = said["info"].replace("/rmpa/a/switch", "/switch").replace(said["uri"].strip(), "URI")
        said["error"] = said["error"].replace("/rmpa/a/switch", "/switch")
        del said["node"], said["uri"]
    assert mesh == one


@pytest.mark.netns
def test_whose_service_is_shown_and_which_stay_home(modules: ModuleFactory) -> None:
    config = "[services]\ndeny = ['/secret']\n"
    a, b, c = modules("a", "b", "c", config=config)
    worker(a, "rospy", "/work")
    worker(a, "rospy", "/secret")
    wait_services(c.ros, "/work")
    second = worker(b, "rospy", "/work")  # b has its own now, and keeps it
    assert b.ros.tool("rosservice", "node", "/work").strip() == "/worker_work"
    client = caller(c, "rospy", "/work")
    assert c.ros.tool("rosservice", "node", "/work").strip() == "/rmpa/a/worker_work"  # the lower address
    a.agent.terminate()
    eventually(
        lambda: c.ros.tool("rosservice", "node", "/work").strip() == "/rmpa/b/worker_work", what="b's in its place"
    )
    assert calls(client, "echo 0 10 1 once")["same"] == 1
    second.interrupt()
    wait_services(c.ros, "/work", there=False)
    assert "/secret" not in c.ros.tool("rosservice", "list")
    assert "get_loggers" not in "".join(
        line for line in c.ros.tool("rosservice", "list").splitlines() if "worker" in line
    )


@pytest.mark.netns
def test_another_release_of_the_type_is_refused_on_both_sides(modules: ModuleFactory) -> None:
    a, b = modules("a", "b")
    worker(a, "rospy", "/work")
    client = caller(b, "rospy", "/work", other_release=True)
    done = calls(client, "echo 0 10 1 once")
    assert done["ok"] == 0
    assert "md5sum" in str(done["errors"])
    a.agent.process.wait_for(r"! b: .*/work.*md5sum")
    b.agent.process.wait_for(r"! .*/work.*md5sum")
    good = caller(b, "roscpp", "/work")
    assert calls(good, "echo 0 10 1 once")["same"] == 1


libraries = pytest.mark.parametrize("library", ["rospy", "roscpp"])
WORK = ServiceType("rmpa_test/Work", "string op\nfloat64 seconds\nuint8[] data\n---\nstring text\nuint8[] data\n")
DEADLINE = 40.0


async def work(request: Any) -> Any:
    """What the workers do."""
    if request.op == "fail":
        raise RmpaError("the gripper is jammed")
    if request.op == "sleep":
        await asyncio.sleep(request.seconds)
    response = WORK.response.make({"text": request.op})
    response.data = request.data
    return response


async def order(caller: Process, words: str) -> dict[str, Any]:
    """Make a caller call, and return the outcome."""
    since = caller.mark_events()
    caller.tell(words)
    return dict(await caller.expect_event("done", DEADLINE, since=since))


@pytest.mark.trap(24, 25, 26)
@libraries
async def test_real_clients_call_our_service(node: Node, ros: Ros, library: str) -> None:
    service = await node.advertise_service("/work", WORK, work, timeout=1.0)
    start = ros.rospy if library == "rospy" else ros.roscpp
    caller = start("caller", commands=True, wait=True)
    await caller.expect_event("there", DEADLINE)
    for how, size, count in (("once", 100, 50), ("persistent", 100, 50), ("once", 5_000_000, 2)):
        done = await order(caller, f"echo 0 {size} {count} {how}")
        assert (done["ok"], done["same"]) == (count, count), how
    done = await order(caller, "sleep 0.5 100 12 parallel")
    assert done["same"] == 12
    assert done["took"] < 3, "concurrent calls wait for each other"
    failed, late = await order(caller, "fail 0 100 1 persistent"), await order(caller, "sleep 9 100 1 once")
    assert failed["ok"] == late["ok"] == 0
    if library == "rospy":
        assert "the gripper is jammed" in failed["errors"][0]
        assert "service [/work] did not answer within 1 s" in late["errors"][0]
        other = ros.rospy("caller", "__name:=other", commands=True, other_release=True)
        await other.expect_event("up", DEADLINE)
        refused = await order(other, "echo 0 100 1 once")
        assert "wants service /work to have md5sum [ffff" in refused["errors"][0]
    await service.close()
    gone = await order(caller, "echo 0 100 1 once")
    assert gone["ok"] == 0
    assert len(service.endpoint._clients) == 0
