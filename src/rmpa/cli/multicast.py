"""``rmpa multicast``: sends and receives single packets, to test multicast between two machines."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING

import click

from rmpa.cli.options import FiniteRange, json_option
from rmpa.cli.output import print_json, print_line, warn
from rmpa.config import limits as config_limits
from rmpa.core.errors import ConfigError, RmpaError
from rmpa.discovery import limits as discovery_limits
from rmpa.discovery.io.interfaces import choose, list_interfaces

if TYPE_CHECKING:
    from rmpa.discovery.io.interfaces import Interface

_interface = click.option(
    "--interface",
    "interfaces",
    metavar="NAME",
    multiple=True,
    help="Only this one; repeatable. [default: all usable]",
)
_group = click.option(
    "--group", default=config_limits.MULTICAST_GROUP, show_default=True, help="The multicast group."
)
_port = click.option(
    "--port",
    type=click.IntRange(1, 65535),
    default=discovery_limits.MULTICAST_TEST_PORT,
    show_default=True,
    help="The UDP port.",
)


def choose_interfaces(names: tuple[str, ...]) -> tuple[Interface, ...]:
    """The interfaces to use: the named ones, or all that can carry multicast.

    Raises:
        ConfigError: One that was named is not here, or cannot carry multicast.
        RmpaError: There is none at all.
    """
    there = list_interfaces()
    usable = choose(there, names)
    for name in names:
        if name not in {interface.name for interface in usable}:
            known = any(interface.name == name for interface in there)
            problem = "is down, or has no IPv4 address" if known else "is not here"
            raise ConfigError("--interface", f"{name} {problem}", f"there are {', '.join(i.name for i in there)}")
    if not usable:
        raise RmpaError("no interface is up and has an IPv4 address: `ip address` shows them")
    return usable


@click.command(
    epilog="\b\nExamples:\n  rmpa multicast send\n  rmpa multicast send --interface wlan0 --count 10 --interval 0.2\n"
)
@_interface
@_group
@_port
@click.option(
    "-c", "--count", type=click.IntRange(1), default=1, show_default=True, help="Packets on each interface."
)
@click.option("-i", "--interval", type=FiniteRange(0.01), default=0.5, show_default=True, help="Seconds between.")
@json_option
def send(interfaces: tuple[str, ...], group: str, port: int, count: int, interval: float, as_json: bool) -> int:
    """Send packets to the group, on every interface or on those that are named.

    Exits 1 if no packet could be sent on one of them.
    """
    from rmpa.observe.doctor.io.multicast import GroupSender

    wanted = choose_interfaces(interfaces)
    failed: dict[str, str] = {}
    with GroupSender(group, port) as sender:
        for number in range(1, count + 1):
            if number > 1:
                time.sleep(interval)
            for interface in wanted:
                problem = sender.send(interface, f"rmpa multicast {number} of {count}".encode())
                if problem:
                    failed[interface.name] = problem
                if as_json:
                    about = {"interface": interface.name, "number": number, "sent": not problem}
                    print_json(about | {"error": problem or None})
                elif not problem:
                    print_line(f"sent on {interface} to {group}:{port}")
    for name, problem in failed.items():
        warn(f"{name}: cannot be sent there: {problem}")
    return 1 if failed else 0


@click.command(
    epilog="\b\nExamples:\n  rmpa multicast receive\n  rmpa multicast receive --interface wlan0 -t 10 -c 3\n"
)
@_interface
@_group
@_port
@click.option("-c", "--count", type=click.IntRange(1), default=1, show_default=True, help="Packets to wait for.")
@click.option("-t", "--timeout", type=FiniteRange(0.01), help="Seconds to wait altogether. [default: for ever]")
@json_option
def receive(
    interfaces: tuple[str, ...], group: str, port: int, count: int, timeout: float | None, as_json: bool
) -> int:
    """Wait for packets of the group.

    Exits 1 if fewer than --count came within --timeout.
    """
    from rmpa.observe.doctor.io.multicast import GroupReceiver

    wanted = choose_interfaces(interfaces)
    until = None if timeout is None else time.monotonic() + timeout
    came = 0
    with GroupReceiver(group, port) as receiver:
        for name, problem in receiver.join(wanted).items():
            warn(f"{name}: cannot be joined: {problem}")
        if not as_json:
            print_line(f"waiting on {', '.join(map(str, wanted))} for packets to {group}:{port}")
        try:
            while came < count:
                rest = None if until is None else until - time.monotonic()
                packet = receiver.wait(rest)
                if packet is None:
                    break
                came += 1
                text = packet.data.decode("utf-8", "replace")
                if as_json:
                    fields = {"source": packet.source, "interface": packet.interface, "text": text}
                    print_json(fields)
                else:
                    print_line(f"from {packet.source} on {packet.interface}: {text!r}")
        except KeyboardInterrupt:
            pass
    if came < count:
        warn(f"{came} of {count} packets came; `rmpa doctor` may tell what is in the way")
        return 1
    return 0
