"""What other sites may do here."""

from __future__ import annotations

from rmpa.bridge.policy import PermissionGate
from rmpa.config.peer_rules import Access, Effect, PermissionRule
from rmpa.config.settings import TrustSettings
from rmpa.core.counters import Counters
from rmpa.gateway.neighbour import SitePermissions
from rmpa.trust.permissions import Permissions


def site_permissions(counters: Counters, *rules: PermissionRule) -> SitePermissions:
    return SitePermissions(PermissionGate(Permissions(TrustSettings(rules=rules)), counters))


def test_a_site_may_do_what_the_rules_let_a_module_of_its_name_do_and_a_refusal_is_counted() -> None:
    counters = Counters()
    permissions = site_permissions(counters, PermissionRule(("warehouse",), names={"publish": ("/scan",)}))
    assert permissions.admits(Access.PUBLISH, "warehouse", "arm", "/scan")
    assert not permissions.admits(Access.PUBLISH, "elsewhere", "arm", "/scan")
    assert "elsewhere" in permissions.why_not(Access.CALL, "elsewhere", "/stop")
    assert (counters["permission.publish"], counters["permission.call"]) == (1, 1)


def test_a_module_of_another_site_gets_nothing_by_its_name_alone_but_may_be_denied_by_it() -> None:
    permissions = site_permissions(
        Counters(),
        PermissionRule(("arm",), names={"publish": ("/cmd_vel",)}),
        PermissionRule(("warehouse",), names={"publish": ("/**",)}),
        PermissionRule(("eve",), effect=Effect.DENY, names={"publish": ("/cmd_vel",)}),
    )
    assert not permissions.admits(Access.PUBLISH, "elsewhere", "arm", "/cmd_vel")
    assert permissions.admits(Access.PUBLISH, "warehouse", "arm", "/cmd_vel")
    assert not permissions.admits(Access.PUBLISH, "warehouse", "eve", "/cmd_vel")
    assert permissions.admits(Access.PUBLISH, "warehouse", "eve", "/scan"), "no rule denies this"


def test_without_trust_every_site_may_do_everything() -> None:
    assert SitePermissions().admits(Access.CALL, "anywhere", "", "/stop")
