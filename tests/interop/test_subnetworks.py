"""Two networks: joined by a router that forwards no multicast, or by modules that have a cable in each.

The commands of docs/guides/networks.md are among them.
"""

from __future__ import annotations

import time
from functools import partial
from typing import TYPE_CHECKING

import pytest

from lab.bed.processes import eventually
from rmpa.observe.control_client import ControlClient
from tests.interop.modules import Module, flows
from tests.interop.ros import lacks

if TYPE_CHECKING:
    from lab.bed.namespaces import Lab
    from tests.interop.conftest import AgentFactory, ShellFactory

pytestmark = [pytest.mark.ros, pytest.mark.netns, pytest.mark.timeout(120)]


def full_mesh(*modules: Module) -> None:
    """Wait until each of these is linked with all others."""
    for module in modules:
        names = {other.name for other in modules if other is not module}
        eventually(partial(all_linked, module, names), what=f"{module.name} linked with {names}", every=0.2)


def all_linked(module: Module, names: set[str]) -> bool:
    """Whether a module has a link to each of these."""
    return names <= linked(module)


def linked(module: Module) -> set[str]:
    """The peers that a module has live links to; asked by its socket, for many looks are needed."""
    with ControlClient(module.agent.sockets()[0]) as client:
        return {peer.name for peer in client.snapshot().peers if peer.state == "linked"}


def test_one_seed_and_gossip_join_two_networks_behind_a_router(
    lab: Lab, agent: AgentFactory, shell: ShellFactory
) -> None:
    """Only ``a`` knows one address of the other side; when that one is gone, new agents are still found by all."""
    router = lab.router(0, 1)
    hosts = {name: lab.host(name, network) for name, network in (("a", 0), ("b", 0), ("c", 1), ("d", 1))}
    for host in hosts.values():
        lab.route(host, router)
    flags = {"a": ["--seed", f"{hosts['c'].address}:45000"], "c": ["--port", "45000"]}
    a, b, c, d = (
        Module(host, agent(host, name=name, flags=flags.get(name, [])), shell(host)) for name, host in hosts.items()
    )
    full_mesh(a, b, c, d)
    heard = d.ros.roscpp("listener", topic="/chatter")
    b.ros.roscpp("talker", "__name:=talker", topic="/chatter", rate=100)
    flows(heard)
    assert "/rmpa/b/talker" in d.ros.tool("rosnode", "list")

    c.agent.kill()
    b.agent.restart()
    full_mesh(a, b, d)
    steady = d.ros.roscpp("listener", "__name:=steady", topic="/steady")
    a.ros.roscpp("talker", "__name:=steady_talker", topic="/steady", rate=100)
    flows(steady)
    c.agent.restart()
    full_mesh(a, b, c, d)
    report = flows(steady)
    assert (report["gaps"], report["doubled"]) == (0, 0)


def test_a_peer_is_reached_by_its_remaining_cable(lab: Lab, agent: AgentFactory, shell: ShellFactory) -> None:
    """Two modules share two networks; each cable in turn is out, and reliable topics lose nothing."""
    config = '[[contract]]\ntopics = ["/chatter"]\nreliability = "reliable"\ndepth = 2000\n'
    hosts = [lab.host(name, 0, 1) for name in ("a", "b")]
    a, b = (Module(host, agent(host, name=host.name, config=config), shell(host)) for host in hosts)
    full_mesh(a, b)
    heard = b.ros.roscpp("listener", topic="/chatter")
    a.ros.roscpp("talker", topic="/chatter", rate=100)
    flows(heard)
    for cable in (0, 1, 0):
        for module in (a, b):
            module.host.cut(cable)
        began = time.monotonic()
        report = flows(heard, 50)
        assert time.monotonic() - began < 10.0
        assert (report["bad"], report["gaps"], report["doubled"]) == (0, 0, 0)
        for module in (a, b):
            module.host.restore(cable)
    assert "/chatter" in b.topics()


def test_a_module_is_found_by_its_second_cable(lab: Lab, agent: AgentFactory, shell: ShellFactory) -> None:
    """The GUID of each is of a network that the other cannot reach."""
    hosts = [lab.host("a", 2, 0), lab.host("b", 3, 0)]
    a, b = (Module(host, agent(host, name=host.name), shell(host)) for host in hosts)
    full_mesh(a, b)
    a.ros.roscpp("talker", topic="/chatter", rate=100)
    flows(b.ros.roscpp("listener", topic="/chatter"))


def test_gossip_across_a_router_says_where_peers_are_heard(
    lab: Lab, agent: AgentFactory, shell: ShellFactory
) -> None:
    """The first cables of two modules, whose addresses are in their GUIDs, lead to networks of their own."""
    router = lab.router(0, 1)
    hosts = [lab.host("a", 2, 0), lab.host("b", 1), lab.host("c", 3, 1)]
    for host in hosts:
        lab.route(host, router)
    flags = {"a": ["--seed", f"{hosts[1].address}:45000"], "b": ["--port", "45000"]}
    full_mesh(*(Module(h, agent(h, name=h.name, flags=flags.get(h.name, [])), shell(h)) for h in hosts))


RELAY = "[relay]\nenabled = true\n"


def test_relays_join_two_networks_without_a_router(lab: Lab, agent: AgentFactory, shell: ShellFactory) -> None:
    """Two relays stand between two networks; one of them is chosen, and the other takes over when it is gone."""
    hosts = [lab.host("a", 0), lab.host("b", 1), lab.host("r", 0, 1), lab.host("s", 0, 1)]
    a, b, r, s = (
        Module(host, agent(host, name=host.name, config=RELAY if host.name in "rs" else ""), shell(host))
        for host in hosts
    )
    for relay in (r, s):
        full_mesh(a, relay)
        full_mesh(b, relay)
    heard = {kind: b.ros.node(kind, "listener", f"__name:={kind}", topic="/chatter") for kind in ("rospy", "roscpp")}
    a.ros.roscpp("talker", "__name:=talker", topic="/chatter", rate=100, latch=True)
    b.ros.roscpp("talker", "__name:=back", topic="/back", rate=100)
    for listener in heard.values():
        report = flows(listener)
        assert (report["bad"], report["doubled"]) == (0, 0), "one relay alone passes it on"

    # Each sees the other as if it were linked, under the other's own name; and nothing comes back.
    assert "/rmpa/a/talker" in b.ros.tool("rosnode", "list").split()
    assert "/rmpa/b/back" in a.ros.tool("rosnode", "list").split()
    assert not [node for node in a.ros.tool("rosnode", "list").split() if node.startswith("/rmpa/a/")]
    for relay in (r, s):
        nodes = relay.ros.tool("rosnode", "list").split()
        assert len(nodes) == len(set(nodes))
        assert {"/rmpa/a/talker", "/rmpa/b/back"} <= set(nodes)
        assert not [node for node in nodes if node.startswith(("/rmpa/r/", "/rmpa/s/"))]
    info = b.agent.peers()["a"]
    assert (info["state"], info["via"] in {"r", "s"}) == ("relayed", True)
    chosen, other = (r, s) if info["via"] == "r" else (s, r)

    chosen.agent.kill()
    for listener in heard.values():
        report = flows(listener)
        assert (report["bad"], report["doubled"]) == (0, 0)
    eventually(lambda: b.agent.peers()["a"]["via"] == other.name, what="the other relay")
    other.agent.terminate()
    eventually(lambda: "a" not in b.agent.peers(), what="no way to a")
    b.wait_no_topic("/rmpa/a/talker", 1.0)
    assert "/rmpa/a/talker" not in b.ros.tool("rosnode", "list")


def test_services_and_actions_go_by_a_relay_too(lab: Lab, agent: AgentFactory, shell: ShellFactory) -> None:
    hosts = [lab.host("a", 0), lab.host("b", 1), lab.host("r", 0, 1)]
    a, b, r = (Module(h, agent(h, name=h.name, config=RELAY if h.name == "r" else ""), shell(h)) for h in hosts)
    full_mesh(a, r)
    full_mesh(b, r)
    a.ros.rospy("worker", service="/work", name="worker").wait_event("up")
    caller = b.ros.rospy("caller", service="/work", wait=True, commands=True)
    caller.wait_event("there")
    for line, ok, errors in (
        ("echo 0 200000 3 once", 3, []),
        ("echo 0 64 20 persistent", 20, []),
        ("fail 0 0 1 once", 0, ["the gripper is jammed"]),
    ):
        since = caller.mark_events()
        caller.tell(line)
        done = caller.wait_event("done", since=since)
        assert (done["ok"], len(done["errors"])) == (ok, len(errors)), done  # type: ignore[arg-type]
        assert all(text in str(done["errors"]) for text in errors), done
    assert b.ros.tool("rosservice", "node", "/work").strip() == "/rmpa/a/worker"
    assert "/work" in r.ros.tool("rosservice", "list").split()

    if not lacks("actionlib"):
        server = a.ros.rospy("action_server", name="server")
        client = b.ros.roscpp("action_client", name="client", commands=True)
        client.tell("server 30")
        assert client.wait_event("server", 40.0)["found"] is True
        since = client.mark_events()
        client.tell("send 20")
        done = client.wait_event("done", since=since)
        assert (done["state"], done["result"]) == ("SUCCEEDED", 20)
        server.kill()


def test_a_relay_is_not_needed_where_there_is_a_way(lab: Lab, agent: AgentFactory, shell: ShellFactory) -> None:
    """All on one network: each source appears once, by its own link."""
    hosts = lab.hosts("a", "b", "r")
    a, b, r = (Module(h, agent(h, name=h.name, config=RELAY if h.name == "r" else ""), shell(h)) for h in hosts)
    full_mesh(a, b, r)
    heard = b.ros.roscpp("listener", topic="/chatter")
    a.ros.roscpp("talker", topic="/chatter", rate=100)
    report = flows(heard, 50)
    assert (report["bad"], report["gaps"], report["doubled"]) == (0, 0, 0)
    assert b.ros.tool("rostopic", "info", "/chatter").count("/talker") == 1
    assert b.agent.peers()["a"]["state"] == "linked"
