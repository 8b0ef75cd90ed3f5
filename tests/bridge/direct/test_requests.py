"""The arguments of requests about direct transport: golden, malformed, and any that can be written."""

from __future__ import annotations

import json
from typing import Any

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rmpa.bridge.direct.conditions import DirectAsk, Want, read_ask
from rmpa.config import limits as config_limits
from rmpa.core.contract import Contract, Transport
from rmpa.core.errors import RemoteProtocolError

WANT = Want("/chatter", "/talker", "/viewer")
NAMES = st.from_regex(r"/[a-z][a-z0-9_]{0,10}", fullmatch=True)


def test_a_request_carries_the_whole_contract_and_no_address() -> None:
    asked = DirectAsk(*WANT, Contract(transport=Transport.AUTO))
    written = msgspec.to_builtins(asked)
    assert set(written) == {"name", "node", "user", "contract"}
    assert written["contract"]["transport"] == "auto"
    assert read_ask(json.loads(json.dumps(written))) == asked
    assert msgspec.to_builtins(DirectAsk("/add", "/adder")) == {"name": "/add", "node": "/adder"}


def test_a_notification_names_what_is_wanted() -> None:
    assert WANT._asdict() == {"name": "/chatter", "node": "/talker", "user": "/viewer"}
    assert read_ask(WANT._asdict()).want == WANT
    assert read_ask({"name": "/add", "node": "/adder"}).want == Want("/add", "/adder")


@given(NAMES, NAMES, NAMES, st.sampled_from(list(Transport)), st.booleans())
def test_what_is_written_can_be_read(name: str, node: str, user: str, transport: Transport, broken: bool) -> None:
    asked = DirectAsk(name, node, user, Contract(transport=transport), broken)
    assert read_ask(json.loads(json.dumps(msgspec.to_builtins(asked)))) == asked


BAD: list[dict[str, Any]] = [
    {"name": "chatter"},
    {"name": "/a//b"},
    {"name": "/a\n"},
    {"name": "/\x1b[2J"},
    {"name": "/" + "x" * config_limits.CROSSING_NAME_MAX},
    {"name": 3},
    {"name": None},
    {"node": ["/talker"]},
    {"node": ""},
    {"user": "viewer"},
    {"user": {"a": 1}},
]


@pytest.mark.parametrize("change", BAD)
def test_what_is_malformed_is_refused_with_a_text_safe_to_log(change: dict[str, Any]) -> None:
    with pytest.raises(RemoteProtocolError) as caught:
        read_ask(msgspec.to_builtins(DirectAsk(*WANT, Contract())) | change)
    assert str(caught.value).isprintable()
    assert len(str(caught.value)) < 1000
    with pytest.raises(RemoteProtocolError):
        read_ask({})


@pytest.mark.parametrize(
    "contract", [{"depth": 0}, {"depth": 1 << 40}, {"max_rate": -1.0}, {"transport": "udp"}, {"outage": 1e9}, 5]
)
def test_a_contract_that_no_rule_can_make_is_refused(contract: object) -> None:
    with pytest.raises(RemoteProtocolError):
        read_ask(WANT._asdict() | {"contract": contract})
