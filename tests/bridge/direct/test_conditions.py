"""The conditions of direct transport, and the response of a peer: a port or a reason, whatever else it says."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any, cast

import pytest

from rmpa.bridge.direct.conditions import Condition, Grant, Unmet, read_reply, reply_of, unmet_by_rules
from rmpa.bridge.policy import PermissionGate
from rmpa.config.settings import TrustSettings
from rmpa.core.contract import Contract, Transport
from rmpa.core.errors import RemoteProtocolError
from rmpa.trust.permissions import Permissions

GRANT = Grant(45225, "/talker", "/talker/get_loggers")


@pytest.mark.parametrize("found", [GRANT, Unmet(Condition.CALLER_ID, "another /viewer")])
def test_a_response_is_read_as_it_was_written(found: Grant | Unmet) -> None:
    assert read_reply(reply_of(found), "/talker") == found


def test_golden_responses() -> None:
    assert reply_of(GRANT) == {"port": 45225, "probe": "/talker/get_loggers"}
    assert reply_of(Unmet(Condition.LISTENING, "loopback")) == {"why": "listening", "text": "loopback"}


@pytest.mark.parametrize(
    "value",
    [
        None,
        [],
        "45225",
        {},
        {"port": 0},
        {"port": 65536},
        {"port": -1},
        {"port": 1 << 200},
        {"port": "45225"},
        {"port": True},
        {"port": 45225.0},
        {"port": None},
        {"port": 45225, "probe": 7},
        {"why": 7},
        {"why": "node", "text": None},
    ],
)
def test_what_is_neither_a_port_nor_a_reason_is_refused(value: object) -> None:
    with pytest.raises(RemoteProtocolError):
        read_reply(value, "/talker")


def test_an_address_in_a_response_is_ignored() -> None:
    value = {"port": 45225, "address": "10.0.0.9", "host": "10.0.0.9", "uri": "http://10.0.0.9/"}
    assert read_reply(value, "/talker") == Grant(45225, "/talker", "")


@pytest.mark.parametrize("probe", ["no_slash", "/a\r\nb", "/" + "x" * 5000, "/a b", "\x00"])
def test_a_probe_that_is_no_name_is_not_sent_to_a_node(probe: str) -> None:
    assert read_reply({"port": 45225, "probe": probe}, "/talker") == Grant(45225, "/talker", "")


def test_a_reason_is_safe_to_show_and_one_of_a_later_release_is_known_as_such() -> None:
    unmet = read_reply({"why": "quantum", "text": "a\x1b[2Jb\n" + "x" * 1000}, "/talker")
    assert isinstance(unmet, Unmet)
    assert unmet.condition is Condition.RELEASE
    assert unmet.text.isprintable()
    assert len(unmet.text) <= 300


def test_only_passing_conditions_are_tried_again_by_time() -> None:
    passing = {one for one in Condition if not Unmet(one, "").lasting}
    assert passing == {
        Condition.AGENT,
        Condition.NODE,
        Condition.REACHABLE,
        Condition.STABLE,
        Condition.LIMIT,
    }


def by_trust(gate: PermissionGate, *, same_machine: bool) -> Unmet | None:
    shared = cast("Any", SimpleNamespace(context=SimpleNamespace(gate=gate)))
    peer = cast("Any", SimpleNamespace(same_machine=same_machine))
    return unmet_by_rules(Contract(transport=Transport.AUTO), shared, peer, "this module", "there", "", None)


def test_a_secured_mesh_relays_between_machines_unless_the_user_allows_plain_connections() -> None:
    secured = PermissionGate(Permissions(TrustSettings()))
    unmet = by_trust(secured, same_machine=False)
    assert unmet is not None
    assert (unmet.condition, unmet.lasting) == (Condition.TRUST, True)
    assert by_trust(secured, same_machine=True) is None
    assert by_trust(PermissionGate(Permissions(TrustSettings(direct=True))), same_machine=False) is None
    assert by_trust(PermissionGate(), same_machine=False) is None
