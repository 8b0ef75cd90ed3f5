"""Direct transport as it is shown: the snapshot, ``rmpa topic info``, ``rmpa why``, figures, ``/diagnostics``."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Any

import pytest

from lab.bed.processes import eventually
from tests.interop.modules import Module, flows
from tests.interop.test_direct import AUTO, reachable

if TYPE_CHECKING:
    from tests.interop.conftest import ModuleFactory

pytestmark = [pytest.mark.ros, pytest.mark.netns, pytest.mark.timeout(120)]

TOPIC = "/chatter"


def route(module: Module, direction: str = "in", topic: str = TOPIC) -> dict[str, Any]:
    """The only route of a topic, as ``rmpa topic info --json`` has it; empty if there is none."""
    code, text = module.agent.rmpa("topic", "info", topic, "--json")
    assert code == 0, text
    routes = [one for one in json.loads(text)["mesh"]["routes"] if one["direction"] == direction]
    assert len(routes) < 2
    return routes[0] if routes else {}


def subscriber(module: Module, node: str, direction: str = "in") -> dict[str, Any]:
    return next((one for one in route(module, direction).get("subscribers", ()) if one["node"] == node), {})


def until_direct(module: Module, node: str) -> dict[str, Any]:
    eventually(lambda: subscriber(module, node).get("transport") == "direct", what=f"{node} is direct")
    return subscriber(module, node)


@pytest.mark.parametrize("client", ["roscpp", "rospy"])
def test_topic_info_says_the_transport_of_each_subscriber(modules: ModuleFactory, client: str) -> None:
    a, b = modules("a", "b", config=AUTO)
    reachable(a, b)
    a.ros.node(client, "talker", topic=TOPIC, rate=100, name="talker")
    flows(b.ros.node(client, "listener", topic=TOPIC, name="viewer"))
    found = until_direct(b, "/viewer")
    for m in (b, a):
        print(m.agent.rmpa("topic", "info", TOPIC)[1])
    print(found)
