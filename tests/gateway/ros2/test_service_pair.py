"""Service types of both distributions: hashes as ROS 2 publishes them, calls there and back."""

from __future__ import annotations

from typing import Any

import pytest

from rmpa.gateway.ros2.conversion import NoConversion
from rmpa.gateway.ros2.pairs import TypeMapping
from rmpa.gateway.ros2.services import ServicePair, ros1_without_use, ros2_without_use, type_by_name
from rmpa.gateway.ros2.types import Ros2Types, TypePair
from rmpa.ros.types.installed import ServiceType, known_services

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


def test_a_service_under_another_name_has_that_names_hash(jazzy: Ros2Types) -> None:
    definition = "int64 a\nint64 b\n---\nint64 sum\n"
    made = ServicePair(
        ServiceType("robot_srvs/Add", definition), TypePair("example_interfaces/srv/AddTwoInts"), jazzy
    )
    assert made.type_hash == PUBLISHED["rospy_tutorials/AddTwoInts"]


def test_a_rule_renames_the_fields_of_a_service(jazzy: Ros2Types) -> None:
    ros1 = ServiceType("robot_srvs/Sum", "int64 left\nint64 right\n---\nint64 all\n")
    pair("rospy_tutorials/AddTwoInts", jazzy)  # its type is known from here on
    rule = TypePair(
        "example_interfaces/srv/AddTwoInts", {"request": {"left": "a", "right": "b"}, "response": {"all": "sum"}}
    )
    made = ServicePair(ros1, rule, jazzy)
    raw = made.request.to_ros2(ros1.request.serialize(ros1.request.make({"left": 5, "right": -6})))
    read: Any = jazzy.store.deserialize_cdr(raw, "example_interfaces/srv/AddTwoInts_Request")
    assert (read.a, read.b) == (5, -6)


def test_a_rule_with_fields_of_an_unknown_type_is_refused_with_what_to_do(jazzy: Ros2Types) -> None:
    ros1 = ServiceType("robot_srvs/Sum", "int64 left\n---\nint64 all\n")
    with pytest.raises(NoConversion, match=r"other_srvs/srv/Sum.*workspace"):
        ServicePair(ros1, TypePair("other_srvs/srv/Sum", {"request": {"left": "a"}}), jazzy)


def test_services_that_the_other_side_cannot_use_are_left_out_with_a_reason() -> None:
    for found, why in (
        (ros1_without_use("roscpp/SetLoggerLevel"), "loggers"),
        (ros1_without_use("roscpp/SetLoggerLevel", ruled=True), ""),
        (ros1_without_use("std_srvs/Trigger"), ""),
        (ros1_without_use(type_by_name("/talker/get_loggers")), "loggers"),  # it need not be asked for its type
        (ros1_without_use(type_by_name("/talker/stop")), ""),
        (ros2_without_use("/talker/get_parameters", "rcl_interfaces/srv/GetParameters"), "parameters"),
        (ros2_without_use("/fib/_action/send_goal", "example_interfaces/action/Fibonacci_SendGoal"), "action"),
        (ros2_without_use("/reset", "std_srvs/srv/Trigger"), ""),
    ):
        assert why in found
        assert bool(why) == bool(found)
