"""The arguments about direct calls of services, as they cross."""

from __future__ import annotations

from typing import Any

import pytest

from rmpa.bridge import limits
from rmpa.bridge.direct.service_requests import (
    AskService,
    CloseService,
    RetryService,
    ServiceDirectClosed,
    read_ask,
    read_close,
    read_closed,
    read_retry,
    write,
)
from rmpa.core.contract import Transport
from rmpa.core.errors import RemoteProtocolError

ASK = {"service": "/arm/grip", "node": "/gripper", "transport": "auto"}
CLOSED = {"service": "/arm/grip", "node": "/gripper", "why": "node", "text": "/gripper has restarted"}
RETRY = {"service": "/arm/grip", "node": "/gripper"}


def test_they_cross_as_the_protocol_says() -> None:
    ask = AskService("/arm/grip", "/gripper", Transport.AUTO)
    closed = ServiceDirectClosed("/arm/grip", "/gripper", "node", "/gripper has restarted")
    retry = RetryService("/arm/grip", "/gripper")
    assert (write(ask), write(closed), write(retry)) == (ASK, CLOSED, RETRY)
    assert (read_ask(ASK), read_closed(CLOSED), read_retry(RETRY)) == (ask, closed, retry)
    assert write(CloseService("/arm/grip", "/gripper")) == RETRY
    assert read_close(RETRY) == CloseService("/arm/grip", "/gripper")
    assert read_retry(RETRY | {"of a later release": 1}) == retry


@pytest.mark.parametrize(
    "wrong",
    [
        {"service": "arm/grip"},
        {"service": ""},
        {"service": 7},
        {"node": "/a b"},
        {"node": None},
        {"service": "/" + "x" * 2000},
        {"transport": "teleport"},
        {"transport": None},
    ],
)
def test_what_is_no_question_is_refused(wrong: dict[str, Any]) -> None:
    with pytest.raises(RemoteProtocolError):
        read_ask(ASK | wrong)


def test_a_long_reason_and_missing_fields_are_refused() -> None:
    with pytest.raises(RemoteProtocolError):
        read_closed(CLOSED | {"text": "x" * (limits.CONTROL_TEXT_MAX + 1)})
    for key in CLOSED:
        with pytest.raises(RemoteProtocolError):
            read_closed({name: value for name, value in CLOSED.items() if name != key})
    with pytest.raises(RemoteProtocolError):
        read_retry({})
