"""The rules ``[[contract]]`` of ``rmpa.toml``: every key, every mistake with its place, and what is doubtful."""

from __future__ import annotations

import math
import re
import tomllib
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rmpa.config.rules import TERMS
from rmpa.config.settings import Settings
from rmpa.config.toml_file import line_of
from rmpa.config.values import BadValue, read_duration, read_rate
from rmpa.core import limits as core_limits
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
)
from tests.config.conftest import Load, Refuse
from tests.core.example import EXAMPLE, uncommented

DOCUMENT = Path(__file__).parents[2] / "docs" / "guides" / "contracts.md"
DIRECT = DOCUMENT.with_name("direct-transport.md")


def test_every_key(load: Load) -> None:
    loaded = load(
        """
[[contract]]
topics = ["/cmd/**"]
types = ["geometry_msgs/*"]
reliability = "reliable"
durability = "TRANSIENT_LOCAL"
history = "keep_last"
depth = 5
deadline = 0.2
lifespan = "500 ms"
liveliness = "manual_by_topic"
liveliness_lease_duration = 2
priority = "high"
max_rate = "50Hz"
outage = "5 min"
transport = "relay"

[[contract]]
topics = ["/camera/**"]
priority = "low"
"""
    )
    values = {
        "reliability": Reliability.RELIABLE,
        "durability": Durability.TRANSIENT_LOCAL,
        "history": History.KEEP_LAST,
        "depth": 5,
        "deadline": 0.2,
        "lifespan": 0.5,
        "liveliness": Liveliness.MANUAL_BY_TOPIC,
        "liveliness_lease": 2.0,
        "priority": Priority.HIGH,
        "max_rate": 50.0,
        "outage": 300.0,
        "transport": Transport.RELAY,
    }
    assert set(values) == set(KEYS)
    first = ContractRule(("/cmd/**",), ("geometry_msgs/*",), values)
    assert loaded.settings.contracts == (first, ContractRule(("/camera/**",), (), {"priority": Priority.LOW}))
    assert loaded.notes == ()
    assert Contracts(loaded.settings.contracts).of("/cmd/a", "geometry_msgs/Twist") == Contract(**values)  # type: ignore[arg-type]


def test_the_default_transport_is_that_of_the_bridge(load: Load) -> None:
    settings = load('[bridge]\ntransport = "auto"\n' + RULE + "transport = 'relay'").settings
    contracts = settings.make_contracts()
    assert settings.transport is Transport.AUTO
    assert [contracts.of(topic, "a/B").transport for topic in ("/a", "/b")] == [Transport.RELAY, Transport.AUTO]
    assert load(RULE + "transport = 'auto'").settings.make_contracts().of("/b", "a/B") == Contract()


def test_one_word_is_enough_for_topics_to_go_direct(load: Load) -> None:
    assert not load(RULE + "transport = 'relay'").settings.allows_direct
    assert not load("[bridge]\ntransport = 'relay'\n" + RULE + "depth = 1").settings.allows_direct
    assert load("[bridge]\ntransport = 'auto'\n" + RULE + "transport = 'relay'").settings.allows_direct
    assert load(RULE + "transport = 'direct'").settings.allows_direct


def test_inline_tables_are_rules_too(load: Load) -> None:
    text = 'contract = [\n  {topics = ["/a"], depth = 1},\n  {types = ["a/B"], depth = 2},\n]\n'
    assert [rule.values for rule in load(text).settings.contracts] == [{"depth": 1}, {"depth": 2}]


def test_no_rules_are_no_rules(load: Load) -> None:
    assert load("contract = []").settings.contracts == ()


def test_the_examples_rules_load(load: Load) -> None:
    loaded = load(uncommented(EXAMPLE.read_text()))
    contracts = Contracts(loaded.settings.contracts)
    assert loaded.notes == ()
    assert contracts.of("/base/cmd_vel", "geometry_msgs/Twist").deadline == 0.2
    assert contracts.of("/camera", "sensor_msgs/Image").max_rate == 10
    assert contracts.of("/tf_static", "tf2_msgs/TFMessage").durability is Durability.TRANSIENT_LOCAL
    assert contracts.of("/odom", "nav_msgs/Odometry") == Contract()


def test_the_rules_of_the_documentation_load(load: Load) -> None:
    blocks = re.findall(r"```toml\n(.*?)```", (DOCUMENT.read_text() + DIRECT.read_text()), re.DOTALL)
    assert len(blocks) >= 4
    for block in blocks:
        loaded = load(block)
        assert loaded.settings.contracts
        assert loaded.notes == ()
    contracts = Contracts(load(blocks[1]).settings.contracts)
    assert contracts.of("/imu/data", "sensor_msgs/Imu") == Contract(priority=Priority.HIGH)
    assert contracts.of("/scan", "sensor_msgs/LaserScan") == Contract(priority=Priority.LOW, max_rate=10.0)


def test_the_documentation_has_every_key_and_every_default() -> None:
    text = DOCUMENT.read_text().partition("\nBoth modules may have rules")[0]
    written = dict(re.findall(r"^\| `(\w+)` \| `\"?([\w ]+)\"?`", text, re.MULTILINE))
    defaults = {
        key: str(
            getattr(Contract(), key.removesuffix("_duration")) or ("unlimited" if key == "max_rate" else "infinite")
        )
        for key in TERMS
    } | {"depth": str(Contract().queue_depth), "outage": f"{Contract().resume_window:g} s"}
    assert {key: value for key, value in written.items() if key in defaults} == defaults


RULE = '[[contract]]\ntopics = ["/a"]\n'


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (RULE + "dept = 1", "3: contract.dept: an unknown key; did you mean contract.depth?"),
        (RULE + "liveliness_lease = 1", "3: contract.liveliness_lease: an unknown key; did you mean contract.livel"),
        (RULE + "rate = 1", "3: contract.rate: an unknown key; did you mean contract.max_rate?"),
        (RULE + "allow = 1", "3: contract.allow: an unknown key; allow belongs in [bridge]"),
        (RULE + "[contract.qos]\nx = 1", "3: contract.qos: an unknown table; known here: topics, types, reliabilit"),
        (RULE + RULE.replace("topics", "topic"), "4: contract.topic: an unknown key; did you mean contract.topics?"),
        ("deadline = 1", "1: deadline: an unknown key; deadline belongs in a [[contract]]"),
        ("[[contracts]]\ndepth = 1", "1: contracts: an unknown key; did you mean contract?"),
        ("[contract]\ntopics = ['/a']", "1: contract: one table, where a list of them is expected; write [[contrac"),
        ("contract = 1", "1: contract: 1 is not a list"),
        ("contract = [\n1]", "2: contract: 1 is not a table"),
        ("[[contract]]\ntopics = '/a'", "2: contract.topics: '/a' is not a list; did you mean [\"/a\"]?"),
        ("[[contract]]\ntopics = ['/a',\n1]", "3: contract.topics: 1 is not a text in quotes"),
        ("[[contract]]\ntopics = [\n'/a',\n\n'cmd']", "5: contract.topics: 'cmd' matches no topic: topics begin wi"),
        ("[[contract]]\ntopics = ['/a', '/a']", "2: contract.topics: '/a' is there twice; delete one of them"),
        ("[[contract]]\ntypes = ['Image']", "2: contract.types: 'Image' matches no message type: types have a pack"),
        ("[[contract]]\ntopics = []", "2: contract.topics: an empty list fits nothing; leave topics out, or name s"),
        (RULE + "\n[[contract]]\ndepth = 1", '4: contract: a rule without topics and types; topics = ["/**"] mak'),
        (RULE + "depth = 0", "3: contract.depth: 0 is out of range; a depth is between 1 and 100000"),
        (RULE + "depth = 1.5", "3: contract.depth: 1.5 is not a whole number"),
        (RULE + "depth = true", "3: contract.depth: true is not a whole number"),
        (RULE + "reliability = 1", "3: contract.reliability: 1 is not a text in quotes"),
        (
            RULE + "reliability = 'reliabel'",
            "3: contract.reliability: 'reliabel' is not a reliability; it is one of best_effort, reliable; did you",
        ),
        (RULE + "reliability = 'best-effort'", "3: contract.reliability: 'best-effort' is not a reliability; it is"),
        (RULE + "durability = 'latched'", "3: contract.durability: 'latched' is not a durability; it is one of vol"),
        (RULE + "history = 'keep_some'", "3: contract.history: 'keep_some' is not a history; it is one of keep_las"),
        (RULE + "liveliness = 'manual'", "3: contract.liveliness: 'manual' is not a liveliness; it is one of autom"),
        (RULE + "priority = 'hihg'", "3: contract.priority: 'hihg' is not a priority; it is one of high, normal, l"),
        (
            RULE + "deadline = -1",
            '3: contract.deadline: -1 is out of range; a deadline is between 0.001 and 86400 s; "infinite" is none ',
        ),
        (RULE + "deadline = 0", "3: contract.deadline: 0 is out of range"),
        (RULE + "deadline = '0 ms'", "3: contract.deadline: '0 ms' is out of range"),
        (RULE + "deadline = '50Hz'", "3: contract.deadline: '50Hz' is a rate, not a duration; did you mean"),
        (RULE + "deadline = '0 Hz'", "3: contract.deadline: '0 Hz' is not a duration"),
        (RULE + "deadline = '100'", "3: contract.deadline: '100' is not a duration; a deadline is seconds as a num"),
        (RULE + "deadline = true", "3: contract.deadline: true is not a duration; a deadline is seconds as a numbe"),
        (RULE + "deadline = nan", "3: contract.deadline: nan is not a duration"),
        (RULE + "deadline = [1]", "3: contract.deadline: [1] is not a duration"),
        (RULE + "deadline = 2026-01-01", "3: contract.deadline: datetime.date(2026, 1, 1) is not a duration"),
        (RULE + "lifespan = '5 sec'", "3: contract.lifespan: '5 sec' is not a duration; a lifespan is seconds as a"),
        (RULE + "lifespan = 86401", "3: contract.lifespan: 86401 is out of range; a lifespan is between 0.001 and "),
        (RULE + f"max_rate = {'9' * 400}", "3: contract.max_rate: 99999999"),
        (RULE + f"deadline = -{'9' * 400}", "3: contract.deadline: -9999999"),
        (RULE + "max_rate = 0", "3: contract.max_rate: 0 is out of range; a rate is between 0.001 and 1000000 Hz; "),
        (RULE + "max_rate = '100 ms'", "3: contract.max_rate: '100 ms' is a duration, not a rate; did you mean"),
        (RULE + "max_rate = 'fast'", "3: contract.max_rate: 'fast' is not a rate; a rate is messages a second as a"),
        (RULE + "outage = 'forever'", "3: contract.outage: 'forever' is not a duration; an outage is seconds as a"),
        (RULE + "outage = 'infinite'", "3: contract.outage: 'infinite' is out of range; an outage is between 1 and "),
        (
            RULE + "outage = '2 d'",
            "3: contract.outage: '2 d' is not a duration; an outage is seconds as a number, or ",
        ),
        (RULE + "outage = 0.5", "3: contract.outage: 0.5 is out of range; an outage is between 1 and 86400 s: "),
        (
            RULE + "outage = '25 h'",
            "3: contract.outage: '25 h' is out of range; an outage is between 1 and 86400 s: ",
        ),
        (RULE + "outage = '5Hz'", "3: contract.outage: '5Hz' is a rate, not a duration; did you mean"),
        (RULE + "outage = true", "3: contract.outage: true is not a duration"),
        (
            RULE + "transport = 'drect'",
            "3: contract.transport: 'drect' is not a transport; it is one of relay, direct, auto; did you mean ",
        ),
        (RULE + "max_rate = false", "3: contract.max_rate: false is not a rate"),
        (
            RULE + "# a comment\n\nliveliness_lease_duration = 1",
            '5: contract.liveliness_lease_duration: has no effect without liveliness; add liveliness = "automatic"',
        ),
        (
            "contract = [\n  {topics = ['/a'], depth = 1},\n  {topics = ['/b'], depth = 0},\n]",
            "3: contract.depth: 0 is out of range",
        ),
    ],
)
def test_each_mistake_names_file_line_and_key(refuse: Refuse, text: str, message: str) -> None:
    assert refuse(text).startswith(f"rmpa.toml:{message}")


@pytest.mark.parametrize(
    ("line", "better"),
    [
        ("reliability = 'reliabel'", '"reliable"'),
        ("reliability = 'best-effort'", '"best_effort"'),
        ("priority = 'hihg'", '"high"'),
        ("deadline = '50Hz'", '"20 ms"'),
        ("max_rate = '100 ms'", '"10 Hz"'),
    ],
)
def test_the_probable_value_is_offered(refuse: Refuse, line: str, better: str) -> None:
    assert refuse(RULE + line).endswith(f"did you mean {better}?")


@pytest.mark.parametrize(
    ("text", "note"),
    [
        (RULE, "1: contract: a rule that sets nothing"),
        (RULE + "history = 'keep_all'\ndepth = 5", "4: contract.depth: has no effect beside history keep_all"),
        (RULE + "liveliness = 'manual_by_topic'", "3: contract.liveliness: has no effect without a liveliness_leas"),
        (RULE + "outage = '5 min'", '3: contract.outage: has no effect without reliability = "reliable"'),
        (
            RULE + "transport = 'direct'\npriority = 'high'",
            "3: contract.transport: direct has no effect: only agents can keep priority high, so the topic is",
        ),
        (
            RULE + "deadline = '100 ms'\nmax_rate = 5",
            "4: contract.max_rate: 5 messages a second miss the deadline of 0.1 s every time",
        ),
    ],
)
def test_what_is_doubtful_is_noted(load: Load, tmp_path: Path, text: str, note: str) -> None:
    loaded = load(text)
    (found,) = loaded.notes
    assert found.startswith(f"{tmp_path}/rmpa.toml:{note}")
    assert len(loaded.settings.contracts) == 1


def test_a_lease_of_another_rule_is_enough(load: Load) -> None:
    lease = 'liveliness = "automatic"\nliveliness_lease_duration = 1\n'
    assert load(RULE + lease + RULE + "liveliness = 'manual_by_topic'").notes == ()


@pytest.mark.parametrize(
    ("raw", "seconds"),
    [
        (1, 1.0),
        (0.001, 0.001),
        ("100 ms", 0.1),
        ("100ms", 0.1),
        (" 2 S ", 2.0),
        ("1500 us", 0.0015),
        ("1500 µs", 0.0015),
        ("1.5 min", 90.0),
        ("24 h", 86400.0),
        ("infinite", None),
        (math.inf, None),
    ],
)
def test_durations(raw: object, seconds: float | None) -> None:
    assert read_duration(raw) == seconds


@pytest.mark.parametrize(
    ("raw", "rate"), [(10, 10.0), ("10 Hz", 10.0), ("0.5hz", 0.5), ("unlimited", None), (math.inf, None)]
)
def test_rates(raw: object, rate: float | None) -> None:
    assert read_rate(raw) == rate


TEXTS = st.text(alphabet="0123456789.-+e_ msuµinhz")


@given(st.one_of(TEXTS, st.floats(), st.integers(), st.booleans(), st.none(), st.lists(st.integers())))
def test_whatever_is_written_is_read_within_bounds_or_refused(raw: object) -> None:
    for read, low, high in (
        (read_duration, core_limits.CONTRACT_TIME_MIN, core_limits.CONTRACT_TIME_MAX),
        (read_rate, core_limits.CONTRACT_RATE_MIN, core_limits.CONTRACT_RATE_MAX),
    ):
        try:
            value = read(raw)
        except BadValue:
            continue
        assert value is None or low <= value <= high


@given(st.floats(core_limits.CONTRACT_TIME_MIN, core_limits.CONTRACT_TIME_MAX))
def test_seconds_stay_as_they_are(seconds: float) -> None:
    assert read_duration(seconds) == seconds


@given(
    st.lists(
        st.sampled_from(["topics = ['/a',\n'/b']", "depth = 3", "[[contract]]", "", "# [[contract]]", "lifespan = 1"])
    )
)
def test_every_key_of_every_rule_is_found_on_its_line(statements: list[str]) -> None:
    text = "\n".join(["[[contract]]", *statements])
    lines = text.split("\n")
    try:
        rules = tomllib.loads(text)["contract"]
    except tomllib.TOMLDecodeError:
        return
    previous = 0
    for index, rule in enumerate(rules):
        header = line_of(text, ("contract", index))
        assert header is not None
        assert header > previous
        assert lines[header - 1] == "[[contract]]"
        previous = header
        for key in rule:
            line = line_of(text, ("contract", index, key))
            assert line is not None
            assert line > header
            assert lines[line - 1].startswith(f"{key} =")
            previous = max(previous, line)
        if "topics" in rule:
            line = line_of(text, ("contract", index, "topics", 1))
            assert line is not None
            assert lines[line - 1] == "'/b']"


def test_settings_with_rules_can_be_hashed(load: Load) -> None:
    settings = load(RULE + "depth = 1").settings
    assert hash(settings) == hash(load(RULE + "depth = 1").settings)
    assert settings != Settings()
