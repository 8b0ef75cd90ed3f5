from __future__ import annotations

import msgspec
import pytest

from rmpa.observe.control import ControlReply, json_pieces
from rmpa.observe.snapshot import Snapshot
from tests.observe.samples import SNAPSHOT

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
