"""The gateway's own policy: [bridge] judges topics, [services] judges services and limits their calls."""

from __future__ import annotations

from rmpa.config.peer_rules import PolicySettings, ServiceRule
from rmpa.config.settings import ServiceSettings, Settings
from rmpa.gateway.neighbour import OwnPolicy, SourceKind

POLICY = OwnPolicy(
    Settings(
        policy=PolicySettings(deny=("/secret/**",), deny_types=("std_msgs/Bool",)),
        services=ServiceSettings(deny=("/stop",), timeout=7.0, rules=(ServiceRule(("/plan/**",), 300.0),)),
    )
)


def test_topics_are_judged_by_bridge_and_services_by_services() -> None:
    def crosses(kind: SourceKind, name: str, type_name: str = "std_msgs/String") -> bool:
        return POLICY.judge(kind, name, type_name, "/node").allowed

    assert crosses(SourceKind.TOPIC, "/stop")
    assert not crosses(SourceKind.SERVICE, "/stop")
    assert crosses(SourceKind.SERVICE, "/secret/plan", "std_msgs/Bool"), "the globs of [bridge] are for topics"
    assert not crosses(SourceKind.TOPIC, "/secret/plan")
    assert not crosses(SourceKind.TOPIC, "/open", "std_msgs/Bool")


def test_a_call_has_the_time_that_its_rule_gives_it() -> None:
    assert (POLICY.timeout("/plan/path"), POLICY.timeout("/other")) == (300.0, 7.0)
