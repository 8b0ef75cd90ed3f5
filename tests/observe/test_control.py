"""The control socket's words."""

from __future__ import annotations

import math
import re

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rmpa.core import facts
from rmpa.core.errors import LimitExceeded, LocalProtocolError, RemoteProtocolError
from rmpa.observe import limits
from rmpa.observe import snapshot as s
from rmpa.observe.control_client import ControlReply, ControlRequest, json_pieces
from rmpa.observe.snapshot import Snapshot
from tests.observe.samples import SNAPSHOT, VIEWER


def test_golden_request() -> None:
    request = ControlRequest("ping", {"peer": "base", "count": 1})
    assert request.serialize() == b'{"op":"ping","args":{"peer":"base","count":1}}\n'
    assert ControlRequest.parse(request.serialize()) == request
    assert str(request) == "ping(peer, count)"
    assert ControlRequest.parse(b'{"op": "snapshot"}') == ControlRequest("snapshot")


def test_golden_replies() -> None:
    good = ControlReply(ok=True, value={"times": [0.5]})
    assert good.serialize() == b'{"ok":true,"value":{"times":[0.5]}}\n'
    assert ControlReply(ok=True, value=math.nan).serialize() == b'{"ok":true,"value":null}\n'
    bad = ControlReply(ok=False, error="no", remedy="do")
    assert bad.serialize() == b'{"ok":false,"error":"no","remedy":"do"}\n'
    assert [ControlReply.parse(r.serialize()) for r in (good, bad)] == [good, bad]


MALFORMED = (b"", b"\n", b"snapshot", b"[]", b"{}", b'{"op": 1}', b'{"op": "x", "args": []}', b'{"op": "\xff"}')


@pytest.mark.parametrize("line", [*MALFORMED, b"[" * 100_000])
def test_malformed_requests(line: bytes) -> None:
    with pytest.raises(RemoteProtocolError, match="not a control request"):
        ControlRequest.parse(line)


@pytest.mark.parametrize("line", [b"", b"{}", b'{"ok": 1}', b'{"ok": true, "error": null}'])
def test_malformed_replies(line: bytes) -> None:
    with pytest.raises(RemoteProtocolError, match="not a control reply"):
        ControlReply.parse(line)


def test_every_prefix_of_a_request_is_refused() -> None:
    line = ControlRequest("ping", {"peer": "base"}).serialize().rstrip()
    for length in range(len(line)):
        with pytest.raises(RemoteProtocolError):
            ControlRequest.parse(line[:length])


def test_limits() -> None:
    with pytest.raises(LimitExceeded):
        ControlRequest.parse(b" " * (limits.CONTROL_REQUEST_MAX + 1))
    with pytest.raises(LocalProtocolError, match="not JSON"):
        ControlReply(ok=True, value=object()).serialize()


JSON = st.recursive(
    st.none()
    | st.booleans()
    | st.integers(-(2**53), 2**53)
    | st.floats(allow_nan=False, allow_infinity=False)
    | st.text(),
    lambda inner: st.lists(inner) | st.dictionaries(st.text(), inner),
    max_leaves=10,
)


@given(st.text(), st.dictionaries(st.text(), JSON))
def test_requests_survive_their_round_trip(op: str, args: dict[str, object]) -> None:
    line = ControlRequest(op, args).serialize()
    assert line.count(b"\n") == 1
    assert ControlRequest.parse(line) == ControlRequest(op, args)
    assert str(ControlRequest(op, args)).isprintable()


MANY = msgspec.structs.replace(SNAPSHOT, topics=SNAPSHOT.topics * 100, peers=SNAPSHOT.peers * 50)


class Tagged(msgspec.Struct, tag=True):
    values: tuple[int, ...]


class Renamed(msgspec.Struct, rename="camel", omit_defaults=True):
    some_values: list[int] = []
    other_value: int = 3


@pytest.mark.parametrize(
    "value",
    [
        SNAPSHOT,
        MANY,
        ControlReply(ok=True, value=MANY),
        ControlReply(ok=True),
        ControlReply(ok=False, error="no", remedy='\u00e4 "quoted"'),
        Tagged(tuple(range(100))),
        Renamed(list(range(100)), 4),
        Renamed(),
        list(range(16)),
        list(range(17)),
        tuple(range(32)),
        (),
        {"a": [1, 2]},
        None,
    ],
    ids=lambda value: type(value).__name__,
)
def test_the_pieces_are_what_msgspec_says(value: object) -> None:
    assert b"".join(json_pieces(value)) == msgspec.json.encode(value)


def test_no_piece_of_a_large_snapshot_is_long() -> None:
    pieces = list(json_pieces(ControlReply(ok=True, value=MANY)))
    assert max(map(len, pieces)) < 32 * 1024
    assert msgspec.json.decode(b"".join(pieces))["value"]["topics"]
    assert msgspec.convert(ControlReply.parse(b"".join(pieces)).value, Snapshot) == MANY


def test_what_json_cannot_say_is_an_error_as_of_msgspec() -> None:
    with pytest.raises(TypeError):
        list(json_pieces(ControlReply(ok=True, value=[object()] * 20)))


def test_the_sample_uses_every_field() -> None:
    def unused(value: msgspec.Struct) -> set[str]:
        return {name for name in value.__struct_fields__ if not getattr(value, name)}

    assert unused(SNAPSHOT.agent) == set()
    assert set.intersection(*map(unused, SNAPSHOT.peers)) == {"via", "invite"}, "none of them is relayed or pending"
    assert unused(SNAPSHOT.topics[0].routes[0]) == {"kept", "problem", "limit"}
    assert unused(VIEWER) == {"condition", "text"}, "it is direct"


def test_a_topics_peers_are_those_it_comes_from() -> None:
    by_name = {topic.name: topic.peers for topic in SNAPSHOT.topics}
    assert by_name == {"/cmd": ("joystick",), "/odom": ()}


def test_every_field_is_explained() -> None:
    for struct in (*vars(facts).values(), *vars(s).values()):
        if not isinstance(struct, type) or not issubclass(struct, msgspec.Struct):
            continue
        for name in struct.__struct_fields__:
            said = "".join(base.__doc__ or "" for base in struct.__mro__)
            assert re.search(rf"^ +{name}: ", said, re.MULTILINE), (struct, name)  # 3.13 strips indentation
