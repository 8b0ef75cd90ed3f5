"""Fuzz target: what a peer says about direct calls of services, and what becomes of it."""

from __future__ import annotations

import contextlib
from typing import Any

import msgspec

from rmpa.bridge.direct.client_side import AnswerDirect, AskPeer, DirectServices, ProbeServer, ServiceKey
from rmpa.bridge.direct.conditions import Condition, Unmet, read_reply, read_unmet
from rmpa.bridge.direct.service_requests import read_ask, read_closed, read_retry
from rmpa.core.contract import Transport
from rmpa.core.errors import RemoteProtocolError

_KEY = ServiceKey(1, "/add")

SEEDS: list[bytes] = [
    b'{"service": "/add", "node": "/adder", "transport": "auto"}',
    b'{"service": "/add", "node": "/adder", "why": "node", "text": "restarted"}',
    b'{"service": "/add", "node": "/adder", "why": "moon", "text": "of a later release"}',
    b'{"service": "add", "node": 7}',
    b'{"port": 45000, "probe": ""}',
    b'{"port": 0}',
    b'{"port": 70000, "probe": "/adder/get_loggers"}',
    b'{"why": "listening", "text": "on loopback only"}',
    b"[1, 2]",
    b"null",
]


def fuzz(data: bytes) -> None:
    """Values or ``RemoteProtocolError``; lookups are never answered directly without a probe."""
    try:
        value = msgspec.json.decode(data)  # as messages between agents are decoded
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError):
        return
    services = DirectServices()
    services.consider(_KEY, "/adder", Transport.AUTO, None, 0.0)
    try:
        found = read_reply(value, "/adder")
    except RemoteProtocolError:
        found = Unmet(Condition.RELEASE, "malformed")
    actions = services.replied(_KEY, 1, found, 0.0)
    if not isinstance(found, Unmet) and not 0 < found.port < 1 << 16:
        raise AssertionError(f"port {found.port} was taken")
    if isinstance(value, dict):
        actions += _notified(services, value)
    if any(isinstance(action, AnswerDirect) for action in actions):
        raise AssertionError("answered directly without a probe")
    if sum(isinstance(action, AskPeer | ProbeServer) for action in actions) > 2:
        raise AssertionError("one message makes many questions")


def _notified(services: DirectServices, args: dict[str, Any]) -> list[Any]:
    actions: list[Any] = []
    with contextlib.suppress(RemoteProtocolError):
        read_ask(args)
    try:
        told = read_closed(args)
    except RemoteProtocolError:
        pass
    else:
        key = ServiceKey(1, told.service)
        actions += services.closed(key, told.node, read_unmet(told.why, told.text), 0.0)
    try:
        again = read_retry(args)
    except RemoteProtocolError:
        return actions
    return actions + list(services.retry(ServiceKey(1, again.service), again.node))
