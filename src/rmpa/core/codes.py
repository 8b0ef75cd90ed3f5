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

# By a counter of refusals, or by its first words: the code of the line in the log.
_COUNTERS: Final = {
    "accept": "out-of-descriptors",
    "audience": "limit-reached",
    "beacon": "protocol-error",
    "beacon.clock": "clock-skew",
    "beacon.other_domain": "peer-refused",
    "beacon.flood": "too-many-connections",
    "beacon.forged": "other-mesh",
    "beacon.unknown_key": "other-mesh",
    "beacon.untagged": "other-mesh",
    "beacon.version": "other-release",
    "conflict": "name-conflict",
    "contract": "contract-missed",
    "control": "too-many-connections",
    "control.refused": "protocol-error",
    "control.user": "not-permitted",
    "descriptors": "out-of-descriptors",
    "direct": "not-direct",
    "http": "protocol-error",
    "http.evicted": "too-many-connections",
    "http.refused": "too-many-connections",
    "link": "protocol-error",
    "link.pending_full": "too-many-connections",
    "link.refused": "peer-refused",
    "message": "message-too-long",
    "clock": "two-clocks",
    "mismatch": "type-mismatch",
    "names": "name-taken",
    "nodes": "limit-reached",
    "param": "param-trouble",
    "peer.twin": "same-names",
    "publication": "type-mismatch",
    "publisher": "protocol-error",
    "route": "contract-missed",
    "route.doubled": "protocol-error",
    "service": "type-mismatch",
    "services": "limit-reached",
    "sources": "limit-reached",
    "site": "other-release",
    "subscription": "type-mismatch",
    "tcpros": "protocol-error",
    "tcpros.refused.full": "too-many-connections",
    "topics": "limit-reached",
    "trust": "token-refused",
    "xmlrpc": "protocol-error",
    "zenoh": "limit-reached",
    **{
        f"link.refused.{reason}": code
        for reason, code in {
            "version": "other-release",
            "full": "limit-reached",
            "duplicate": "name-conflict",
            "plain": "other-mesh",
            "unsecured": "other-mesh",
            "key": "other-mesh",
            "foreign": "other-mesh",
            **dict.fromkeys(("clock", "expired", "revoked", "name", "downgrade"), "certificate-refused"),
        }.items()
    },
}


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
