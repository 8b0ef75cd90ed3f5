"""How a bridge works off what it has to do; whole bridges are tested with their agents."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING, cast

import pytest

from rmpa.bridge import limits
from rmpa.bridge.actions import Describe, Disconnect, Warn
from rmpa.bridge.io.bridge import Bridge
from rmpa.bridge.messages import Advertise, Description, Source, TopicOffer, encode
from rmpa.bridge.policy import Policy
from rmpa.config import limits as config_limits
from rmpa.config.settings import PolicySettings
from rmpa.core.contract import Contract
from rmpa.core.errors import LimitExceeded

if TYPE_CHECKING:
    from rmpa.bridge.actions import Action
    from rmpa.bridge.io.bridge import PeerSession
    from rmpa.mesh.io.link import PeerLink
    from rmpa.ros.core.embedded import RosCore

ABOUT = Description("a/B", "5a9ea5f83505693b71e785041e67a8bb", "", False)


class Core:
    """What making a bridge needs of a core."""

    uri = "http://127.0.0.1:1/"
    node_host = node_address = "127.0.0.1"


@pytest.fixture
async def bridge() -> Bridge:
    made = Bridge(cast("RosCore", Core()), Policy(PolicySettings()), rng=lambda: 0.5)
    made._loop = asyncio.get_running_loop()
    return made


async def test_what_comes_while_others_are_done_waits_but_for_descriptions(
    bridge: Bridge, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A reader of data may bring more to do at any breath between two actions."""
    one, two, three = (Disconnect(Source("/t", f"/{name}")) for name in ("a", "b", "c"))
    describe = Describe(1, Source("/t", "/d"), 7, ABOUT, Contract())
    done: list[Action] = []

    def do(action: Action) -> None:
        done.append(action)
        if action is one:
            bridge._act([three, describe])

    monkeypatch.setattr(bridge, "_do", do)
    bridge._act([one, two])
    assert done == [one, describe, two, three]


async def test_an_action_that_fails_does_not_hold_up_the_next_ones(
    bridge: Bridge, monkeypatch: pytest.MonkeyPatch
) -> None:
    done: list[Action] = []

    def do(action: Action) -> None:
        done.append(action)
        if len(done) == 1:
            raise RuntimeError("once")

    monkeypatch.setattr(bridge, "_do", do)
    warnings = [Warn("kind", "who", str(number)) for number in range(3)]
    with pytest.raises(RuntimeError):
        bridge._act(list(warnings))
    bridge._act([])
    assert done == warnings


def test_the_longest_advertisement_of_ours_is_within_the_limit_of_one() -> None:
    longest = "/" + "x" * (config_limits.CROSSING_NAME_MAX - 1)
    kind = f"a/{'x' * (config_limits.CROSSING_NAME_MAX - 2)}"
    offers = tuple(TopicOffer(longest, longest, kind) for _ in range(limits.ADVERTISED_AT_ONCE))
    assert len(encode(Advertise(added=offers, full=True, more=True))) < limits.ADVERTISEMENT_MAX


async def test_a_longer_one_ends_the_link_before_it_is_read(bridge: Bridge) -> None:
    link = cast("PeerLink", object())
    bridge._by_link[link] = cast("PeerSession", object())
    payload = encode(Advertise()).replace(b"[]", b" " * limits.ADVERTISEMENT_MAX + b"[]", 1)
    assert payload.startswith(b'{"op":"advertise"')
    with pytest.raises(LimitExceeded):
        bridge.control(link, payload)
