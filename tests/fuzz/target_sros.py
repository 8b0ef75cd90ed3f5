"""Fuzz target: SROS 2's permissions and policies."""

from __future__ import annotations

import tomllib

from rmpa.config.permission_rules import PERMISSION_RULES
from rmpa.core.errors import ConfigError
from rmpa.trust.sros import read_sros, to_toml

_BEGIN = b"<dds><permissions><grant name='g'><subject_name>CN=/lab/talker</subject_name>"
_END = b"<default>DENY</default></grant></permissions></dds>"

SEEDS: list[bytes] = [
    b"",
    b"<dds><permissions/></dds>",
    _BEGIN + b"<allow_rule><publish><topics><topic>rt/chatter</topic></topics></publish></allow_rule>" + _END,
    _BEGIN + b"<deny_rule><subscribe><topics><topic>rr/a/bReply</topic></topics></subscribe></deny_rule>" + _END,
    _BEGIN
    + b"<allow_rule><publish><topics><topic>*</topic><topic>rt/a*b/?</topic>"
    + b"<topic>rq/m/_action/send_goalRequest</topic></topics></publish></allow_rule>"
    + _END,
    (
        b"<policy><enclaves><enclave path='/lab/talker'><profiles><profile ns='/x' node='n'><topics publish='ALLOW'>"
        b"<topic>~/y</topic><topic>z*</topic></topics><services reply='DENY'><service>s</service></services>"
        b"<actions call='ALLOW'><action>/a</action></actions></profile></profiles></enclave></enclaves></policy>"
    ),
    b"<!DOCTYPE d [<!ENTITY a 'b'>]><dds>&a;</dds>",
]


def fuzz(data: bytes) -> None:
    """Whatever comes in: rules that rmpa.toml may have, or an error for the user."""
    try:
        imported = read_sros(data)
    except ConfigError as error:
        str(error)
        return
    tables = tomllib.loads(to_toml(imported)).get("permission", [])
    if PERMISSION_RULES.read(tables) != imported.rules:
        raise AssertionError("the rules do not survive their round trip")
