"""Which limits of the kernel are too low for which mesh."""

from __future__ import annotations

from dataclasses import replace
from ipaddress import IPv4Interface
from typing import TYPE_CHECKING

import msgspec
import pytest

from rmpa.config.settings import Settings
from rmpa.core.links import Links
from rmpa.observe.check import Check, CheckLevel
from rmpa.observe.doctor.kernel_limits import KernelLimits, MeshSize, judge_kernel_limits, mesh_size
from rmpa.observe.doctor.network import NetworkInterface
from rmpa.observe.peer_info import PeerInfo
from tests.observe.samples import SNAPSHOT

if TYPE_CHECKING:
    from rmpa.observe.snapshot import Snapshot

USUAL = KernelLimits(receive_buffer=212_992, backlog=4096, neighbours=1024, memberships=20, files=1_048_576)
"""Debian's, for an agent under systemd."""
SMALL = MeshSize(modules=64, why="which mesh.full_mesh_up_to allows", all_linked=True, neighbours=63, interfaces=2)
LARGE = MeshSize(modules=1000, why="as agent base knows", all_linked=False, neighbours=999, interfaces=2)
LO = NetworkInterface("lo", (IPv4Interface("127.0.0.1/8"),), loopback=True)
ETH = NetworkInterface("eth0", (IPv4Interface("10.0.0.5/16"),))
SPARE = NetworkInterface("eth1", (IPv4Interface("10.9.0.5/16"),), used=False)


def snapshot(*addresses: str) -> Snapshot:
    peers = tuple(
        PeerInfo(name=f"m{n}", guid="", instance="", state="parked", since_ago=1.0, addresses=(address,))
        for n, address in enumerate(addresses)
    )
    return msgspec.structs.replace(SNAPSHOT, peers=peers)


def warned(found: list[Check]) -> dict[str, Check]:
    assert all(check.name == "kernel limits" for check in found)
    return {check.where: check for check in found if check.level is CheckLevel.WARN}


def test_the_usual_limits_are_enough_for_a_small_mesh() -> None:
    (found,) = judge_kernel_limits(USUAL, SMALL)
    assert found.level is CheckLevel.OK
    assert found.text == "enough for a mesh of 64 modules, which mesh.full_mesh_up_to allows"
    (unknown,) = judge_kernel_limits(KernelLimits(), SMALL)
    assert unknown.level is CheckLevel.OK


def test_the_usual_limits_are_not_enough_for_a_thousand() -> None:
    found = judge_kernel_limits(USUAL, LARGE)
    assert warned(found).keys() == {"net.core.rmem_max", "net.ipv4.neigh.default.gc_thresh3"}
    assert all(check.level is CheckLevel.WARN for check in found), "no word that all is well beside a warning"
    buffer, neighbours = warned(found).values()
    assert buffer.text == (
        "it is 212992: beacons are lost when 1,000 modules start at once, for only some 184 can wait to be read"
    )
    assert "sudo sysctl -w net.core.rmem_max=1048576 " in buffer.remedy
    assert "start the agent again" in buffer.remedy
    assert "999 modules are in this machine's networks" in neighbours.text
    assert neighbours.remedy.startswith(
        "sudo sysctl -w net.ipv4.neigh.default.gc_thresh1=999 net.ipv4.neigh.default.gc_thresh2=1998 "
        "net.ipv4.neigh.default.gc_thresh3=3996 "
    )


@pytest.mark.parametrize(
    ("kernel", "mesh", "where"),
    [
        (replace(USUAL, receive_buffer=65_536), SMALL, "net.core.rmem_max"),
        (replace(USUAL, receive_buffer=None), SMALL, ""),
        (replace(USUAL, receive_buffer=1_048_576, neighbours=8192), LARGE, ""),
        (replace(USUAL, backlog=128), SMALL, ""),
        (replace(USUAL, backlog=128), replace(SMALL, modules=129), ""),
        (replace(USUAL, backlog=128), replace(SMALL, modules=130), "net.core.somaxconn"),
        (replace(USUAL, neighbours=128), replace(SMALL, neighbours=96), ""),
        (replace(USUAL, neighbours=128), replace(SMALL, neighbours=97), "net.ipv4.neigh.default.gc_thresh3"),
        (replace(USUAL, neighbours=128), replace(LARGE, modules=150, neighbours=0), ""),
        (USUAL, replace(SMALL, interfaces=20), ""),
        (USUAL, replace(SMALL, interfaces=21), "net.ipv4.igmp_max_memberships"),
        (replace(USUAL, files=209), SMALL, "open files"),
        (replace(USUAL, files=210), SMALL, ""),
        (replace(USUAL, files=209), replace(SMALL, all_linked=False), ""),
    ],
)
def test_a_limit_is_reported_from_the_size_that_needs_it(kernel: KernelLimits, mesh: MeshSize, where: str) -> None:
    found = warned(judge_kernel_limits(kernel, mesh))
    assert [*found] == ([where] if where else [])
    for check in found.values():
        assert "sysctl -w net." in check.remedy or "LimitNOFILE" in check.remedy


def test_the_files_of_a_running_agent_can_be_raised_at_once() -> None:
    low = replace(USUAL, receive_buffer=None, neighbours=None, files=1024, pid=4242)
    (found,) = warned(judge_kernel_limits(low, replace(LARGE, all_linked=True, neighbours=0))).values()
    assert found.text == (
        "an agent may have 1024 files open; a mesh of 1,000 modules, as agent base knows, takes 2,082 with two "
        "connections for each link, before any topic"
    )
    assert "prlimit --pid 4242" in found.remedy


def test_a_namespace_that_does_not_show_the_table_of_neighbours() -> None:
    hidden = replace(USUAL, receive_buffer=None, neighbours=None)
    ok, skipped = judge_kernel_limits(hidden, LARGE)
    assert (ok.level, skipped.level) == (CheckLevel.OK, CheckLevel.SKIPPED)
    assert "outside of the container" in skipped.text


def test_size_is_what_the_settings_allow_or_what_an_agent_knows() -> None:
    interfaces = (LO, ETH, SPARE)
    few = snapshot("10.0.0.2", "10.0.3.4", "10.9.0.1", "192.168.1.1", "127.0.0.1")
    unknown = MeshSize(64, "a usual size, for no agent runs here that knows it", True, 0, 2)
    assert mesh_size(Settings(), [], interfaces) == unknown
    assert mesh_size(Settings(links=Links.DEMAND), [], interfaces) == replace(unknown, all_linked=False)
    assert mesh_size(Settings(), [few], interfaces) == MeshSize(64, "which mesh.full_mesh_up_to allows", True, 2, 2)
    for links, all_linked in ((Links.FULL, True), (Links.DEMAND, False)):
        size = mesh_size(Settings(links=links), [snapshot(), few], interfaces)
        assert size == MeshSize(6, "as agent base knows", all_linked, 2, 2)
    assert mesh_size(Settings(full_mesh_up_to=5), [few], interfaces).all_linked is False
    assert mesh_size(Settings(full_mesh_up_to=6), [few], interfaces).all_linked is True
