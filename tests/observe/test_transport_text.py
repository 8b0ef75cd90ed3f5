"""The transport in words: each state of a subscriber, and which of them need a warning."""

from __future__ import annotations

from typing import Any

import msgspec
import pytest

from rmpa.observe.why.diagnosis import misplaced, route_texts, subscriber_text
from tests.observe.samples import DIRECT, VIEWER

SAID = "a node /viewer of another module is connected already"
RELAYED: dict[str, Any] = {"transport": "relay", "state": "relayed", "condition": "caller_id", "text": SAID}


STATES: dict[str, dict[str, Any]] = {
    "direct": {},
    "relayed": RELAYED,
    "to be relayed": RELAYED | {"transport": ""},
    "direct, and to be relayed": RELAYED | {"transport": "direct"},
    "relayed, and asked": {"transport": "relay", "state": "asking"},
    "relayed, and moved": {"transport": "relay"},
    "asked": {"transport": "", "state": "asking"},
    "direct, and asked again": {"state": "asking"},
    "granted": {"state": "granted", "endpoint": "41234"},
}
"""The states of a subscriber; the golden file has their words."""


def words() -> list[str]:
    return [
        f"{name}: {subscriber_text(msgspec.structs.replace(VIEWER, **of), '3 min')}" for name, of in STATES.items()
    ]


def test_a_topic_that_is_relayed_by_rule_says_so() -> None:
    text = 'the setting transport = "relay" of this module asks for it'
    route = msgspec.structs.replace(
        DIRECT, transport="relay", condition="transport", condition_text=text, subscribers=()
    )
    assert route_texts(route) == [f"relayed: {text}"]
    assert route_texts(msgspec.structs.replace(route, transport="", condition="", condition_text="")) == []


@pytest.mark.parametrize(
    ("changes", "warned"),
    [
        ({"wanted": "direct", "condition": "reachable"}, True),
        ({"wanted": "auto", "condition": "reachable"}, False),
        ({"wanted": "direct", "condition": "measures"}, False),
        ({"wanted": "direct", "condition": "transport"}, False),
        ({"transport": "direct", "condition": "transport"}, True),  # and has to be relayed
    ],
)
def test_only_a_direct_contract_that_falls_back_is_warned_of(changes: dict[str, str], warned: bool) -> None:
    one = msgspec.structs.replace(VIEWER, **(RELAYED | changes))
    assert misplaced(msgspec.structs.replace(DIRECT, subscribers=(one, VIEWER))) == [one] * warned
