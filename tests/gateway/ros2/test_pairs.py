"""Which type and which service of ROS 2 is which of ROS 1."""

from __future__ import annotations

from pathlib import Path

import pytest

from rmpa.core.errors import ConfigError
from rmpa.gateway.ros2.conversion import NoConversion
from rmpa.gateway.ros2.pairs import Ros2Pairs, ServicePair, TypeMapping, derive_ros1
from rmpa.gateway.ros2.services import without_use
from rmpa.gateway.ros2.types import Ros2Types, TypePair
from rmpa.ros.types.definitions import known_types
from rmpa.ros.types.installed import ServiceType, known_services
from rmpa.ros.types.messages import MessageType

JAZZY = Ros2Types("jazzy")
DIFFER = {
    "sensor_msgs/BatteryState", "sensor_msgs/CameraInfo", "sensor_msgs/Range", "shape_msgs/SolidPrimitive",
    "stereo_msgs/DisparityImage", "visualization_msgs/ImageMarker", "rosgraph_msgs/Log", "sensor_msgs/NavSatStatus",
    "visualization_msgs/Marker", "std_msgs/Header", "std_msgs/Char",
}  # fmt: skip
"""Types whose fields or constants are not the same in Noetic and Jazzy."""


def name1(name: str) -> str:
    return TypeMapping().ros1_type(name, known_types())


def test_the_ros1_form_of_ros2s_types_is_noetics_where_both_have_the_type() -> None:
    times = ("builtin_interfaces/msg/Time", "builtin_interfaces/msg/Duration")
    made = {kind.name: kind for each in JAZZY.store.fielddefs if each not in times
            for kind in [derive_ros1(JAZZY.store, each, name1)]}  # fmt: skip
    known = {name for name in made if name in known_types()}
    assert len(known) > 100
    assert {name for name in known if made[name].md5sum != MessageType(name).md5sum} == DIFFER


def pairs(mapping: TypeMapping | None = None) -> Ros2Pairs:
    return Ros2Pairs(Ros2Types("jazzy"), mapping or TypeMapping(), MessageType)


def test_a_type_of_this_machine_makes_the_same_type_of_ros2_known() -> None:
    kind = MessageType.learn("arm_msgs/Grip", "float64 width")
    known = Ros2Types("jazzy")
    known.learn(kind.specifications)
    made = Ros2Pairs(Ros2Types("jazzy"), TypeMapping(), {"arm_msgs/Grip": kind}.__getitem__)
    assert made.incoming("arm_msgs/msg/Grip", "RIHS01_" + "0" * 64) is None, "its fields differ there"
    assert made.incoming("arm_msgs/msg/Grip", known.type_hash("arm_msgs/msg/Grip")) is not None


def test_a_rule_to_a_type_that_is_not_known_says_what_to_do(tmp_path: Path) -> None:
    rules = tmp_path / "rules.yaml"
    rules.write_text(
        "- {ros1_package_name: a_msgs, ros1_message_name: A, ros2_package_name: b_msgs, ros2_message_name: B}"
    )
    mapping = TypeMapping()
    mapping.read(rules)
    with pytest.raises(NoConversion, match="get_type_description"):
        pairs(mapping).ros2_type("a_msgs/A")


def test_a_definition_that_ros2_cannot_have_is_no_pair() -> None:
    with pytest.raises(NoConversion, match="no form in ROS 2"):
        pairs().learn(MessageType.learn("arm_msgs/Odd", "float64 fooBar\nfloat64 foo_bar"))


# --- Pairs of types -------------------------------------------------------------------------------------------------

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
RULED = "ros1_package_name: a, ros2_package_name: b, ros1_message_name: C, ros2_message_name: D"
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
        (f"- {{{RULED}, fields_1_to_2: 3}}", "no mapping of fields"),
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


MAPPING = TypeMapping()
PUBLISHED = {
    "std_srvs/Trigger": "RIHS01_eeff2cd6fa5ad9d27cdf4dec64818317839b62f212a91e6b5304b634b2062c5f",
    "rospy_tutorials/AddTwoInts": "RIHS01_e118de6bf5eeb66a2491b5bda11202e7b68f198d6f67922cf30364858239c81a",
}


@pytest.fixture(scope="module")
def jazzy() -> Ros2Types:
    return Ros2Types("jazzy")


def pair(name: str, types: Ros2Types) -> ServicePair:
    return ServicePair(ServiceType(name), MAPPING.counterpart(name, "srv"), types)


@pytest.mark.parametrize("name", sorted(PUBLISHED))
def test_the_hash_is_the_one_that_ros2_publishes(jazzy: Ros2Types, name: str) -> None:
    assert pair(name, jazzy).type_hash == PUBLISHED[name]


@pytest.mark.parametrize("name", known_services())
def test_the_calls_of_each_known_service_go_there_and_back(jazzy: Ros2Types, name: str) -> None:
    made = pair(name, jazzy)
    for conversion, kind in ((made.request, made.ros1.request), (made.response, made.ros1.response)):
        raw = kind.serialize(kind.make(None))
        assert conversion.to_ros1(conversion.to_ros2(raw)) == raw


def test_a_request_without_fields_has_the_five_bytes_of_ros2_and_a_response_its_cdr(jazzy: Ros2Types) -> None:
    made = pair("std_srvs/Trigger", jazzy)
    assert made.request.to_ros2(b"") == b"\x00\x01\x00\x00\x00"
    assert made.request.to_ros1(b"\x00\x01\x00\x00\x00") == b""
    kind = made.ros1.response
    cdr = made.response.to_ros2(kind.serialize(kind.make({"success": True, "message": "ok"})))
    assert cdr == b"\x00\x01\x00\x00" + b"\x01\x00\x00\x00" + b"\x03\x00\x00\x00ok\x00"


def test_a_rule_with_fields_of_an_unknown_type_is_refused_with_what_to_do(jazzy: Ros2Types) -> None:
    ros1 = ServiceType("robot_srvs/Sum", "int64 left\n---\nint64 all\n")
    with pytest.raises(NoConversion, match=r"other_srvs/srv/Sum.*workspace"):
        ServicePair(ros1, TypePair("other_srvs/srv/Sum", {"request": {"left": "a"}}), jazzy)


def test_services_that_the_other_side_cannot_use_are_left_out_with_a_reason() -> None:
    for found, why in (
        (without_use("roscpp/SetLoggerLevel"), "loggers"),
        (without_use("std_srvs/Trigger"), ""),
        (without_use("rosapi/Topics"), "rosapi"),
        (without_use("rcl_interfaces/srv/GetParameters"), "parameters"),
        (without_use("example_interfaces/action/Fibonacci_SendGoal"), "action"),
        (without_use("std_srvs/srv/Trigger"), ""),
    ):
        assert why in found
        assert bool(why) == bool(found)
