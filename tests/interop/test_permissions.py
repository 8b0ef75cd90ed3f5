"""Permissions in a secured mesh of two machines, with unmodified nodes: what crosses, and who is told why not."""

from __future__ import annotations

import json
import time
from pathlib import Path

import pytest

from lab.bed.namespaces import Lab
from lab.bed.processes import eventually
from tests.interop.conftest import AgentFactory, ShellFactory
from tests.interop.modules import Module, flows
from tests.interop.services import calls, wait_services, worker
from tests.trust.io.member_files import SecuredMesh

pytestmark = [pytest.mark.ros, pytest.mark.netns, pytest.mark.timeout(180)]

BASE = """
[bridge]
transport = "direct"

[trust.groups]
operators = ["joy*"]

[[permission]]
groups = ["operators"]
publish = ["/cmd_vel"]
subscribe = ["/odom"]
call = ["/stop"]
param = ["/speed/**"]
"""
FORBIDDEN = """
[[permission]]
modules = ["*"]
effect = "deny"
publish = ["/cmd_vel"]
call = ["/stop"]
subscribe = ["/odom"]
"""
JOYSTICK = """
[bridge]
transport = "direct"

[[permission]]
modules = ["base"]
publish = ["/**"]
subscribe = ["/**"]
serve = ["/**"]
"""


@pytest.fixture
def pair(lab: Lab, agent: AgentFactory, shell: ShellFactory, tmp_path: Path) -> tuple[Module, Module]:
    """A base and a joystick, both members of one mesh, linked."""
    mesh, made = SecuredMesh(tmp_path), []
    for host, config in zip(lab.hosts("base", "joystick"), (BASE, JOYSTICK), strict=True):
        mesh.folder = tmp_path / "state" / host.name
        mesh.save(host.name, time.time())
        made.append(Module(host, agent(host, name=host.name, config=config), shell(host)))
        made[-1].ros.env["ROS_IP"] = host.address  # so that nodes could be connected directly
    base, joystick = made
    base.agent.wait_peer("joystick")
    joystick.agent.wait_peer("base")
    return base, joystick


def publishers(module: Module, topic: str) -> str:
    """What the stock ``rostopic info`` says of a topic's publishers."""
    return module.ros.tool("rostopic", "info", topic).partition("Subscribers:")[0]


def has_remote(module: Module, topic: str, peer: str, *, there: bool = True) -> None:
    eventually(
        lambda: (f"/rmpa/{peer}/" in publishers(module, topic)) is there,
        what=f"{topic} of {peer} {'in' if there else 'out of'} the graph of {module.name}",
    )


def why(module: Module, name: str) -> str:
    return module.agent.rmpa("why", name)[1]


def test_what_the_permissions_say_crosses_and_a_reload_closes_and_opens_it(
    pair: tuple[Module, Module], tmp_path: Path
) -> None:
    base, joystick = pair
    cmd_vel = base.ros.rospy("listener", "__name:=motors", topic="/cmd_vel")
    base.ros.rospy("listener", "__name:=curious", topic="/spam")
    odom = joystick.ros.rospy("listener", "__name:=display", topic="/odom")
    for module, topic in ((joystick, "/cmd_vel"), (joystick, "/spam"), (base, "/odom"), (base, "/secret")):
        module.ros.rospy("talker", f"__name:=say{topic.replace('/', '_')}", topic=topic, rate=50)
    worker(base, "rospy", "/stop")
    worker(base, "rospy", "/open_door")
    flows(cmd_vel)
    flows(odom)
    wait_services(joystick.ros, "/stop")
    caller = joystick.ros.rospy("caller", service="/stop", wait=True, commands=True)
    caller.wait_event("there")
    assert calls(caller, "echo 0 100 5 once")["same"] == 5

    # What no rule allows is not there, on either side.
    assert "/rmpa/joystick" not in publishers(base, "/spam")
    assert "/rmpa/base/motors" in joystick.ros.tool("rostopic", "info", "/cmd_vel")
    assert "/rmpa/base" not in joystick.ros.tool("rostopic", "info", "/spam")
    assert "/secret" not in joystick.topics()
    assert "/open_door" not in joystick.ros.tool("rosservice", "list").split()
    counters = base.agent.snapshot().counters
    assert counters["permission.publish"] >= 1
    assert counters["permission.subscribe"] >= 1
    assert counters["permission.call"] >= 1
    lines = [line for line in base.agent.process.output.splitlines() if "joystick may not publish" in line]
    assert len(lines) == 1, lines

    # Each side learns the reason; the rule is the affair of the one that has it.
    assert "joystick may not publish /spam here: no [[permission]] lets joystick publish /spam" in why(
        base, "joystick:/spam"
    )
    assert "the permissions of base do not let joystick publish /spam" in why(joystick, "/spam")
    assert "the permissions of base do not let joystick subscribe to /secret" in why(joystick, "base:/secret")
    assert "do not let joystick subscribe to /open_door, nor call it if it is a service" in why(
        joystick, "base:/open_door"
    )

    # Plain connections past the agents are none of a secured mesh.
    said = why(joystick, "base:/odom")
    assert "permission there" in said
    assert "(condition trust)" in said
    assert "trust.direct is false" in said

    file = tmp_path / "base.toml"
    file.write_text(BASE + FORBIDDEN)
    code, said = base.agent.rmpa("reload", "--json")
    assert (code, json.loads(said)["changed"]) == (0, ["[[permission]]"])
    has_remote(base, "/cmd_vel", "joystick", there=False)
    has_remote(joystick, "/odom", "base", there=False)
    wait_services(joystick.ros, "/stop", there=False)
    assert "/rmpa/base" not in joystick.ros.tool("rostopic", "info", "/cmd_vel")
    assert calls(caller, "echo 0 100 1 once")["ok"] == 0
    code, said = base.agent.rmpa("trust", "check", "joystick", "publish", "/cmd_vel", "--config", str(file))
    assert (code, said.strip()) == (1, "no: [[permission]] 2 denies publish of '/cmd_vel' to '*'")

    file.write_text(BASE)
    assert base.agent.rmpa("reload")[0] == 0
    flows(cmd_vel)
    flows(odom)
    wait_services(joystick.ros, "/stop")
    eventually(lambda: calls(caller, "echo 0 100 1 once")["ok"] == 1, what="/stop can be called again")

    # Plain connections where both modules allow them, and only where the permissions let the topic cross.
    for module, config in ((base, BASE), (joystick, JOYSTICK)):
        (tmp_path / f"{module.name}.toml").write_text("[trust]\ndirect = true\n" + config)
        code, said = module.agent.rmpa("reload", "--json")
        assert (code, json.loads(said)["changed"]) == (0, ["trust.direct"])
    eventually(lambda: "direct to 10." in why(joystick, "base:/odom"), what="/odom is direct")
    flows(odom)
    file.write_text("[trust]\ndirect = true\n" + BASE + FORBIDDEN)
    assert base.agent.rmpa("reload")[0] == 0
    has_remote(joystick, "/odom", "base", there=False)
    eventually(lambda: "/display" not in base.ros.tool("rosnode", "info", "/say_odom"), what="no direct connection")
