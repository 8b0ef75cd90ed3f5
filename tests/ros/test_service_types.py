from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

from rmpa.ros.definitions import DefinitionError
from rmpa.ros.installed import find_message, find_service
from rmpa.ros.service_types import ServiceType, known_services

if TYPE_CHECKING:
    from pathlib import Path


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
        ("int64 a", "has 0 lines '---' instead of one"),
        ("int64 a\n---\nint64 b\n---\n", "has 2 lines '---'"),
        ("int64\n---\n", "'int64' is neither a field nor a constant"),
        ("Thing a\n---\n", "message type p/Thing: is not one that comes with rmpa"),
    ],
)
def test_what_is_refused(text: str, problem: str) -> None:
    with pytest.raises(DefinitionError, match=problem):
        ServiceType("p/T", text)


def test_an_unknown_type_says_where_to_get_it() -> None:
    with pytest.raises(DefinitionError, match=r"my_pkg/Do: .*ROS_PACKAGE_PATH"):
        ServiceType("my_pkg/Do")


def test_types_of_the_machine_are_found(tmp_path: Path) -> None:
    package = tmp_path / "src" / "stack" / "my_pkg"
    (package / "srv").mkdir(parents=True)
    (package / "msg").mkdir()
    (package / "package.xml").touch()
    (package / "srv" / "Do.srv").write_text("Thing thing\nstd_msgs/Header header\n---\nmy_pkg/Thing[] things\n")
    (package / "msg" / "Thing.msg").write_text("int32 a\n")
    environ = {"ROS_PACKAGE_PATH": str(tmp_path)}
    text = find_service("my_pkg/Do", environ)
    assert text is not None
    kind = ServiceType("my_pkg/Do", text, lambda name: find_message(name, environ))
    assert kind.request.serialize(kind.request.make([[7], {}])) == b"\x07" + bytes(3) + bytes(16)
    assert find_service("my_pkg/Other", environ) is None
    assert find_service("../x", environ) is None
    assert find_message("my_pkg/Thing", {"CMAKE_PREFIX_PATH": str(tmp_path)}) is None
    (tmp_path / "share").symlink_to(package.parent)
    assert find_message("my_pkg/Thing", {"CMAKE_PREFIX_PATH": str(tmp_path)}) == "int32 a\n"


def test_what_genpy_made_is_read_and_not_run(tmp_path: Path) -> None:
    folder = tmp_path / "my_pkg" / "srv"
    folder.mkdir(parents=True)
    separator = "=" * 80
    (folder / "_Do.py").write_text(
        "raise SystemExit\n"
        "class DoRequest(genpy.Message):\n"
        f'  _full_text = """Thing a\n{separator}\nMSG: my_pkg/Thing\nint8 x\n"""\n'
        "class DoResponse(genpy.Message):\n"
        '  _md5sum = "x"\n'
        '  _full_text = """string s\n"""\n'
    )
    (folder / "_Bad.py").write_text("class (")
    environ = {"PYTHONPATH": str(tmp_path)}
    assert find_service("my_pkg/Do", environ) == "Thing a\n---\nstring s\n"
    assert find_service("my_pkg/Bad", environ) is None
