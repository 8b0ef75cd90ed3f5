"""Direct calls of services: unmodified clients connect to the server itself, and the agents only arrange it."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING

import pytest

from lab.bed.processes import eventually
from tests.interop.ros import PYTHON

if TYPE_CHECKING:
    from lab.bed.processes import Event, Process
    from tests.interop.conftest import ModuleFactory
    from tests.interop.modules import Module

pytestmark = [pytest.mark.ros, pytest.mark.netns, pytest.mark.timeout(120)]

AUTO = '[services]\ntransport = "auto"\n'
CLIENTS = ["rospy", "roscpp"]


def on_network(*modules: Module) -> None:
    """Let the modules' nodes listen for the network, as without ROS_IP."""
    for module in modules:
        module.ros.env["ROS_IP"] = module.host.address


def worker(module: Module, kind: str = "rospy", service: str = "/work") -> Process:
    """Start a server."""
    name = f"worker{service.replace('/', '_')}"
    started = module.ros.node(kind, "worker", name=name, service=service, quiet=False)
    started.wait_event("up")
    return started


def caller(module: Module, kind: str = "rospy", service: str = "/work", **options: object) -> Process:
    """Start a client, and wait until the service is there for it."""
    start = module.ros.rospy if kind == "rospy" else module.ros.roscpp
    started = start("caller", service=service, wait=True, commands=True, **options)  # type: ignore[arg-type]
    started.wait_event("there")
    return started


def calls(client: Process, line: str, timeout: float = 20.0) -> Event:
    """Make a client make the calls of its line, and return the outcomes."""
    since = client.mark_events()
    client.tell(line)
    return client.wait_event("done", timeout, since=since)


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


@pytest.mark.parametrize("client", CLIENTS)
@pytest.mark.parametrize("server", CLIENTS)
def test_calls_go_from_node_to_node(modules: ModuleFactory, server: str, client: str) -> None:
    a, b = modules("a", "b", config=AUTO)
    on_network(a, b)
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
