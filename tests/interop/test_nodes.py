"""Nodes that are killed, cannot be reached, or have another node's address, and what users see of it."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING

import pytest

from lab.bed.processes import eventually
from rmpa.observe.control_client import ControlClient

if TYPE_CHECKING:
    from lab.bed.namespaces import Lab
    from rmpa.observe.snapshot import PeerInfo
    from tests.interop.conftest import AgentFactory, ModuleFactory

pytestmark = [pytest.mark.ros, pytest.mark.netns, pytest.mark.timeout(120)]


def test_two_machines_with_one_address_are_told_as_a_conflict(lab: Lab, agent: AgentFactory) -> None:
    """Beacons of both come; TCP reaches whichever the ARP cache names, and the other one's port is refused."""
    a, b, c = lab.hosts("a", "b", "c")
    cable = c.cables[0]
    c.ip("address", "del", f"{cable.address}/24", "dev", cable.interface)
    c.ip("address", "add", f"{b.address}/24", "dev", cable.interface)
    seen_by, *_ = agent(a, name="a"), agent(b, name="b"), agent(c, name="c")

    def conflicts() -> list[PeerInfo]:
        with ControlClient(seen_by.sockets()[0]) as client:
            return [peer for peer in client.snapshot().peers if peer.state == "conflict"]

    eventually(conflicts, what="the conflict", every=0.5)
    assert all(f"its address {b.address} is also that of peer" in peer.conflicts[0] for peer in conflicts())


def test_nodes_are_pinged_and_ended_across_modules(modules: ModuleFactory) -> None:
    """What stock tools and ours do to the nodes of two modules."""
    a, b = modules("a", "b")
    for name in ("talker", "other"):
        b.ros.rospy("talker", f"__name:={name}", topic=f"/{name}", rate=20)
    a.ros.roscpp("talker", "__name:=mine", topic="/mine", rate=20)
    for name in ("talker", "other"):
        a.wait_topic(f"/{name}")
    b.wait_topic("/mine")
    listed = a.agent.rmpa("node", "list")[1].split()
    assert {"/mine", "b:/talker", "b:/other", "/rosout", "/rmpa"} <= set(listed)

    def rosout() -> str:
        code, said = a.agent.rmpa("node", "info", "/rosout", "--json")[:2]
        return "" if code else str(json.loads(said).get("uri", ""))  # it is away until it is started anew

    before = rosout()
    assert "killed" in a.ros.tool("rosnode", "kill", "-a")
    b.wait_no_topic("/mine")
    eventually(lambda: rosout() not in {"", before}, what="another /rosout")
    assert {"/talker", "/other"} <= b.topics(), "kill -a ends the nodes of this module alone"
    assert a.agent.rmpa("node", "ping", "b:/talker", "-c", "1")[0] == 0
    assert {"/talker", "/rosout_agg"} <= a.topics()

    ping = a.ros.start("rosnode", "ping", "/rmpa/b/talker", name="ping")
    ping.wait_for("xmlrpc reply from http://127")
    code, out = a.agent.rmpa("node", "kill", "b:/talker")
    assert (code, out.strip()) == (0, "killed b:/talker")
    b.wait_no_topic("/talker")
    ping.wait()
    assert "connection to [/rmpa/b/talker] failed" in ping.output, "as of any node that is gone"

    def killed() -> bool:
        a.ros.tool("rosnode", "kill", "/rmpa/b/other")  # refused as long as it may belong to kill -a
        return "/other" not in b.topics()

    eventually(killed, what="the end of b's /other", every=3.0)
    a.wait_no_topic("/other")
