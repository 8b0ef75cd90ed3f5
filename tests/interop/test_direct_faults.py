"""Direct transport: cables, hosts, agents and nodes fail; subscribers hang up, and are back when the rest is."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING, Final

import pytest

from lab.bed.processes import eventually
from tests.interop.modules import Module, flows
from tests.interop.transports import (
    AUTO,
    RELAY,
    connections,
    in_order,
    links,
    on_the_network,
    reload,
    shown,
    unbroken,
    wait_direct,
    wait_relayed,
)

if TYPE_CHECKING:
    from lab.bed.namespaces import Lab
    from lab.bed.processes import Process
    from tests.interop.conftest import ModuleFactory

pytestmark = [pytest.mark.ros, pytest.mark.netns, pytest.mark.timeout(120)]

CLIENTS: Final = [("roscpp", "rospy"), ("rospy", "roscpp")]
"""Subscriber and publisher. What each library does at a fault depends on its own side alone."""
RATE: Final = 100
UNPRIVILEGED: Final = ("setpriv", "--bounding-set=-net_admin,-sys_ptrace", "--inh-caps=-net_admin,-sys_ptrace", "--")
"""Runs an agent as root without the capabilities by which it could end connections of nodes."""
ORDINARY: Final = ("setpriv", "--bounding-set=-net_admin", "--inh-caps=-net_admin", "--")
"""Runs an agent that may end those of processes that it may touch, as one of the nodes' own user."""


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


@pytest.mark.parametrize("client", ["roscpp", "rospy"])
def test_a_host_that_was_switched_off_comes_back_with_new_nodes(
    modules: ModuleFactory, lab: Lab, client: str
) -> None:
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
        one.agent.restart()
        one.agent.wait_peer(other.name)
        in_order(flows(listener, 300))
        in_order(wait_direct(listener, talker))
        taken_over = shown(b, "/chatter", "/hearer")
        assert taken_over is not None
        assert (taken_over.transport, taken_over.condition) == ("direct", "")


@pytest.mark.parametrize("side", ["subscriber", "publisher"])
def test_direct_messages_end_with_their_module(modules: ModuleFactory, side: str) -> None:
    """An agent that ends in order takes what it has shown with it."""
    a, b, talker, listener = pair(modules, "roscpp", "rospy")
    (b if side == "subscriber" else a).agent.terminate()
    eventually(lambda: links(listener, talker) == 0, what="no connection")


@pytest.mark.parametrize("client", ["roscpp", "rospy"])
def test_a_host_with_another_address_is_direct_again(modules: ModuleFactory, client: str) -> None:
    a, b = modules("a", "b", config=AUTO)
    on_the_network(a, b)
    # The node's own name leads to an address that stays, as a machine's host name does on Debian.
    a.host.ip("address", "add", "10.78.0.1/32", "dev", "lo")
    a.ros.env["ROS_IP"] = "10.78.0.1"
    talker = a.ros.node(client, "talker", topic="/chatter", rate=RATE)
    listener = b.ros.node(client, "listener", topic="/chatter")
    wait_direct(listener, talker)
    interface = a.host.cables[0].interface
    a.host.ip("address", "del", f"{a.host.address}/24", "dev", interface)
    a.host.ip("address", "add", "10.77.0.77/24", "brd", "+", "dev", interface)
    in_order(wait_direct(listener, talker, 40.0))
    eventually(lambda: any(other.startswith("10.77.0.77:") for _, other in connections(listener)))


@pytest.mark.parametrize("prefix", [(), ORDINARY])
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
