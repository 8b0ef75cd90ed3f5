"""Judges the limits of the kernel and of the process that a large mesh can reach."""

from __future__ import annotations

from dataclasses import dataclass
from ipaddress import IPv4Address
from typing import TYPE_CHECKING, Final

from rmpa.core.links import Links
from rmpa.core.open_files import remedy as files_remedy
from rmpa.discovery.limits import RECEIVE_BUFFER_BYTES
from rmpa.observe import limits
from rmpa.observe.check import OK, SKIPPED, WARN, Check
from rmpa.runtime.limits import DESCRIPTORS_RESERVED, MESH_BACKLOG

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Sequence

    from rmpa.config.settings import Settings
    from rmpa.observe.doctor.network import NetworkInterface
    from rmpa.observe.snapshot import Snapshot

NAME: Final = "kernel limits"
RECEIVE_BUFFER: Final = "net.core.rmem_max"
BACKLOG: Final = "net.core.somaxconn"
NEIGHBOURS: Final = "net.ipv4.neigh.default.gc_thresh3"
MEMBERSHIPS: Final = "net.ipv4.igmp_max_memberships"
_KEEP: Final = "(a line in /etc/sysctl.d/ keeps it)"


@dataclass(frozen=True, slots=True)
class KernelLimits:
    """The limits that an agent of this machine has; ``None`` where one is unknown, or does not bind the agent.

    Args:
        receive_buffer: ``net.core.rmem_max``, in bytes; a process with CAP_NET_ADMIN may exceed it.
        backlog: ``net.core.somaxconn``, in connections.
        neighbours: ``net.ipv4.neigh.default.gc_thresh3``, in addresses; network namespaces do not show it.
        memberships: ``net.ipv4.igmp_max_memberships``, in interfaces of one socket.
        files: File descriptors that the agent may have.
        pid: The process of the agent that ``files`` is about; ``None``: one that would be started here.
    """

    receive_buffer: int | None = None
    backlog: int | None = None
    neighbours: int | None = None
    memberships: int | None = None
    files: int | None = None
    pid: int | None = None


@dataclass(frozen=True, slots=True)
class MeshSize:
    """How large a mesh the limits have to be enough for.

    Args:
        modules: The modules, this one included.
        why: Where this number is from, ready to read.
        all_linked: Whether each module keeps a link to each other one.
        neighbours: Modules in the networks that this machine is in, which it reaches without a router.
        interfaces: Interfaces on which an agent receives multicast.
    """

    modules: int
    why: str
    all_linked: bool
    neighbours: int = 0
    interfaces: int = 1


def mesh_size(settings: Settings, snapshots: Iterable[Snapshot], interfaces: Sequence[NetworkInterface]) -> MeshSize:
    """The size of the mesh: as agents know it, or as the settings allow it, whichever is larger.

    Args:
        settings: What an agent that is started here would have.
        snapshots: Of the agents of this machine.
        interfaces: Of this machine.
    """
    used = [one for one in interfaces if one.used]
    networks = [network.network for one in used if not one.loopback for network in one.networks]
    allowed = settings.full_mesh_up_to
    largest = max(snapshots, key=lambda shown: len(shown.peers), default=None)
    if largest is None:
        why = "a usual size, for no agent runs here that knows it"
        return MeshSize(allowed, why, settings.links is not Links.DEMAND, 0, len(used))
    hosts = {peer.addresses[0].partition(":")[0] for peer in largest.peers if peer.addresses}
    neighbours = sum(any(IPv4Address(host) in network for network in networks) for host in hosts)
    modules = 1 + len(largest.peers)
    if settings.links is Links.AUTO and allowed >= modules:
        return MeshSize(allowed, "which mesh.full_mesh_up_to allows", True, neighbours, len(used))
    why = f"as agent {largest.agent.name} knows"
    return MeshSize(modules, why, settings.links is Links.FULL, neighbours, len(used))


def judge_kernel_limits(kernel: KernelLimits, mesh: MeshSize) -> list[Check]:
    """Which limits are too low for a mesh; each with the command that raises it."""
    found = [
        *_receive_buffer(kernel.receive_buffer, mesh.modules),
        *_backlog(kernel.backlog, mesh.modules),
        *_neighbours(kernel.neighbours, mesh.neighbours),
        *_memberships(kernel.memberships, mesh.interfaces),
        *_files(kernel, mesh),
    ]
    if any(check.level is WARN for check in found):
        return found
    return [Check(NAME, OK, f"enough for a mesh of {mesh.modules:,} modules, {mesh.why}"), *found]


def _receive_buffer(value: int | None, modules: int) -> Iterator[Check]:
    if value is None or value >= RECEIVE_BUFFER_BYTES:
        return
    room = 2 * value // limits.DOCTOR_BEACON_BYTES  # the kernel doubles what a program asks for (socket(7))
    if modules > room:
        text = (
            f"it is {value}: beacons are lost when {modules:,} modules start at once, "
            f"for only some {room} can wait to be read"
        )
        remedy = f"sudo sysctl -w {RECEIVE_BUFFER}={RECEIVE_BUFFER_BYTES} {_KEEP}; then start the agent again"
        yield Check(NAME, WARN, text, remedy, where=RECEIVE_BUFFER)


def _backlog(value: int | None, modules: int) -> Iterator[Check]:
    if value is not None and value < min(modules - 1, MESH_BACKLOG):
        text = (
            f"it is {value}: when {modules:,} modules dial at once, only so many connections can wait "
            "to be accepted; the others dial again, and are linked later"
        )
        remedy = f"sudo sysctl -w {BACKLOG}=4096 {_KEEP}; then start the agent again"
        yield Check(NAME, WARN, text, remedy, where=BACKLOG)


def _neighbours(value: int | None, neighbours: int) -> Iterator[Check]:
    share = limits.DOCTOR_NEIGHBOURS_SHARE
    if value is None:
        if neighbours > share * limits.DOCTOR_NEIGHBOURS_USUAL:
            text = f"the kernel does not show {NEIGHBOURS} here: read it on the host, outside of the container"
            yield Check(NAME, SKIPPED, text, where=NEIGHBOURS)
        return
    if neighbours > share * value:
        text = (
            f"it is {value}, and {neighbours:,} modules are in this machine's networks: the kernel keeps "
            "the hardware addresses of so many neighbours, and drops packets to further ones"
        )
        enough = 4 * neighbours
        steps = " ".join(
            f"net.ipv4.neigh.default.gc_thresh{step}={enough // part}" for step, part in ((1, 4), (2, 2), (3, 1))
        )
        yield Check(NAME, WARN, text, f"sudo sysctl -w {steps} {_KEEP}", where=NEIGHBOURS)


def _memberships(value: int | None, interfaces: int) -> Iterator[Check]:
    if value is not None and interfaces > value:
        text = f"it is {value}, and agents use {interfaces} interfaces: on the others no beacon is received"
        remedy = f"sudo sysctl -w {MEMBERSHIPS}={2 * interfaces} {_KEEP}, or fewer interfaces (--interface NAME)"
        yield Check(NAME, WARN, text, remedy, where=MEMBERSHIPS)


def _files(kernel: KernelLimits, mesh: MeshSize) -> Iterator[Check]:
    links = (mesh.modules - 1) * (2 if mesh.all_linked else 1)
    needed = limits.DOCTOR_FILES_OWN + links + DESCRIPTORS_RESERVED
    if kernel.files is not None and kernel.files < needed:
        reason = "with two connections for each link" if mesh.all_linked else "when all of them start at once"
        text = (
            f"an agent may have {kernel.files} files open; a mesh of {mesh.modules:,} modules, {mesh.why}, "
            f"takes {needed:,} {reason}, before any topic"
        )
        yield Check(NAME, WARN, text, files_remedy(kernel.pid), where="open files")
