"""Rules about peers: ``[[peer]]``, ``[[permission]]`` and ``[[service]]``, and the policy of names.

``[[peer]]`` has names and policy for single peers (docs/guides/names.md). Names that no topic can have, or that
never cross, are refused. What two names do that become one shows at run time: the first stays, and the other one
says why it is hidden. ``[[permission]]`` and ``[trust.groups]`` say what other modules may do here; the grammar, with
examples: docs/design/trust.md, "Permissions".
"""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from enum import StrEnum
from typing import TYPE_CHECKING, Any, Final, Self

from rmpa.config import limits, values
from rmpa.config.schema import NEEDED, Setting, keys_of, rules_of, setting
from rmpa.core.contract import Transport
from rmpa.core.identity import NEVER_CROSSING, is_global_name, matches

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence

TRANSPORT: Final = values.member_of(Transport, "a transport")
_WITH_PEER: Final = ("/**", f"/{values.PEER}/**")


@dataclass(frozen=True, slots=True)
class PolicySettings:
    """The topics and types that may cross the mesh, by globs (``core.identity.matches``).

    A topic crosses if one of ``allow`` matches it and none of ``deny``, its type likewise; of several policies each
    must let it cross. A ``[[peer]]`` has the same four keys for its peers.
    """

    allow: tuple[str, ...] = setting(
        ("/**",), values.list_of(values.TOPIC_GLOB), "Topics that may cross; `[]` lets none cross."
    )
    deny: tuple[str, ...] = setting(
        (), values.list_of(values.TOPIC_GLOB), "Topics that do not cross, besides the built-in ones."
    )
    allow_types: tuple[str, ...] = setting(("**",), values.list_of(values.TYPE_GLOB), "Message types that may cross.")
    deny_types: tuple[str, ...] = setting((), values.list_of(values.TYPE_GLOB), "Message types that do not cross.")


@dataclass(frozen=True, slots=True)
class ServiceRule:
    """One ``[[service]]``: how long calls of some services may take, and their transport; ``None``: not said."""

    names: tuple[str, ...] = setting(
        NEEDED,
        values.list_of(values.SERVICE_GLOB, if_empty="name some services"),
        "Globs over services, by their names here.",
    )
    timeout: float | None = setting(
        None, values.TIMEOUT, "How long a call may take: seconds, or a text such as 5 min."
    )
    transport: Transport | None = setting(
        None, TRANSPORT, "relay: through the agents; direct, auto: from node to node where possible."
    )


_SERVICE_EXAMPLE: Final = 'one has names = ["/plan/**"] and timeout = "5 min", or transport = "direct"'


def _make_service(given: dict[str, Any]) -> ServiceRule:
    if len(given) == 1:
        raise values.BadValue("a rule without timeout and transport", _SERVICE_EXAMPLE)
    return ServiceRule(**given)


SERVICE_RULES: Final = rules_of(keys_of(ServiceRule), _make_service, _SERVICE_EXAMPLE)

# Names before and after, or namespaces ``/namespace/**``; ``{peer}`` in them is the peer's name.
Renames = tuple[tuple[str, str], ...]


def _read_prefix(raw: object) -> str:
    prefix = values.read_text(raw).strip()
    if prefix.strip("/") == "":
        raise values.BadValue(f"{prefix!r} puts nothing in front", "leave it out, or name a namespace")
    if prefix != (better := "/" + prefix.strip("/")):
        raise values.BadValue(f"{prefix!r} is not a namespace", better=better)
    _check_name(prefix)
    return prefix


def _read_renames(raw: Mapping[str, str]) -> Renames:
    """A table ``remap_in`` or ``remap_out``: the name after, by the name before."""
    if len(raw) > limits.REMAPS_MAX:
        raise values.BadValue(f"{len(raw)} rules", f"at most {limits.REMAPS_MAX}; rename namespaces")

    def read(renaming: tuple[str, str]) -> tuple[str, str]:
        before, after = map(_read_end, renaming)
        if before.endswith("/**") is not after.endswith("/**"):
            remedy = "a namespace becomes a namespace: both end with /**, or none"
            raise values.BadValue(f"{before} and {after} do not fit each other", remedy)
        return before, after

    return tuple(values.read_at(renaming[0], read, renaming) for renaming in raw.items())


def _read_end(raw: object) -> str:
    """One end of a renaming: a name, or a namespace followed by ``/**``."""
    end = values.read_text(raw).strip()
    stem = end.removesuffix("/**")
    if re.search(r"[*?]", stem):
        raise values.BadValue(f"{end!r} is not a name", "a rule renames /one/name, or all of a /namespace/**")
    if stem and not stem.startswith("/"):
        raise values.BadValue(f"{end!r} is not a global name", better=f"/{end}")
    if stem or end != "/**":
        _check_name(stem)
    return end


def _check_name(name: str) -> None:
    filled = name.replace(values.PEER, values.SOME_PEER)
    if name == "/" or not is_global_name(filled):
        raise values.BadValue(
            f"{name!r} is not a ROS name", "one looks like /robot1/odom; {peer} stands for the peer's name"
        )
    if len(filled) > limits.CROSSING_NAME_MAX:
        raise values.BadValue(
            f"a name of {len(filled)} characters", f"at most {limits.CROSSING_NAME_MAX} cross the mesh"
        )
    for pattern, why in NEVER_CROSSING.items():
        if matches(pattern, filled):
            raise values.BadValue(f"{name} never crosses: {why}", "leave this rule out")


_RENAMES: Final = values.ValueType(_read_renames, {"type": "object", "additionalProperties": {"type": "string"}})
_PEER_TOPICS: Final = values.list_of(values.glob_over("topic", *_WITH_PEER))


@dataclass(frozen=True, slots=True)
class PeerRule:
    """One ``[[peer]]``: what holds for the peers whose name fits. All rules that fit a peer apply, in order.

    Of ``remap_in`` and ``remap_out`` the first that fits a name applies. ``policy`` holds on top of ``[bridge]``, in
    our names with ``{peer}``.
    """

    name: str = setting(NEEDED, values.PEER_GLOB, "The peers, by a glob over their names.")
    prefix: str = setting(
        "",
        values.text_type(_read_prefix, f"/{values.PEER}"),
        "A namespace for their names here; {peer} is the peer's name.",
    )
    remap_in: Renames = setting((), _RENAMES, "Their names, and what they are here.")
    remap_out: Renames = setting((), _RENAMES, "Our names, and what they are there.")
    policy: PolicySettings = field(default_factory=PolicySettings)


_POLICY_KEYS: Final = {
    "allow": Setting(_PEER_TOPICS, "Topics that may cross, on top of [bridge], by their names here."),
    "deny": Setting(_PEER_TOPICS, "Topics that do not cross."),
    "allow_types": Setting(values.list_of(values.TYPE_GLOB), "Message types that may cross."),
    "deny_types": Setting(values.list_of(values.TYPE_GLOB), "Message types that do not cross."),
}


def _make_peer(given: dict[str, Any]) -> PeerRule:
    policy = PolicySettings(**{key: given.pop(key) for key in _POLICY_KEYS if key in given})
    return PeerRule(**given, policy=policy)


PEER_RULES: Final = rules_of(
    keys_of(PeerRule) | _POLICY_KEYS, _make_peer, 'name = "robot*" makes it one for those peers, "*" for all'
)


def peer_warnings(rules: Sequence[PeerRule]) -> Iterator[tuple[values.Place, str]]:
    """Rules that can be used but are probably mistakes: where, and what about it."""
    for index, rule in enumerate(rules):
        if rule == PeerRule(rule.name):
            yield (index,), "a rule that sets nothing"
        if rule.prefix and values.PEER not in rule.prefix and re.search(r"[*?]", rule.name):
            text = f"{rule.prefix} is one place for every peer that {rule.name} fits"
            yield (index, "prefix"), f"{text}; /{values.PEER} would keep them apart"


class Effect(StrEnum):
    """What a rule does where it fits."""

    ALLOW = "allow"
    DENY = "deny"


class Access(StrEnum):
    """What another module does with something of this module, or brings to it; a word of ``[[permission]]``.

    Attributes:
        verb: What it does, for texts: ``arm may not subscribe to /scan``.
        over: What its globs are over.
        about: What the reference of the settings says of it.
    """

    verb: str
    over: str
    about: str

    def __new__(cls, word: str, verb: str, over: str, about: str) -> Self:
        """Make a word of it that has the others beside it."""
        made = str.__new__(cls, word)
        made._value_, made.verb, made.over, made.about = word, verb, over, about
        return made

    PUBLISH = "publish", "publish", "topic", "Topics of the module that it may show here, by their names here."
    SUBSCRIBE = "subscribe", "subscribe to", "topic", "Topics of this module that it may subscribe to."
    CALL = "call", "call", "service", "Services of this module that it may call."
    SERVE = "serve", "serve", "service", "Services of the module that it may offer here, by their names here."
    PARAM = "param", "read or set", "parameter", "Parameters of this module that it may read or set, within [params]."
    KILL = "kill", "end", "node", "Nodes of this module that it may end, within [nodes] kill."
    LOG = (
        "log",
        "use the log of",
        "node",
        "Nodes whose log lines it may read and levels it may set; /rmpa: the agent.",
    )
    # No default gives it: what is started runs as the agent's user.
    LAUNCH = (
        "launch",
        "start",
        "resource",
        "Resources of [resources] that it may start, stop and read the log of; trust.default never gives this.",
    )
    RECORD = "record", "use the recording", "recording", "Recordings that it may have kept, read and remove: /NAME."


# The key of a rule about actions of this module, whose client the other module is.
ACTION_CLIENT: Final = "action"
# The key of a rule about actions of the other module, whose clients are here.
ACTION_SERVER: Final = "action_serve"
_GROUP_NAME: Final = values.text_like(
    "[A-Za-z][A-Za-z0-9_]{0,63}", "a group's name", "one has a letter, then letters, digits and _", "operators"
)


@dataclass(frozen=True, slots=True)
class ModuleGroup:
    """One line of ``[trust.groups]``: a name for the modules whose names fit one of the globs."""

    name: str
    modules: tuple[str, ...]

    def __str__(self) -> str:
        """``operators: joystick, laptop*``."""
        return f"{self.name}: {', '.join(self.modules)}"


@dataclass(frozen=True, slots=True)
class PermissionRule:
    """One ``[[permission]]``.

    Attributes:
        names: By key of the rule (a word of ``Access``, ``action``, ``action_serve``): globs over names here;
            ``{peer}`` in one is the module's name.
    """

    modules: tuple[str, ...] = setting(
        (),
        values.list_of(values.PEER_GLOB, if_empty="leave modules out, or name some"),
        "The modules, by globs over their names.",
    )
    groups: tuple[str, ...] = setting(
        (),
        values.list_of(_GROUP_NAME, if_empty="leave groups out, or name some"),
        "The groups of [trust.groups] to whose modules it applies too.",
    )
    effect: Effect = setting(
        Effect.ALLOW,
        values.member_of(Effect, "an effect"),
        "allow, the default, or deny, which wins where both match.",
    )
    names: Mapping[str, tuple[str, ...]] = field(default_factory=dict)


def _globs_over(what: str) -> values.ValueType[tuple[str, ...]]:
    return values.list_of(values.glob_over(what, *_WITH_PEER), if_empty="leave the key out, or name some")


_NAME_KEYS: Final = {
    **{access.value: Setting(_globs_over(access.over), access.about) for access in Access},
    ACTION_CLIENT: Setting(_globs_over("topic"), "Actions of this module that it may use."),
    ACTION_SERVER: Setting(_globs_over("topic"), "Actions of the module that nodes here may use."),
}
# The keys of a rule that have names of topics, services, parameters, nodes or actions.
NAME_KEYS: Final = tuple(_NAME_KEYS)


def _make_permission(given: dict[str, Any]) -> PermissionRule:
    names = {key: given.pop(key) for key in NAME_KEYS if key in given}
    rule = PermissionRule(**given, names=names)
    if not rule.modules and not rule.groups:
        raise values.BadValue("a rule without modules and groups", 'modules = ["*"] makes it one for every module')
    if not names:
        example = 'one has modules = ["joystick"] and publish = ["/cmd_vel"]'
        raise values.BadValue(f"a rule that {'denies' if rule.effect is Effect.DENY else 'allows'} nothing", example)
    return rule


PERMISSION_RULES: Final = rules_of(
    keys_of(PermissionRule) | _NAME_KEYS,
    _make_permission,
    most=limits.PERMISSION_RULES_MAX,
    instead="make groups of modules",
)
_GROUP: Final = values.list_of(values.PEER_GLOB, if_empty="leave the group out, or name some modules")


def _read_groups(raw: object) -> tuple[ModuleGroup, ...]:
    if raw == ():
        return ()
    if not isinstance(raw, dict):
        raise values.BadValue(f"{raw!r} is not a table", 'operators = ["joystick", "laptop*"] is a group')
    if len(raw) > limits.GROUPS_MAX:
        raise values.BadValue(f"{len(raw)} groups", f"at most {limits.GROUPS_MAX}")
    return tuple(
        ModuleGroup(values.read_at(name, _GROUP_NAME.read, name), values.read_at(name, _GROUP.read, modules))
        for name, modules in raw.items()
    )


MODULE_GROUPS: Final = values.ValueType(_read_groups, {"type": "object", "additionalProperties": _GROUP.json_schema})
PERMISSION_DEFAULT: Final = values.word_of(
    [str(effect) for effect in Effect], "a default", "deny, or allow: every member may do everything", "EFFECT"
)


def permission_problems(
    rules: Sequence[PermissionRule], groups: Sequence[ModuleGroup]
) -> Iterator[tuple[values.Place, str, str]]:
    """Problems that only show when all settings are known: ``(place in [[permission]], problem, remedy)``."""
    known = [group.name for group in groups]
    for index, rule in enumerate(rules):
        for place, name in enumerate(rule.groups):
            if name not in known:
                near = values.did_you_mean(name, known)
                there = f"the groups are {', '.join(known)}" if known else "there are none"
                remedy = f"did you mean {near}?" if near else f"make it in [trust.groups]; {there}"
                yield (index, "groups", place), f"there is no group {name!r}", remedy
