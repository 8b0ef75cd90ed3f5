"""Pairs of types: by name, and by ros1_bridge's mapping files."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

from rmpa.core.errors import ConfigError
from rmpa.gateway.ros2.pairs import TypeMapping
from rmpa.gateway.ros2.types import TypePair

if TYPE_CHECKING:
    from pathlib import Path

RULES = """
- ros1_package_name: arm_msgs
  ros2_package_name: arm_interfaces
- ros1_package_name: arm_msgs
  ros1_message_name: Joint
  ros2_package_name: control_msgs
  ros2_message_name: JointState
  fields_1_to_2:
    header.stamp: stamp
    angle: position
- ros1_package_name: arm_msgs
  ros1_service_name: Home
  ros2_package_name: arm_interfaces
  ros2_service_name: GoHome
  request_fields_1_to_2: {fast: quick}
"""
PAIR = "ros1_package_name: a, ros2_package_name: b, ros1_message_name: C, ros2_message_name: D"
NAMES = "arm_interfaces/msg/Grip std_msgs/msg/String other_interfaces/msg/Thing control_msgs/msg/JointState"
KNOWN = set(NAMES.split())


@pytest.fixture
def mapping(tmp_path: Path) -> TypeMapping:
    made = TypeMapping()
    (tmp_path / "rules.yaml").write_text(RULES)
    made.read(tmp_path / "rules.yaml")
    return made


def test_types_of_one_name_are_a_pair_and_packages_that_end_in_msgs_also_fit_interfaces() -> None:
    assert TypeMapping().message("std_msgs/String", KNOWN) == TypePair("std_msgs/msg/String")
    assert TypeMapping().message("std_msgs/Nothing", KNOWN) is None
    assert TypeMapping().message("other_msgs/Thing", KNOWN) == TypePair("other_interfaces/msg/Thing")


def test_rules_for_packages_messages_and_fields(mapping: TypeMapping) -> None:
    assert mapping.message("arm_msgs/Grip", KNOWN) == TypePair("arm_interfaces/msg/Grip")
    fields = {"header.stamp": "stamp", "angle": "position"}
    assert mapping.message("arm_msgs/Joint", KNOWN) == TypePair("control_msgs/msg/JointState", {"": fields})


def test_rules_for_services(mapping: TypeMapping) -> None:
    for name, ros2, *paths in (
        ("arm_msgs/Home", "arm_interfaces/srv/GoHome", {"request": {"fast": "quick"}}),
        ("arm_msgs/Stop", "arm_interfaces/srv/Stop"),
        ("std_srvs/Trigger", "std_srvs/srv/Trigger"),
    ):
        assert mapping.counterpart(name, "srv") == TypePair(ros2, *paths)


def test_the_way_back(mapping: TypeMapping) -> None:
    assert mapping.ros1_type("std_msgs/msg/String") == "std_msgs/String"
    assert mapping.ros1_type("control_msgs/msg/JointState") == "arm_msgs/Joint"
    assert mapping.ros1_type("arm_interfaces/msg/Grip") == "arm_msgs/Grip"
    assert mapping.ros1_type("rcl_interfaces/msg/Log") == "rosgraph_msgs/Log"
    assert mapping.ros1_type("arm_interfaces/srv/GoHome") == "arm_msgs/Home"
    assert mapping.ros1_type("tf2_msgs/msg/TFMessage", ["tf2_msgs/TFMessage"]) == "tf2_msgs/TFMessage"


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ("a: 1", "is not a list"),
        ("- 3", "rule 1 is not a mapping"),
        ("- {ros1_package_name: a}", "needs ros1_package_name and ros2_package_name"),
        ("- {ros1_package_name: a, ros2_package_name: 3}", "has no text as ros2_package_name"),
        ("- {ros1_package_name: a, ros2_package_name: b, ros1_message_name: C}", "needs both"),
        ("- {ros1_package_name: a, ros2_package_name: b, field: C}", "unknown key 'field'"),
        ("- {ros1_package_name: a, ros2_package_name: b, fields_1_to_2: {a: b}}", "names no message"),
        (f"- {{{PAIR}, fields_1_to_2: 3}}", "no mapping of fields"),
        ("- {ros1_package_name: '', ros2_package_name: b, ros1_message_name: C, ros2_message_name: D}", "not a name"),
        ("- [", "cannot be read"),
    ],
)
def test_a_wrong_file_is_refused_with_the_rule(tmp_path: Path, text: str, problem: str) -> None:
    path = tmp_path / "rules.yaml"
    path.write_text(text)
    with pytest.raises(ConfigError, match=problem) as caught:
        TypeMapping().read(path)
    assert str(path) in str(caught.value)
    with pytest.raises(ConfigError, match="cannot be read"):
        TypeMapping().read(tmp_path / "none.yaml")
