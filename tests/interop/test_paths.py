"""A source keeps its numbers whichever way it takes: cables and relays come and go, and addresses change.

What is counted is what a listener at ``m4`` got of a talker at ``m1``, over their own cable or by ``m2`` or ``m3``.
"""

from __future__ import annotations

import random
import subprocess
import time
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, Any, Final

import pytest

from lab.bed.processes import eventually
from tests.interop.modules import Module, flows
from tests.interop.test_subnetworks import RELAY, full_mesh

if TYPE_CHECKING:
    from collections.abc import Callable

    from lab.bed.namespaces import Host, Lab
    from lab.bed.processes import Event
    from tests.interop.conftest import AgentFactory, ShellFactory

pytestmark = [pytest.mark.ros, pytest.mark.netns, pytest.mark.timeout(900)]

SURE: Final = '[[contract]]\ntopics = ["/sure", "/map"]\nreliability = "reliable"\ndepth = 5000\n'
DIRECT, FIRST, SECOND = 0, 1, 2
"""The cable of m1 and m4, and those of the relays m2 and m3 with both: their networks are 1 and 2, and 3 and 4."""


class Triangle:
    """Two modules, a cable between them, and two relays; those that are left out begin without their cables."""

    def __init__(
        self, lab: Lab, agent: AgentFactory, shell: ShellFactory, *, unplugged: tuple[int, ...] = ()
    ) -> None:
        def module(name: str, *networks: int) -> Module:
            host = lab.host(name, *networks)
            self.cables[name] = {network: place for place, network in enumerate(networks)}
            for network in networks:
                if self.way(network) in unplugged:
                    host.cut(self.cables[name][network])
            return Module(
                host, agent(host, name=name, config=SURE + (RELAY if name in {"m2", "m3"} else "")), shell(host)
            )

        self.cables: dict[str, dict[int, int]] = {}
        self.m1, self.m4 = module("m1", 0, 1, 3), module("m4", 0, 2, 4)
        self.m2, self.m3 = module("m2", 1, 2), module("m3", 3, 4)
        for way, relay in ((FIRST, self.m2), (SECOND, self.m3)):
            if way not in unplugged:
                full_mesh(relay, self.m1)
                full_mesh(relay, self.m4)
        if DIRECT not in unplugged:
            full_mesh(self.m1, self.m4)
        self.heard = {topic: self.m4.ros.roscpp("listener", f"__name:={topic[1:]}", topic=topic) for topic in TOPICS}
        for topic, options in TOPICS.items():
            self.m1.ros.roscpp("talker", f"__name:={topic[1:]}_talker", topic=topic, **options)
        flows(self.heard["/sure"], 50)
        eventually(lambda: self.heard["/map"].events("report"), what="the map")

    @staticmethod
    def way(network: int) -> int:
        return (network + 1) // 2

    def _each(self, way: int) -> list[tuple[Module, int]]:
        modules = (self.m1, self.m2, self.m3, self.m4)
        return [(m, place) for m in modules for net, place in self.cables[m.name].items() if self.way(net) == way]

    def cut(self, way: int) -> None:
        for module, place in self._each(way):
            module.host.cut(place)

    def restore(self, way: int) -> None:
        for module, place in self._each(way):
            module.host.restore(place)

    def via(self) -> str:
        """By which relay the source comes, or nothing for its own cable."""
        return str(self.m4.agent.peers().get("m1", {}).get("via", ""))

    def after(self, act: Callable[[], object], more: int = 150) -> tuple[Event, float]:
        """What the listener says after something has happened, and for how long it got nothing at most."""
        sure = self.heard["/sure"]
        since = sure.mark_events()
        began = time.monotonic()
        act()
        report = flows(sure, more)
        assert (report["bad"], report["gaps"], report["doubled"]) == (0, 0, 0), report
        maps = self.heard["/map"].events("report")[-1]
        assert (maps["count"], maps["doubled"]) == (1, 0), maps
        took = time.monotonic() - began
        print(f"{took:.1f} s for {more} messages; best effort {self.heard['/plain'].events('report')[-1]}", since)
        return report, took


TOPICS: Final[dict[str, dict[str, Any]]] = {
    "/sure": {"rate": 50},
    "/plain": {"rate": 50},
    "/map": {"rate": 50, "count": 1, "latch": True},
}


def readdress(host: Host, place: int, last: int, before: float = 0.0) -> None:
    """Give a host another address on one cable; the new one may be there for a while before the old one goes."""
    cable = host.cables[place]
    old, new = cable.address, f"{cable.address.rpartition('.')[0]}.{last}"
    # Else the kernel takes the second address of a network away with the first one.
    keep = f"net.ipv4.conf.{cable.interface}.promote_secondaries=1"
    subprocess.run(host.command(["sysctl", "-qw", keep]), check=True)
    if not before:
        host.ip("address", "del", f"{old}/24", "dev", cable.interface)
    host.ip("address", "add", f"{new}/24", "dev", cable.interface)
    if before:
        time.sleep(before)
        host.ip("address", "del", f"{old}/24", "dev", cable.interface)
    host.cables[place] = replace(cable, address=new)


def test_a_relay_takes_over_at_once_when_a_cable_is_pulled(
    lab: Lab, agent: AgentFactory, shell: ShellFactory
) -> None:
    triangle = Triangle(lab, agent, shell, unplugged=(SECOND,))
    assert triangle.via() == ""
    _, took = triangle.after(lambda: triangle.cut(DIRECT))
    assert took < 20.0, "without an outage's 30 s"
    assert triangle.via() == "m2"
    triangle.after(lambda: triangle.restore(DIRECT), 300)
    eventually(lambda: triangle.via() == "", what="the cable is used again")
    triangle.after(lambda: None)


def test_a_way_that_joins_is_taken_without_a_break(lab: Lab, agent: AgentFactory, shell: ShellFactory) -> None:
    triangle = Triangle(lab, agent, shell, unplugged=(DIRECT, SECOND))
    assert triangle.via() == "m2"
    triangle.after(lambda: triangle.restore(SECOND), 300)
    triangle.after(lambda: triangle.restore(DIRECT), 300)
    eventually(lambda: triangle.via() == "", what="the cable is used")
    triangle.after(lambda: None)


def test_a_relay_that_leaves_takes_nothing_along(lab: Lab, agent: AgentFactory, shell: ShellFactory) -> None:
    triangle = Triangle(lab, agent, shell, unplugged=(DIRECT,))
    used, other = (triangle.m2, "m3") if triangle.via() == "m2" else (triangle.m3, "m2")
    triangle.after(used.agent.terminate, 300)
    assert triangle.via() == other


@pytest.mark.parametrize("who", ["m1", "m4"])
@pytest.mark.parametrize("before", [0.0, 3.0])
def test_an_address_that_changes_loses_nothing(
    lab: Lab, agent: AgentFactory, shell: ShellFactory, who: str, before: float
) -> None:
    """As DHCP does it; also when the new address is there before the old one goes."""
    triangle = Triangle(lab, agent, shell, unplugged=(FIRST, SECOND))
    module = triangle.m1 if who == "m1" else triangle.m4
    triangle.after(lambda: readdress(module.host, 0, 77, before), 300)


@pytest.mark.parametrize("seconds", [30.0, pytest.param(600.0, marks=pytest.mark.long)])
def test_cables_relays_and_addresses_change_at_random(
    lab: Lab, agent: AgentFactory, shell: ShellFactory, seconds: float
) -> None:
    """A way is left at any time, so nothing may be lost."""
    triangle, rng = Triangle(lab, agent, shell), random.Random(seconds)
    out: set[int] = set()
    addresses, until = 100, time.monotonic() + seconds
    while time.monotonic() < until:
        relay = rng.choice([triangle.m2, triangle.m3])
        way = rng.choice([DIRECT, FIRST, SECOND])
        match rng.randrange(5):
            case 0:
                addresses += 1
                module = rng.choice([triangle.m1, triangle.m4])
                triangle.after(partial(readdress, module.host, rng.randrange(3), addresses), 50)
            case 1 if not out:
                triangle.after(relay.agent.terminate, 150)
                relay.agent.restart()
            case _ if way in out:
                out.remove(way)
                triangle.after(partial(triangle.restore, way), rng.choice([10, 100, 300]))
            case _ if len(out) < 2:
                out.add(way)
                triangle.after(partial(triangle.cut, way), rng.choice([10, 100, 300]))
    for way in out:
        triangle.restore(way)
    triangle.after(lambda: None, 300)
