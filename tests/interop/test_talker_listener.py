"""The main job: a node publishes on one machine, a node receives on another, without a configured address."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

from tests.interop.modules import flows

if TYPE_CHECKING:
    from lab.bed.processes import Event
    from tests.interop.conftest import ModuleFactory

pytestmark = [pytest.mark.ros, pytest.mark.netns, pytest.mark.timeout(120)]

CLIENTS = ["rospy", "roscpp"]


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


def _counts(report: Event, sources: str) -> list[int]:
    """Messages by source, in the order of ``sources``."""
    rows = report["sources"]
    assert isinstance(rows, dict)
    return [int(rows.get(source, {"count": 0})["count"]) for source in sources]
