"""What real nodes send at real rates and sizes arrives complete. Completeness, never time, is asserted."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

from tests.interop.modules import whole

if TYPE_CHECKING:
    from tests.interop.conftest import ModuleFactory

pytestmark = [pytest.mark.ros, pytest.mark.netns, pytest.mark.timeout(120)]

MEGABYTE = 1024 * 1024


@pytest.mark.parametrize(
    ("talker", "listener", "rate", "size"),
    [
        ("roscpp", "roscpp", 1000, 64),
        ("rospy", "rospy", 1000, 64),
        ("roscpp", "rospy", 100, 3000),
        ("rospy", "roscpp", 10, MEGABYTE),
    ],
)
def test_rates_from_10_hz_to_1_khz(modules: ModuleFactory, talker: str, listener: str, rate: int, size: int) -> None:
    a, b = modules("a", "b")
    assert "default" not in a.host.ip("route")  # neither a route nor a name service is needed
    count = 3 * rate
    heard = b.ros.node(listener, "listener", topic="/chatter", count=count)
    a.ros.node(talker, "talker", topic="/chatter", rate=rate, count=count, size=size, wait=1)
    whole(heard.wait_event("done"), count)


def test_sizes_around_every_buffer(modules: ModuleFactory) -> None:
    a, b = modules("a", "b")
    for size in (20, 21, 65515, 65516, 65517, 65536, 5 * MEGABYTE):
        heard = b.ros.roscpp("listener", topic=f"/any{size}", count=10)
        rate = 20 if size < MEGABYTE else 3  # best effort: a busy machine drops what comes quicker
        a.ros.roscpp("talker", topic=f"/any{size}", rate=rate, count=10, size=size, wait=1)
        report = heard.wait_event("done")
        whole(report, 10)
        assert report["bytes"] == 10 * size


def test_large_and_small_topics_side_by_side(modules: ModuleFactory) -> None:
    a, b = modules("a", "b")
    image = b.ros.roscpp("listener", "__name:=hear_image", topic="/image", count=30)
    command = b.ros.roscpp("listener", "__name:=hear_command", topic="/command", count=500)
    a.ros.roscpp("talker", "__name:=say_image", topic="/image", rate=10, count=30, size=MEGABYTE, wait=1)
    a.ros.roscpp("talker", "__name:=say_command", topic="/command", rate=200, count=500, wait=1)
    whole(command.wait_event("done", 40.0), 500)
    whole(image.wait_event("done", 40.0), 30)


def test_a_slow_wire_drops_whole_messages_and_breaks_none(modules: ModuleFactory) -> None:
    a, b = modules("a", "b")
    a.host.shape("20mbit")
    heard = b.ros.roscpp("listener", topic="/image")
    a.ros.roscpp("talker", topic="/image", rate=30, size=MEGABYTE, wait=1)
    report = heard.wait_event("report", 40.0, where=lambda event: int(str(event["count"])) >= 10)
    assert (report["bad"], report["doubled"]) == (0, 0)
    a.agent.wait_peer(b.name)
