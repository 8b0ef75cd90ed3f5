"""Searches the rules of nftables and iptables for signs that they drop agents' packets.

These are signs, not proofs: only all rules together decide about a packet. A sign is a chain for incoming packets
whose policy is to drop, a rule that names a port of ours, or one that drops all UDP. The multicast check sends a real
packet besides.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from typing import Final

from rmpa.observe.check import FAIL, OK, WARN, Check

_DROPS: Final = re.compile(r"\b(drop|reject|DROP|REJECT)\b")
_ACCEPTS: Final = re.compile(r"\b(accept|ACCEPT)\b")
_UDP: Final = re.compile(
    r"(?:meta l4proto|ip protocol|ip6 nexthdr|-A \S+(?: -m comment --comment (?:\"[^\"]*\"|\S+))? -p)"
    r" (?:udp|17|\{ ?[^{}]*\b(?:udp|17)\b[^{}]* ?\})"
    r"(?: counter(?: packets \d+ bytes \d+)?| -m comment --comment (?:\"[^\"]*\"|\S+))*"
    r" (?:-j )?(?:drop|reject|DROP|REJECT)\b"
)
"""A rule that drops UDP to and from every port and address, as nft or iptables print it."""
_HOOK: Final = re.compile(r"type filter hook input .*policy (\w+)")
_BLOCK: Final = re.compile(r"(table|chain) (.+?) \{")
_RANGE: Final = re.compile(r"\b(\d{1,5})[-:](\d{1,5})\b")
_NUMBER: Final = re.compile(r"\b\d{1,5}\b")


@dataclass(slots=True)
class FirewallRules:
    """The signs found in a set of rules.

    Args:
        source: The program that printed them.
        closed: Chains for incoming packets whose policy is to drop.
        drops: Rules that drop packets for a port of ours.
        drops_udp: Rules that drop all UDP.
        accepts: Rules that accept packets for a port of ours.
        count: The number of all rules.
    """

    source: str
    closed: list[str] = field(default_factory=list)
    drops: list[str] = field(default_factory=list)
    drops_udp: list[str] = field(default_factory=list)
    accepts: list[str] = field(default_factory=list)
    count: int = 0

    def add(self, rule: str, ports: frozenset[int]) -> None:
        """Count one rule, and keep it if it names a port of ours, or drops all UDP that no rule before it lets in."""
        self.count += 1
        if _UDP.match(rule) and not any("udp" in accept or "tcp" not in accept for accept in self.accepts):
            self.drops_udp.append(rule)
        if not names_port(rule, ports):
            return
        if _DROPS.search(rule):
            self.drops.append(rule)
        elif _ACCEPTS.search(rule):
            self.accepts.append(rule)


def names_port(rule: str, ports: frozenset[int]) -> bool:
    """Whether a rule names one of the ports as destination, by number or within a range."""
    _, found, behind = rule.partition("dport")
    if not found:
        return False
    spans = [(int(low), int(high)) for low, high in _RANGE.findall(behind)]
    if any(low <= port <= high for low, high in spans for port in ports):
        return True
    return not ports.isdisjoint(map(int, _NUMBER.findall(_RANGE.sub("", behind))))


def read_nft(text: str, ports: frozenset[int]) -> FirewallRules:
    """Parse the output of ``nft list ruleset``."""
    rules = FirewallRules("nft")
    table = chain = ""
    for line in map(str.strip, text.splitlines()):
        block = _BLOCK.match(line)
        if block is not None:
            table, chain = (block[2], "") if block[1] == "table" else (table, block[2])
        elif (hook := _HOOK.match(line)) is not None:
            if hook[1] == "drop":
                rules.closed.append(f"{table} {chain}".strip())
        elif line and line != "}" and chain and not line.startswith("type "):
            rules.add(line, ports)
    return rules


def read_iptables(text: str, ports: frozenset[int]) -> FirewallRules:
    """Parse the output of ``iptables -S``."""
    rules = FirewallRules("iptables")
    for line in map(str.strip, text.splitlines()):
        if line in ("-P INPUT DROP", "-P INPUT REJECT"):
            rules.closed.append("INPUT")
        elif line.startswith("-A "):
            rules.add(line, ports)
    return rules


def judge_rules(rules: FirewallRules, ports: str) -> Check:
    """Whether the rules let agents' packets in.

    Args:
        rules: As parsed.
        ports: The ports that must be open, ready to read.
    """
    if rules.drops:
        remedy = f"take it out, or let {ports} in before it"
        return Check("firewall", FAIL, f"drops what agents send: {rules.drops[0]}", remedy, where=rules.source)
    if rules.drops_udp:
        text = f"drops all UDP, also beacons of agents: {rules.drops_udp[0]}"
        return Check("firewall", FAIL, text, f"take it out, or let {ports} in before it", where=rules.source)
    if rules.closed and not rules.accepts:
        text = f"{', '.join(rules.closed)} drops what no rule lets in, and no rule names our ports"
        remedy = f"let in {ports}; `rmpa up --port N` gives the mesh a port that rules can name"
        return Check("firewall", WARN, text, remedy, where=rules.source)
    if rules.closed:
        return Check("firewall", OK, f"lets ours in: {rules.accepts[0]}", where=rules.source)
    return Check("firewall", OK, f"{rules.count} rules, and none against agents that we see", where=rules.source)
