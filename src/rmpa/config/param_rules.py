"""The tables ``[[param]]`` of ``rmpa.toml``: which parameters of which peers are followed, and under which name."""

from __future__ import annotations

import re
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Final

from rmpa.config import limits
from rmpa.config.values import NAME, BadValue, Place, RuleKey, ValueType, read_at, read_keys, read_text, tables_of
from rmpa.core.identity import is_global_name, is_legal_name, matches

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence

SIM_TIME: Final = "/use_sim_time"
CLOCK: Final = "/clock"
UNTOUCHABLE: Final = {
    "/run_id": "it names the run of this module's core",
    "/roslaunch/**": "it is roslaunch's own",
    "/rosdistro": "it tells which ROS this core is",
    "/rosversion": "it tells which ROS this core is",
    SIM_TIME: "time is followed by [time] alone",
}
"""Parameters that another module never sets or deletes, and why."""
_OWNER_ALONE: Final = "a parameter has one owner: leave one of the rules out"


@dataclass(frozen=True, slots=True)
class FollowRule:
    """One ``[[param]]``: a parameter, or a namespace as a whole, of a peer that this module follows.

    Args:
        key: Its global name at the peer.
        owner: The peer's name.
        to: Its global name here.
    """

    key: str
    owner: str
    to: str

    def __str__(self) -> str:
        """``base:/robot_description as /base/robot_description``."""
        return f"{self.owner}:{self.key}" + (f" as {self.to}" if self.to != self.key else "")


def untouchable(key: str) -> str:
    """Why another module may not change a key: it, one below it or one above it is ``UNTOUCHABLE``; empty: it may."""
    for pattern, why in UNTOUCHABLE.items():
        if matches(pattern, key) or overlap(pattern.removesuffix("/**"), key):
            return why if pattern == key.rstrip("/") else f"{pattern}: {why}"
    return ""


def overlap(one: str, other: str) -> bool:
    """Whether two keys are the same, or one of them is a namespace around the other."""
    first, second = one.rstrip("/") + "/", other.rstrip("/") + "/"
    return first.startswith(second) or second.startswith(first)


def read_key(raw: object) -> str:
    """A parameter's global name; not the root."""
    key = read_text(raw).strip()
    if key.strip("/") == "":
        raise BadValue("the root holds every parameter", "name one, or a namespace")
    if re.search(r"[*?]", key):
        raise BadValue(f"{key!r} is a glob", "name one parameter, or a namespace, which is followed as a whole")
    if not key.startswith("/") and is_legal_name(key) and not key.startswith("~"):
        raise BadValue(f"{key!r} is not a global name", better=f"/{key.rstrip('/')}")
    if not is_global_name(key.rstrip("/")) or "//" in key:
        raise BadValue(f"{key!r} is not a parameter's name", "one looks like /robot_description")
    if len(key) > limits.CROSSING_NAME_MAX:
        raise BadValue(f"a name of {len(key)} characters", f"at most {limits.CROSSING_NAME_MAX} cross the mesh")
    return key.rstrip("/")


def _read_owner(raw: object) -> str:
    if re.fullmatch(r"\w+/\w+", read_text(raw)):
        raise BadValue(
            f"{raw!r} is a module of another site, whose parameters are not followed",
            f"read one by `rmpa param get --peer {raw} NAME`",
        )
    return NAME.read(raw)


_OWNER: Final = ValueType(_read_owner, NAME.json_schema)
_PARAM: Final = ValueType(read_key, {"type": "string", "examples": ["/robot_description"]})
_KEYS: Final = (
    RuleKey("key", _PARAM, "The parameter's name at its owner; a namespace is followed as a whole.", required=True),
    RuleKey("from", _OWNER, "The peer that owns it.", required=True),
    RuleKey("to", _PARAM, "Its name here; without it: the same."),
)


def _read_rule(table: Mapping[str, object]) -> FollowRule:
    values = read_keys(table, _KEYS, 'one has key = "/robot_description" and from = "base"')
    rule = FollowRule(values["key"], values["from"], values.get("to", values["key"]))
    if why := untouchable(rule.to):
        raise BadValue(f"{rule.to} cannot be followed: {why}", at=("to",) if "to" in table else ("key",))
    return rule


def _read_rules(raw: object) -> tuple[FollowRule, ...]:
    """Every ``[[param]]`` of a file; the error about a rule that contradicts an earlier one is at the later one."""
    rules = _TABLES.read(raw)
    for index, rule in enumerate(rules):
        read_at((index,), partial(_check_against, rules[:index]), rule)
    return rules


_TABLES: Final = tables_of(_KEYS, _read_rule, limits.FOLLOW_RULES_MAX, "follow a namespace as a whole")
PARAM_RULES: Final = ValueType(_read_rules, _TABLES.json_schema)


def _check_against(rules: Sequence[FollowRule], rule: FollowRule) -> None:
    for other in rules:
        if overlap(other.to, rule.to):
            whose = f"{other.to} comes from {other.owner}'s {other.key} already"
            raise BadValue(f"{rule.to} cannot come from {rule.owner} too: {whose}", _OWNER_ALONE)


def follow_problems(rules: Sequence[FollowRule], time_owner: str, name: str) -> Iterator[tuple[str, Place, str]]:
    """Problems that only show when all settings are known: ``(setting, place in it, problem)``.

    Args:
        rules: Of ``[[param]]``.
        time_owner: The peer whose time is followed; empty for none.
        name: This module's own name.
    """
    for index, rule in enumerate(rules):
        if rule.owner == name:
            yield (
                "params.follow",
                (index, "from"),
                f"{name} is this module itself; its own parameters are here already",
            )
    if time_owner and time_owner == name:
        yield "time.follow", (), f"{name} is this module itself; its own time is here already"
