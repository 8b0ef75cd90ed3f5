from __future__ import annotations

from typing import Any

import pytest

from rmpa.bridge.messages import (
    Advertise,
    Description,
    Mismatch,
    OpenRoute,
    RouteClosed,
    RouteOpened,
    Source,
    TopicOffer,
)
from rmpa.bridge.policy import Names, Policy
from rmpa.config.peer_rules import PolicySettings
from rmpa.core.contract import Contract, ContractRule, Contracts, Reliability, Transport
from tests.bridge.recorder import Detach, Imports, Publish, Retract, Send, Warn

CMD = Source("/cmd", "/joy")
OFFER = TopicOffer("/cmd", "/joy", "sensor_msgs/Joy")
ABOUT = Description("sensor_msgs/Joy", "5a9ea5f83505693b71e785041e67a8bb", "Header header\n", False)


@pytest.fixture
def imports() -> Imports:
    machine = Imports(Policy(PolicySettings(deny=("/secret",))), rng=lambda: 1.0)
    machine.link_up(1)
    return machine


def state(imports: Imports, peer: int = 1) -> str:
    entry = imports.entry(peer, CMD)
    found: str = entry.state
    return found


def test_a_closed_route_is_asked_for_again_with_a_growing_delay(imports: Imports) -> None:
    imports.advertised(1, Advertise(added=(OFFER,)))
    imports.demand(1, CMD, 0.0, wanted=True)
    now, delays = 0.0, []
    for attempt in range(1, 8):
        assert imports.closed(1, RouteClosed(attempt, "it closed the connection"), now) == [
            Detach(1, CMD, attempt, missed=True)
        ]
        assert state(imports) == "waiting"
        timer = imports.next_timer()
        assert timer is not None
        delays.append(round(timer - now, 3))
        now = timer
        assert imports.handle_timer(now) == [Send(1, OpenRoute(attempt + 1, "/cmd", "/joy"))]
    assert delays == [0.1, 0.2, 0.4, 0.8, 1.6, 2.0, 2.0]
    entry = imports.entry(1, CMD)
    assert entry.problem == "it closed the connection"
    imports.opened(1, RouteOpened(8, ABOUT), now)
    assert entry.problem == ""


def test_another_type_than_the_local_one_is_refused_at_both_ends(imports: Imports) -> None:
    imports.local_type("/cmd", "std_msgs/String")
    warn, told = imports.advertised(1, Advertise(added=(OFFER,)))
    assert isinstance(warn, Warn)
    assert "std_msgs/String" in warn.text
    assert "sensor_msgs/Joy" in warn.text
    assert isinstance(told, Send)
    assert isinstance(told.message, Mismatch)
    assert imports.demand(1, CMD, 0.0, wanted=False) == []
    over = Send(1, Mismatch("/cmd", "/joy", "", ""))
    assert imports.local_type("/cmd", None) == [Publish(1, CMD, "sensor_msgs/Joy"), over]
    retract, *loud = imports.local_type("/cmd", "std_msgs/String")
    assert retract == Retract(1, CMD)
    assert [type(action) for action in loud] == [Warn, Send]


def test_a_publisher_with_another_type_than_offered_is_not_described(imports: Imports) -> None:
    imports.advertised(1, Advertise(added=(OFFER,)))
    imports.demand(1, CMD, 0.0, wanted=True)
    odd = Description("a/B", "5a9ea5f83505693b71e785041e67a8bb", "", False)
    actions = imports.opened(1, RouteOpened(1, odd), 0.0)
    assert [type(action) for action in actions] == [Send, Warn, Detach]
    assert state(imports) == "waiting"


# --- contracts, and links that come back --------------------------------------------------------------------------

SURE = Contract(reliability=Reliability.RELIABLE)
OPENED = RouteOpened(1, ABOUT, SURE, epoch=5, first=1)
ODOM = TopicOffer("/odom", "/base", "a/B")


Positions = dict[tuple[int, Source], tuple[int, int]]
"""What the data path says of reliable routes that outlived their links."""


@pytest.fixture
def positions() -> Positions:
    return {}


@pytest.fixture
def flowing(positions: Positions) -> Imports:
    """Of peer 1, /cmd flows reliably by route 1 and /odom by best effort by route 2; both are listened to."""
    rules = Contracts((ContractRule(("/cmd",), (), {"reliability": Reliability.RELIABLE}),))
    machine = Imports(Policy(PolicySettings()), lambda: 1.0, rules, lambda *place: positions.get(place))
    machine.link_up(1)
    machine.advertised(1, Advertise(added=(OFFER, ODOM), full=True))
    machine.demand(1, CMD, 0.0, wanted=True)
    machine.demand(1, ODOM.source, 0.0, wanted=True)
    machine.opened(1, OPENED, 0.0)
    machine.opened(1, RouteOpened(2, Description("a/B", ABOUT.md5, "", False)), 0.0)
    return machine


def opens(actions: list[Any]) -> list[OpenRoute]:
    return [a.message for a in actions if isinstance(a, Send) and isinstance(a.message, OpenRoute)]


def test_another_transport_alone_leaves_routes_open(flowing: Imports) -> None:
    rule = ContractRule(("/cmd",), (), {"reliability": Reliability.RELIABLE})
    changed = ContractRule(("/cmd",), (), {"reliability": Reliability.RELIABLE, "depth": 5})

    def applied(rules: Contracts) -> list[Any]:
        return [a for some in flowing.apply_rules(Policy(PolicySettings()), rules, Names(), 0.0) for a in some]

    assert applied(Contracts((rule,), Transport.AUTO)) == []
    assert applied(Contracts((rule,), Transport.DIRECT)) == []
    (asked,) = opens(applied(Contracts((changed,), Transport.DIRECT)))
    assert asked.contract == Contract(reliability=Reliability.RELIABLE, depth=5, transport=Transport.DIRECT)
