"""Reads ``[services]`` and ``[[service]]`` of ``rmpa.toml``: which services cross, and how long a call may take."""

from __future__ import annotations

from typing import TYPE_CHECKING

from rmpa.config import limits
from rmpa.config.contract_rules import read_duration
from rmpa.config.settings import ServiceRule
from rmpa.config.values import BadValue, read_list, read_topic_glob

if TYPE_CHECKING:
    from collections.abc import Mapping


def read_service_glob(raw: object) -> str:
    """A glob over services, as ``core.names.matches`` reads it."""
    try:
        return read_topic_glob(raw)
    except BadValue as error:
        problem, remedy = (text.replace("topic", "service") for text in (error.problem, error.remedy))
        raise BadValue(problem, remedy, error.better) from None


def read_node_glob(raw: object) -> str:
    """A glob over nodes, as ``core.names.matches`` reads it."""
    try:
        return read_topic_glob(raw)
    except BadValue as error:
        problem, remedy = (text.replace("topic", "node") for text in (error.problem, error.remedy))
        raise BadValue(problem, remedy, error.better) from None


def read_timeout(raw: object) -> float:
    """Seconds that a call may take, as a number or a text such as ``"500 ms"``; there is always an end."""
    seconds = read_duration(raw, "a timeout")
    if seconds is None or seconds > limits.SERVICE_TIMEOUT_MAX:
        raise BadValue(
            f"{raw!r} is too long for a call", f"at most {limits.SERVICE_TIMEOUT_MAX:g} s: an action can say more"
        )
    return seconds


def read_service_rules(raw: object) -> tuple[ServiceRule, ...]:
    """Every ``[[service]]`` of a file, each as a table of its keys (of known names, as ``config.file`` checks).

    Raises:
        BadValue: ``at`` says which rule and key.
    """
    if not isinstance(raw, list | tuple):
        raise BadValue(f"{raw!r} is not a list")
    rules: list[ServiceRule] = []
    for index, table in enumerate(raw):
        try:
            rules.append(_read_rule(table))
        except BadValue as error:
            error.at = (index, *error.at)
            raise
    return tuple(rules)


def _read_rule(table: Mapping[str, object]) -> ServiceRule:
    for key in ("names", "timeout"):
        if key not in table:
            raise BadValue(f"a rule without {key}", 'one has names = ["/plan/**"] and timeout = "5 min"')
    try:
        names = read_list(table["names"], read_service_glob)
    except BadValue as error:
        error.at = ("names", *error.at)
        raise
    if not names:
        raise BadValue("an empty list fits nothing", "name some services", at=("names",))
    try:
        return ServiceRule(names, read_timeout(table["timeout"]))
    except BadValue as error:
        error.at = ("timeout", *error.at)
        raise
