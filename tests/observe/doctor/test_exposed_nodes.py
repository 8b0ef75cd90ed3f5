"""What ``rmpa doctor`` says of nodes that other machines reach past the agent."""

from __future__ import annotations

import pytest

from rmpa.observe.doctor.agents import is_beyond_loopback, judge_exposed_nodes
from rmpa.observe.peer_info import CheckLevel


def test_without_trust_no_ports_are_listed() -> None:
    assert judge_exposed_nodes("base", None, trusted=False).level is CheckLevel.SKIPPED


def test_a_secured_module_is_told_its_open_ports_and_how_to_close_them() -> None:
    found = judge_exposed_nodes("base", {"/talker": (40001, 40002), "/camera": (5,)}, trusted=True)
    assert found.level is CheckLevel.WARN
    assert "/camera (5), /talker (40001, 40002)" in found.text
    assert "ROS_IP=127.0.0.1" in found.remedy
    assert "direct transport" not in found.remedy
    assert "direct transport" in judge_exposed_nodes("base", {"/a": (1,)}, trusted=True, direct=True).remedy
    many = judge_exposed_nodes("base", {f"/n{number}": (number,) for number in range(9)}, trusted=True)
    assert "/n4 (4) and 4 more" in many.text


def test_nodes_on_loopback_are_fine_and_what_is_not_known_is_not_judged() -> None:
    assert judge_exposed_nodes("base", {}, trusted=True).level is CheckLevel.OK
    assert judge_exposed_nodes("base", None, trusted=True).level is CheckLevel.SKIPPED


@pytest.mark.parametrize(
    ("address", "beyond"),
    [("127.0.0.1", False), ("127.1.2.3", False), ("::1", False), ("0.0.0.0", True), ("::", True), ("10.0.0.1", True)],
)
def test_loopback(address: str, beyond: bool) -> None:
    assert is_beyond_loopback(address) is beyond
