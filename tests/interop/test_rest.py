"""Agents whose links are at rest: a pause, a hang and a cut are told apart, at the documented pace."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING

import pytest

from lab.bed.processes import eventually
from tests.interop.modules import flows

if TYPE_CHECKING:
    from tests.interop.conftest import ModuleFactory
    from tests.interop.modules import Module

pytestmark = [pytest.mark.ros, pytest.mark.netns, pytest.mark.timeout(300)]

PAUSE, HANG = 5.0, 30.0
"""Seconds for which an agent is stopped: less than the lease of a link at rest, and more."""
SOON = 60.0
"""Seconds in which links rest, on a busy machine too; the protocol takes 5 to 10."""
NOTICED = 30.0
"""Seconds in which the silence of a link at rest is noticed, on a busy machine too; the protocol takes 11 to 16."""
IN_USE = 8.0
"""The same of a link in use, of which the protocol promises 1 s: less than any link at rest takes."""


def links(module: Module) -> dict[str, tuple[bool, float]]:
    """The links of a module by the name of the peer: whether it is at rest, and when it came up."""
    now = time.monotonic()
    peers = module.agent.snapshot().peers
    return {peer.name: (peer.link.rests, now - peer.link.up_ago) for peer in peers if peer.link is not None}


def wait_rest(*modules: Module) -> None:
    """Wait until all of these are linked with each other, and all links are at rest."""

    def rests() -> bool:
        found = [links(module) for module in modules]
        return all(len(one) == len(modules) - 1 and all(rest for rest, _ in one.values()) for one in found)

    eventually(rests, SOON, what="every link is at rest", every=0.5)


def wait_lost(module: Module, within: float, *peers: str) -> None:
    """Wait until a module has no link with any of these peers."""
    eventually(lambda: not links(module).keys() & {*peers}, within, what=f"{module.name} without {peers}", every=0.1)


def test_a_pause_a_hang_and_a_cut_at_rest(modules: ModuleFactory) -> None:
    a, b, c = modules("a", "b", "c")
    for module in (a, b, c):
        module.ros.roscpp("talker", topic=f"/of_{module.name}", rate=10)
    for module in (a, b, c):
        for other in (a, b, c):
            module.wait_topic(f"/of_{other.name}")
    wait_rest(a, b, c)

    before = links(a)
    b.agent.freeze()
    time.sleep(PAUSE)
    b.agent.thaw()
    code, answer = a.agent.rmpa("peer", "ping", "b", "-c", "1")
    assert code == 0, answer
    assert links(a)["b"][1] == pytest.approx(before["b"][1], abs=1.0), "a pause ends no link at rest"
    wait_rest(a, b, c)

    b.agent.freeze()
    c.host.cut()
    begun = time.monotonic()
    wait_lost(a, NOTICED, "b", "c")
    a.wait_no_topic("/of_b")
    a.wait_no_topic("/of_c")
    time.sleep(max(0.0, begun + HANG - time.monotonic()))
    b.agent.thaw()
    c.host.restore()
    for module in (a, b, c):
        for other in (a, b, c):
            module.wait_topic(f"/of_{other.name}")
    flows(a.ros.roscpp("listener", topic="/of_b"))
    flows(b.ros.roscpp("listener", topic="/of_c"))


def test_a_cut_in_use_is_noticed_at_once(modules: ModuleFactory) -> None:
    a, b = modules("a", "b")
    a.ros.roscpp("talker", topic="/chatter", rate=10)
    flows(b.ros.roscpp("listener", topic="/chatter"))
    a.host.cut()
    wait_lost(b, IN_USE, "a")
