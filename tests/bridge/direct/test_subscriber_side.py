"""The subscriber's side of direct transport: what it asks, decides and moves at each event."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

from rmpa.bridge import limits
from rmpa.bridge.direct.conditions import Condition, Grant, Unmet
from rmpa.bridge.direct.direct_route import (
    Ask,
    Decided,
    DirectKey,
    DirectState,
    Fallback,
    HangUp,
    Move,
    Path,
    ProbeNode,
    Release,
)
from rmpa.bridge.direct.subscriber_side import DirectSubscriptions
from rmpa.bridge.messages import Source
from rmpa.core.contract import Transport

if TYPE_CHECKING:
    from rmpa.bridge.direct.direct_route import DirectAction

SOURCE = Source("/chatter", "/talker")
KEY = DirectKey(1, SOURCE, "/viewer")
OTHER = DirectKey(1, SOURCE, "/logger")
GRANT = Grant(45225, "/talker", "/talker/get_loggers")
END = ("10.0.0.1", 45225)
RULE = Unmet(Condition.CONTRACT, "lifespan")
NAMESAKE = Unmet(Condition.CALLER_ID, "another /viewer")
RESTARTED = Unmet(Condition.NODE, "it has restarted")


class Sut(DirectSubscriptions):
    """With the steps that many tests begin with."""

    latched = relayed = False

    def __init__(self) -> None:
        super().__init__(lambda _: self.latched, lambda _: self.relayed)

    def ask(self, key: DirectKey = KEY, now: float = 0.0, wanted: Transport = Transport.AUTO) -> int:
        (asked,) = self.consider(key, wanted, None, now)
        assert isinstance(asked, Ask)
        return asked.attempt

    def direct(self, key: DirectKey = KEY, now: float = 0.0) -> None:
        actions = self.replied(key, self.ask(key, now), GRANT, now)
        if actions == [ProbeNode(1, GRANT)]:
            actions = self.probed(1, GRANT.port, "", now)
        assert actions == [Decided(key)]

    def connected_directly(self, key: DirectKey = KEY, now: float = 0.0) -> None:
        self.direct(key, now)
        assert self.answered(key, END, now) == []

    def state(self, key: DirectKey = KEY) -> tuple[DirectState, Path]:
        route = self.get(key)
        assert route is not None
        return route.state, route.path


def asked(actions: list[DirectAction]) -> Ask:
    (found,) = [one for one in actions if isinstance(one, Ask)]
    return found


def test_a_subscriber_is_asked_for_probed_and_answered_with_the_publishers_port() -> None:
    sut = Sut()
    attempt = sut.ask()
    assert sut.decision(KEY) is None, "its requestTopic waits"
    assert sut.replied(KEY, attempt, GRANT, 0.1) == [ProbeNode(1, GRANT)]
    assert sut.decision(KEY) is None
    assert sut.probed(1, GRANT.port, "", 0.2) == [Decided(KEY)]
    assert sut.decision(KEY) == GRANT
    sut.answered(KEY, END, 0.3)
    assert sut.connected() == [(KEY, sut.get(KEY))]


def test_a_port_is_probed_once_for_all_subscribers() -> None:
    sut = Sut()
    first, second = sut.ask(), sut.ask(OTHER)
    assert sut.replied(KEY, first, GRANT, 0.0) == [ProbeNode(1, GRANT)]
    assert sut.replied(OTHER, second, GRANT, 0.0) == []
    assert sut.probed(1, GRANT.port, "", 0.0) == [Decided(KEY), Decided(OTHER)]
    third = DirectKey(1, SOURCE, "/third")
    assert sut.replied(third, sut.ask(third), GRANT, 0.0) == [Decided(third)]


def test_what_cannot_be_reached_is_relayed_and_tried_again_by_time() -> None:
    sut = Sut()
    sut.replied(KEY, sut.ask(), GRANT, 0.0)
    assert sut.probed(1, GRANT.port, "firewall", 1.0) == [Release(KEY), Decided(KEY)]
    assert sut.decision(KEY) == Unmet(Condition.REACHABLE, "firewall")
    assert sut.next_timer() == 1.0 + limits.DIRECT_RETRY
    assert asked(sut.handle_timer(1.0 + limits.DIRECT_RETRY)).key == KEY


@pytest.mark.parametrize("wanted", [Transport.AUTO, Transport.DIRECT])
def test_only_direct_warns_where_it_cannot_be_had(wanted: Transport) -> None:
    sut = Sut()
    warned = [Fallback(KEY, RULE)] if wanted is Transport.DIRECT else []
    assert sut.consider(KEY, wanted, RULE, 0.0) == [*warned, Decided(KEY)]
    # A reload that asks for the warning gets it.
    assert sut.consider(KEY, Transport.DIRECT, RULE, 1.0) == ([] if warned else [Fallback(KEY, RULE)])


def test_a_new_rule_moves_a_subscriber_back_to_the_relay_and_releases_its_grant() -> None:
    sut = Sut()
    sut.connected_directly()
    assert sut.consider(KEY, Transport.AUTO, RULE, 1.0) == [Release(KEY), Decided(KEY), Move(KEY)]
    sut.hung_up(KEY)
    assert sut.answered(KEY, None, 1.1) == []
    assert sut.state() == (DirectState.RELAYED, Path.RELAY)
    assert asked(sut.consider(KEY, Transport.AUTO, None, 2.0)).key == KEY


def test_a_grant_that_comes_too_late_is_released() -> None:
    sut = Sut()
    attempt = sut.ask()
    # Not before: the peer may grant it after the Release has passed.
    assert sut.consider(KEY, Transport.AUTO, RULE, 0.1) == [Decided(KEY)]
    assert sut.replied(KEY, attempt, GRANT, 0.2) == [Release(KEY)]
    attempt = sut.ask(OTHER)
    assert sut.remove(OTHER) == [Decided(OTHER)]
    assert sut.replied(OTHER, attempt, GRANT, 0.3) == [Release(OTHER)]


def test_the_response_to_an_earlier_request_is_not_taken_for_the_present_one() -> None:
    sut = Sut()
    first = sut.ask()
    sut.remove(KEY)
    second = sut.ask()
    assert first != second
    assert sut.replied(KEY, first, GRANT, 0.1) == []
    assert sut.state()[0] is DirectState.ASKING
    assert sut.replied(KEY, second, NAMESAKE, 0.2) == [Decided(KEY)]
    assert sut.decision(KEY) == NAMESAKE


def test_a_notification_that_comes_while_the_peer_is_asked_makes_it_be_asked_once_more() -> None:
    sut = Sut()
    attempt = sut.ask()
    assert sut.closed(1, SOURCE, "", NAMESAKE, 0.1) == []
    assert Decided(KEY) in sut.replied(KEY, attempt, GRANT, 0.2)
    assert sut.state() == (DirectState.RELAYED, Path.NONE)
    again = sut.next_timer()
    assert again is not None
    attempt = asked(sut.handle_timer(again)).attempt
    assert sut.replied(KEY, attempt, GRANT, again) == [ProbeNode(1, GRANT)]


def test_a_retry_that_comes_while_the_peer_is_asked_is_not_lost() -> None:
    sut = Sut()
    attempt = sut.ask()
    assert sut.retry(1, SOURCE, 0.1) == []
    sut.replied(KEY, attempt, NAMESAKE, 0.2)
    again = sut.next_timer()
    assert again is not None
    assert asked(sut.handle_timer(again)).key == KEY


def test_a_peer_that_does_not_answer_is_asked_again_and_may_hold_a_grant() -> None:
    sut = Sut()
    sut.replied(KEY, sut.ask(), Unmet(Condition.AGENT, "no answer"), 5.0)
    assert sut.next_timer() == 5.0 + limits.DIRECT_RETRY
    assert Release(KEY) in sut.remove(KEY)


def test_a_withdrawal_moves_its_subscriber_alone() -> None:
    sut = Sut()
    sut.connected_directly()
    sut.connected_directly(OTHER)
    assert sut.closed(1, SOURCE, "/viewer", NAMESAKE, 1.0) == [Decided(KEY), Move(KEY)]
    assert sut.state(OTHER) == (DirectState.DIRECT, Path.DIRECT)


def test_a_publisher_that_restarted_is_asked_for_at_once_and_its_subscriber_called_back() -> None:
    sut = Sut()
    sut.connected_directly()
    hang_up, ask = sut.closed(1, SOURCE, "", RESTARTED, 1.0)
    assert hang_up == HangUp(KEY, END)
    assert isinstance(ask, Ask)
    other = Grant(45226, "/talker")
    assert sut.replied(KEY, ask.attempt, other, 1.1) == [ProbeNode(1, other)]
    assert sut.probed(1, other.port, "", 1.2) == [Decided(KEY), Move(KEY)]


def test_withdrawals_in_a_row_end_on_the_relay() -> None:
    sut = Sut()
    sut.connected_directly()
    moves, asks, now = 0, 0, 1.0
    for _ in range(1000):
        now += 0.001
        actions = sut.closed(1, SOURCE, "", RESTARTED, now)
        moves += sum(isinstance(one, HangUp | Move) for one in actions)
        for one in actions:
            if isinstance(one, Ask):
                asks += 1
                sut.replied(KEY, one.attempt, GRANT, now)
                sut.probed(1, GRANT.port, "", now)
                sut.answered(KEY, END, now)
        sut.retry(1, SOURCE, now)
    assert moves <= limits.DIRECT_BREAKS + 1
    assert asks < limits.DIRECT_BREAKS
    assert sut.decision(KEY) == Unmet(Condition.STABLE, "its direct connection broke 3 times in 10 s")
    assert asked(sut.handle_timer(now + limits.DIRECT_RETRY)).key == KEY


def test_a_storm_of_retries_asks_once_a_second() -> None:
    sut = Sut()
    sut.replied(KEY, sut.ask(), NAMESAKE, 0.0)
    asks, now = 0, 0.0
    for _ in range(5000):
        now += 0.001
        actions = sut.retry(1, SOURCE, now)
        if (due := sut.next_timer()) is not None and due <= now:
            actions += sut.handle_timer(now)
        for one in actions:
            assert isinstance(one, Ask)
            asks += 1
            sut.replied(KEY, one.attempt, NAMESAKE, now)
    assert 3 <= asks <= 5


def test_a_retry_is_not_for_what_this_module_decides() -> None:
    sut = Sut()
    sut.consider(KEY, Transport.AUTO, RULE, 0.0)
    assert sut.retry(1, SOURCE, 5.0) == []
    # Also where the peer said just the same before.
    sut.replied(OTHER, sut.ask(OTHER), RULE, 0.0)
    sut.consider(OTHER, Transport.AUTO, RULE, 1.0)
    assert sut.retry(1, SOURCE, 5.0) == []


def test_a_latched_source_is_direct_when_its_subscriber_connects_again() -> None:
    sut = Sut()
    sut.latched = sut.relayed = True
    assert sut.consider(KEY, Transport.AUTO, None, 0.0) == [Decided(KEY)], "the peer is not even asked"
    decision = sut.decision(KEY)
    assert isinstance(decision, Unmet)
    assert decision.condition is Condition.LATCHED
    assert sut.retry(1, SOURCE, 5.0) == [Decided(KEY)]
    assert asked(sut.left(KEY, 9.0)).key == KEY


def test_a_relayed_subscriber_is_moved_when_it_may_be_direct() -> None:
    sut = Sut()
    attempt = sut.ask()
    sut.answered(KEY, None, 0.3)  # it waited for too long
    sut.replied(KEY, attempt, GRANT, 0.5)
    assert sut.probed(1, GRANT.port, "", 0.6) == [Decided(KEY), Move(KEY)]


def test_an_answer_that_a_new_decision_overtook_moves_its_subscriber() -> None:
    sut = Sut()
    sut.direct()
    sut.closed(1, SOURCE, "", NAMESAKE, 1.0)
    assert sut.answered(KEY, END, 1.1) == [Move(KEY)]
    assert sut.misplaced(KEY)


def test_a_broken_connection_is_reported_and_asked_for_again_but_not_for_ever() -> None:
    sut = Sut()
    sut.connected_directly()
    rest: list[DirectAction] = []
    for number in range(limits.DIRECT_BREAKS):
        released, *rest = sut.broken(KEY, 1.0 + number)
        assert released == Release(KEY, broken=True)
        if number < limits.DIRECT_BREAKS - 1:
            sut.replied(KEY, asked(rest).attempt, GRANT, 1.0 + number)
            assert sut.probed(1, GRANT.port, "", 1.0 + number) == [Decided(KEY), Move(KEY)]
            sut.answered(KEY, END, 1.0 + number)
    assert rest == [Decided(KEY), Move(KEY)]
    assert sut.state() == (DirectState.RELAYED, Path.NONE)


@pytest.mark.parametrize("crashed", [True, False])
def test_direct_connections_outlive_an_agent_but_no_link(crashed: bool) -> None:
    sut = Sut()
    sut.connected_directly()
    actions = sut.link_down(1, 5.0, crashed=crashed)
    if crashed:
        assert actions == []
        # Two links in a row that end so.
        ask = asked(sut.link_up(1, 6.0))
        assert sut.link_down(1, 6.1, crashed=True) == []
        assert sut.replied(KEY, ask.attempt, GRANT, 6.2) == [], "over a link that is gone"
        ask = asked(sut.link_up(1, 6.3))
        assert sut.replied(KEY, ask.attempt, GRANT, 6.4) == [ProbeNode(1, GRANT)], "probed again over the new link"
        assert sut.probed(1, GRANT.port, "", 6.5) == [Decided(KEY)]
        assert sut.state() == (DirectState.DIRECT, Path.DIRECT)
    else:
        assert actions == [HangUp(KEY, END), Decided(KEY)]
        assert sut.state() == (DirectState.RELAYED, Path.NONE)
        ask = asked(sut.link_up(1, 6.0))
        sut.replied(KEY, ask.attempt, GRANT, 6.1)
        assert sut.probed(1, GRANT.port, "", 6.2) == [Decided(KEY), Move(KEY)]


def test_a_link_of_another_peer_changes_nothing() -> None:
    sut = Sut()
    sut.connected_directly()
    assert sut.link_down(2, 1.0, crashed=False) == []
    assert sut.closed(2, SOURCE, "", NAMESAKE, 1.0) == []
    assert sut.probed(2, GRANT.port, "no", 1.0) == []
    assert sut.state() == (DirectState.DIRECT, Path.DIRECT)


@pytest.mark.parametrize("hang_up", [True, False])
def test_nothing_is_left_of_a_subscriber_that_is_removed(hang_up: bool) -> None:
    sut = Sut()
    sut.connected_directly()
    actions = sut.remove(KEY, hang_up=hang_up)
    assert actions == [Release(KEY), Decided(KEY), *([HangUp(KEY, END)] if hang_up else [])]
    assert (list(sut), sut.of(1, SOURCE), sut.next_timer(), sut.connected()) == ([], [], None, [])
    assert sut.remove(KEY) == []


def test_a_subscriber_that_comes_back_to_the_proxy_without_asking_is_moved() -> None:
    sut = Sut()
    sut.ask()
    sut.answered(KEY, None, 1.0)
    assert sut.left(KEY, 2.0) == []
    assert sut.arrived(KEY, 2.2) == []
    assert sut.state() == (DirectState.ASKING, Path.RELAY)
    sut = Sut()
    sut.direct()
    assert sut.arrived(KEY, 3.0) == [Decided(KEY), Move(KEY)]
    assert sut.arrived(KEY, 3.1) == []


def test_a_port_that_was_not_reached_delays_no_further_subscriber_until_it_is_tried_again() -> None:
    sut = Sut()
    sut.consider(KEY, Transport.AUTO, None, 0.0)
    sut.replied(KEY, 1, GRANT, 0.0)
    sut.probed(1, GRANT.port, "no answer within 1 s", 1.0)
    other = DirectKey(KEY.peer, KEY.source, "/another")
    attempt = asked(sut.consider(other, Transport.AUTO, None, 2.0)).attempt
    actions = sut.replied(other, attempt, GRANT, 2.0)
    assert not any(isinstance(one, ProbeNode) for one in actions)
    assert Decided(other) in actions
    later = 1.0 + limits.DIRECT_RETRY
    attempt = asked(sut.handle_timer(later)).attempt
    assert ProbeNode(1, GRANT) in sut.replied(KEY, attempt, GRANT, later)


PROBLEM = "Operation not permitted"


def test_a_stuck_subscriber_that_may_be_direct_again_is_stuck_no_more() -> None:
    sut = Sut()
    sut.connected_directly()
    sut.consider(KEY, Transport.RELAY, RULE, 1.0)
    route = sut.get(KEY)
    assert route is not None
    sut.stays(KEY, END, PROBLEM)
    assert (sut.state(), route.stuck) == ((DirectState.RELAYED, Path.DIRECT), PROBLEM)
    sut.direct(now=2.0)
    assert (sut.state(), route.stuck) == ((DirectState.DIRECT, Path.DIRECT), "")


@pytest.mark.parametrize("back_before_it_is_known", [False, True])
def test_a_connection_that_outlasts_its_lost_link_is_direct_when_the_link_is_back(
    back_before_it_is_known: bool,
) -> None:
    sut = Sut()
    sut.connected_directly()
    route = sut.get(KEY)
    assert route is not None
    assert HangUp(KEY, END) in sut.link_down(1, 5.0, crashed=False)
    if not back_before_it_is_known:
        sut.stays(KEY, END, PROBLEM)
        assert (sut.state(), route.stuck) == ((DirectState.RELAYED, Path.DIRECT), PROBLEM)
    sut.replied(KEY, asked(sut.link_up(1, 6.0)).attempt, GRANT, 6.0)
    actions = sut.probed(1, GRANT.port, "", 6.0)
    if back_before_it_is_known:
        assert Move(KEY) in actions
        sut.stays(KEY, END, PROBLEM)
    assert (sut.state(), route.stuck) == ((DirectState.DIRECT, Path.DIRECT), "")
    assert not sut.misplaced(KEY)


def test_a_subscriber_that_cannot_leave_an_earlier_port_stays_stuck() -> None:
    sut = Sut()
    sut.connected_directly()
    sut.link_down(1, 5.0, crashed=False)
    sut.stays(KEY, END, PROBLEM)
    moved = Grant(END[1] + 1, GRANT.node, GRANT.probe)
    sut.replied(KEY, asked(sut.link_up(1, 6.0)).attempt, moved, 6.0)
    assert Move(KEY) in sut.probed(1, END[1] + 1, "", 6.0)
    sut.stays(KEY, END, PROBLEM)
    route = sut.get(KEY)
    assert route is not None
    assert (route.path, route.stuck) == (Path.DIRECT, PROBLEM)
