"""The tables ``[[peer]]`` of ``rmpa.toml``: names and policy for single peers (docs/names.md).

Rules that cannot be meant are refused: names that no topic can have or that never cross, two names that would become
one (which service would be called?), and names that lead back to themselves.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import combinations
from typing import TYPE_CHECKING, Final

from rmpa.config import limits
from rmpa.config.contract_rules import ConfigWarning
from rmpa.config.policy import PolicySettings
from rmpa.config.values import (
    PEER_GLOB,
    TYPE_GLOB,
    BadValue,
    JsonSchema,
    Place,
    RuleKey,
    ValueType,
    did_you_mean,
    list_of,
    read_at,
    read_keys,
    read_text,
    read_topic_glob,
    table_schema,
)
from rmpa.core.names import NEVER_CROSSING, is_global_name, matches

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence

PEER: Final = "{peer}"
"""Stands for the peer's name in a rule."""
_SOME_PEER: Final = "peer"
_DIRECTIONS: Final = ("in", "out")


def _read_peer_topic_glob(raw: object) -> str:
    """A glob over topics that may have ``{peer}`` in it."""
    try:
        read_topic_glob(raw.replace(PEER, _SOME_PEER) if isinstance(raw, str) else raw)
    except BadValue as error:
        if error.better is not None and isinstance(raw, str):
            error.better = f"/{raw.strip()}"
        raise
    return read_text(raw).strip()


_PEER_TOPIC_GLOB: Final = ValueType(_read_peer_topic_glob, {"type": "string", "examples": ["/{peer}/**"]})


@dataclass(frozen=True, slots=True)
class Remap:
    """One name, or a namespace, that has another name at a peer.

    Args:
        source: The name before, or ``/namespace/**``; ``{peer}`` in it is the peer's name.
        target: The name after, likewise.
        types: Globs over message types, one of which must fit; empty: topics of any type, and services.
    """

    source: str
    target: str
    types: tuple[str, ...] = ()


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
    remap_in: tuple[Remap, ...] = ()
    remap_out: tuple[Remap, ...] = ()
    policy: PolicySettings = field(default_factory=PolicySettings)


@dataclass(frozen=True, slots=True)
class _Placed:
    """A remap and where it is written; its names with some peer's name filled in."""

    remap: Remap
    at: Place
    source: str
    target: str

    def below(self, key: str | int) -> _Placed:
        """This renaming with a place that is one level deeper in the file."""
        return replace(self, at=(key, *self.at))


def _read_rules(raw: object) -> tuple[PeerRule, ...]:
    """Every ``[[peer]]`` of a file; ``BadValue.at`` says which rule, key and element is wrong."""
    if not isinstance(raw, list | tuple):
        raise BadValue(f"{raw!r} is not a list")
    rules: list[PeerRule] = []
    remaps: list[dict[str, list[_Placed]]] = []
    for index, table in enumerate(raw):
        rule, placed = read_at((index,), _read_rule, table)
        rules.append(rule)
        remaps.append({direction: [p.below(index) for p in found] for direction, found in placed.items()})
    for index, rule in enumerate(rules):
        together = [i for i in range(index + 1) if i == index or _meet(rules[i].name, rule.name)]
        for direction in _DIRECTIONS:
            _check([placed for i in together for placed in remaps[i][direction]])
    return tuple(rules)


def _meet(one: str, other: str) -> bool:
    """Whether two globs over peers' names surely fit a peer in common."""
    return one == other or matches(one, other) or matches(other, one)


def _read_rule(table: Mapping[str, object]) -> tuple[PeerRule, dict[str, list[_Placed]]]:
    if "name" not in table:
        raise BadValue("a rule without a name", 'name = "robot*" makes it one for those peers, "*" for all')
    values = read_keys(table, _KEYS)
    placed: dict[str, list[_Placed]] = {direction: [] for direction in _DIRECTIONS}
    for direction, remap in values.pop("remap", ()):
        placed[direction].append(remap.below("remap"))
    for direction, found in placed.items():
        key = f"remap_{direction}"
        found += [remap.below(key) for remap in values.pop(key, ())]
        if len(found) > limits.REMAPS_MAX:
            raise BadValue(f"{len(found)} rules", f"at most {limits.REMAPS_MAX}; rename namespaces", at=(key,))
    incoming, outgoing = (tuple(p.remap for p in placed[direction]) for direction in _DIRECTIONS)
    name, prefix = values.pop("name"), values.pop("prefix", "")
    return PeerRule(name, prefix, incoming, outgoing, PolicySettings(**values)), placed


def _read_prefix(raw: object) -> str:
    prefix = read_text(raw).strip()
    if prefix.strip("/") == "":
        raise BadValue(f"{prefix!r} puts nothing in front", "leave it out, or name a namespace")
    if prefix != (better := "/" + prefix.strip("/")):
        raise BadValue(f"{prefix!r} is not a namespace", better=better)
    _check_name(prefix)
    return prefix


def _read_remap(table: Mapping[str, object]) -> tuple[str, _Placed]:
    known = [key.name for key in _REMAP_KEYS]
    for key in table:
        if key not in known:
            near = did_you_mean(key, known)
            raise BadValue(
                "an unknown key", f"did you mean {near}?" if near else f"known here: {', '.join(known)}", at=(key,)
            )
    example = 'one has direction = "in", from = "/odom" and to = "/robot1/odom"'
    values = read_keys(table, _REMAP_KEYS, example)
    placed = read_at(("to",), partial(_placed, values["from"], types=values.get("types", ())), values["to"])
    return values["direction"], placed


def _read_remaps(raw: Sequence[Mapping[str, object]]) -> list[tuple[str, _Placed]]:
    """Every ``[[peer.remap]]`` of a rule: its direction, and what it renames."""
    found = []
    for index, table in enumerate(raw):
        direction, placed = read_at((index,), _read_remap, table)
        found.append((direction, placed.below(index)))
    return found


def _read_renames(raw: Mapping[str, str]) -> list[_Placed]:
    """A table ``remap_in`` or ``remap_out``: the name after, by the name before."""
    return [read_at((source,), partial(_placed, source), target).below(source) for source, target in raw.items()]


def _read_direction(raw: object) -> str:
    if raw not in _DIRECTIONS:
        raise BadValue(f"{raw!r} is not a direction", '"in" renames what they have, "out" what we have')
    return str(raw)


def _placed(source: str, target: object, types: tuple[str, ...] = ()) -> _Placed:
    """A renaming whose two ends fit each other."""
    before, after = _read_end(source), _read_end(target)
    if before.endswith("/**") is not after.endswith("/**"):
        raise BadValue(
            f"{before} and {after} do not fit each other",
            "a namespace becomes a namespace: both end with /**, or none",
        )
    remap = Remap(before, after, types)
    return _Placed(remap, (), before.replace(PEER, _SOME_PEER), after.replace(PEER, _SOME_PEER))


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

_NAME_OR_NAMESPACE: Final = ValueType(_read_end, {"type": "string", "examples": ["/odom", "/arm/**"]})
_REMAP_KEYS: Final = (
    RuleKey(
        "direction",
        ValueType(_read_direction, {"type": "string", "enum": list(_DIRECTIONS)}),
        "in renames what they have, out what this module has.",
        required=True,
    ),
    RuleKey("from", _NAME_OR_NAMESPACE, "The name before, or a namespace with /** behind it.", required=True),
    RuleKey("to", _NAME_OR_NAMESPACE, "The name after, likewise.", required=True),
    RuleKey(
        "types",
        list_of(TYPE_GLOB, if_empty="leave types out, or name some"),
        "Only topics of these message types; without it: any, and services.",
    ),
)
_RENAMES: Final[JsonSchema] = {"type": "object", "additionalProperties": {"type": "string"}}
_KEYS: Final = (
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
    RuleKey(
        "remap",
        ValueType(_read_remaps, {"type": "array", "items": table_schema(_REMAP_KEYS)}),
        "Single renamings, which may be for some message types only.",
    ),
    RuleKey("remap_in", ValueType(_read_renames, _RENAMES), "Their names, and what they are here."),
    RuleKey("remap_out", ValueType(_read_renames, _RENAMES), "Our names, and what they are there."),
    RuleKey("allow", list_of(_PEER_TOPIC_GLOB), "Topics that may cross, on top of [bridge], by their names here."),
    RuleKey("deny", list_of(_PEER_TOPIC_GLOB), "Topics that stay home."),
    RuleKey("allow_types", list_of(TYPE_GLOB), "Message types that may cross."),
    RuleKey("deny_types", list_of(TYPE_GLOB), "Message types that stay home."),
)
PEER_RULES: Final = ValueType(_read_rules, {"type": "array", "items": table_schema(_KEYS)})


# --- whether the rules of one direction fit each other --------------------------------------------------------------


def _check(rules: Sequence[_Placed]) -> None:
    for rule in rules:
        _check_end(rules, rule)
    for one, other in combinations(rules, 2):
        if not (one.remap.types and other.remap.types and set(one.remap.types).isdisjoint(other.remap.types)):
            _check_pair(rules, one, other)


def _check_end(rules: Sequence[_Placed], rule: _Placed) -> None:
    """Refuse names that lead back to themselves: which of them is meant cannot be known."""
    way = [_sample(rule.source)]
    for _ in range(len(rules) + 1):
        _, name = _first_fit(rules, way[-1])
        if name in {None, way[-1]}:
            return
        assert name is not None  # noqa: S101 - as just seen
        if name in way:
            shown = ", which becomes ".join([*way[way.index(name) + 1 :], name])
            problem = f"these rules undo each other: {name} becomes {shown}"
            raise BadValue(problem, "a name is renamed once; leave one of them out", at=rule.at)
        way.append(name)


def _check_pair(rules: Sequence[_Placed], one: _Placed, other: _Placed) -> None:
    """Refuse two names that would become the same."""
    longer, shorter = (one, other) if len(_stem(one.target)) >= len(_stem(other.target)) else (other, one)
    target = _sample(longer.target)
    sources = [_before(rule, target) for rule in (longer, shorter)]
    if None in sources or sources[0] == sources[1]:
        return
    if all(
        _first_fit(rules, str(name)) == (rule, target) for rule, name in zip((longer, shorter), sources, strict=True)
    ):
        ends = f"{one.remap.source} and {other.remap.source}"
        problem = f"{ends} would both become {target.removesuffix('/x') if longer.target.endswith('/**') else target}"
        raise BadValue(problem, "two topics or services of one name cannot be told apart", at=other.at)


def _stem(end: str) -> str:
    return end.removesuffix("/**")


def _sample(end: str) -> str:
    """A name that fits: of ``/a/**`` the name ``/a/x``."""
    return end[:-3] + "/x" if end.endswith("/**") else end


def _before(rule: _Placed, target: str) -> str | None:
    """The name that a rule renames to ``target``; ``None`` if there is none."""
    if not rule.target.endswith("/**"):
        return rule.source if target == rule.target else None
    stem = _stem(rule.target)
    return _stem(rule.source) + target[len(stem) :] if target == stem or target.startswith(stem + "/") else None


def _first_fit(rules: Sequence[_Placed], name: str) -> tuple[_Placed | None, str | None]:
    """The first rule that renames a name, and the name after."""
    for rule in rules:
        if not rule.source.endswith("/**"):
            if name == rule.source:
                return rule, rule.target
        elif name == (stem := _stem(rule.source)) or name.startswith(stem + "/"):
            return rule, _stem(rule.target) + name[len(stem) :]
    return None, None


def peer_warnings(rules: Sequence[PeerRule]) -> Iterator[ConfigWarning]:
    """Warnings about rules that can be used but are probably mistakes."""
    for index, rule in enumerate(rules):
        if rule == PeerRule(rule.name):
            yield ConfigWarning((index,), "a rule that sets nothing")
        if rule.prefix and PEER not in rule.prefix and re.search(r"[*?]", rule.name):
            text = f"{rule.prefix} is one place for every peer that {rule.name} fits; /{PEER} would keep them apart"
            yield ConfigWarning((index, "prefix"), text)
