"""The format of zenoh-bridge-ros1: the keys that its documentation shows, and what is none."""

from __future__ import annotations

import contextlib

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rmpa.core.errors import RemoteProtocolError
from rmpa.gateway.ros1_bridge import BridgedKind, BridgedTopic, parse_key, parse_presence

MD5 = "992ce8a1687cec8c8bd883ec73ca41d1"
CHATTER = BridgedTopic("/chatter", "std_msgs/String", MD5)
KEY = f"7374645f6d7367732f537472696e67/{MD5}/*/chatter"


def test_golden_keys() -> None:
    assert CHATTER.key() == KEY
    assert CHATTER.presence(BridgedKind.PUBLISHER) == f"ros1_discovery_info/*/pub/{KEY}"


def test_keys_are_read_back() -> None:
    deep = BridgedTopic("/a/b/c", "*", "*", "fleet")
    for topic in (CHATTER, deep):
        assert parse_key(topic.key()) == topic
        assert parse_presence(topic.presence(BridgedKind.CLIENT, "x")) == (BridgedKind.CLIENT, topic)


@pytest.mark.parametrize(
    "key",
    [
        "",
        "a/b",
        f"zz/{MD5}/*/chatter",
        f"00ff/{MD5}/*/chatter",
        f"{KEY}//",
        KEY.replace(MD5, "99"),
        KEY.replace("chatter", "a-b"),
    ],
)
def test_what_is_no_key_is_refused(key: str) -> None:
    with pytest.raises(RemoteProtocolError):
        parse_key(key)
    with pytest.raises(RemoteProtocolError):
        parse_presence(f"ros1_discovery_info/*/pub/{key}")
    with pytest.raises(RemoteProtocolError):
        parse_presence(f"ros1_discovery_info/*/pup/{KEY}")


@given(st.text(max_size=100) | st.text("0123456789abcdef/*", max_size=100))
def test_any_text_is_a_key_or_refused(key: str) -> None:
    for parse in (parse_key, parse_presence):
        with contextlib.suppress(RemoteProtocolError):
            parse(key)
