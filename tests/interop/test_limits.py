"""Limits with real nodes and stock tools: what exceeds them is reported, and nothing else is affected."""

from __future__ import annotations

import json
import socket
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from lab.bed.agents import Agent
from lab.bed.processes import DEADLINE
from tests.interop.conftest import AgentFactory, ShellFactory
from tests.interop.ros import PYTHON

pytestmark = [pytest.mark.ros, pytest.mark.timeout(180)]

SET_HUGE = """
import rospy
try:
    rospy.set_param("/huge", "x" * 80_000_000)
except Exception as error:
    print(error)
"""
HEAD = b"POST /RPC2 HTTP/1.1\r\nHost: x\r\nContent-Type: text/xml\r\nContent-Length: 5000\r\n\r\n"


def beyond(agent: Agent, peer: str) -> list[dict[str, Any]]:
    code, output = agent.rmpa("peer", "info", peer, "--json")
    assert code == 0, output
    found: list[dict[str, Any]] = json.loads(output)["beyond"]
    return found


@pytest.fixture
def dribble() -> Iterator[Callable[[int], None]]:
    """Makes seven hundred connections to a port, each with a byte now and then; returns when all have begun."""
    ports: list[int] = []
    stop, all_begun = threading.Event(), threading.Event()

    def dial() -> socket.socket:
        made = socket.socket()
        made.setblocking(False)
        made.connect_ex(("127.0.0.1", ports[0]))
        return made

    def feed() -> None:
        while not ports and not stop.wait(0.01):
            pass
        begun: dict[socket.socket, bool] = {dial(): False for _ in range(700)} if ports else {}
        while not stop.wait(0.5):
            for one, more in list(begun.items()):
                try:
                    one.send(b"x" if more else HEAD)
                    begun[one] = True
                except BlockingIOError:
                    pass
                except OSError:
                    one.close()
                    del begun[one]
                    begun[dial()] = False
            if all(begun.values()):
                all_begun.set()
        for one in begun:
            one.close()

    def begin(port: int) -> None:
        ports.append(port)
        assert all_begun.wait(DEADLINE)

    thread = threading.Thread(target=feed)
    thread.start()
    yield begin
    stop.set()
    thread.join()


def test_slow_connections_and_large_parameters(
    agent: AgentFactory, shell: ShellFactory, dribble: Callable[[int], None], tmp_path: Path
) -> None:
    made = agent(name="core")
    ros = shell(port=made.core_port)
    (tmp_path / "map.yaml").write_text("map: '" + "x" * 12_000_000 + "'\n", encoding="utf-8")
    ros.tool("rosparam", "load", str(tmp_path / "map.yaml"), "/large")
    assert "large" in ros.tool("rosparam", "list")
    text = ros.tool(str(PYTHON), "-c", SET_HUGE)
    assert "setParam /huge: 80000" in text, text[:500]
    assert "64 MiB" in text

    dribble(made.core_port)
    slowest = 0.0
    for _ in range(5):
        begin = time.monotonic()
        assert "/rosout" in ros.tool("rostopic", "list")
        slowest = max(slowest, time.monotonic() - begin)
    assert slowest < 10.0, "it was refused, or waited for 10 s"
    assert "gave way to others" not in made.process.output
