"""Latched topics (/tf_static, a map): kept for each source, replayed to late subscribers, never lost or doubled."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

from lab.bed.processes import eventually
from tests.interop.modules import Module, flows

if TYPE_CHECKING:
    from lab.bed.namespaces import Lab
    from lab.bed.processes import Event, Process
    from tests.interop.conftest import AgentFactory, ModuleFactory, ShellFactory

pytestmark = [pytest.mark.ros, pytest.mark.netns, pytest.mark.timeout(120)]

TF = "/tf_static"
EVERYONE = {"1", "2", "3", "4"}


def hears(module: Module, kind: str, name: str = "") -> Process:
    """A listener that reports each message."""
    return module.ros.node(kind, "listener", topic=TF, each=True, **({"name": name} if name else {}))


def got(listener: Process) -> Event:
    """The report once it has heard of all four sources."""
    return listener.wait_event("report", where=lambda event: set(event["sources"]) == EVERYONE)  # type: ignore[call-overload]


def once(report: Event) -> None:
    """Fail unless the report has one message of each source."""
    assert (report["count"], report["bad"], report["doubled"]) == (4, 0, 0), report


def last(listener: Process) -> Event:
    """The last output of a listener."""
    return listener.events("report")[-1]


@pytest.mark.trap(10)
def test_all_latched_sources_reach_each_late_joiner_once(
    modules: ModuleFactory, lab: Lab, agent: AgentFactory, shell: ShellFactory
) -> None:
    a, b, c = modules("a", "b", "c")
    early = hears(a, "rospy", "early")
    early.wait_event("up")
    # Four nodes, two of them of one module, two of one name in two modules.
    for source, (module, kind, name) in enumerate(
        [(a, "rospy", "frames"), (b, "roscpp", "frames"), (c, "rospy", "arm"), (c, "roscpp", "base")], start=1
    ):
        module.ros.node(kind, "talker", topic=TF, count=1, latch=True, source=source, name=name).wait_event("done")
    once(got(early))
    late = [hears(module, kind) for module in (a, b, c) for kind in ("rospy", "roscpp")]
    for listener in late:
        once(got(listener))
    # A module that joins later still.
    host = lab.host("d", 0)
    d = Module(host, agent(host, name="d"), shell(host))
    once(got(hears(d, "roscpp")))
    # The stock tool, which joins late by nature.
    assert a.ros.tool("rostopic", "echo", "-n4", TF).count("layout:") == 4
    # The first subscribers did not get it again.
    for listener in (early, *late):
        once(last(listener))


def test_a_latched_message_is_not_repeated_when_the_link_is_back(modules: ModuleFactory) -> None:
    a, b = modules("a", "b")
    for kind, source, size in (("rospy", 1, 300), ("roscpp", 2, 2_000_000)):
        a.ros.node(kind, "talker", topic=TF, count=1, latch=True, source=source, size=size).wait_event("done")
    a.ros.roscpp("talker", topic="/beat", rate=50)
    listeners = [hears(b, kind) for kind in ("rospy", "roscpp")]
    beat = b.ros.roscpp("listener", topic="/beat")
    for listener in listeners:
        listener.wait_event("report", where=lambda event: event["count"] == 2)
    flows(beat)
    b.host.outage(1.0)
    flows(beat, 100)
    # A longer one: what is not latched leaves the graph, and a late joiner is told meanwhile what is latched.
    b.host.cut()
    eventually(lambda: "Publishers: None" in b.ros.tool("rostopic", "info", "/beat"), what="no publisher of /beat")
    listeners += [hears(b, kind) for kind in ("rospy", "roscpp")]
    for listener in listeners[2:]:
        listener.wait_event("report", where=lambda event: event["count"] == 2)
    b.host.restore()
    flows(beat, 100)
    for listener in listeners:
        assert (last(listener)["count"], last(listener)["doubled"]) == (2, 0), listener.name
    # Gone in order, or killed, a module leaves nothing behind.
    a.agent.kill()
    eventually(
        lambda: "Publishers: None" in b.ros.tool("rostopic", "info", TF), what="no publisher of a killed module"
    )
