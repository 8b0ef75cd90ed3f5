"""The publisher's side of direct transport: one grant for each name, and none that is not used."""

from __future__ import annotations

import pytest

from rmpa.bridge import limits
from rmpa.bridge.direct.conditions import Condition, Unmet
from rmpa.bridge.direct.publisher_side import DirectGrants, EndConnections, Granted, Retry, WithdrawGrant
from rmpa.bridge.messages import Source
from rmpa.core.contract import Contract

SOURCE = Source("/chatter", "/talker")
URI = "http://10.0.0.1:1234/"
GRANTED = Granted(Contract(), 45225, URI)
WHY = Unmet(Condition.CONTRACT, "lifespan")


@pytest.fixture
def sut() -> DirectGrants:
    """One grant: /viewer of peer 1."""
    made = DirectGrants()
    assert made.judge(1, SOURCE, "/viewer", []) is None
    made.grant(1, SOURCE, "/viewer", GRANTED)
    return made


def condition(unmet: Unmet | None) -> Condition | None:
    return unmet.condition if unmet is not None else None


@pytest.mark.trap(12)
def test_a_name_is_granted_once_for_a_source(sut: DirectGrants) -> None:
    assert condition(sut.judge(2, SOURCE, "/viewer", [])) is Condition.CALLER_ID
    assert sut.judge(1, SOURCE, "/viewer", []) is None, "the same subscriber may ask again"
    assert sut.judge(2, SOURCE, "/logger", []) is None
    assert sut.judge(2, Source("/other", "/talker"), "/viewer", []) is None
    assert sut.release(1, SOURCE, "/viewer") == [Retry(2, SOURCE)]
    assert sut.judge(2, SOURCE, "/viewer", []) is None


def test_a_local_subscriber_of_that_name_goes_first(sut: DirectGrants) -> None:
    assert condition(sut.judge(2, SOURCE, "/logger", ["/logger"])) is Condition.CALLER_ID
    (withdrawn,) = sut.local_subscriber("/chatter", "/viewer")
    assert isinstance(withdrawn, WithdrawGrant)
    assert (withdrawn.peer, withdrawn.subscriber, withdrawn.unmet.condition) == (1, "/viewer", Condition.CALLER_ID)
    assert list(sut) == []
    assert set(sut.local_subscriber_gone("/chatter")) == {Retry(1, SOURCE), Retry(2, SOURCE)}
    assert sut.local_subscriber_gone("/chatter") == [], "each is told once"


def test_a_peer_has_a_bounded_number_of_grants(sut: DirectGrants) -> None:
    for number in range(limits.DIRECT_MAX - 1):
        name = f"/n{number}"
        assert sut.judge(1, SOURCE, name, []) is None
        sut.grant(1, SOURCE, name, GRANTED)
    assert condition(sut.judge(1, SOURCE, "/more", [])) is Condition.LIMIT
    assert sut.judge(1, SOURCE, "/n1", []) is None, "one that is granted already"
    assert sut.judge(2, SOURCE, "/more", []) is None, "another peer"
    sut.release(1, SOURCE, "/n1")
    assert sut.judge(1, SOURCE, "/more", []) is None


def test_a_peer_that_asks_for_all_kinds_of_sources_is_remembered_within_a_bound(sut: DirectGrants) -> None:
    for number in range(3 * limits.DIRECT_MAX):
        sut.refused(1, Source(f"/t{number}", "/n"), "/viewer")
    told = [one for number in range(3 * limits.DIRECT_MAX) for one in sut.changed(Source(f"/t{number}", "/n"))]
    assert len(told) == limits.DIRECT_MAX
    assert told[-1] == Retry(1, Source(f"/t{3 * limits.DIRECT_MAX - 1}", "/n")), "the latest are"


def test_a_refusal_ends_an_earlier_grant_of_that_subscriber(sut: DirectGrants) -> None:
    sut.judge(2, SOURCE, "/viewer", [])
    assert sut.refused(1, SOURCE, "/viewer") == [Retry(2, SOURCE)]
    assert list(sut) == []
    assert sut.changed(SOURCE) == [Retry(1, SOURCE)]


def test_a_publisher_that_restarts_is_withdrawn_so_that_its_peers_ask_again(sut: DirectGrants) -> None:
    sut.grant(1, SOURCE, "/logger", GRANTED)
    assert sut.published(SOURCE, URI) == [], "it registers once more"
    (withdrawn,) = sut.published(SOURCE, "http://10.0.0.1:9999/")
    assert isinstance(withdrawn, WithdrawGrant)
    assert (withdrawn.peer, withdrawn.subscriber, withdrawn.unmet.condition) == (1, "", Condition.NODE)
    assert list(sut) == []


def test_one_that_left_first_is_withdrawn_when_it_is_back(sut: DirectGrants) -> None:
    sut.refused(2, SOURCE, "/logger")
    sut.gone(SOURCE)
    assert list(sut) == []
    withdrawn, retry = sut.published(SOURCE, "http://10.0.0.1:9999/")
    assert isinstance(withdrawn, WithdrawGrant)
    assert withdrawn.unmet.condition is Condition.NODE
    assert retry == Retry(2, SOURCE)
    assert sut.published(SOURCE, "http://10.0.0.1:9999/") == []


def test_what_left_is_remembered_within_a_bound(sut: DirectGrants) -> None:
    sources = [Source(f"/t{number}", "/n") for number in range(limits.DIRECT_MAX + 10)]
    for source in sources:
        sut.grant(1, source, "/viewer", GRANTED)
        sut.gone(source)
    assert sum(bool(sut.published(source, URI)) for source in sources) == limits.DIRECT_MAX


def test_new_rules_withdraw_what_they_do_not_allow(sut: DirectGrants) -> None:
    other = Source("/other", "/talker")
    sut.grant(1, other, "/viewer", GRANTED)
    assert sut.judge_again(lambda source, *_: WHY if source == other else None) == [
        WithdrawGrant(1, other, "/viewer", WHY)
    ]
    assert [source for source, *_ in sut] == [SOURCE]
    assert sut.retry_all() == [Retry(1, other)]


def test_what_a_peer_does_not_ask_for_after_a_new_link_is_free_again(sut: DirectGrants) -> None:
    sut.grant(1, SOURCE, "/logger", GRANTED)
    sut.judge(2, SOURCE, "/viewer", [])
    sut.link_up(1)
    sut.grant(1, SOURCE, "/logger", GRANTED)
    sut.grant(1, SOURCE, "/new", GRANTED)
    assert sut.expire(1) == [Retry(2, SOURCE)]
    assert [name for _, _, name, _ in sut] == ["/logger", "/new"]
    assert sut.expire(1) == []


def test_a_peer_that_cannot_be_reached_keeps_no_publisher_waiting(sut: DirectGrants) -> None:
    sut.grant(1, SOURCE, "/logger", GRANTED)
    assert sut.unreachable(1) == [EndConnections(1, 45225)]
    assert sut.unreachable(2) == []
    assert len(list(sut)) == 2, "its session may go on"


def test_nothing_is_left_of_a_peer_that_is_gone(sut: DirectGrants) -> None:
    sut.judge(2, SOURCE, "/viewer", [])
    sut.refused(1, Source("/none", "/none"), "/viewer")
    sut.gone(Source("/none", "/none"))
    sut.link_up(1)
    assert sut.peer_gone(1) == [Retry(2, SOURCE)]
    assert list(sut) == []
    assert (sut.retry_all(), sut.expire(1), sut.published(SOURCE, URI)) == ([], [], [])
