"""What a publisher says to each new subscriber alone reaches every one, in any module: connect callbacks of ROS."""

from __future__ import annotations

from typing import TYPE_CHECKING, cast

import pytest

if TYPE_CHECKING:
    from lab.bed.processes import Event, Process
    from tests.interop.conftest import ModuleFactory

pytestmark = [pytest.mark.ros, pytest.mark.netns, pytest.mark.timeout(180)]

TOPIC = "/map"
BIG = 1_000_000
DIRECT = f'[[contract]]\ntopics = ["{TOPIC}"]\ntransport = "direct"\n'


def greeted(listener: Process, beyond: int = 0) -> dict[str, dict[str, int]]:
    """What a listener has heard of each source, once it has the greeting, and more than ``beyond`` messages."""

    def enough(event: Event) -> bool:
        sources = cast("dict[str, dict[str, int]]", event["sources"])
        return "2" in sources and sources.get("1", {}).get("last", 0) > beyond

    return cast("dict[str, dict[str, int]]", listener.wait_event("report", where=enough)["sources"])


@pytest.mark.parametrize(
    ("kind", "size", "greeting", "latch", "config"),
    [
        pytest.param("rospy", 64, BIG, False, "", id="map-rospy"),
        pytest.param("roscpp", 64, BIG, False, "", id="map-roscpp"),
        pytest.param("rospy", BIG, 64, False, "", id="images-rospy"),
        pytest.param("roscpp", BIG, 64, False, "", id="images-roscpp"),
        pytest.param("roscpp", 64, 1000, True, "", id="latched"),  # rospy latches what it says to one subscriber, too
        pytest.param("rospy", 64, 1000, False, DIRECT, id="direct-rospy"),
        pytest.param("roscpp", 64, 1000, False, DIRECT, id="direct-roscpp"),
    ],
)
def test_each_subscriber_anywhere_is_a_new_connection(
    modules: ModuleFactory, kind: str, size: int, greeting: int, latch: bool, config: str
) -> None:
    a, b, c = modules("a", "b", "c", config=config)
    options = {"latch": True} if latch else {}
    rate = 5 if size == BIG else 20
    a.ros.node(kind, "greeter", topic=TOPIC, size=size, greeting=greeting, rate=rate, **options).wait_event("up")
    listeners = []
    last = 0
    for module, ear in ((b, "rospy"), (b, "roscpp"), (c, "roscpp"), (c, "rospy"), (b, "roscpp"), (a, "roscpp")):
        listeners.append(module.ros.node(ear, "listener", topic=TOPIC))
        last = greeted(listeners[-1], last)["1"]["last"]
    for listener in listeners:
        sources = greeted(listener, last + 5 * rate)
        assert sources["2"]["count"] == 1, listener.name
        assert (sources["1"]["gaps"], sources["1"]["doubled"]) == (0, 0), listener.name
