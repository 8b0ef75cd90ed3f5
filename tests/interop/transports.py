"""By which connections the nodes of a test exchange messages, as the kernel's tables of their hosts say."""

from __future__ import annotations

import subprocess
from typing import TYPE_CHECKING, Final

from lab.bed.processes import DEADLINE, eventually
from tests.interop.modules import Module, flows

if TYPE_CHECKING:
    from pathlib import Path

    from lab.bed.processes import Event, Process

AUTO: Final = '[bridge]\ntransport = "auto"\n'
RELAY: Final = '[[contract]]\ntopics = ["/chatter"]\ntransport = "relay"\n'


def reload(tmp_path: Path, module: Module, text: str) -> None:
    """Give an agent other settings."""
    (tmp_path / f"{module.name}.toml").write_text(text, encoding="utf-8")
    code, said = module.agent.rmpa("reload")
    assert code == 0, said


def on_the_network(*modules: Module) -> None:
    """Let the nodes that are started from now on listen for the network, not for loopback only."""
    for module in modules:
        module.ros.env["ROS_IP"] = module.host.address


def connections(process: Process) -> set[tuple[str, str]]:
    """The established TCP connections of a process: the own and the other end of each, as ``address:port``."""
    if process.returncode is not None:
        return set()
    command = ["nsenter", "-t", str(process.pid), "-n", "ss", "-tnpHO", "state", "established"]
    table = subprocess.run(command, capture_output=True, text=True, check=False, timeout=20).stdout
    rows = (line.split() for line in table.splitlines() if f"pid={process.pid}," in line)
    return {(_ipv4(row[2]), _ipv4(row[3])) for row in rows}


def _ipv4(endpoint: str) -> str:
    return endpoint.replace("[::ffff:", "").replace("]", "")


def links(subscriber: Process, publisher: Process) -> int:
    """The number of connections between two nodes; 0 if every message between them goes through the agents."""
    there = connections(publisher)
    return sum((other, own) in there for own, other in connections(subscriber))


def wait_direct(subscriber: Process, publisher: Process, timeout: float = DEADLINE) -> Event:
    """Wait until a node is connected to another one, once, and hears it; return its report."""
    what = f"{subscriber.name} connected to {publisher.name}"
    eventually(lambda: links(subscriber, publisher) == 1, timeout, what=what)
    return flows(subscriber)


def wait_relayed(subscriber: Process, publisher: Process, timeout: float = DEADLINE) -> Event:
    """Wait until a node is not connected to another one any more, but hears it; return its report."""
    what = f"{subscriber.name} not connected to {publisher.name}"
    eventually(lambda: links(subscriber, publisher) == 0, timeout, what=what)
    return flows(subscriber)


def in_order(report: Event) -> None:
    """Fail unless a report says: each byte right, none doubled or moved (gaps are allowed)."""
    assert (report["bad"], report["doubled"]) == (0, 0), report


def unbroken(report: Event) -> None:
    """Fail unless a report says: each byte right, none doubled, moved or missing after the first."""
    assert (report["bad"], report["doubled"], report["gaps"]) == (0, 0, 0), report
