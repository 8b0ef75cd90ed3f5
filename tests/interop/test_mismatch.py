"""Two ends with different types or md5 sums for one topic: refused loudly at both, and nothing else is harmed."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING

import pytest

from lab.bed.processes import eventually
from tests.interop.modules import flows
from tests.interop.ros import lacks

if TYPE_CHECKING:
    from lab.bed.processes import Process
    from tests.interop.conftest import ModuleFactory
    from tests.interop.modules import Module

pytestmark = [
    pytest.mark.ros,
    pytest.mark.netns,
    pytest.mark.timeout(120),
    pytest.mark.skipif(bool(lacks("diagnostic_msgs")), reason=lacks("diagnostic_msgs")),
]

TOPIC = "/mixed"


def loud(module: Module, diagnostics: Process, wanted: str) -> None:
    """Fail unless a module says it in its log, in ``rmpa topic info`` and in /diagnostics."""
    module.agent.process.wait_for(rf"(?i)(warning|error).*{TOPIC}.*{wanted}")
    eventually(lambda: mismatches(module), what=f"a mismatch of {TOPIC} at {module.name}")
    assert wanted in " ".join(mismatches(module))
    code, shown = module.agent.rmpa("topic", "info", TOPIC)
    assert code == 0
    assert wanted in shown
    diagnostics.wait_for(rf"message: .*{wanted}", since=max(0, diagnostics.mark() - 1))


def mismatches(module: Module) -> list[str]:
    """What ``rmpa topic info`` says does not fit."""
    code, output = module.agent.rmpa("topic", "info", TOPIC, "--json")
    assert code == 0, output
    found: list[str] = json.loads(output)["mesh"]["mismatches"]
    return found


def mended(module: Module) -> None:
    """Wait until the mismatch is no longer reported."""
    eventually(lambda: not mismatches(module), what=f"nothing wrong at {module.name}")


def diagnostics(module: Module) -> Process:
    """/diagnostics as the stock tool prints it."""
    return module.ros.start("rostopic", "echo", "/diagnostics", name="diagnostics")


@pytest.mark.trap(1)
@pytest.mark.parametrize("kind", ["rospy", "roscpp"])
def test_another_md5_is_refused_at_both_ends(modules: ModuleFactory, kind: str) -> None:
    a, b = modules("a", "b")
    steady = b.ros.roscpp("listener", topic="/steady")
    a.ros.roscpp("talker", topic="/steady", rate=100, wait=1)
    a.ros.rospy("talker", topic=TOPIC, rate=50, another_md5=True, name="speaker")
    tells = [diagnostics(module) for module in (a, b)]
    b.wait_topic(TOPIC)
    heard = b.ros.node(kind, "listener", topic=TOPIC, name="wrong")
    heard.wait_event("up")
    for module, told in zip((a, b), tells, strict=True):
        loud(module, told, "md5sum")
    assert heard.events("first") == []
    # The listener leaves: nothing is wrong any more, at either end, and no other topic has noticed.
    heard.interrupt()
    for module in (a, b):
        mended(module)
    report = flows(steady, 50)
    assert (report["gaps"], report["doubled"], report["bad"]) == (0, 0, 0)


def test_another_type_is_refused_at_both_ends(modules: ModuleFactory) -> None:
    a, b = modules("a", "b")
    steady = b.ros.roscpp("listener", topic="/steady")
    a.ros.roscpp("talker", topic="/steady", rate=100, wait=1)
    at_home = b.ros.rospy("talker", topic=TOPIC, rate=50, type="String", name="texts")
    heard = b.ros.rospy("listener", topic=TOPIC, type="String")
    heard.wait_event("text")
    a.ros.roscpp("talker", topic=TOPIC, rate=50, name="bytes")
    tells = [diagnostics(module) for module in (a, b)]
    for module, told in zip((a, b), tells, strict=True):
        loud(module, told, "std_msgs/String")
    # The local topic is what it was: its type, its publishers, its messages.
    assert b.ros.tool("rostopic", "type", TOPIC).strip() == "std_msgs/String"
    assert "/rmpa/a/bytes" not in b.ros.tool("rostopic", "info", TOPIC)
    heard.wait_event("text", since=heard.mark_events())
    # The local publisher leaves: the remote one takes its place, and nothing is wrong any more.
    heard.interrupt()
    at_home.interrupt()
    eventually(lambda: "/rmpa/a/bytes" in b.ros.tool("rostopic", "info", TOPIC), what="the remote publisher")
    flows(b.ros.roscpp("listener", topic=TOPIC), 5)
    for module in (a, b):
        mended(module)
    report = flows(steady, 50)
    assert (report["gaps"], report["doubled"], report["bad"]) == (0, 0, 0)
