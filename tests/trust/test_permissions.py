"""Permissions: which rule decides, for modules and groups, for each kind of access."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rmpa.config.peer_rules import Access, Effect, ModuleGroup, PermissionRule
from rmpa.config.read import load_settings
from rmpa.config.settings import TrustSettings
from rmpa.core.errors import ConfigError
from rmpa.trust import limits
from rmpa.trust.permissions import PermissionDecision, Permissions

if TYPE_CHECKING:
    from pathlib import Path

FILE = """
[trust.groups]
operators = ["joystick", "laptop*"]
robots = ["base", "arm?"]

[[permission]]
groups = ["operators"]
publish = ["/cmd_vel", "/joy"]
subscribe = ["/**"]
action = ["/arm/move"]

[[permission]]
modules = ["*"]
subscribe = ["/tf", "/tf_static"]
publish = ["/{peer}/**"]

[[permission]]
modules = ["*"]
effect = "deny"
call = ["/motors/**"]
param = ["/motors/**"]

[[permission]]
modules = ["joystick"]
groups = ["robots"]
call = ["/**"]
param = ["/**"]
kill = ["/demo/*"]
action_serve = ["/pick"]
serve = ["/ik"]
"""


def _load(tmp_path: Path, text: str) -> TrustSettings:
    path = tmp_path / "rmpa.toml"
    path.write_text(text)
    return load_settings({"config": str(path)}, {}, host_name="robot", cwd=tmp_path).settings.trust


@pytest.fixture
def permissions(tmp_path: Path) -> Permissions:
    return Permissions(_load(tmp_path, FILE))


@pytest.mark.parametrize(
    ("access", "module", "name", "number"),
    [
        (Access.PUBLISH, "joystick", "/cmd_vel", 1),
        (Access.PUBLISH, "laptop7", "/joy", 1),
        (Access.SUBSCRIBE, "laptop7", "/camera/image", 1),
        (Access.SUBSCRIBE, "base", "/tf", 2),
        (Access.PUBLISH, "base", "/base/odom", 2),
        (Access.CALL, "arm1", "/plan", 4),
        (Access.PARAM, "joystick", "/speed", 4),
        (Access.KILL, "base", "/demo/talker", 4),
        (Access.SERVE, "arm2", "/ik", 4),
    ],
)
def test_what_a_rule_allows(permissions: Permissions, access: Access, module: str, name: str, number: int) -> None:
    decision = permissions.judge(access, module, name)
    assert decision.allowed
    assert decision.number == number


@pytest.mark.parametrize(
    ("access", "module", "name"),
    [
        (Access.PUBLISH, "base", "/cmd_vel"),
        (Access.PUBLISH, "joystick", "/cmd_vel/raw"),
        (Access.PUBLISH, "arm1", "/base/odom"),
        (Access.SUBSCRIBE, "base", "/camera/image"),
        (Access.CALL, "laptop7", "/plan"),
        (Access.KILL, "base", "/move_base"),
        (Access.SERVE, "arm12", "/ik"),
    ],
)
def test_what_no_rule_allows_is_denied(permissions: Permissions, access: Access, module: str, name: str) -> None:
    decision = permissions.judge(access, module, name)
    assert not decision.allowed
    assert decision.number is None
    assert module in decision.rule
    assert name in decision.rule


def test_a_denial_wins_over_a_later_allowance(permissions: Permissions) -> None:
    assert permissions.judge(Access.CALL, "joystick", "/motors/stop") == PermissionDecision(
        False, "[[permission]] 3 denies call of '/motors/**' to '*'", 3
    )
    assert not permissions.judge(Access.PARAM, "base", "/motors").allowed


def test_a_denial_wins_over_an_earlier_allowance() -> None:
    rules = (
        PermissionRule(("*",), names={"publish": ("/**",)}),
        PermissionRule(("arm",), effect=Effect.DENY, names={"publish": ("/cmd_vel",)}),
    )
    permissions = Permissions(TrustSettings(rules=rules))
    assert not permissions.judge(Access.PUBLISH, "arm", "/cmd_vel").allowed
    assert permissions.judge(Access.PUBLISH, "base", "/cmd_vel").allowed
    assert permissions.judge(Access.PUBLISH, "arm", "/joint_states").allowed


def test_an_action_is_five_topics(permissions: Permissions) -> None:
    for topic in ("goal", "cancel"):
        assert permissions.judge(Access.PUBLISH, "joystick", f"/arm/move/{topic}").number == 1
        assert not permissions.judge(Access.PUBLISH, "base", f"/arm/move/{topic}").allowed
        assert permissions.judge(Access.SUBSCRIBE, "base", f"/pick/{topic}").number == 4
    for topic in ("status", "feedback", "result"):
        assert permissions.judge(Access.SUBSCRIBE, "joystick", f"/arm/move/{topic}").allowed
        assert not permissions.judge(Access.PUBLISH, "joystick", f"/arm/move/{topic}").allowed
        assert permissions.judge(Access.PUBLISH, "base", f"/pick/{topic}").number == 4
        assert not permissions.judge(Access.SUBSCRIBE, "base", f"/pick/{topic}").allowed


def test_an_action_may_be_a_glob() -> None:
    rules = (PermissionRule(("arm",), names={"action": ("/arm/**",)}),)
    permissions = Permissions(TrustSettings(rules=rules))
    for name in ("/arm/goal", "/arm/left/move/goal"):
        assert permissions.judge(Access.PUBLISH, "arm", name).allowed
    assert not permissions.judge(Access.PUBLISH, "arm", "/arm/left/move").allowed


def test_the_text_names_the_group(permissions: Permissions) -> None:
    rule = permissions.judge(Access.PUBLISH, "laptop7", "/joy").rule
    assert rule == "[[permission]] 1 allows publish of '/joy' to group 'operators'"
    assert permissions.groups_of("arm1") == ("robots",)
    assert permissions.groups_of("arm12") == ()


def test_default_allow_lets_all_do_everything_but_what_is_denied() -> None:
    deny = PermissionRule(("*",), effect=Effect.DENY, names={"kill": ("/**",)})
    permissions = Permissions(TrustSettings(default="allow", rules=(deny,)))
    assert permissions.judge(Access.CALL, "any", "/x").rule == 'no [[permission]] fits, and trust.default = "allow"'
    assert permissions.judge(Access.CALL, "any", "/x").allowed
    assert not permissions.judge(Access.KILL, "any", "/x").allowed


def test_no_rule_at_all_denies() -> None:
    permissions = Permissions(TrustSettings())
    assert not any(permissions.judge(access, "base", "/x").allowed for access in Access)


def test_relays_are_named() -> None:
    permissions = Permissions(TrustSettings(relays=("gateway*",)))
    assert permissions.may_relay("gateway1") == PermissionDecision(True, "trust.relays has 'gateway*'")
    assert not permissions.may_relay("base").allowed


def test_many_modules_do_not_fill_the_memory() -> None:
    permissions = Permissions(TrustSettings(rules=(PermissionRule(("*",), names={"call": ("/{peer}/x",)}),)))
    for number in range(2 * limits.MODULES_REMEMBERED):
        assert permissions.judge(Access.CALL, f"m{number}", f"/m{number}/x").allowed
        assert not permissions.judge(Access.CALL, f"m{number}", "/m_other/x").allowed
    assert len(permissions._known) <= limits.MODULES_REMEMBERED


_NAMES = st.lists(st.sampled_from(["a", "b", "cmd"]), min_size=1, max_size=3).map(lambda parts: "/" + "/".join(parts))
_GLOBS = st.one_of(_NAMES, st.sampled_from(["/**", "/a/**", "/*", "/**/cmd"]))
_RULES = st.lists(
    st.builds(
        PermissionRule,
        modules=st.lists(st.sampled_from(["*", "arm", "b*"]), max_size=2).map(tuple),
        groups=st.sampled_from([(), ("all",)]),
        effect=st.sampled_from(Effect),
        names=st.dictionaries(st.sampled_from(["publish", "call"]), st.lists(_GLOBS, min_size=1).map(tuple)),
    ),
    max_size=6,
)


@given(_RULES, st.sampled_from(["arm", "base"]), _NAMES, st.randoms(use_true_random=False))
def test_order_never_matters(rules: list[PermissionRule], module: str, name: str, rng: object) -> None:
    groups = (ModuleGroup("all", ("*",)),)
    turned = Permissions(TrustSettings(rules=tuple(reversed(rules)), groups=groups))
    straight = Permissions(TrustSettings(rules=tuple(rules), groups=groups))
    for access in (Access.PUBLISH, Access.CALL):
        assert straight.judge(access, module, name).allowed == turned.judge(access, module, name).allowed
        more = [*rules, PermissionRule(("*",), effect=Effect.DENY, names={access.value: (name,)})]
        denied = Permissions(TrustSettings(rules=tuple(more), groups=groups))
        assert not denied.judge(access, module, name).allowed


@pytest.mark.parametrize(
    ("text", "line", "words"),
    [
        ("[[permission]]\npublish = ['/a']", 1, "a rule without modules and groups"),
        ("[[permission]]\nmodules = ['a']", 1, "a rule that allows nothing"),
        ("[[permission]]\nmodules = ['a']\neffect = 'deny'", 1, "a rule that denies nothing"),
        ("[[permission]]\nmodules = ['a']\neffect = 'forbid'\ncall = ['/a']", 3, "it is one of allow, deny"),
        ("[[permission]]\nmodules = ['a b']\ncall = ['/a']", 2, "'a b' is not a glob over peers' names"),
        ("[[permission]]\nmodules = ['a']\ncall = ['x']", 3, 'did you mean "/x"?'),
        ("[[permission]]\nmodules = ['a']\ncall = []", 3, "an empty list fits nothing"),
        ("[[permission]]\nmodules = ['a']\nkill = ['/a b']", 3, "'/a b' is not a glob over nodes"),
        ("[[permission]]\nmodules = ['a']\npublishes = ['/a']", 3, "did you mean permission.publish?"),
        ("[[permission]]\ngroups = ['ops']\npublish = ['/a']", 2, "there is no group 'ops'; make it in"),
        (
            "[trust.groups]\noperators = ['a']\n[[permission]]\ngroups = ['operator']\npublish = ['/a']",
            4,
            "did you mean operators?",
        ),
        ("[trust.groups]\noperators = []", 2, "an empty list fits nothing"),
        ("[trust.groups]\n'my group' = ['a']", 2, "'my group' is not a group's name"),
        ("[trust.groups]\noperators = 'a'", 2, 'did you mean ["a"]?'),
        ("[trust]\ndefault = 'maybe'", 2, "'maybe' is not a default"),
        ("[trust]\ngroups = ['a']", 2, "is not a table"),
        ("[permission]\nmodules = ['a']", 1, "write [[permission]]"),
    ],
)
def test_a_mistake_is_named_with_its_line(tmp_path: Path, text: str, line: int, words: str) -> None:
    with pytest.raises(ConfigError) as caught:
        _load(tmp_path, text)
    assert f"rmpa.toml:{line}: " in str(caught.value)
    assert words in str(caught.value)


def test_too_many_rules_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="4097 rules; at most 4096"):
        _load(tmp_path, "[[permission]]\nmodules = ['*']\ncall = ['/a']\n" * 4097)


NAMES = st.sampled_from(["/a", "/a/b", "/m1", "/m1/x"])
GLOBS = st.sampled_from(["/a", "/*", "/**", "/{peer}/**", "/a/*"])
SOME_RULES = st.lists(
    st.builds(
        lambda modules, effect, glob: PermissionRule((modules,), effect=effect, names={"subscribe": (glob,)}),
        st.sampled_from(["*", "m1", "m*"]),
        st.sampled_from(Effect),
        GLOBS,
    ),
    max_size=4,
)


@given(SOME_RULES, st.sampled_from(Effect), NAMES)
def test_what_is_decided_for_all_is_decided_so_for_each(
    rules: list[PermissionRule], default: Effect, name: str
) -> None:
    permissions = Permissions(TrustSettings(default=str(default), rules=tuple(rules)))
    decision = permissions.judge_all(Access.SUBSCRIBE, "any other site", name)
    each = {permissions.judge(Access.SUBSCRIBE, module, name).allowed for module in ("a", "m1", "m2", "other")}
    assert decision is None or each == {decision.allowed}
    if not any(glob != "*" for rule in rules for glob in rule.modules) and "{peer}" not in str(rules):
        assert decision is not None


def test_no_default_lets_a_module_start_resources() -> None:
    given = PermissionRule(("arm",), names={"launch": ("/cam",)})
    permissions = Permissions(TrustSettings("allow", rules=(given,)))
    assert permissions.judge(Access.PUBLISH, "base", "/cmd_vel").allowed
    assert not permissions.judge(Access.LAUNCH, "base", "/cam").allowed
    assert permissions.judge(Access.LAUNCH, "arm", "/cam").allowed
    assert not permissions.judge(Access.LAUNCH, "arm", "/base").allowed
