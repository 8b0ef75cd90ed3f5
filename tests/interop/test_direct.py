"""Direct transport: which subscribers are direct, what both ends show of it, and hostile peers."""

from __future__ import annotations

import json
import sys
from typing import Any, Final

import pytest

from lab.bed.namespaces import Lab
from lab.bed.processes import Process, eventually
from tests.interop.conftest import AgentFactory, ModuleFactory, ShellFactory
from tests.interop.modules import Module, flows
from tests.interop.ros import NODES, lacks
from tests.interop.transports import (
    AUTO,
    conditions,
    direct_topics,
    heard,
    in_order,
    links,
    on_the_network,
    reload,
    steady,
    unbroken,
    wait_condition,
    wait_direct,
    wait_direct_topics,
    wait_relayed,
)

pytestmark = [pytest.mark.ros, pytest.mark.netns, pytest.mark.timeout(240)]
TERMS_HERE: Final = """
[[contract]]
topics = ["/relayed_here"]
transport = "relay"
[[contract]]
topics = ["/reliable"]
reliability = "reliable"
[[contract]]
topics = ["/kept"]
durability = "transient_local"
depth = 5
[[contract]]
topics = ["/limited"]
max_rate = 100000.0  # a busy machine hands on two within a millisecond, which 1000 would drop
[[peer]]
name = "a"
remap_in = { "/in_there" = "/in_here" }
"""
TERMS_THERE: Final = """
[[contract]]
topics = ["/relayed_there"]
transport = "relay"
[[contract]]
topics = ["/urgent"]
priority = "high"
[[contract]]
topics = ["/watched"]
deadline = 5.0
[[contract]]
topics = ["/fresh"]
lifespan = 5.0
[[peer]]
name = "b"
remap_out = { "/out_there" = "/out_here" }
"""
RELAYS: Final = "[relay]\nenabled = true\n"
BY_TERMS: Final = {
    "/relayed_here": "transport",
    "/relayed_there": "transport",
    **dict.fromkeys(("/reliable", "/kept", "/limited", "/urgent", "/watched", "/fresh"), "contract"),
}
FREE: Final = ("/free", "/free_too")


@pytest.mark.long
def test_what_needs_the_agents_is_relayed_until_its_rules_change(modules: ModuleFactory) -> None:
    """Terms of a contract at either end, and another name at either end; the rest is direct all the time."""
    a, b = modules("a", "b", config=AUTO)
    on_the_network(a, b)
    reload(a, AUTO + TERMS_THERE)
    reload(b, AUTO + TERMS_HERE)
    there = (*BY_TERMS, *FREE, "/in_there", "/out_there")
    here = (*BY_TERMS, *FREE, "/in_here", "/out_here")
    a.ros.roscpp("many_talker", topics=",".join(there), rate=50)
    names = ("ears", "rospy_ears")
    ears = [
        b.ros.node(client, "many_listener", topics=",".join((*here, "/in_there", "/out_there")), name=name)
        for client, name in zip(("roscpp", "rospy"), names, strict=True)
    ]
    for listener, name in zip(ears, names, strict=True):
        heard(listener, here)
        wait_direct_topics(b, f"/{name}", a, FREE)
        steady(listener, here)
    shown = {topic: condition for topic, condition in conditions(b).items() if topic in here}
    assert shown == BY_TERMS | dict.fromkeys(("/in_here", "/out_here"), "name") | dict.fromkeys(FREE, "")
    before = [heard(listener, FREE) for listener in ears]
    reload(a, AUTO)
    reload(b, AUTO)
    for listener, name, rows in zip(ears, names, before, strict=True):
        wait_direct_topics(b, f"/{name}", a, there)
        after = steady(listener, there)
        assert [after[topic]["gaps"] for topic in FREE] == [rows[topic]["gaps"] for topic in FREE]


def test_nodes_that_are_bound_to_loopback_are_relayed(modules: ModuleFactory) -> None:
    """ROS_IP=127.0.0.1 binds a publisher's sockets; a subscriber's node dials nothing else then."""
    a, b = modules("a", "b", config=AUTO)
    for client in ("roscpp", "rospy"):
        a.ros.node(client, "many_talker", topics=f"/bound_{client}", rate=50)
    on_the_network(a)
    for client in ("roscpp", "rospy"):
        a.ros.node(client, "many_talker", topics=f"/free_{client}", rate=50)
    topics = [f"/{how}_{client}" for how in ("bound", "free") for client in ("roscpp", "rospy")]
    bound = [
        b.ros.node(client, "many_listener", topics=",".join(topics), name=f"bound_{client}")
        for client in ("roscpp", "rospy")
    ]
    on_the_network(b)
    free = [
        b.ros.node(client, "many_listener", topics=",".join(topics), name=f"free_{client}")
        for client in ("roscpp", "rospy")
    ]
    for listener in (*free, *bound):
        for report in heard(listener, topics, 50).values():
            in_order(report)
    for client in ("roscpp", "rospy"):
        wait_direct_topics(b, f"/free_{client}", a, ("/free_roscpp", "/free_rospy"))
        assert direct_topics(b, f"/bound_{client}", a) == set()
    assert {conditions(b)[f"/bound_{client}"] for client in ("roscpp", "rospy")} <= {"listening", "subscriber"}
    assert {conditions(b)[f"/free_{client}"] for client in ("roscpp", "rospy")} == {"subscriber"}


@pytest.mark.long
def test_a_firewall_between_the_nodes_makes_them_fall_back(modules: ModuleFactory) -> None:
    """The agents' ports pass, those of nodes do not: from now on, and for who comes later; until it is open again."""
    a, b = modules("a", "b", config=AUTO)
    on_the_network(a, b)
    talker = a.ros.roscpp("talker", topic="/chatter", rate=100)
    listener = b.ros.rospy("listener", topic="/chatter")
    wait_direct(listener, talker)
    ports = ", ".join(_listening(talker))
    _nft(a, "add table ip filter", "add chain ip filter input { type filter hook input priority 0 ; }")
    _nft(a, f"add rule ip filter input iifname eth0 tcp dport {{ {ports} }} reject with tcp reset")
    in_order(wait_relayed(listener, talker))
    wait_condition(b, "/chatter", "reachable")
    _nft(a, "flush chain ip filter input", f"add rule ip filter input iifname eth0 tcp dport {{ {ports} }} drop")
    late = b.ros.roscpp("listener", topic="/chatter")
    flows(late)
    assert links(late, talker) == 0
    _nft(a, "flush chain ip filter input")
    for one in (late, listener):
        in_order(wait_direct(one, talker, 60.0))


def _nft(module: Module, *commands: str) -> None:
    for command in commands:
        module.ros.tool("nft", command)


def _listening(process: Process) -> list[str]:
    """The TCP ports at which a process listens."""
    import subprocess

    command = ["nsenter", "-t", str(process.pid), "-n", "ss", "-tlnpHO"]
    table = subprocess.run(command, capture_output=True, text=True, check=True, timeout=20).stdout
    return [line.split()[3].rpartition(":")[2] for line in table.splitlines() if f"pid={process.pid}," in line]


@pytest.mark.parametrize("client", ["roscpp", pytest.param("rospy", marks=pytest.mark.long)])
def test_one_caller_id_is_direct_once(modules: ModuleFactory, client: str) -> None:
    """Nodes of one name subscribe in two modules: the second is relayed until the first has gone."""
    a, b, c = modules("a", "b", "c", config=AUTO)
    on_the_network(a, b, c)
    talker = a.ros.rospy("talker", topic="/chatter", rate=100)
    first = b.ros.node(client, "listener", topic="/chatter", name="viewer")
    wait_direct(first, talker)
    other = c.ros.node(client, "listener", topic="/chatter", name="other")
    second = c.ros.node(client, "listener", topic="/chatter", name="viewer")
    flows(second)
    wait_direct(other, talker)
    assert (links(first, talker), links(second, talker)) == (1, 0)
    assert (conditions(b)["/chatter"], conditions(c)["/chatter"]) == ("", "caller_id")
    unbroken(flows(first, 50))
    first.terminate()
    in_order(wait_direct(second, talker))
    unbroken(flows(other))


def test_what_comes_by_a_relay_is_relayed(lab: Lab, agent: AgentFactory, shell: ShellFactory) -> None:
    """Modules a and c do not see each other; m is in both networks, and relays."""
    hosts = [lab.host("a", 0), lab.host("m", 0, 1), lab.host("c", 1)]
    a, m, c = (
        Module(host, agent(host, name=host.name, config=AUTO + (RELAYS if host.name == "m" else "")), shell(host))
        for host in hosts
    )
    on_the_network(a, m, c)
    m.agent.wait_peer("a")
    m.agent.wait_peer("c")
    talker = a.ros.roscpp("talker", topic="/chatter", rate=100)
    near, far = (module.ros.roscpp("listener", topic="/chatter") for module in (m, c))
    wait_direct(near, talker)
    unbroken(flows(far, 100))
    assert links(far, talker) == 0
    assert conditions(c)["/chatter"] == "own_source"


@pytest.mark.skipif(bool(lacks("actionlib")), reason=lacks("actionlib"))
def test_actions_work_because_their_topics_are_relayed(modules: ModuleFactory) -> None:
    a, b = modules("a", "b", config=AUTO)
    on_the_network(a, b)
    a.ros.node("rospy", "action_server", name="counter", action="/count").wait_event("up")
    asking = b.ros.node("roscpp", "action_client", name="asking", action="/count", commands=True)
    asking.wait_event("up")
    for line in ("server 15", "send 20"):
        asking.tell(line)
    assert asking.wait_event("server")["found"]
    assert asking.wait_event("done")["result"] == 20
    assert direct_topics(a, "/counter", b) | direct_topics(b, "/asking", a) == set()
    assert conditions(a)["/count/goal"] == conditions(b)["/count/status"] == "action"


def test_with_an_agent_of_an_earlier_release_all_is_relayed(
    lab: Lab, agent: AgentFactory, shell: ShellFactory
) -> None:
    earlier = {"a": (sys.executable, str(NODES / "earlier_release.py"))}
    a, b = (
        Module(host, agent(host, name=host.name, config=AUTO, prefix=earlier.get(host.name, ())), shell(host))
        for host in lab.hosts("a", "b")
    )
    a.agent.wait_peer("b")
    on_the_network(a, b)
    talker = a.ros.roscpp("talker", topic="/chatter", rate=100)
    listener = b.ros.rospy("listener", topic="/chatter")
    unbroken(flows(listener, 200))
    assert links(listener, talker) == 0
    assert conditions(b)["/chatter"] == "release"


def test_the_first_message_is_not_late(modules: ModuleFactory) -> None:
    """One node subscribes to a relayed and to a direct topic of one publisher, which counts the same on both."""
    a, b = modules("a", "b", config=f'{AUTO}\n[[contract]]\ntopics = ["/relayed"]\ntransport = "relay"\n')
    on_the_network(a, b)
    rate = 500
    talker = a.ros.roscpp("many_talker", topics="/relayed,/direct", rate=rate)
    b.wait_topic("/direct")
    first = []
    for _ in range(3):
        listener = b.ros.rospy("many_listener", topics="/direct,/relayed")
        reports = heard(listener, ("/relayed", "/direct"), 50)
        assert links(listener, talker) == 1
        first.append([reports[topic]["sources"]["1"]["first"] for topic in ("/direct", "/relayed")])  # type: ignore[index]
        unbroken(reports["/direct"])
        listener.terminate()
    assert min(direct - relayed for direct, relayed in first) <= rate * 0.1, first


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
