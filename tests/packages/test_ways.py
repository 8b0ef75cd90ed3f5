"""Each way to install, from a new machine to nodes of two client libraries on machines of different releases."""

from __future__ import annotations

import re

import pytest

from tests.interop.modules import whole
from tests.packages.conftest import LINKED, Team, around
from tests.packages.ways import USER

pytestmark = [pytest.mark.packages, pytest.mark.timeout(900)]


def test_the_first_message_comes_within_two_minutes(team: Team) -> None:
    assert team.seconds["all"] <= 120.0


def test_rospy_and_roscpp_of_different_releases_hear_each_other(team: Team) -> None:
    heard = []
    for number, (one, other) in enumerate(around(team)):
        for source, sink, client, server in ((one, other, "rospy", "roscpp"), (other, one, "roscpp", "rospy")):
            topic = f"/{client}{number}"
            heard.append(sink.node(server, "listener", topic=topic, count=100))
            source.node(client, "talker", topic=topic, rate=100, count=100, size=3000, wait=1)
    for listener in heard:
        whole(listener.wait_event("done", 60.0), 100)


def test_stock_tools_see_the_topic_of_the_other_machine(team: Team) -> None:
    talker, machine = team.machines[:2]
    assert "/hello" in machine.run("rostopic", "list", user=USER).split()
    assert talker.host.name in machine.run("rostopic", "info", "/hello", user=USER)
    rate = machine.start("rostopic", "hz", "/hello", user=USER).wait_for(r"average rate: ([\d.]+)", 40.0).group(1)
    assert 5.0 < float(rate) < 15.0


def test_it_says_its_version_and_its_peers(team: Team) -> None:
    for machine in team.machines:
        assert re.match(r"rmpa \d+\.\d+\.\d+", team.rmpa(machine, "--version"))
        peers = team.rmpa(machine, "peer", "list")
        assert all(other.host.name in peers for other in team.machines if other is not machine)


def test_doctor_finds_nothing_wrong_but_the_clock(team: Team) -> None:
    for machine in team.machines:
        said = team.rmpa(machine, "doctor").splitlines()
        wrong = [line for line in said if line.startswith(("warn", "fail"))]
        assert [line for line in wrong if not line.startswith("warn     clock synchronised")] == [], "\n".join(said)


def test_a_machine_that_starts_again_is_linked_again(team: Team) -> None:
    machine, *others = team.machines
    marks = {other: team.agents[other].mark() for other in others}
    team.down(machine)
    team.up(machine)
    for other, mark in marks.items():
        team.agents[other].wait_for(LINKED.format(machine.host.name), 60.0, since=mark)
