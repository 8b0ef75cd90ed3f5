"""Rules about peers: ``[[peer]]``, ``[[permission]]`` and ``[[service]]``, and the policy of names.

The tables ``[[peer]]`` of ``rmpa.toml``: names and policy for single peers (docs/names.md).

Names that no topic can have, or that never cross, are refused. What two names do that become one shows at run time:
the first stays, and the other one says why it is hidden.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from enum import StrEnum
from functools import partial
from typing import TYPE_CHECKING, Final

from rmpa.config import limits
from rmpa.config.rules import ConfigWarning
from rmpa.config.schema import TIMEOUT, setting
from rmpa.config.values import (
    NODE_GLOB,
    PARAM_GLOB,
    PEER_GLOB,
    SERVICE_GLOB,
    TOPIC_GLOB,
    TRANSPORT,
    TYPE_GLOB,
    BadValue,
    JsonSchema,
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
from rmpa.core.identity import NEVER_CROSSING, is_global_name, matches

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence

    from rmpa.core.contract import Transport


# ``[bridge]``: which topics may cross; a ``[[peer]]`` has the same four keys for its peers.


@dataclass(frozen=True, slots=True)
class PolicySettings:
    """The topics and types that may cross the mesh, by globs (``core.identity.matches``).

    A topic crosses if one of ``allow`` matches it and none of ``deny``, its type likewise; of several policies each
    must let it cross.
    """

    allow: tuple[str, ...] = setting(
        ("/**",), list_of(TOPIC_GLOB), "Topics that may cross; `[]` lets none cross.", env="RMPA_ALLOW"
    )
    deny: tuple[str, ...] = setting(
        (), list_of(TOPIC_GLOB), "Topics that stay home, besides the built-in ones.", env="RMPA_DENY"
    )
    allow_types: tuple[str, ...] = setting(
        ("**",), list_of(TYPE_GLOB), "Message types that may cross.", env="RMPA_ALLOW_TYPES"
    )
    deny_types: tuple[str, ...] = setting(
        (), list_of(TYPE_GLOB), "Message types that stay home.", env="RMPA_DENY_TYPES"
    )


# The tables ``[[service]]`` of ``rmpa.toml``: how long calls of some services may take, and their transport.


@dataclass(frozen=True, slots=True)
class ServiceRule:
    """One ``[[service]]``.

    Args:
        names: Globs over the names that services have here.
        timeout: Seconds that a call may take; ``None``: the rule says nothing of it.
        transport: The path of calls; ``None``: the rule says nothing of it.
    """

    names: tuple[str, ...]
    timeout: float | None = None
    transport: Transport | None = None


_SERVICE_KEYS: Final = (
    RuleKey(
        "names",
        list_of(SERVICE_GLOB, if_empty="name some services"),
        "Globs over services, by their names here.",
        required=True,
    ),
    RuleKey("timeout", TIMEOUT, "How long a call may take: seconds, or a text such as 5 min."),
    RuleKey("transport", TRANSPORT, "relay: through the agents; direct, auto: from node to node where it can be."),
)
_SERVICE_EXAMPLE: Final = 'one has names = ["/plan/**"] and timeout = "5 min", or transport = "direct"'


def _read_service(table: Mapping[str, object]) -> ServiceRule:
    values = read_keys(table, _SERVICE_KEYS, _SERVICE_EXAMPLE)
    if len(values) == 1:
        raise BadValue("a rule without timeout and transport", _SERVICE_EXAMPLE)
    return ServiceRule(**values)


SERVICE_RULES: Final = tables_of(_SERVICE_KEYS, _read_service)


PEER: Final = "{peer}"
"""Stands for the peer's name in a rule."""
_SOME_PEER: Final = "peer"
Renames = tuple[tuple[str, str], ...]
"""Names before and after, or namespaces ``/namespace/**``; ``{peer}`` in them is the peer's name."""


def with_peer(glob: ValueType[str]) -> ValueType[str]:
    """A glob that may have ``{peer}`` in it."""

    def read(raw: object) -> str:
        try:
            glob.read(raw.replace(PEER, _SOME_PEER) if isinstance(raw, str) else raw)
        except BadValue as error:
            if error.better is not None:
                error.better = f"/{str(raw).strip()}"
            raise
        return str(raw).strip()

    return ValueType(read, {"type": "string", "examples": ["/**", f"/{PEER}/**"]})


@dataclass(frozen=True, slots=True)
class PeerRule:
    """One ``[[peer]]``: what holds for the peers whose name fits. All rules that fit a peer apply, in order.

    Args:
        name: A glob over peers' names.
        prefix: Put in front of their names here, and removed from ours there; ``{peer}`` is the peer's name.
        remap_in: Their names (before) and the names here (after); the first that fits applies.
        remap_out: Our names (before) and the names there (after).
        policy: What may cross to and from them, on top of ``[bridge]``; in our names, with ``{peer}``.
    """

    name: str
    prefix: str = ""
    remap_in: Renames = ()
    remap_out: Renames = ()
    policy: PolicySettings = field(default_factory=PolicySettings)


def _read_peer(table: Mapping[str, object]) -> PeerRule:
    if "name" not in table:
        raise BadValue("a rule without a name", 'name = "robot*" makes it one for those peers, "*" for all')
    values = read_keys(table, _PEER_KEYS)
    own = {key: values.pop(key) for key in ("prefix", "remap_in", "remap_out") if key in values}
    return PeerRule(values.pop("name"), **own, policy=PolicySettings(**values))


def _read_prefix(raw: object) -> str:
    prefix = read_text(raw).strip()
    if prefix.strip("/") == "":
        raise BadValue(f"{prefix!r} puts nothing in front", "leave it out, or name a namespace")
    if prefix != (better := "/" + prefix.strip("/")):
        raise BadValue(f"{prefix!r} is not a namespace", better=better)
    _check_name(prefix)
    return prefix


def _read_renames(raw: Mapping[str, str]) -> Renames:
    """A table ``remap_in`` or ``remap_out``: the name after, by the name before."""
    if len(raw) > limits.REMAPS_MAX:
        raise BadValue(f"{len(raw)} rules", f"at most {limits.REMAPS_MAX}; rename namespaces")
    return tuple(read_at((source,), partial(_renaming, source), target) for source, target in raw.items())


def _renaming(source: str, target: object) -> tuple[str, str]:
    """A renaming whose two ends fit each other."""
    before, after = _read_end(source), _read_end(target)
    if before.endswith("/**") is not after.endswith("/**"):
        raise BadValue(
            f"{before} and {after} do not fit each other",
            "a namespace becomes a namespace: both end with /**, or none",
        )
    return before, after


def _read_end(raw: object) -> str:
    """One end of a renaming: a name, or a namespace followed by ``/**``."""
    end = read_text(raw).strip()
    stem = end.removesuffix("/**")
    if re.search(r"[*?]", stem):
        raise BadValue(f"{end!r} is not a name", "a rule renames /one/name, or all of a /namespace/**")
    if stem and not stem.startswith("/"):
        raise BadValue(f"{end!r} is not a global name", better=f"/{end}")
    if stem or end != "/**":
        _check_name(stem)
    return end


def _check_name(name: str) -> None:
    filled = name.replace(PEER, _SOME_PEER)
    if name == "/" or not is_global_name(filled):
        raise BadValue(
            f"{name!r} is not a ROS name", "one looks like /robot1/odom; {peer} stands for the peer's name"
        )
    if len(filled) > limits.CROSSING_NAME_MAX:
        raise BadValue(f"a name of {len(filled)} characters", f"at most {limits.CROSSING_NAME_MAX} cross the mesh")
    for pattern, why in NEVER_CROSSING.items():
        if matches(pattern, filled):
            raise BadValue(f"{name} never crosses: {why}", "leave this rule out")


# --- the keys of the tables -----------------------------------------------------------------------------------------

_RENAMES: Final[JsonSchema] = {"type": "object", "additionalProperties": {"type": "string"}}
_PEER_KEYS: Final = (
    RuleKey(
        "name",
        PEER_GLOB,
        "The peers, by a glob over their names.",
        required=True,
    ),
    RuleKey(
        "prefix",
        ValueType(_read_prefix, {"type": "string", "examples": [f"/{PEER}"]}),
        "A namespace for their names here; {peer} is the peer's name.",
    ),
    RuleKey("remap_in", ValueType(_read_renames, _RENAMES), "Their names, and what they are here."),
    RuleKey("remap_out", ValueType(_read_renames, _RENAMES), "Our names, and what they are there."),
    RuleKey(
        "allow", list_of(with_peer(TOPIC_GLOB)), "Topics that may cross, on top of [bridge], by their names here."
    ),
    RuleKey("deny", list_of(with_peer(TOPIC_GLOB)), "Topics that stay home."),
    RuleKey("allow_types", list_of(TYPE_GLOB), "Message types that may cross."),
    RuleKey("deny_types", list_of(TYPE_GLOB), "Message types that stay home."),
)
PEER_RULES: Final = tables_of(_PEER_KEYS, _read_peer)


def peer_warnings(rules: Sequence[PeerRule]) -> Iterator[ConfigWarning]:
    """Warnings about rules that can be used but are probably mistakes."""
    for index, rule in enumerate(rules):
        if rule == PeerRule(rule.name):
            yield ConfigWarning((index,), "a rule that sets nothing")
        if rule.prefix and PEER not in rule.prefix and re.search(r"[*?]", rule.name):
            text = f"{rule.prefix} is one place for every peer that {rule.name} fits; /{PEER} would keep them apart"
            yield ConfigWarning((index, "prefix"), text)


# ``[[permission]]`` and ``[trust.groups]`` of ``rmpa.toml``: what other modules may do here.
#
# The grammar, with examples: docs/design/trust.md, "Permissions".


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
_PERMISSION_KEYS: Final = (
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


def _read_permission(table: Mapping[str, object]) -> PermissionRule:
    values = read_keys(table, _PERMISSION_KEYS)
    modules, groups = values.pop("modules", ()), values.pop("groups", ())
    effect = values.pop("effect", Effect.ALLOW)
    if not modules and not groups:
        raise BadValue("a rule without modules and groups", 'modules = ["*"] makes it one for every module')
    if not values:
        raise BadValue(f"a rule that {'denies' if effect is Effect.DENY else 'allows'} nothing", _EXAMPLE)
    return PermissionRule(modules, groups, effect, values)


PERMISSION_RULES: Final = tables_of(
    _PERMISSION_KEYS, _read_permission, limits.PERMISSION_RULES_MAX, "make groups of modules"
)


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
