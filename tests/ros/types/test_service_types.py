from __future__ import annotations

import pytest

from rmpa.ros.types.definitions import DefinitionError
from rmpa.ros.types.installed import ServiceType, known_services
from tests.ros.types.genmsg_cases import SERVICES


@pytest.mark.parametrize(
    ("name", "md5sum"),
    [
        ("std_srvs/Empty", "d41d8cd98f00b204e9800998ecf8427e"),
        ("std_srvs/Trigger", "937c9679a518e3a18d831e57125ea522"),
        ("std_srvs/SetBool", "09fb03525b03e7ea1fd3992bafd87e16"),
        ("roscpp/GetLoggers", "32e97e85527d4678a8f9279894bb64b0"),
        ("roscpp/SetLoggerLevel", "51da076440d78ca1684d36c868df61ea"),
        ("rospy_tutorials/AddTwoInts", "6a2e34150c00229791cc89ff309fff21"),
        ("nav_msgs/GetMap", "6cdd0a18e0aff5b0a3ca2326a89b54ff"),
        ("nav_msgs/GetPlan", "421c8ea4d21c6c9db7054b4bbdf1e024"),
        ("sensor_msgs/SetCameraInfo", "bef1df590ed75ed1f393692395e15482"),
        ("dynamic_reconfigure/Reconfigure", "bb125d226a21982a4a98760418dc2672"),
    ],
)
def test_the_sums_that_ros_knows(name: str, md5sum: str) -> None:
    assert ServiceType(name).md5sum == md5sum


@pytest.mark.parametrize(("text", "answer"), SERVICES.items())
def test_a_text_is_split_as_by_genmsg(text: str, answer: tuple[str, str, str]) -> None:
    if not answer[0]:
        with pytest.raises(DefinitionError):
            ServiceType("my_msgs/Case", text)
        return
    kind = ServiceType("my_msgs/Case", text)
    assert (kind.md5sum, kind.request.definition, kind.response.definition) == answer


@pytest.mark.parametrize("name", known_services())
def test_every_type_makes_requests_and_responses(name: str) -> None:
    kind = ServiceType(name)
    assert kind.describe().request_type == f"{name}Request"
    for half in (kind.request, kind.response):
        message = half.make()
        assert half.to_plain(half.deserialize(half.serialize(message))) == half.to_plain(message)


def test_a_request_in_bytes() -> None:
    add = ServiceType("rospy_tutorials/AddTwoInts")
    raw = add.request.serialize(add.request.make([20, 22]))
    assert raw == b"\x14" + bytes(7) + b"\x16" + bytes(7)
    assert add.response.to_plain(add.response.deserialize(b"\x2a" + bytes(7))) == {"sum": 42}
    empty = ServiceType("std_srvs/Empty")
    assert empty.request.serialize(empty.request.make()) == b""
    assert empty.response.to_plain(empty.response.deserialize(b"")) == {}


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ("int64\n---\n", "'int64' is neither a field nor a constant"),
        ("Thing a\n---\n", "message type p/Thing: is not known here, and p/TRequest embeds it"),
    ],
)
def test_what_is_refused(text: str, problem: str) -> None:
    with pytest.raises(DefinitionError, match=problem):
        ServiceType("p/T", text)


def test_a_type_that_does_not_come_with_us_is_refused() -> None:
    with pytest.raises(DefinitionError, match="service type my_pkg/Do: is not a service that comes with rmpa"):
        ServiceType("my_pkg/Do")
