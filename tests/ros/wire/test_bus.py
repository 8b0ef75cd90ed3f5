"""``getBusInfo`` of other nodes: what rospy and roscpp answer, and whatever else may come."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rmpa.ros.wire.slave_api import BusConnection, BusLink, bus_info, read_bus_info
from rmpa.ros.wire.xmlrpc import parse_response

if TYPE_CHECKING:
    from rmpa.ros.wire.xmlrpc import XmlRpcValue

# Each library with a publisher and a subscriber: ten messages of 80 bytes with their length, which all others heard.
ROSPY_TALKER_INFO = b"""<?xml version='1.0'?>
<methodResponse>
<params>
<param>
<value><array><data>
<value><int>1</int></value>
<value><string>bus info</string></value>
<value><array><data>
<value><array><data>
<value><int>1</int></value>
<value><string>/rosout</string></value>
<value><string>o</string></value>
<value><string>TCPROS</string></value>
<value><string>/rosout</string></value>
<value><boolean>1</boolean></value>
<value><string>TCPROS connection on port 43063 to [127.0.0.1:33964 on socket 8]</string></value>
</data></array></value>
<value><array><data>
<value><int>3</int></value>
<value><string>/cpp_listener</string></value>
<value><string>o</string></value>
<value><string>TCPROS</string></value>
<value><string>/chatter</string></value>
<value><boolean>1</boolean></value>
<value><string>TCPROS connection on port 43063 to [127.0.0.1:33980 on socket 11]</string></value>
</data></array></value>
</data></array></value>
</data></array></value>
</param>
</params>
</methodResponse>
"""
ROSCPP_TALKER_INFO = (
    b'<?xml version="1.0"?>\n<methodResponse><params><param>\n\t'
    b"<value><array><data><value><i4>1</i4></value><value></value><value><array><data>"
    b"<value><array><data><value><i4>0</i4></value><value>/rosout</value><value>o</value><value>TCPROS</value>"
    b"<value>/rosout</value><value><boolean>1</boolean></value>"
    b"<value>TCPROS connection on port 52309 to [127.0.0.1:34730 on socket 10]</value></data></array></value>"
    b"<value><array><data><value><i4>1</i4></value><value>/py_listener</value><value>o</value><value>TCPROS</value>"
    b"<value>/chatter</value><value><boolean>1</boolean></value>"
    b"<value>TCPROS connection on port 52309 to [127.0.0.1:34736 on socket 11]</value></data></array></value>"
    b"</data></array></value></data></array></value>\n</param></params></methodResponse>\n"
)
# The others as they are parsed.
ROSPY_LISTENER_INFO: XmlRpcValue = [
    *(1, "bus info"),
    [
        [
            1,
            "/rosout",
            "o",
            "TCPROS",
            "/rosout",
            True,
            "TCPROS connection on port 39855 to [127.0.0.1:48826 on socket 9]",
        ],
        [
            *(2, "http://127.0.0.1:36171/", "i", "TCPROS", "/chatter", True),
            "TCPROS connection on port 34736 to [127.0.0.1:52309 on socket None]",
        ],
    ],
]
ROSCPP_LISTENER_INFO: XmlRpcValue = [
    *(1, ""),
    [
        [
            *(1, "http://127.0.0.1:36171/", "i", "TCPROS", "/chatter", True),
            "TCPROS connection on port 34738 to [127.0.0.1:52309 on socket 13]",
        ],
    ],
]
OURS_INFO: XmlRpcValue = [
    *(1, "bus info"),
    [
        [
            *(4, "http://127.0.0.1:36171/", "i", "TCPROS", "/rosout", True),
            "TCPROS connection on port 34730 to [127.0.0.1:52309]",
        ]
    ],
]


@pytest.mark.parametrize(
    ("answer", "links"),
    [
        pytest.param(
            parse_response(ROSPY_TALKER_INFO),
            [
                BusLink(1, "/rosout", False, "/rosout", True, 43063, ("127.0.0.1", 33964)),
                BusLink(3, "/cpp_listener", False, "/chatter", True, 43063, ("127.0.0.1", 33980)),
            ],
            id="rospy, publisher",
        ),
        pytest.param(
            parse_response(ROSCPP_TALKER_INFO),
            [
                BusLink(0, "/rosout", False, "/rosout", True, 52309, ("127.0.0.1", 34730)),
                BusLink(1, "/py_listener", False, "/chatter", True, 52309, ("127.0.0.1", 34736)),
            ],
            id="roscpp, publisher",
        ),
        pytest.param(
            ROSPY_LISTENER_INFO,
            [
                BusLink(1, "/rosout", False, "/rosout", True, 39855, ("127.0.0.1", 48826)),
                BusLink(2, "http://127.0.0.1:36171/", True, "/chatter", True, 34736, ("127.0.0.1", 52309)),
            ],
            id="rospy, subscriber",
        ),
        pytest.param(
            ROSCPP_LISTENER_INFO,
            [BusLink(1, "http://127.0.0.1:36171/", True, "/chatter", True, 34738, ("127.0.0.1", 52309))],
            id="roscpp, subscriber",
        ),
        pytest.param(
            OURS_INFO,
            [BusLink(4, "http://127.0.0.1:36171/", True, "/rosout", True, 34730, ("127.0.0.1", 52309))],
            id="an agent",
        ),
    ],
)
def test_the_connections_of_each_library_are_read(answer: XmlRpcValue, links: list[BusLink]) -> None:
    assert read_bus_info(answer) == links


def test_a_node_of_ours_is_read_too() -> None:
    text = "TCPROS connection on port {} to [10.0.0.2:{}]"
    value = bus_info(
        [
            BusConnection(1, "/s", "o", "/out", True, text.format(1, 2), 70, 7),
            BusConnection(2, "http://10.0.0.2:3/", "i", "/in", False, text.format(4, 5), 50, 5),
        ]
    )
    links = [
        BusLink(1, "/s", False, "/out", True, 1, ("10.0.0.2", 2)),
        BusLink(2, "http://10.0.0.2:3/", True, "/in", False, 4, ("10.0.0.2", 5)),
    ]
    assert read_bus_info([1, "bus info", value]) == links
    assert read_bus_info(value) == links


ROW: tuple[XmlRpcValue, ...] = (
    7,
    "http://base:4711/",
    "i",
    "TCPROS",
    "/a",
    True,
    "TCPROS connection on port 4 to [base:5 on socket 6]",
)
LINK = BusLink(7, "http://base:4711/", True, "/a", True, 4, ("base", 5))


KEYS = ("number", "other", "direction", "transport", "topic", "connected", "info")


def row(**changed: XmlRpcValue) -> list[XmlRpcValue]:
    return [changed.get(key, value) for key, value in zip(KEYS, ROW, strict=True)]


def link(**changed: object) -> BusLink:
    return replace(LINK, **changed)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("written", "read"),
    [
        (row(), [LINK]),
        ([*row(), "more"], [LINK]),
        (row(connected=1), [LINK]),
        (row(connected=0), [link(connected=False)]),
        (row(connected="yes"), [link(connected=False)]),
        (row()[:5], [link(connected=False, local_port=None, remote=None)]),
        (row()[:6], [link(local_port=None, remote=None)]),
        (row(info="Closed TCPROS connection on port 4 to [base:5]"), [link(connected=False)]),
        (row(info="TCPROS connection on port 70000 to [base:5]"), [link(local_port=None)]),
        (row(info="TCPROS connection on port 4 to [base:0]"), [link(remote=None)]),
        (row(info="TCPROS connection on port 4 to [fe80::1:5 on socket 6]"), [link(remote=("fe80::1", 5))]),
        (row(info="TCPROS connection to [base]"), [link(local_port=None, remote=None)]),
        (row(info=5), [link(local_port=None, remote=None)]),
        (row(transport="UDPROS"), [link(local_port=None, remote=None)]),
        (row(direction="b"), []),
        (row(direction=[]), []),
        (row(number="7"), []),
        (row(number=True), []),
        (row(other=None), []),
        (row(topic=5), []),
        (row()[:4], []),
        ([], []),
        ("TCPROS", []),
        ({"a": 1}, []),
    ],
)
def test_a_connection_is_read_as_far_as_it_can_be(written: XmlRpcValue, read: list[BusLink]) -> None:
    assert read_bus_info([1, "", [written]]) == read
    assert read_bus_info([written]) == read
    assert read_bus_info([1, "", [5, written, None, row(number=8)]]) == [*read, link(number=8)]


SCALARS = (
    st.none() | st.booleans() | st.integers() | st.floats() | st.text() | st.binary() | st.sampled_from(["i", "o"])
)
VALUES: st.SearchStrategy[XmlRpcValue] = st.recursive(
    SCALARS, lambda inner: st.lists(inner, max_size=8) | st.dictionaries(st.text(), inner, max_size=3)
)


@given(VALUES)
def test_whatever_is_answered_is_read(answer: XmlRpcValue) -> None:
    for found in read_bus_info(answer):
        assert found.local_port is None or 0 < found.local_port < 65536
        assert found.remote is None or 0 < found.remote[1] < 65536


HOSTS = st.from_regex(r"[a-z0-9.:-]{1,30}[a-z0-9]", fullmatch=True)
PORTS = st.integers(1, 65535)


@given(PORTS, HOSTS, PORTS, st.sampled_from(["", " on socket 7", " on socket None"]))
def test_every_address_is_read(local: int, host: str, port: int, socket: str) -> None:
    text = f"TCPROS connection on port {local} to [{host}:{port}{socket}]"
    assert read_bus_info([row(info=text)]) == [link(local_port=local, remote=(host, port))]
