"""Settings that are read again while data flows: only what they concern changes."""

from __future__ import annotations

import json
import re
import signal
from typing import TYPE_CHECKING

import pytest

from tests.interop.modules import Module, flows, whole

if TYPE_CHECKING:
    from pathlib import Path

    from lab.bed.namespaces import Lab
    from tests.interop.conftest import AgentFactory, ShellFactory

pytestmark = [pytest.mark.ros, pytest.mark.netns, pytest.mark.timeout(180)]

BEFORE = """
[bridge]
deny = ["/later"]
"""
AFTER = """
[bridge]
deny = ["/no_more"]

[[peer]]
name = "a"
remap_in = { "/moved" = "/a/moved" }

[[contract]]
topics = ["/tuned"]
depth = 5
"""


def write(tmp_path: Path, module: Module, text: str) -> None:
    (tmp_path / f"{module.name}.toml").write_text(text, encoding="utf-8")


def connection(module: Module, node: str) -> str:
    """The TCP connection over which a node has its one topic, as the stock ``rosnode info`` shows it."""
    info = module.ros.tool("rosnode", "info", node)
    [found] = re.findall(r"topic: /steady\s.*?direction: \w+ \((\d+ - [\d.:]+)\)", info, re.DOTALL)
    return str(found)


def test_a_reload_loses_no_message_of_a_stream(
    lab: Lab, agent: AgentFactory, shell: ShellFactory, tmp_path: Path
) -> None:
    a, b = (
        Module(host, agent(host, name=host.name, config="" if host.name == "a" else BEFORE), shell(host))
        for host in lab.hosts("a", "b")
    )
    a.agent.wait_peer("b")
    steady = b.ros.roscpp("listener", "__name:=hear_steady", topic="/steady")
    moved, tuned = (b.ros.roscpp("listener", f"__name:=hear_{name}", topic=f"/{name}") for name in ("moved", "tuned"))
    for name in ("moved", "tuned", "no_more", "later"):
        a.ros.roscpp("talker", f"__name:=say_{name}", topic=f"/{name}", rate=50)
    a.ros.roscpp("talker", "__name:=say_steady", topic="/steady", rate=100, wait=1)
    flows(steady)
    flows(moved)
    flows(tuned)
    b.wait_topic("/no_more")
    assert "/later" not in b.topics()
    connections = [connection(a, "/say_steady"), connection(b, "/hear_steady")]

    # What cannot be used changes nothing, and says where it is wrong.
    write(tmp_path, b, AFTER.replace("depth = 5", "depth = 0"))
    code, said = b.agent.rmpa("reload")
    assert code == 2, said
    assert f"{b.name}.toml:11: contract.depth: 0 is out of range" in said

    # A check only tells.
    write(tmp_path, b, AFTER + "[mesh]\nport = 40123\n[log]\nlevel = 'debug'\n")
    code, said = b.agent.rmpa("reload", "--check")
    assert code == 0, said
    assert "b.toml: bridge.deny, [[peer]], [[contract]] would take effect" in said
    assert "mesh.port (40123 instead of 0) would take effect after a restart" in said
    assert "/later" not in b.topics()

    # SIGHUP does it.
    b.agent.process.send(signal.SIGHUP)
    b.wait_topic("/later")
    b.wait_topic("/a/moved")
    b.wait_no_topic("/no_more")
    newly = b.ros.roscpp("listener", "__name:=hear_again", topic="/a/moved")
    flows(newly)
    flows(tuned)
    code, said = b.agent.rmpa("topic", "info", "/tuned", "--json")
    assert code == 0, said
    [route] = json.loads(said)["mesh"]["routes"]
    assert (route["state"], route["contract"]) == ("open", {"depth": 5})

    # And back, by the command, which also names what waits for a restart.
    write(tmp_path, b, BEFORE + "[mesh]\nport = 40123\n")
    code, said = b.agent.rmpa("reload", "--json")
    assert code == 0, said
    reply = json.loads(said)
    assert reply["changed"] == ["bridge.deny", "[[peer]]", "[[contract]]"]
    assert reply["restart"] == ["mesh.port (40123 instead of 0)"]
    b.wait_no_topic("/later")
    flows(moved)

    report = flows(steady)
    whole(report, int(str(report["last"])))
    assert [connection(a, "/say_steady"), connection(b, "/hear_steady")] == connections
