"""The embedded core with real nodes: twins, dead and stopped ones, probes, and connections that are read."""

from __future__ import annotations

import asyncio
from typing import Final

import pytest

from rmpa.ros.core.embedded import RosCore
from rmpa.ros.http.rpc import call, call_api
from rmpa.ros.node.ask import name_at, probe
from rmpa.ros.wire.slave_api import BusConnection, read_bus_info
from rmpa.ros.wire.tcpros import parse_service_uri
from tests.interop.conftest import ShellFactory
from tests.interop.ros import Ros
from tests.waiting import until

pytestmark = [pytest.mark.ros, pytest.mark.timeout(180)]
DEADLINE: Final = 90.0
LIBRARIES: Final = ("rospy", "roscpp")
KINDS: Final = pytest.mark.parametrize("kind", LIBRARIES)


@pytest.mark.trap(33)
@KINDS
async def test_a_twin_pushes_the_older_node_out_and_only_that(kind: str, shell: ShellFactory) -> None:
    core = RosCore(port=0)
    await core.start()
    ros = shell(port=core.port)
    ros_cpp_or_py = {"topic": "/chatter", "rate": 20, "count": 0}
    bystander = ros.node(kind, "talker", "__name:=bystander", **ros_cpp_or_py)
    older = ros.node(kind, "talker", "__name:=twin", **ros_cpp_or_py)
    await bystander.expect_event("up", DEADLINE)
    await until(lambda: {"/twin", "/bystander"} <= core.state().publishers.get("/chatter", {}).keys())
    first = core.state().nodes["/twin"]
    assert await name_at(first) == "/twin"
    newer = ros.node(kind, "talker", "__name:=twin", **ros_cpp_or_py)
    await until(lambda: older.returncode is not None)
    await until(lambda: core.state().publishers["/chatter"].get("/twin", first) != first)
    # What the older one unregistered on its way out was its own.
    assert core.state().publishers["/chatter"].keys() == {"/twin", "/bystander"}
    assert newer.returncode is None
    assert bystander.returncode is None
    await core.close()


@pytest.mark.trap(18, 31)
@KINDS
async def test_a_stopped_node_is_kept_and_gets_the_latest_update(kind: str, shell: ShellFactory) -> None:
    core = RosCore(port=0)
    await core.start()
    ros = shell(port=core.port)
    listener = ros.node(kind, "listener", "__name:=listener", topic="/chatter", count=3)
    await until(lambda: "/listener" in core.state().subscribers.get("/chatter", {}))
    await listener.expect_event("up", DEADLINE)
    listener.freeze()
    core.suspect("/listener")
    talker = ros.node("roscpp", "talker", "__name:=talker", topic="/chatter", rate=20, count=0)
    await until(lambda: "/talker" in core.state().publishers.get("/chatter", {}))
    # The notification waits for its answer, and is not sent again: it could be carried out behind a newer one.
    later = ros.node("roscpp", "talker", "__name:=later", topic="/chatter", rate=20, count=0)
    await until(lambda: "/later" in core.state().publishers.get("/chatter", {}))
    assert "/listener" in core.state().nodes
    told = core.counters["notify.sent"]
    listener.thaw()
    await until(lambda: core.counters["notify.sent"] >= told + 2)
    await listener.expect_event("done", DEADLINE)
    assert talker.returncode is later.returncode is None
    assert core.counters["notify.failed"] == 0
    await core.close()


libraries = pytest.mark.parametrize("library", LIBRARIES)
SERVICE: Final = "/talker/get_loggers"


async def publisher_at(core: RosCore) -> tuple[str, int]:
    """The address of the talker, as its subscribers are told it, which is also that of its services."""
    talker = (await call_api(core.uri, "lookupNode", "/test", "/talker")).value
    match (await call_api(str(talker), "requestTopic", "/test", "/chatter", [["TCPROS"]])).value:
        case ["TCPROS", str(host), int(port)]:
            uri = (await call_api(core.uri, "lookupService", "/test", SERVICE)).value
            assert parse_service_uri(str(uri)) == (host, port)
            return host, port
    raise AssertionError


@pytest.mark.trap(11)
@libraries
async def test_a_probe_leaves_no_trace_at_a_real_publisher(core: RosCore, ros: Ros, library: str) -> None:
    """The talker says ``connected`` once it counts a subscriber; the real one afterwards is served at once."""
    talker = ros.node(library, "talker", "__name:=talker", topic="/chatter", rate=100, wait=1)
    await talker.expect_event("up", DEADLINE)
    host, port = await publisher_at(core)
    for _ in range(20):
        assert await probe(host, port, SERVICE, timeout=DEADLINE, node="/talker") == ""
    at_once = [probe(host, port, SERVICE, timeout=DEADLINE, node="/talker") for _ in range(20)]
    assert set(await asyncio.gather(*at_once)) == {""}
    assert "connected" not in talker.output
    listener = ros.node(library, "listener", topic="/chatter", count=20)
    connected = await talker.expect_event("connected", DEADLINE)
    assert connected["subscribers"] == 1
    await listener.expect_event("done", DEADLINE)
    problem = await probe(host, port, SERVICE, timeout=DEADLINE, node="/camera")
    assert problem == "another node listens there: /talker"
    logs = "".join(path.read_text(errors="replace") for path in (ros.home / "log").rglob("*talker*"))
    for text in (talker.output, logs):
        for bad in ("WARN", "ERROR", "Traceback", "terminated"):
            assert bad not in text, text


@libraries
async def test_a_service_that_the_node_has_not(core: RosCore, ros: Ros, library: str) -> None:
    """rospy names itself in its refusal, roscpp does not: then any node could be there."""
    talker = ros.node(library, "talker", "__name:=talker", topic="/chatter")
    await talker.expect_event("up", DEADLINE)
    host, port = await publisher_at(core)
    problem = await probe(host, port, "/camera/get_loggers", timeout=DEADLINE, node="/talker")
    if library == "rospy":
        assert problem == ""
    else:
        assert "not the expected one: received a tcpros connection for a nonexistent service" in problem


async def test_a_probe_without_a_service_makes_roscpp_log_nothing(core: RosCore, ros: Ros) -> None:
    talker = ros.roscpp("talker", "__name:=talker", topic="/chatter")
    await talker.expect_event("up", DEADLINE)
    host, port = await publisher_at(core)
    for _ in range(5):
        assert await probe(host, port, "", timeout=DEADLINE) == ""
    assert await probe(host, port, SERVICE, timeout=DEADLINE, node="/talker") == "", "it has taken those before"
    assert "WARN" not in talker.output
    assert "ERROR" not in talker.output


TOPIC = "/chatter"
COUNT, SIZE = 50, 64


def uri_of(core: RosCore, node: str) -> str:
    state = core.state()
    return next(nodes[node] for nodes in (*state.publishers.values(), *state.subscribers.values()) if nodes.get(node))


async def links(core: RosCore, node: str) -> list[BusConnection]:
    """A node's connections of the topic."""
    return [one for one in read_bus_info(await call(uri_of(core, node), "getBusInfo", "/t")) if one.topic == TOPIC]


@pytest.mark.trap(41)
async def test_connections_of_real_nodes_are_read(core: RosCore, shell: ShellFactory) -> None:
    ros = shell(port=core.port)
    processes = [ros.node(library, "listener", name=f"hears_{library}", count=2 * COUNT) for library in LIBRARIES]
    for library in LIBRARIES:
        ros.node(library, "talker", name=f"says_{library}", count=COUNT, size=SIZE, rate=100, wait=2)
    for process in processes:
        await asyncio.to_thread(process.wait_event, "done", timeout=DEADLINE)
    for talker in LIBRARIES:
        sent = await links(core, f"/says_{talker}")
        assert {(one.other, one.inbound, one.connected) for one in sent} == {
            ("/hears_rospy", False, True),
            ("/hears_roscpp", False, True),
        }
        for listener in LIBRARIES:
            (end,) = (one for one in sent if one.other == f"/hears_{listener}")
            (start,) = (
                one for one in await links(core, f"/hears_{listener}") if one.other == uri_of(core, f"/says_{talker}")
            )
            assert (start.inbound, start.connected, start.remote) == (True, True, ("127.0.0.1", end.local_port))
            assert end.remote == ("127.0.0.1", start.local_port)
