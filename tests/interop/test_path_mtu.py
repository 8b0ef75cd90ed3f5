"""A path that silently drops large packets: images still arrive, and the user is informed."""

from __future__ import annotations

import json
import shutil
import subprocess
from typing import TYPE_CHECKING

import pytest

from lab.bed.processes import eventually
from lab.bed.ros import PYTHON
from tests.interop.modules import Module, flows

if TYPE_CHECKING:
    from lab.bed.namespaces import Host, Lab
    from tests.interop.conftest import AgentFactory, ModuleFactory, ShellFactory

pytestmark = [
    pytest.mark.ros,
    pytest.mark.netns,
    pytest.mark.timeout(120),
    pytest.mark.skipif(shutil.which("nft") is None, reason="no nftables here (apt install nftables)"),
]

IMAGE = 300_000
TOPICS = 60
"""Whose advertisement is larger than a packet."""
CROWD = """
import rospy, std_msgs.msg
rospy.init_node("crowd")
names = ["/crowd/a_topic_with_a_name_%d" % number for number in range({count})]
kept = [rospy.Publisher(name, std_msgs.msg.String, queue_size=1) for name in names]
rospy.spin()
"""
HEALED = 15.0
"""Seconds within which images flow: a few on a quiet machine."""


def drop_large(host: Host, above: int = 1400) -> None:
    """Drop larger packets from the cable, as a tunnel does whose ICMP messages are lost."""
    chain = "type filter hook input priority 0"
    rules = f"table inet hole {{\n chain in {{\n {chain}\n iifname eth0 meta length > {above} drop\n }}\n }}\n"
    subprocess.run(host.command(["nft", rules]), check=True, capture_output=True, timeout=20)


def wait_topics(module: Module, count: int) -> None:
    """Wait until a module's graph shows so many topics of the other one's crowd."""

    def shown() -> bool:
        return sum(topic.startswith("/crowd/") for topic in module.topics()) >= count

    eventually(shown, HEALED, what=f"{count} topics in the graph of {module.name}")


def test_images_arrive_where_large_packets_are_dropped(lab: Lab, agent: AgentFactory, shell: ShellFactory) -> None:
    """From the first packet on, both ways: graphs, whose exchange is larger than a packet, commands and images."""
    hosts = lab.hosts("a", "b")
    for host in hosts:
        drop_large(host)
    a, b = (Module(host, agent(host, name=host.name, log_level="info"), shell(host)) for host in hosts)
    a.agent.wait_peer("b")
    a.ros.start(PYTHON, "-c", CROWD.format(count=TOPICS), name="crowd")
    wait_topics(b, TOPICS)
    eyes = [to.ros.roscpp("listener", "__name:=eye", topic=f"/{of.name}/image") for of, to in ((a, b), (b, a))]
    hand = b.ros.roscpp("listener", "__name:=hand", topic="/command", nodelay=True)
    a.ros.roscpp("talker", "__name:=teller", topic="/command", size=64, rate=50)
    for module in (a, b):
        module.ros.roscpp("talker", "__name:=camera", topic=f"/{module.name}/image", size=IMAGE, rate=10)
    for eye in eyes:
        flows(eye, 3, HEALED)
    for listener in (*eyes, hand):
        assert flows(listener, 10)["bad"] == 0
    wait_topics(b, TOPICS)
    assert a.agent.process.output.count("a path-MTU black hole") == 1, "said once"
    told(a, b)


def told(a: Module, b: Module) -> None:
    """What users see of the hole between ``a`` and ``b``."""
    hole = f"large packets do not get through to {b.host.address} (a path-MTU black hole)"
    _, output = a.agent.rmpa("peer", "list")
    assert hole in output
    _, output = a.agent.rmpa("peer", "info", "b")
    assert "Packets:      of at most 1252 bytes to it" in output
    assert hole in output
    code, output = b.agent.rmpa("why", "a:/a/image")
    assert f"a says: {hole}" in output
    assert code == 0, output
    _, output = a.agent.rmpa("doctor", "--json", "--quiet")
    found = {(f["check"], f["subject"]): f for f in json.loads(output)}
    assert hole in found["mtu", "a-b"]["text"]
    assert "tcp_mtu_probing=1" in found["mtu", "probing"]["remedy"]


def test_a_path_that_becomes_narrow_takes_images_on(modules: ModuleFactory) -> None:
    """A route that changes to a tunnel: topics that flowed in large packets go on in small ones."""
    a, b = modules("a", "b", log_level="info")
    eye = b.ros.roscpp("listener", "__name:=eye", topic="/image")
    a.ros.roscpp("talker", "__name:=camera", topic="/image", size=IMAGE, rate=5)
    flows(eye, 3)
    drop_large(b.host)
    eventually(lambda: "a path-MTU black hole" in a.agent.process.output, HEALED, what="the warning")
    assert flows(eye, 10, HEALED)["bad"] == 0
