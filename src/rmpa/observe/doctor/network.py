"""Judges interfaces, routes and the firewall's rules.

Searches the rules of nftables and iptables for signs that they drop agents' packets.

These are signs, not proofs: only all rules together decide about a packet. A sign is a chain for incoming packets
whose policy is to drop, a rule that names a port of ours, or one that drops all UDP. The multicast check sends a real
packet besides.
"""

from __future__ import annotations

import contextlib
import os
import re
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Final

import psutil

from rmpa.observe import limits
from rmpa.observe.doctor.machine import ask_program
from rmpa.observe.peer_info import FAIL, OK, SKIPPED, WARN, Check

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence
    from ipaddress import IPv4Interface

    from rmpa.config.settings import Settings

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


# Judges the network: interfaces, multicast on each, filters of the kernel, routes, ports.


_CONTAINERS: Final = re.compile(r"(docker|br-|veth|virbr|lxc|lxd|cni|flannel|podman|cali)")
_TUNNELS: Final = re.compile(r"(tun|tap|wg|zt|tailscale|ppp|utun|nordlynx|proton)")
_STRICT: Final = 1
"""The value of rp_filter that drops a packet whose answer would leave by another interface (RFC 3704)."""


@dataclass(frozen=True, slots=True)
class NetworkInterface:
    """One network interface.

    Args:
        name: As in ``ip link``.
        networks: Its IPv4 addresses with their networks.
        up: Whether it is up and has a carrier.
        multicast: Whether its flags say so.
        loopback: Whether it never leaves this machine.
        used: Whether an agent started here would use it.
    """

    name: str
    networks: tuple[IPv4Interface, ...] = ()
    up: bool = True
    multicast: bool = True
    loopback: bool = False
    used: bool = True


@dataclass(slots=True)
class MulticastEcho:
    """Whether a packet that was sent to the group on an interface was received there.

    Args:
        interface: Its name.
        problem: Why it could not be sent, or the group not be joined; empty if nothing failed.
        after: Seconds until it was received; ``None`` if it was not.
        others: The addresses of other machines that were heard there.
    """

    interface: str
    problem: str = ""
    after: float | None = None
    others: set[str] = field(default_factory=set)


def judge_interfaces(
    interfaces: Sequence[NetworkInterface], wanted: Sequence[str], *, container: bool = False
) -> list[Check]:
    """Which interfaces an agent can use, and which of these are likely to make trouble.

    Args:
        interfaces: All of them.
        wanted: The names that the settings give; empty for all that can be used.
        container: Whether this is a container with a network namespace of its own.
    """
    found = []
    missing = [name for name in wanted if name not in {one.name for one in interfaces}]
    for name in missing:
        have = ", ".join(one.name for one in interfaces)
        text = f"the settings name it, and it is not here (there are {have})"
        found.append(Check("interface", WARN, text, "correct discovery.interfaces, or plug it in", where=name))
    outer = [one for one in interfaces if one.used and not one.loopback]
    kept = [one.name for one in interfaces if one.loopback and one.name in wanted]
    if not outer and kept and not missing:
        text = "the settings keep agents to this machine"
        found.append(Check("interface", OK, text, where=kept[0]))
    elif not outer:
        down = [one.name for one in interfaces if not one.loopback]
        text = "none but loopback can be used: agents of other machines are not found"
        remedy = f"see `ip address`: {', '.join(down)} need to be up and have an IPv4 address" if down else ""
        found.append(Check("interface", WARN, text, remedy or "plug in a network"))
    found += [_judge_interface(one) for one in outer]
    found += _shared(outer)
    if container and outer:
        text = "this is a container with a network of its own: no multicast of the outside comes in"
        remedy = "start it with --network host, or reach the others by --seed HOST:PORT"
        found.append(Check("interface", WARN, text, remedy, where=outer[0].name))
    return found


def _judge_interface(one: NetworkInterface) -> Check:
    addresses = ", ".join(str(network) for network in one.networks)
    if _TUNNELS.match(one.name) or not one.multicast:
        text = f"{addresses}: a tunnel; most of them carry no multicast"
        return Check("interface", WARN, text, "name one agent behind it by --seed HOST:PORT", where=one.name)
    if _CONTAINERS.match(one.name):
        text = f"{addresses}: belongs to containers or virtual machines; agents send beacons there too"
        return Check("interface", OK, text, "to keep to one network: --interface NAME", where=one.name)
    if all(network.is_link_local for network in one.networks):
        text = f"{addresses}: it gave itself this address, for no DHCP server answered"
        return Check("interface", WARN, text, "is the cable in the right network?", where=one.name)
    return Check("interface", OK, addresses, where=one.name)


def _shared(interfaces: Sequence[NetworkInterface]) -> list[Check]:
    """Interfaces that share a network: the kernel may answer by either."""
    networks = Counter(
        network.network for one in interfaces for network in {n.network: n for n in one.networks}.values()
    )
    found = []
    for network in (network for network, count in networks.items() if count > 1 and network.prefixlen < 32):
        names = [one.name for one in interfaces if any(n.network == network for n in one.networks)]
        text = f"{' and '.join(names)} are both in {network}: answers may leave by the other one, and be dropped"
        found.append(Check("interface", WARN, text, "keep one of them, or --interface NAME", where="+".join(names)))
    return found


def judge_multicast(echoes: Sequence[MulticastEcho], group: str, port: int, listened: float = 0.0) -> list[Check]:
    """Whether each interface can send to the group and receives what was sent, and what others send.

    Args:
        echoes: By interface.
        group: The multicast group.
        port: Its port.
        listened: Seconds for which packets of other machines were waited for; 0: they were not.
    """
    found = []
    for echo in echoes:
        if echo.problem:
            text = f"{group}:{port} cannot be used: {echo.problem}"
            remedy = "an OUTPUT rule of the firewall, or no multicast on this interface: --seed HOST:PORT needs none"
            found.append(Check("multicast", FAIL, text, remedy, where=echo.interface))
        elif echo.after is None:
            text = f"sent to {group}:{port}, but not heard: something on this machine drops it"
            remedy = f"let UDP port {port} in (ufw allow {port}/udp; nft or iptables: see the check firewall)"
            found.append(Check("multicast", FAIL, text, remedy, where=echo.interface))
        else:
            text = f"{group}:{port} sent, and heard {echo.after * 1e3:.1f} ms later"
            others = f"; heard of other machines: {', '.join(sorted(echo.others))}" if echo.others else ""
            found.append(Check("multicast", OK, text + others, where=echo.interface))
    if listened and not any(echo.others for echo in echoes):
        text = f"nothing of another machine was heard within {listened:g} s"
        remedy = "run `rmpa doctor` there meanwhile; if it was: a switch, an access point or a firewall drops it"
        found.append(Check("multicast", WARN, text, remedy))
    return found


def judge_rp_filter(values: Mapping[str, int], interfaces: Sequence[NetworkInterface]) -> list[Check]:
    """Whether the kernel drops packets that come in on another interface than answers would leave by.

    Args:
        values: ``net.ipv4.conf.NAME.rp_filter`` by name, ``all`` among them.
        interfaces: All of them.
    """
    outer = [one.name for one in interfaces if one.used and not one.loopback]
    strict = [name for name in outer if max(values.get("all", 0), values.get(name, 0)) == _STRICT]
    if not values:
        return [Check("rp_filter", SKIPPED, "this kernel does not tell")]
    if len(outer) > 1 and strict:
        text = (
            f"strict on {', '.join(strict)}, and there are {len(outer)} interfaces: packets of a peer that is routed "
            "by another one are dropped without a word"
        )
        remedy = "sudo sysctl -w net.ipv4.conf.all.rp_filter=2 (and of each interface)"
        return [Check("rp_filter", WARN, text, remedy)]
    return [Check("rp_filter", OK, "nothing is dropped for coming by the wrong interface")]


@dataclass(frozen=True, slots=True)
class Radio:
    """What the kernel does for TCP over a wireless interface.

    Args:
        name: As in ``ip link``.
        network: Its network, as ``ip route`` has it.
        rto_min: ``rto_min`` of its route, as ``ip route`` shows it; empty for none, or where ``ip`` is missing.
    """

    name: str
    network: str
    rto_min: str = ""


def judge_radio(radios: Iterable[Radio], *, quick: bool, bbr: bool) -> list[Check]:
    """Whether packets that a radio loses are repeated soon, and whether large messages fill its queue.

    Args:
        radios: The wireless interfaces that an agent would use.
        quick: Whether this kernel lets an agent shorten the time-outs of its own links (TCP_RTO_MIN_US).
        bbr: Whether this process may use BBR for its large messages.
    """
    found = []
    for radio in radios:
        remedy = f"sudo ip route change {radio.network} dev {radio.name} rto_min 40ms"
        if radio.rto_min:
            text = f"its route has rto_min {radio.rto_min}: lost packets are repeated soon"
            found.append(Check("radio", OK, text, where=radio.name))
        elif quick:
            text = "agents repeat lost commands soon; connections of nodes (direct transport) wait 200 ms"
            found.append(Check("radio", OK, text, remedy, where=radio.name))
        else:
            text = "TCP waits 200 ms before it repeats a lost packet, and this kernel has no option for less"
            found.append(Check("radio", WARN, text, remedy, where=radio.name))
        if not bbr:
            text = "BBR is not permitted: commands wait some 30 ms in the radio's queue behind large messages"
            permit = 'sudo modprobe tcp_bbr; sudo sysctl -w net.ipv4.tcp_allowed_congestion_control="reno cubic bbr"'
            found.append(Check("radio", WARN, text, permit, where=radio.name))
    return found or [Check("radio", SKIPPED, "no wireless interface is used")]


def judge_routes(routes: Mapping[str, str]) -> list[Check]:
    """Whether the kernel has a route to each address of a peer or seed.

    Args:
        routes: Why there is none, or empty, by the address, ready to read (with the peer's name).
    """
    found = []
    remedy = "`ip route get ADDRESS`; a gateway is missing, or the interface of that network is down"
    for target, problem in routes.items():
        if problem:
            found.append(Check("route", FAIL, f"there is no way: {problem}", remedy, where=target))
        elif len(routes) <= limits.DOCTOR_PEERS_LISTED:
            found.append(Check("route", OK, "there is a way", where=target))
    reached = sum(not problem for problem in routes.values())
    if reached and len(routes) > limits.DOCTOR_PEERS_LISTED:
        found.append(Check("route", OK, f"there is a way to {reached:,} of {len(routes):,} peers and seeds"))
    return found or [Check("route", SKIPPED, "no peer and no seed is known whose way could be looked for")]


@dataclass(frozen=True, slots=True)
class Port:
    """One port that an agent needs.

    Args:
        what: Its use, ready to read.
        number: Its number.
        taken: Why it cannot be bound, or empty.
        owner: The program that has it, ready to read; empty if none or unknown. A port that is not ``taken`` may have
            one too: agents share the port of the beacons.
        ours: Whether the owner is an agent of this machine, or its core.
    """

    what: str
    number: int
    taken: str = ""
    owner: str = ""
    ours: bool = False


def judge_ports(ports: Iterable[Port]) -> list[Check]:
    """Whether an agent can bind the ports that it needs."""
    found = []
    for port in ports:
        if not port.taken:
            text = f"used by {port.owner}; others may use it too" if port.owner else "free"
            found.append(Check("port", OK, f"{port.what}: {text}", where=str(port.number)))
        elif port.ours:
            found.append(Check("port", OK, f"{port.what}: {port.owner} has it", where=str(port.number)))
        else:
            owner = f" by {port.owner}" if port.owner else ""
            text = f"{port.what}: taken{owner} ({port.taken})"
            remedy = f"end that program (`ss -lptun | grep :{port.number}` names it), or choose another port"
            found.append(Check("port", FAIL, text, remedy, where=str(port.number)))
    return found


# Reads the rules of this machine's firewalls.


def check_firewall(settings: Settings) -> list[Check]:
    """Whether the rules of nftables and iptables, and their front ends, let an agent's packets in."""
    numbers = frozenset({settings.discovery_port, *((settings.port,) if settings.port else ())})
    needed = f"UDP port {settings.discovery_port}, and the mesh's port (TCP and UDP"
    needed += f", {settings.port})" if settings.port else "; it is any one without --port)"
    found = []
    for words, read in ((("nft", "list", "ruleset"), read_nft), (("iptables", "-S"), read_iptables)):
        text = ask_program(*words)
        if text is not None:
            found.append(judge_rules(read(text, numbers), needed))
    if not found:
        why = "only root may read them" if os.geteuid() else "neither nft nor iptables is here, or they do not answer"
        found.append(Check("firewall", SKIPPED, why, "" if not os.geteuid() else "run it by sudo", where="rules"))
    return found + _front_ends(needed)


def _front_ends(needed: str) -> list[Check]:
    found = []
    with contextlib.suppress(OSError):
        if "ENABLED=yes" in Path("/etc/ufw/ufw.conf").read_text(encoding="utf-8", errors="replace"):
            text = f"is switched on: it must let in {needed}"
            found.append(Check("firewall", WARN, text, "`sudo ufw status` shows its rules", where="ufw"))
    if any(process.info["name"] == "firewalld" for process in psutil.process_iter(["name"])):
        text = f"runs: its zone must let in {needed}"
        found.append(Check("firewall", WARN, text, "`firewall-cmd --list-all` shows its zone", where="firewalld"))
    return found
