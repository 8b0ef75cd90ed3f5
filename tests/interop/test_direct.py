"""Direct transport: messages go from node to node, and the agents only arrange it."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

from tests.interop.modules import Module, flows

if TYPE_CHECKING:
    from tests.interop.conftest import ModuleFactory

pytestmark = [pytest.mark.ros, pytest.mark.netns, pytest.mark.timeout(120)]

AUTO = '[bridge]\ntransport = "auto"\n'
CLIENTS = [(s, p) for s in ("roscpp", "rospy") for p in ("roscpp", "rospy")]


def direct_sockets(module: Module, other: Module) -> set[str]:
    """The connections of a module's nodes to nodes of another one: those that are neither of its agent nor local."""
    import subprocess

    text = subprocess.run(
        ["ip", "netns", "exec", module.host.namespace, "ss", "-tnHp", "state", "established"],
        capture_output=True,
        text=True,
        check=True,
    ).stdout
    return {
        line
        for line in text.splitlines()
        if str(other.host.address) in line and f"pid={module.agent.pid}," not in line
    }


def reachable(*modules: Module) -> None:
    """Let the modules' nodes listen for the network: without ROS_IP, or with an address of it."""
    for module in modules:
        module.ros.env["ROS_IP"] = module.host.address


@pytest.mark.parametrize(("subscriber", "publisher"), CLIENTS)
def test_messages_go_from_node_to_node(modules: ModuleFactory, subscriber: str, publisher: str) -> None:
    a, b = modules("a", "b", config=AUTO)
    reachable(a, b)
    a.ros.node(publisher, "talker", topic="/chatter", rate=100)
    listener = b.ros.node(subscriber, "listener", topic="/chatter")
    flows(listener)
    print(direct_sockets(b, a))
    assert direct_sockets(b, a)
    info = b.agent.rmpa("topic", "info", "/chatter")
    print(info)
    report = flows(listener, 100)
    assert (report["gaps"], report["doubled"]) == (0, 0)
