from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from typing import Final

import pytest
from rosbags.typesys import Stores

from rmpa.core.errors import LimitExceeded
from rmpa.ros import limits
from rmpa.ros.types.definitions import (
    SEPARATOR,
    DefinitionError,
    Field,
    Specification,
    full_text,
    md5sum,
    parse_definition,
)
from rmpa.ros.types.installed import ServiceType, action_message, actions_of
from rmpa.ros.types.typestore import Ros1Store
from tests.ros.types.genmsg_cases import MESSAGES, SERVICES


def test_a_text_is_read() -> None:
    spec = Specification.parse(
        "my_msgs/All",
        "# comment\nint32 A=1 # one\nstring S= a # b \nbyte  B = 2\n\nHeader header\nuint8[] data#x\n"
        "float64[36] cov\nPoint  p\tq\n".replace("\tq", "")
        + "geometry_msgs/Pose[] poses\n",
    )
    assert spec.constants == ("int32 A=1", "string S=a # b", "byte B=2")
    assert spec.fields == (
        Field("header", "std_msgs/Header"), Field("data", "uint8", array=True),
        Field("cov", "float64", array=True, size=36), Field("p", "my_msgs/Point"),
        Field("poses", "geometry_msgs/Pose", array=True),
    )  # fmt: skip
    assert list(spec.depends()) == ["std_msgs/Header", "my_msgs/Point", "geometry_msgs/Pose"]
    assert [str(field) for field in spec.fields][1:3] == ["uint8[]", "float64[36]"]


@pytest.mark.parametrize(("text", "sum_"), MESSAGES.items())
def test_a_text_has_the_sum_of_genmsg(text: str, sum_: str) -> None:
    known = parse_definition("my_msgs/Case", text)
    assert md5sum("my_msgs/Case", known) == sum_
    assert full_text("my_msgs/Case", known) == text


@pytest.mark.parametrize(
    ("text", "error"),
    [
        ("int32", "'int32' is neither a field nor a constant"),
        ("int32 a b", "'int32 a b' is neither a field nor a constant"),
        ("int32 1a", "neither a field nor a constant"), ("int32 a;import", "neither a field nor a constant"),
        ("time T=1", "'time T=1' is not a constant"),
        ("Other o", "message type p/Other: is not defined; p/T embeds it"), ("a/b/c x", "'a/b/c' is not a type"),
        (f"T t\n{SEPARATOR}\nMSG: p/T\nint32 a", "contains itself"),
        (f"U u\n{SEPARATOR}\nMSG: p/U\nT t", "contains itself"),
        (f"int32 a\n{SEPARATOR}\nwhat\n", "'what' stands where 'MSG: package/Name' must be"),
        (f"int32 a\n{SEPARATOR}\nMSG: 1\n", "is not a type's name"),
    ],
)  # fmt: skip
def test_what_is_refused(text: str, error: str) -> None:
    with pytest.raises(DefinitionError) as caught:
        parse_definition("p/T", text)
    assert error in str(caught.value)


def test_sizes_are_bounded() -> None:
    with pytest.raises(LimitExceeded):
        parse_definition("p/T", "#" * (limits.DEFINITION_MAX + 1))
    with pytest.raises(LimitExceeded):
        parse_definition("p/T", "".join(f"int8 a{n}\n" for n in range(limits.DEFINITION_FIELDS_MAX + 1)))
    deep = "".join(f"\n{SEPARATOR}\nMSG: p/T{n}\nT{n + 1} x" for n in range(40))
    with pytest.raises(DefinitionError, match="is nested deeper than 32 types"):
        parse_definition("p/T", "T0 x" + deep)


def test_a_lattice_of_types_is_read_in_no_time() -> None:
    blocks = [f"\n{SEPARATOR}\nMSG: p/T{n}\n" + "".join(f"T{m} x{m}\n" for m in range(n + 1, 30)) for n in range(30)]
    known = parse_definition("p/T", "T0 x" + "".join(blocks))
    assert len(md5sum("p/T", known)) == 32


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
def test_the_sums_of_services_that_ros_knows(name: str, md5sum: str) -> None:
    assert ServiceType(name).md5sum == md5sum


@pytest.mark.parametrize(("text", "answer"), SERVICES.items())
def test_a_text_is_split_as_by_genmsg(text: str, answer: tuple[str, str, str]) -> None:
    if not answer[0]:
        with pytest.raises(DefinitionError):
            ServiceType("my_msgs/Case", text)
        return
    kind = ServiceType("my_msgs/Case", text)
    assert (kind.md5sum, kind.request.definition, kind.response.definition) == answer


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
def test_what_is_refused_of_a_service(text: str, problem: str) -> None:
    with pytest.raises(DefinitionError, match=problem):
        ServiceType("p/T", text)


def test_a_type_that_does_not_come_with_us_is_refused() -> None:
    with pytest.raises(DefinitionError, match="service type my_pkg/Do: is not a service that comes with rmpa"):
        ServiceType("my_pkg/Do")


GENACTION: Final = Path("/usr/lib/actionlib_msgs/genaction.py")


ACTION_TEXT: Final = "# how far\nfloat64 metres\nuint8 FAST=1\n---\nbool done\n---\nfloat64 left  # m"


def test_a_file_without_three_parts_is_no_action() -> None:
    assert action_message("Do", "Goal", "int8 a\n---\nint8 b") is None
    assert action_message("Do", "ActionGoal", "---\n---\n---\n") is None


@pytest.mark.skipif(not GENACTION.exists(), reason="ROS 1 is not installed (no genaction.py of actionlib_msgs)")
@pytest.mark.parametrize("text", [ACTION_TEXT, "---\n---\n", "int8 a\n--- \nint8 b\n----\nint8 c\n"])
def test_the_texts_are_those_of_genaction(tmp_path: Path, text: str) -> None:
    (tmp_path / "Do.action").write_text(text)
    subprocess.run([sys.executable, GENACTION, "Do.action", "-o", tmp_path], cwd=tmp_path, check=True)
    made = sorted(tmp_path.glob("*.msg"))
    assert len(made) == 7
    for path in made:
        (_, part), *_ = actions_of(path.stem)
        assert action_message("Do", part, text) == path.read_text(), part


def test_it_is_ros_1_alone() -> None:
    store = Ros1Store(Stores.ROS1_NOETIC)
    empty = store.types["std_msgs/msg/String"](data="")
    with pytest.raises(NotImplementedError, match="ROS 1 alone"):
        store.serialize_cdr(empty, "std_msgs/msg/String")
    with pytest.raises(KeyError):
        store.get_msgdef("nobody_msgs/msg/Nothing")
