"""How a driver works off what it has to do."""

from __future__ import annotations

from types import SimpleNamespace
from typing import TYPE_CHECKING, Any, cast

import pytest

from rmpa.bridge import limits
from rmpa.bridge.actions import Describe, Disconnect, Warn
from rmpa.bridge.driver import GraphDriver
from rmpa.bridge.messages import Advertise, Description, Source, encode, op_of
from rmpa.core.contract import Contract
from rmpa.core.errors import LimitExceeded

if TYPE_CHECKING:
    from collections.abc import Callable

    from rmpa.bridge.actions import Action
    from rmpa.bridge.sessions import PeerSession

ABOUT = Description("a/B", "5a9ea5f83505693b71e785041e67a8bb", "", False)


def driver(do: Callable[[Action], None]) -> GraphDriver[Action, Advertise]:
    refusals = SimpleNamespace(refuse=lambda *_: None)
    plan = SimpleNamespace(pending=False, advertise=lambda _: (), next_timer=lambda: None, handle_timer=lambda _: ())
    return GraphDriver(
        cast("Any", SimpleNamespace(get=lambda _: None)),
        cast("Any", refusals),
        exports=cast("Any", plan),
        imports=cast("Any", plan),
        look_at=lambda _: None,
        advertisement=Advertise,
        apply=lambda _session, _message: iter(()),
        do=do,
        is_urgent=lambda action: isinstance(action, Describe),
    )


async def test_actions_that_come_meanwhile_wait_unless_urgent() -> None:
    """Data that is handled between two actions may bring more of them."""
    one, two, three = (Disconnect(Source("/t", f"/{name}")) for name in ("a", "b", "c"))
    describe = Describe(1, Source("/t", "/d"), 7, ABOUT, Contract())
    done: list[Action] = []

    def do(action: Action) -> None:
        done.append(action)
        if action is one:
            made.act([three, describe])

    made = driver(do)
    made.act([one, two])
    assert done == [one, describe, two, three]


async def test_a_failing_action_does_not_hold_up_the_next_ones(caplog: pytest.LogCaptureFixture) -> None:
    done: list[Action] = []

    def do(action: Action) -> None:
        done.append(action)
        if len(done) == 1:
            raise RuntimeError("once")

    made = driver(do)
    actions: list[Action] = [Disconnect(Source("/t", f"/{number}")) for number in range(3)]
    made.act(actions)
    assert done == actions
    assert "once" in caplog.text


async def test_warnings_are_the_drivers_own() -> None:
    made = driver(lambda action: pytest.fail(str(action)))
    made.act([Warn("kind", "who", "text")])


async def test_a_too_long_advertisement_ends_the_link_unparsed() -> None:
    made = driver(lambda action: pytest.fail(str(action)))
    payload = encode(Advertise()).replace(b"[]", b" " * limits.ADVERTISEMENT_MAX + b"[]", 1)
    assert op_of(payload) == "advertise"
    with pytest.raises(LimitExceeded):
        made.advertised(cast("PeerSession", object()), payload)
