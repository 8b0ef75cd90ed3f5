"""Reads and judges the network of this machine: interfaces, multicast, filters, routes, ports, and firewalls.

Rules of nftables and iptables are searched for signs that they drop agents' packets. These are signs, not proofs:
only all rules together decide about a packet. A sign is a chain for incoming packets whose policy is to drop, a rule
that names a port of ours, or one that drops all UDP. The check of multicast sends a real packet besides.
"""

from __future__ import annotations

import contextlib
import os
import re
import secrets
import select
import socket
import struct
import time
from collections import Counter
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Final

import psutil

from rmpa.core.errors import StartError
from rmpa.discovery import limits as discovery_limits
from rmpa.discovery.beacon import MAGIC, VERSION, BeaconKind
from rmpa.discovery.network import CONTAINERS, Interface, choose, join_group, list_interfaces, open_receiver, receive
from rmpa.mesh.io.lane import may_use_bbr, repeats_quickly
from rmpa.observe import limits
from rmpa.observe.check import FAIL, OK, SKIPPED, WARN, Check
from rmpa.observe.doctor.machine import DoctorInput, ask_program, resolve
from rmpa.runtime.kernel_tcp import program_at

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Mapping, Sequence


_TUNNELS: Final = re.compile(r"(tun|tap|wg|zt|tailscale|ppp|utun|nordlynx|proton)")
_CONTAINER_MARKS: Final = (Path("/.dockerenv"), Path("/run/.containerenv"))


def interfaces(given: DoctorInput) -> Iterable[Check]:
    """The check of the interfaces."""
    return judge_interfaces(given.interfaces, given.settings.interfaces, container=_in_container())


def _in_container() -> bool:
    """Whether this is a container with a network namespace of its own."""
    if "container" not in os.environ and not any(mark.exists() for mark in _CONTAINER_MARKS):
        return False
    with contextlib.suppress(OSError, ValueError):
        link, own = (
            int(Path(f"/sys/class/net/eth0/{name}").read_text(encoding="ascii")) for name in ("iflink", "ifindex")
        )
        return link != own  # a veth: its other end is outside
    return False


def judge_interfaces(
    interfaces: Sequence[Interface], wanted: Sequence[str], *, container: bool = False
) -> Iterator[Check]:
    """Which interfaces an agent can use, and which of these are likely to make trouble.

    Args:
        interfaces: All of them.
        wanted: The names that the settings give; empty for all that can be used.
        container: Whether this is a container with a network namespace of its own.
    """
    check, names = partial(Check, "interface"), [one.name for one in interfaces]
    missing = [name for name in wanted if name not in names]
    for name in missing:
        text = f"the settings name it, and it is not here (there are {', '.join(names)})"
        yield check(WARN, text, "correct discovery.interfaces, or plug it in", where=name)
    outer = [one for one in interfaces if one.used and not one.loopback]
    kept = [one.name for one in interfaces if one.loopback and one.name in wanted]
    if not outer and kept and not missing:
        yield check(OK, "the settings keep agents to this machine", where=kept[0])
    elif not outer:
        down = ", ".join(one.name for one in interfaces if not one.loopback)
        remedy = f"see `ip address`: {down} need to be up and have an IPv4 address" if down else "plug in a network"
        yield check(WARN, "only loopback can be used: agents of other machines are not found", remedy)
    yield from map(_judge_interface, outer)
    # Of interfaces that share a network the kernel may answer by either.
    networks = Counter(network for one in outer for network in dict.fromkeys(at.network for at in one.networks))
    for network in (network for network, count in networks.items() if count > 1 and network.prefixlen < 32):
        sharing = [one.name for one in outer if any(at.network == network for at in one.networks)]
        text = f"{' and '.join(sharing)} are both in {network}: answers may leave by the other one, and be dropped"
        yield check(WARN, text, "keep one of them, or --interface NAME", where="+".join(sharing))
    if container and outer:
        text = "this is a container with a network of its own: no multicast of the outside comes in"
        remedy = "start it with --network host; or publish its --port for TCP and UDP, and give it a --seed"
        yield check(WARN, text, remedy, where=outer[0].name)


def _judge_interface(one: Interface) -> Check:
    addresses, check = ", ".join(map(str, one.networks)), partial(Check, "interface", where=one.name)
    if _TUNNELS.match(one.name) or not one.multicast:
        text = f"{addresses}: a tunnel; most of them carry no multicast"
        return check(WARN, text, "name one agent behind it by --seed HOST:PORT")
    if CONTAINERS.match(one.name):
        text = f"{addresses}: belongs to containers or virtual machines; agents send beacons there too"
        return check(OK, text, "to keep to one network: --interface NAME")
    if all(network.is_link_local for network in one.networks):
        text = f"{addresses}: it gave itself this address, for no DHCP server answered"
        return check(WARN, text, "is the cable in the right network?")
    return check(OK, addresses)


_PKTINFO: Final = struct.Struct("@i4s4s")
_IP_PKTINFO: Final = 8  # Linux's (linux/in.h); not in the socket module of every supported Python
# Greater than every domain: agents ignore beacons of it without logging.
_NO_DOMAIN: Final = 0xFFFF


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


def multicast(given: DoctorInput) -> Iterable[Check]:
    """The check of multicast: send and receive on each interface that an agent would use, at the agents' own port."""
    settings = given.settings
    group, port = settings.multicast.group, settings.discovery_port
    if not settings.multicast.enabled:
        return [Check("multicast", SKIPPED, "the settings switch it off (discovery.multicast)")]
    try:
        echoes = hear(choose(list_interfaces(), settings.interfaces), group, port, given.listen)
    except StartError as error:
        return [Check("multicast", FAIL, f"{error.what} {error.problem}", error.remedy)]
    return judge_multicast(echoes, group, port, given.listen)


def hear(interfaces: Iterable[Interface], group: str, port: int, listen: float = 0.0) -> tuple[MulticastEcho, ...]:
    """Send one packet on each interface, and receive it there as an agent does.

    The packets are beacons of a domain that cannot exist, so agents ignore them.

    Args:
        interfaces: Where to send.
        group: The multicast group.
        port: Its port, which is shared with agents and others.
        listen: Seconds to listen for packets of other machines; 0: only until the own ones are back.

    Raises:
        StartError: Another program has the port and does not share it.
    """
    wanted = {interface.index: interface for interface in interfaces}
    own = {str(address) for interface in wanted.values() for address in interface.addresses}
    try:
        receiver = open_receiver(group, port)
    except OSError as error:
        problem, remedy = f"cannot be opened ({error.strerror})", "`ss -ulnp` shows the program that has it"
        raise StartError(f"UDP port {port}", problem, remedy, code="port-in-use") from None
    found: dict[str, MulticastEcho] = {}
    with receiver, socket.socket(socket.AF_INET, socket.SOCK_DGRAM | socket.SOCK_CLOEXEC) as sender:
        sender.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_TTL, discovery_limits.MULTICAST_TTL)
        refused = join_group(receiver, group, wanted.values(), set())
        sent: dict[bytes, tuple[str, float]] = {}
        for interface in wanted.values():
            token = struct.pack(">4sBBH", MAGIC, VERSION, BeaconKind.HEARTBEAT, _NO_DOMAIN) + secrets.token_bytes(16)
            why = refused.get(interface.name) or _send(sender, interface, token, (group, port))
            found[interface.name] = MulticastEcho(interface.name, (why.strerror or str(why)) if why else "")
            if why is None:
                sent[token] = interface.name, time.monotonic()
        until = time.monotonic() + max(limits.DOCTOR_HEAR, listen)
        while (sent or listen) and (rest := until - time.monotonic()) > 0:
            if not select.select([receiver], [], [], rest)[0]:
                break
            try:
                data, (host, _), index = receive(receiver)
            except BlockingIOError:
                continue  # the kernel dropped it: its checksum was wrong
            name = wanted[index].name if index in wanted else ""
            # If two interfaces share a network, the packet is received on the other one too.
            if data in sent and sent[data][0] == name:
                found[name].after = time.monotonic() - sent.pop(data)[1]
            elif name and host not in own and data.startswith(MAGIC):
                found[name].others.add(host)
    return tuple(found.values())


def _send(sender: socket.socket, interface: Interface, data: bytes, to: tuple[str, int]) -> OSError | None:
    """Send one packet on an interface; return why that failed."""
    source = interface.addresses[0].packed if interface.addresses else bytes(4)
    ancillary = [(socket.IPPROTO_IP, _IP_PKTINFO, _PKTINFO.pack(interface.index, source, bytes(4)))]
    try:
        sender.sendmsg([data], ancillary, 0, to)
    except OSError as error:
        return error
    return None


def judge_multicast(echoes: Sequence[MulticastEcho], group: str, port: int, listened: float = 0.0) -> Iterator[Check]:
    """Whether each interface can send to the group and receives what was sent, and what others send.

    Args:
        echoes: By interface.
        group: The multicast group.
        port: Its port.
        listened: Seconds for which packets of other machines were waited for; 0: they were not.
    """
    for echo in echoes:
        check = partial(Check, "multicast", where=echo.interface)
        if echo.problem:
            remedy = "an OUTPUT rule of the firewall, or no multicast on this interface: --seed HOST:PORT needs none"
            yield check(FAIL, f"{group}:{port} cannot be used: {echo.problem}", remedy)
        elif echo.after is None:
            text = f"sent to {group}:{port}, but not heard: something on this machine drops it"
            remedy = f"let UDP port {port} in (ufw allow {port}/udp; nft or iptables: see the check firewall)"
            yield check(FAIL, text, remedy)
        else:
            others = f"; heard of other machines: {', '.join(sorted(echo.others))}" if echo.others else ""
            yield check(OK, f"{group}:{port} sent, and heard {echo.after * 1e3:.1f} ms later{others}")
    if listened and not any(echo.others for echo in echoes):
        remedy = "run `rmpa doctor` there meanwhile; if it was: a switch, an access point or a firewall drops it"
        yield Check("multicast", WARN, f"nothing of another machine was heard within {listened:g} s", remedy)


_DROPS: Final = re.compile(r"\b(drop|reject|DROP|REJECT)\b")
_ACCEPTS: Final = re.compile(r"\b(accept|ACCEPT)\b")
# A rule that drops UDP to and from every port and address, as nft or iptables print it.
_UDP: Final = re.compile(
    r"(?:meta l4proto|ip protocol|ip6 nexthdr|-A \S+(?: -m comment --comment (?:\"[^\"]*\"|\S+))? -p)"
    r" (?:udp|17|\{ ?[^{}]*\b(?:udp|17)\b[^{}]* ?\})"
    r"(?: counter(?: packets \d+ bytes \d+)?| -m comment --comment (?:\"[^\"]*\"|\S+))*"
    r" (?:-j )?(?:drop|reject|DROP|REJECT)\b"
)
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
        if names_port(rule, ports):
            kept = self.drops if _DROPS.search(rule) else self.accepts if _ACCEPTS.search(rule) else []
            kept.append(rule)


def names_port(rule: str, ports: frozenset[int]) -> bool:
    """Whether a rule names one of the ports as destination, by number or within a range."""
    behind = rule.partition("dport")[2]
    spans = [(int(low), int(high)) for low, high in _RANGE.findall(behind)]
    if any(low <= port <= high for low, high in spans for port in ports):
        return True
    return not ports.isdisjoint(map(int, _NUMBER.findall(_RANGE.sub("", behind))))


def read_nft(text: str, ports: frozenset[int]) -> FirewallRules:
    """Parse the output of ``nft list ruleset``."""
    rules = FirewallRules("nft")
    table = chain = ""
    for line in map(str.strip, text.splitlines()):
        if (block := _BLOCK.match(line)) is not None:
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
    check, remedy = partial(Check, "firewall", where=rules.source), f"take it out, or let {ports} in before it"
    if rules.drops:
        return check(FAIL, f"drops what agents send: {rules.drops[0]}", remedy)
    if rules.drops_udp:
        return check(FAIL, f"drops all UDP, also beacons of agents: {rules.drops_udp[0]}", remedy)
    if rules.closed and not rules.accepts:
        text = f"{', '.join(rules.closed)} drops what no rule lets in, and no rule names our ports"
        return check(WARN, text, f"let in {ports}; `rmpa up --port N` gives the mesh a port that rules can name")
    if rules.closed:
        return check(OK, f"lets ours in: {rules.accepts[0]}")
    return check(OK, f"{rules.count} rules, and none against agents that we see")


def firewall(given: DoctorInput) -> Iterator[Check]:
    """The check of the rules of nftables and iptables, and of their front ends."""
    beacons, mesh = given.settings.discovery_port, given.settings.port
    needed = f"UDP port {beacons}, and the mesh's port (TCP and UDP"
    needed += f", {mesh})" if mesh else "; it is any one without --port)"
    numbers = frozenset({beacons, mesh} - {0})
    nft, iptables = ask_program("nft", "list", "ruleset"), ask_program("iptables", "-S")
    if nft is not None:
        yield judge_rules(read_nft(nft, numbers), needed)
    if iptables is not None:
        yield judge_rules(read_iptables(iptables, numbers), needed)
    if nft is None and iptables is None and os.geteuid():
        yield Check("firewall", SKIPPED, "only root may read them", "run it by sudo", where="rules")
    elif nft is None and iptables is None:
        text = "neither nft nor iptables is here, or they do not answer"
        yield Check("firewall", SKIPPED, text, where="rules")
    with contextlib.suppress(OSError):
        if "ENABLED=yes" in Path("/etc/ufw/ufw.conf").read_text(encoding="utf-8", errors="replace"):
            text = f"is switched on: it must let in {needed}"
            yield Check("firewall", WARN, text, "`sudo ufw status` shows its rules", where="ufw")
    if any(process.info["name"] == "firewalld" for process in psutil.process_iter(["name"])):
        text = f"runs: its zone must let in {needed}"
        yield Check("firewall", WARN, text, "`firewall-cmd --list-all` shows its zone", where="firewalld")


# The value of rp_filter that drops a packet whose answer would leave by another interface (RFC 3704).
_STRICT: Final = 1


def rp_filter(given: DoctorInput) -> Iterable[Check]:
    """The check of ``net.ipv4.conf.NAME.rp_filter``."""
    values = {}
    for path in Path("/proc/sys/net/ipv4/conf").glob("*/rp_filter"):
        with contextlib.suppress(OSError, ValueError):
            values[path.parent.name] = int(path.read_text(encoding="ascii"))
    return [judge_rp_filter(values, given.interfaces)]


def judge_rp_filter(values: Mapping[str, int], interfaces: Sequence[Interface]) -> Check:
    """Whether the kernel drops packets that come in on another interface than answers would leave by.

    Args:
        values: ``net.ipv4.conf.NAME.rp_filter`` by name, ``all`` among them.
        interfaces: All of them.
    """
    outer = [one.name for one in interfaces if one.used and not one.loopback]
    strict = [name for name in outer if max(values.get("all", 0), values.get(name, 0)) == _STRICT]
    if not values:
        return Check("rp_filter", SKIPPED, "this kernel does not say")
    if len(outer) < 2 or not strict:
        return Check("rp_filter", OK, "no packet is dropped because of the interface by which it comes")
    text = (
        f"strict on {', '.join(strict)}, and there are {len(outer)} interfaces: packets of a peer that is routed "
        "by another one are dropped without a message"
    )
    return Check("rp_filter", WARN, text, "sudo sysctl -w net.ipv4.conf.all.rp_filter=2 (and of each interface)")


def radio(given: DoctorInput) -> Iterable[Check]:
    """The check of the wireless interfaces that an agent would use, with what their routes say."""
    found = []
    for one in given.interfaces:
        if one.used and one.networks and Path(f"/sys/class/net/{one.name}/phy80211").exists():
            network = str(one.networks[0].network)
            route = ask_program("ip", "-4", "route", "show", network, "dev", one.name) or ""
            words = route.partition(" rto_min ")[2].removeprefix("lock ").split()
            found.append((one.name, network, words[0] if words else ""))
    return judge_radio(found, quick=repeats_quickly(), bbr=may_use_bbr())


def judge_radio(radios: Sequence[tuple[str, str, str]], *, quick: bool, bbr: bool) -> Iterator[Check]:
    """Whether packets that a radio loses are repeated soon, and whether large messages fill its queue.

    Args:
        radios: Of the wireless interfaces that an agent would use: the name, the network, and ``rto_min`` of its
            route, as ``ip route`` shows it; empty for none, or where ``ip`` is missing.
        quick: Whether this kernel lets an agent shorten the time-outs of its own links (TCP_RTO_MIN_US).
        bbr: Whether this process may use BBR for its large messages.
    """
    for name, network, rto_min in radios:
        check, remedy = partial(Check, "radio", where=name), f"sudo ip route change {network} dev {name} rto_min 40ms"
        if rto_min:
            yield check(OK, f"its route has rto_min {rto_min}: lost packets are repeated soon")
        elif quick:
            text = "agents repeat lost commands soon; connections of nodes (direct transport) wait 200 ms"
            yield check(OK, text, remedy)
        else:
            text = "TCP waits 200 ms before it repeats a lost packet, and this kernel has no option for less"
            yield check(WARN, text, remedy)
        if not bbr:
            text = "BBR is not permitted: commands wait some 30 ms in the radio's queue behind large messages"
            permit = 'sudo modprobe tcp_bbr; sudo sysctl -w net.ipv4.tcp_allowed_congestion_control="reno cubic bbr"'
            yield check(WARN, text, permit)
    if not radios:
        yield Check("radio", SKIPPED, "no wireless interface is used")


def routes(given: DoctorInput) -> Iterable[Check]:
    """The check of the routes to peers and seeds. Nothing is sent."""
    targets = {
        address.partition(":")[0]: f"{address.partition(':')[0]} ({peer.name})"
        for snapshot in given.snapshots.values()
        for peer in snapshot.peers
        for address in peer.addresses[:1]
    }
    found = {}
    for seed, addresses in resolve(seed.host for seed in given.settings.seeds).items():
        targets |= {address: f"{address} (seed {seed})" for address in addresses[:1]}
        if not addresses:
            found[f"seed {seed}"] = "the name cannot be resolved"
    return judge_routes({text: _no_route(host) for host, text in targets.items()} | found)


def _no_route(host: str) -> str:
    """Why the kernel has no route to an address, or an empty string."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            probe.connect((host, 9))
        except OSError as error:
            return error.strerror or str(error)
    return ""


def judge_routes(routes: Mapping[str, str]) -> Iterator[Check]:
    """Whether the kernel has a route to each address of a peer or seed.

    Args:
        routes: Why there is none, or empty, by the address, ready to read (with the peer's name).
    """
    remedy = "`ip route get ADDRESS`; a gateway is missing, or the interface of that network is down"
    for target, problem in routes.items():
        if problem:
            yield Check("route", FAIL, f"there is no route: {problem}", remedy, where=target, code="no-route")
        elif len(routes) <= limits.DOCTOR_PEERS_LISTED:
            yield Check("route", OK, "there is a route", where=target)
    reached = sum(not problem for problem in routes.values())
    if reached and len(routes) > limits.DOCTOR_PEERS_LISTED:
        yield Check("route", OK, f"there is a route to {reached:,} of {len(routes):,} peers and seeds")
    if not routes:
        yield Check("route", SKIPPED, "no peer and no seed is known to look for a route to")


def ports(given: DoctorInput) -> Iterator[Check]:
    """The check of the ports of an agent with these settings: they are bound for a moment."""
    settings, ours, processes = given.settings, {}, {}
    for name, snapshot in given.snapshots.items():
        processes[snapshot.agent.pid] = name
        core = snapshot.agent.core_uri.rstrip("/").rpartition(":")[2]
        mesh = snapshot.agent.guid.partition("#")[0].rpartition(":")[2]
        for text, what in ((core, "the core of agent"), (mesh, "agent")):
            if text.isdecimal():
                ours[int(text)] = f"{what} {name}"
    if settings.core_mode == "embedded":  # an external core has its port already
        yield _tcp("the ROS core", settings.core_host, settings.core_port, ours)
    if settings.port:
        yield _tcp("the mesh (TCP)", "", settings.port, ours)
    number = settings.discovery_port
    try:
        open_receiver(settings.multicast.group, number).close()
    except OSError as error:
        yield judge_port("beacons (UDP)", number, error.strerror or str(error), program_at(number))
    else:
        yield judge_port("beacons (UDP)", number, owner=_users(number, processes))


def _tcp(what: str, host: str, number: int, ours: Mapping[int, str]) -> Check:
    with socket.socket(socket.AF_INET, socket.SOCK_STREAM) as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((host, number))
        except OSError as error:
            owner, why = ours.get(number, ""), error.strerror or str(error)
            return judge_port(what, number, why, owner or program_at(number), ours=bool(owner))
    return judge_port(what, number)


def _users(number: int, agents: Mapping[int, str]) -> str:
    """The programs that share a UDP port, ready to read; empty for none.

    Args:
        number: The port.
        agents: The names of the agents of this machine, by process id.
    """
    names: dict[str, None] = {}
    with contextlib.suppress(psutil.Error, OSError):
        for at in psutil.net_connections("udp4"):
            if not at.laddr or at.laddr.port != number:
                continue
            name = "a program of another user"
            if at.pid is not None:
                name = f"a program (pid {at.pid})"
                with contextlib.suppress(psutil.Error):
                    name = f"{psutil.Process(at.pid).name()} (pid {at.pid})"
                name = f"agent {agents[at.pid]}" if at.pid in agents else name
            names[name] = None
    return " and ".join(names)


def judge_port(what: str, number: int, taken: str = "", owner: str = "", *, ours: bool = False) -> Check:
    """Whether an agent can bind a port that it needs.

    Args:
        what: Its use, ready to read.
        number: Its number.
        taken: Why it cannot be bound, or empty.
        owner: The program that has it, ready to read; empty if none or unknown. A port that is not ``taken`` may have
            one too: agents share the port of the beacons.
        ours: Whether the owner is an agent of this machine, or its core.
    """
    check = partial(Check, "port", where=str(number))
    if not taken:
        return check(OK, f"{what}: used by {owner}; others may use it too" if owner else f"{what}: free")
    if ours:
        return check(OK, f"{what}: {owner} has it")
    text = f"{what}: taken{f' by {owner}' if owner else ''} ({taken})"
    remedy = f"end that program (`ss -lptun | grep :{number}` names it), or choose another port"
    return check(FAIL, text, remedy)
