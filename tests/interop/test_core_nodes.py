"""Real rospy and roscpp nodes at our core: twins, deaths, reconnections."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING, Final

import pytest

from rmpa.ros.core.embedded import RosCore
from rmpa.ros.core.liveness import name_at

if TYPE_CHECKING:
    from collections.abc import Callable

    from tests.interop.conftest import ShellFactory

pytestmark = [pytest.mark.ros, pytest.mark.timeout(120)]

DEADLINE: Final = 30.0
KINDS: Final = pytest.mark.parametrize("kind", ["rospy", "roscpp"])


async def until(wanted: Callable[[], bool]) -> None:
    async with asyncio.timeout(DEADLINE):
        while not wanted():
            await asyncio.sleep(0.01)


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


@pytest.mark.trap(40)
@KINDS
async def test_a_killed_node_is_gone_at_a_hint(kind: str, shell: ShellFactory) -> None:
    core = RosCore(port=0)
    await core.start()
    ros = shell(port=core.port)
    victim = ros.node(kind, "talker", "__name:=victim", topic="/chatter", rate=20, count=0)
    await until(lambda: "/victim" in core.state().publishers.get("/chatter", {}))
    await asyncio.to_thread(victim.kill)
    core.suspect("/victim")
    await until(lambda: "/victim" not in core.state().nodes)
    assert "/chatter" not in core.state().publishers
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
