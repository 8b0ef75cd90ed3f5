"""Fuzz target: ``[[permission]]`` and ``[trust.groups]``."""

from __future__ import annotations

from pathlib import Path

from rmpa.config.peer_rules import MODULE_GROUPS, PERMISSION_RULES, Access, Effect, permission_problems
from rmpa.config.read import parse_config
from rmpa.config.settings import TrustSettings
from rmpa.config.values import BadValue
from rmpa.core.errors import ConfigError
from rmpa.trust.permissions import Permissions

SEEDS: list[bytes] = [
    b"",
    b"[[permission]]\nmodules = ['*']\npublish = ['/{peer}/**']\n",
    b"[[permission]]\ngroups = ['ops']\neffect = 'deny'\ncall = ['/a', '/b/*']\n[trust.groups]\nops = ['a', 'b?']\n",
    b"[trust]\ngroups = {ops = ['a']}\ndefault = 'allow'\n[[permission]]\ngroups = ['ops']\naction = ['/m/**']\n",
    b"permission = [{modules = 'a;b', param = '/a;/b', kill = ['/**'], action_serve = ['/x/']}]\n",
]


def fuzz(data: bytes) -> None:
    """Rules of which each decision names one, and a denial wins; or an error that says where."""
    try:
        found = parse_config(data, Path("rmpa.toml"))
        rules = PERMISSION_RULES.read(found.get(("permission",), []))
        groups = MODULE_GROUPS.read(found.get(("trust", "groups"), ()))
    except ConfigError as error:
        str(error)
        return
    except BadValue as error:
        if not error.at:
            raise AssertionError(f"a wrong rule, but nothing says which: {error}") from error
        return
    list(permission_problems(rules, groups))
    permissions = Permissions(TrustSettings(rules=rules, groups=groups))
    for access in Access:
        for module in ("a", "base"):
            for name in ("/a", "/m/x/goal", "/base/odom"):
                decision = permissions.judge(access, module, name)
                if (decision.number is None) and decision.allowed:
                    raise AssertionError("no rule decided, and it is allowed")
                if decision.number and (rules[decision.number - 1].effect is Effect.ALLOW) is not decision.allowed:
                    raise AssertionError(f"{decision} contradicts its rule")
