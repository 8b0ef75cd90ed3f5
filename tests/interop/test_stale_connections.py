"""``rmpa doctor`` about the right to end stale connections: that of the agent, whoever asks."""

from __future__ import annotations

import json
import os
from typing import TYPE_CHECKING, Final

import pytest

from lab.bed.agents import RMPA
from lab.bed.namespaces import MACHINE
from lab.bed.processes import Process
from rmpa.runtime.tcp_connections import may_end_connections
from tests.interop.test_realtime import Prefixed, runs

if TYPE_CHECKING:
    from lab.bed.agents import Agent
    from tests.interop.conftest import AgentFactory

WITHOUT_NET_ADMIN: Final = ("setpriv", "--bounding-set=-net_admin")
CONFIG: Final = '[bridge]\ntransport = "{}"\n'

needs_the_right = pytest.mark.skipif(bool(may_end_connections()), reason="connections cannot be ended here")
needs_root = pytest.mark.skipif(os.geteuid() != 0, reason="needs root, to drop a capability")


def asked(made: Agent) -> dict[str, str]:
    """What a doctor that this process starts, with its rights, says of the agent's."""
    config = made.home / f"{made.name}.toml"
    words = [RMPA, "doctor", "--json", "--config", config]
    with Process(MACHINE.command(words), env=made.env) as process:
        process.wait()
        answers = json.loads(process.output[process.output.index("[") :])
    name = "stale connections"
    (found,) = [answer for answer in answers if (answer["check"], answer["subject"]) == (name, made.name)]
    return dict(found)


@needs_the_right
def test_an_agent_that_may(agent: AgentFactory) -> None:
    found = asked(agent(config=CONFIG.format("auto")))
    assert (found["level"], found["text"]) == (
        "ok",
        "the agent may end those that a vanished host leaves behind",
    )


@needs_root
@needs_the_right
def test_an_agent_without_the_capability_is_told_what_to_do(agent: AgentFactory) -> None:
    if not runs(WITHOUT_NET_ADMIN):
        pytest.skip("capabilities cannot be dropped here")
    bare = Prefixed("bare", "", prefix=WITHOUT_NET_ADMIN)
    found = asked(agent(bare, config=CONFIG.format("auto")))
    assert found["level"] == "warn"
    assert "may not end" in found["text"]
    assert "no CAP_NET_ADMIN" in found["text"]
    assert "a rospy publisher without queue_size may hang for minutes" in found["text"]
    assert "AmbientCapabilities=CAP_NET_ADMIN" in found["remedy"]
    found = asked(agent(bare, config=CONFIG.format("relay")))
    assert found["level"] == "ok", "nothing of this agent goes direct"
