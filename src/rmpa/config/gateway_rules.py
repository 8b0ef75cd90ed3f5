"""The table ``[gateway]`` of ``rmpa.toml``: which other sites and which ROS 2 a gateway joins, and what may cross."""

from __future__ import annotations

import re
from dataclasses import dataclass
from enum import StrEnum
from typing import TYPE_CHECKING, Final

from rmpa.config import limits
from rmpa.config.quantities import BYTES_A_SECOND, RATE, read_bytes_a_second
from rmpa.config.schema import setting, table
from rmpa.config.values import (
    BOOL,
    DOMAIN,
    NAME,
    PEER_GLOB,
    TEXT,
    TOPIC_GLOB,
    BadValue,
    RuleKey,
    ValueType,
    did_you_mean,
    list_of,
    member_of,
    read_keys,
    read_text,
    tables_of,
    whole_number,
    word_of,
)
from rmpa.core.identity import is_global_name

if TYPE_CHECKING:
    from collections.abc import Mapping

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
_KEYS: Final = (
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
_EXAMPLE: Final = 'one has names = ["/camera/**"] and rate = 2, or crossing = "none"'
_SELECTORS: Final = {"names", "sites", "modules"}


def _read_rule(raw: Mapping[str, object]) -> CrossingRule:
    values = read_keys(raw, _KEYS)
    said = set(values) - _SELECTORS
    if not said:
        raise BadValue("a rule that says nothing of what it selects", _EXAMPLE)
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


GATEWAY_RULES: Final = tables_of(_KEYS, _read_rule, limits.GATEWAY_RULES_MAX, "one may have several globs")

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
