"""Modules as the paper has them: a host with its own agent and core, and a ROS user's shell there."""

from __future__ import annotations

from contextlib import ExitStack
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path
from typing import Final

from lab.bed.agents import Agent
from lab.bed.namespaces import Host, Lab
from lab.bed.processes import DEADLINE, Event, Process, eventually
from lab.bed.ros import MasterProxy
from rmpa.core.errors import RmpaError
from tests.interop.ros import Ros

# Seconds within which a bed is as it was before a test, or is thrown away.
_SETTLES: Final = 10.0


@dataclass(frozen=True, slots=True)
class Module:
    """One host of a test with everything that runs there."""

    host: Host
    agent: Agent
    ros: Ros

    @property
    def name(self) -> str:
        """The agent's name."""
        return self.agent.name

    def topics(self) -> set[str]:
        """What the stock ``rostopic list`` says here."""
        return set(self.ros.tool("rostopic", "list").split())

    def wait_topic(self, topic: str, timeout: float = DEADLINE) -> None:
        """Wait until the master here knows a topic: what ``rostopic list`` shows."""
        eventually(lambda: topic in self.ros.graph_topics(), timeout, what=f"{topic} in the graph of {self.name}")

    def wait_no_topic(self, topic: str, timeout: float = DEADLINE) -> None:
        """Wait until the master here no longer knows a topic."""
        what = f"{topic} out of the graph of {self.name}"
        eventually(lambda: topic not in self.ros.graph_topics(), timeout, what=what)


def whole(report: Event, count: int) -> None:
    """Fail unless a listener's report says: this many messages, each byte right, none missing, doubled or moved."""
    assert (report["count"], report["bad"], report["gaps"], report["doubled"]) == (count, 0, 0, 0), report


def flows(listener: Process, more: int = 10, timeout: float = DEADLINE) -> Event:
    """Wait until a listener has received ``more`` further messages; return its report."""
    reports = listener.events("report")
    begin = _count(reports[-1]) if reports else 0
    return listener.wait_event(
        "report", timeout, where=lambda e: _count(e) >= begin + more, since=listener.mark_events()
    )


def _count(event: Event) -> int:
    return int(str(event["count"]))


class Bed:
    """Agents on one network, linked with each other, that tests take in turn while each leaves them as they were.

    Args:
        home: Existing directory of the agents' files.
        names: Of the hosts and agents.
        options: Of each agent.
    """

    def __init__(self, home: Path, names: tuple[str, ...], options: dict[str, object]) -> None:
        with ExitStack() as stack:
            lab = stack.enter_context(Lab())
            self.agents = start_linked(lab.hosts(*names), home, stack, options)
            self._pids = [agent.pid for agent in self.agents]
            self._at_first = self._state()
            self._stack = stack.pop_all()

    def settled(self) -> bool:
        """Whether it is as it was at first; the agents' output so far is forgotten."""
        if any(agent.process.returncode is not None for agent in self.agents):
            return False
        if [agent.pid for agent in self.agents] != self._pids:
            return False
        try:
            for agent in self.agents:
                file = agent.home / f"{agent.name}.toml"
                if agent.config and file.read_text() != agent.config:
                    file.write_text(agent.config)
                    agent.rmpa("reload")
            eventually(lambda: self._state() == self._at_first, _SETTLES)
        except (RmpaError, OSError):
            return False
        for agent in self.agents:
            agent.process.lines.clear()
        return True

    def close(self) -> None:
        """End all of it."""
        self._stack.close()

    def _state(self) -> list[object]:
        """What a test may not leave changed: addresses and cables, links, what the cores hold."""
        state: list[object] = []
        for agent in self.agents:
            with MasterProxy(agent.host, agent.core_port) as master:
                core = [master.getSystemState("/test"), sorted(master.getParamNames("/test")[2])]  # type: ignore[index, arg-type] # XML-RPC
            state += [agent.host.ip("-4", "address"), agent.linked(), core]
        return state


def start_linked(
    hosts: list[Host], home: Path, stack: ExitStack, options: dict[str, object], *, linked: bool = True
) -> list[Agent]:
    """Start an agent on each host; return when all are ready and, if so wished, linked with each other."""
    agents = []
    for host in hosts:
        agents.append(agent := stack.enter_context(Agent(host, home, name=host.name, **options)))  # type: ignore[arg-type]
        agent.start()
    for agent in agents:
        agent.wait_ready()
    for one, other in combinations(agents if linked else (), 2):
        one.wait_peer(other.name)
    return agents
