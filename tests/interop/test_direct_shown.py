"""Direct transport as it is shown: the snapshot, ``rmpa topic info``, ``rmpa why``, figures, ``/diagnostics``."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Any, Final

import pytest

from lab.bed.processes import eventually
from tests.interop.modules import Module, flows
from tests.interop.test_direct_faults import UNPRIVILEGED
from tests.interop.transports import AUTO, on_the_network, reload, unbroken, wait_direct

if TYPE_CHECKING:
    from tests.interop.conftest import ModuleFactory

pytestmark = [pytest.mark.ros, pytest.mark.netns, pytest.mark.timeout(150)]

TOPIC: Final = "/chatter"
RATE: Final = 100


def mesh(module: Module) -> dict[str, Any]:
    """What ``rmpa topic info --json`` says of the topic's routes."""
    code, text = module.agent.rmpa("topic", "info", TOPIC, "--json")
    assert code == 0, text
    found: dict[str, Any] = json.loads(text)["mesh"]
    return found


def route(module: Module, direction: str = "in") -> dict[str, Any]:
    """The only route of the topic in a direction; empty if there is none."""
    routes = [one for one in mesh(module)["routes"] if one["direction"] == direction]
    assert len(routes) < 2, routes
    return routes[0] if routes else {}


def subscriber(module: Module, node: str, direction: str = "in") -> dict[str, Any]:
    """What a route says of one subscriber; empty if it does not name it."""
    return next((one for one in route(module, direction).get("subscribers", ()) if one["node"] == node), {})


def stages(module: Module) -> dict[str, tuple[str, str]]:
    """The stages of ``rmpa why``, which must say that the topic flows."""
    code, text = module.agent.rmpa("why", TOPIC, "--json")
    (found,) = json.loads(text)
    assert (code, found["flows"]) == (0, True), text
    return {stage["name"]: (stage["verdict"], stage["text"]) for stage in found["stages"]}


def near(value: float | None, wanted: float) -> bool:
    return value is not None and 0.5 * wanted < value < 1.5 * wanted


def test_both_ends_say_which_subscriber_is_direct_and_why_another_is_not(modules: ModuleFactory) -> None:
    a, b = modules("a", "b", config=AUTO)
    on_the_network(a, b)
    talker = a.ros.roscpp("talker", topic=TOPIC, rate=RATE, name="talker")
    wait_direct(b.ros.rospy("listener", topic=TOPIC, name="viewer"), talker)
    here = subscriber(b, "/viewer")
    assert (here["transport"], here["state"], here["condition"]) == ("direct", "direct", "")
    address, _, port = here["endpoint"].partition(":")
    assert address == a.host.address
    there = subscriber(a, "/viewer", "out")
    assert (there["state"], there["endpoint"]) == ("granted", port)
    assert (route(b)["transport"], route(a, "out")["transport"]) == ("direct", "direct")

    # In words, and in the walk along the path, from both sides.
    code, text = b.agent.rmpa("topic", "info", TOPIC)
    assert code == 0
    assert f" * from a: /talker direct\n     transport  direct to {here['endpoint']} for /viewer (" in text
    assert "not measured: the nodes are connected directly" in text
    code, text = a.agent.rmpa("topic", "info", TOPIC)
    assert f"transport  direct for /viewer, to port {port} of this machine" in text
    assert "Direct:       1 of the subscribers here to its nodes" in b.agent.rmpa("peer", "info", "a")[1]
    assert ", 1 of its subscribers to nodes here" in a.agent.rmpa("peer", "info", "b")[1]
    for module in (a, b):
        said = stages(module)
        assert said["transport"] == ("ok", f"direct to {here['endpoint']} for /viewer")
        assert said["connection"][0] == "ok"
        assert said["connection"][1].startswith(f"/viewer is connected to {here['endpoint']}; not measured")
        assert "route" not in said, "no message passes the agents"

    # In the publisher's graph the subscriber stands as its proxy: a stealth relay, which asks the master, sees it.
    assert "/rmpa/b/viewer" in a.ros.tool("rostopic", "info", TOPIC).partition("Subscribers:")[2]
    assert "/viewer of peer b, by its proxy /rmpa/b/viewer" in a.agent.rmpa("topic", "info", TOPIC)[1]

    # Another subscriber connects within its machine only, so it is relayed: both transports at once.
    b.ros.env["ROS_IP"] = "127.0.0.1"
    flows(b.ros.roscpp("listener", topic=TOPIC, name="bound"))
    bound = subscriber(b, "/bound")
    assert (bound["transport"], bound["state"], bound["condition"]) == ("relay", "relayed", "subscriber")
    both = route(b)
    assert (both["transport"], both["condition"]) == ("both", "subscriber")
    assert "127.0.0.1" in both["condition_text"]
    said = stages(b)
    assert f"relayed for /bound: {bound['text']}" in said["transport"][1]
    assert said["route"][0] == "ok"


@pytest.mark.parametrize(
    ("config", "condition", "text"),
    [
        ("", "transport", 'transport  relayed: the setting transport = "relay" of this module asks for it'),
        (
            f'{AUTO}[[contract]]\ntopics = ["{TOPIC}"]\ndeadline = 0.2\n',
            "contract",
            "relayed for /viewer (",
        ),
        ('[bridge]\ntransport = "direct"\n', "listening", "relayed for /viewer ("),
    ],
    ids=["relayed by rule", "a deadline", "a publisher on loopback"],
)
def test_a_relayed_topic_names_the_condition(modules: ModuleFactory, config: str, condition: str, text: str) -> None:
    a, b = modules("a", "b", config=config)
    on_the_network(b)  # not the publisher's module: it listens on loopback
    a.ros.roscpp("talker", topic=TOPIC, rate=RATE, name="talker")
    flows(b.ros.roscpp("listener", topic=TOPIC, name="viewer"))
    eventually(lambda: route(b)["condition"] == condition, what=f"the condition {condition}")
    found = route(b)
    assert found["transport"] == "relay"
    said = b.agent.rmpa("topic", "info", TOPIC)[1]
    assert text in said
    assert found["condition_text"] in said
    level, why = stages(b)["transport"]
    assert found["condition_text"] in why
    # Only where the contract says "direct" does relaying it deserve a warning.
    assert level == ("warn" if condition == "listening" else "ok")
    checks = json.loads(b.agent.rmpa("doctor", "--json")[1])
    warned = [one for one in checks if one["check"] == "transport" and one["subject"] == TOPIC]
    assert bool(warned) is (condition == "listening"), warned


def test_tools_that_measure_are_relayed_and_leave_the_user_direct(modules: ModuleFactory) -> None:
    a, b = modules("a", "b", fresh=True, config='[bridge]\ntransport = "direct"\n')
    on_the_network(a, b)
    talker = a.ros.rospy("talker", topic=TOPIC, rate=RATE, name="talker")
    viewer = b.ros.roscpp("listener", topic=TOPIC, name="viewer")
    wait_direct(viewer, talker)
    since = subscriber(b, "/viewer")["since_ago"]
    code, text = b.agent.rmpa("topic", "delay", TOPIC, "-n", str(2 * RATE), "--json")
    assert code == 0, text
    (measured,) = json.loads(text.splitlines()[-1])["routes"]
    assert measured["latency"]["error"] > 0
    assert measured["latency"]["count"] > RATE
    assert near(measured["rate"], RATE), measured
    code, text = b.agent.rmpa("topic", "echo", TOPIC, "-n", "3", "--json")
    assert (code, len(text.splitlines())) == (0, 3), text
    after = subscriber(b, "/viewer")
    assert (after["transport"], after["interruptions"]) == ("direct", 0)
    assert after["since_ago"] > since, "it was not moved meanwhile"
    unbroken(flows(viewer))
    assert "direct.relayed" not in b.agent.snapshot().counters, "a tool is relayed on purpose: no warning"


def test_a_subscriber_that_cannot_be_moved_is_warned_of(modules: ModuleFactory) -> None:
    a, b = modules("a", "b", config=AUTO, prefix=UNPRIVILEGED)
    on_the_network(a, b)
    talker = a.ros.roscpp("talker", topic=TOPIC, rate=RATE, name="talker")
    viewer = b.ros.rospy("listener", topic=TOPIC, name="viewer")
    wait_direct(viewer, talker)
    reload(b, f'{AUTO}[[contract]]\ntopics = ["{TOPIC}"]\ntransport = "relay"\n')
    b.agent.process.wait_for("/viewer stays connected .*see rmpa doctor")
    found = subscriber(b, "/viewer")
    assert (found["transport"], found["state"], found["condition"]) == ("direct", "relayed", "transport")
    level, text = stages(b)["transport"]
    assert level == "warn"
    assert f"has to be relayed: {found['text']}" in text
    assert text in [one["text"].removeprefix("of a: ") for one in json.loads(b.agent.rmpa("doctor", "--json")[1])]


def test_a_latched_topic_is_told_to_a_tool_as_well(modules: ModuleFactory) -> None:
    a, b = modules("a", "b", config=AUTO)
    on_the_network(a, b)
    talker = a.ros.roscpp("talker", topic=TOPIC, rate=10, count=1, latch=True, name="talker")
    talker.wait_event("up")
    viewer = b.ros.roscpp("listener", topic=TOPIC, name="viewer")
    flows(viewer, 1)
    eventually(lambda: subscriber(b, "/viewer").get("transport") == "direct", what="/viewer is direct")
    code, text = b.agent.rmpa("topic", "echo", TOPIC, "-n", "1", "--json")
    assert (code, len(text.splitlines())) == (0, 1), text
    assert subscriber(b, "/viewer")["transport"] == "direct"
    assert [one["count"] for one in viewer.events("report")][-1] == 1


def test_why_sees_that_messages_go_on_without_the_peers_agent(modules: ModuleFactory) -> None:
    a, b = modules("a", "b", config=AUTO)
    on_the_network(a, b)
    talker = a.ros.roscpp("talker", topic=TOPIC, rate=RATE, name="talker")
    viewer = b.ros.roscpp("listener", topic=TOPIC, name="viewer")
    wait_direct(viewer, talker)
    a.agent.kill()
    b.agent.wait_no_peer("a")
    flows(viewer)
    said = stages(b)
    assert said["link"][0] == "warn"
    assert "without its agent only what is connected directly goes on" in said["link"][1]
    assert said["connection"][0] == "ok"
