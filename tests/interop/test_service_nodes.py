"""Real rospy and roscpp clients and servers of services against ours, at the embedded core."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING, Any

import pytest

from rmpa.core.errors import PeerRefused, RmpaError
from rmpa.ros.core.embedded import RosCore
from rmpa.ros.environment import RosEnvironment
from rmpa.ros.node.node import Node
from rmpa.ros.node.service_client import ServiceFailed
from rmpa.ros.types.installed import ServiceType
from tests.interop.nodes.payload import Pattern

if TYPE_CHECKING:
    from collections.abc import AsyncIterator

    from lab.bed.processes import Process
    from tests.interop.conftest import ShellFactory
    from tests.interop.ros import Ros

pytestmark = pytest.mark.ros
libraries = pytest.mark.parametrize("library", ["rospy", "roscpp"])
WORK = ServiceType("rmpa_test/Work", "string op\nfloat64 seconds\nuint8[] data\n---\nstring text\nuint8[] data\n")
DEADLINE = 40.0


@pytest.fixture
async def core() -> AsyncIterator[RosCore]:
    made = RosCore("127.0.0.1", 0)
    await made.start()
    yield made
    await made.close()


@pytest.fixture
async def node(core: RosCore) -> AsyncIterator[Node]:
    async with Node("ours", master_uri=core.uri, environment=RosEnvironment()) as made:
        yield made


@pytest.fixture
async def ros(core: RosCore, shell: ShellFactory) -> AsyncIterator[Ros]:
    made = shell(port=core.port)
    yield made
    await asyncio.to_thread(made.close)  # while the core answers them: rospy waits for it


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


@libraries
async def test_our_client_calls_a_real_service(node: Node, ros: Ros, library: str) -> None:
    worker = ros.node(library, "worker", "__name:=worker")
    await worker.expect_event("up", DEADLINE)
    data = list(Pattern(300).payload(1, 1))
    response = await node.call_service("/work", WORK, ["echo", 0, data], DEADLINE)
    assert response.text == "echo"
    assert response.data.tolist() == data
    async with asyncio.timeout(DEADLINE):
        client = await node.connect_service("/work", WORK)
        assert client.connection.caller_id == "/worker"
        assert client.connection.description == WORK.describe()
        for _ in range(50):
            assert (await client.call({"op": "echo", "data": data})).data.tolist() == data
        large = Pattern(5_000_000).payload(1, 2)
        request = WORK.request.serialize(WORK.request.make(["echo", 0, []]))[:-4]
        ok, body = await client.connection.call(request + len(large).to_bytes(4, "little") + large)
        assert ok
        assert body.endswith(large)
        with pytest.raises(PeerRefused, match="gripper is jammed" if library == "rospy" else "service /work refused"):
            await client.call(["fail", 0, []])
        if library == "roscpp":
            # rospy closes behind an error, though the connection is persistent.
            assert not client.closed
        client.close()
    sleeping = await node.connect_service("/work", WORK)
    with pytest.raises(ServiceFailed, match=r"no answer within 0\.3 s"):
        await sleeping.call(["sleep", 2, []], timeout=0.3)
    with pytest.raises(PeerRefused, match="md5sum"):
        await node.call_service("/work", "std_srvs/Trigger")
    with pytest.raises(ServiceFailed, match=r"died.* in the middle of the call"):
        await node.call_service("/work", WORK, ["die", 0, []], DEADLINE)
    with pytest.raises(RmpaError, match="no server of service /work answers"):
        await node.call_service("/work", WORK, ["echo", 0, []], DEADLINE)


async def test_the_stock_tools_show_and_call_our_service(node: Node, ros: Ros) -> None:
    def set_bool(request: Any) -> dict[str, object]:
        return {"success": not request.data, "message": "ü <ok>"}

    async def tool(*words: str) -> str:
        return (await asyncio.to_thread(ros.tool, *words)).strip()

    await node.advertise_service("/arm/enable", "std_srvs/SetBool", set_bool)
    uri = node.slave.service_uri
    assert "/arm/enable" in (await tool("rosservice", "list")).splitlines()
    assert await tool("rosservice", "type", "/arm/enable") == "std_srvs/SetBool"
    assert await tool("rosservice", "find", "std_srvs/SetBool") == "/arm/enable"
    assert await tool("rosservice", "args", "/arm/enable") == "data"
    assert await tool("rosservice", "uri", "/arm/enable") == uri
    info = (await tool("rosservice", "info", "/arm/enable")).splitlines()
    assert info == ["Node: /ours", f"URI: {uri}", "Type: std_srvs/SetBool", "Args: data"]
    answer = await tool("rosservice", "call", "/arm/enable", "data: false")
    assert answer.splitlines()[0] == "success: True"
    assert " * /arm/enable" in (await tool("rosnode", "info", "/ours")).splitlines()
