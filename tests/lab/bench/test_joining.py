"""A mesh is full when the last link of the last agent is up; a graph is mirrored when all of it is seen."""

from __future__ import annotations

import json
import subprocess
import sys
import threading
from typing import Any
from xmlrpc.server import SimpleXMLRPCServer

import pytest

from lab.bed.agents import last_link
from lab.bed.ros import NODES
from rmpa.observe.peer_info import LinkInfo, PeerInfo
from rmpa.observe.snapshot import AgentInfo, Snapshot


def snapshot(**links: float | None) -> Snapshot:
    agent = AgentInfo(
        name="m", guid="", instance="", domain=0, core_uri="", version="", pid=1, started=0.0, uptime=9.0
    )
    peers = tuple(
        PeerInfo(
            name=name,
            guid="",
            instance="",
            state="linked" if up is not None else "linking",
            since_ago=0.0,
            link=LinkInfo(remote="", dialled=True, up_ago=up) if up is not None else None,
        )
        for name, up in links.items()
    )
    return Snapshot(agent=agent, taken=0.0, peers=peers)


def test_the_last_link_counts_and_none_may_be_missing() -> None:
    assert last_link(snapshot(a=3.0, b=1.5), {"a", "b"}, 10.0) == pytest.approx(8.5)
    assert last_link(snapshot(a=3.0, b=None), {"a", "b"}, 10.0) is None
    assert last_link(snapshot(a=3.0), {"a", "b"}, 10.0) is None
    assert last_link(snapshot(a=3.0, stranger=0.1), {"a"}, 10.0) == pytest.approx(7.0)
    assert last_link(None, {"a"}, 10.0) is None


def test_a_graph_is_mirrored_when_all_of_it_is_there() -> None:
    looks = 0

    def state(_caller: Any) -> Any:
        nonlocal looks
        looks += 1
        topics = [[f"/crowd/topic{n}", ["/rmpa/there/crowd0"]] for n in range(looks)]
        services = [[f"/crowd0/service{n}", ["/rmpa/there/crowd0"]] for n in range(looks - 2)]
        return [1, "", [[["/other", ["/n"]], *topics], [], services]]

    with SimpleXMLRPCServer(("127.0.0.1", 0), logRequests=False) as server:
        server.register_function(state, "getSystemState")
        thread = threading.Thread(target=server.serve_forever, args=(0.01,))
        thread.start()
        argv = [sys.executable, str(NODES / "mirrored.py"), "--topics", "3", "--services", "2", "--every", "0.001"]
        uri = f"http://127.0.0.1:{server.server_address[1]}/"
        done = subprocess.run(
            argv, env={"ROS_MASTER_URI": uri}, capture_output=True, text=True, timeout=20, check=True
        )
        server.shutdown()
        thread.join()
    events = [json.loads(line.removeprefix("@ ")) for line in done.stdout.splitlines()]
    assert [(event["event"], event.get("count")) for event in events] == [
        ("up", None),
        ("topics", 3),
        ("services", 2),
    ]
