"""Reads ``[params]``, ``[[param]]`` and ``[time]`` of ``rmpa.toml``: which parameters are followed, and from whom."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING, Final

from rmpa.config import limits
from rmpa.config.settings import FollowRule
from rmpa.config.values import BadValue, read_name, read_text, read_topic_glob
from rmpa.core.names import is_global_name, is_legal_name, matches

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping, Sequence

SIM_TIME: Final = "/use_sim_time"
CLOCK: Final = "/clock"
UNTOUCHABLE: Final = {
    "/run_id": "it names the run of this module's core",
    "/roslaunch/**": "it is roslaunch's own",
    "/rosdistro": "it tells which ROS this core is",
    "/rosversion": "it tells which ROS this core is",
    SIM_TIME: "time is followed by [time] alone",
}
"""Parameters that nothing from another module ever sets or deletes, and why."""
_OWNER_ALONE: Final = "a parameter has one owner: leave one of the rules out"


def untouchable(key: str) -> str:
    """Why a key may not be changed from another module: it, one below it or one above it is untouchable; or empty."""
    for pattern, why in UNTOUCHABLE.items():
        if matches(pattern, key) or overlap(pattern.removesuffix("/**"), key):
            return why if pattern == key.rstrip("/") else f"{pattern}: {why}"
    return ""


def overlap(one: str, other: str) -> bool:
    """Whether two keys are one, or one of them is the namespace of the other."""
    first, second = one.rstrip("/") + "/", other.rstrip("/") + "/"
    return first.startswith(second) or second.startswith(first)


def read_key_glob(raw: object) -> str:
    """A glob over parameters, as ``core.names.matches`` reads it."""
    try:
        return read_topic_glob(raw)
    except BadValue as error:
        problem, remedy = (text.replace("topics", "parameters") for text in (error.problem, error.remedy))
        raise BadValue(
            problem.replace("topic", "parameter"), remedy.replace("topic", "parameter"), error.better
        ) from None


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


def read_follow_rules(raw: object) -> tuple[FollowRule, ...]:
    """Every ``[[param]]`` of a file, each as a table of its keys (of known names, as ``config.file`` checks).

    Raises:
        BadValue: ``at`` says which rule and key: a bad value, or one that contradicts a rule before it.
    """
    if not isinstance(raw, list | tuple):
        raise BadValue(f"{raw!r} is not a list")
    if len(raw) > limits.FOLLOW_RULES_MAX:
        raise BadValue(f"{len(raw)} rules", f"at most {limits.FOLLOW_RULES_MAX}; follow a namespace as a whole")
    rules: list[FollowRule] = []
    for index, table in enumerate(raw):
        try:
            rule = _read_rule(table)
            _check_against(rules, rule)
        except BadValue as error:
            error.at = (index, *error.at)
            raise
        rules.append(rule)
    return tuple(rules)


def _read_rule(table: Mapping[str, object]) -> FollowRule:
    for key in ("key", "from"):
        if key not in table:
            raise BadValue(f"a rule without {key}", 'one has key = "/robot_description" and from = "base"')
    key = _at("key", read_key, table["key"])
    owner = _at("from", read_name, table["from"])
    to = _at("to", read_key, table["to"]) if "to" in table else key
    if why := untouchable(to):
        raise BadValue(f"{to} cannot be followed: {why}", at=("to",) if "to" in table else ("key",))
    return FollowRule(key, owner, to)


def _check_against(rules: Sequence[FollowRule], rule: FollowRule) -> None:
    for other in rules:
        if overlap(other.to, rule.to):
            whose = f"{other.to} comes from {other.owner}'s {other.key} already"
            raise BadValue(f"{rule.to} cannot come from {rule.owner} too: {whose}", _OWNER_ALONE)


def _at(key: str, read: Callable[[object], str], raw: object) -> str:
    try:
        return read(raw)
    except BadValue as error:
        error.at = (key, *error.at)
        raise


def problems(rules: Sequence[FollowRule], follow: str, name: str) -> Iterator[tuple[str, tuple[str | int, ...], str]]:
    """What only shows when all settings are known: ``(setting, place in it, problem)``.

    Args:
        rules: Of ``[[param]]``.
        follow: Whose time is followed.
        name: This module's own.
    """
    for index, rule in enumerate(rules):
        if rule.owner == name:
            yield "follow", (index, "from"), f"{name} is this module itself; its own parameters are here already"
    if follow and follow == name:
        yield "time_follow", (), f"{name} is this module itself; its own time is here already"
