"""Parameters of ROS 1 and ROS 2: values there and back, names, and what list_parameters returns."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rmpa.core.errors import RemoteProtocolError
from rmpa.gateway.ros2.params import ParamTypes, flat, key_of, listed, name_in_ros2
from rmpa.gateway.ros2.types import Ros2Types

if TYPE_CHECKING:
    from rmpa.ros.wire.xmlrpc import XmlRpcValue

JAZZY = Ros2Types("jazzy")
TYPES = ParamTypes(JAZZY)
SMALL = st.integers(-(2**31), 2**31 - 1)
FLOATS = st.floats(allow_nan=False)


def through(value: XmlRpcValue) -> XmlRpcValue:
    """A value to ROS 2's bytes and back."""
    kind = "rcl_interfaces/srv/GetParameters_Response"
    raw = TYPES.write(kind, values=[TYPES.value(value)])
    return TYPES.plain(TYPES.read(kind, raw).values[0])


@settings(deadline=None)
@given(
    st.one_of(
        st.booleans(),
        SMALL,
        FLOATS,
        st.text(st.characters(exclude_categories=["Cs"])),
        st.binary(),
        st.lists(st.booleans(), min_size=1),
        st.lists(SMALL, min_size=1),
        st.lists(FLOATS, min_size=1),
        st.lists(st.text(st.characters(exclude_categories=["Cs"]))),
    )
)
def test_values_go_there_and_back(value: Any) -> None:
    again = through(value)
    assert again == value
    assert type(again) is type(value)


def test_what_the_other_side_has_no_type_for() -> None:
    assert through(None) is None
    assert through([1, "a"]) == '[1, "a"]', "a list of several types is JSON"
    assert through([1, 2.5]) == [1.0, 2.5]
    value = TYPES.value(0)
    object.__setattr__(value, "integer_value", 2**40)
    assert TYPES.plain(value) == float(2**40), "ROS 1's integers have 32 bits"
    many = TYPES.value([1, 2])
    many.integer_array_value[0] = 2**40
    assert TYPES.plain(many) == [float(2**40), 2.0]
    assert isinstance(TYPES.plain(many), list)
    with pytest.raises(RemoteProtocolError):
        TYPES.read("rcl_interfaces/srv/GetParameters_Request", b"\0\1\0\0\xff\xff\xff\xff")


def test_names_and_trees() -> None:
    assert (name_in_ros2("/gains/p"), key_of("gains.p")) == ("gains.p", "/gains/p")
    assert flat({"gains": {"p": 1, "more": {"i": 2}}, "rate": 5}) == {"gains.p": 1, "gains.more.i": 2, "rate": 5}


def test_names_are_listed_as_rclcpp_lists_them() -> None:
    names = ["a.b", "a.c.d", "rate"]
    assert listed(names, [], 0) == (["a.b", "a.c.d", "rate"], ["a", "a.c"])
    assert listed(names, [], 1) == (["rate"], [])
    assert listed(names, ["a"], 1) == (["a.b"], ["a"])
    assert listed(names, ["a"], 0) == (["a.b", "a.c.d"], ["a", "a.c"])
    assert listed(names, ["nothing"], 0) == ([], [])


def test_the_hashes_are_those_that_a_graph_of_jazzy_has() -> None:
    assert TYPES.event_hash() == "RIHS01_043e627780fcad87a22d225bc2a037361dba713fca6a6b9f4b869a5aa0393204"
    assert JAZZY.type_hash("rcl_interfaces/msg/Log") == (
        "RIHS01_e28ce254ca8abc06abf92773b74602cdbf116ed34fbaf294fb9f81da9f318eac"
    )
    assert TYPES.service("get_parameters")[0] == "rcl_interfaces/srv/GetParameters"
