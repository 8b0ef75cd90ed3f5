"""The snapshot crosses the control socket unchanged."""

from __future__ import annotations

import msgspec

from rmpa.monitor import snapshot as s
from tests.monitor.samples import SNAPSHOT


def test_a_snapshot_survives_json() -> None:
    assert msgspec.json.decode(msgspec.json.encode(SNAPSHOT), type=s.Snapshot) == SNAPSHOT


def test_the_sample_uses_every_field() -> None:
    def empty(value: object, where: str) -> list[str]:
        if isinstance(value, msgspec.Struct):
            return [e for f in value.__struct_fields__ for e in empty(getattr(value, f), f"{where}.{f}")]
        return []

    assert empty(SNAPSHOT.agent, "agent") == []
    assert {f for p in SNAPSHOT.peers for f in p.__struct_fields__ if getattr(p, f)} == set(
        s.PeerInfo.__struct_fields__
    )


def test_a_topics_peers_are_those_it_comes_from() -> None:
    by_name = {topic.name: topic.peers for topic in SNAPSHOT.topics}
    assert by_name == {"/cmd": ("joystick",), "/odom": ()}


def test_every_field_is_explained() -> None:
    for struct in (s.AgentInfo, s.LinkInfo, s.PeerInfo, s.RouteInfo, s.TopicInfo, s.Snapshot, s.PingReply):
        for name in struct.__struct_fields__:
            assert f"        {name}: " in (struct.__doc__ or ""), (struct, name)
