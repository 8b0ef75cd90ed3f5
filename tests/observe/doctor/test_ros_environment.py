"""Variables that would mislead nodes; each of these has cost somebody an afternoon."""

from __future__ import annotations

from dataclasses import replace

import pytest

from rmpa.observe.doctor.machine import RosShell, judge_shell, names_of
from rmpa.observe.peer_info import Check, CheckLevel

SHELL = RosShell(
    environ={},
    host_name="base",
    addresses=frozenset({"127.0.0.1", "10.0.0.1"}),
    resolved={"base": ("127.0.1.1",), "robot2": ("10.0.0.2",), "base.local": ("10.0.0.1",)},
    cores={"base": "http://127.0.0.1:11311/"},
    domains={"base": 0},
)


def judged(shell: RosShell = SHELL, /, **environ: str) -> dict[str, Check]:
    found = {finding.where: finding for finding in judge_shell(replace(shell, environ=environ))}
    for finding in found.values():
        assert bool(finding.remedy) is (finding.level is not CheckLevel.OK), finding
    return found


def test_a_clean_shell() -> None:
    assert {finding.level for finding in judged().values()} == {CheckLevel.OK}


@pytest.mark.parametrize(
    ("uri", "level", "part"),
    [
        ("http://localhost:11311", CheckLevel.OK, "is the core of base"),
        ("http://127.0.0.1:11311/", CheckLevel.OK, "is the core of base"),
        ("http://10.0.0.1:11311", CheckLevel.OK, "is the core of base"),
        ("http://robot2:11311", CheckLevel.FAIL, "is another machine (10.0.0.2)"),
        ("http://10.0.0.7:11311", CheckLevel.FAIL, "is another machine"),
        ("http://nobody:11311", CheckLevel.FAIL, "the name nobody cannot be resolved"),
        (
            "http://localhost:11312",
            CheckLevel.WARN,
            "is not the core of an agent here (base's is http://127.0.0.1:11311/)",
        ),
        ("localhost:11311", CheckLevel.FAIL, "is not a master's URI"),
        ("http://localhost", CheckLevel.FAIL, "is not a master's URI"),
    ],
)
def test_ros_master_uri(uri: str, level: CheckLevel, part: str) -> None:
    found = judged(ROS_MASTER_URI=uri)["ROS_MASTER_URI"]
    assert found.level is level
    assert part in found.text


def test_ros_master_uri_without_an_agent() -> None:
    alone = replace(SHELL, cores={}, domains={})
    assert judged(alone)["ROS_MASTER_URI"].level is CheckLevel.OK
    found = judged(replace(alone, answers=True))["ROS_MASTER_URI"]
    assert found.level is CheckLevel.WARN
    assert "no agent of ours" in found.text


def test_ros_master_uri_of_a_roscore_that_the_agent_uses() -> None:
    alone = replace(SHELL, cores={}, domains={}, external="http://robot2:11311/", answers=True)
    found = judged(alone, ROS_MASTER_URI="http://robot2:11311")["ROS_MASTER_URI"]
    assert (found.level, "will use" in found.text) == (CheckLevel.OK, True)
    found = judged(replace(alone, answers=False), ROS_MASTER_URI="http://robot2:11311")["ROS_MASTER_URI"]
    assert (found.level, found.remedy) == (CheckLevel.WARN, "start it: roscore")
    running = replace(SHELL, cores={"base": "http://robot2:11311/"})
    assert judged(running, ROS_MASTER_URI="http://robot2:11311")["ROS_MASTER_URI"].level is CheckLevel.OK


@pytest.mark.parametrize(
    ("variable", "value", "level", "part"),
    [
        ("ROS_IP", "127.0.0.1", CheckLevel.OK, "is this machine"),
        ("ROS_IP", "10.0.0.1", CheckLevel.OK, "is this machine"),
        ("ROS_IP", "10.0.0.9", CheckLevel.FAIL, "is not an address of this machine"),
        ("ROS_IP", "base", CheckLevel.FAIL, "no IPv4 address"),
        ("ROS_HOSTNAME", "base.local", CheckLevel.OK, "is this machine"),
        ("ROS_HOSTNAME", "localhost", CheckLevel.OK, "is this machine"),
        ("ROS_HOSTNAME", "robot2", CheckLevel.FAIL, "is not an address of this machine"),
        ("ROS_HOSTNAME", "nobody", CheckLevel.FAIL, "the name nobody cannot be resolved"),
        ("ROS_HOSTNAME", "http://base:11311", CheckLevel.FAIL, "is a URI"),
    ],
)
def test_ros_hostname_and_ros_ip(variable: str, value: str, level: CheckLevel, part: str) -> None:
    found = judged(**{variable: value})[variable]
    assert found.level is level
    assert part in found.text


def test_ros_ip_beside_ros_hostname() -> None:
    found = judged(ROS_IP="10.0.0.1", ROS_HOSTNAME="base.local")
    assert found["ROS_IP"].level is CheckLevel.WARN
    assert found["ROS_HOSTNAME"].level is CheckLevel.OK


@pytest.mark.parametrize(
    ("addresses", "level"),
    [(("127.0.1.1",), CheckLevel.OK), (("10.0.0.9",), CheckLevel.FAIL), ((), CheckLevel.FAIL)],
)
def test_the_host_name_counts_without_variables(addresses: tuple[str, ...], level: CheckLevel) -> None:
    shell = replace(SHELL, resolved={"base": addresses})
    assert judged(shell)["host name"].level is level
    assert "host name" not in judged(shell, ROS_IP="127.0.0.1")


@pytest.mark.parametrize(
    ("value", "level"),
    [("0", CheckLevel.OK), ("7", CheckLevel.WARN), ("233", CheckLevel.FAIL), ("x", CheckLevel.FAIL)],
)
def test_domain(value: str, level: CheckLevel) -> None:
    assert judged(ROS_DOMAIN_ID=value)["ROS_DOMAIN_ID"].level is level


@pytest.mark.parametrize(
    ("variable", "value"),
    [
        ("ROS_LOCALHOST_ONLY", "1"),
        ("ROS_AUTOMATIC_DISCOVERY_RANGE", "OFF"),
        ("ROS_AUTOMATIC_DISCOVERY_RANGE", "localhost"),
        ("ROS_NAMESPACE", "/robot"),
    ],
)
def test_other_misleading_variables(variable: str, value: str) -> None:
    assert judged(**{variable: value})[variable].level is CheckLevel.WARN


def test_names_to_resolve() -> None:
    assert names_of({"ROS_MASTER_URI": "http://robot2:11311", "ROS_HOSTNAME": "10.0.0.1"}, "base") == (
        "robot2",
        "base",
    )
    assert names_of({"ROS_MASTER_URI": "nonsense"}, "base") == ("base",)
