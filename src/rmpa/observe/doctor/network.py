"""Judges the network: interfaces, multicast on each, routes, filters of the kernel, ports."""

from __future__ import annotations

import re
from collections import Counter
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from rmpa.observe.check import FAIL, OK, SKIPPED, WARN, Check

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence
    from ipaddress import IPv4Interface

_CONTAINERS: Final = re.compile(r"(docker|br-|veth|virbr|lxc|lxd|cni|flannel|podman|cali)")
_TUNNELS: Final = re.compile(r"(tun|tap|wg|zt|tailscale|ppp|utun|nordlynx|proton)")
_STRICT: Final = 1
"""Of rp_filter: packets must come by the way that answers would go (RFC 3704)."""


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


@dataclass(frozen=True, slots=True)
class MulticastEcho:
    """What became of a packet that an interface sent to ourselves.

    Args:
        card: The interface's name.
        problem: Why it could not be sent or joined; empty if it could.
        after: Seconds until it was heard; ``None`` if it was not.
    """

    card: str
    problem: str = ""
    after: float | None = None


def judge_cards(cards: Sequence[NetworkInterface], wanted: Sequence[str], *, container: bool = False) -> list[Check]:
    """Which interfaces there are for agents, and which of them are not what they seem.

    Args:
        cards: All.
        wanted: Those that the settings name; empty for all usable ones.
        container: Whether this is a container with a network of its own.
    """
    found = []
    missing = [name for name in wanted if name not in {card.name for card in cards}]
    for name in missing:
        have = ", ".join(card.name for card in cards)
        text = f"the settings name it, and it is not here (there are {have})"
        found.append(Check("interface", WARN, text, "correct discovery.interfaces, or plug it in", where=name))
    outer = [card for card in cards if card.used and not card.loopback]
    kept = [card.name for card in cards if card.loopback and card.name in wanted]
    if not outer and kept and not missing:
        text = "the settings keep agents to this machine"
        found.append(Check("interface", OK, text, where=kept[0]))
    elif not outer:
        down = [card.name for card in cards if not card.loopback]
        text = "none but loopback can be used: agents of other machines are not found"
        remedy = f"see `ip address`: {', '.join(down)} need to be up and have an IPv4 address" if down else ""
        found.append(Check("interface", WARN, text, remedy or "plug in a network"))
    found += [_card(card) for card in outer]
    found += _shared(outer)
    if container and outer:
        text = "this is a container with a network of its own: no multicast of the outside comes in"
        remedy = "start it with --network host, or reach the others by --seed HOST:PORT"
        found.append(Check("interface", WARN, text, remedy, where=outer[0].name))
    return found


def _card(card: NetworkInterface) -> Check:
    addresses = ", ".join(str(network) for network in card.networks)
    if _TUNNELS.match(card.name) or not card.multicast:
        text = f"{addresses}: a tunnel; most of them carry no multicast"
        return Check("interface", WARN, text, "name one agent behind it by --seed HOST:PORT", where=card.name)
    if _CONTAINERS.match(card.name):
        text = f"{addresses}: belongs to containers or virtual machines; agents send beacons there too"
        return Check("interface", OK, text, "to keep to one network: --interface NAME", where=card.name)
    if all(network.is_link_local for network in card.networks):
        text = f"{addresses}: it gave itself this address, for no DHCP server answered"
        return Check("interface", WARN, text, "is the cable in the right network?", where=card.name)
    return Check("interface", OK, addresses, where=card.name)


def _shared(cards: Sequence[NetworkInterface]) -> list[Check]:
    """Two interfaces in one network: the kernel answers by whichever it likes."""
    networks = Counter(
        network.network for card in cards for network in {n.network: n for n in card.networks}.values()
    )
    found = []
    for network in (network for network, count in networks.items() if count > 1 and network.prefixlen < 32):
        names = [card.name for card in cards if any(n.network == network for n in card.networks)]
        text = f"{' and '.join(names)} are both in {network}: answers may leave by the other one, and be dropped"
        found.append(Check("interface", WARN, text, "keep one of them, or --interface NAME", where="+".join(names)))
    return found


def judge_multicast(echoes: Iterable[MulticastEcho], group: str, port: int) -> list[Check]:
    """Whether each interface sends to the group, and hears what it sends."""
    found = []
    for echo in echoes:
        if echo.problem:
            text = f"{group}:{port} cannot be used: {echo.problem}"
            remedy = "an OUTPUT rule of the firewall, or no multicast on this interface: --seed HOST:PORT needs none"
            found.append(Check("multicast", FAIL, text, remedy, where=echo.card))
        elif echo.after is None:
            text = f"sent to {group}:{port}, but not heard: something on this machine drops it"
            remedy = f"let UDP port {port} in (ufw allow {port}/udp; nft or iptables: see the check firewall)"
            found.append(Check("multicast", FAIL, text, remedy, where=echo.card))
        else:
            text = f"{group}:{port} sent, and heard {echo.after * 1e3:.1f} ms later"
            found.append(Check("multicast", OK, text, where=echo.card))
    return found


def judge_rp_filter(values: Mapping[str, int], cards: Sequence[NetworkInterface]) -> list[Check]:
    """Whether the kernel drops what comes by another interface than answers would leave by.

    Args:
        values: ``net.ipv4.conf.NAME.rp_filter`` by name, ``all`` among them.
        cards: All interfaces.
    """
    outer = [card.name for card in cards if card.used and not card.loopback]
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


def judge_mtu_probing(value: int | None, *, black_hole: bool) -> Check:
    """Whether the kernel finds the MTU of a path that drops large packets without a word.

    Agents do it for their own links; this is about all other TCP connections.

    Args:
        value: ``net.ipv4.tcp_mtu_probing``: 0 never, 1 behind a black hole, 2 always; ``None``: not known.
        black_hole: Whether an agent has met such a path.
    """
    if value is None:
        return Check("mtu", SKIPPED, "this kernel does not tell", where="probing")
    name = "net.ipv4.tcp_mtu_probing"
    if value:
        return Check("mtu", OK, f"{name} is {value}: TCP finds a path's MTU itself", where="probing")
    if black_hole:
        text = f"a path drops large packets, and {name} is 0: ssh and other programs hang on it"
        return Check("mtu", WARN, text, f"sudo sysctl -w {name}=1 (on both machines)", where="probing")
    text = f"{name} is 0, Linux's default; agents find a path that drops large packets themselves"
    return Check("mtu", OK, text, where="probing")


def judge_routes(routes: Mapping[str, str]) -> list[Check]:
    """Whether the kernel has a way to each address that agents want to reach.

    Args:
        routes: By address, ready to read (a peer's name behind it perhaps): why there is none, or empty.
    """
    found = []
    for target, problem in routes.items():
        if problem:
            remedy = "`ip route get ADDRESS`; a gateway is missing, or the interface of that network is down"
            found.append(Check("route", FAIL, f"there is no way: {problem}", remedy, where=target))
        else:
            found.append(Check("route", OK, "there is a way", where=target))
    return found or [Check("route", SKIPPED, "no peer and no seed is known whose way could be looked for")]


@dataclass(frozen=True, slots=True)
class Port:
    """One port that an agent needs.

    Args:
        what: For what, ready to read.
        number: Its number.
        taken: Why it cannot be had, or empty.
        owner: Who has it, ready to read; empty if nobody or unknown. A port that is not ``taken`` may have one too:
            agents share the port of the beacons.
        ours: Whether that is an agent, or an agent's core, of this machine.
    """

    what: str
    number: int
    taken: str = ""
    owner: str = ""
    ours: bool = False


def judge_ports(ports: Iterable[Port]) -> list[Check]:
    """Whether an agent can have the ports that it needs."""
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
