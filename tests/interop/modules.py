"""A module as the paper has it: a host with its own agent and core, and a ROS user's shell there."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from lab.bed.processes import DEADLINE, Event, Process, eventually

if TYPE_CHECKING:
    from lab.bed.agents import Agent
    from lab.bed.namespaces import Host
    from tests.interop.ros import Ros


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
        """Wait until the master here knows a topic; ``rostopic list`` then shows it."""
        what = f"{topic} in the graph of {self.name}"
        eventually(lambda: topic in self.ros.graph_topics(), timeout, what=what)
        eventually(lambda: topic in self.topics(), timeout, what=what)

    def wait_no_topic(self, topic: str, timeout: float = DEADLINE) -> None:
        """Wait until the master here no longer knows a topic; ``rostopic list`` then does not show it."""
        what = f"{topic} out of the graph of {self.name}"
        eventually(lambda: topic not in self.ros.graph_topics(), timeout, what=what)
        eventually(lambda: topic not in self.topics(), timeout, what=what)


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
