"""The transport in words: each state of a subscriber, and which of them need a warning."""

from __future__ import annotations

from typing import Any

import msgspec
import pytest

from rmpa.observe.why.diagnosis import misplaced, route_texts, subscriber_text
from tests.observe.samples import DIRECT, VIEWER

SAID = "a node /viewer of another module is connected already"
RELAYED: dict[str, Any] = {"transport": "relay", "state": "relayed", "condition": "caller_id", "text": SAID}
WHY = f"{SAID} (condition caller_id)"


@pytest.mark.parametrize(
    ("changes", "text"),
    [
        ({}, "direct to 10.0.0.2:41234 for /viewer"),
        (RELAYED, f"relayed for /viewer: {WHY}"),
        (RELAYED | {"transport": ""}, f"relayed for /viewer, once it connects: {WHY}"),
        (
            RELAYED | {"transport": "direct"},
            f"direct to 10.0.0.2:41234 for /viewer, has to be relayed: {WHY}",
        ),
        (
            {"transport": "relay", "state": "asking"},
            "relayed for /viewer: the peer's agent is asked whether it may be direct",
        ),
        ({"transport": "relay"}, "relayed for /viewer: it is moved to a direct connection"),
        (
            {"transport": "", "state": "asking"},
            "none yet for /viewer: the peer's agent is asked for a direct connection, and its node is tried",
        ),
        ({"state": "asking"}, "direct to 10.0.0.2:41234 for /viewer"),
        ({"state": "granted", "endpoint": "41234"}, "direct for /viewer, to port 41234 of this machine"),
    ],
)
def test_each_state_of_a_subscriber_has_its_words(changes: dict[str, Any], text: str) -> None:
    one = msgspec.structs.replace(VIEWER, **changes)
    assert subscriber_text(one) == text
    assert subscriber_text(one, "3 min") == text.replace("for /viewer", "for /viewer (3 min)", 1)


def test_a_topic_that_is_relayed_by_rule_says_so() -> None:
    text = 'transport is "relay" in this module'
    route = msgspec.structs.replace(
        DIRECT, transport="relay", condition="transport", condition_text=text, subscribers=()
    )
    assert route_texts(route) == [f"relayed: {text} (condition transport)"]
    assert route_texts(msgspec.structs.replace(route, transport="", condition="", condition_text="")) == []


@pytest.mark.parametrize(
    ("wanted", "condition", "warned"),
    [
        ("direct", "reachable", True),
        ("auto", "reachable", False),
        ("direct", "measures", False),
        ("direct", "transport", False),
    ],
)
def test_only_a_direct_contract_that_falls_back_is_warned_of(wanted: str, condition: str, warned: bool) -> None:
    one = msgspec.structs.replace(VIEWER, **(RELAYED | {"wanted": wanted, "condition": condition}))
    assert bool(misplaced(msgspec.structs.replace(DIRECT, subscribers=(one, VIEWER)))) is warned


def test_a_subscriber_that_is_direct_and_has_to_be_relayed_is_warned_of() -> None:
    one = msgspec.structs.replace(VIEWER, **(RELAYED | {"transport": "direct", "condition": "transport"}))
    assert misplaced(msgspec.structs.replace(DIRECT, subscribers=(VIEWER, one))) == [one]
