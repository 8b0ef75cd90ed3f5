from __future__ import annotations

import pytest

from rmpa.bridge.policy import Policy
from rmpa.config.peer_rules import PolicySettings
from rmpa.core.identity import NEVER_CROSSING


@pytest.mark.parametrize(
    ("settings", "topic", "type_name", "node", "allowed", "rule"),
    [
        (PolicySettings(), "/cmd", "sensor_msgs/Joy", "/joy", True, "bridge.allow has '/**'"),
        (PolicySettings(), "/rosout", "rosgraph_msgs/Log", "/joy", False, "built in"),
        (PolicySettings(), "/rosout_agg", "rosgraph_msgs/Log", "/rosout", False, "built in"),
        (PolicySettings(), "/clock", "rosgraph_msgs/Clock", "/gazebo", False, "built in"),
        (PolicySettings(), "/rmpa/quality", "std_msgs/String", "/q", False, "built in"),
        (PolicySettings(), "/cmd", "sensor_msgs/Joy", "/rmpa", False, "the agent itself"),
        (PolicySettings(), "/cmd", "sensor_msgs/Joy", "/rmpa/base/joy", False, "stands for"),
        (PolicySettings(), "/rmpax", "std_msgs/String", "/rmpax", True, "bridge.allow"),
        (PolicySettings(deny=("/camera/**",)), "/camera/image", "a/B", "/n", False, "bridge.deny has"),
        (PolicySettings(deny=("/camera/**",)), "/camera", "a/B", "/n", False, "bridge.deny has"),
        (PolicySettings(deny=("/camera/*",)), "/camera/left/image", "a/B", "/n", True, "bridge.allow"),
        (PolicySettings(deny_types=("sensor_msgs/*",)), "/x", "sensor_msgs/Image", "/n", False, "bridge.deny_types"),
        (PolicySettings(allow_types=("std_msgs/*",)), "/x", "sensor_msgs/Image", "/n", False, "bridge.allow_types"),
        (PolicySettings(allow=("/cmd",)), "/cmd", "a/B", "/n", True, "bridge.allow has '/cmd'"),
        (PolicySettings(allow=("/cmd",)), "/odom", "a/B", "/n", False, "no glob of bridge.allow fits /odom"),
        (PolicySettings(allow=("/**",), deny=("/cmd",)), "/cmd", "a/B", "/n", False, "bridge.deny"),
    ],
)
def test_the_first_no_wins_and_names_its_rule(
    settings: PolicySettings, topic: str, type_name: str, node: str, allowed: bool, rule: str
) -> None:
    decision = Policy(settings).judge(topic, type_name, node)
    assert decision.allowed is allowed
    assert rule in decision.rule


@pytest.mark.trap(36)
def test_no_user_rule_can_open_what_is_built_in() -> None:
    policy = Policy(PolicySettings(allow=tuple(NEVER_CROSSING)))
    assert not any(policy.judge(topic.rstrip("/*"), "a/B", "/n").allowed for topic in NEVER_CROSSING)
