"""Contracts: which rules apply to a topic, who outweighs whom, and what two ends agree on."""

from __future__ import annotations

import dataclasses

import pytest
from hypothesis import given
from hypothesis import strategies as st
from msgspec import UNSET

from rmpa.core import limits
from rmpa.core.contract import (
    KEYS,
    Contract,
    ContractRule,
    Contracts,
    Durability,
    History,
    Liveliness,
    Priority,
    Reliability,
    Transport,
    combine,
    needs_agents,
)
from rmpa.core.identity import matches

SECONDS = st.one_of(st.none(), st.sampled_from([0.1, 0.5, 2.0]))
VALUES: dict[str, st.SearchStrategy[object]] = {
    "reliability": st.sampled_from(Reliability),
    "durability": st.sampled_from(Durability),
    "history": st.sampled_from(History),
    "depth": st.one_of(st.just(UNSET), st.integers(1, 10), st.just(limits.ROUTE_QUEUE_MESSAGES)),
    "deadline": SECONDS,
    "lifespan": SECONDS,
    "liveliness": st.sampled_from(Liveliness),
    "liveliness_lease": SECONDS,
    "priority": st.sampled_from(Priority),
    "max_rate": st.one_of(st.none(), st.sampled_from([1.0, 10.0])),
    "outage": st.sampled_from([UNSET, limits.RESUME_WINDOW, 31.0, 300.0]),
    "transport": st.sampled_from(Transport),
}
WRITTEN = {key: values.filter(lambda value: value is not UNSET) for key, values in VALUES.items()}
DEFAULTS = {"depth": limits.ROUTE_QUEUE_MESSAGES, "outage": limits.RESUME_WINDOW}
CONTRACTS = st.builds(Contract, **VALUES)
GLOBS = st.lists(st.sampled_from(["/a", "/a/**", "/*", "/**", "/b/?"]), max_size=2, unique=True).map(tuple)
TYPE_GLOBS = st.lists(st.sampled_from(["m/A", "m/*", "**", "n/B"]), max_size=2, unique=True).map(tuple)
RULES = st.lists(
    st.builds(ContractRule, GLOBS, TYPE_GLOBS, st.fixed_dictionaries({}, optional=WRITTEN)), max_size=3
).map(tuple)
TOPICS = st.sampled_from(["/a", "/a/x", "/b", "/b/c", "/c/d/e"])
TYPES = st.sampled_from(["m/A", "m/B", "n/B", ""])


def rule(*topics: str, types: tuple[str, ...] = (), **values: object) -> ContractRule:
    return ContractRule(topics, types, values)


def test_no_rules_ask_for_nothing() -> None:
    assert Contracts().of("/cmd", "a/B") == Contract()
    assert Contract() == Contract(
        Reliability.BEST_EFFORT,
        Durability.VOLATILE,
        History.KEEP_LAST,
        UNSET,
        None,
        None,
        Liveliness.AUTOMATIC,
        None,
        Priority.NORMAL,
        None,
        UNSET,
        Transport.RELAY,
    )
    assert (Contract().queue_depth, Contract().resume_window) == (limits.ROUTE_QUEUE_MESSAGES, limits.RESUME_WINDOW)


@pytest.mark.parametrize("depth", [1, limits.ROUTE_QUEUE_MESSAGES - 1, limits.ROUTE_QUEUE_MESSAGES])
def test_a_depth_that_is_written_out_is_kept_for_late_subscribers(depth: int) -> None:
    assert Contract(durability=Durability.TRANSIENT_LOCAL, depth=depth).kept == depth
    assert Contract(durability=Durability.TRANSIENT_LOCAL).kept == 1


def test_the_words_are_those_of_ros_2() -> None:
    assert [*Reliability, *Durability, *History, *Liveliness, *Priority] == [
        *("best_effort", "reliable", "volatile", "transient_local", "keep_last", "keep_all"),
        *("automatic", "manual_by_topic", "high", "normal", "low"),
    ]
    assert [*Transport] == ["relay", "direct", "auto"]


def test_what_decided_is_explained() -> None:
    contracts = Contracts(
        (rule("/**", depth=2, priority=Priority.LOW), rule("/x", "/cmd/*", types=("a/*",), depth=1))
    )
    explained = contracts.explain("/cmd/vel", "a/B")
    assert tuple(explained) == KEYS
    assert explained["depth"] == (1, "rule 2: topics /cmd/*, types a/*")
    assert explained["priority"] == (Priority.LOW, "rule 1: topics /**")
    assert explained["deadline"] == (None, "default")
    assert contracts.explain("/cmd/vel", "b/B")["depth"] == (2, "rule 1: topics /**")


def test_the_default_transport_holds_where_no_rule_sets_one() -> None:
    rules = (rule("/cmd/**", depth=1), rule("/image", transport=Transport.DIRECT))
    contracts = Contracts(rules, Transport.AUTO)
    found = {topic: contracts.of(topic, "a/B").transport for topic in ("/cmd", "/image", "/odom")}
    assert found == {"/cmd": Transport.AUTO, "/image": Transport.DIRECT, "/odom": Transport.AUTO}
    assert Contracts((), Transport.AUTO).of("/odom", "a/B") == Contract(transport=Transport.AUTO)
    assert contracts.explain("/odom", "a/B")["transport"] == (Transport.AUTO, "[bridge] transport")
    assert contracts.explain("/image", "a/B")["transport"] == (Transport.DIRECT, "rule 2: topics /image")
    assert Contracts(rules).explain("/odom", "a/B")["transport"] == (Transport.RELAY, "default")


@given(RULES, TOPICS, TYPES)
def test_the_contract_is_what_is_explained(rules: tuple[ContractRule, ...], topic: str, type_name: str) -> None:
    contracts = Contracts(rules)
    contract = contracts.of(topic, type_name)
    assert contracts.of(topic, type_name) is contract or contract == Contract()
    for key, (value, why) in contracts.explain(topic, type_name).items():
        set_ = getattr(contract, key)
        assert set_ == value or (set_ is UNSET and value == DEFAULTS[key])
        setting = [
            number
            for number, rule in enumerate(rules, 1)
            if key in rule.values
            and (not rule.topics or any(matches(glob, topic) for glob in rule.topics))
            and (not rule.types or any(matches(glob, type_name) for glob in rule.types))
        ]
        assert why.startswith(f"rule {setting[-1]}: " if setting else "default")
        assert value == (
            rules[setting[-1] - 1].values[key] if setting else DEFAULTS.get(key, getattr(Contract(), key))
        )


def test_invented_topics_do_not_fill_the_memory(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("rmpa.core.contract.CONTRACTS_REMEMBERED", 3)
    contracts = Contracts((rule("/1", depth=1),))
    for number in range(10):
        assert contracts.of(f"/{number}", "a/B").depth == (1 if number == 1 else UNSET)
    assert contracts._find.cache_info().currsize == 3
    assert contracts.of("/1", "a/B").depth == 1


@pytest.mark.parametrize(
    ("key", "offered", "requested", "agreed"),
    [
        ("reliability", Reliability.RELIABLE, None, Reliability.RELIABLE),
        ("reliability", None, Reliability.RELIABLE, Reliability.RELIABLE),
        ("durability", None, Durability.TRANSIENT_LOCAL, Durability.TRANSIENT_LOCAL),
        ("history", History.KEEP_ALL, None, History.KEEP_ALL),
        ("depth", 5, 9, 9),
        ("outage", 300.0, 60.0, 300.0),
        ("outage", 2.0, None, 2.0),
        ("outage", None, 2.0, 2.0),
        ("outage", 1.0, 2.0, 2.0),
        ("outage", limits.RESUME_WINDOW, 5.0, limits.RESUME_WINDOW),
        ("outage", 5.0, limits.RESUME_WINDOW, limits.RESUME_WINDOW),
        ("depth", 1, limits.ROUTE_QUEUE_MESSAGES, limits.ROUTE_QUEUE_MESSAGES),
        ("depth", None, limits.ROUTE_QUEUE_MESSAGES, limits.ROUTE_QUEUE_MESSAGES),
        ("depth", 1, None, 1),
        ("transport", Transport.AUTO, None, Transport.RELAY),
        ("transport", None, Transport.DIRECT, Transport.RELAY),
        ("transport", Transport.AUTO, Transport.AUTO, Transport.AUTO),
        ("transport", Transport.AUTO, Transport.DIRECT, Transport.DIRECT),
        ("transport", Transport.DIRECT, Transport.AUTO, Transport.DIRECT),
        ("deadline", 1.0, None, 1.0),
        ("deadline", 1.0, 2.0, 2.0),
        ("lifespan", 1.0, 2.0, 1.0),
        ("lifespan", None, 2.0, 2.0),
        ("max_rate", 5.0, 9.0, 5.0),
        ("priority", Priority.LOW, None, Priority.LOW),
        ("priority", None, Priority.LOW, Priority.LOW),
        ("priority", Priority.LOW, Priority.HIGH, Priority.HIGH),
        ("priority", Priority.HIGH, Priority.LOW, Priority.HIGH),
    ],
)
def test_two_ends_agree(key: str, offered: object, requested: object, agreed: object) -> None:
    sides = [Contract(**{} if value is None else {key: value}) for value in (offered, requested)]  # type: ignore[arg-type]
    assert combine(*sides) == Contract(**{key: agreed})  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("side", "depth"),
    [
        (Contract(), 1),
        (Contract(priority=Priority.HIGH, lifespan=0.5), 1),
        (Contract(depth=limits.ROUTE_QUEUE_MESSAGES), limits.ROUTE_QUEUE_MESSAGES),
        (Contract(reliability=Reliability.RELIABLE), UNSET),
        (Contract(durability=Durability.TRANSIENT_LOCAL), UNSET),
        (Contract(history=History.KEEP_ALL), UNSET),
    ],
)
def test_of_velocity_commands_the_newest_counts_unless_a_side_wants_more(side: Contract, depth: object) -> None:
    for sides in ((side, Contract()), (Contract(), side)):
        assert combine(*sides, "geometry_msgs/Twist").depth == depth
        assert combine(*sides, "geometry_msgs/Twist").newest_only is (depth == 1)
        assert combine(*sides, "geometry_msgs/Pose").depth == side.depth


def test_two_ends_agree_on_liveliness_and_its_lease() -> None:
    manual = Contract(liveliness=Liveliness.MANUAL_BY_TOPIC, liveliness_lease=1.0)
    assert combine(manual, Contract()) == manual
    assert combine(manual, Contract(liveliness_lease=3.0)) == Contract(liveliness_lease=3.0)


@given(CONTRACTS, CONTRACTS)
def test_what_is_agreed_needs_no_second_agreement(offered: Contract, requested: Contract) -> None:
    agreed = combine(offered, requested)
    assert combine(agreed, agreed) == agreed
    assert combine(agreed, requested) == agreed
    assert combine(offered, agreed) == agreed


@pytest.mark.parametrize(
    ("contract", "terms"),
    [
        (Contract(), ""),
        (Contract(outage=300.0, transport=Transport.DIRECT, liveliness=Liveliness.MANUAL_BY_TOPIC), ""),
        (Contract(reliability=Reliability.RELIABLE), "reliability reliable"),
        (Contract(durability=Durability.TRANSIENT_LOCAL), "durability transient_local"),
        (Contract(history=History.KEEP_ALL), "history keep_all"),
        (Contract(depth=5), "depth 5"),
        (Contract(deadline=0.2), "deadline 0.2 s"),
        (Contract(lifespan=0.5), "lifespan 0.5 s"),
        (Contract(liveliness_lease=2.0), "liveliness lease 2 s"),
        (Contract(priority=Priority.HIGH), "priority high"),
        (Contract(priority=Priority.LOW), "priority low"),
        (Contract(max_rate=10.0), "max_rate 10 Hz"),
        (
            Contract(max_rate=10.0, lifespan=0.5, reliability=Reliability.RELIABLE),
            "reliability reliable, lifespan 0.5 s, max_rate 10 Hz",
        ),
    ],
)
def test_terms_that_only_agents_keep_are_named(contract: Contract, terms: str) -> None:
    assert needs_agents(contract) == terms


@given(CONTRACTS, CONTRACTS)
def test_a_route_needs_agents_if_either_end_does(offered: Contract, requested: Contract) -> None:
    needs = [bool(needs_agents(contract)) for contract in (offered, requested)]
    assert bool(needs_agents(combine(offered, requested))) is any(needs)


@given(CONTRACTS, st.sampled_from(Transport), st.sampled_from(sorted(VALUES)), st.data())
def test_only_another_transport_leaves_the_route_the_same(
    contract: Contract, transport: Transport, key: str, data: st.DataObject
) -> None:
    value = data.draw(VALUES[key])
    changed = dataclasses.replace(contract, **{"transport": transport, key: value})  # type: ignore[arg-type]
    assert contract.same_route(changed) is (key == "transport" or value == getattr(contract, key))
