"""Rules about topics, parameters and sites in ``rmpa.toml``: ``[[contract]]``, ``[[param]]`` and ``[gateway]``.

A ``[[contract]]`` says what topics need, in ROS 2's words (docs/guides/contracts.md).
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from enum import StrEnum
from typing import TYPE_CHECKING, Any, Final

from rmpa.config import limits
from rmpa.config.peer_rules import TRANSPORT
from rmpa.config.schema import NEEDED, Setting, keys_of, rules_of, setting, switch, table
from rmpa.config.values import (
    BYTES_A_SECOND,
    DOMAIN,
    NAME,
    OUTAGE,
    PEER_GLOB,
    RATE,
    TEXT,
    TOPIC_GLOB,
    TYPE_GLOB,
    BadValue,
    Place,
    ValueType,
    did_you_mean,
    duration_of,
    list_of,
    member_of,
    read_text,
    text_type,
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
    from collections.abc import Iterator, Sequence

# The key of a contract's ``liveliness_lease``.
_LEASE: Final = "liveliness_lease_duration"
_CONTRACT_KEYS: Final = {
    "topics": Setting(
        list_of(TOPIC_GLOB, if_empty="leave topics out, or name some"),
        "Globs of topics, one of which must match; without it: any topic.",
    ),
    "types": Setting(
        list_of(TYPE_GLOB, if_empty="leave types out, or name some"),
        "Globs of message types, one of which must match; without it: any type.",
    ),
    "reliability": Setting(member_of(Reliability, "a reliability"), "Whether messages survive the loss of a link."),
    "durability": Setting(
        member_of(Durability, "a durability"), "Whether a late subscriber gets each publisher's last messages."
    ),
    "history": Setting(member_of(History, "a history"), "What a full queue keeps."),
    "depth": Setting(
        whole_number(1, core_limits.CONTRACT_DEPTH_MAX, "a depth"),
        "Messages that wait for one slow receiver; when there are more, the oldest is dropped.",
    ),
    "deadline": Setting(duration_of("a deadline"), "The longest time from one message to the next."),
    "lifespan": Setting(duration_of("a lifespan"), "A message that is older is dropped."),
    "liveliness": Setting(
        member_of(Liveliness, "a liveliness"), "What shows that a publisher is alive: its link, or its own messages."
    ),
    _LEASE: Setting(
        duration_of("a lease"), "A publisher that shows no life for so long counts as dead; needs liveliness."
    ),
    "priority": Setting(member_of(Priority, "a priority"), "The lane: high is express, low is bulk, normal by size."),
    "max_rate": Setting(RATE, "How many messages a second cross at most; the newest are kept."),
    "outage": Setting(OUTAGE, "How long a reliable topic is kept when its link is gone."),
    "transport": Setting(TRANSPORT, "relay: through the agents; direct, auto: from node to node where possible."),
}
# The keys of a ``[[contract]]`` besides the topics and types that it is about.
TERMS: Final = tuple(_CONTRACT_KEYS)[2:]


def _make_contract(values: dict[str, Any]) -> ContractRule:
    topics, types = values.pop("topics", ()), values.pop("types", ())
    if not topics and not types:
        raise BadValue("a rule without topics and types", 'topics = ["/**"] makes it one for every topic')
    if _LEASE in values:
        if "liveliness" not in values:
            kinds = (
                '"automatic" (its link shows that a publisher is alive) or "manual_by_topic" (its messages show it)'
            )
            raise BadValue("has no effect without liveliness", f"add liveliness = {kinds}", at=(_LEASE,))
        values["liveliness_lease"] = values.pop(_LEASE)
    return ContractRule(topics, types, values)


CONTRACT_RULES: Final = rules_of(_CONTRACT_KEYS, _make_contract)


def contract_warnings(rules: Sequence[ContractRule]) -> Iterator[tuple[Place, str]]:
    """Rules that can be used but are probably mistakes: where, and what about it."""
    leased = any(rule.values.get("liveliness_lease") is not None for rule in rules)
    reliable = any(rule.values.get("reliability") == Reliability.RELIABLE for rule in rules)
    for index, rule in enumerate(rules):
        values = rule.values
        if not values:
            yield (index,), "a rule that sets nothing"
        if values.get("history") == History.KEEP_ALL and "depth" in values:
            yield (index, "depth"), "has no effect beside history keep_all"
        if values.get("liveliness") == Liveliness.MANUAL_BY_TOPIC and not leased:
            yield (index, "liveliness"), f"has no effect without a {_LEASE}"
        if "outage" in values and not reliable:
            yield (index, "outage"), 'has no effect without reliability = "reliable"'
        if values.get("transport") == Transport.DIRECT:
            terms = needs_agents(Contract(**values))  # type: ignore[arg-type] # as ContractRule.values promises
            if terms:
                text = f"direct has no effect: only agents can keep {terms}, so the topic is relayed"
                yield (index, "transport"), text
        deadline, rate = values.get("deadline"), values.get("max_rate")
        if isinstance(deadline, float) and isinstance(rate, float) and deadline * rate < 1:
            text = f"{rate:g} messages a second miss the deadline of {deadline:g} s every time"
            yield (index, "max_rate"), text


# The tables ``[[param]]`` of ``rmpa.toml``. Which parameters of which peers are followed, and under which name.


SIM_TIME: Final = "/use_sim_time"
CLOCK: Final = "/clock"
# Parameters that another module never sets or deletes, and why.
UNTOUCHABLE: Final = {
    "/run_id": "it names the run of this module's core",
    "/roslaunch/**": "it is roslaunch's own",
    "/rosdistro": "it says which ROS this core is",
    "/rosversion": "it says which ROS this core is",
    SIM_TIME: "time is followed by [time] alone",
}


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


def _read_key(raw: object) -> str:
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


_PARAM: Final = text_type(_read_key, "/robot_description")


@dataclass(frozen=True, slots=True)
class FollowRule:
    """One ``[[param]]``: a parameter, or a namespace as a whole, of a peer that this module follows."""

    key: str = setting(
        NEEDED, _PARAM, "The parameter's name at its owner; a namespace is followed as a whole.", key="key"
    )
    owner: str = setting(NEEDED, ValueType(_read_owner, NAME.json_schema), "The peer that owns it.", key="from")
    to: str = setting("", _PARAM, "Its name here; without it: the same.")

    def __str__(self) -> str:
        """``base:/robot_description as /base/robot_description``."""
        return f"{self.owner}:{self.key}" + (f" as {self.to}" if self.to != self.key else "")


def _make_follow(values: dict[str, Any]) -> FollowRule:
    rule = FollowRule(values["key"], values["from"], values.get("to", values["key"]))
    if why := untouchable(rule.to):
        raise BadValue(f"{rule.to} cannot be followed: {why}", at=("to",) if "to" in values else ("key",))
    return rule


_FOLLOW: Final = rules_of(
    keys_of(FollowRule),
    _make_follow,
    'one has key = "/robot_description" and from = "base"',
    limits.FOLLOW_RULES_MAX,
    "follow a namespace as a whole",
)


def _read_params(raw: object) -> tuple[FollowRule, ...]:
    """Every ``[[param]]`` of a file; the error about a rule that contradicts an earlier one is at the later one."""
    rules = _FOLLOW.read(raw)
    for index, rule in enumerate(rules):
        for other in rules[:index]:
            if overlap(other.to, rule.to):
                whose = f"{other.to} comes from {other.owner}'s {other.key} already"
                problem = f"{rule.to} cannot come from {rule.owner} too: {whose}"
                raise BadValue(problem, "a parameter has one owner: leave one of the rules out", at=(index,))
    return rules


PARAM_RULES: Final = ValueType(_read_params, _FOLLOW.json_schema)


# The table ``[gateway]`` of ``rmpa.toml``. Which other sites and which ROS 2 a gateway joins, and what may cross.


# Stands in the place of a site in names and rules, for a ROS 2 graph; no site may have it.
ROS2: Final = "ros2"
# The protocols of Zenoh's endpoints that are accepted.
PROTOCOLS: Final = ("tls", "tcp", "quic", "udp", "ws")
_ENDPOINT: Final = (
    r"(?P<protocol>[a-z0-9]+)/(?P<host>\[[0-9A-Fa-f:.]+(?:%[A-Za-z0-9]+)?\]|[A-Za-z0-9_](?:[A-Za-z0-9_.-]{0,252})|\*)"
    r":(?P<port>[0-9]{1,5})(?P<more>[?#][A-Za-z0-9_=;.:/-]{1,200})?"
)
_LOOKS: Final = "one looks like tls/fleet.example:7447"
# What a rule's ``name`` may have in it, each with an example of what it becomes.
_PLACEHOLDERS: Final = {"{site}": "site", "{module}": "module", "{name}": "/name"}


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
    match = re.fullmatch(_ENDPOINT, text)
    if match is None:
        guesses = (f"tls/{text}", f"{text}:7447", re.sub(r"^([a-z]+)://(.+?)/?$", r"\1/\2", text))
        better = next((guess for guess in guesses if re.fullmatch(_ENDPOINT, guess)), None)
        raise BadValue(f"{text!r} is not an endpoint of Zenoh", _LOOKS, better)
    protocol = match["protocol"]
    if protocol not in PROTOCOLS:
        near = did_you_mean(protocol, PROTOCOLS)
        better = near and near + text.removeprefix(protocol)
        raise BadValue(f"{protocol!r} is not a protocol of endpoints", f"there are {', '.join(PROTOCOLS)}", better)
    if not 1 <= int(match["port"]) <= 65535:
        raise BadValue(f"{text!r} has no port between 1 and 65535", _LOOKS)
    return text


def _read_template(raw: object) -> str:
    text = filled = read_text(raw).strip()
    for placeholder, example in _PLACEHOLDERS.items():
        filled = filled.replace(placeholder, example)
    remedy = 'an example: "/{site}{name}"'
    if unknown := re.search(r"\{[^{}]*\}?|\}", filled):
        raise BadValue(f"{unknown[0]!r} stands for nothing", f"there are {', '.join(_PLACEHOLDERS)}; {remedy}")
    if "//" in filled:
        raise BadValue(f"{text!r} has two slashes together", "{name} begins with a slash; " + remedy)
    if not filled.startswith("/"):
        raise BadValue(f"{text!r} is not a global name", remedy, f"/{text}")
    if not is_global_name(filled):
        raise BadValue(f"{text!r} is not a name of ROS", remedy)
    return text


ENDPOINT: Final = ValueType(
    _read_endpoint,
    {"type": "string", "pattern": f"^({'|'.join(PROTOCOLS)})/", "examples": ["tls/fleet.example:7447"]},
    "ENDPOINT",
)


class Crossing(StrEnum):
    """The way in which a rule lets sources cross, seen from this site."""

    BOTH = "both"
    OUT = "out"
    IN = "in"
    NONE = "none"


@dataclass(frozen=True, slots=True)
class CrossingRule:
    """One ``[[gateway.rule]]``; the first that matches a source holds. Without one everything crosses, on demand."""

    names: tuple[str, ...] = setting(
        ("/**",),
        list_of(TOPIC_GLOB, if_empty="leave names out, or name some"),
        "Globs over topics, services and parameters, by their names in their module; without it all.",
    )
    sites: tuple[str, ...] = setting(
        ("*",),
        list_of(PEER_GLOB, if_empty="leave sites out, or name some"),
        "Globs over the other site's name; ros2 is a name too. Without it all.",
    )
    modules: tuple[str, ...] = setting(
        ("*",),
        list_of(PEER_GLOB, if_empty="leave modules out, or name some"),
        "Globs over the module that has the source; without it all.",
    )
    crossing: Crossing = setting(
        Crossing.BOTH, member_of(Crossing, "a way to cross"), "Which way it may cross, seen from this site."
    )
    name: str = setting(
        "{name}",
        text_type(_read_template, "/{site}{name}"),
        "The name here of what comes in; {site}, {module} and {name} are replaced.",
    )
    rate: float | None = setting(
        None,
        RATE,
        "Messages a second of each topic that goes out, or comes from ROS 2; others are counted.",
    )
    size: int | None = setting(
        None,
        BYTES_A_SECOND,
        "Bytes a second of each topic that goes out, or comes from ROS 2; others are counted.",
    )


def _make_crossing(values: dict[str, Any]) -> CrossingRule:
    rule = CrossingRule(**values)
    if not values.keys() - {"names", "sites", "modules"}:
        example = 'one has names = ["/camera/**"] and rate = 2, or crossing = "none"'
        raise BadValue("a rule that selects nothing", example)
    for key, useful in (("name", Crossing.IN), ("rate", Crossing.OUT), ("size", Crossing.OUT)):
        ros2 = useful is Crossing.OUT and ROS2 in rule.sites and rule.crossing is Crossing.IN
        if key in values and rule.crossing not in (Crossing.BOTH, useful) and not ros2:
            what = "comes in" if useful is Crossing.IN else "goes out"
            remedy = f"leave {key} out, or write crossing = {useful.value!r}"
            raise BadValue(f"{key} is about what {what}, and nothing does", remedy, at=(key,))
    one_name = len(rule.names) == 1 and not {"*", "?"} & set(rule.names[0])
    if "{name}" not in rule.name and not one_name:
        remedy = 'put {name} into it, as "/{site}{name}"'
        raise BadValue("all that the rule selects would get one name", remedy, at=("name",))
    return rule


GATEWAY_RULES: Final = rules_of(
    keys_of(CrossingRule), _make_crossing, most=limits.GATEWAY_RULES_MAX, instead="one may have several globs"
)


@dataclass(frozen=True, slots=True)
class Ros2Settings:
    """The table ``[gateway.ros2]``."""

    enabled: bool = switch("Join a ROS 2 graph.", option="--ros2/--no-ros2")
    domain: int = setting(0, DOMAIN, "ROS_DOMAIN_ID there; by rclpy 0 is the environment's.", option="--ros2-domain")
    distribution: str = setting(
        "jazzy",
        word_of(
            ("humble", "iron", "jazzy", "kilted", "lyrical"),
            "a distribution of ROS 2 that rmw_zenoh is made for",
            "there are humble, iron, jazzy, kilted and lyrical",
            "NAME",
        ),
        "The distribution whose message definitions its nodes have; rclpy tells its own.",
        option="--ros2-distribution",
    )
    mapping: tuple[str, ...] = setting(
        (), list_of(TEXT), "Files of rules of ros1_bridge (YAML), for types that differ.", option="--ros2-mapping"
    )
    via: str = setting(
        "auto",
        word_of(
            ("auto", "rclpy", "zenoh"),
            "a way to ROS 2",
            "auto: zenoh where connect or listen is set, else rclpy; rclpy: ROS 2's own library, with any RMW; "
            "zenoh: nodes that run rmw_zenoh, without ROS 2 on this machine",
            "WAY",
        ),
        "How it is joined: by ROS 2's own library in a process of its own (rclpy), or as rmw_zenoh (zenoh). "
        "auto: zenoh where connect or listen is set.",
        option="--ros2-via",
    )
    python: str = setting(
        "",
        TEXT,
        "The Python that has rclpy.",
        option="--ros2-python",
        shown_default="python3 of the sourced environment",
    )


@dataclass(frozen=True, slots=True)
class GatewaySettings:
    """The table ``[gateway]``."""

    site: str = setting(
        "",
        ValueType(_read_site, {"type": "string", "pattern": "^([A-Za-z][A-Za-z0-9_]*)?$"}, "NAME"),
        "This site's name, a ROS base name; empty: no other sites are joined.",
        env="RMPA_SITE",
        option="--site",
        shown_default="none",
    )
    rank: int = setting(
        100,
        whole_number(0, limits.GATEWAY_RANK_MAX, "a rank"),
        "Of several gateways of one site the one with the lowest rank leads.",
        option="--rank",
    )
    connect: tuple[str, ...] = setting(
        (), list_of(ENDPOINT), "Zenoh endpoints to connect to, such as tls/fleet.example:7447.", option="--connect"
    )
    listen: tuple[str, ...] = setting(
        (), list_of(ENDPOINT), "Zenoh endpoints to listen at, such as tls/0.0.0.0:7447.", option="--listen"
    )
    router: bool = switch(
        "Be a Zenoh router, which the gateways of other sites connect to.", option="--router/--no-router"
    )
    insecure: bool = switch(
        "Connect without certificates; else the module must have joined a secured mesh.",
        option="--insecure/--no-insecure",
    )
    uplink: int | None = setting(
        None,
        BYTES_A_SECOND,
        "The bandwidth to the other sites, bytes a second: commands then do not wait behind images in the kernel's "
        "buffer.",
        option="--uplink",
        shown_default="unlimited",
    )
    ros2: Ros2Settings = table(Ros2Settings, "gateway.ros2", "ROS2", command="gateway")
    rules: tuple[CrossingRule, ...] = setting(
        (),
        GATEWAY_RULES,
        "What may cross to other sites and to ROS 2; the first rule that matches applies. "
        "Without a rule, everything that [bridge] and [services] allow crosses, on demand.",
        key="gateway.rule",
        live=True,
    )

    @property
    def via_rclpy(self) -> bool:
        """Whether ROS 2 is joined by its own library; a file that joined it by Zenoh before does so as before."""
        auto = "zenoh" if self.connect or self.listen else "rclpy"
        return self.ros2.enabled and (auto if self.ros2.via == "auto" else self.ros2.via) == "rclpy"
