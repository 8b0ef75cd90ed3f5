"""The clients' side of direct calls: when lookups are answered with a server's own address, and when not any more."""

from __future__ import annotations

import pytest

from rmpa.bridge import limits
from rmpa.bridge.direct.client_side import (
    AnswerDirect,
    AnswerRelay,
    AskPeer,
    DirectServices,
    Lost,
    ProbeServer,
    ReleaseGrant,
    ServiceAction,
    ServiceFallback,
    ServiceKey,
)
from rmpa.bridge.direct.conditions import Condition, Grant, Unmet
from rmpa.bridge.direct.direct_route import DirectState
from rmpa.core.contract import Transport

KEY = ServiceKey(1, "/add")
GRANT = Grant(45000, "/adder")
REFUSED = Unmet(Condition.LISTENING, "/adder listens on loopback only")
PASSING = Unmet(Condition.NODE, "/adder does not answer")
RELEASE = ReleaseGrant(KEY, "/adder")
RENAMED = Unmet(Condition.NAME, "it is /sum there")


@pytest.fixture
def services() -> DirectServices:
    """One service that the peer is asked for."""
    made = DirectServices()
    assert made.consider(KEY, "/adder", Transport.AUTO, None, 0.0) == [AskPeer(KEY, 1)]
    return made


def direct(services: DirectServices, key: ServiceKey = KEY, now: float = 0.0) -> None:
    """Bring a service that is asked for to direct calls."""
    attempt = attempt_of(services, key)
    assert services.replied(key, attempt, GRANT, now) == [ProbeServer(key, attempt, GRANT)]
    assert AnswerDirect(key, GRANT) in services.probed(key, attempt, "", now)


def attempt_of(services: DirectServices, key: ServiceKey = KEY) -> int:
    found = services.get(key)
    assert found is not None
    return found.attempt


def state(services: DirectServices, key: ServiceKey = KEY) -> tuple[DirectState, Unmet | None]:
    found = services.get(key)
    assert found is not None
    return found.state, found.unmet


def asked(actions: list[ServiceAction]) -> list[str]:
    return [action.key.service for action in actions if isinstance(action, AskPeer)]


def test_a_service_is_direct_once_its_server_has_answered_a_probe(services: DirectServices) -> None:
    assert services.replied(KEY, 1, GRANT, 0.0) == [ProbeServer(KEY, 1, GRANT)]
    assert state(services)[0] is DirectState.PROBING
    assert services.probed(KEY, 1, "", 0.0) == [AnswerDirect(KEY, GRANT)]
    assert state(services) == (DirectState.DIRECT, None)


def test_a_port_that_does_not_answer_is_never_told_to_clients_and_is_tried_again_later(
    services: DirectServices,
) -> None:
    services.replied(KEY, 1, GRANT, 0.0)
    assert services.probed(KEY, 1, "connection refused", 0.0) == [RELEASE]
    assert state(services) == (DirectState.RELAYED, Unmet(Condition.REACHABLE, "connection refused"))
    assert services.next_timer() == limits.DIRECT_RETRY
    assert asked(services.handle_timer(limits.DIRECT_RETRY)) == ["/add"]


def test_a_lasting_refusal_is_asked_again_only_when_the_peer_says_so(services: DirectServices) -> None:
    assert services.replied(KEY, 1, REFUSED, 0.0) == []
    assert state(services) == (DirectState.RELAYED, REFUSED)
    assert services.next_timer() is None
    assert services.retry(KEY, "/another") == []
    assert asked(services.retry(KEY, "/adder")) == ["/add"]


def test_a_change_at_the_peer_that_overtakes_its_refusal_is_not_overlooked(services: DirectServices) -> None:
    """A notification is handled at once, the response that was sent before it by the task that waits for it."""
    assert services.retry(KEY, "/adder") == []
    assert services.replied(KEY, 1, REFUSED, 5.0) == []
    assert services.next_timer() == 5.0 + limits.DIRECT_RETRY_PAUSE
    assert asked(services.handle_timer(5.0 + limits.DIRECT_RETRY_PAUSE)) == ["/add"]
    assert services.replied(KEY, 2, REFUSED, 7.0) == []
    assert services.next_timer() is None, "once for each change"


def test_late_outcomes_of_earlier_attempts_change_nothing(services: DirectServices) -> None:
    assert asked(services.renewed(KEY)) == ["/add"]
    assert services.replied(KEY, 1, GRANT, 0.0) == []
    services.replied(KEY, 2, GRANT, 0.0)
    services.renewed(KEY)
    assert services.probed(KEY, 2, "", 0.0) == []
    assert state(services)[0] is DirectState.ASKING


def test_a_condition_that_fails_here_ends_direct_calls_and_asks_nothing(services: DirectServices) -> None:
    direct(services)
    assert services.consider(KEY, "/adder", Transport.AUTO, RENAMED, 0.0) == [AnswerRelay(KEY), RELEASE]
    assert services.retry(KEY, "/adder") == []
    assert services.renewed(KEY) == []
    assert services.link_up(1) == []
    assert asked(services.consider(KEY, "/adder", Transport.AUTO, None, 0.0)) == ["/add"]


@pytest.mark.parametrize("wanted", [Transport.AUTO, Transport.DIRECT])
@pytest.mark.parametrize("unmet", [REFUSED, PASSING, Unmet(Condition.TRANSPORT, "relay there")])
def test_only_direct_warns_and_not_because_the_other_module_relays_by_rule(wanted: Transport, unmet: Unmet) -> None:
    services = DirectServices()
    services.consider(KEY, "/adder", wanted, None, 0.0)
    warns = wanted is Transport.DIRECT and unmet.condition is not Condition.TRANSPORT
    assert services.replied(KEY, 1, unmet, 0.0) == ([ServiceFallback(KEY, unmet)] if warns else [])


def test_a_restarted_server_is_relayed_at_once_and_asked_for_again(services: DirectServices) -> None:
    direct(services)
    restarted = Unmet(Condition.NODE, "/adder has restarted")
    assert services.closed(KEY, "/another", restarted, 0.0) == []
    assert services.closed(KEY, "/adder", restarted, 0.0) == [AnswerRelay(KEY), AskPeer(KEY, 2)]
    direct(services)
    assert services.closed(KEY, "/adder", REFUSED, 0.0) == [AnswerRelay(KEY)]
    assert state(services) == (DirectState.RELAYED, REFUSED)


def test_a_service_that_moves_to_another_node_begins_anew(services: DirectServices) -> None:
    direct(services)
    actions = services.consider(KEY, "/other", Transport.AUTO, None, 0.0)
    assert actions == [AnswerRelay(KEY), RELEASE, AskPeer(KEY, 1)]


def test_a_lost_link_ends_direct_calls_and_the_next_one_asks_again(services: DirectServices) -> None:
    direct(services)
    assert services.link_down(1, 0.0, crashed=False) == [AnswerRelay(KEY)]
    assert state(services)[1] == Unmet(Condition.OFFERED, "its module has no link")
    assert services.adrift(1) == set()
    assert asked(services.link_up(1)) == ["/add"]


def test_after_a_crash_direct_calls_go_on_while_the_server_answers(services: DirectServices) -> None:
    direct(services)
    assert services.link_down(1, 10.0, crashed=True) == []
    assert services.adrift(1) == {"/add"}
    for now in (10.0, 11.0, 12.0):
        assert services.next_timer() == now
        [probe] = services.handle_timer(now)
        assert isinstance(probe, ProbeServer)
        assert services.probed(KEY, probe.attempt, "", now) == []
        assert state(services) == (DirectState.DIRECT, None)
    [probe] = services.handle_timer(13.0)
    assert isinstance(probe, ProbeServer)
    assert services.probed(KEY, probe.attempt, "no answer within 1 s", 14.0) == [
        AnswerRelay(KEY),
        Lost(KEY, "no answer within 1 s"),
    ]
    assert services.adrift(1) == set()


def test_a_service_that_appears_without_a_link_is_asked_for_over_the_next_one() -> None:
    services = DirectServices()
    services.wait(KEY, "/adder", Transport.AUTO)
    assert state(services)[1] == Unmet(Condition.OFFERED, "its module has no link")
    assert services.consider(KEY, "/adder", Transport.AUTO, RENAMED, 0.0) == []
    services.wait(KEY, "/adder", Transport.AUTO)
    assert asked(services.link_up(1)) == ["/add"]


def test_a_crash_ends_what_was_not_direct_yet(services: DirectServices) -> None:
    services.replied(KEY, 1, GRANT, 0.0)
    assert services.link_down(1, 0.0, crashed=True) == []
    assert services.probed(KEY, 1, "", 0.0) == []
    assert state(services)[0] is DirectState.RELAYED


def test_a_new_run_of_the_agent_is_asked_anew(services: DirectServices) -> None:
    direct(services)
    services.link_down(1, 0.0, crashed=True)
    assert services.remove(KEY) == [AnswerRelay(KEY)]
    assert services.next_timer() is None
    assert services.consider(ServiceKey(2, "/add"), "/adder", Transport.AUTO, None, 1.0) == [
        AskPeer(ServiceKey(2, "/add"), 1)
    ]


def test_a_server_that_clients_cannot_reach_is_relayed_and_tried_again(services: DirectServices) -> None:
    assert services.unreachable(KEY, "no answer", 0.0) == []
    direct(services)
    assert services.unreachable(KEY, "no answer", 0.0) == [AnswerRelay(KEY), RELEASE]
    assert state(services) == (DirectState.RELAYED, Unmet(Condition.REACHABLE, "no answer"))
    assert asked(services.handle_timer(limits.DIRECT_RETRY)) == ["/add"]


def test_many_services_are_asked_for_a_few_at_a_time_and_every_one_in_turn() -> None:
    services = DirectServices()
    keys = [ServiceKey(1, f"/s{number}") for number in range(5 * limits.DIRECT_ASKS)]
    open_ = [name for key in keys for name in asked(services.consider(key, "/n", Transport.AUTO, None, 0.0))]
    assert len(open_) == limits.DIRECT_ASKS
    other = ServiceKey(2, "/s")
    assert asked(services.consider(other, "/n", Transport.AUTO, None, 0.0)) == ["/s"], "each peer has its own places"
    services.remove(keys[-1])  # one that still waits
    seen = []
    for number in range(len(keys) - 1):
        key = ServiceKey(1, open_.pop(0))
        seen.append(key.service)
        attempt = attempt_of(services, key)
        if number % 2:
            actions = services.replied(key, attempt, REFUSED, 0.0)
        else:
            services.replied(key, attempt, GRANT, 0.0)
            actions = services.probed(key, attempt, "", 0.0)
        open_ += asked(actions)
        assert len(open_) <= limits.DIRECT_ASKS
    assert sorted(seen) == sorted(key.service for key in keys[:-1])


def test_a_flood_of_notifications_is_one_question_at_a_time() -> None:
    services = DirectServices()
    services.consider(KEY, "/adder", Transport.AUTO, None, 0.0)
    direct(services)
    for _ in range(1000):
        services.closed(KEY, "/adder", PASSING, 0.0)
        services.retry(KEY, "/adder")
        services.renewed(KEY)
    for name in ("/unknown", "/add"):
        assert services.closed(ServiceKey(7, name), "/adder", REFUSED, 0.0) == []
        assert services.retry(ServiceKey(7, name), "/adder") == []
    assert len(list(services)) == 1
    direct(services)
