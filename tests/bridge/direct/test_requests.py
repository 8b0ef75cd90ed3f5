"""The arguments of requests about direct transport: golden, malformed, and any that can be written."""

from __future__ import annotations

import json
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rmpa.bridge import limits
from rmpa.bridge.direct import requests
from rmpa.bridge.direct.requests import CloseDirect, DirectClosed, OpenDirect, RetryDirect
from rmpa.bridge.messages import Source
from rmpa.config import limits as config_limits
from rmpa.core.contract import Contract, Transport
from rmpa.core.errors import RemoteProtocolError

READERS = {
    OpenDirect: requests.read_open,
    CloseDirect: requests.read_close,
    DirectClosed: requests.read_closed,
    RetryDirect: requests.read_retry,
}
PLACE = {"topic": "/chatter", "node": "/talker"}
GOLDEN: list[tuple[requests.Arguments, dict[str, Any]]] = [
    (CloseDirect("/chatter", "/talker", "/viewer"), {**PLACE, "subscriber": "/viewer"}),
    (CloseDirect("/chatter", "/talker", "/viewer", True), {**PLACE, "subscriber": "/viewer", "broken": True}),
    (
        DirectClosed("/chatter", "/talker", "", "node", "it has restarted"),
        {**PLACE, "subscriber": "", "why": "node", "text": "it has restarted"},
    ),
    (RetryDirect("/chatter", "/talker"), PLACE),
]
NAMES = st.from_regex(r"/[a-z][a-z0-9_]{0,10}", fullmatch=True)


@pytest.mark.parametrize(("arguments", "golden"), GOLDEN)
def test_golden_arguments(arguments: requests.Arguments, golden: dict[str, Any]) -> None:
    assert requests.write(arguments) == golden
    assert READERS[type(arguments)](golden) == arguments


def test_a_request_carries_the_whole_contract_and_no_address() -> None:
    asked = OpenDirect("/chatter", "/talker", "/viewer", Contract(transport=Transport.AUTO))
    written = requests.write(asked)
    assert set(written) == {"topic", "node", "subscriber", "contract"}
    assert written["contract"]["transport"] == "auto"
    assert requests.read_open(json.loads(json.dumps(written))) == asked
    # An agent of an earlier release sends no transport: that means relay.
    del written["contract"]["transport"]
    assert requests.read_open(written).contract.transport is Transport.RELAY


@given(NAMES, NAMES, NAMES, st.sampled_from(list(Transport)))
def test_what_is_written_can_be_read(topic: str, node: str, subscriber: str, transport: Transport) -> None:
    asked = OpenDirect(topic, node, subscriber, Contract(transport=transport))
    assert requests.read_open(json.loads(json.dumps(requests.write(asked)))) == asked
    assert asked.source == Source(topic, node)


BAD: list[dict[str, Any]] = [
    {},
    {"topic": "chatter"},
    {"topic": "/a//b"},
    {"topic": "/a\n"},
    {"topic": "/\x1b[2J"},
    {"topic": "/" + "x" * config_limits.CROSSING_NAME_MAX},
    {"topic": 3},
    {"topic": None},
    {"node": ["/talker"]},
    {"node": ""},
    {"subscriber": "viewer"},
    {"subscriber": {}},
]


@pytest.mark.parametrize("change", BAD)
@pytest.mark.parametrize("kind", READERS)
def test_what_is_malformed_is_refused_with_a_text_safe_to_log(
    kind: type[requests.Arguments], change: dict[str, Any]
) -> None:
    good = requests.write(OpenDirect("/chatter", "/talker", "/viewer", Contract())) | {"why": "node", "text": ""}
    bad = good | change if change else {}
    if kind is RetryDirect and "subscriber" in change:
        return  # it has none
    with pytest.raises(RemoteProtocolError) as caught:
        READERS[kind](bad)
    assert str(caught.value).isprintable()
    assert len(str(caught.value)) < 1000


@pytest.mark.parametrize(
    "contract", [{"depth": 0}, {"depth": 1 << 40}, {"max_rate": -1.0}, {"transport": "udp"}, {"outage": 1e9}, 5]
)
def test_a_contract_that_no_rule_can_make_is_refused(contract: object) -> None:
    with pytest.raises(RemoteProtocolError):
        requests.read_open({**PLACE, "subscriber": "/viewer", "contract": contract})


def test_a_reason_has_a_bound() -> None:
    closed = {**PLACE, "subscriber": "", "why": "node", "text": "x" * (limits.CONTROL_TEXT_MAX + 1)}
    with pytest.raises(RemoteProtocolError, match="characters"):
        requests.read_closed(closed)
