"""Judges the network: interfaces, multicast on each, filters of the kernel, routes, ports."""

from __future__ import annotations

import re
from collections import Counter
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Final

from rmpa.observe import limits
from rmpa.observe.check import FAIL, OK, SKIPPED, WARN, Check

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence
    from ipaddress import IPv4Interface

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
