"""A path that silently drops large packets: a router with narrow cables whose ICMP messages are lost."""

from __future__ import annotations

import shutil
import subprocess
from typing import TYPE_CHECKING

import pytest

from lab.bed.processes import eventually
from lab.bed.ros import PYTHON
from tests.interop.modules import Module, flows

if TYPE_CHECKING:
    from lab.bed.namespaces import Host, Lab
    from tests.interop.conftest import AgentFactory, ShellFactory

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
SOON = 15.0


def narrow(router: Host, mtu: int = 1200) -> None:
    """Give the router's cables this MTU, and keep it from telling the hosts."""
    for cable in router.cables:
        router.ip("link", "set", cable.interface, "mtu", str(mtu))
    chain = "add chain ip hole told { type filter hook output priority 0; }"
    rules = f"add table ip hole; {chain}; add rule ip hole told ip protocol icmp drop"
    subprocess.run(router.command(["nft", rules]), check=True, capture_output=True, timeout=20)


def test_all_arrives_from_the_first_packet_on(lab: Lab, agent: AgentFactory, shell: ShellFactory) -> None:
    """Both ways: graphs, whose exchange is larger than a packet, commands and images."""
    hosts = [lab.host("a", 0), lab.host("b", 1)]
    router = lab.router(0, 1)
    narrow(router)
    for host in hosts:
        lab.route(host, router)
    first = agent(hosts[0], name="a", flags=["--seed", hosts[1].address])
    a, b = (
        Module(host, made, shell(host)) for host, made in zip(hosts, (first, agent(hosts[1], name="b")), strict=True)
    )
    a.agent.wait_peer("b")
    a.ros.start(PYTHON, "-c", CROWD.format(count=TOPICS), name="crowd")

    def known() -> bool:
        return sum(topic.startswith("/crowd/") for topic in b.ros.graph_topics()) >= TOPICS

    eventually(known, SOON, what="a's graph at b")
    eyes = [to.ros.roscpp("listener", "__name:=eye", topic=f"/{of.name}/image") for of, to in ((a, b), (b, a))]
    hand = b.ros.roscpp("listener", "__name:=hand", topic="/command", nodelay=True)
    a.ros.roscpp("talker", "__name:=teller", topic="/command", size=64, rate=50)
    for module in (a, b):
        module.ros.roscpp("talker", "__name:=camera", topic=f"/{module.name}/image", size=IMAGE, rate=10)
    for listener in (*eyes, hand):
        assert flows(listener, 10, SOON)["bad"] == 0
    assert a.agent.snapshot().counters.get("link.down", 0) == 0
