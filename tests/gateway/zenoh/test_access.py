"""Zenoh's table of access from rules of ours; a real router enforces it in test_trust.py."""

from __future__ import annotations

from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rmpa.config.peer_rules import Effect, ModuleGroup, PermissionRule
from rmpa.config.settings import TrustSettings
from rmpa.core.identity import matches
from rmpa.gateway.zenoh.access import AccessTable, access_table, key_expressions

zenoh = pytest.importorskip("zenoh")

_PARTS = st.text("ab_", min_size=1, max_size=3)
_NAMES = st.lists(_PARTS, min_size=1, max_size=4).map(lambda parts: "/" + "/".join(parts))
_GLOBS = st.lists(
    st.sampled_from(["a", "b", "*", "**", "a*", "*b", "a**", "**b", "a**b", "_*a*"]), min_size=1, max_size=4
).map(lambda parts: "/" + "/".join(parts))


@given(_GLOBS, _NAMES)
def test_the_key_expressions_fit_the_names_that_the_glob_fits(glob: str, name: str) -> None:
    keys = [zenoh.KeyExpr(key) for key in key_expressions(glob)]
    assert [str(key) for key in keys] == list(key_expressions(glob)), "in canonical form"
    assert any(key.includes(name[1:]) for key in keys) == matches(glob, name)


def subjects(table: AccessTable) -> list[Any]:
    found = table.entries["subjects"]
    assert isinstance(found, list)
    return [each.get("cert_common_names") for each in found]


def rule(*modules: str, effect: Effect = Effect.ALLOW, **names: str) -> PermissionRule:
    return PermissionRule(modules, (), effect, {key: (glob,) for key, glob in names.items()})


def test_globs_over_modules_become_the_known_names_and_groups_their_modules() -> None:
    trust = TrustSettings(
        groups=(ModuleGroup("operators", ("laptop*", "joystick")),),
        rules=(PermissionRule((), ("operators",), names={"publish": ("/cmd_vel",)}),),
    )
    table = access_table(trust, ["laptop1", "laptop2", "arm"])
    assert subjects(table) == [None, ["laptop1", "laptop2", "joystick"]]
    assert table.notes == ()


def test_a_glob_that_fits_no_known_module_never_allows_and_denies_all() -> None:
    table = access_table(TrustSettings(rules=(rule("laptop*", publish="/a"),)))
    assert subjects(table) == [None]
    assert "[[permission]] 1 is left out for 'laptop*'" in table.notes[0]
    denied = access_table(TrustSettings(default="allow", rules=(rule("laptop*", effect=Effect.DENY, publish="/a"),)))
    assert subjects(denied) == [None]
    assert "denies it to all modules" in denied.notes[0]
    rules = denied.entries["rules"]
    assert isinstance(rules, list)
    assert {each["permission"] for each in rules} == {"deny"}


def test_a_question_mark_never_allows_more_than_it_says() -> None:
    table = access_table(TrustSettings(rules=(rule("arm", publish="/a?"),)))
    assert "Zenoh has no ?" in table.notes[0]
    assert "/a$*" not in str(table.entries)


def test_the_name_of_the_module_itself_makes_a_rule_for_each_module() -> None:
    table = access_table(TrustSettings(rules=(rule("*", publish="/{peer}/**"),)), ["arm", "base"])
    assert subjects(table) == [None, ["arm"], ["base"]]
    rules = table.entries["rules"]
    assert isinstance(rules, list)
    assert len({each["id"] for each in rules}) == len(rules), "Zenoh wants unique ids"
    arm = next(each for each in rules if each["id"] == "permission 1: publish of arm (ingress)")
    assert "rmpa/1/*/*/t/*/arm/**" in arm["key_exprs"]


def test_where_not_all_names_are_known_a_denial_of_one_beside_rules_for_all_is_for_all() -> None:
    trust = TrustSettings(rules=(rule("*", publish="/a"), rule("arm", effect=Effect.DENY, publish="/a")))
    assert None in subjects(access_table(trust))
    assert "[[permission]] 2 denies it to all modules" in access_table(trust).notes[0]
    known = access_table(trust, ["arm", "base"])
    assert sorted(map(sorted, subjects(known))) == [["arm"], ["arm", "base"]]
    assert known.notes == ()


def test_a_revoked_name_is_denied_everything_or_it_is_told() -> None:
    named = TrustSettings(rules=(rule("arm", publish="/a"),))
    assert ["base"] in subjects(access_table(named, revoked=["base"]))
    for_all = TrustSettings(rules=(rule("*", publish="/a"),))
    assert "let in base, which were revoked" in access_table(for_all, revoked=["base"]).notes[0]
    assert access_table(for_all, ["arm", "base"], revoked=["base"]).notes == ()
    assert None not in subjects(access_table(for_all, ["arm", "base"], revoked=["base"]))
