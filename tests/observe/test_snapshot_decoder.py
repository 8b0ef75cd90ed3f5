"""Snapshots that are decoded one after the other: equal to those decoded alone, and what stays is the same object."""

from __future__ import annotations

from typing import TYPE_CHECKING

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rmpa.core.errors import RemoteProtocolError
from rmpa.observe.control import ControlReply, SnapshotDecoder
from rmpa.observe.snapshot import RouteInfo, ServiceInfo, Snapshot, TopicInfo
from rmpa.trust.permissions import TrustStatus
from tests.web.snapshots import AGENT, peer

if TYPE_CHECKING:
    from collections.abc import Sequence

_TOPICS = st.builds(
    lambda name, type_, messages: TopicInfo(
        name=name,
        type=type_,
        routes=(RouteInfo(peer="arm", node="/n", direction="in", state="open", messages=messages),),
    ),
    st.sampled_from(("/a", "/b", "/ünïcode", '/with"quote')),
    st.sampled_from(("", "std_msgs/String")),
    st.integers(0, 2),
)
_SERVICES = st.builds(
    lambda name, calls: ServiceInfo(name=name, node="/n", direction="out", calls=calls),
    st.sampled_from(("/s", "/t")),
    st.integers(0, 1),
)
_SNAPSHOTS = st.builds(
    lambda topics, services: Snapshot(
        agent=AGENT,
        taken=1.5,
        peers=(peer(),),
        topics=tuple(topics),
        services=tuple(services),
        counters={"beacon.malformed": len(topics)},
        notes=("a note",),
    ),
    st.lists(_TOPICS, max_size=4),
    st.lists(_SERVICES, max_size=3),
)


def _line(snapshot: Snapshot) -> bytes:
    return ControlReply(ok=True, value=snapshot).serialize()


@given(st.lists(_SNAPSHOTS, max_size=6))
def test_each_snapshot_is_what_it_is_without_those_before(snapshots: Sequence[Snapshot]) -> None:
    decoder = SnapshotDecoder()
    for snapshot in snapshots:
        assert decoder.decode(_line(snapshot)) == snapshot


def test_what_has_not_changed_is_the_same_object() -> None:
    idle, busy = TopicInfo(name="/idle", type="std_msgs/String"), TopicInfo(name="/busy")
    served = ServiceInfo(name="/s", node="/n", direction="out")
    decoder = SnapshotDecoder()
    first = decoder.decode(_line(Snapshot(agent=AGENT, taken=1.0, topics=(busy, idle), services=(served,))))
    busy = msgspec.structs.replace(busy, type="std_msgs/Int32")
    second = decoder.decode(_line(Snapshot(agent=AGENT, taken=2.0, topics=(busy, idle), services=(served,))))
    assert second.topics[1] is first.topics[1]
    assert second.services[0] is first.services[0]
    assert second.topics[0].type == "std_msgs/Int32"
    assert second.taken == 2.0


def test_all_of_a_snapshot_is_decoded() -> None:
    members = {field.name for field in msgspec.structs.fields(Snapshot)}
    given = dict.fromkeys(members) | {"agent": AGENT, "taken": 1.0, "peers": [peer()], "topics": []}
    given |= {"services": [], "counters": {"a": 1}, "notes": ["n"], "unreachable": []}
    given |= {"topics_left": 3, "services_left": 4, "strangers": [peer()]}
    given |= {"trust": TrustStatus(on=True, module="base", folder="f", agent="secured")}
    assert None not in given.values(), "a new member of Snapshot: SnapshotDecoder needs it too"
    decoded = SnapshotDecoder().decode(msgspec.json.encode({"ok": True, "value": given}))
    assert decoded == msgspec.convert(msgspec.to_builtins(given), Snapshot)


@pytest.mark.parametrize(
    "line",
    [
        b"",
        b"{",
        b'{"ok":false,"error":"no"}',
        b'{"ok":true,"value":{}}',
        b'{"ok":true,"value":{"agent":{},"taken":1}}',
        _line(Snapshot(agent=AGENT, taken=1.0)).replace(b'"topics":[]', b'"topics":[7]'),
        b"\xff",
    ],
)
def test_what_is_no_snapshot_is_refused(line: bytes) -> None:
    with pytest.raises(RemoteProtocolError):
        SnapshotDecoder().decode(line)
