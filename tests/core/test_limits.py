"""Limits: each has a reason, and they fit each other."""

from __future__ import annotations

import ast
from pathlib import Path

from rmpa.core import limits


def test_every_limit_has_its_reason() -> None:
    body = ast.parse(Path(limits.__file__).read_text(encoding="utf-8")).body
    for number, node in enumerate(body):
        if (
            isinstance(node, ast.AnnAssign)
            and isinstance(node.target, ast.Name)
            and node.target.id not in ("KIB", "MIB")
        ):
            reason = body[number + 1] if number + 1 < len(body) else None
            assert isinstance(reason, ast.Expr), node.target.id
            assert isinstance(reason.value, ast.Constant), node.target.id


def test_limits_fit_each_other() -> None:
    assert limits.KEEPALIVE_INTERVAL * 3 < limits.LINK_LEASE
    assert limits.HEARTBEAT_INTERVAL * 3 < limits.ROSTER_LEASE
    assert limits.BACKOFF_FIRST < limits.BACKOFF_MAX
    assert limits.CONTROL_PAYLOAD_MAX < limits.FRAME_PAYLOAD_MAX
    assert limits.TCPROS_MESSAGE_MAX + 4 <= limits.FRAME_PAYLOAD_MAX
    assert limits.MULTICAST_PORT + limits.DOMAIN_MAX < 65536
    largest = 42 + limits.PEER_NAME_MAX + 4 * limits.BEACON_ADDRESSES_MAX + 1 + 8 * limits.BEACON_GOSSIP_MAX
    assert largest <= limits.BEACON_MAX_BYTES
