"""The snapshot crosses the control socket unchanged."""

from __future__ import annotations

import msgspec

from rmpa.observe import peer_info
from rmpa.observe import snapshot as s
from tests.observe.samples import SNAPSHOT, VIEWER


def test_a_snapshot_survives_json() -> None:
    assert msgspec.json.decode(msgspec.json.encode(SNAPSHOT), type=s.Snapshot) == SNAPSHOT


def test_the_sample_uses_every_field() -> None:
    def unused(value: msgspec.Struct) -> set[str]:
        return {name for name in value.__struct_fields__ if not getattr(value, name)}

    assert unused(SNAPSHOT.agent) == set()
    assert set.intersection(*map(unused, SNAPSHOT.peers)) == {"via"}, "none of them is relayed"
    assert unused(SNAPSHOT.topics[0].routes[0]) == {"kept", "problem", "limit"}
    assert unused(VIEWER) == {"condition", "text"}, "it is direct"


def test_a_topics_peers_are_those_it_comes_from() -> None:
    by_name = {topic.name: topic.peers for topic in SNAPSHOT.topics}
    assert by_name == {"/cmd": ("joystick",), "/odom": ()}


def test_every_field_is_explained() -> None:
    for struct in (*vars(peer_info).values(), *vars(s).values()):
        if not isinstance(struct, type) or not issubclass(struct, msgspec.Struct):
            continue
        for name in struct.__struct_fields__:
            said = "".join(base.__doc__ or "" for base in struct.__mro__)
            assert f"        {name}: " in said, (struct, name)
