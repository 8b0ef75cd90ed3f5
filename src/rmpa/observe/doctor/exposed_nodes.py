"""Judges which nodes of a secured module listen beyond this machine: what ROS 1 leaves open (docs/security.md)."""

from __future__ import annotations

from ipaddress import ip_address
from typing import TYPE_CHECKING, Final

from rmpa.observe.check import OK, SKIPPED, WARN, Check

if TYPE_CHECKING:
    from collections.abc import Mapping

_NAME: Final = "exposed nodes"
_LISTED: Final = 5
_REMEDY: Final = (
    "start them with ROS_IP=127.0.0.1 (roscpp's XML-RPC port stays open), and let a firewall drop what comes from "
    "outside to them (docs/security.md)"
)
_DIRECT: Final = "; direct transport needs them open, and crosses the network unprotected"


def judge_exposed_nodes(
    agent: str, exposed: Mapping[str, tuple[int, ...]] | None, *, trusted: bool, direct: bool = False
) -> Check:
    """Whether other machines reach the nodes of one agent's core past the agent.

    Args:
        agent: The agent's name.
        exposed: The TCP ports, beyond loopback, of each node that has some; ``None``: they cannot be read.
        trusted: Whether the module is in a secured mesh; else nothing is protected, and no ports are listed.
        direct: Whether the settings allow direct transport.
    """
    if not trusted:
        return Check(_NAME, SKIPPED, "trust is off: the mesh is open too (rmpa trust init)", where=agent)
    if exposed is None:
        return Check(_NAME, SKIPPED, "the core or the kernel does not tell the nodes' ports", where=agent)
    if not exposed:
        return Check(_NAME, OK, "every node listens on loopback alone", where=agent)
    listed = [f"{node} ({', '.join(map(str, ports))})" for node, ports in sorted(exposed.items())]
    more = f" and {len(listed) - _LISTED} more" if len(listed) > _LISTED else ""
    text = f"other machines reach {', '.join(listed[:_LISTED])}{more} without any check"
    return Check(_NAME, WARN, text, _REMEDY + (_DIRECT if direct else ""), where=agent)


def is_beyond_loopback(address: str) -> bool:
    """Whether a socket that listens at an address is reached from other machines."""
    try:
        return not ip_address(address).is_loopback
    except ValueError:
        return True
