"""What bridges announce, by a clock that the test sets."""

from __future__ import annotations

from typing import TYPE_CHECKING

from rmpa.gateway.ros1_bridge import BridgedKind, BridgedTopic, limits
from rmpa.gateway.ros1_bridge.presence import PresenceTable

if TYPE_CHECKING:
    import pytest

CHATTER = BridgedKind.PUBLISHER, BridgedTopic("/chatter", "std_msgs/String", "992ce8a1687cec8c8bd883ec73ca41d1")


def test_what_is_announced_each_second_stays_and_what_is_not_goes() -> None:
    table = PresenceTable()
    assert table.seen(CHATTER, 0.0)
    for second in range(1, 10):
        assert not table.seen(CHATTER, float(second))
        assert table.expire(float(second), ()) == []
    assert table.expire(9.0 + limits.PRESENCE_LEASE + 0.1, ()) == [CHATTER]
    assert not table.present
    assert table.seen(CHATTER, 20.0)


def test_a_bridge_that_is_silent_because_it_hears_this_gateway_is_not_missed() -> None:
    table = PresenceTable()
    table.seen(CHATTER, 0.0)
    assert table.expire(100.0, [CHATTER]) == []
    assert table.expire(101.0, ()) == []
    assert table.expire(100.1 + limits.PRESENCE_LEASE, ()) == [CHATTER]


def test_announcements_are_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(limits, "REMOTE_MAX", 2)
    table = PresenceTable()
    for number in range(5):
        table.seen((BridgedKind.PUBLISHER, BridgedTopic(f"/t{number}", "*", "*")), 0.0)
    assert (len(table.present), table.ignored) == (2, 3)
