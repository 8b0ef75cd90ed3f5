"""SROS 2's permissions as rules: what each topic of DDS becomes, and what is refused."""

from __future__ import annotations

import tomllib

import pytest

from rmpa.config.permission_rules import PERMISSION_RULES, Access, Effect, PermissionRule
from rmpa.config.settings import TrustSettings
from rmpa.core.errors import ConfigError
from rmpa.trust import limits
from rmpa.trust.permissions import Permissions
from rmpa.trust.sros import read_sros, to_toml
from tests.fuzz import target_sros

TALKER = """<?xml version="1.0" encoding="UTF-8"?>
<dds xmlns:xsi="http://www.w3.org/2001/XMLSchema-instance"
     xsi:noNamespaceSchemaLocation="http://www.omg.org/spec/DDS-SECURITY/20170901/omg_shared_ca_permissions.xsd">
  <permissions>
    <grant name="/lab/talker">
      <subject_name>CN=/lab/talker</subject_name>
      <validity>
        <not_before>2026-01-01T00:00:00</not_before>
        <not_after>2036-01-01T00:00:00</not_after>
      </validity>
      <allow_rule>
        <domains><id>0</id></domains>
        <publish>
          <topics>
            <topic>rt/chatter</topic>
            <topic>rt/rosout</topic>
            <topic>rq/talker/set_parametersRequest</topic>
            <topic>rq/plan/pathRequest</topic>
            <topic>rr/talker/resetReply</topic>
            <topic>rq/arm/move/_action/send_goalRequest</topic>
            <topic>rr/pick/_action/send_goalReply</topic>
            <topic>rt/pick/_action/feedback</topic>
          </topics>
          <partitions><partition>x</partition></partitions>
        </publish>
        <subscribe>
          <topics>
            <topic>rt/joints/*</topic>
            <topic>rr/plan/pathReply</topic>
            <topic>ros_discovery_info</topic>
            <topic>rt/[ab]</topic>
          </topics>
        </subscribe>
      </allow_rule>
      <default>DENY</default>
    </grant>
  </permissions>
</dds>
"""


def _grant(body: str, subject: str = "CN=/talker") -> bytes:
    grant = f"<grant name='g'><subject_name>{subject}</subject_name>{body}</grant>"
    return f"<dds><permissions>{grant}</permissions></dds>".encode()


def _rule(effect: str, direction: str, *topics: str) -> str:
    inner = "".join(f"<topic>{topic}</topic>" for topic in topics)
    return f"<{effect}_rule><{direction}><topics>{inner}</topics></{direction}></{effect}_rule>"


def test_a_file_of_sros_becomes_one_rule() -> None:
    imported = read_sros(TALKER.encode())
    assert imported.rules == (
        PermissionRule(
            ("talker",),
            names={
                "publish": ("/chatter",),
                "subscribe": ("/joints/**",),
                "call": ("/plan/path",),
                "serve": ("/talker/reset",),
                "action": ("/arm/move",),
                "action_serve": ("/pick",),
            },
        ),
    )
    notes = "\n".join(imported.notes)
    for word in ("validity", "domains", "partitions", "rt/rosout", "param = [...]", "rt/[ab]"):
        assert word in notes
    assert "ros_discovery_info" not in notes


def test_the_tables_can_be_read_again() -> None:
    imported = read_sros(TALKER.encode())
    tables = tomllib.loads(to_toml(imported))["permission"]
    assert PERMISSION_RULES.read(tables) == imported.rules


def test_the_star_is_everything() -> None:
    rules = read_sros(_grant(_rule("allow", "publish", "*"))).rules
    permissions = Permissions(TrustSettings(rules=rules))
    for access in (Access.PUBLISH, Access.CALL, Access.SERVE):
        assert permissions.judge(access, "talker", "/a/b").allowed
    assert not permissions.judge(Access.SUBSCRIBE, "talker", "/a/b").allowed
    assert not permissions.judge(Access.PUBLISH, "listener", "/a/b").allowed


def test_a_denied_reply_prevents_the_call() -> None:
    body = _rule("deny", "subscribe", "rr/plan/pathReply") + _rule("allow", "publish", "*")
    permissions = Permissions(TrustSettings(rules=read_sros(_grant(body)).rules))
    assert not permissions.judge(Access.CALL, "talker", "/plan/path").allowed
    assert permissions.judge(Access.CALL, "talker", "/plan/other").allowed


def test_default_allow_lets_what_is_not_denied() -> None:
    body = _rule("deny", "publish", "rt/cmd_vel") + "<default>ALLOW</default>"
    permissions = Permissions(TrustSettings(rules=read_sros(_grant(body)).rules))
    assert not permissions.judge(Access.PUBLISH, "talker", "/cmd_vel").allowed
    assert permissions.judge(Access.PUBLISH, "talker", "/odom").allowed


def test_a_denial_behind_an_allowance_is_reported() -> None:
    body = _rule("allow", "publish", "rt/*") + _rule("deny", "publish", "rt/cmd_vel")
    imported = read_sros(_grant(body))
    assert [rule.effect for rule in imported.rules] == [Effect.ALLOW, Effect.DENY]
    assert any("denial of publish /cmd_vel" in note for note in imported.notes)
    straight = _rule("deny", "publish", "rt/cmd_vel") + _rule("allow", "publish", "rt/*")
    assert not read_sros(_grant(straight)).notes


@pytest.mark.parametrize(
    ("subject", "module"),
    [
        ("CN=/talker", "talker"),
        ("emailAddress=x@y.org,CN=/robot/front-camera", "front_camera"),
        ("C=DE, O=Lab, CN=arm1", "arm1"),
        ("CN=/", None),
        ("O=Lab", None),
        ("", None),
    ],
)
def test_the_module_is_the_last_part_of_the_common_name(subject: str, module: str | None) -> None:
    imported = read_sros(_grant(_rule("allow", "publish", "rt/x"), subject))
    assert [rule.modules for rule in imported.rules] == ([(module,)] if module else [])
    assert bool(imported.notes) is (module is None)


@pytest.mark.parametrize(
    ("data", "problem"),
    [
        (b"", "not XML"),
        (b"permissions", "not XML"),
        (b"<dds/>", "no permissions"),
        (b"<policy><permissions/></policy>", "no permissions"),
        (b"<!DOCTYPE dds><dds><permissions/></dds>", "not XML that can be read"),
        (b"<!DOCTYPE d [<!ENTITY a 'b'>]><dds><permissions/>&a;</dds>", "not XML that can be read"),
        (b"<!DOCTYPE d [<!ENTITY a SYSTEM 'file:///etc/passwd'>]><dds>&a;</dds>", "not XML that can be read"),
        (b"<?xml version='1.0' encoding='nonsense'?><dds/>", "not XML"),
        (b"<a>" * 100, "nested elements"),
        (b" " * (limits.SROS_FILE_MAX + 1), "more than"),
    ],
)
def test_what_cannot_be_read_is_refused(data: bytes, problem: str) -> None:
    with pytest.raises(ConfigError, match=problem):
        read_sros(data)


def test_too_many_rules_are_refused() -> None:
    with pytest.raises(ConfigError, match="more than 4096 rules"):
        read_sros(_grant(_rule("allow", "publish", "rt/x") * 4097))


def test_no_rules_is_no_error() -> None:
    assert read_sros(b"<dds><permissions/></dds>").rules == ()


def test_the_fuzz_target_takes_its_seeds() -> None:
    for seed in target_sros.SEEDS:
        target_sros.fuzz(seed)
