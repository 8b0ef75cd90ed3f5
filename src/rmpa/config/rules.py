"""Rules about topics and parameters in ``rmpa.toml``: ``[[contract]]``, ``[[param]]`` and ``[[gateway.rule]]``.

The tables ``[[contract]]`` of ``rmpa.toml``: what topics need, in ROS 2's words (docs/contracts.md).
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from enum import StrEnum
from functools import partial
from typing import TYPE_CHECKING, Final

from rmpa.config import limits
from rmpa.config.schema import BYTES_A_SECOND, OUTAGE, RATE, duration_of, read_bytes_a_second, setting, table
from rmpa.config.values import (
    BOOL,
    DOMAIN,
    NAME,
    PEER_GLOB,
    TEXT,
    TOPIC_GLOB,
    TRANSPORT,
    TYPE_GLOB,
    BadValue,
    Place,
    RuleKey,
    ValueType,
    did_you_mean,
    list_of,
    member_of,
    read_at,
    read_keys,
    read_text,
    tables_of,
    whole_number,
    word_of,
)
from rmpa.core import limits as core_limits
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
from rmpa.core.identity import is_global_name, is_legal_name, matches

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
        whole_number(1, core_limits.CONTRACT_DEPTH_MAX, "a depth"),
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


def _read_contract(table: Mapping[str, object]) -> ContractRule:
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


CONTRACT_RULES: Final = tables_of(KEYS, _read_contract)


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


# The tables ``[[param]]`` of ``rmpa.toml``: which parameters of which peers are followed, and under which name.


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
_PARAM_KEYS: Final = (
    RuleKey("key", _PARAM, "The parameter's name at its owner; a namespace is followed as a whole.", required=True),
    RuleKey("from", _OWNER, "The peer that owns it.", required=True),
    RuleKey("to", _PARAM, "Its name here; without it: the same."),
)


def _read_param(table: Mapping[str, object]) -> FollowRule:
    values = read_keys(table, _PARAM_KEYS, 'one has key = "/robot_description" and from = "base"')
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


_TABLES: Final = tables_of(_PARAM_KEYS, _read_param, limits.FOLLOW_RULES_MAX, "follow a namespace as a whole")
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


# The table ``[gateway]`` of ``rmpa.toml``: which other sites and which ROS 2 a gateway joins, and what may cross.


ROS2: Final = "ros2"
"""Stands in the place of a site in names and rules, for a ROS 2 graph; no site may have it."""
PROTOCOLS: Final = ("tls", "tcp", "quic", "udp", "ws")
"""The protocols of Zenoh's endpoints that are accepted."""
_COMMAND: Final = "gateway"
_ENDPOINT: Final = re.compile(
    r"(?P<protocol>[a-z0-9]+)/(?P<host>\[[0-9A-Fa-f:.]+(?:%[A-Za-z0-9]+)?\]|[A-Za-z0-9_](?:[A-Za-z0-9_.-]{0,252})|\*)"
    r":(?P<port>[0-9]{1,5})(?P<more>[?#][A-Za-z0-9_=;.:/-]{1,200})?"
)
_LOOKS: Final = "one looks like tls/fleet.example:7447"
_PLACEHOLDERS: Final = {"{site}": "site", "{module}": "module", "{name}": "/name"}
"""What a rule's ``name`` may have in it, each with an example of what it becomes."""


class Crossing(StrEnum):
    """The way in which a rule lets sources cross, seen from this site."""

    BOTH = "both"
    OUT = "out"
    IN = "in"
    NONE = "none"


@dataclass(frozen=True, slots=True)
class CrossingRule:
    """One ``[[gateway.rule]]``: the first that matches a source holds. Without a rule everything crosses, on demand.

    Args:
        names: Globs over topics, services and parameters, by the names that they have in their module.
        sites: Globs over the other site's name; ``ros2`` is a name too.
        modules: Globs over the module that has the source.
        crossing: Which way it may cross.
        name: The name here of what comes in; ``{site}``, ``{module}`` and ``{name}`` are replaced. ``{name}`` begins
            with a slash.
        rate: Messages a second of each topic that goes out; ``None``: no limit. Others are dropped, and counted.
        size: Bytes a second of each topic that goes out; ``None``: no limit.
    """

    names: tuple[str, ...] = ("/**",)
    sites: tuple[str, ...] = ("*",)
    modules: tuple[str, ...] = ("*",)
    crossing: Crossing = Crossing.BOTH
    name: str = "{name}"
    rate: float | None = None
    size: int | None = None


# --- values ---------------------------------------------------------------------------------------------------------


def _read_site(raw: object) -> str:
    if raw == "":
        return ""
    try:
        name = NAME.read(raw)
    except BadValue as error:
        raise BadValue(error.problem.replace("peer's", "site's"), error.remedy, error.better) from None
    if len(name) > limits.SITE_NAME_MAX:
        raise BadValue(f"a site's name has at most {limits.SITE_NAME_MAX} characters")
    if name == ROS2:
        raise BadValue("ros2 is reserved: rules and names mean the ROS 2 graph by it", "choose another name")
    return name


def _read_endpoint(raw: object) -> str:
    text = read_text(raw).strip()
    match = _ENDPOINT.fullmatch(text)
    if match is None:
        better = f"tls/{text}" if "/" not in text and _ENDPOINT.fullmatch(f"tls/{text}") else None
        better = better or (f"{text}:7447" if _ENDPOINT.fullmatch(f"{text}:7447") else None)
        url = re.fullmatch(r"([a-z]+)://(.+?)/?", text)
        if url and _ENDPOINT.fullmatch(f"{url[1]}/{url[2]}"):
            better = f"{url[1]}/{url[2]}"
        raise BadValue(f"{text!r} is not an endpoint of Zenoh", _LOOKS, better)
    if match["protocol"] not in PROTOCOLS:
        near = did_you_mean(match["protocol"], PROTOCOLS)
        better = f"{near}{text[match.end('protocol') :]}" if near else None
        raise BadValue(
            f"{match['protocol']!r} is not a protocol of endpoints", f"there are {', '.join(PROTOCOLS)}", better
        )
    if not 1 <= int(match["port"]) <= 65535:
        raise BadValue(f"{text!r} has no port between 1 and 65535", _LOOKS)
    return text


def _read_template(raw: object) -> str:
    text = read_text(raw).strip()
    filled = text
    for placeholder, example in _PLACEHOLDERS.items():
        filled = filled.replace(placeholder, example)
    remedy = 'an example: "/{site}{name}"'
    if "{" in filled or "}" in filled:
        unknown = re.findall(r"\{[^{}]*\}?|\}", filled)
        raise BadValue(f"{unknown[0]!r} stands for nothing", f"there are {', '.join(_PLACEHOLDERS)}; {remedy}")
    if "//" in filled:
        raise BadValue(f"{text!r} has two slashes together", "{name} begins with a slash; " + remedy)
    if not filled.startswith("/"):
        raise BadValue(f"{text!r} is not a global name", remedy, f"/{text}")
    if not is_global_name(filled):
        raise BadValue(f"{text!r} is not a name of ROS", remedy)
    return text


_SITE: Final = ValueType(_read_site, {"type": "string", "pattern": "^([A-Za-z][A-Za-z0-9_]*)?$"}, "NAME")
ENDPOINT: Final = ValueType(
    _read_endpoint,
    {"type": "string", "pattern": f"^({'|'.join(PROTOCOLS)})/", "examples": ["tls/fleet.example:7447"]},
    "ENDPOINT",
)
_RANK: Final = whole_number(0, limits.GATEWAY_RANK_MAX, "a rank")
_DISTRIBUTION: Final = word_of(
    ("humble", "iron", "jazzy", "kilted", "lyrical"),
    "a distribution of ROS 2 that rmw_zenoh is made for",
    "there are humble, iron, jazzy, kilted and lyrical",
    "NAME",
)
_TEMPLATE: Final = ValueType(_read_template, {"type": "string", "examples": ["/{site}{name}"]})
_CROSSING_KEYS: Final = (
    RuleKey(
        "names",
        list_of(TOPIC_GLOB, if_empty="leave names out, or name some"),
        "Globs over topics, services and parameters, by their names in their module; without it all.",
    ),
    RuleKey(
        "sites",
        list_of(PEER_GLOB, if_empty="leave sites out, or name some"),
        "Globs over the other site's name; ros2 is a name too. Without it all.",
    ),
    RuleKey(
        "modules",
        list_of(PEER_GLOB, if_empty="leave modules out, or name some"),
        "Globs over the module that has the source; without it all.",
    ),
    RuleKey("crossing", member_of(Crossing, "a way to cross"), "Which way it may cross, seen from this site."),
    RuleKey("name", _TEMPLATE, "The name here of what comes in; {site}, {module} and {name} are replaced."),
    RuleKey("rate", RATE, "Messages a second of each topic that goes out; others are dropped, and counted."),
    RuleKey("size", BYTES_A_SECOND, "Bytes a second of each topic that goes out; others are dropped, and counted."),
)
_CROSSING_EXAMPLE: Final = 'one has names = ["/camera/**"] and rate = 2, or crossing = "none"'
_SELECTORS: Final = {"names", "sites", "modules"}


def _read_crossing(raw: Mapping[str, object]) -> CrossingRule:
    values = read_keys(raw, _CROSSING_KEYS)
    said = set(values) - _SELECTORS
    if not said:
        raise BadValue("a rule that says nothing of what it selects", _CROSSING_EXAMPLE)
    crossing = values.get("crossing", Crossing.BOTH)
    for key, useful in (("name", Crossing.IN), ("rate", Crossing.OUT), ("size", Crossing.OUT)):
        if key in said and crossing not in (Crossing.BOTH, useful):
            what = "comes in" if useful is Crossing.IN else "goes out"
            remedy = f"leave {key} out, or write crossing = {useful.value!r}"
            raise BadValue(f"{key} is about what {what}, and nothing does", remedy, at=(key,))
    names = values.get("names", ("/**",))
    one_name = len(names) == 1 and not {"*", "?"} & set(names[0])
    if "name" in values and "{name}" not in values["name"] and not one_name:
        raise BadValue(
            "all that the rule selects would get one name", 'put {name} into it, as "/{site}{name}"', at=("name",)
        )
    return CrossingRule(**values)


GATEWAY_RULES: Final = tables_of(
    _CROSSING_KEYS, _read_crossing, limits.GATEWAY_RULES_MAX, "one may have several globs"
)

# --- settings -------------------------------------------------------------------------------------------------------


_UPLINK: Final = ValueType(
    lambda raw: None if raw is None else read_bytes_a_second(raw), BYTES_A_SECOND.json_schema, "RATE"
)
"""Bytes a second, or ``None`` as the default has it."""


@dataclass(frozen=True, slots=True)
class Ros2Settings:
    """The table ``[gateway.ros2]``."""

    enabled: bool = setting(
        False,
        BOOL,
        "Join a ROS 2 graph whose nodes run rmw_zenoh.",
        env="RMPA_ROS2",
        option="--ros2/--no-ros2",
        command=_COMMAND,
    )
    domain: int = setting(
        0, DOMAIN, "ROS_DOMAIN_ID there.", env="RMPA_ROS2_DOMAIN", option="--ros2-domain", command=_COMMAND
    )
    distribution: str = setting(
        "jazzy",
        _DISTRIBUTION,
        "The distribution whose message definitions its nodes have.",
        env="RMPA_ROS2_DISTRIBUTION",
        option="--ros2-distribution",
        command=_COMMAND,
    )
    mapping: tuple[str, ...] = setting(
        (),
        list_of(TEXT),
        "Files of rules of ros1_bridge (YAML), for types that differ.",
        env="RMPA_ROS2_MAPPING",
        option="--ros2-mapping",
        command=_COMMAND,
    )


@dataclass(frozen=True, slots=True)
class GatewaySettings:
    """The table ``[gateway]``."""

    site: str = setting(
        "",
        _SITE,
        "This site's name, a ROS base name; empty: no other sites are joined.",
        env="RMPA_SITE",
        option="--site",
        command=_COMMAND,
        shown_default="none",
    )
    rank: int = setting(
        100,
        _RANK,
        "Of several gateways of one site the one with the lowest rank leads.",
        env="RMPA_GATEWAY_RANK",
        option="--rank",
        command=_COMMAND,
    )
    connect: tuple[str, ...] = setting(
        (),
        list_of(ENDPOINT),
        "Zenoh endpoints to connect to, such as tls/fleet.example:7447.",
        env="RMPA_GATEWAY_CONNECT",
        option="--connect",
        command=_COMMAND,
    )
    listen: tuple[str, ...] = setting(
        (),
        list_of(ENDPOINT),
        "Zenoh endpoints to listen at, such as tls/0.0.0.0:7447.",
        env="RMPA_GATEWAY_LISTEN",
        option="--listen",
        command=_COMMAND,
    )
    router: bool = setting(
        False,
        BOOL,
        "Be a Zenoh router, which the gateways of other sites connect to.",
        env="RMPA_GATEWAY_ROUTER",
        option="--router/--no-router",
        command=_COMMAND,
    )
    insecure: bool = setting(
        False,
        BOOL,
        "Connect without certificates; else the module must have joined a secured mesh.",
        env="RMPA_GATEWAY_INSECURE",
        option="--insecure/--no-insecure",
        command=_COMMAND,
    )
    uplink: int | None = setting(
        None,
        _UPLINK,
        "What the line to the other sites carries, bytes a second: a command then does not wait behind seconds of "
        "images in the kernel's buffer.",
        env="RMPA_GATEWAY_UPLINK",
        option="--uplink",
        command=_COMMAND,
        shown_default="unlimited",
    )
    ros2: Ros2Settings = table(Ros2Settings, "gateway.ros2")
    rules: tuple[CrossingRule, ...] = setting(
        (),
        GATEWAY_RULES,
        "What may cross to other sites and to ROS 2; the first rule that fits a source holds. "
        "Without a rule everything crosses that [bridge] and [services] let, on demand.",
        key="gateway.rule",
        live=True,
    )
