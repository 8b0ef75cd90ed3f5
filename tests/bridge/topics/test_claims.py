"""Until when a peer that is back may claim its routes."""

from __future__ import annotations

from rmpa.bridge.topics.claims import ClaimDeadlines
from rmpa.mesh import limits


def test_the_short_time_begins_when_the_peer_was_told_everything() -> None:
    claims = ClaimDeadlines()
    claims.begin(1, 10.0)
    assert claims.untold == {1}
    assert claims.next_timer() == 10.0 + limits.RESUME_CLAIM_MAX
    claims.told(1, 11.0)
    claims.told(1, 12.0)
    assert claims.untold == frozenset()
    assert claims.next_timer() == 11.0 + limits.RESUME_CLAIM
    assert claims.handle_timer(11.0) == []
    assert claims.handle_timer(11.0 + limits.RESUME_CLAIM) == [1]
    assert claims.next_timer() is None


def test_a_peer_that_is_never_told_everything_has_the_long_time() -> None:
    claims = ClaimDeadlines()
    claims.begin(1, 0.0)
    claims.begin(2, 1.0)
    assert claims.handle_timer(limits.RESUME_CLAIM_MAX) == [1]
    assert claims.untold == {2}


def test_without_a_link_there_is_no_deadline() -> None:
    claims = ClaimDeadlines()
    claims.begin(1, 0.0)
    claims.forget(1)
    claims.told(1, 0.0)
    assert (claims.next_timer(), claims.untold) == (None, frozenset())
