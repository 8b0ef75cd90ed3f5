"""The codes of errors, warnings and problems: what each means, and what to do. ``rmpa explain CODE`` shows one.

A code stands in square brackets at the end of a line, and as ``code`` in JSON. It does not change between releases;
texts may. They stand in ``codes.toml``, of which docs/reference/codes.md is made, by ``make reference``.

A code is for what a user can do something else about, not for each line of the program that raises.
"""

from __future__ import annotations

import functools
import re
from pathlib import Path
from typing import Final

# By the name of a check of ``rmpa doctor``, or of a stage of ``rmpa why``: the code of its warning or failure.
CHECKS: Final = {
    **dict.fromkeys(("settings",), "invalid-value"),
    **dict.fromkeys(("policy here", "policy there", "rule", "rule here", "shown"), "rule-excludes"),
    **dict.fromkeys(("permission here", "permission there"), "not-permitted"),
    **dict.fromkeys(("offer", "offers"), "not-offered"),
    **dict.fromkeys(("limit", "limits"), "limit-reached"),
    **dict.fromkeys(("type", "md5"), "type-mismatch"),
    **dict.fromkeys(("publisher", "source there"), "no-publisher"),
    **dict.fromkeys(("demand", "demand here"), "no-subscriber"),
    **dict.fromkeys(("peer", "link"), "peer-unlinked"),
    **dict.fromkeys(("lanes", "load"), "link-slow"),
    **dict.fromkeys(("node", "reachable"), "node-unreachable"),
    **dict.fromkeys(("multicast", "heard"), "multicast-blocked"),
    **dict.fromkeys(("answer", "calls"), "service-failed"),
    "agent": "agent-trouble",
    "directory": "directory-unusable",
    "interface": "no-interface",
    "firewall": "firewall-blocks",
    "rp_filter": "rp-filter-strict",
    "radio": "radio-slow",
    "port": "port-in-use",
    "ROS": "ros-environment",
    "clock": "clock-skew",
    "realtime": "realtime-denied",
    "boot": "service-unit",
    "exposed nodes": "nodes-exposed",
    "files": "out-of-descriptors",
    "trust": "certificate-trouble",
    "transport": "not-direct",
    "graph": "name-taken",
    "time": "two-clocks",
    "subscriber": "subscriber-unconnected",
    "route": "route-not-open",
    "sent": "nothing-sent",
    "arrived": "nothing-arrives",
    "contract": "contract-missed",
    "reader": "reader-slow",
    "server": "no-server",
    "site": "site-unreachable",
    "router": "zenoh-trouble",
}

# By the state of a peer that is not linked.
PEER_STATES: Final = {
    "linking": "peer-unlinked",
    "refused": "peer-refused",
    "conflict": "name-conflict",
    "foreign": "other-mesh",
    "pending": "pending",
    "revoked": "member-revoked",
}

# By code: the counters of refusals whose lines in the log have it, or the first words of these.
_REFUSALS: Final = {
    "certificate-refused": [f"link.refused.{word}" for word in ("clock", "expired", "revoked", "name", "downgrade")],
    "clock-skew": ["beacon.clock"],
    "contract-missed": ["contract", "route"],
    "limit-reached": ["audience", "link.refused.full", "nodes", "services", "sources", "topics", "zenoh"],
    "message-too-long": ["message"],
    "name-conflict": ["conflict", "link.refused.duplicate"],
    "name-taken": ["names"],
    "not-direct": ["direct"],
    "not-permitted": ["control.user"],
    "other-mesh": [
        *(f"beacon.{word}" for word in ("forged", "unknown_key", "untagged")),
        *(f"link.refused.{word}" for word in ("plain", "unsecured", "key", "foreign")),
    ],
    "other-release": ["beacon.version", "link.refused.version", "site"],
    "out-of-descriptors": ["accept", "descriptors"],
    "param-trouble": ["param"],
    "peer-refused": ["beacon.other_domain", "link.refused"],
    "protocol-error": ["beacon", "control.refused", "http", "link", "publisher", "route.doubled", "tcpros", "xmlrpc"],
    "same-names": ["peer.twin"],
    "token-refused": ["trust"],
    "too-many-connections": [
        "beacon.flood",
        "control",
        "http.evicted",
        "http.refused",
        "link.pending_full",
        "tcpros.refused.full",
    ],
    "two-clocks": ["clock"],
    "type-mismatch": ["mismatch", "publication", "service", "subscription"],
}
_COUNTERS: Final = {counter: code for code, counters in _REFUSALS.items() for counter in counters}


@functools.cache
def texts() -> dict[str, tuple[str, str]]:
    """By code: what it means, and what to do."""
    import tomllib  # noqa: PLC0415 - for `rmpa explain` alone

    found = tomllib.loads(Path(__file__).with_name("codes.toml").read_text("utf-8"))
    return {code: (each["means"], each["do"]) for code, each in found.items()}


def of_counter(name: str) -> str:
    """The code of a line about a refusal, by the counter's name; those of the web server have no dot."""
    if "." not in name:
        return "web-client-refused"
    while name and name not in _COUNTERS:
        name = name.rpartition(".")[0]
    return _COUNTERS.get(name, "failed")


def of_line(text: str) -> str:
    """The code at the end of a line; empty where there is none."""
    found = re.search(r" \[([a-z][a-z0-9-]+)\]$", text)
    return found[1] if found else ""


def plain(text: str) -> str:
    """A text of the table without the Markdown of its links: ``limits (docs/reference/limits.md)``."""
    text = re.sub(r"\[([^\]]+)\]\(\.\./([^)]+)\)", r"\1 (docs/\2)", text)
    return re.sub(r"\[([^\]]+)\]\(([a-z]+\.md[^)]*)\)", r"\1 (docs/reference/\2)", text)
