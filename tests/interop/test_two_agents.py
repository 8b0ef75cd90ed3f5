"""Two agents on one machine: each with its own core; a conflict over a port or a name is reported."""

from __future__ import annotations

import signal

import pytest

from tests.interop.conftest import AgentFactory, ShellFactory
from tests.interop.modules import whole


@pytest.mark.ros
def test_two_agents_on_one_machine_share_topics(agent: AgentFactory, shell: ShellFactory) -> None:
    first, second = agent(), agent()
    first.wait_peer(second.name)
    heard = shell(port=second.core_port).rospy("listener", topic="/chatter", count=100)
    shell(port=first.core_port).roscpp("talker", topic="/chatter", rate=200, count=100, wait=1)
    whole(heard.wait_event("done"), 100)


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_signals_end_it_in_order(agent: AgentFactory, number: signal.Signals) -> None:
    first = agent()
    assert first.sockets()
    first.process.send(number)
    assert first.process.wait() == 0
    assert first.sockets() == []
    assert "Traceback" not in first.process.output
