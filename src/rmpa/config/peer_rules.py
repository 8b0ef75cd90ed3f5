"""The tables ``[[peer]]`` of ``rmpa.toml``: names and policy for single peers (docs/names.md).

Names that no topic can have, or that never cross, are refused. What two names do that become one shows at run time:
the first stays, and the other one says why it is hidden.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from functools import partial
from typing import TYPE_CHECKING, Final

from rmpa.config import limits
from rmpa.config.contract_rules import ConfigWarning
from rmpa.config.policy import PolicySettings
from rmpa.config.values import (
    PEER_GLOB,
    TOPIC_GLOB,
    TYPE_GLOB,
    BadValue,
    JsonSchema,
    RuleKey,
    ValueType,
    list_of,
    read_at,
    read_keys,
    read_text,
    tables_of,
)
from rmpa.core.identity import NEVER_CROSSING, is_global_name, matches

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence

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


def _read_rule(table: Mapping[str, object]) -> PeerRule:
    if "name" not in table:
        raise BadValue("a rule without a name", 'name = "robot*" makes it one for those peers, "*" for all')
    values = read_keys(table, _KEYS)
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
    RuleKey("remap_in", ValueType(_read_renames, _RENAMES), "Their names, and what they are here."),
    RuleKey("remap_out", ValueType(_read_renames, _RENAMES), "Our names, and what they are there."),
    RuleKey(
        "allow", list_of(with_peer(TOPIC_GLOB)), "Topics that may cross, on top of [bridge], by their names here."
    ),
    RuleKey("deny", list_of(with_peer(TOPIC_GLOB)), "Topics that stay home."),
    RuleKey("allow_types", list_of(TYPE_GLOB), "Message types that may cross."),
    RuleKey("deny_types", list_of(TYPE_GLOB), "Message types that stay home."),
)
PEER_RULES: Final = tables_of(_KEYS, _read_rule)


def peer_warnings(rules: Sequence[PeerRule]) -> Iterator[ConfigWarning]:
    """Warnings about rules that can be used but are probably mistakes."""
    for index, rule in enumerate(rules):
        if rule == PeerRule(rule.name):
            yield ConfigWarning((index,), "a rule that sets nothing")
        if rule.prefix and PEER not in rule.prefix and re.search(r"[*?]", rule.name):
            text = f"{rule.prefix} is one place for every peer that {rule.name} fits; /{PEER} would keep them apart"
            yield ConfigWarning((index, "prefix"), text)
