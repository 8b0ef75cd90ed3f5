"""Policies of SROS 2 as rules."""

from __future__ import annotations

import pytest

from rmpa.config.permission_rules import Effect, PermissionRule
from rmpa.core.errors import ConfigError
from rmpa.trust import limits
from rmpa.trust.sros import read_sros, to_toml
from tests.fuzz import target_sros

POLICY = b"""<?xml version="1.0" encoding="UTF-8"?>
<policy version="0.2.0" xmlns:xi="http://www.w3.org/2001/XInclude">
  <enclaves>
    <enclave path="/lab/talker">
      <profiles>
        <profile ns="/" node="talker">
          <xi:include href="common/node.xml" xpointer="xpointer(/profile/*)"/>
          <topics publish="ALLOW"><topic>chatter</topic><topic>/abs/*</topic></topics>
          <topics subscribe="ALLOW" publish="DENY"><topic>parameter_events</topic></topics>
          <services reply="ALLOW" request="ALLOW"><service>~/reset</service></services>
        </profile>
        <profile ns="/arm" node="planner">
          <topics subscribe="DENY"><topic>secret</topic><topic>/clock</topic><topic>bad name</topic></topics>
          <services request="ALLOW"><service>ik</service></services>
          <actions call="ALLOW"><action>move</action></actions>
          <actions execute="ALLOW"><action>/pick</action></actions>
        </profile>
      </profiles>
    </enclave>
    <enclave path="/"><profiles/></enclave>
  </enclaves>
</policy>
"""


def test_golden() -> None:
    imported = read_sros(POLICY)
    assert imported.rules == (
        PermissionRule(
            ("talker",),
            names={
                "publish": ("/chatter", "/abs/**"),
                "subscribe": ("/parameter_events",),
                "call": ("/talker/reset", "/arm/ik"),
                "serve": ("/talker/reset",),
                "action": ("/arm/move",),
                "action_serve": ("/pick",),
            },
        ),
        PermissionRule(
            ("talker",),
            effect=Effect.DENY,
            names={"publish": ("/parameter_events",), "subscribe": ("/arm/secret",)},
        ),
    )
    notes = "\n".join(imported.notes)
    for text in ("xi:include", "enclave '/' has no name", "'/clock' is left out", "'bad name' is left out"):
        assert text in notes
    target_sros.fuzz(POLICY)
    assert "[[permission]]" in to_toml(imported)


@pytest.mark.parametrize(
    "text", [b"<policy><enclaves/></policy>", b"<policy><enclaves><enclave/></enclaves></policy>"]
)
def test_one_without_rules(text: bytes) -> None:
    assert read_sros(text).rules == ()


def test_the_number_of_rules_is_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(limits, "SROS_RULES_MAX", 1)
    with pytest.raises(ConfigError, match="more than 1 rules"):
        read_sros(POLICY)
