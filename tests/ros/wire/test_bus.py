"""``getBusInfo`` of other nodes: what rospy and roscpp answer, and whatever else may come."""

from __future__ import annotations

from typing import Final

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rmpa.ros.wire.slave_api import (
    BusConnection,
    bus_stats,
    read_bus_info,
    read_bus_stats,
    sent_between,
)
from rmpa.ros.wire.xmlrpc import XmlRpcValue

TALKER: Final = "http://127.0.0.1:36171/"


def connection(port: int, to: int, behind: str = "") -> str:
    """The text that all libraries write of a connection."""
    return f"TCPROS connection on port {port} to [127.0.0.1:{to}{behind}]"


# Each library's answer, as it is parsed: the text of the status, direction, ports, and what is behind the address.
ANSWERS: Final = {
    "rospy, publisher": ("bus info", "o", 43063, 33980, " on socket 11"),
    "roscpp, publisher": ("", "o", 52309, 34736, " on socket 11"),
    "rospy, subscriber": ("bus info", "i", 34736, 52309, " on socket None"),
    "roscpp, subscriber": ("", "i", 34738, 52309, " on socket 13"),
    "an agent": ("bus info", "i", 34730, 52309, ""),
}


@pytest.mark.parametrize(("status", "way", "port", "to", "behind"), ANSWERS.values(), ids=ANSWERS)
def test_the_connections_of_each_library_are_read(status: str, way: str, port: int, to: int, behind: str) -> None:
    other = TALKER if way == "i" else "/listener"
    row: list[XmlRpcValue] = [1, other, way, "TCPROS", "/chatter", True, connection(port, to, behind)]
    (found,) = read_bus_info([1, status, [row]])
    assert (found.number, found.other, found.inbound, found.topic) == (1, other, way == "i", "/chatter")
    assert (found.connected, found.local_port, found.remote) == (True, port, ("127.0.0.1", to))


ROW: tuple[XmlRpcValue, ...] = (
    7, "http://base:4711/", "i", "TCPROS", "/a", True, "TCPROS connection on port 4 to [base:5 on socket 6]",
)  # fmt: skip
REMOTE = ("base", 5)


KEYS = ("number", "other", "direction", "transport", "topic", "connected", "info")


def row(**changed: XmlRpcValue) -> list[XmlRpcValue]:
    return [changed.get(key, value) for key, value in zip(KEYS, ROW, strict=True)]


@pytest.mark.parametrize(
    ("written", "read"),
    [
        (row(), (True, 4, REMOTE)), ([*row(), "more"], (True, 4, REMOTE)), (row(connected=1), (True, 4, REMOTE)),
        (row(connected=0), (False, 4, REMOTE)), (row(connected="yes"), (False, 4, REMOTE)),
        (row()[:5], (False, None, None)), (row()[:6], (True, None, None)),
        (row(info="Closed TCPROS connection on port 4 to [base:5]"), (False, 4, REMOTE)),
        (row(info="TCPROS connection on port 70000 to [base:5]"), (True, None, REMOTE)),
        (row(info="TCPROS connection on port 4 to [base:0]"), (True, 4, None)),
        (row(info="TCPROS connection on port 4 to [fe80::1:5 on socket 6]"), (True, 4, ("fe80::1", 5))),
        (row(info="TCPROS connection to [base]"), (True, None, None)), (row(info=5), (True, None, None)),
        (row(transport="UDPROS"), (True, None, None)), (row(direction="b"), None), (row(direction=[]), None),
        (row(number="7"), None), (row(number=True), None), (row(other=None), None), (row(topic=5), None),
        (row()[:4], None), ([], None), ("TCPROS", None), ({"a": 1}, None),
    ],
)  # fmt: skip
def test_a_connection_is_read_as_far_as_it_can_be(
    written: XmlRpcValue, read: tuple[bool, int | None, tuple[str, int] | None] | None
) -> None:
    wanted = [read] if read is not None else []
    assert [ends(one) for one in read_bus_info([1, "", [written]])] == wanted
    assert [ends(one) for one in read_bus_info([written])] == wanted
    among = read_bus_info([1, "", [5, written, None, row(number=8)]])
    assert [ends(one) for one in among] == [*wanted, (True, 4, REMOTE)]
    assert among[-1].number == 8


def ends(one: BusConnection) -> tuple[bool, int | None, tuple[str, int] | None]:
    """What is known of the ends of a connection."""
    return one.connected, one.local_port, one.remote


HOSTS = st.from_regex(r"[a-z0-9.:-]{1,30}[a-z0-9]", fullmatch=True)
PORTS = st.integers(1, 65535)


@given(PORTS, HOSTS, PORTS, st.sampled_from(["", " on socket 7", " on socket None"]))
def test_every_address_is_read(local: int, host: str, port: int, socket: str) -> None:
    text = f"TCPROS connection on port {local} to [{host}:{port}{socket}]"
    assert [ends(one) for one in read_bus_info([row(info=text)])] == [(True, local, (host, port))]


def test_what_each_library_has_sent_is_read() -> None:
    rospy: XmlRpcValue = [1, "", [[["/out", 660, [[2, 812, 55, True]]], ["/quiet", 0, []]], [["/in", []]], []]]
    assert read_bus_stats(rospy) == {"/out": {2: (55, 812)}, "/quiet": {}}
    # roscpp leaves out code and status, and has the bytes of messages as well.
    roscpp: XmlRpcValue = [[["/out", [[2, 1032, 1032, 86, 0]]]], [["/in", [[1, 696, 87, 0, 0]]]]]
    assert read_bus_stats(roscpp) == {"/out": {2: (86, 1032)}}
    ours = bus_stats(["/out"], [], [BusConnection(1, "/s", "o", "/out", True, "", 70, 7)])
    assert read_bus_stats([1, "", ours]) == {"/out": {1: (7, 70)}}


VALUES = st.recursive(st.integers() | st.text(max_size=3) | st.booleans(), lambda inner: st.lists(inner, max_size=5))


@given(VALUES)
def test_whatever_a_node_answers_for_its_counts_is_read(value: XmlRpcValue) -> None:
    answers: list[XmlRpcValue] = [value, [value], [1, "", value], [1, "", [[["/a", value], ["/a", [value]]]]]]
    for answer in answers:
        assert all(isinstance(sent, dict) for sent in read_bus_stats(answer).values())


def test_what_was_sent_between_two_answers_is_that_of_the_best_connection() -> None:
    before = {1: (2**32 - 2, 2**32 - 8), 2: (10, 1040), 4: (9, 9)}
    after = {1: (3, 512), 2: (12, 1248), 3: (100, 10_000)}
    assert sent_between(before, after) == (5, 500)  # counters of 32 bits; a new connection says nothing yet
    assert sent_between(before, {3: (100, 10_000)}) is None
    assert sent_between({}, {}) is None
