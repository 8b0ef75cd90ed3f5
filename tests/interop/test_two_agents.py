"""Two agents on one machine: each with its own core; a conflict over a port or a name is reported."""

from __future__ import annotations

import signal
from typing import TYPE_CHECKING

import pytest

from lab.bed.agents import Agent
from lab.bed.namespaces import MACHINE
from tests.interop.modules import whole

if TYPE_CHECKING:
    from pathlib import Path

    from tests.interop.conftest import AgentFactory, ShellFactory


@pytest.mark.ros
@pytest.mark.parametrize("client", ["rospy", "roscpp"])
def test_two_agents_on_one_machine_share_topics(agent: AgentFactory, shell: ShellFactory, client: str) -> None:
    first, second = agent(), agent()
    first.wait_peer(second.name)
    heard = shell(port=second.core_port).node(client, "listener", topic="/chatter", count=100)
    shell(port=first.core_port).node(client, "talker", topic="/chatter", rate=200, count=100, wait=1)
    whole(heard.wait_event("done"), 100)


def test_second_agent_of_one_name_says_so_and_exits_1(agent: AgentFactory) -> None:
    first = agent(name="base")
    second = agent(name="base", ready=False)
    assert second.process.wait() == 1
    assert "base" in second.process.output
    assert "Traceback" not in second.process.output
    assert first.process.returncode is None
    assert first.sockets()


def test_second_agent_on_one_core_port_says_so_and_exits_1(agent: AgentFactory) -> None:
    first = agent()
    second = agent(core_port=first.core_port, ready=False)
    assert second.process.wait() == 1
    assert str(first.core_port) in second.process.output
    assert "Traceback" not in second.process.output


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_signals_end_it_in_order(agent: AgentFactory, number: signal.Signals) -> None:
    first = agent()
    assert first.sockets()
    first.process.send(number)
    assert first.process.wait() == 0
    assert first.sockets() == []
    assert "Traceback" not in first.process.output


def test_a_socket_left_by_a_killed_agent_does_not_stop_the_next(agent: AgentFactory) -> None:
    first = agent()
    first.kill()
    first.restart()
    assert isinstance(first.peers(), dict)
    assert first.terminate() == 0
    assert first.sockets() == []


def test_commands_say_so_when_no_agent_answers(tmp_path: Path) -> None:
    stranger = Agent(MACHINE, tmp_path)
    code, output = stranger.rmpa("peer", "list")
    assert code == 1
    assert "rmpa up" in output
    assert "Traceback" not in output
