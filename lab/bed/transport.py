"""How a message gets from a node of one module to one of another: relayed by the agents, or straight; and the proof.

A figure is called by a transport, so the kernel is asked whether it was that one: the two processes share a TCP
connection that the publisher accepted, or they do not. What agents say of it is not needed.
"""

from __future__ import annotations

import contextlib
import time
from pathlib import Path
from typing import TYPE_CHECKING, Final

from lab.bed.processes import DEADLINE, BedError, Process

if TYPE_CHECKING:
    from collections.abc import Iterable

    from lab.bed.plan import Transport

    # A publisher, and a subscriber of it in another module.
    Pair = tuple[Process, Process]

_ESTABLISHED: Final = "01"
# States in /proc/net/tcp (proc_pid_net(5)).
_LISTENING: Final = "0A"


def settings(transport: Transport) -> str:
    """The part of ``rmpa.toml`` that asks for it, for topics and services."""
    return f'[bridge]\ntransport = "{transport}"\n\n[services]\ntransport = "{transport}"\n'


def require(transport: Transport, pairs: Iterable[Pair], timeout: float = DEADLINE) -> None:
    """Make sure that messages of each pair go by this transport and by no other.

    Raises:
        BedError: They do not; of a direct one that is missing, after ``timeout`` seconds.
    """
    deadline = time.monotonic() + timeout
    for publisher, subscriber in pairs:
        while transport == "direct" and not is_direct(publisher.pid, subscriber.pid):
            if time.monotonic() > deadline:
                raise BedError(
                    f"{subscriber.name} is not connected to {publisher.name} after {timeout} s: "
                    "what should be direct is not; `rmpa topic info` there says why"
                )
            time.sleep(0.05)
        if transport == "relay" and is_direct(publisher.pid, subscriber.pid):
            raise BedError(f"{subscriber.name} is connected to {publisher.name}: what should be relayed is direct")


def is_direct(publisher: int, subscriber: int) -> bool:
    """Whether a process has a TCP connection that another one accepted; both may be in network namespaces."""
    listening, accepted = _sockets(publisher)
    _, dialled = _sockets(subscriber)
    return any((remote, local) in dialled for local, remote in accepted if local.partition(":")[2] in listening)


def _sockets(pid: int) -> tuple[set[str], set[tuple[str, str]]]:
    """The ports at which a process listens, and its connections (local, remote), as the kernel writes them."""
    links: set[str] = set()
    with contextlib.suppress(FileNotFoundError):  # it has ended
        for link in Path(f"/proc/{pid}/fd").iterdir():
            with contextlib.suppress(FileNotFoundError):  # closed meanwhile
                links.add(str(link.readlink()))
        lines = Path(f"/proc/{pid}/net/tcp").read_text(encoding="ascii").splitlines()[1:]
        rows = [row for row in map(str.split, lines) if f"socket:[{row[9]}]" in links]
        ports = {row[1].partition(":")[2] for row in rows if row[3] == _LISTENING}
        return ports, {(row[1], row[2]) for row in rows if row[3] == _ESTABLISHED}
    return set(), set()
