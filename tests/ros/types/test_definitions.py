from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rmpa.core.errors import LimitExceeded
from rmpa.ros import limits
from rmpa.ros.types.definitions import (
    SEPARATOR,
    DefinitionError,
    Field,
    Specification,
    full_text,
    known_specifications,
    known_types,
    md5sum,
    parse_definition,
)
from tests.ros.types.genmsg_cases import MESSAGES


def test_a_text_is_read() -> None:
    spec = Specification.parse(
        "my_msgs/All",
        "# comment\nint32 A=1 # one\nstring S= a # b \nbyte  B = 2\n\nHeader header\nuint8[] data#x\n"
        "float64[36] cov\nPoint  p\tq\n".replace("\tq", "")
        + "geometry_msgs/Pose[] poses\n",
    )
    assert spec.constants == ("int32 A=1", "string S=a # b", "byte B=2")
    assert spec.fields == (
        Field("header", "std_msgs/Header"),
        Field("data", "uint8", array=True),
        Field("cov", "float64", array=True, size=36),
        Field("p", "my_msgs/Point"),
        Field("poses", "geometry_msgs/Pose", array=True),
    )
    assert list(spec.depends()) == ["std_msgs/Header", "my_msgs/Point", "geometry_msgs/Pose"]
    assert [str(field) for field in spec.fields][1:3] == ["uint8[]", "float64[36]"]


@pytest.mark.parametrize(
    ("name", "sum_"),
    [
        ("std_msgs/Empty", "d41d8cd98f00b204e9800998ecf8427e"),
        ("std_msgs/String", "992ce8a1687cec8c8bd883ec73ca41d1"),
        ("std_msgs/Header", "2176decaecbce78abc3b96ef049fabed"),
        ("sensor_msgs/Joy", "5a9ea5f83505693b71e785041e67a8bb"),
        ("geometry_msgs/Twist", "9f195f881246fdfa2798d1d3eebca84a"),
        ("nav_msgs/Odometry", "cd5e73d190d741a2f92e81eda573aca7"),
        ("rosgraph_msgs/Log", "acffd30cd6b6de30f120938c17c593fb"),
        ("diagnostic_msgs/DiagnosticArray", "60810da900de1dd6ddd437c3503511da"),
        ("sensor_msgs/PointCloud2", "1158d486dd51d683ce2f1be655c3c181"),
    ],
)
def test_the_sums_that_ros_knows(name: str, sum_: str) -> None:
    assert md5sum(name, known_specifications(name)) == sum_


@pytest.mark.parametrize(("text", "sum_"), MESSAGES.items())
def test_a_text_has_the_sum_of_genmsg(text: str, sum_: str) -> None:
    known = parse_definition("my_msgs/Case", text)
    assert md5sum("my_msgs/Case", known) == sum_
    assert full_text("my_msgs/Case", known) == text


def test_an_array_of_no_elements_is_not_one_of_any_length() -> None:
    none, any_ = Specification.parse("p/T", "int32[0] none\nint32[] any").fields
    assert (none.size, any_.size) == (0, None)
    with pytest.raises(DefinitionError, match="neither a field nor a constant"):
        Specification.parse("p/T", "int32[9999999999] many")


@pytest.mark.parametrize("name", known_types())
def test_a_full_text_is_read_back_with_the_same_sum(name: str) -> None:
    known = known_specifications(name)
    text = full_text(name, known)
    again = parse_definition(name, text)
    assert md5sum(name, again) == md5sum(name, known)
    assert full_text(name, again) == text


def test_the_full_text_has_each_embedded_type_once() -> None:
    text = full_text("geometry_msgs/Twist", known_specifications("geometry_msgs/Twist"))
    assert text.count(SEPARATOR) == text.count("MSG: geometry_msgs/Vector3\n") == 1


@pytest.mark.parametrize(
    ("text", "error"),
    [
        ("int32", "'int32' is neither a field nor a constant"),
        ("int32 a b", "'int32 a b' is neither a field nor a constant"),
        ("int32 1a", "neither a field nor a constant"),
        ("int32 a;import", "neither a field nor a constant"),
        ("time T=1", "'time T=1' is not a constant"),
        ("Other o", "message type p/Other: is not defined; p/T embeds it"),
        ("a/b/c x", "'a/b/c' is not a type"),
        (f"T t\n{SEPARATOR}\nMSG: p/T\nint32 a", "contains itself"),
        (f"U u\n{SEPARATOR}\nMSG: p/U\nT t", "contains itself"),
        (f"int32 a\n{SEPARATOR}\nwhat\n", "'what' stands where 'MSG: package/Name' must be"),
        (f"int32 a\n{SEPARATOR}\nMSG: 1\n", "is not a type's name"),
    ],
)
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


@given(st.text(max_size=300))
def test_any_text_is_a_definition_or_an_error(text: str) -> None:
    try:
        known = parse_definition("p/T", text)
    except DefinitionError as error:
        str(error)
        return
    assert len(md5sum("p/T", known)) == 32


def test_unknown_type_has_a_remedy() -> None:
    with pytest.raises(DefinitionError, match="its definition is learnt from a publisher"):
        known_specifications("my_msgs/Unknown")
