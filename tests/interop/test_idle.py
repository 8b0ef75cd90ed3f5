"""What an agent costs while nothing happens: the kernel counts how often it is woken."""

from __future__ import annotations

import time
from typing import Final

import pytest

from lab.bed.agents import Agent
from lab.bed.namespaces import Lab
from lab.bed.processes import eventually
from lab.usage import wakeups
from tests.interop.conftest import AgentFactory

pytestmark = [pytest.mark.netns, pytest.mark.timeout(180)]

_SPAN: Final = 5.0
# A second, over all threads; wanted are 5, and 3 are measured. Without rest there are 75.
_WAKEUPS_MAX: Final = 8.0


def test_an_agent_with_three_peers_sleeps(lab: Lab, agent: AgentFactory) -> None:
    hosts = lab.hosts("one", "two", "three", "four")
    agents = [agent(host, name=host.name, flags=["--log-level", "info"]) for host in hosts]
    for other in hosts[1:]:
        agents[0].wait_peer(other.name)

    def rests() -> bool:
        """Whether no agent was woken often over a while; links rest some seconds after they came up."""
        return max(_woken(agents)) <= _WAKEUPS_MAX

    eventually(rests, 120.0, what="agents without work that sleep")


def _woken(agents: list[Agent]) -> list[float]:
    """Wake-ups a second of each agent over the next seconds."""
    before, begun = [wakeups(one.pid) for one in agents], time.monotonic()
    time.sleep(_SPAN)
    span = time.monotonic() - begun
    return [(wakeups(one.pid) - was) / span for one, was in zip(agents, before, strict=True)]
