"""What ``rmpa doctor`` says of facts; the golden file has the texts whole."""

from __future__ import annotations

from functools import partial
from ipaddress import IPv4Interface
from typing import TYPE_CHECKING, Any, Final

import msgspec
import pytest

from rmpa.core.facts import FilesInfo, UnreachableInfo
from rmpa.discovery.network import Interface
from rmpa.observe.check import FAIL, WARN, Check
from rmpa.observe.doctor.checks import is_beyond_loopback, judge_agents, judge_exposed_nodes, judge_membership
from rmpa.observe.doctor.machine import (
    judge_clock,
    judge_rights,
    judge_sim_time,
    judge_unit,
)
from rmpa.observe.doctor.network import (
    MulticastEcho,
    judge_interfaces,
    judge_multicast,
    judge_port,
    judge_radio,
    judge_routes,
    judge_rp_filter,
)
from rmpa.observe.snapshot import FOREIGN, PeerInfo, Snapshot
from rmpa.observe.why.diagnosis import judge_peer_clock
from rmpa.trust.permissions import TrustStatus
from tests.observe.samples import SNAPSHOT

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable

LO = Interface("lo", (IPv4Interface("127.0.0.1/8"),), loopback=True)
WLAN = Interface("wlan0", (IPv4Interface("192.168.1.5/24"),))
ETH = Interface("eth0", (IPv4Interface("10.0.0.5/24"),))
STRICT: Final = {"all": 1, "wlan0": 0, "eth0": 0}
GOOD: Final[dict[str, Any]] = {"stepped": 0.00001, "synchronised": True, "error": 0.004, "year": 2026}
WALL: Final = 1_790_000_000
TAKEN: Final = "Address already in use"
MEMBER: Final = TrustStatus(on=True, module="arm", expires=WALL + 7200, key=3, deny_number=1)
JOYSTICK, PC = SNAPSHOT.peers
RADIO: Final = ("wlan0", "10.0.0.0/24", "")
ROUTES: Final = {f"10.0.{n >> 8}.{n & 255} (m{n})": "" for n in range(999)} | {"10.1.0.2 (arm)": "none"}


def interfaces(
    *more: Interface, wanted: tuple[str, ...] = (), container: bool = False
) -> Callable[[], Iterable[Check]]:
    return partial(judge_interfaces, (LO, *more), wanted, container=container)


def card(name: str, network: str) -> Interface:
    return Interface(name, (IPv4Interface(network),))


def one(judge: Callable[..., Check], *args: object, **more: object) -> Callable[[], Iterable[Check]]:
    return lambda: [judge(*args, **more)]


def agent(snapshot: Snapshot = SNAPSHOT, version: str = "0.1.0", **changes: object) -> Callable[[], Iterable[Check]]:
    return partial(judge_agents, {"base": msgspec.structs.replace(snapshot, **changes)}, version)


def files(problem: str = "", *, near: bool = False) -> Callable[[], Iterable[Check]]:
    few = FilesInfo(open=60, limit=64, hard=64, reserved=16, near=near, problem=problem)
    changed = msgspec.structs.replace(SNAPSHOT.agent, files=few)
    return agent(agent=changed, notes=(problem,) if problem else ())


UNIT: Final = {"LoadState": "loaded", "ActiveState": "active", "UnitFileState": "enabled", "Result": "success"}
CASES: dict[str, Callable[[], Iterable[Check]]] = {
    "two ordinary interfaces": interfaces(WLAN, ETH),
    "an interface that is down": interfaces(Interface("eth0", up=False, used=False)),
    "no network at all": interfaces(),
    "settings that keep to loopback": interfaces(Interface("eth0", ETH.networks, used=False), wanted=("lo",)),
    "an interface that is not there": interfaces(WLAN, wanted=("wlan0", "eth7")),
    **{f"a tunnel {name}": interfaces(card(name, "10.8.0.2/32")) for name in ("tun0", "wg0", "tailscale0", "ztabc")},
    "interfaces of containers": interfaces(card("docker0", "172.17.0.1/16")),
    "an address that no DHCP gave": interfaces(card("eth0", "169.254.3.4/16")),
    "two interfaces in one network": interfaces(WLAN, card("eth0", "192.168.1.6/24")),
    "a container": interfaces(ETH, container=True),
    "multicast": partial(
        judge_multicast,
        (MulticastEcho("lo", after=0.0002), MulticastEcho("eth0"), MulticastEcho("wlan0", "not permitted")),
        *("239.255.82.77", 11411),
    ),
    "strict filters and two interfaces": one(judge_rp_filter, STRICT, (LO, WLAN, ETH)),
    "strict filters and one interface": one(judge_rp_filter, STRICT, (LO, WLAN)),
    "loose filters": one(judge_rp_filter, {"all": 2, "wlan0": 1}, (WLAN, ETH)),
    "unknown filters": one(judge_rp_filter, {}, (WLAN, ETH)),
    "routes": partial(judge_routes, {"10.1.0.2 (arm)": "Network is unreachable", "10.0.0.2 (base)": ""}),
    "no routes": partial(judge_routes, {}),
    "routes to many": partial(judge_routes, ROUTES),
    "a port that another program has": one(judge_port, "the ROS core", 11311, TAKEN, "roscore (pid 7)"),
    "a port of ours": one(judge_port, "the mesh (TCP)", 40001, TAKEN, "agent base", ours=True),
    "a free port": one(judge_port, "beacons (UDP)", 11411),
    "a shared port": one(judge_port, "beacons (UDP)", 11412, owner="agent base"),
    "no radio": partial(judge_radio, (), quick=False, bbr=False),
    "a radio and a quick kernel": partial(judge_radio, [RADIO], quick=True, bbr=True),
    "a radio whose losses are repeated late and whose queue is filled": partial(
        judge_radio, [RADIO], quick=False, bbr=False
    ),
    "a radio that was set": partial(judge_radio, [(*RADIO[:2], "40ms")], quick=False, bbr=True),
    "a good clock": partial(judge_clock, **GOOD),
    "a clock that was set and of which nothing is known": partial(
        judge_clock, **GOOD | {"stepped": -0.2, "synchronised": None}
    ),
    "a clock alone, in the year 1970": partial(judge_clock, **GOOD | {"synchronised": False, "year": 1970}),
    "no simulated time": partial(judge_sim_time, "base", None),
    "simulated time": partial(judge_sim_time, "base", ["/gazebo"]),
    "simulated time that stands": partial(judge_sim_time, "base", []),
    "clocks that agree": one(judge_peer_clock, "base", "arm", 0.001, 0.0),
    "a clock ahead": one(judge_peer_clock, "base", "arm", 0.5, 0.0),
    "a clock behind": one(judge_peer_clock, "base", "arm", -0.5, None),
    "a clock within its error": one(judge_peer_clock, "base", "arm", 0.5, 0.6),
    "all rights": partial(judge_rights, "", None, 65536, wanted=True),
    "no rights and few files": partial(judge_rights, "not permitted", 65536, 1024, wanted=True),
    "rights that are not wanted; an agent tells its files": partial(
        judge_rights, "not permitted", 65536, None, wanted=False
    ),
    "a member": one(judge_membership, MEMBER, WALL),
    "a certificate that ends": one(
        judge_membership, msgspec.structs.replace(MEMBER, problems=("ends in 2 h; start it",)), WALL
    ),
    "a certificate that has ended": one(
        judge_membership, msgspec.structs.replace(MEMBER, problems=("ended; renew it",)), WALL + 8000
    ),
    "a clock that is not set": one(
        judge_membership, msgspec.structs.replace(MEMBER, clock_set=False, problems=("not set; do",)), WALL + 8000
    ),
    "a unit": one(judge_unit, UNIT),
    "no unit": one(judge_unit, {"LoadState": "not-found"}),
    "a unit that is not enabled": one(judge_unit, UNIT | {"UnitFileState": "disabled"}),
    "a unit of the package that was never set up": one(
        judge_unit, UNIT | {"UnitFileState": "disabled", "ActiveState": "inactive"}
    ),
    "a unit that was switched off": one(
        judge_unit, UNIT | {"UnitFileState": "disabled", "ActiveState": "inactive", "FragmentPath": "/etc/x"}
    ),
    "a unit that was stopped": one(judge_unit, UNIT | {"ActiveState": "inactive"}),
    "a unit that has failed": one(judge_unit, UNIT | {"ActiveState": "failed", "Result": "watchdog"}),
    "nodes of an open mesh": one(judge_exposed_nodes, "base", None, trusted=False),
    "unknown nodes": one(judge_exposed_nodes, "base", None, trusted=True),
    "nodes on loopback": one(judge_exposed_nodes, "base", {}, trusted=True),
    "exposed nodes": one(judge_exposed_nodes, "base", {"/talker": (1, 2), "/camera": (5,)}, trusted=True),
    "exposed nodes and direct transport": one(
        judge_exposed_nodes, "base", {f"/n{n}": (n,) for n in range(9)}, trusted=True, direct=True
    ),
    "no agent": partial(judge_agents, {}, "0.1.0"),
    "an agent that does not answer": partial(judge_agents, {"base": "no agent answers in time"}, "0.1.0"),
}


AGENTS: dict[str, tuple[Callable[[], Iterable[Check]], str]] = {
    # The facts of an agent, and the check.
    "itself": (agent(), "agent"),
    "its proxies": (agent(), "proxies"),
    "its core": (agent(), "core memory"),
    "its peers": (agent(), "peer"),
    "their clocks": (agent(), "clock"),
    "a conflict that keeps a peer out": (agent(peers=(msgspec.structs.replace(PC, state="conflict"),)), "peer"),
    "a peer that refuses has been reached by TCP": (
        agent(peers=(msgspec.structs.replace(PC, state="refused", conflicts=()),)),
        "peer",
    ),
    "a module that is not of this mesh, and no advice on multicast": (
        agent(
            peers=(),
            strangers=(
                PeerInfo(
                    name="opn",
                    guid="g",
                    instance="33" * 16,
                    state=FOREIGN,
                    since_ago=1.0,
                    last_error="not of this mesh: it has not joined; let it join",
                ),
            ),
        ),
        "peer",
    ),
    "of many modules that are not of this mesh some": (
        agent(
            peers=(), strangers=tuple(msgspec.structs.replace(PC, name=f"m{n}", last_error="x; y") for n in range(18))
        ),
        "peer",
    ),
    "a relayed peer needs no link": (
        agent(peers=(msgspec.structs.replace(JOYSTICK, state="relayed", link=None),)),
        "peer",
    ),
    "of many peers the problems": (
        agent(
            peers=(
                *(msgspec.structs.replace(JOYSTICK, name=f"m{n}", state="relayed", link=None) for n in range(999)),
                *(JOYSTICK, PC),
            )
        ),
        "peer",
    ),
    "what permissions refused": (
        agent(counters={"link.up": 3, "permission.call": 1, "permission.publish": 4}),
        "permissions",
    ),
    "nodes that cannot be reached": (
        agent(
            unreachable=(
                UnreachableInfo(node="/cam", uri="http://nosuch:1/", problem="no such name", ago=3.0),
                UnreachableInfo(node="/gone", uri="http://10.9.9.9:1/", problem="none", ago=60.0, withdrawn=True),
            )
        ),
        "node",
    ),
    "another version": (agent(notes=(), version="0.2.0"), "agent"),
    "alone": (agent(peers=()), "peer"),
    "files": (files(), "files"),
    "few files": (files(near=True), "files"),
    "no file": (files("node /x is refused: none left; raise it", near=True), "files"),
    "a shortage is said once": (files("none left; raise it"), "agent"),
}


def results(name: str) -> list[Check]:
    """What is said in a case."""
    if name in CASES:
        return [*CASES[name]()]
    judge, check = AGENTS[name]
    return [result for result in judge() if result.name == check and result.where]


def test_trouble_has_a_remedy() -> None:
    """The golden file has the levels and texts."""
    for name in (*CASES, *AGENTS):
        for check in results(name):
            assert check.remedy or check.level not in (WARN, FAIL) or check.text in SNAPSHOT.notes, name


@pytest.mark.parametrize(
    ("address", "beyond"),
    [("127.0.0.1", False), ("127.1.2.3", False), ("::1", False), ("0.0.0.0", True), ("::", True), ("10.0.0.1", True)],
)
def test_loopback(address: str, beyond: bool) -> None:
    assert is_beyond_loopback(address) is beyond
