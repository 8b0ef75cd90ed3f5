"""What crosses between sites: the first rule that fits holds, and the gateway's own policy stands above all."""

from __future__ import annotations

from rmpa.bridge.policy import BridgeContext, PermissionGate
from rmpa.config.peer_rules import Access, Effect, PermissionRule, PolicySettings
from rmpa.config.rules import Crossing, CrossingRule
from rmpa.config.settings import ServiceSettings, Settings, TrustSettings
from rmpa.core.statistics import Counters
from rmpa.gateway.rules import CrossingDecision, CrossingRules, ForeignSource, MeshSource, SourceKind
from rmpa.trust.permissions import Permissions

T = SourceKind.TOPIC


def out(
    rules: CrossingRules, name: str, module: str = "arm", kind: SourceKind = T, type_name: str = "std_msgs/String"
) -> CrossingDecision:
    return rules.outgoing(MeshSource(kind, module, "0" * 32, "/node", name, type_name, name, "/proxy"))


def into(
    rules: CrossingRules, name: str, site: str = "cloud", module: str = "arm", kind: SourceKind = T
) -> CrossingDecision:
    return rules.incoming(ForeignSource(kind, site, module, "/node", name, "std_msgs/String"))


def test_the_first_rule_that_fits_holds_and_is_named() -> None:
    rules = CrossingRules(
        (
            CrossingRule(names=("/cmd_vel",), crossing=Crossing.IN),
            CrossingRule(names=("/camera/**",), rate=5.0, size=1000),
            CrossingRule(crossing=Crossing.NONE),
        )
    )
    for decision, allowed, why in (
        (out(rules, "/cmd_vel"), False, "gateway.rule 1"),
        (into(rules, "/cmd_vel"), True, "gateway.rule 1"),
        (out(rules, "/other"), False, "gateway.rule 3"),
        (into(rules, "/other"), False, "gateway.rule 3"),
        (out(CrossingRules(), "/scan"), True, "everything crosses"),
        (into(CrossingRules(), "/scan"), True, "everything crosses"),
        (out(CrossingRules((CrossingRule(modules=("arm",), crossing=Crossing.NONE),)), "/scan"), False, "rule 1"),
        (
            out(CrossingRules((CrossingRule(modules=("leg",), crossing=Crossing.NONE),)), "/scan"),
            True,
            "no gateway.rule",
        ),
    ):
        assert (decision.allowed, why in decision.why) == (allowed, True), decision
    camera = out(rules, "/camera/image")
    assert (camera.allowed, camera.rate, camera.size) == (True, 5.0, 1000)


def test_what_one_site_may_have_is_offered_and_refused_to_the_others() -> None:
    rules = CrossingRules((CrossingRule(sites=("cloud",)), CrossingRule(crossing=Crossing.NONE)))
    assert out(rules, "/scan").allowed
    assert rules.refusal("cloud", "arm", "/scan") == ""
    assert "gateway.rule 2" in rules.refusal("yard", "arm", "/scan")
    assert rules.refusal("", "arm", "/scan").endswith("lets it not go out to a program without a site")
    assert out(CrossingRules((CrossingRule(crossing=Crossing.NONE),)), "/scan").why.endswith("lets it not go out")
    assert not into(rules, "/scan", "yard").allowed


def test_a_source_is_for_all_sites_unless_a_rule_treats_one_of_them_otherwise() -> None:
    everyone = CrossingRule(crossing=Crossing.OUT)
    assert not out(CrossingRules(), "/scan").addressed
    for rule, addressed in (
        (CrossingRule(sites=("yard*",), crossing=Crossing.BOTH), False),
        (CrossingRule(sites=("ros2",), crossing=Crossing.NONE), False),
        (CrossingRule(sites=("ros2", "yard"), crossing=Crossing.NONE), True),
        (CrossingRule(sites=("yard",), rate=2.0), True),
        (CrossingRule(names=("/other",), sites=("yard",), crossing=Crossing.NONE), False),
    ):
        assert out(CrossingRules((rule, everyone)), "/scan").addressed is addressed, rule
        assert out(CrossingRules((everyone, rule)), "/scan").addressed is False
    nowhere = (CrossingRule(sites=("yard",), crossing=Crossing.IN), CrossingRule(crossing=Crossing.NONE))
    assert not out(CrossingRules(nowhere), "/scan").allowed
    thin = CrossingRules((CrossingRule(sites=("yard",), rate=2.0), everyone))
    assert [thin.outgoing_to(site, "arm", "/scan").rate for site in ("yard", "hall")] == [2.0, None]


def test_what_comes_in_is_renamed_and_a_name_that_is_none_is_told() -> None:
    rules = CrossingRules((CrossingRule(name="/{site}/{module}{name}"),))
    assert [into(each, "/scan").name for each in (rules, CrossingRules())] == ["/cloud/arm/scan", "/scan"]
    decision = into(CrossingRules((CrossingRule(name="{site}{name}"),)), "/scan")
    assert (decision.allowed, "'cloud/scan'" in decision.why) == (False, True)


def test_a_rate_holds_for_what_comes_from_ros2_and_another_site_limits_its_own() -> None:
    rules = CrossingRules((CrossingRule(rate=5.0, size=1000),))
    assert (into(rules, "/scan", "ros2", "").rate, into(rules, "/scan", "ros2", "").size) == (5.0, 1000)
    assert into(rules, "/scan").rate is None


def test_the_gateways_policy_stands_above_the_rules_that_of_bridge_for_topics_and_of_services_for_services() -> None:
    policy = PolicySettings(deny=("/secret/**",), deny_types=("std_msgs/Bool",))
    own = BridgeContext.of(Settings(policy=policy, services=ServiceSettings(deny=("/stop",))))
    rules = CrossingRules((CrossingRule(name="/{site}{name}"),), own)
    assert "bridge.deny" in out(rules, "/secret/plan").why
    assert not out(rules, "/rosout").allowed
    assert not out(rules, "/open", type_name="std_msgs/Bool").allowed
    assert out(rules, "/stop").allowed
    assert not out(rules, "/stop", kind=SourceKind.SERVICE).allowed
    assert out(rules, "/secret/plan", kind=SourceKind.SERVICE, type_name="std_msgs/Bool").allowed
    assert into(rules, "/secret/plan").name == "/cloud/secret/plan"
    assert not into(CrossingRules((), own), "/secret/plan").allowed


def test_topics_that_each_node_of_ros2_has_cross_only_if_a_rule_names_them() -> None:
    assert "is of each ROS 2 node" in into(CrossingRules(), "/rosout", "ros2", "").why
    assert into(CrossingRules((CrossingRule(names=("/rosout",)),)), "/rosout", "ros2", "").allowed
    assert (
        into(CrossingRules((CrossingRule(name="/{site}/{module}{name}"),)), "/a", "ros2", "").name == "/ros2/ros2/a"
    )


def permitted(*permissions: PermissionRule) -> tuple[CrossingRules, Counters]:
    counters = Counters()
    gate = PermissionGate(Permissions(TrustSettings(rules=permissions)), counters)
    return CrossingRules(gate=gate), counters


def test_permissions_stand_above_the_rules_and_what_they_refuse_is_counted() -> None:
    names = {"publish": ("/scan",), "call": ("/stop",)}
    rules, counters = permitted(PermissionRule(("cloud",), names=names))
    assert into(rules, "/scan").allowed
    refused = into(rules, "/cmd_vel")
    assert (refused.allowed, refused.why) == (False, "no [[permission]] lets cloud publish /cmd_vel")
    assert not into(rules, "/scan", site="elsewhere").allowed
    assert rules.refusal("cloud", "arm", "/stop", Access.CALL) == ""
    assert "do not let cloud call /off" in rules.refusal("cloud", "arm", "/off", Access.CALL)
    unnamed = rules.refusal("", "arm", "/stop", Access.CALL)
    assert unnamed == "the permissions there do not let a program without a site call /stop"
    assert (counters["permission.publish"], counters["permission.call"]) == (2, 2)


def test_a_module_of_another_site_gets_nothing_by_its_name_alone_but_may_be_denied_by_it() -> None:
    rules, _ = permitted(
        PermissionRule(("arm",), names={"publish": ("/cmd_vel",)}),
        PermissionRule(("warehouse",), names={"publish": ("/**",)}),
        PermissionRule(("eve",), effect=Effect.DENY, names={"publish": ("/cmd_vel",)}),
    )
    for name, site, module, allowed in (
        ("/cmd_vel", "elsewhere", "arm", False),
        ("/cmd_vel", "warehouse", "arm", True),
        ("/cmd_vel", "warehouse", "eve", False),
        ("/scan", "warehouse", "eve", True),  # no rule denies this
    ):
        assert into(rules, name, site, module).allowed is allowed
