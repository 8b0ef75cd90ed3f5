"""Direct calls of services: unmodified clients connect to the server itself, and the agents only arrange it.

The command of docs/guides/services.md is among them.
"""

from __future__ import annotations

import json
import time

import pytest

from lab.bed.namespaces import Lab
from lab.bed.processes import Process, eventually
from tests.interop.conftest import AgentFactory, ModuleFactory, ShellFactory
from tests.interop.modules import Module
from tests.interop.ros import PYTHON
from tests.interop.services import caller, calls, worker
from tests.interop.transports import on_the_network, reload

pytestmark = [pytest.mark.ros, pytest.mark.netns, pytest.mark.timeout(120)]

AUTO = '[services]\ntransport = "auto"\n'
CLIENTS = ["rospy", "roscpp"]


def lookup(module: Module, caller_id: str, service: str = "/work") -> str:
    """What the module's master answers a node that looks up a service."""
    text = f"import rosgraph; print(rosgraph.Master({caller_id!r}).lookupService({service!r}))"
    with module.ros.start(PYTHON, "-c", text) as process:
        return process.wait_for(r"rosrpc://\S+").group()


def known(module: Module, service: str = "/work") -> dict[str, object]:
    """What the module's agent knows of a peer's service."""
    code, output = module.agent.rmpa("service", "info", service, "--json")
    if code:
        return {}
    [info] = [one for one in json.loads(output)["mesh"] if one["direction"] == "in"]
    return dict(info)


def wait_transport(module: Module, transport: str, condition: str = "", service: str = "/work") -> dict[str, object]:
    """Wait until a peer's service is called by this transport, for the sake of this condition."""

    def seen() -> dict[str, object] | None:
        info = known(module, service)
        return info if (info.get("transport"), info.get("condition")) == (transport, condition) else None

    return eventually(seen, what=f"{service} of {module.name} by {transport} {condition}") or {}


def wait_address(module: Module, *, other_than: object) -> None:
    """Wait until a service is called directly at another address."""

    def seen() -> bool:
        info = known(module)
        return info.get("transport") == "direct" and info["address"] != other_than

    eventually(seen, what=f"another address than {other_than}")


@pytest.mark.parametrize(
    ("client", "server"), [("rospy", "roscpp"), pytest.param("roscpp", "rospy", marks=pytest.mark.long)]
)
def test_calls_go_from_node_to_node(modules: ModuleFactory, server: str, client: str) -> None:
    a, b = modules("a", "b", config=AUTO)
    on_the_network(a, b)
    worker(a, server)
    wait_transport(b, "direct")
    called = caller(b, client)
    for how, count in (("once", 5), ("persistent", 20), ("parallel", 5)):
        done = calls(called, f"echo 0 1000 {count} {how}")
        assert (done["ok"], done["same"]) == (count, count), (how, done)
    done = calls(called, "fail 0 10 1 once")
    assert done["ok"] == 0
    if client == server == "rospy":
        assert "the gripper is jammed" in str(done["errors"])
    info = known(b)
    assert info["calls"] == 0, "no call went through the agents"
    assert int(str(info["lookups"])) >= 11


def test_the_graph_does_not_change(modules: ModuleFactory) -> None:
    a, b = modules("a", "b", config=AUTO)
    on_the_network(a, b)
    worker(a)
    own = a.ros.tool("rosservice", "uri", "/work").strip()
    wait_transport(b, "direct")
    client = caller(b, name="client")
    assert b.ros.tool("rosservice", "uri", "/work").startswith("rosrpc://127.")
    assert b.ros.tool("rosservice", "node", "/work").strip() == "/rmpa/a/worker_work"
    assert b.ros.tool("rosservice", "type", "/work").strip() == "rmpa_test/Work"
    assert lookup(b, "/client") == own, "a node of this module is told the server's own address"
    assert lookup(b, "/unknown").startswith("rosrpc://127."), "a tool that is no node is told the proxy's"
    code, output = b.agent.rmpa("why", "/work")
    assert code == 0
    assert f"direct: clients call the server itself, at {own}" in output
    assert "direct for b" in a.agent.rmpa("service", "info", "/work")[1]
    assert calls(client, "echo 0 10 2 once")["same"] == 2
    assert known(b)["calls"] == 0


def test_a_server_that_restarts_on_another_port_is_found_again(modules: ModuleFactory) -> None:
    a, b = modules("a", "b", config=AUTO)
    on_the_network(a, b)
    for kind in CLIENTS:
        server = worker(a, kind)
        first = wait_transport(b, "direct")["address"]
        client = caller(b, kind)
        assert calls(client, "echo 0 10 2 once")["same"] == 2
        server.kill()
        server.wait()
        server = worker(a, kind)  # at another port, before or after the core has missed the first one
        wait_address(b, other_than=first)
        assert calls(client, "echo 0 10 2 once")["same"] == 2
        assert calls(client, "echo 0 10 2 persistent")["same"] == 2
        assert known(b)["calls"] == 0
        server.interrupt()
        eventually(lambda: not known(b), what="the service has left")


@pytest.mark.parametrize("kind", ["roscpp", pytest.param("rospy", marks=pytest.mark.long)])
def test_a_call_under_way_fails_within_the_lease_when_the_cable_is_cut(modules: ModuleFactory, kind: str) -> None:
    a, b = modules("a", "b", config=AUTO)
    on_the_network(a, b)
    server = worker(a, kind)
    wait_transport(b, "direct")
    client = caller(b, kind)
    since = client.mark_events()
    client.tell("sleep 60 10 1 persistent")
    server.wait_event("call", where=lambda event: event["op"] == "sleep")
    a.host.cut()
    began = time.monotonic()
    done = client.wait_event("done", since=since)
    assert done["ok"] == 0
    assert time.monotonic() - began < 10.0, "the lease of 1 s, and what a shared machine adds; TCP takes minutes"
    eventually(lambda: "/work" not in b.ros.tool("rosservice", "list").split(), what="the service has left")
    a.host.restore()
    wait_transport(b, "direct")
    fresh = worker(a, kind, "/fresh")  # rospy's server is busy with the call of before
    wait_transport(b, "direct", service="/fresh")
    assert calls(caller(b, kind, "/fresh"), "echo 0 10 2 once")["same"] == 2
    assert fresh.returncode is None


def test_calls_go_on_while_the_agent_of_the_server_is_dead(modules: ModuleFactory) -> None:
    a, b = modules("a", "b", config=AUTO)
    on_the_network(a, b)
    worker(a)
    wait_transport(b, "direct")
    client = caller(b)
    local = caller_at_loopback(b)
    since = client.mark_events()
    client.tell("sleep 3 10 1 persistent")
    a.agent.kill()
    b.agent.wait_no_peer("a")
    assert calls(local, "echo 0 10 1 once")["ok"] == 0, "what would be relayed fails at once"
    assert client.wait_event("done", since=since)["same"] == 1, "a call under way is answered"
    assert calls(client, "echo 0 10 3 once")["same"] == 3
    a.agent.restart()
    b.agent.wait_peer("a")
    eventually(lambda: known(b).get("transport") == "direct", what="direct again")
    assert calls(client, "echo 0 10 3 persistent")["same"] == 3
    assert calls(local, "echo 0 10 1 once")["same"] == 1


def caller_at_loopback(module: Module) -> Process:
    """A client that connects within its machine only."""
    before, module.ros.env["ROS_HOSTNAME"] = module.ros.env.pop("ROS_IP"), "localhost"
    started = caller(module, name="local")
    del module.ros.env["ROS_HOSTNAME"]
    module.ros.env["ROS_IP"] = before
    return started


def test_a_persistent_call_outlives_the_agent_of_the_client(modules: ModuleFactory) -> None:
    a, b = modules("a", "b", config=AUTO)
    on_the_network(a, b)
    server = worker(a)
    wait_transport(b, "direct")
    client = caller(b)
    since = client.mark_events()
    client.tell("sleep 3 10 2 persistent")
    server.wait_event("call", where=lambda event: event["op"] == "sleep")
    b.agent.kill()
    assert client.wait_event("done", since=since)["same"] == 2
    b.agent.restart()
    wait_transport(b, "direct")
    assert calls(client, "echo 0 10 2 once")["same"] == 2
    relayed = known(b)[
        "calls"
    ]  # 2 if the new core does not know this node: it registered just before the old one died
    assert calls(caller(b), "echo 0 10 2 once")["same"] == 2
    assert known(b)["calls"] == relayed


def test_the_transport_follows_the_rules_of_both_modules(modules: ModuleFactory) -> None:
    a, b = modules("a", "b", config=AUTO)
    on_the_network(a, b)
    server = worker(a)
    wait_transport(b, "direct")
    client = caller(b)
    since = client.mark_events()
    client.tell("sleep 1.5 10 3 persistent")
    server.wait_event("call", where=lambda event: event["op"] == "sleep")

    reload(a, '[[service]]\nnames = ["/work"]\ntransport = "relay"\n' + AUTO)
    info = wait_transport(b, "relay", "transport")
    assert "the server's module" in str(info["relayed_because"])
    assert client.wait_event("done", since=since)["same"] == 3, "a persistent client keeps its connection"
    assert known(b)["calls"] == 0
    assert calls(client, "echo 0 10 2 once")["same"] == 2
    assert known(b)["calls"] == 2
    reload(a, AUTO)
    wait_transport(b, "direct")
    reload(b, "")
    wait_transport(b, "relay", "transport")
    reload(b, AUTO + "timeout = 5\n")
    assert "5 s" in str(wait_transport(b, "relay", "contract")["relayed_because"])
    reload(b, '[services]\ntransport = "direct"\n[[peer]]\nname = "a"\nprefix = "/robot"\n')
    wait_transport(b, "relay", "name", "/robot/work")
    b.agent.process.wait_for(r'! /robot/work of a: relayed although transport is "direct"')
    assert "[name" in b.agent.rmpa("why", "/robot/work")[1] or "(name)" in b.agent.rmpa("why", "/robot/work")[1]


def test_a_port_that_a_firewall_closes_is_relayed_soon(modules: ModuleFactory) -> None:
    a, b = modules("a", "b", config=AUTO)
    on_the_network(a, b)
    worker(a)
    address = str(wait_transport(b, "direct")["address"])
    client = caller(b)
    assert calls(client, "echo 0 10 2 once")["same"] == 2
    # The answers of that port get lost, and those of the agent do not.
    a.host.ip("rule", "add", "ipproto", "tcp", "sport", address.rpartition(":")[2], "blackhole")
    began = time.monotonic()
    assert calls(client, "echo 0 10 1 once")["ok"] == 0
    assert time.monotonic() - began < 10.0, "the kernel alone tries for two minutes"
    wait_transport(b, "relay", "reachable")
    assert calls(client, "echo 0 10 2 once")["same"] == 2
    assert known(b)["calls"] == 2


@pytest.mark.long
def test_a_roscore_answers_all_nodes_alike_so_its_module_is_relayed(
    lab: Lab, agent: AgentFactory, shell: ShellFactory
) -> None:
    first, second = lab.hosts("a", "b")
    a = Module(first, agent(first, name="a", config=AUTO), shell(first))
    ros = shell(second)
    ros.roscore()
    b = Module(second, agent(second, name="b", config=AUTO, flags=("--core", "external")), ros)
    a.agent.wait_peer("b")
    on_the_network(a, b)
    worker(a)
    worker(b, "roscpp", "/mine")
    wait_transport(b, "relay", "core")
    wait_transport(a, "direct", service="/mine")
    assert calls(caller(a, "rospy", "/mine"), "echo 0 10 2 once")["same"] == 2
    assert calls(caller(b), "echo 0 10 2 once")["same"] == 2
    assert (known(a, "/mine")["calls"], known(b)["calls"]) == (0, 2)
