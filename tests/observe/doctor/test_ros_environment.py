"""Variables that would mislead nodes; each of these has cost somebody an afternoon."""

from __future__ import annotations

from dataclasses import replace

import pytest

from rmpa.observe.check import CheckLevel
from rmpa.observe.doctor.machine import RosShell, judge_shell, names_of

SHELL = RosShell(
    environ={},
    host_name="base",
    addresses=frozenset({"127.0.0.1", "10.0.0.1"}),
    resolved={"base": ("127.0.1.1",), "robot2": ("10.0.0.2",), "base.local": ("10.0.0.1",)},
    cores={"base": "http://127.0.0.1:11311/"},
    domains={"base": 0},
)


ALONE = replace(SHELL, cores={}, domains={})
EXTERNAL = replace(ALONE, external="http://robot2:11311/", answers=True)


def shell(shell: RosShell = SHELL, /, **environ: str) -> RosShell:
    return replace(shell, environ=environ)


SHELLS: dict[str, RosShell] = {
    "clean": shell(),
    "ok, the core": shell(ROS_MASTER_URI="http://localhost:11311"),
    "ok, the core by its address": shell(
        ROS_MASTER_URI="http://10.0.0.1:11311", ROS_IP="127.0.0.1", ROS_DOMAIN_ID="0"
    ),
    "ok, the core of a roscore": shell(
        replace(SHELL, cores={"base": "http://robot2:11311/"}), ROS_MASTER_URI="http://robot2:11311"
    ),
    "fail, another machine": shell(ROS_MASTER_URI="http://robot2:11311"),
    "fail, another address": shell(ROS_MASTER_URI="http://10.0.0.7:11311"),
    "fail, no such name": shell(ROS_MASTER_URI="http://nosuch:11311"),
    "warn, another port": shell(ROS_MASTER_URI="http://localhost:11312"),
    "fail, no URI": shell(ROS_MASTER_URI="localhost:11311"),
    "fail, no port": shell(ROS_MASTER_URI="http://localhost"),
    "ok, no agent": shell(ALONE),
    "warn, a roscore without an agent": shell(replace(ALONE, answers=True)),
    "ok, a roscore for the agent": shell(EXTERNAL, ROS_MASTER_URI="http://robot2:11311"),
    "warn, a roscore that does not run": shell(
        replace(EXTERNAL, answers=False), ROS_MASTER_URI="http://robot2:11311"
    ),
    "ok, ROS_IP": shell(ROS_IP="10.0.0.1"),
    "fail, ROS_IP of another machine": shell(ROS_IP="10.0.0.9"),
    "fail, ROS_IP with a name": shell(ROS_IP="base"),
    "ok, ROS_HOSTNAME": shell(ROS_HOSTNAME="base.local"),
    "ok, localhost": shell(ROS_HOSTNAME="localhost"),
    "fail, ROS_HOSTNAME of another machine": shell(ROS_HOSTNAME="robot2"),
    "fail, ROS_HOSTNAME that is unknown": shell(ROS_HOSTNAME="nosuch"),
    "fail, ROS_HOSTNAME with a URI": shell(ROS_HOSTNAME="http://base:11311"),
    "warn, both": shell(ROS_IP="10.0.0.1", ROS_HOSTNAME="base.local"),
    "ok, the host's name": replace(SHELL, resolved={"base": ("127.0.1.1",)}),
    "fail, the host's name is another machine's": replace(SHELL, resolved={"base": ("10.0.0.9",)}),
    "fail, the host's name is unknown": replace(SHELL, resolved={}, host_name="odd"),
    "ok, a domain": shell(ROS_DOMAIN_ID="0"),
    "warn, another domain": shell(ROS_DOMAIN_ID="7"),
    "fail, a domain beyond": shell(ROS_DOMAIN_ID="233"),
    "fail, no domain": shell(ROS_DOMAIN_ID="x"),
    "warn, ROS 2": shell(ROS_LOCALHOST_ONLY="1"),
    "warn, no beacons": shell(ROS_AUTOMATIC_DISCOVERY_RANGE="OFF"),
    "warn, this machine alone": shell(ROS_AUTOMATIC_DISCOVERY_RANGE="localhost"),
    "warn, a namespace": shell(ROS_NAMESPACE="/robot"),
}


@pytest.mark.parametrize(("name", "shell"), SHELLS.items(), ids=SHELLS)
def test_a_shell_is_as_bad_as_its_worst_variable(name: str, shell: RosShell) -> None:
    """The golden file has what is said of each variable."""
    found = [*judge_shell(shell)]
    worst = max((each.level for each in found), key=[CheckLevel.OK, CheckLevel.WARN, CheckLevel.FAIL].index)
    assert worst == name.partition(",")[0].replace("clean", "ok")
    assert all(bool(each.remedy) is (each.level is not CheckLevel.OK) for each in found)


def test_names_to_resolve() -> None:
    assert names_of({"ROS_MASTER_URI": "http://robot2:11311", "ROS_HOSTNAME": "10.0.0.1"}, "base") == (
        "robot2",
        "base",
    )
    assert names_of({"ROS_MASTER_URI": "nonsense"}, "base") == ("base",)
