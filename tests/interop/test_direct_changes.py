"""Direct transport: rules, nodes, machines and cables that change."""

from __future__ import annotations

import json
import time
from typing import Final

import pytest

from lab.bed.namespaces import Host, Lab
from lab.bed.processes import Event, Process, eventually
from tests.interop.conftest import AgentFactory, ModuleFactory, ShellFactory
from tests.interop.modules import Module, flows
from tests.interop.test_direct import stages
from tests.interop.transports import (
    AUTO,
    RELAY,
    connections,
    heard,
    in_order,
    links,
    on_the_network,
    reload,
    shown,
    unbroken,
    wait_direct,
    wait_relayed,
)

pytestmark = [pytest.mark.ros, pytest.mark.netns, pytest.mark.timeout(120)]
CLIENTS: Final = [("roscpp", "rospy"), pytest.param("rospy", "roscpp", marks=pytest.mark.long)]
RATE: Final = 100
# Messages that may pass while a subscriber is moved: a tenth of a second in general, much more on a busy machine.
MOVE_GAP: Final = RATE * 2


def gaps(report: Event) -> int:
    """Messages that are missing in a listener's report."""
    return int(str(report["gaps"]))


@pytest.mark.parametrize(("subscriber", "publisher"), CLIENTS)
def test_a_changed_contract_moves_a_subscriber_and_back(
    modules: ModuleFactory, subscriber: str, publisher: str
) -> None:
    a, b = modules("a", "b", config=AUTO)
    on_the_network(a, b)
    talker = a.ros.node(publisher, "talker", topic="/chatter", rate=RATE)
    listener = b.ros.node(subscriber, "listener", topic="/chatter")
    wait_direct(listener, talker)
    for changed, turn in ((b, 1), (a, 2)):
        reload(changed, AUTO + RELAY)
        wait_relayed(listener, talker)
        reload(changed, AUTO)
        report = wait_direct(listener, talker)
        in_order(report)
        assert gaps(report) <= 2 * turn * MOVE_GAP


@pytest.mark.long
def test_two_subscribers_of_one_publisher_move_each_for_itself(modules: ModuleFactory) -> None:
    """A local node with the caller id of a remote subscriber takes its place at the publisher (trap 12)."""
    a, b = modules("a", "b", config=AUTO)
    on_the_network(a, b)
    talker = a.ros.rospy("talker", topic="/chatter", rate=RATE)
    viewer, other = (b.ros.rospy("listener", topic="/chatter", name=name) for name in ("viewer", "other"))
    for listener in (viewer, other):
        wait_direct(listener, talker)
    local = a.ros.rospy("listener", topic="/chatter", name="viewer")
    flows(local)
    in_order(wait_relayed(viewer, talker))
    flows(local)
    local.kill()
    report = wait_direct(viewer, talker)
    in_order(report)
    unbroken(flows(other))


@pytest.mark.parametrize(("subscriber", "publisher"), CLIENTS)
def test_a_latched_message_comes_once_more_only_when_its_topic_becomes_relayed(
    modules: ModuleFactory, subscriber: str, publisher: str
) -> None:
    a, b = modules("a", "b", config=AUTO)
    on_the_network(a, b)
    talker = a.ros.node(publisher, "talker", topic="/chatter", count=1, latch=True)
    talker.wait_event("done")
    beat = a.ros.roscpp("talker", topic="/beat", rate=50)
    listener = b.ros.node(subscriber, "listener", topic="/chatter", each=True)
    heard = b.ros.roscpp("listener", topic="/beat")
    listener.wait_event("report")
    eventually(lambda: links(listener, talker) == 1, what="a direct connection")
    wait_direct(heard, beat)
    reload(b, AUTO + RELAY)
    eventually(lambda: links(listener, talker) == 0, what="no direct connection")
    flows(heard, 50)
    reload(b, AUTO)
    flows(heard, 50)
    _once(listener, doubled=1)
    # A new subscriber is direct, and gets it once as well; so does one that comes while it is relayed.
    late = b.ros.node(subscriber, "listener", topic="/chatter", each=True)
    late.wait_event("report")
    eventually(lambda: links(late, talker) == 1, what="a direct connection")
    reload(a, AUTO + RELAY)
    eventually(lambda: links(late, talker) == 0, what="no direct connection")
    later = b.ros.node(subscriber, "listener", topic="/chatter", each=True)
    later.wait_event("report")
    flows(heard, 50)
    for one, doubled in ((listener, 1), (late, 1), (later, 0)):
        _once(one, doubled=doubled)


def _once(listener: Process, *, doubled: int) -> None:
    """It got the message once, and at most so many times more."""
    report = listener.events("report")[-1]
    again = int(str(report["doubled"]))
    assert (report["count"], report["bad"]) == (1 + again, 0), report
    assert again <= doubled, report


@pytest.mark.parametrize(("subscriber", "publisher"), CLIENTS)
def test_a_restarted_publisher_is_direct_again(modules: ModuleFactory, subscriber: str, publisher: str) -> None:
    """It comes back on another port: after kill -9, and after a proper end."""
    a, b = modules("a", "b", config=AUTO)
    on_the_network(a, b)
    talker = a.ros.node(publisher, "talker", topic="/chatter", rate=RATE, name="speaker")
    listener = b.ros.node(subscriber, "listener", topic="/chatter")
    wait_direct(listener, talker)
    for source, end in ((2, talker.kill), (3, None)):
        if end is None:
            talker.terminate()
        else:
            end()
        talker = a.ros.node(publisher, "talker", topic="/chatter", rate=RATE, name="speaker", source=source)
        wait_direct(listener, talker)
        report = listener.wait_event("report", where=lambda event, n=str(source): n in event["sources"])  # type: ignore[misc]
        in_order(report)
    settled = gaps(flows(listener))
    assert gaps(flows(listener, 50)) == settled


@pytest.mark.parametrize("client", ["roscpp", pytest.param("rospy", marks=pytest.mark.long)])
def test_an_ended_subscriber_leaves_nothing_behind(modules: ModuleFactory, client: str) -> None:
    a, b = modules("a", "b", config=AUTO)
    on_the_network(a, b)
    talker = a.ros.node(client, "talker", topic="/chatter", rate=RATE)
    steady = b.ros.roscpp("listener", topic="/chatter")
    wait_direct(steady, talker)
    for end in ("kill", "terminate"):
        # One that comes again under its name finds no refusal of the one before.
        listener = b.ros.node(client, "listener", topic="/chatter", name="again")
        wait_direct(listener, talker)
        getattr(listener, end)()
    unbroken(flows(steady, 50))


# Runs an agent as root without the capabilities by which it could end connections of nodes.
UNPRIVILEGED: Final = ("setpriv", "--bounding-set=-net_admin,-sys_ptrace", "--inh-caps=-net_admin,-sys_ptrace", "--")
# Runs an agent that may end those of processes that it may touch, as one of the nodes' own user.
ORDINARY: Final = ("setpriv", "--bounding-set=-net_admin", "--inh-caps=-net_admin", "--")


def pair(modules: ModuleFactory, subscriber: str, publisher: str) -> tuple[Module, Module, Process, Process]:
    """Modules a and b, a talker at a, and a listener at b that is connected to it."""
    a, b = modules("a", "b", config=AUTO)
    on_the_network(a, b)
    talker = a.ros.node(publisher, "talker", topic="/chatter", rate=RATE, name="speaker")
    listener = b.ros.node(subscriber, "listener", topic="/chatter", name="hearer")
    wait_direct(listener, talker)
    return a, b, talker, listener


@pytest.mark.parametrize(("subscriber", "publisher"), CLIENTS)
def test_a_cable_that_is_out_for_long_ends_both_ends_connections(
    modules: ModuleFactory, subscriber: str, publisher: str
) -> None:
    a, b, talker, listener = pair(modules, subscriber, publisher)
    b.host.dropout(0.3)  # one for a moment costs nothing
    unbroken(flows(listener, 100))
    assert links(listener, talker) == 1
    b.host.cut()
    eventually(lambda: not _abroad(listener, a) and not _abroad(talker, b), 6.0, what="both ends have hung up")
    time.sleep(1.0)  # nothing may come back before the cable is in
    b.host.restore()
    b.agent.wait_peer("a")
    in_order(wait_direct(listener, talker, 6.0))


@pytest.mark.long
def test_a_host_that_was_switched_off_comes_back_with_new_nodes(modules: ModuleFactory, lab: Lab) -> None:
    client = "rospy"
    a, b, talker, listener = pair(modules, client, client)
    lab.power_off(a.host)
    eventually(lambda: not _abroad(listener, a), 6.0, what="the listener has hung up")
    lab.power_on(a.host)
    a.agent.restart()
    talker = a.ros.node(client, "talker", topic="/chatter", rate=RATE, name="speaker", source=2)
    in_order(wait_direct(listener, talker))
    # The other side.
    lab.power_off(b.host)
    eventually(lambda: not _abroad(talker, b), 6.0, what="the talker has hung up")
    lab.power_on(b.host)
    b.agent.restart()
    in_order(wait_direct(b.ros.node(client, "listener", topic="/chatter", name="hearer"), talker))


@pytest.mark.parametrize(("subscriber", "publisher"), CLIENTS)
def test_direct_messages_go_on_while_an_agent_is_dead(
    modules: ModuleFactory, subscriber: str, publisher: str
) -> None:
    a, b, talker, listener = pair(modules, subscriber, publisher)
    flows(listener, 200)  # a new run knows the nodes that were registered for more than a second
    for one, other in ((b, a), (a, b)):
        settled = flows(listener)
        one.agent.kill()
        unbroken(flows(listener, 50), settled)
        other.agent.wait_no_peer(one.name)
        unbroken(flows(listener, 50), settled)
        if one is a:
            said = stages(b)
            assert said["link"][0] == "warn"
            assert "without its agent only what is connected directly goes on" in said["link"][1]
            assert said["connection"][0] == "ok"
        one.agent.restart()
        one.agent.wait_peer(other.name)
        in_order(flows(listener, 300))
        in_order(wait_direct(listener, talker))
        taken_over = shown(b, "/chatter", "/hearer")
        assert taken_over is not None
        assert (taken_over.transport, taken_over.condition) == ("direct", "")


def test_direct_messages_end_with_their_module(modules: ModuleFactory) -> None:
    """An agent that ends in order takes what it has shown with it."""
    a, _, talker, listener = pair(modules, "roscpp", "rospy")
    a.agent.terminate()
    eventually(lambda: links(listener, talker) == 0, what="no connection")


@pytest.mark.long
def test_a_host_with_another_address_is_direct_again(modules: ModuleFactory) -> None:
    a, b = modules("a", "b", config=AUTO)
    on_the_network(a, b)
    # The node's own name leads to an address that stays, as a machine's host name does on Debian.
    a.host.ip("address", "add", "10.78.0.1/32", "dev", "lo")
    a.ros.env["ROS_IP"] = "10.78.0.1"
    talker = a.ros.roscpp("talker", topic="/chatter", rate=RATE)
    listener = b.ros.rospy("listener", topic="/chatter")
    wait_direct(listener, talker)
    interface = a.host.cables[0].interface
    a.host.ip("address", "del", f"{a.host.address}/24", "dev", interface)
    a.host.ip("address", "add", "10.77.0.77/24", "brd", "+", "dev", interface)
    in_order(wait_direct(listener, talker, 40.0))
    eventually(lambda: any(other.startswith("10.77.0.77:") for _, other in connections(listener)))


@pytest.mark.parametrize("prefix", [(), pytest.param(ORDINARY, marks=pytest.mark.long)])
def test_a_publisher_without_a_queue_is_freed_from_a_vanished_subscriber(
    modules: ModuleFactory, lab: Lab, prefix: tuple[str, ...]
) -> None:
    """rospy without ``queue_size`` sends to each subscriber in turn, and blocks where one takes nothing more."""
    a, b = modules("a", "b", config=AUTO, prefix=prefix)
    on_the_network(a, b)
    talker = a.ros.rospy("talker", topic="/chatter", rate=50, size=100_000, queue=-1)
    abroad = b.ros.roscpp("listener", topic="/chatter")
    wait_direct(abroad, talker)
    at_home = a.ros.roscpp("listener", topic="/chatter")
    flows(at_home, 50)
    lab.power_off(b.host)
    eventually(lambda: not _abroad(talker, b), 6.0, what="the connection to the vanished host has ended")
    unbroken(flows(at_home, 50, 6.0))


@pytest.mark.long
def test_without_the_right_to_end_connections_only_rospy_subscribers_stay(modules: ModuleFactory) -> None:
    """roscpp moves by the list of publishers; rospy stays direct, which the agent says, and hears nothing twice."""
    a, b = modules("a", "b", config=AUTO, prefix=UNPRIVILEGED)
    on_the_network(a, b)
    talker = a.ros.roscpp("talker", topic="/chatter", rate=RATE)
    cpp, py = (b.ros.node(client, "listener", topic="/chatter", name=client) for client in ("roscpp", "rospy"))
    for listener in (cpp, py):
        wait_direct(listener, talker)
    for changed in (b, a):
        reload(changed, AUTO + RELAY)
        in_order(wait_relayed(cpp, talker))
        b.agent.process.wait_for("/rospy stays connected .*see rmpa doctor")
        assert links(py, talker) == 1
        eventually(lambda: (row := shown(b, "/chatter", "/rospy")) and row.state == "relayed", what="has to move")
        unbroken(flows(py, 100))
        if changed is b:
            level, text = stages(b)["transport"]
            assert level == "warn"
            assert "for /rospy, has to be relayed: " in text
            advice = [one["text"] for one in json.loads(b.agent.rmpa("doctor", "--json")[1])]
            assert any("has to be relayed: " in one for one in advice), advice
        reload(changed, AUTO)
        in_order(wait_direct(cpp, talker))
        unbroken(flows(py, 100))
        assert links(py, talker) == 1
        free = shown(b, "/chatter", "/rospy")
        assert free is not None
        assert (free.transport, free.state) == ("direct", "direct")
    # The cable is out for longer than a lease: neither hears anything twice when it is back.
    b.host.cut()
    b.agent.wait_no_peer("a")
    a.agent.wait_no_peer("b")
    b.host.restore()
    in_order(wait_direct(cpp, talker))
    eventually(lambda: links(py, talker) == 1, what="one connection")
    in_order(flows(py, 300))
    in_order(flows(cpp))
    eventually(
        lambda: (row := shown(b, "/chatter", "/rospy")) and (row.transport, row.state) == ("direct", "direct"),
        what="shown as direct",
    )
    # A contract that forbids it leaves the connection, and does not add a second path.
    reload(b, AUTO + RELAY)
    in_order(wait_relayed(cpp, talker))
    in_order(flows(py, 200))


def test_a_node_that_was_direct_under_a_killed_agent_obeys_the_new_one(modules: ModuleFactory) -> None:
    """The agent is killed, and started again with a contract that says relay: no subscriber keeps two paths."""
    a, b = modules("a", "b", config=AUTO)
    on_the_network(a, b)
    talker = a.ros.roscpp("talker", topic="/chatter", rate=RATE)
    listeners = [b.ros.node(client, "listener", topic="/chatter") for client in ("roscpp", "rospy")]
    for listener in listeners:
        wait_direct(listener, talker)
    flows(listeners[0], 200)  # the new run knows the nodes that were registered for more than a second
    b.agent.kill()
    b.agent.config = AUTO + RELAY
    b.agent.restart()
    b.agent.wait_peer("a")
    for listener in listeners:
        in_order(wait_relayed(listener, talker))
        in_order(flows(listener, 200))


def _abroad(process: Process, other: Module) -> bool:
    """Whether a node has a connection to an address of another module's host."""
    return any(end.startswith(f"{other.host.address}:") for _, end in connections(process))


EXTERNAL: Final = ("--core", "external")


def two_on_one(host: Host, agent: AgentFactory, shell: ShellFactory) -> tuple[Module, Module]:
    """Two linked modules on one host, with their cores at two ports."""
    first, second = (
        Module(host, agent(host, name=name, core_port=port, config=AUTO), shell(host, port))
        for name, port in (("a", 11311), ("b", 11312))
    )
    first.agent.wait_peer("b")
    second.agent.wait_peer("a")
    return first, second


@pytest.mark.parametrize(
    ("client", "bound"), [("roscpp", True), pytest.param("rospy", False, marks=pytest.mark.long)]
)
def test_modules_of_one_machine_are_direct_over_loopback(
    lab: Lab, agent: AgentFactory, shell: ShellFactory, client: str, *, bound: bool
) -> None:
    a, b = two_on_one(lab.host("both", 0), agent, shell)
    if not bound:
        on_the_network(a, b)
    talker = a.ros.node(client, "talker", topic="/chatter", rate=100)
    # A publisher of the module itself, which the subscriber hears all the time.
    b.ros.node(client, "talker", topic="/chatter", rate=100, source=2)
    listener = b.ros.node(client, "listener", topic="/chatter")
    wait_direct(listener, talker)
    assert {
        own.rpartition(":")[0] for own, other in connections(talker) if (other, own) in connections(listener)
    } == {"127.0.0.1"}
    listener.wait_event("report", where=lambda event: set(event["sources"]) == {"1", "2"})  # type: ignore[call-overload]
    home = str(flows(listener)["sources"])
    reload(b, AUTO + RELAY)
    in_order(wait_relayed(listener, talker))
    reload(b, AUTO)
    report = wait_direct(listener, talker)
    in_order(report)
    assert report["sources"]["2"]["gaps"] == 0, home  # type: ignore[index]
    a.agent.kill()
    unbroken_since = flows(listener, 200)
    in_order(unbroken_since)


@pytest.mark.long
def test_nodes_of_a_real_roscore_are_direct_if_they_are_on_its_machine(
    lab: Lab, agent: AgentFactory, shell: ShellFactory
) -> None:
    """A roscore may have nodes on other machines: the agent cannot see their sockets, so they are relayed."""
    first, second, far = lab.hosts("a", "b", "far")
    ros = shell(first)
    ros.env["ROS_IP"] = first.address  # roscore listens for other machines too
    ros.roscore()
    a = Module(first, agent(first, name="a", flags=EXTERNAL, config=AUTO), ros)
    b = Module(second, agent(second, name="b", config=AUTO), shell(second))
    on_the_network(b)
    a.agent.wait_peer("b")
    elsewhere = shell(far)
    elsewhere.env.update(ROS_IP=far.address, ROS_MASTER_URI=f"http://{first.address}:11311/")
    near = a.ros.rospy("talker", topic="/near", rate=100)
    away = elsewhere.roscpp("talker", topic="/away", rate=100)
    near_heard, away_heard = (b.ros.roscpp("listener", topic=topic) for topic in ("/near", "/away"))
    wait_direct(near_heard, near)
    unbroken(flows(away_heard, 200))
    assert links(away_heard, away) == 0
    # The other way: a subscriber of that roscore.
    talker = b.ros.rospy("talker", topic="/back", rate=100)
    here = a.ros.rospy("listener", topic="/back")
    in_order(wait_direct(here, talker))


@pytest.mark.long
def test_two_hundred_topics_of_many_nodes_go_direct_at_once(modules: ModuleFactory) -> None:
    """Four publishers with 50 topics each, and two subscribers of all: 400 connections, and agents that answer."""
    a, b = modules("a", "b", config=AUTO, log_level="info")
    on_the_network(a, b)
    topics = [[f"/flood/n{node}/t{number}" for number in range(50)] for node in range(4)]
    every = [topic for some in topics for topic in some]
    talkers = [a.ros.roscpp("many_talker", topics=",".join(some), rate=2) for some in topics]
    b.wait_topic(every[-1], 60.0)
    listeners = [b.ros.roscpp("many_listener", topics=",".join(every)) for _ in range(2)]
    slowest = 0.0

    def all_direct() -> bool:
        nonlocal slowest
        begin = time.monotonic()
        code, _ = b.agent.rmpa("peer", "list", "--json")
        slowest = max(slowest, time.monotonic() - begin)
        assert code == 0
        return all(links(listener, talker) == 50 for listener in listeners for talker in talkers)

    eventually(all_direct, 60.0, what="400 connections", every=0.2)
    assert slowest < 10.0
    for listener in listeners:
        for report in heard(listener, every, 4).values():
            in_order(report)
