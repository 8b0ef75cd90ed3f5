"""A probe of real rospy and roscpp nodes: it finds the right one, and leaves no trace."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING, Final

import pytest

from rmpa.ros.http.rpc import call_api
from rmpa.ros.node.service_client import probe
from rmpa.ros.wire.tcpros import parse_service_uri
from tests.interop.test_service_nodes import core, ros

if TYPE_CHECKING:
    from rmpa.ros.core.embedded import RosCore
    from tests.interop.ros import Ros

__all__ = ["core", "ros"]

pytestmark = pytest.mark.ros
libraries = pytest.mark.parametrize("library", ["rospy", "roscpp"])
DEADLINE: Final = 40.0
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


async def test_a_node_that_is_gone(core: RosCore, ros: Ros) -> None:
    talker = ros.rospy("talker", "__name:=talker", topic="/chatter")
    await talker.expect_event("up", DEADLINE)
    host, port = await publisher_at(core)
    talker.kill()
    assert await probe(host, port, SERVICE, timeout=DEADLINE, node="/talker") == "connection refused"
