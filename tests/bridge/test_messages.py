from __future__ import annotations

import contextlib

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rmpa.bridge import messages
from rmpa.bridge.messages import (
    Advertise,
    Close,
    Closed,
    Description,
    Message,
    Mismatch,
    Offer,
    Open,
    Opened,
    Source,
    decode,
    encode,
)
from rmpa.core import limits
from rmpa.core.errors import LimitExceeded, RemoteProtocolError

GOLDEN: list[tuple[Message, bytes]] = [
    (
        Advertise(added=(Offer("/cmd", "/joy", "sensor_msgs/Joy"),), full=True),
        (
            b'{"op":"advertise","added":[{"topic":"/cmd","node":"/joy","type":"sensor_msgs/Joy"}],'
            b'"removed":[],"full":true}'
        ),
    ),
    (
        Advertise(removed=(Source("/cmd", "/joy"),)),
        b'{"op":"advertise","added":[],"removed":[{"topic":"/cmd","node":"/joy"}],"full":false}',
    ),
    (Open(7, "/cmd", "/joy"), b'{"op":"open","route":7,"topic":"/cmd","node":"/joy"}'),
    (
        Opened(7, Description("sensor_msgs/Joy", "5a9ea5f83505693b71e785041e67a8bb", "Header header\n", True)),
        (
            b'{"op":"opened","route":7,"description":{"type":"sensor_msgs/Joy","md5":"5a9ea5f83505693b71e785041e67a8bb",'
            b'"definition":"Header header\\n","latching":true}}'
        ),
    ),
    (Close(7), b'{"op":"close","route":7}'),
    (Closed(7, "the node has gone"), b'{"op":"closed","route":7,"reason":"the node has gone"}'),
    (
        Mismatch("/cmd", "/joy", "/base", "md5"),
        b'{"op":"mismatch","topic":"/cmd","node":"/joy","subscriber":"/base","text":"md5"}',
    ),
]


@pytest.mark.parametrize(("message", "wire"), GOLDEN)
def test_golden_bytes(message: Message, wire: bytes) -> None:
    assert encode(message) == wire
    assert decode(wire) == message
    assert decode(memoryview(wire)) == message


@pytest.mark.parametrize(
    "wire",
    [
        b"",
        b"{",
        b"[]",
        b"null",
        b'{"op":"unheard-of"}',
        b'{"route":7}',
        b'{"op":"open","route":7}',
        b'{"op":"open","route":0,"topic":"/a","node":"/b"}',
        b'{"op":"open","route":4294967296,"topic":"/a","node":"/b"}',
        b'{"op":"open","route":-1,"topic":"/a","node":"/b"}',
        b'{"op":"open","route":1,"topic":"a","node":"/b"}',
        b'{"op":"open","route":1,"topic":"/a","node":"/b/"}',
        b'{"op":"open","route":1,"topic":"/a//c","node":"/b"}',
        b'{"op":"open","route":1,"topic":"/\xff","node":"/b"}',
        b'{"op":"open","route":1,"topic":"/a\\nb","node":"/b"}',
        b'{"op":"advertise","added":[{"topic":"/a","node":"/b","type":"*"}]}',
        b'{"op":"advertise","added":[{"topic":"/a","node":"/b","type":"String"}]}',
        b'{"op":"advertise","added":[{"topic":"","node":"/b","type":"a/B"}]}',
        b'{"op":"advertise","removed":[{"topic":"/a","node":""}]}',
        b'{"op":"opened","route":1,"description":{"type":"*","md5":"*","definition":"","latching":false}}',
        (
            b'{"op":"opened","route":1,"description":{"type":"a/B","md5":"5a9ea5f83505693b71e785041e67a8bb",'
            b'"definition":"\xe2\x82\xac","latching":false}}'
        ),
        b'{"op":"close","route":1}trailing',
        b'{"op":"open","route":1,"topic":"/' + b"x" * 1024 + b'","node":"/b"}',
        b'{"op":"advertise","added":[{"topic":"/a","node":"/b","type":"a/' + b"B" * 1024 + b'"}]}',
        b'{"op":"closed","route":1,"reason":"' + b"x" * 16385 + b'"}',
        b'{"op":"mismatch","topic":"/a","node":"/b","subscriber":"/c","text":"' + b"x" * 16385 + b'"}',
        b"[" * 100_000,
    ],
)
def test_what_is_not_a_message_is_the_peers_error(wire: bytes) -> None:
    with pytest.raises(RemoteProtocolError):
        decode(wire)


def test_a_message_beyond_the_limit_is_not_parsed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(limits, "CONTROL_PAYLOAD_MAX", 10)
    with pytest.raises(LimitExceeded, match="control message of 24 bytes"):
        decode(b'{"op":"close","route":1}')


def test_too_many_topics_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(limits, "TOPICS_PER_PEER_MAX", 2)
    offers = tuple(Offer(f"/t{i}", "/n", "a/B") for i in range(3))
    with pytest.raises(LimitExceeded, match="in topics"):
        decode(encode(Advertise(added=offers)))


def test_fields_of_later_versions_are_ignored() -> None:
    assert decode(b'{"op":"close","route":1,"hurry":true}') == Close(1)


_names = st.from_regex(r"/[a-z][a-z0-9_]{0,8}(/[a-z][a-z0-9_]{0,8}){0,3}", fullmatch=True)
_types = st.from_regex(r"[a-z][a-z_]{0,8}/[A-Z][A-Za-z]{0,8}", fullmatch=True)
_md5s = st.from_regex(r"[0-9a-f]{32}", fullmatch=True)
_routes = st.integers(1, (1 << 32) - 1)
_messages: st.SearchStrategy[Message] = st.one_of(
    st.builds(
        Advertise,
        added=st.lists(st.builds(Offer, _names, _names, _types), max_size=5).map(tuple),
        removed=st.lists(st.builds(Source, _names, _names), max_size=5).map(tuple),
        full=st.booleans(),
    ),
    st.builds(Open, _routes, _names, _names),
    st.builds(
        Opened,
        _routes,
        st.builds(Description, _types, _md5s, st.text(st.characters(max_codepoint=255)), st.booleans()),
    ),
    st.builds(Close, _routes),
    st.builds(Closed, _routes, st.text()),
    st.builds(Mismatch, _names, _names, st.text(), st.text()),
)


@given(_messages)
def test_every_message_survives_the_wire(message: Message) -> None:
    assert decode(encode(message)) == message


@given(st.binary(max_size=400))
def test_no_bytes_do_worse_than_a_protocol_error(wire: bytes) -> None:
    with contextlib.suppress(RemoteProtocolError):
        decode(wire)


def test_every_message_has_golden_bytes() -> None:
    golden = {type(message) for message, _ in GOLDEN}
    assert golden == {Advertise, Open, Opened, Close, Closed, Mismatch}
    assert messages.Message == Advertise | Open | Opened | Close | Closed | Mismatch
