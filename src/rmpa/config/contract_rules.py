"""Reads the rules ``[[contract]]`` of ``rmpa.toml``: each key's value, and whether a rule's keys fit each other."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, TypeVar

from rmpa.config import limits
from rmpa.config.values import BadValue, did_you_mean, read_list, read_topic_glob, read_type_glob, read_whole
from rmpa.core.contract import ContractRule, Durability, History, Liveliness, Priority, Reliability

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping, Sequence
    from enum import StrEnum

_Value = TypeVar("_Value")

_QUANTITY: Final = re.compile(r"([0-9]{1,9}(?:\.[0-9]{1,9})?)\s*([a-zµ]*)")
_SECONDS: Final = {"us": 1e6, "µs": 1e6, "ms": 1e3, "s": 1.0, "min": 1 / 60, "h": 1 / 3600}
"""How many of each unit are a second. Dividing by these rounds once: ``"100 ms"`` is 0.1, as a user writes it."""
_INFINITE: Final = "infinite"
"""ROS 2's own word for a duration without a bound; it lifts what an earlier rule has set."""
_UNLIMITED: Final = "unlimited"
"""The same for a rate."""


def read_duration(raw: object, what: str = "a duration") -> float | None:
    """Seconds as a number, or a text such as ``"100 ms"`` or ``"2 s"``; ``"infinite"`` is ``None``.

    Args:
        raw: As written.
        what: What the duration is, with its article, for the text of errors.

    Raises:
        BadValue: It is not a duration, or no sensible one.
    """
    return _bounded(raw, _seconds(raw, what), what)


def _seconds(raw: object, what: str) -> float:
    """A duration as it is written, whatever its size."""
    example = f'{what} is seconds as a number, or a text such as "100 ms"'
    if not isinstance(raw, str):
        return _number(raw, "a duration", example)
    text = raw.strip().lower()
    if text == _INFINITE:
        return math.inf
    number, unit = _quantity(text)
    if number and unit == "hz":
        raise BadValue(f"{raw!r} is a rate, not a duration", better=f"{1000 / number:g} ms")
    if number is None or unit not in _SECONDS:
        raise BadValue(f"{raw!r} is not a duration", f"{example}; units are {', '.join(_SECONDS)}")
    return number / _SECONDS[unit]


def _read_outage(raw: object) -> float:
    """How long messages are kept for a peer that is away; unlike other durations it has an end."""
    seconds = _seconds(raw, "an outage")
    shortest, longest = limits.OUTAGE_MIN, limits.OUTAGE_MAX
    if not shortest <= seconds <= longest:
        bounds = f"an outage is between {shortest:g} and {longest:.0f} s: messages are not kept for ever"
        raise BadValue(f"{_written(raw)} is out of range", bounds)
    return seconds


def _bounded(raw: object, seconds: float, what: str) -> float | None:
    if seconds == math.inf:
        return None
    if not limits.CONTRACT_TIME_MIN <= seconds <= limits.CONTRACT_TIME_MAX:
        bounds = f"{limits.CONTRACT_TIME_MIN:g} and {limits.CONTRACT_TIME_MAX:.0f} s"
        raise BadValue(
            f"{_written(raw)} is out of range", f'{what} is between {bounds}; "{_INFINITE}" is none at all'
        )
    return seconds


def read_rate(raw: object) -> float | None:
    """Messages a second as a number, or a text such as ``"10 Hz"``; ``"unlimited"`` is ``None``.

    Raises:
        BadValue: It is not a rate, or no sensible one.
    """
    example = 'a rate is messages a second as a number, or a text such as "10 Hz"'
    if isinstance(raw, str):
        text = raw.strip().lower()
        if text == _UNLIMITED:
            return None
        number, unit = _quantity(text)
        if number and unit in _SECONDS:
            raise BadValue(f"{raw!r} is a duration, not a rate", better=f"{_SECONDS[unit] / number:g} Hz")
        if number is None or unit != "hz":
            raise BadValue(f"{raw!r} is not a rate", example)
        rate = number
    else:
        rate = _number(raw, "a rate", example)
    if rate == math.inf:
        return None
    if not limits.CONTRACT_RATE_MIN <= rate <= limits.CONTRACT_RATE_MAX:
        bounds = f"{limits.CONTRACT_RATE_MIN:g} and {limits.CONTRACT_RATE_MAX:.0f} Hz"
        raise BadValue(
            f"{_written(raw)} is out of range", f'a rate is between {bounds}; "{_UNLIMITED}" is none at all'
        )
    return rate


def _quantity(text: str) -> tuple[float | None, str]:
    match = _QUANTITY.fullmatch(text)
    return (float(match[1]), match[2]) if match else (None, "")


def _number(raw: object, what: str, example: str) -> float:
    if isinstance(raw, bool) or not isinstance(raw, int | float) or math.isnan(raw):
        raise BadValue(f"{_written(raw)} is not {what}", example)
    return float(raw)  # TOML's whole numbers have 64 bits


def _written(raw: object) -> str:
    shown = str(raw).lower() if isinstance(raw, bool) else repr(raw)
    return shown if len(shown) <= 60 else shown[:57] + "..."


def _word(kind: type[StrEnum], what: str) -> Callable[[object], object]:
    def read(raw: object) -> object:
        text = str(raw).strip().lower()
        words = [word.value for word in kind]
        if text not in words:
            raise BadValue(f"{raw!r} is not {what}", f"it is one of {', '.join(words)}", did_you_mean(text, words))
        return kind(text)

    return read


def _read_depth(raw: object) -> int:
    return read_whole(raw, 1, limits.CONTRACT_DEPTH_MAX, "a depth")


_READERS: Final[Mapping[str, tuple[str, Callable[[object], object]]]] = {
    "reliability": ("reliability", _word(Reliability, "a reliability")),
    "durability": ("durability", _word(Durability, "a durability")),
    "history": ("history", _word(History, "a history")),
    "depth": ("depth", _read_depth),
    "deadline": ("deadline", lambda raw: read_duration(raw, "a deadline")),
    "lifespan": ("lifespan", lambda raw: read_duration(raw, "a lifespan")),
    "liveliness": ("liveliness", _word(Liveliness, "a liveliness")),
    "liveliness_lease_duration": ("liveliness_lease", lambda raw: read_duration(raw, "a lease")),
    "priority": ("priority", _word(Priority, "a priority")),
    "max_rate": ("max_rate", read_rate),
    "outage": ("outage", _read_outage),
}
"""By the file's key: the contract's field, and the reader of its value."""


@dataclass(frozen=True, slots=True)
class ConfigWarning:
    """Something in the rules that can be used and is hardly meant.

    Args:
        at: Where: the rule's index, and the key in it.
        text: What about it.
    """

    at: tuple[str | int, ...]
    text: str


@dataclass(frozen=True, slots=True)
class ContractRules:
    """All rules, in the order of the file, and what is doubtful about them."""

    rules: tuple[ContractRule, ...] = ()
    doubts: tuple[ConfigWarning, ...] = ()


def read_contracts(raw: object) -> ContractRules:
    """Every ``[[contract]]`` of a file, each as a table of its keys (of known names, as ``config.file`` checks).

    Raises:
        BadValue: ``at`` says which rule, key and element.
    """
    if not isinstance(raw, list | tuple):
        raise BadValue(f"{_written(raw)} is not a list")
    rules: list[ContractRule] = []
    for index, table in enumerate(raw):
        try:
            rules.append(_read_rule(table))
        except BadValue as error:
            error.at = (index, *error.at)
            raise
    return ContractRules(tuple(rules), tuple(_doubts(rules)))


def _read_rule(table: Mapping[str, object]) -> ContractRule:
    topics = _read_globs(table, "topics", read_topic_glob)
    types = _read_globs(table, "types", read_type_glob)
    if not topics and not types:
        raise BadValue("a rule without topics and types", 'topics = ["/**"] makes it one for every topic')
    values: dict[str, object] = {}
    for key, (name, read) in _READERS.items():
        if key in table:
            values[name] = _at_key(key, read, table[key])
    if "liveliness_lease" in values and "liveliness" not in values:
        remedy = (
            'add liveliness = "automatic" (its link says that a source lives) or "manual_by_topic" (its messages)'
        )
        raise BadValue("says nothing without liveliness", remedy, at=("liveliness_lease_duration",))
    return ContractRule(topics, types, values)


def _read_globs(table: Mapping[str, object], key: str, item: Callable[[object], str]) -> tuple[str, ...]:
    if key not in table:
        return ()
    globs: tuple[str, ...] = _at_key(key, lambda raw: read_list(raw, item), table[key])
    if not globs:
        raise BadValue("an empty list fits nothing", f"leave {key} out, or name some", at=(key,))
    return globs


def _at_key(key: str, read: Callable[[object], _Value], raw: object) -> _Value:
    try:
        return read(raw)
    except BadValue as error:
        error.at = (key, *error.at)
        raise


def _doubts(rules: Sequence[ContractRule]) -> Iterator[ConfigWarning]:
    leased = any(rule.values.get("liveliness_lease") is not None for rule in rules)
    reliable = any(rule.values.get("reliability") == Reliability.RELIABLE for rule in rules)
    for index, rule in enumerate(rules):
        values = rule.values
        if not values:
            yield ConfigWarning((index,), "a rule that sets nothing")
        if values.get("history") == History.KEEP_ALL and "depth" in values:
            yield ConfigWarning((index, "depth"), "has no effect beside history keep_all")
        if values.get("liveliness") == Liveliness.MANUAL_BY_TOPIC and not leased:
            yield ConfigWarning((index, "liveliness"), "has no effect without a liveliness_lease_duration")
        if "outage" in values and not reliable:
            yield ConfigWarning((index, "outage"), 'has no effect without reliability = "reliable"')
        deadline, rate = values.get("deadline"), values.get("max_rate")
        if isinstance(deadline, float) and isinstance(rate, float) and deadline * rate < 1:
            text = f"{rate:g} messages a second miss the deadline of {deadline:g} s every time"
            yield ConfigWarning((index, "max_rate"), text)
