"""What crosses between two sites beside topics: parameters, Smart Resources; and what the tools tell.

The sites are those of ``test_sites``. The tests share one set of processes; each leaves it as it was.
"""

from __future__ import annotations

import json
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import pytest

from lab.bed.agents import RMPA
from lab.bed.namespaces import Lab
from lab.bed.processes import Process, eventually
from tests.interop.ros import Ros
from tests.interop.sites import JoinedModules, join

if TYPE_CHECKING:
    from collections.abc import Iterator

    from lab.bed.agents import Agent
    from lab.bed.namespaces import Host

pytest.importorskip("zenoh", reason="the extra rmpa[zenoh] is not installed")
pytestmark = [pytest.mark.ros, pytest.mark.nat, pytest.mark.timeout(180)]

LONG: Final = 40.0
LAMP: Final = Path(__file__).parent / "resources" / "lamp.py"
RULES: Final = '[[gateway.rule]]\nnames = ["/secret/**"]\ncrossing = "none"\n'
"""Of both gateways."""


@pytest.fixture(scope="module")
def joined(tmp_path_factory: pytest.TempPathFactory) -> Iterator[JoinedModules]:
    """Both sites with their modules, gateways and shells."""
    with ExitStack() as stack:
        lab = stack.enter_context(Lab())
        home = tmp_path_factory.mktemp("values")

        def shell(host: Host) -> Ros:
            return stack.enter_context(Ros(host, home, 11311))

        yield join(lab, home, shell, stack, config=RULES)


def does(agent: Agent, *words: str) -> str:
    """Run a command of rmpa that has to succeed; return its output."""
    code, output = agent.rmpa(*words, timeout=LONG)
    assert code == 0, f"rmpa {' '.join(words)}: {output}"
    return output


def fails(agent: Agent, *words: str) -> str:
    """Run a command of rmpa that has to fail; return its output."""
    code, output = agent.rmpa(*words, timeout=LONG)
    assert code == 1, f"rmpa {' '.join(words)}: {output}"
    return output


def test_parameters_of_another_site_are_read_set_and_refused_by_rules(joined: JoinedModules) -> None:
    arm, base = joined.arm.agent, joined.base.agent
    does(arm, "param", "set", "/speed", "1.5")
    does(arm, "param", "set", "/secret/key", "42")
    there = ("--peer", "warehouse/arm")
    assert does(base, "param", "get", *there, "/speed").strip() == "1.5"
    does(base, "param", "set", *there, "/gains", "{p: 1, i: [2, 3]}")
    assert does(arm, "param", "get", "/gains/i").split() == ["-", "2", "-", "3"]
    names = does(base, "param", "list", *there).split()
    assert "/speed" in names
    assert "/secret/key" not in names
    assert "gateway.rule 1" in fails(base, "param", "get", *there, "/secret/key")
    assert "gateway.rule 1" in fails(base, "param", "set", *there, "/secret/key", "0")
    assert does(arm, "param", "get", "/secret/key").strip() == "42"
    assert "there is no parameter /none" in fails(base, "param", "get", *there, "/none")
    assert "no module answers at site warehouse as 'leg'" in fails(
        base, "param", "get", "--peer", "warehouse/leg", "/x"
    )
    does(base, "param", "delete", *there, "/gains")
    fails(arm, "param", "get", "/gains")


def test_smart_resources_of_another_site_are_listed_and_set(joined: JoinedModules) -> None:
    arm, base = joined.arm.agent, joined.base.agent
    arm.kill()
    argv: list[str | Path] = [RMPA, "run", LAMP, "--name", arm.name]
    lamp = Process(joined.arm.host.command(argv), env=arm.env, name="lamp")
    try:
        lamp.wait_for("active on", LONG)

        def listed() -> dict[str, Any] | None:
            rows = json.loads(does(base, "resource", "list", "--json"))
            return next((row for row in rows if row["name"] == "/lamp" and row["state"] == "active"), None)

        row = eventually(listed, LONG, what="the lamp at base", every=0.5)
        assert row is not None
        assert (row["peer"], row["role"]) == ("warehouse/arm", "acting")
        assert "warehouse/arm:/lamp" in does(base, "resource", "list")
        assert "of module warehouse/arm" in does(base, "resource", "info", "warehouse/arm:/lamp")
        does(base, "profile", "set", "warehouse/arm:/lamp", "slow")
        assert does(base, "profile", "get", "warehouse/arm:/lamp").strip() == "slow"
    finally:
        lamp.end()
        print(lamp.output[-4000:])
        arm.restart()
        arm.wait_peer(joined.warehouse.gateway.name)


def test_why_names_the_hop_and_the_rule(joined: JoinedModules) -> None:
    base = joined.base.agent
    with (
        joined.arm.ros.rospy("talker", "__name:=told", topic="/told", rate=20) as told,
        joined.arm.ros.rospy("talker", "__name:=spy", topic="/secret/word", rate=20) as spy,
    ):
        told.wait_event("up")
        spy.wait_event("up")
        joined.base.wait_topic("/told")
        output = fails(base, "why", "warehouse/arm:/told")
        assert "/told of /told from warehouse/arm to site yard" in output
        assert "no node of this site subscribes" in output
        output = fails(base, "why", "warehouse/arm:/secret/word")
        assert "it stops at: rule there" in output
        assert "gateway.rule 1 (none: /secret/**)" in output
        output = fails(base, "why", "warehouse/arm:/none")
        assert "no node of arm at warehouse has /none" in output
        assert "no gateway of a site moon" in fails(base, "why", "moon/arm:/none")


def test_a_site_that_is_cut_off_is_told_of_as_unreachable(joined: JoinedModules) -> None:
    base = joined.base.agent
    joined.warehouse.network.cut()
    try:
        eventually(lambda: "unreachable" in base.rmpa("site", "list")[1], LONG, what="unreachable", every=0.5)
        assert "site warehouse is unreachable since" in fails(base, "why", "warehouse/arm:/told")
        assert "site warehouse is unreachable since" in fails(base, "why", "/told"), "whose it was need not be known"
        fails(base, "site", "info", "warehouse")
    finally:
        joined.warehouse.network.restore()
    eventually(lambda: base.rmpa("site", "list")[0] == 0, LONG, what="joined again", every=0.5)
