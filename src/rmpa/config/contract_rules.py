"""The tables ``[[contract]]`` of ``rmpa.toml``: what topics need, in ROS 2's words (docs/contracts.md)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from rmpa.config import limits
from rmpa.config.quantities import OUTAGE, RATE, duration_of
from rmpa.config.values import (
    TOPIC_GLOB,
    TRANSPORT,
    TYPE_GLOB,
    BadValue,
    Place,
    RuleKey,
    list_of,
    member_of,
    read_keys,
    tables_of,
    whole_number,
)
from rmpa.core.contract import (
    Contract,
    ContractRule,
    Durability,
    History,
    Liveliness,
    Priority,
    Reliability,
    Transport,
    needs_agents,
)

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence


KEYS: Final = (
    RuleKey(
        "topics",
        list_of(TOPIC_GLOB, if_empty="leave topics out, or name some"),
        "Globs over topics, one of which must fit; without it: any topic.",
    ),
    RuleKey(
        "types",
        list_of(TYPE_GLOB, if_empty="leave types out, or name some"),
        "Globs over message types, one of which must fit; without it: any type.",
    ),
    RuleKey("reliability", member_of(Reliability, "a reliability"), "Whether messages survive the loss of a link."),
    RuleKey(
        "durability",
        member_of(Durability, "a durability"),
        "Whether a late subscriber gets each source's last ones.",
    ),
    RuleKey("history", member_of(History, "a history"), "What a full queue keeps."),
    RuleKey(
        "depth",
        whole_number(1, limits.CONTRACT_DEPTH_MAX, "a depth"),
        "Messages that wait for one slow receiver; beyond it the oldest is dropped.",
    ),
    RuleKey("deadline", duration_of("a deadline"), "The longest time from one message to the next."),
    RuleKey("lifespan", duration_of("a lifespan"), "A message that is older is dropped."),
    RuleKey(
        "liveliness",
        member_of(Liveliness, "a liveliness"),
        "What shows that a source is alive: its link, or its own messages.",
    ),
    RuleKey(
        "liveliness_lease_duration",
        duration_of("a lease"),
        "Without a sign of life for so long a source counts as dead; needs liveliness.",
    ),
    RuleKey("priority", member_of(Priority, "a priority"), "The lane: high is express, low is bulk, normal by size."),
    RuleKey("max_rate", RATE, "Messages a second that cross at most; the newest are kept."),
    RuleKey("outage", OUTAGE, "How long a reliable topic is kept when its link is gone."),
    RuleKey("transport", TRANSPORT, "relay: through the agents; direct, auto: from node to node where it can be."),
)
"""The keys that one ``[[contract]]`` may have."""
_FIELDS: Final = {"liveliness_lease_duration": "liveliness_lease"}
"""The contract's field, for a key that has another name."""


@dataclass(frozen=True, slots=True)
class ConfigWarning:
    """Something in the rules that can be used but is probably a mistake.

    Args:
        at: Where: the rule's index, and the key in it.
        text: What about it.
    """

    at: Place
    text: str


def _read_rule(table: Mapping[str, object]) -> ContractRule:
    values = read_keys(table, KEYS)
    topics, types = values.pop("topics", ()), values.pop("types", ())
    if not topics and not types:
        raise BadValue("a rule without topics and types", 'topics = ["/**"] makes it one for every topic')
    if "liveliness_lease_duration" in values and "liveliness" not in values:
        remedy = (
            'add liveliness = "automatic" (its link says that a source lives) or "manual_by_topic" (its messages)'
        )
        raise BadValue("says nothing without liveliness", remedy, at=("liveliness_lease_duration",))
    return ContractRule(topics, types, {_FIELDS.get(key, key): value for key, value in values.items()})


CONTRACT_RULES: Final = tables_of(KEYS, _read_rule)


def contract_warnings(rules: Sequence[ContractRule]) -> Iterator[ConfigWarning]:
    """Warnings about rules that can be used but are probably mistakes."""
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
        if values.get("transport") == Transport.DIRECT:
            terms = needs_agents(Contract(**values))  # type: ignore[arg-type] # as ContractRule.values promises
            if terms:
                text = f"direct has no effect: only agents can keep {terms}, so the topic is relayed"
                yield ConfigWarning((index, "transport"), text)
        deadline, rate = values.get("deadline"), values.get("max_rate")
        if isinstance(deadline, float) and isinstance(rate, float) and deadline * rate < 1:
            text = f"{rate:g} messages a second miss the deadline of {deadline:g} s every time"
            yield ConfigWarning((index, "max_rate"), text)
