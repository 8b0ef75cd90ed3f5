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
    assert limits.TCPROS_MESSAGE_MAX + 4 == limits.MESSAGE_MAX <= limits.DATA_PAYLOAD_MAX * 65536
    assert limits.CONTROL_PAYLOAD_MAX <= limits.LINK_URGENT_BYTES
    assert limits.MULTICAST_PORT + limits.DOMAIN_MAX < 65536
    largest = 42 + limits.PEER_NAME_MAX + 4 * limits.BEACON_ADDRESSES_MAX + 1 + 8 * limits.BEACON_GOSSIP_MAX
    assert largest <= limits.BEACON_MAX_BYTES


def test_the_limits_of_the_lanes_fit_each_other() -> None:
    assert limits.EXPRESS_MESSAGE_MAX <= limits.FRAGMENT_BYTES <= limits.DATA_PAYLOAD_MAX
    assert limits.CUT_THROUGH_BYTES <= limits.FRAGMENT_BYTES <= limits.DATA_PAYLOAD_MAX
    assert limits.COMMIT_BYTES <= 4 * limits.FRAGMENT_BYTES, "what is prepared delays whoever comes next"
    assert limits.BULK_UNSENT_BYTES < limits.LINK_UNSENT_BYTES <= limits.COMMIT_BYTES
    assert limits.LINK_LEASE < limits.LINK_UNACKED < limits.BULK_LEASE, "the lease, which can say why, speaks first"
    assert limits.STALE_HOLD < limits.STALE_TICK < limits.STALE_AGE < limits.BULK_STALE_AGE
    assert limits.ROUTE_QUEUE_MESSAGES <= limits.CONTRACT_DEPTH_MAX < limits.KEEP_ALL_MESSAGES


def test_a_reliable_sender_never_waits_for_a_delayed_acknowledgement() -> None:
    assert limits.RELIABLE_WINDOW_MESSAGES >= 2 * limits.ACK_MESSAGES
    assert limits.RELIABLE_WINDOW_BYTES >= 2 * limits.ACK_BYTES
    assert limits.RELIABLE_WINDOW_BYTES <= limits.REPLAY_BYTES <= limits.RESUME_BYTES_MAX
    assert limits.ACK_DELAY < limits.LINK_LEASE < limits.RESUME_WINDOW
