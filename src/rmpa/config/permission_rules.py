"""``[[permission]]`` and ``[trust.groups]`` of ``rmpa.toml``: what other modules may do here.

The grammar, with examples: docs/design/trust.md, "Permissions".
"""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from enum import StrEnum
from typing import TYPE_CHECKING, Final

from rmpa.config import limits
from rmpa.config.peer_rules import with_peer
from rmpa.config.values import (
    NODE_GLOB,
    PARAM_GLOB,
    PEER_GLOB,
    SERVICE_GLOB,
    TOPIC_GLOB,
    BadValue,
    Place,
    RuleKey,
    ValueType,
    did_you_mean,
    list_of,
    member_of,
    read_at,
    read_keys,
    read_text,
    tables_of,
    word_of,
)

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence

_NAME: Final = re.compile(r"[A-Za-z][A-Za-z0-9_]{0,63}")


class Effect(StrEnum):
    """What a rule does where it fits."""

    ALLOW = "allow"
    DENY = "deny"


class Access(StrEnum):
    """What another module does with something of this module, or brings to it."""

    PUBLISH = "publish"
    """Its topic is shown here."""
    SUBSCRIBE = "subscribe"
    """It gets a topic of this module."""
    CALL = "call"
    """It calls a service of this module."""
    SERVE = "serve"
    """Its service is shown here."""
    PARAM = "param"
    """It reads, follows, sets or deletes a parameter of this module."""
    KILL = "kill"
    """It ends a node of this module."""


ACTION_CLIENT: Final = "action"
"""The key of a rule about actions of this module, whose client the other module is."""
ACTION_SERVER: Final = "action_serve"
"""The key of a rule about actions of the other module, whose clients are here."""


@dataclass(frozen=True, slots=True)
class ModuleGroup:
    """One line of ``[trust.groups]``.

    Args:
        name: The group's.
        modules: Globs over the names of its modules.
    """

    name: str
    modules: tuple[str, ...]

    def __str__(self) -> str:
        """``operators: joystick, laptop*``."""
        return f"{self.name}: {', '.join(self.modules)}"


@dataclass(frozen=True, slots=True)
class PermissionRule:
    """One ``[[permission]]``.

    Args:
        modules: Globs over modules' names; the rule is about those that fit one of them, or are in a group.
        groups: Names of groups.
        effect: Whether it allows or denies.
        names: By key of the rule (a word of ``Access``, ``action``, ``action_serve``): globs over names here;
            ``{peer}`` in one is the module's name.
    """

    modules: tuple[str, ...] = ()
    groups: tuple[str, ...] = ()
    effect: Effect = Effect.ALLOW
    names: Mapping[str, tuple[str, ...]] = field(default_factory=dict)


def _read_group_name(raw: object) -> str:
    name = read_text(raw).strip()
    if not _NAME.fullmatch(name):
        raise BadValue(f"{name!r} is not a group's name", "one has a letter, then letters, digits and _")
    return name


GROUP_NAME: Final = ValueType(_read_group_name, {"type": "string", "examples": ["operators"]})


def _globs(glob: ValueType[str]) -> ValueType[tuple[str, ...]]:
    return list_of(with_peer(glob), if_empty="leave the key out, or name some")


_NAME_KEYS: Final = (
    RuleKey(Access.PUBLISH.value, _globs(TOPIC_GLOB), "Its topics that are shown here, by their names here."),
    RuleKey(Access.SUBSCRIBE.value, _globs(TOPIC_GLOB), "This module's topics that it gets."),
    RuleKey(Access.CALL.value, _globs(SERVICE_GLOB), "This module's services that it calls."),
    RuleKey(Access.SERVE.value, _globs(SERVICE_GLOB), "Its services that are shown here, by their names here."),
    RuleKey(
        Access.PARAM.value, _globs(PARAM_GLOB), "This module's parameters that it reads or sets, as [params] lets."
    ),
    RuleKey(Access.KILL.value, _globs(NODE_GLOB), "This module's nodes that it ends, as [nodes] kill lets."),
    RuleKey(ACTION_CLIENT, _globs(TOPIC_GLOB), "This module's actions whose client it is."),
    RuleKey(ACTION_SERVER, _globs(TOPIC_GLOB), "Its actions whose clients are here."),
)
NAME_KEYS: Final = tuple(key.name for key in _NAME_KEYS)
"""The keys of a rule that have names of topics, services, parameters, nodes or actions."""
_KEYS: Final = (
    RuleKey(
        "modules",
        list_of(PEER_GLOB, if_empty="leave modules out, or name some"),
        "The modules, by globs over their names.",
    ),
    RuleKey(
        "groups",
        list_of(GROUP_NAME, if_empty="leave groups out, or name some"),
        "The groups of [trust.groups] whose modules it is about, too.",
    ),
    RuleKey(
        "effect", member_of(Effect, "an effect"), "allow, which is the default, or deny, which wins where both fit."
    ),
    *_NAME_KEYS,
)
_EXAMPLE: Final = 'one has modules = ["joystick"] and publish = ["/cmd_vel"]'


def _read_rule(table: Mapping[str, object]) -> PermissionRule:
    values = read_keys(table, _KEYS)
    modules, groups = values.pop("modules", ()), values.pop("groups", ())
    effect = values.pop("effect", Effect.ALLOW)
    if not modules and not groups:
        raise BadValue("a rule without modules and groups", 'modules = ["*"] makes it one for every module')
    if not values:
        raise BadValue(f"a rule that {'denies' if effect is Effect.DENY else 'allows'} nothing", _EXAMPLE)
    return PermissionRule(modules, groups, effect, values)


PERMISSION_RULES: Final = tables_of(_KEYS, _read_rule, limits.PERMISSION_RULES_MAX, "make groups of modules")


_GROUP: Final = list_of(PEER_GLOB, if_empty="leave the group out, or name some modules")


def _read_groups(raw: object) -> tuple[ModuleGroup, ...]:
    if raw == ():
        return ()
    if not isinstance(raw, dict):
        raise BadValue(f"{raw!r} is not a table", 'operators = ["joystick", "laptop*"] is a group')
    if len(raw) > limits.GROUPS_MAX:
        raise BadValue(f"{len(raw)} groups", f"at most {limits.GROUPS_MAX}")
    return tuple(
        ModuleGroup(read_at((name,), GROUP_NAME.read, name), read_at((name,), _GROUP.read, modules))
        for name, modules in raw.items()
    )


MODULE_GROUPS: Final = ValueType(_read_groups, {"type": "object", "additionalProperties": _GROUP.json_schema})
PERMISSION_DEFAULT: Final = word_of(
    [str(effect) for effect in Effect], "a default", "deny, or allow: every member may do everything", "EFFECT"
)


def permission_problems(
    rules: Sequence[PermissionRule], groups: Sequence[ModuleGroup]
) -> Iterator[tuple[Place, str, str]]:
    """Problems that only show when all settings are known: ``(place in [[permission]], problem, remedy)``."""
    known = [group.name for group in groups]
    for index, rule in enumerate(rules):
        for place, name in enumerate(rule.groups):
            if name not in known:
                near = did_you_mean(name, known)
                there = f"the groups are {', '.join(known)}" if known else "there are none"
                remedy = f"did you mean {near}?" if near else f"make it in [trust.groups]; {there}"
                yield (index, "groups", place), f"there is no group {name!r}", remedy
