"""The main job: a node publishes on one machine, a node receives on another, without a configured address."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

from tests.interop.modules import flows, whole

if TYPE_CHECKING:
    from lab.bed.processes import Event
    from tests.interop.conftest import ModuleFactory

pytestmark = [pytest.mark.ros, pytest.mark.netns, pytest.mark.timeout(120)]

CLIENTS = ["rospy", "roscpp"]


@pytest.mark.parametrize(("listener", "talker"), [("rospy", "roscpp"), ("roscpp", "rospy")])
def test_every_byte_arrives(modules: ModuleFactory, talker: str, listener: str) -> None:
    a, b = modules("a", "b")
    heard = b.ros.node(listener, "listener", topic="/chatter", count=200)
    a.ros.node(talker, "talker", topic="/chatter", rate=200, count=200, size=3000, wait=1)
    whole(heard.wait_event("done"), 200)


@pytest.mark.parametrize("client", CLIENTS)
def test_both_directions_at_once(modules: ModuleFactory, client: str) -> None:
    a, b = modules("a", "b")
    hears = [m.ros.node(client, "listener", topic=t, count=100) for m, t in ((a, "/to_a"), (b, "/to_b"))]
    a.ros.node(client, "talker", topic="/to_b", rate=100, count=100, wait=1)
    b.ros.node(client, "talker", topic="/to_a", rate=100, count=100, wait=1)
    for heard in hears:
        whole(heard.wait_event("done"), 100)


@pytest.mark.trap(37)
def test_a_topic_that_is_published_everywhere_does_not_loop(modules: ModuleFactory) -> None:
    everyone = modules("a", "b", "c")
    hears = [module.ros.roscpp("listener", topic="/shared") for module in everyone]
    for source, module in enumerate(everyone, start=1):
        module.ros.roscpp("talker", topic="/shared", rate=100, source=source)
    for heard in hears:
        report = heard.wait_event("report", where=lambda event: min(_counts(event, "123")) >= 100)
        assert (report["bad"], report["gaps"], report["doubled"]) == (0, 0, 0)


@pytest.mark.parametrize("client", CLIENTS)
def test_echo_node_answers_across(modules: ModuleFactory, client: str) -> None:
    a, b = modules("a", "b")
    b.ros.node(client, "echo", topic="/ask", reply="/answer", nodelay=True).wait_event("up")
    heard = a.ros.node(client, "listener", topic="/answer")
    a.ros.node(client, "talker", topic="/ask", rate=100)
    assert flows(heard, 50)["bad"] == 0


@pytest.mark.trap(10)
def test_two_latched_sources_both_reach_a_late_listener_once(modules: ModuleFactory) -> None:
    a, b, c = modules("a", "b", "c")
    for source, module in enumerate((a, b), start=1):
        module.ros.rospy("talker", topic="/map", count=1, latch=True, source=source).wait_event("done")
    c.wait_topic("/map")
    for client in CLIENTS:
        heard = c.ros.node(client, "listener", topic="/map", each=True)
        report = heard.wait_event("report", where=lambda event: event["count"] == 2)
        whole(report, 2)
        assert set(report["sources"]) == {"1", "2"}  # type: ignore[call-overload]  # a dict, from JSON


def test_a_listener_that_comes_back_is_served_again(modules: ModuleFactory) -> None:
    a, b = modules("a", "b")
    a.ros.roscpp("talker", topic="/chatter", rate=100)
    for _ in range(2):
        heard = b.ros.rospy("listener", topic="/chatter")
        assert flows(heard)["bad"] == 0
        heard.interrupt()


def test_stock_tools_see_the_remote_topic_as_their_own(modules: ModuleFactory) -> None:
    a, b = modules("a", "b")
    a.ros.roscpp("talker", "__name:=speaker", topic="/chatter", rate=50)
    b.wait_topic("/chatter")
    assert b.ros.tool("rostopic", "type", "/chatter").strip() == "std_msgs/UInt8MultiArray"
    info = b.ros.tool("rostopic", "info", "/chatter")
    assert "Publishers:" in info
    assert "speaker" in info
    assert "layout:" in b.ros.tool("rostopic", "echo", "-n1", "/chatter")
    rate = b.ros.start("rostopic", "hz", "/chatter")
    assert float(rate.wait_for(r"average rate: ([\d.]+)").group(1)) > 5.0
    rate.interrupt()
    assert "/chatter" in b.ros.tool("rostopic", "list", "-p")


@pytest.mark.trap(36)
def test_what_is_home_stays_home(modules: ModuleFactory) -> None:
    a, b = modules("a", "b")
    a.ros.roscpp("talker", "__name:=speaker", topic="/chatter", rate=10)
    a.ros.rospy("talker", topic="/clock", rate=10, type="String")
    a.wait_topic("/clock")
    b.wait_topic("/chatter")
    assert not {"/clock"} & b.topics()
    assert "speaker" not in b.ros.tool("rostopic", "info", "/rosout")


def test_agents_need_no_route_and_no_name_service(modules: ModuleFactory) -> None:
    a, b = modules("a", "b")
    assert "default" not in a.host.ip("route")
    heard = b.ros.roscpp("listener", topic="/chatter", count=10)
    a.ros.roscpp("talker", topic="/chatter", rate=100, count=10, wait=1)
    whole(heard.wait_event("done"), 10)


def _counts(report: Event, sources: str) -> list[int]:
    """Messages by source, in the order of ``sources``."""
    rows = report["sources"]
    assert isinstance(rows, dict)
    return [int(rows.get(source, {"count": 0})["count"]) for source in sources]
